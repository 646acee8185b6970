//! Files of cameras as JSON: nerfstudio, Blender, instant-ngp.

use crate::base::{Files, PHOTOS};
use crate::{Expect, FileCase};
use segwild_scene::Scene;
use segwild_scene::colmap::CameraModel;

/// Frames of the good scene's cameras, the names in this folder.
pub fn frames(photos: std::ops::Range<u32>, folder: &str) -> String {
    let frame = |i: u32| {
        let x = f64::from(i) / f64::from(PHOTOS - 1);
        let pose = format!("[[1,0,0,{x}],[0,-1,0,0],[0,0,-1,0],[0,0,0,1]]");
        format!("{{\"file_path\": \"{folder}photo{i:02}.png\", \"transform_matrix\": {pose}}}")
    };
    photos.map(frame).collect::<Vec<_>>().join(",\n")
}

/// Writes a transforms.json with the good scene's intrinsics.
pub fn write(files: &Files, head: &str, frames: &str) {
    let intrinsics = r#""fl_x": 50, "fl_y": 50, "cx": 24, "cy": 18, "w": 48, "h": 36"#;
    files.write("transforms.json", format!("{{{head} {intrinsics}, \"frames\": [{frames}]}}"));
}

fn only(files: &Files, head: &str, folder: &str) {
    files.remove("sparse");
    write(files, head, &frames(0..PHOTOS, folder));
}

/// Makes it Blender's scene of images with this ending: two for testing, and no ending in the names.
fn blender(files: &Files, ending: &str) {
    files.remove("sparse");
    let angle = 2.0 * (24.0f64 / 50.0).atan();
    for (part, photos) in [("train", 2..PHOTOS), ("test", 0..2)] {
        let frames = frames(photos.clone(), &format!("./{part}/")).replace(".png\"", "\"");
        let text = format!("{{\"camera_angle_x\": {angle}, \"frames\": [{frames}]}}");
        files.write(&format!("transforms_{part}.json"), text);
        for i in photos {
            let from = format!("images/photo{i:02}.png");
            let test_image = image::open(files.path(&from)).expect("a photo").to_rgb8();
            test_image.save(files.path(&format!("{part}/photo{i:02}.{ending}"))).expect("a photo is written");
            files.remove(&from);
        }
    }
}

fn lens(scene: &Scene) -> Option<CameraModel> {
    scene.views[0].photo.lens.as_ref().map(|lens| lens.model())
}

pub const ROWS: &[FileCase] = &[
    FileCase {
        name: "instant-ngp's is_fisheye",
        make: |files| {
            only(
                files,
                r#""is_fisheye": true, "k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": -0.001,"#,
                "images/",
            )
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| assert_eq!(lens(scene), Some(CameraModel::OpenCvFisheye)),
        },
    },
    FileCase {
        name: "FULL_OPENCV in transforms.json",
        make: |files| {
            let head = r#""camera_model": "FULL_OPENCV", "k1": 0.02, "k2": 0.01, "k3": 0.001, "k4": 0.01, "k5": 0.001, "k6": 0.001,
                "p1": 0.001, "p2": -0.001,"#;
            only(files, head, "images/");
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| assert_eq!(lens(scene), Some(CameraModel::FullOpenCv)),
        },
    },
    FileCase {
        name: "distortion_params of nerfstudio",
        make: |files| {
            only(
                files,
                r#""camera_model": "OPENCV", "distortion_params": [0.02, 0.01, 0, 0, 0.001, 0.001],"#,
                "images/",
            )
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| assert_eq!(lens(scene), Some(CameraModel::OpenCv)),
        },
    },
    FileCase {
        name: "panoramas in transforms.json",
        make: |files| only(files, r#""camera_model": "EQUIRECTANGULAR","#, "images/"),
        settings: &[],
        expect: Expect::Refuses(&["EQUIRECTANGULAR", "panorama"]),
    },
    FileCase {
        name: "orthophotos in transforms.json",
        make: |files| only(files, r#""camera_model": "ORTHOPHOTO","#, "images/"),
        settings: &[],
        expect: Expect::Refuses(&["ORTHOPHOTO", "no perspective"]),
    },
    FileCase {
        name: "a lens in transforms.json that cannot be undistorted",
        make: |files| only(files, r#""camera_model": "FISHEYE624","#, "images/"),
        settings: &[],
        expect: Expect::Refuses(&["FISHEYE624", "cannot be undistorted"]),
    },
    FileCase {
        name: "backslashes in file_path",
        make: |files| only(files, "", r"images\\"),
        settings: &[],
        expect: Expect::Holds { photos: 12, check: |scene| assert_eq!(scene.views[0].name, "photo00.png") },
    },
    FileCase {
        name: "file_path of another machine, Windows",
        make: |files| only(files, "", r"C:\\Users\\x\\scene\\images\\"),
        settings: &[],
        expect: Expect::Holds { photos: 12, check: |scene| assert_eq!(scene.views[0].name, "photo00.png") },
    },
    FileCase {
        name: "file_path of another machine, absolute, in another folder",
        make: |files| only(files, "", "/home/other/photos/"),
        settings: &[],
        expect: Expect::Holds { photos: 12, check: |scene| assert_eq!(scene.views[0].name, "photo00.png") },
    },
    FileCase {
        name: "file_path that leads out of the scene",
        make: |files| {
            files.rename("images/photo05.png", "../photo05.png");
            files.remove("sparse");
            let good = frames(0..PHOTOS, "images/");
            write(files, "", &good.replace("images/photo05", "../photo05"));
        },
        settings: &[],
        expect: Expect::Reads { photos: 11, words: &["photo05.png", "lies outside of the scene's folder"] },
    },
    FileCase {
        name: "transforms.json beside colmap/sparse/0, as nerfstudio's ns-process-data leaves them",
        make: |files| {
            files.rename("sparse/0", "colmap/sparse/0");
            write(files, "", &frames(0..PHOTOS, "images/"));
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["transforms.json is read, and not", "colmap/sparse/0"] },
    },
    FileCase {
        name: "transforms.json beside sparse/0",
        make: |files| write(files, "", &frames(0..PHOTOS, "images/")),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["sparse/0 is read, and not", "transforms.json"] },
    },
    FileCase {
        name: "transforms.json with a byte order mark",
        make: |files| {
            only(files, "", "images/");
            let text = std::fs::read(files.path("transforms.json")).expect("it is there");
            files.write("transforms.json", [&b"\xef\xbb\xbf"[..], &text].concat());
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "transforms.json in UTF-16",
        make: |files| {
            only(files, "", "images/");
            let text = std::fs::read(files.path("transforms.json")).expect("it is there");
            files.write("transforms.json", text.into_iter().flat_map(|b| [b, 0]).collect::<Vec<u8>>());
        },
        settings: &[],
        expect: Expect::Refuses(&["transforms.json", "UTF-16"]),
    },
    FileCase {
        name: "frames of two folders of which the same file may be left",
        make: |files| {
            files.remove("sparse");
            let good = frames(0..PHOTOS, "images/");
            let two = good.replace("images/photo05", "images/cam0/photo05");
            write(files, "", &two.replace("images/photo06", "images/cam1/photo05"));
        },
        settings: &[],
        expect: Expect::Reads {
            photos: 10,
            words: &["`photo05.png` may be that of images/cam0/photo05.png or images/cam1/photo05.png"],
        },
    },
    FileCase {
        name: "Blender's scene of photos in BMP",
        make: |files| blender(files, "bmp"),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &[] },
    },
    FileCase {
        name: "depths and normals beside Blender's photos",
        make: |files| {
            blender(files, "png");
            for name in ["photo00_depth_0001.png", "photo00_normal.png", "more.png"] {
                files.photo(&format!("../test/{name}"));
            }
        },
        settings: &[],
        expect: Expect::Reads {
            photos: 12,
            words: &["1 of the photos in", "transforms_train.json + transforms_test.json", "more.png"],
        },
    },
];
