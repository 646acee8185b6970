//! Splits: which photos are for training and which for testing.

use crate::base::{Files, PHOTOS};
use crate::transforms::{frames, write};
use crate::{Expect, FileCase};
use segwild_scene::Scene;

/// The photos held out.
fn tests(scene: &Scene) -> Vec<&str> {
    scene.views.iter().filter(|view| view.test).map(|view| view.name.as_str()).collect()
}

fn first_two(scene: &Scene) {
    assert_eq!(tests(scene), ["photo00.png", "photo01.png"]);
}

/// Names of photos, each in quotes.
fn quoted(photos: std::ops::Range<u32>, folder: &str) -> String {
    let names: Vec<String> = photos.map(|i| format!("\"{folder}photo{i:02}.png\"")).collect();
    names.join(", ")
}

fn lines(photos: std::ops::Range<u32>) -> String {
    photos.map(|i| format!("photo{i:02}.png\r\n")).collect()
}

/// Gives the photos other names, in the model and on disk.
fn renamed(files: &Files, name: fn(u32) -> String) {
    for i in 0..PHOTOS {
        files.rename(&format!("images/photo{i:02}.png"), &format!("images/{}", name(i)));
    }
    files.remodel(|model| (0..PHOTOS).for_each(|i| model.images[i as usize].name = name(i)));
}

pub const ROWS: &[FileCase] = &[
    FileCase {
        name: "split.json of names, clutter and extra",
        make: |files| {
            files.write(
                "split.json",
                format!("{{\"clutter\": [{}], \"extra\": [{}]}}", quoted(2..10, ""), quoted(0..2, "")),
            );
        },
        settings: &[],
        expect: Expect::Holds { photos: 10, check: first_two },
    },
    FileCase {
        name: "split.json of numbers beside transforms.json, as NeRF On-the-go has it",
        make: |files| {
            files.remove("sparse");
            write(files, "", &frames(0..PHOTOS, "images/"));
            files.write("split.json", "{\"clutter\": [2, 3, 4, 5, 6, 7], \"extra\": [0, 1]}");
        },
        settings: &[],
        expect: Expect::Holds { photos: 8, check: first_two },
    },
    FileCase {
        name: "a split is spoken of",
        make: |files| files.write("split.json", "{\"clutter\": [2, 3, 4, 5, 6, 7], \"extra\": [0, 1]}"),
        settings: &[],
        expect: Expect::Reads {
            photos: 8,
            words: &[
                "split.json is taken: 6 photos train, 2 are held out",
                "4 are left out",
                "not listed in the split",
            ],
        },
    },
    FileCase {
        name: "split.json with a number of no photo",
        make: |files| files.write("split.json", "{\"clutter\": [2, 300], \"extra\": [0, 1]}"),
        settings: &[],
        expect: Expect::Refuses(&["split.json", "clutter", "no photo number 300"]),
    },
    FileCase {
        name: "split.json of something else",
        make: |files| files.write("split.json", "{\"folds\": 5}"),
        settings: &[],
        expect: Expect::Refuses(&["split.json", "it is no split"]),
    },
    FileCase {
        name: "train_list.txt and test_list.txt",
        make: |files| {
            files.write("train_list.txt", lines(2..12));
            files.write("test_list.txt", lines(0..2));
        },
        settings: &[],
        expect: Expect::Holds { photos: 12, check: first_two },
    },
    FileCase {
        name: "test_list.txt alone, names without endings",
        make: |files| files.write("test_list.txt", "\u{feff}photo00\nphoto01\n"),
        settings: &[],
        expect: Expect::Holds { photos: 12, check: first_two },
    },
    FileCase {
        name: "test.txt beside the model, as INRIA has it",
        make: |files| files.write("sparse/0/test.txt", "photo00.png\nphoto01.png\n"),
        settings: &[],
        expect: Expect::Holds { photos: 12, check: first_two },
    },
    FileCase {
        name: "test.txt of something else",
        make: |files| files.write("test.txt", "hello\n"),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["test.txt: it names no photo of this scene"] },
    },
    FileCase {
        name: "two splits",
        make: |files| {
            files.write("test_list.txt", "photo00.png\n");
            files.write("split.json", "{\"train\": [1], \"test\": [0]}");
        },
        settings: &[],
        expect: Expect::Refuses(&["several splits", "split.json", "test_list.txt", "name one"]),
    },
    FileCase {
        name: "a named list out of two splits",
        make: |files| {
            files.write("test_list.txt", "photo00.png\nphoto01.png\n");
            files.write("split.json", "{\"train\": [1], \"test\": [0]}");
        },
        settings: &[("split", "test_list.txt")],
        expect: Expect::Holds { photos: 12, check: first_two },
    },
    FileCase {
        name: "no split is wanted",
        make: |files| files.write("split.json", "{\"train\": [1], \"test\": [0]}"),
        settings: &[("split", "none")],
        expect: Expect::Holds { photos: 12, check: |scene| assert!(tests(scene).is_empty()) },
    },
    FileCase {
        name: "train_filenames and test_filenames in transforms.json",
        make: |files| {
            files.remove("sparse");
            let head = format!(
                "\"train_filenames\": [{}], \"val_filenames\": [{}], \"test_filenames\": [{}],",
                quoted(3..12, "images/"),
                quoted(2..3, "images/"),
                quoted(0..2, "./images/")
            );
            write(files, &head, &frames(0..PHOTOS, "images/"));
        },
        settings: &[],
        expect: Expect::Holds { photos: 11, check: first_two },
    },
    FileCase {
        name: "val_filenames where nothing else is for testing",
        make: |files| {
            files.remove("sparse");
            let head = format!(
                "\"train_filenames\": [{}], \"val_filenames\": [{}],",
                quoted(2..12, "images/"),
                quoted(0..2, "images/")
            );
            write(files, &head, &frames(0..PHOTOS, "images/"));
        },
        settings: &[],
        expect: Expect::Holds { photos: 12, check: first_two },
    },
    FileCase {
        name: "Blender's transforms_train, _val and _test",
        make: |files| {
            files.remove("sparse");
            for (part, photos) in [("train", 3..12), ("val", 2..3), ("test", 0..2)] {
                for i in photos.clone() {
                    files.rename(&format!("images/photo{i:02}.png"), &format!("{part}/photo{i:02}.png"));
                }
                let frames = frames(photos, &format!("./{part}/")).replace(".png\"", "\"");
                let angle = 2.0 * (24.0f64 / 50.0).atan();
                files.write(
                    &format!("transforms_{part}.json"),
                    format!("{{\"camera_angle_x\": {angle}, \"frames\": [{frames}]}}"),
                );
            }
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 11,
            check: |scene| {
                assert_eq!(tests(scene), ["test/photo00.png", "test/photo01.png"]);
                assert!(
                    scene
                        .skipped
                        .iter()
                        .any(|s| s.name == "val/photo02.png" && s.reason.contains("validation"))
                );
            },
        },
    },
    FileCase {
        name: "RobustNeRF's names",
        make: |files| {
            let name = |i: u32| match i {
                0 | 1 => format!("2extra{i:03}.png"),
                2 => format!("0clean{i:03}.png"),
                _ => format!("1clutter{i:03}.png"),
            };
            for i in 0..PHOTOS {
                files.rename(&format!("images/photo{i:02}.png"), &format!("images/{}", name(i)));
            }
            files.remodel(|model| (0..PHOTOS).for_each(|i| model.images[i as usize].name = name(i)));
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 11,
            check: |scene| assert_eq!(tests(scene), ["2extra000.png", "2extra001.png"]),
        },
    },
    FileCase {
        name: "RobustNeRF's names, and one photo that is named otherwise",
        make: |files| {
            renamed(files, |i| match i {
                0 | 1 => format!("2extra{i:03}.png"),
                2 => "door.png".into(),
                _ => format!("1clutter{i:03}.png"),
            });
        },
        settings: &[],
        expect: Expect::Reads {
            photos: 12,
            words: &["9 `clutter`, 2 `extra`, 0 `clean`", "door.png is called neither", "all photos train"],
        },
    },
    FileCase {
        name: "RobustNeRF's names, clutter and clean alone",
        make: |files| renamed(files, |i| format!("{}{i:03}.png", if i < 2 { "0clean" } else { "1clutter" })),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["none is called `extra`", "all photos train"] },
    },
    FileCase {
        name: "RobustNeRF's names, one that is named otherwise, and a list",
        make: |files| {
            renamed(files, |i| match i {
                0 | 1 => format!("photo{i:02}.png"),
                2 => "extra.png".into(),
                _ => format!("1clutter{i:03}.png"),
            });
            files.write("test_list.txt", "photo00.png\nphoto01.png\n");
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| {
                first_two(scene);
                assert!(scene.notes.iter().all(|note| !note.contains("RobustNeRF")), "{:?}", scene.notes);
            },
        },
    },
    FileCase {
        name: "a .tsv of something else",
        make: |files| files.write("measurements.tsv", "time\tvalue\n1\t2\n"),
        settings: &[],
        expect: Expect::Reads {
            photos: 12,
            words: &["measurements.tsv", "no column `filename`", "--split none"],
        },
    },
    FileCase {
        name: "an empty .tsv beside a split",
        make: |files| {
            files.write("a.tsv", "");
            let row = |i: u32| format!("photo{i:02}.png\t{i}\t{}\tx\n", if i < 2 { "test" } else { "train" });
            let rows: String = (0..PHOTOS).map(row).collect();
            files.write("b.tsv", format!("filename\tid\tsplit\tdataset\n{rows}"));
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| {
                first_two(scene);
                assert!(scene.notes.iter().any(|note| note.contains("a.tsv: the file is empty")));
            },
        },
    },
    FileCase {
        name: "a .tsv of another scene's photos",
        make: |files| files.write("x.tsv", "filename\tid\tsplit\tdataset\nother.jpg\t1\ttrain\tx\n"),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["x.tsv: it names no photo of this scene"] },
    },
    FileCase {
        name: "a .tsv with a byte order mark and Latin-1",
        make: |files: &Files| {
            let mut bytes =
                b"\xef\xbb\xbffilename\tid\tsplit\tdataset\r\nStra\xdfe.jpg\t9\ttrain\tx\r\n".to_vec();
            for i in 0..PHOTOS {
                let part = if i < 2 { "test" } else { "train" };
                bytes.extend(format!("photo{i:02}.png\t{i}\t{part}\tx\r\n").as_bytes());
            }
            files.write("x.tsv", bytes);
        },
        settings: &[],
        expect: Expect::Holds { photos: 12, check: first_two },
    },
    FileCase {
        name: "a list of the photos of one camera, where another camera's have the same last parts",
        make: |files| {
            let name = |i: u32| format!("cam{}/{:02}.png", i / 6, i % 6);
            for i in 0..PHOTOS {
                files.rename(&format!("images/photo{i:02}.png"), &format!("images/{}", name(i)));
            }
            files.remodel(|model| (0..PHOTOS).for_each(|i| model.images[i as usize].name = name(i)));
            files.write("test_list.txt", "cam0/03.png\ncam1/04\n");
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| assert_eq!(tests(scene), ["cam0/03.png", "cam1/04.png"]),
        },
    },
    FileCase {
        name: "split.json of numbers, where two cameras' photos have the same last parts",
        make: |files| {
            let name = |i: u32| format!("cam{}/{:02}.png", i / 6, i % 6);
            for i in 0..PHOTOS {
                files.rename(&format!("images/photo{i:02}.png"), &format!("images/{}", name(i)));
            }
            files.remodel(|model| (0..PHOTOS).for_each(|i| model.images[i as usize].name = name(i)));
            files.write("split.json", "{\"test\": [0, 3]}");
        },
        settings: &[],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| assert_eq!(tests(scene), ["cam0/00.png", "cam1/01.png"]),
        },
    },
];
