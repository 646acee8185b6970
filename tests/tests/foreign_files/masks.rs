//! Masks of other programs: what their files are called, what black and white mean in them.

use crate::base::{Files, PHOTOS, SIZE};
use crate::{Expect, FileCase};
use segwild_scene::{Image, Mask, Scene};

/// A third of the photo, on its left.
fn left() -> Mask {
    Mask::from_fn(SIZE.0 as u32, SIZE.1 as u32, |x, _| x < 16)
}

/// Writes a mask for every photo, white on the left third.
fn masks(files: &Files, name: impl Fn(u32) -> String, mask: &Mask) {
    for i in 0..PHOTOS {
        mask.write_png(&files.path(&name(i))).expect("a mask is written");
    }
}

/// Writes a grey image of these two values.
fn two_values(files: &Files, name: &str, out: f32, into: f32) {
    let mut image = Image::zeros(SIZE.0, SIZE.1, 1);
    for (i, value) in image.data.iter_mut().enumerate() {
        *value = if left().index(i) { into } else { out };
    }
    image.write_png(&files.path(name)).expect("a mask is written");
}

fn valid(scene: &Scene, view: usize) -> Option<Mask> {
    scene.views[view].load(SIZE.0 as u32).expect("the photo loads").valid
}

fn only_left(scene: &Scene) {
    assert!((0..scene.views.len()).all(|i| valid(scene, i) == Some(left())));
}

fn all_but_left(scene: &Scene) {
    assert!((0..scene.views.len()).all(|i| valid(scene, i) == Some(left().not())));
}

pub const ROWS: &[FileCase] = &[
    FileCase {
        name: "masks/NAME.png.png beside the photos, white is kept, as COLMAP writes them",
        make: |files| masks(files, |i| format!("masks/photo{i:02}.png.png"), &left()),
        settings: &[],
        expect: Expect::Holds { photos: 12, check: only_left },
    },
    FileCase {
        name: "a masks folder is spoken of",
        make: |files| masks(files, |i| format!("masks/photo{i:02}.png"), &left().not()),
        settings: &[],
        expect: Expect::Reads {
            photos: 12,
            words: &[
                "12 of 12 photos have a mask",
                "white in it is kept",
                "`--keep-masks none`",
                "`--ignore",
            ],
        },
    },
    FileCase {
        name: "masks that hide most of every photo may be meant the other way",
        make: |files| masks(files, |i| format!("masks/photo{i:02}.png"), &left()),
        settings: &[],
        expect: Expect::Reads {
            photos: 12,
            words: &["hide more than half of nearly every photo", "`--ignore"],
        },
    },
    FileCase {
        name: "a masks folder that is not wanted",
        make: |files| masks(files, |i| format!("masks/photo{i:02}.png"), &left()),
        settings: &[("keep_masks", "none")],
        expect: Expect::Holds { photos: 12, check: |scene| assert_eq!(valid(scene, 0), None) },
    },
    FileCase {
        name: "a masks folder of things to ignore",
        make: |files| masks(files, |i| format!("masks/photo{i:02}.png"), &left()),
        settings: &[("ignore", "masks")],
        expect: Expect::Holds { photos: 12, check: all_but_left },
    },
    FileCase {
        name: "a masks folder of other photos",
        make: |files| left().write_png(&files.path("masks/other.png")).expect("written"),
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["none of its files is named after a photo"] },
    },
    FileCase {
        name: "a masks folder of images that are no masks",
        make: |files| {
            for i in 0..PHOTOS {
                crate::base::test_image()
                    .write_png(&files.path(&format!("masks/photo{i:02}.png")))
                    .expect("written");
            }
        },
        settings: &[],
        expect: Expect::Reads { photos: 12, words: &["are not used", "not a mask of two values"] },
    },
    FileCase {
        name: "masks of 0 and 1",
        make: |files| {
            for i in 0..PHOTOS {
                two_values(files, &format!("ignored/photo{i:02}.png"), 0.0, 1.0 / 255.0);
            }
        },
        settings: &[("ignore", "ignored")],
        expect: Expect::Holds { photos: 12, check: all_but_left },
    },
    FileCase {
        name: "masks with endings in capitals",
        make: |files| {
            for i in 0..PHOTOS {
                left().write_png(&files.path("ignored/x.png")).expect("written");
                files.rename("ignored/x.png", &format!("ignored/PHOTO{i:02}.PNG"));
            }
        },
        settings: &[("ignore", "ignored")],
        expect: Expect::Holds { photos: 12, check: all_but_left },
    },
    FileCase {
        name: "two masks of one photo",
        make: |files| {
            for name in ["photo03.png", "photo03.png.png", "photo04.png"] {
                left().write_png(&files.path(&format!("ignored/{name}"))).expect("written");
            }
        },
        settings: &[("ignore", "ignored")],
        expect: Expect::Reads {
            photos: 11,
            words: &["photo03.png.png", "may both be the mask of photo03.png"],
        },
    },
    FileCase {
        name: "one mask and two photos that differ in their endings alone",
        make: |files| {
            files.rename("images/photo04.png", "images/photo03.jpg");
            files.remodel(|model| model.images[4].name = "photo03.jpg".into());
            for name in ["photo03.png", "photo03.jpg.png", "photo05.png"] {
                left().write_png(&files.path(&format!("ignored/{name}"))).expect("written");
            }
        },
        settings: &[("ignore", "ignored")],
        expect: Expect::Reads {
            photos: 11,
            words: &["differs in its ending alone", "name it photo03.png.png"],
        },
    },
];
