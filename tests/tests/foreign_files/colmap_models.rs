//! COLMAP reconstructions: where they lie, what their cameras are, how their names are written.

use crate::base::Files;
use crate::{Expect, FileCase};
use segwild_scene::colmap::{self, Reconstruction};

/// Keeps the photos of these indexes, as COLMAP does where it makes several models.
fn part(files: &Files, to: &str, photos: std::ops::Range<usize>) {
    let mut model = files.model.clone();
    model.images = model.images[photos].to_vec();
    let ids: Vec<u32> = model.images.iter().map(|image| image.id).collect();
    model.points.iter_mut().for_each(|point| point.track.retain(|(id, _)| ids.contains(id)));
    colmap::write(&files.path(to), &model).expect("a model is written");
}

fn text(files: &Files) {
    files.remove("sparse/0");
    colmap::write_text(&files.path("sparse/0"), &files.model).expect("the model is written");
}

/// Writes the model as text, each file changed.
fn text_as(files: &Files, change: impl Fn(Vec<u8>) -> Vec<u8>) {
    text(files);
    for name in ["cameras", "images", "points3D"] {
        let name = format!("sparse/0/{name}.txt");
        let bytes = std::fs::read(files.path(&name)).expect("the text is there");
        files.write(&name, change(bytes));
    }
}

fn renamed(files: &Files, name: impl Fn(&str) -> String) {
    files.remodel(|model: &mut Reconstruction| {
        model.images.iter_mut().for_each(|image| image.name = name(&image.name));
    });
}

pub const ROWS: &[FileCase] = &[
    FileCase {
        name: "several models, the largest is not the first",
        make: |files| {
            files.remove("sparse");
            part(files, "sparse/0", 0..2);
            part(files, "sparse/1", 2..12);
        },
        settings: &[],
        expect: Expect::Reads {
            photos: 10,
            words: &["sparse/1 with 10 photos is taken", "sparse/0 (2)", "2 of the photos"],
        },
    },
    FileCase {
        name: "a model in sparse/1 alone",
        make: |files| files.rename("sparse/0", "sparse/1"),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "a model in colmap/sparse/0, as nerfstudio puts it",
        make: |files| files.rename("sparse/0", "colmap/sparse/0"),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "a model in distorted/sparse/0, as INRIA's script puts it",
        make: |files| {
            files.rename("sparse/0", "distorted/sparse/0");
            files.rename("images", "input");
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "a model in outputs/sfm, as hloc puts it",
        make: |files| files.rename("sparse/0", "outputs/sfm"),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "an undistorted model beside the distorted one",
        make: |files| colmap::write(&files.path("distorted/sparse/0"), &files.model).expect("written"),
        settings: &[],
        expect: Expect::Reads {
            photos: 12,
            words: &["/sparse/0 with 12 photos is taken", "distorted/sparse/0 (12)"],
        },
    },
    FileCase {
        name: "a model in dense/0/sparse, as COLMAP's automatic reconstructor puts it",
        make: |files| {
            files.rename("sparse/0", "dense/0/sparse");
            files.rename("images", "dense/0/images");
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "a model in dense/1 alone",
        make: |files| {
            files.rename("sparse/0", "dense/1/sparse");
            files.rename("images", "dense/1/images");
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "models in dense/0 and dense/1, the larger is the second",
        make: |files| {
            files.remove("sparse");
            part(files, "dense/0/sparse", 0..5);
            part(files, "dense/1/sparse", 5..12);
            (0..5).for_each(|i| {
                files.rename(&format!("images/photo{i:02}.png"), &format!("dense/0/images/photo{i:02}.png"))
            });
            files.rename("images", "dense/1/images");
        },
        settings: &[],
        expect: Expect::Reads {
            photos: 7,
            words: &["dense/1/sparse with 7 photos is taken", "dense/0/sparse (5)"],
        },
    },
    FileCase {
        name: "photos in dense/1 of a model elsewhere",
        make: |files| files.rename("images", "dense/1/images"),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "folders and lists in other capitals",
        make: |files| {
            files.rename("sparse", "Sparse");
            files.rename("images", "Images");
            files.write("Test_List.txt", "photo00.png\n");
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| assert_eq!(scene.views.iter().filter(|view| view.test).count(), 1),
        },
    },
    FileCase {
        name: "dense/images in other capitals",
        make: |files| {
            files.rename("sparse", "Dense/Sparse");
            files.rename("images", "Dense/Images");
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "names with accents, from a Mac",
        make: |files| {
            files.rename("images/photo03.png", "images/Cafe\u{301}.png");
            files.remodel(|model| model.images[3].name = "Caf\u{e9}.png".into());
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["found by what is left"] },
    },
    FileCase {
        name: "points3D.txt beside cameras.bin and images.bin",
        make: |files| {
            colmap::write_text(&files.path("sparse/text"), &files.model).expect("the model is written");
            files.rename("sparse/text/points3D.txt", "sparse/0/points3D.txt");
            files.remove("sparse/text");
            files.remove("sparse/0/points3D.bin");
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| {
                assert!(scene.points.len() == 60 && scene.points.iter().all(|p| p.track.len() == 12));
                assert!(scene.notes.iter().any(|note| note.contains("no points3D.bin")), "{:?}", scene.notes);
            },
        },
    },
    FileCase {
        name: "points3D.bin beside cameras.txt and images.txt",
        make: |files| {
            colmap::write_text(&files.path("sparse/0"), &files.model).expect("the model is written");
            ["cameras.bin", "images.bin", "points3D.txt"]
                .iter()
                .for_each(|name| files.remove(&format!("sparse/0/{name}")));
        },
        settings: &[],
        expect: Expect::Holds { photos: 12, check: |scene| assert_eq!(scene.points.len(), 60) },
    },
    FileCase {
        name: "points3D.ply in place of points3D.bin",
        make: |files| {
            files.remove("sparse/0/points3D.bin");
            let head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
                        property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
            files.write("sparse/0/points3D.ply", format!("{head}0 0 5 10 20 30\n1 0 5 10 20 30\n"));
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["points3D.ply", "2 of 2 points name no photo"] },
    },
    FileCase {
        name: "rigs.bin and frames.bin of COLMAP 3.12 beside the model",
        make: |files| {
            files.write("sparse/0/rigs.bin", [1, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]);
            files.write("sparse/0/frames.bin", [12, 0, 0, 0, 0, 0, 0, 0]);
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "photos on disk that the model does not hold",
        make: |files| ["more1.jpg", "more2.png"].iter().for_each(|name| files.photo(name)),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["2 of the photos", "more1.jpg"] },
    },
    FileCase {
        name: "text with a byte order mark and CRLF",
        make: |files| {
            text_as(files, |bytes| {
                let text = String::from_utf8(bytes).expect("text").replace('\n', "\r\n");
                [&b"\xef\xbb\xbf"[..], text.as_bytes()].concat()
            });
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "text in UTF-16",
        make: |files| {
            text_as(files, |bytes| {
                [0xff, 0xfe].into_iter().chain(bytes.into_iter().flat_map(|b| [b, 0])).collect()
            });
        },
        settings: &[],
        expect: Expect::Refuses(&["cameras.txt", "UTF-16", "save it as UTF-8"]),
    },
    FileCase {
        name: "backslashes in names",
        make: |files| {
            files.rename("images", "images2");
            files.rename("images2", "images/cam 0");
            renamed(files, |name| format!(r"cam 0\{name}"));
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| assert_eq!(scene.views[0].name, "cam 0/photo00.png"),
        },
    },
    FileCase {
        name: "names of another machine, Windows",
        make: |files| renamed(files, |name| format!(r"C:\Users\x\scene\images\{name}")),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["12 photos have other names"] },
    },
    FileCase {
        name: "names of another machine, absolute",
        make: |files| renamed(files, |name| format!("/home/other/scene/images/{name}")),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["12 photos have other names"] },
    },
    FileCase {
        name: "names that begin with ./",
        make: |files| renamed(files, |name| format!("./{name}")),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "names whose case differs from the files'",
        make: |files| renamed(files, |name| name.replace(".png", ".PNG")),
        settings: &[],
        expect: Expect::Reads {
            photos: 12,
            words: &["12 photos have other names", "photo00.PNG is photo00.png"],
        },
    },
    FileCase {
        name: "a photo in another folder than the model says",
        make: |files| files.rename("images/photo05.png", "images/other/photo05.png"),
        settings: &[],
        expect: Expect::Reads {
            photos: 11,
            words: &["photo05.png: there is no file", "other/photo05.png may be the one"],
        },
    },
    FileCase {
        name: "a photo with another ending than the model says",
        make: |files| files.rename("images/photo05.png", "images/photo05.jpg"),
        settings: &[],
        expect: Expect::Reads { photos: 11, words: &["photo05.jpg may be the one"] },
    },
    FileCase {
        name: "a name that leads out of the photo folder",
        make: |files| {
            files.rename("images/photo05.png", "photo05.png");
            renamed(files, |name| name.replace("photo05", "../photo05"));
        },
        settings: &[],
        expect: Expect::Reads { photos: 11, words: &["../photo05.png", "inside the photo folder"] },
    },
    #[cfg(target_os = "linux")]
    FileCase {
        name: "names in Latin-1",
        make: |files| {
            use std::os::unix::ffi::OsStrExt;
            let latin = std::ffi::OsStr::from_bytes(b"Stra\xdfe.png");
            let images = files.path("images/x");
            let images = images.parent().expect("the photo folder");
            std::fs::rename(images.join("photo05.png"), images.join(latin)).expect("a photo is renamed");
            // The other lies there as UTF-8.
            std::fs::rename(images.join("photo06.png"), images.join("Größe.png"))
                .expect("a photo is renamed");
            let path = files.path("sparse/0/images.bin");
            let bytes = std::fs::read(&path).expect("the model is there");
            let bytes = replace(&bytes, b"photo05.png", b"Stra\xdfe.png");
            files.write("sparse/0/images.bin", replace(&bytes, b"photo06.png", b"Gr\xf6\xdfe.png"));
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "an edited .txt beside a stale .bin",
        make: |files| {
            let mut edited = files.model.clone();
            edited.images.pop();
            colmap::write_text(&files.path("sparse/0"), &edited).expect("written");
        },
        settings: &[],
        expect: Expect::Reads {
            photos: 12,
            words: &["the .txt files do not say", "11 photos and 12", "the .bin files are read"],
        },
    },
    FileCase {
        name: "the same model as .txt and .bin",
        make: |files| colmap::write_text(&files.path("sparse/0"), &files.model).expect("written"),
        settings: &[],
        expect: Expect::Holds { photos: 12, check: |scene| assert_eq!(scene.notes, [""; 0]) },
    },
    FileCase {
        name: "a model in the scene's folder itself, and photos of the same names outside of it",
        make: |files| {
            for name in ["cameras.bin", "images.bin", "points3D.bin"] {
                files.rename(&format!("sparse/0/{name}"), name);
            }
            files.photo("../../images/photo00.png");
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| assert!(scene.views[0].photo.path.ends_with("scene/images/photo00.png")),
        },
    },
    FileCase {
        name: "a model in the scene's folder itself, and its photos outside of it",
        make: |files| {
            for name in ["cameras.bin", "images.bin", "points3D.bin"] {
                files.rename(&format!("sparse/0/{name}"), name);
            }
            files.rename("images", "../images");
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["which lies outside of", "with `images`"] },
    },
    FileCase {
        name: "two photos of which the same file may be left",
        make: |files| {
            renamed(files, |name| match name {
                "photo05.png" => "cam0/photo05.png".into(),
                "photo06.png" => "cam1/photo05.png".into(),
                other => other.into(),
            });
        },
        settings: &[],
        expect: Expect::Reads {
            photos: 10,
            words: &["`photo05.png` may be that of cam0/photo05.png or cam1/photo05.png", "2 of the photos"],
        },
    },
    FileCase {
        name: "a photo of its own name and another of which the same file may be left",
        make: |files| {
            renamed(files, |name| match name {
                "photo05.png" => "cam0/photo06.PNG".into(),
                "photo06.png" => "photo06.PNG".into(),
                other => other.into(),
            });
        },
        settings: &[],
        expect: Expect::Reads {
            photos: 11,
            words: &["cam0/photo06.PNG", "that is photo photo06.PNG already"],
        },
    },
    FileCase {
        name: "the raw originals beside the photos",
        make: |files| {
            files.write("images/photo05.CR2", "II*");
            files.write("images/other.nef", "II*");
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["1 of the photos", "other.nef"] },
    },
];

#[cfg(target_os = "linux")]
fn replace(bytes: &[u8], from: &[u8], to: &[u8]) -> Vec<u8> {
    let at = bytes.windows(from.len()).position(|window| window == from).expect("the name is there");
    [&bytes[..at], to, &bytes[at + from.len()..]].concat()
}
