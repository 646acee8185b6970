//! Photos and masks, by file format.

use crate::seeds::{SIZE, encoded, photo, scene_for};
use crate::yard::put;
use crate::{FuzzTarget, seal};
use image::{DynamicImage, ImageFormat};
use segwild_scene::settings::Group;
use segwild_scene::{Mask, Scene, SceneSettings};
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

/// The scene of a target, made at its first input.
fn scene(target: &'static str) -> PathBuf {
    static MADE: Mutex<Vec<&str>> = Mutex::new(Vec::new());
    let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
    if !made.contains(&target) {
        made.push(target);
        return scene_for(target, "bin");
    }
    crate::yard::folder(target)
}

/// Megapixels that a photo may have here. Some formats hold pixels of one colour in no bytes at all, so only this bounds what
/// decoding takes.
const MEGAPIXELS: &str = "4";

/// As a photo of a scene, whatever its name ends in: shrunk, and whole.
fn read(target: &'static str, bytes: &[u8]) {
    let scene = scene(target);
    put(&scene.join("images/photo0.png"), bytes);
    if let Ok(scene) = Scene::open(&scene, &bounded()) {
        for view in scene.views.iter().filter(|view| view.name == "photo0.png") {
            let _ = view.load(16);
            let _ = view.load(u32::MAX);
        }
    }
}

fn bounded() -> SceneSettings {
    let mut settings = SceneSettings::default();
    settings.set("max_megapixels", MEGAPIXELS).unwrap_or_else(|e| panic!("{e}"));
    settings
}

fn forms() -> [DynamicImage; 4] {
    let photo = photo(0);
    [photo.to_rgba8().into(), photo.to_luma8().into(), photo.to_rgb16().into(), photo]
}

/// The photo in each of its forms that the format has.
fn seeds(format: ImageFormat) -> Vec<Vec<u8>> {
    let in_form = |photo: DynamicImage| {
        let mut bytes = std::io::Cursor::new(Vec::new());
        photo.write_to(&mut bytes, format).ok().map(|()| bytes.into_inner())
    };
    forms().into_iter().filter_map(in_form).collect()
}

macro_rules! photo_target {
    ($name:ident, $target:literal, $format:expr, $seal:expr, $words:expr) => {
        pub(super) const $name: FuzzTarget = FuzzTarget {
            name: $target,
            seeds: || seeds($format),
            words: $words,
            seal: $seal,
            read: |bytes| read($target, bytes),
        };
    };
}

photo_target!(
    PNG,
    "photo_png",
    ImageFormat::Png,
    seal::png,
    &["IHDR", "PLTE", "IDAT", "iCCP", "eXIf", "tRNS", "acTL", "IEND", "zTXt"]
);
photo_target!(
    JPEG,
    "photo_jpeg",
    ImageFormat::Jpeg,
    seal::nothing,
    &["Exif\0\0", "JFIF\0", "Adobe", "ICC_PROFILE\0"]
);
photo_target!(
    WEBP,
    "photo_webp",
    ImageFormat::WebP,
    seal::nothing,
    &["RIFF", "WEBP", "VP8 ", "VP8L", "VP8X", "ALPH", "ANIM", "ANMF", "ICCP", "EXIF"]
);
photo_target!(TIFF, "photo_tiff", ImageFormat::Tiff, seal::nothing, &["II*\0", "MM\0*"]);
photo_target!(BMP, "photo_bmp", ImageFormat::Bmp, seal::nothing, &["BM"]);

pub(super) const MASK: FuzzTarget = FuzzTarget {
    name: "mask_png",
    seeds: || {
        let white = |x: u32, y: u32| image::Luma([if x > y { 255u8 } else { 0 }]);
        let grey: DynamicImage = image::GrayImage::from_fn(SIZE.0, SIZE.1, white).into();
        let ones: DynamicImage =
            image::GrayImage::from_fn(SIZE.0, SIZE.1, |x, y| image::Luma([u8::from(x > y)])).into();
        [grey.to_rgba8().into(), grey, ones].map(|mask| encoded(&mask, ImageFormat::Png)).to_vec()
    },
    words: &["IHDR", "PLTE", "IDAT", "tRNS", "IEND"],
    seal: seal::png,
    read: |bytes| {
        let scene = scene("mask_png");
        let masks = crate::yard::folder("mask_png/ignored");
        put(&masks.join("photo0.png"), bytes);
        let _ = Mask::read_png(&masks.join("photo0.png"));
        let mut settings = bounded();
        settings.set("ignore", &masks.to_string_lossy()).unwrap_or_else(|e| panic!("{e}"));
        if let Ok(scene) = Scene::open(&scene, &settings) {
            let _ = scene.views.first().map(|view| view.load(16));
        }
    },
};
