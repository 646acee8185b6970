//! Photos: formats, sizes, damage.

use crate::base::{Files, test_image};
use crate::{Expect, FileCase};
use image::{DynamicImage, ImageFormat, RgbImage, Rgba, RgbaImage};
use segwild_scene::colmap::CameraModel;
use std::io::Cursor;

/// The photo that rows change.
const ONE: &str = "images/photo03.png";

/// The good photo.
fn photo() -> RgbImage {
    let from = test_image();
    RgbImage::from_fn(from.width as u32, from.height as u32, |x, y| {
        let value = |c: usize| (from.at(c, x as usize, y as usize) * 255.0) as u8;
        image::Rgb([value(0), value(1), value(2)])
    })
}

fn encoded(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, format).expect("it is encoded");
    bytes.into_inner()
}

fn jpeg() -> Vec<u8> {
    let mut bytes = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 92);
    photo().write_with_encoder(encoder).expect("it is encoded");
    bytes
}

/// Every photo in a format, under the names that the model has: what a file is, its content says.
fn all(files: &Files, format: ImageFormat) {
    let bytes = encoded(&photo().into(), format);
    for image in &files.model.images {
        files.write(&format!("images/{}", image.name), &bytes);
    }
}

/// The camera with a little distortion.
fn distorted(files: &Files) {
    files.remodel(|model| {
        let camera = &mut model.cameras[0];
        camera.model = CameraModel::OpenCv;
        camera.params.extend([-0.05, 0.01, 0.0, 0.0]);
    });
}

/// A JPEG with an EXIF segment: an orientation, and the size that the camera wrote.
fn with_exif(jpeg: &[u8], orientation: u8, size: (u8, u8)) -> Vec<u8> {
    let entry = |tag: u16, kind: u16, value: u32| {
        [&tag.to_le_bytes()[..], &kind.to_le_bytes(), &1u32.to_le_bytes(), &value.to_le_bytes()].concat()
    };
    let exif = [
        &b"Exif\0\0II*\0\x08\0\0\0\x02\0"[..],
        &entry(0x0112, 3, orientation.into()),
        &entry(0x8769, 4, 38),
        &[0; 4],
        &[2, 0],
        &entry(0xa002, 4, size.0.into()),
        &entry(0xa003, 4, size.1.into()),
        &[0; 4],
    ]
    .concat();
    let length = (exif.len() as u16 + 2).to_be_bytes();
    [&jpeg[..2], &[0xff, 0xe1], &length, &exif, &jpeg[2..]].concat()
}

/// A JPEG whose frame claims another size.
fn claiming(mut jpeg: Vec<u8>, width: u16, height: u16) -> Vec<u8> {
    let at = jpeg.windows(2).position(|w| w == [0xff, 0xc0]).expect("a frame");
    jpeg[at + 5..at + 7].copy_from_slice(&height.to_be_bytes());
    jpeg[at + 7..at + 9].copy_from_slice(&width.to_be_bytes());
    jpeg
}

/// A PNG whose head says that it is of so many pixels.
fn png_claiming(width: u32, height: u32) -> Vec<u8> {
    let mut png = encoded(&photo().into(), ImageFormat::Png);
    png[16..20].copy_from_slice(&width.to_be_bytes());
    png[20..24].copy_from_slice(&height.to_be_bytes());
    let bit = |crc: u32, _| if crc & 1 == 1 { (crc >> 1) ^ 0xedb8_8320 } else { crc >> 1 };
    let crc = !png[12..29].iter().fold(!0, |crc, &byte| (0..8).fold(crc ^ u32::from(byte), bit));
    png[29..33].copy_from_slice(&crc.to_be_bytes());
    png
}

/// A TIFF whose first directory has an entry with so many values.
fn tiff_claiming(values: u32) -> Vec<u8> {
    let mut tiff = encoded(&photo().into(), ImageFormat::Tiff);
    let at = u32::from_le_bytes([tiff[4], tiff[5], tiff[6], tiff[7]]) as usize;
    tiff[at + 6..at + 10].copy_from_slice(&values.to_le_bytes());
    tiff
}

/// A BMP whose head says that it is of so many pixels.
fn bmp_claiming(width: u32, height: u32) -> Vec<u8> {
    let mut bmp = encoded(&photo().into(), ImageFormat::Bmp);
    bmp[18..22].copy_from_slice(&width.to_le_bytes());
    bmp[22..26].copy_from_slice(&height.to_le_bytes());
    bmp
}

/// A photo that is seen through a hole of this shape.
fn through(opaque: impl Fn(u32, u32) -> bool) -> DynamicImage {
    let photo = photo();
    let pixel = |x: u32, y: u32| {
        let [r, g, b] = photo.get_pixel(x, y).0;
        Rgba([r, g, b, if opaque(x, y) { 255 } else { 0 }])
    };
    RgbaImage::from_fn(photo.width(), photo.height(), pixel).into()
}

/// A disc in the middle, a little larger in each photo.
fn cut_outs(files: &Files) {
    for (i, image) in files.model.images.iter().enumerate() {
        let reach = 36 + 12 * i as i32;
        let disc = through(|x, y| (x as i32 - 24).pow(2) + (y as i32 - 18).pow(2) < reach);
        files.write(&format!("images/{}", image.name), encoded(&disc, ImageFormat::Png));
    }
}

/// A mask of 1.08 megapixels.
fn large_mask(files: &Files, name: &str) {
    let mask = segwild_scene::Mask::from_fn(1_200, 900, |x, _| x < 300);
    mask.write_png(&files.path(name)).expect("a mask is written");
}

fn foreign(files: &Files, start: &[u8]) {
    files.write(ONE, [start, &[0; 64]].concat());
}

/// Renames a photo in the model and on disk.
fn renamed(files: &Files, to: &str) {
    files.remodel(|model| model.images[3].name = to.into());
    files.rename(ONE, &format!("images/{to}"));
}

const fn left_out(words: &'static [&'static str]) -> Expect {
    Expect::Reads { photos: 11, words }
}

const fn used(words: &'static [&'static str]) -> Expect {
    Expect::Reads { photos: 12, words }
}

const fn row(name: &'static str, make: fn(&Files), expect: Expect) -> FileCase {
    FileCase { name, make, settings: &[], expect }
}

pub const ROWS: &[FileCase] = &[
    row(
        "photo cut short",
        |files| {
            let bytes = std::fs::read(files.path(ONE)).expect("the photo is there");
            files.write(ONE, &bytes[..20]);
        },
        left_out(&["photo03.png"]),
    ),
    row(
        "PNG cut in its data",
        |files| {
            let bytes = std::fs::read(files.path(ONE)).expect("the photo is there");
            files.write(ONE, &bytes[..bytes.len() * 2 / 3]);
        },
        left_out(&["photo03.png", "does not decode"]),
    ),
    row(
        "PNG with a flipped bit",
        |files| {
            let mut bytes = std::fs::read(files.path(ONE)).expect("the photo is there");
            let at = bytes.len() / 2;
            bytes[at] ^= 8;
            files.write(ONE, bytes);
        },
        left_out(&["photo03.png", "does not decode"]),
    ),
    row("empty file", |files| files.write(ONE, b""), left_out(&["photo03.png", "the file is empty"])),
    row(
        "text instead of a photo",
        |files| files.write(ONE, b"404: Not Found"),
        left_out(&["photo03.png", "neither a JPEG nor a PNG"]),
    ),
    row(
        "folder instead of a photo",
        |files| {
            files.remove(ONE);
            std::fs::create_dir(files.path(ONE)).expect("a folder");
        },
        left_out(&["photo03.png", "a folder, not a file"]),
    ),
    row(
        "pipe instead of a photo",
        |files| {
            files.remove(ONE);
            let made = std::process::Command::new("mkfifo").arg(files.path(ONE)).status().expect("it runs");
            assert!(made.success());
        },
        left_out(&["photo03.png", "a pipe"]),
    ),
    row(
        "device instead of a photo",
        |files| {
            files.remove(ONE);
            std::os::unix::fs::symlink("/dev/zero", files.path(ONE)).expect("a link");
        },
        left_out(&["photo03.png", "a device"]),
    ),
    row("all WEBP", |files| all(files, ImageFormat::WebP), used(&[])),
    row("all TIFF", |files| all(files, ImageFormat::Tiff), used(&[])),
    row("all BMP", |files| all(files, ImageFormat::Bmp), used(&[])),
    row("all JPEG under names of PNG", |files| all(files, ImageFormat::Jpeg), used(&[])),
    row(
        "WEBP of a distorted lens",
        |files| {
            distorted(files);
            all(files, ImageFormat::WebP);
        },
        used(&[]),
    ),
    row(
        "TIFF of a distorted lens",
        |files| {
            distorted(files);
            all(files, ImageFormat::Tiff);
        },
        used(&[]),
    ),
    row(
        "BMP of a distorted lens",
        |files| {
            distorted(files);
            all(files, ImageFormat::Bmp);
        },
        used(&[]),
    ),
    row(
        "palettes, one bit, interlaced",
        |files| {
            files.write("images/photo00.png", include_bytes!("files/palette.png"));
            files.write("images/photo01.png", include_bytes!("files/one_bit.png"));
            files.write("images/photo02.png", include_bytes!("files/interlaced.png"));
            files.write("images/photo03.png", include_bytes!("files/palette.bmp"));
            files.write("images/photo04.png", include_bytes!("files/one_bit.bmp"));
            files.write("images/photo05.png", include_bytes!("files/one_bit.tif"));
            files.write("images/photo06.png", include_bytes!("files/palette_alpha.png"));
        },
        Expect::Holds { photos: 12, check: same_image },
    ),
    row(
        "TIFF as other programs pack it",
        |files| {
            files.write("images/photo00.png", include_bytes!("files/lzw.tif"));
            files.write("images/photo01.png", include_bytes!("files/deflate.tif"));
            files.write("images/photo02.png", include_bytes!("files/cmyk.tif"));
        },
        Expect::Holds { photos: 12, check: same_image },
    ),
    row(
        "JPEG of print, grey, progressive, of two lenses; WEBP with losses, moving",
        |files| {
            files.write("images/photo00.png", include_bytes!("files/cmyk.jpg"));
            files.write("images/photo01.png", include_bytes!("files/grey.jpg"));
            files.write("images/photo02.png", include_bytes!("files/progressive.jpg"));
            files.write("images/photo03.png", include_bytes!("files/multi.mpo"));
            files.write("images/photo04.png", include_bytes!("files/lossy.webp"));
            files.write("images/photo05.png", include_bytes!("files/animated.webp"));
        },
        Expect::Holds { photos: 12, check: same_image },
    ),
    row(
        "AVIF of a real encoder",
        |files| files.write(ONE, include_bytes!("files/real.avif")),
        left_out(&["photo03.png", "AVIF", "avifdec"]),
    ),
    row(
        "TIFF and PNG of 16 bits, grey, grey with alpha",
        |files| {
            let photo = DynamicImage::from(photo());
            let kinds = [
                encoded(&photo.to_rgb16().into(), ImageFormat::Tiff),
                encoded(&photo.to_luma16().into(), ImageFormat::Tiff),
                encoded(&photo.to_luma8().into(), ImageFormat::Tiff),
                encoded(&photo.to_rgba8().into(), ImageFormat::Tiff),
                encoded(&photo.to_rgb16().into(), ImageFormat::Png),
                encoded(&photo.to_luma16().into(), ImageFormat::Png),
                encoded(&photo.to_luma_alpha8().into(), ImageFormat::Png),
                encoded(&photo.to_luma8().into(), ImageFormat::Jpeg),
                encoded(&photo.to_rgba8().into(), ImageFormat::WebP),
            ];
            for (bytes, image) in kinds.iter().zip(&files.model.images) {
                files.write(&format!("images/{}", image.name), bytes);
            }
        },
        used(&[]),
    ),
    row(
        "JPEG that claims 65,535 x 65,535 pixels",
        |files| files.write(ONE, claiming(jpeg(), 65_535, 65_535)),
        left_out(&["photo03.png", "65535 x 65535", "--max-megapixels allows 200"]),
    ),
    row(
        "PNG that claims 196 megapixels in a few bytes",
        |files| files.write(ONE, png_claiming(14_000, 14_000)),
        left_out(&["photo03.png", "14000 x 14000", "bytes cannot hold"]),
    ),
    row(
        "TIFF with a tag that claims eight million values",
        |files| files.write(ONE, tiff_claiming(8_388_608)),
        left_out(&["photo03.png", "claims 8388608 values"]),
    ),
    row(
        "BMP that claims 196 megapixels in a few bytes",
        |files| files.write(ONE, bmp_claiming(14_000, 14_000)),
        left_out(&["photo03.png", "14000 x 14000", "bytes cannot hold"]),
    ),
    row(
        "JPEG without an end marker",
        |files| files.write(ONE, &jpeg()[..jpeg().len() - 2]),
        used(&["photo03.png", "no end marker"]),
    ),
    row(
        "JPEG cut in half",
        |files| files.write(ONE, &jpeg()[..jpeg().len() * 3 / 4]),
        left_out(&["photo03.png", "cut short", "%"]),
    ),
    row(
        "JPEG with a trailer",
        |files| files.write(ONE, [jpeg(), b"SEFH trailer of a phone".repeat(100)].concat()),
        used(&[]),
    ),
    row("JPEG with a second image after it", |files| files.write(ONE, [jpeg(), jpeg()].concat()), used(&[])),
    row(
        "JPEG with a hole in its data",
        |files| {
            let mut bytes = jpeg();
            let (half, end) = (bytes.len() / 2, bytes.len() - 40);
            bytes[half + 100..end].fill(0);
            files.write(ONE, bytes);
        },
        left_out(&["photo03.png", "its data are damaged"]),
    ),
    row(
        "EXIF data that are noise",
        |files| {
            let noise: Vec<u8> = (0..5000u32).map(|i| (i * i % 251) as u8).collect();
            let exif = [&b"Exif\0\0II*\0\x08\0\0\0\xff\xff"[..], &noise].concat();
            let length = (exif.len() as u16 + 2).to_be_bytes();
            let good = jpeg();
            files.write(ONE, [&good[..2], &[0xff, 0xe1], &length, &exif, &good[2..]].concat());
        },
        used(&[]),
    ),
    row(
        "EXIF orientation, stored as the camera says",
        |files| files.write(ONE, with_exif(&jpeg(), 6, (48, 36))),
        used(&[]),
    ),
    row(
        "EXIF orientation, the camera for the turned photo",
        |files| {
            let turned = DynamicImage::from(photo()).rotate270();
            files.write(ONE, with_exif(&encoded(&turned, ImageFormat::Jpeg), 6, (36, 48)));
        },
        used(&[]),
    ),
    row(
        "turned by another program, its EXIF data left as they were",
        |files| {
            let turned = DynamicImage::from(photo()).rotate90();
            files.write(ONE, with_exif(&encoded(&turned, ImageFormat::Jpeg), 6, (48, 36)));
        },
        left_out(&["photo03.png", "some program has turned its pixels"]),
    ),
    row(
        "turned by another program, without EXIF data",
        |files| files.write(ONE, encoded(&DynamicImage::from(photo()).rotate90(), ImageFormat::Jpeg)),
        left_out(&["photo03.png", "36 x 48", "48 x 36"]),
    ),
    row(
        "AVIF",
        |files| foreign(files, b"\0\0\0\x1cftypavif\0\0\0\0avifmif1"),
        left_out(&["photo03.png", "AVIF", "avifdec"]),
    ),
    row(
        "HEIC",
        |files| foreign(files, b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"),
        left_out(&["photo03.png", "HEIC", "heif-convert"]),
    ),
    row(
        "Canon raw of new cameras",
        |files| foreign(files, b"\0\0\0\x18ftypcrx \0\0\0\x01crx isom"),
        left_out(&["photo03.png", "raw", "dcraw"]),
    ),
    row(
        "Canon raw",
        |files| foreign(files, b"II*\0\x10\0\0\0CR\x02\0\0\0\0\0\x01\0\0\x01\x03\0\x01\0\0\0\x10\0\0\0"),
        left_out(&["photo03.png", "raw", "dcraw"]),
    ),
    row(
        "DNG",
        |files| foreign(files, b"II*\0\x08\0\0\0\x01\0\x12\xc6\x01\0\x04\0\0\0\x01\x04\0\0"),
        left_out(&["photo03.png", "raw", "dcraw"]),
    ),
    row(
        "Nikon or Sony raw",
        |files| {
            foreign(
                files,
                b"II*\0\x08\0\0\0\x02\0\xfe\0\x04\0\x01\0\0\0\x01\0\0\0\x0f\x01\x02\0\x06\0\0\0\x30\0\0\0",
            )
        },
        left_out(&["photo03.png", "raw", "dcraw"]),
    ),
    row(
        "Fuji raw",
        |files| foreign(files, b"FUJIFILMCCD-RAW 0201"),
        left_out(&["photo03.png", "raw", "dcraw"]),
    ),
    row(
        "JPEG XL",
        |files| foreign(files, b"\xff\x0a\xfa\x7f"),
        left_out(&["photo03.png", "JPEG XL", "djxl"]),
    ),
    row(
        "JPEG 2000",
        |files| foreign(files, b"\0\0\0\x0cjP  \r\n\x87\n"),
        left_out(&["photo03.png", "JPEG 2000", "magick"]),
    ),
    row("GIF", |files| foreign(files, b"GIF89a"), left_out(&["photo03.png", "GIF", "magick"])),
    row(
        "SVG",
        |files| files.write(ONE, b"<?xml version=\"1.0\"?>\n<svg xmlns=\"http://www.w3.org/2000/svg\"/>"),
        left_out(&["photo03.png", "SVG", "convert"]),
    ),
    row(
        "Photoshop",
        |files| foreign(files, b"8BPS\0\x01"),
        left_out(&["photo03.png", "Photoshop", "magick"]),
    ),
    row(
        "HEIC with its converted copy",
        |files| {
            renamed(files, "photo03.heic");
            files.write("images/photo03.heic", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic");
            files.write("images/photo03.jpg", jpeg());
        },
        used(&["photo03.heic is read from its converted copy", "photo03.jpg"]),
    ),
    row(
        "HEIC under a name of PNG",
        |files| foreign(files, b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"),
        left_out(&["photo03.png", "HEIC", "photo03.png.jpg"]),
    ),
    row(
        "AVIF under a name of JPEG, with the copy that the command makes",
        |files| {
            renamed(files, "photo03.jpg");
            files.write("images/photo03.jpg", include_bytes!("files/real.avif"));
            files.write("images/photo03.jpg.png", encoded(&photo().into(), ImageFormat::Png));
        },
        Expect::Holds {
            photos: 12,
            check: |scene| {
                assert!(scene.notes.iter().any(|note| note.contains("from its converted copy")));
                assert!(scene.notes.iter().all(|note| !note.contains("take no part")), "{:?}", scene.notes);
            },
        },
    ),
    row(
        "HEIC whose name differs from another photo's in its ending alone",
        |files| {
            renamed(files, "photo04.heic");
            files.write("images/photo04.heic", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic");
        },
        left_out(&["photo04.heic", "photo04.heic.jpg"]),
    ),
    row(
        "only the converted copy of a raw photo is there",
        |files| {
            renamed(files, "photo03.CR2");
            files.rename("images/photo03.CR2", "images/photo03.tif");
            files.write("images/photo03.tif", encoded(&photo().into(), ImageFormat::Tiff));
        },
        used(&["photo03.CR2 is read from its converted copy"]),
    ),
    row(
        "a transparent photo among others",
        |files| files.write(ONE, encoded(&through(|_, _| false), ImageFormat::Png)),
        left_out(&["photo03.png", "all of it is transparent"]),
    ),
    FileCase {
        name: "one photo that its mask leaves nothing of",
        make: |files| {
            let white = |name: &str, value: u8| {
                let grey =
                    image::GrayImage::from_fn(48, 36, |x, _| image::Luma([if x > 3 { value } else { 255 }]));
                files.write(&format!("away/{name}"), encoded(&grey.into(), ImageFormat::Png));
            };
            white("photo03.png", 255);
            white("photo04.png", 0);
        },
        settings: &[("ignore", "away")],
        expect: left_out(&["photo03.png", "masks leave nothing of it"]),
    },
    FileCase {
        name: "cut-outs of an object",
        make: cut_outs,
        settings: &[],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| {
                assert!(scene.notes.iter().any(|note| note.contains("cut-outs")), "{:?}", scene.notes);
                for view in &scene.views {
                    let loaded = view.load(48).expect("it loads");
                    let (valid, empty) = (loaded.valid.expect("some"), loaded.empty.expect("some"));
                    assert!(valid == empty.not() && empty.count() > 100, "{}", view.name);
                }
            },
        },
    },
    FileCase {
        name: "cut-outs that are to be left out",
        make: cut_outs,
        settings: &[("alpha", "ignore")],
        expect: Expect::Holds {
            photos: 12,
            check: |scene| assert!(scene.views.iter().all(|v| v.load(48).is_ok_and(|l| l.empty.is_none()))),
        },
    },
    row(
        "passers-by made transparent are no cut-outs",
        |files| {
            for (i, image) in files.model.images.iter().enumerate() {
                let hole = through(|x, y| !(10..20).contains(&(x as usize - i.min(x as usize))) || y < 8);
                files.write(&format!("images/{}", image.name), encoded(&hole, ImageFormat::Png));
            }
        },
        Expect::Holds {
            photos: 12,
            check: |scene| {
                assert!(scene.notes.iter().all(|note| !note.contains("cut-outs")), "{:?}", scene.notes);
                assert!(scene.views.iter().all(|v| v.load(48).is_ok_and(|l| l.empty.is_none())));
            },
        },
    ),
    FileCase {
        name: "a mask to ignore with more megapixels than allowed",
        make: |files| {
            large_mask(files, "ignored/photo03.png");
            large_mask(files, "ignored/photo04.png.png");
        },
        settings: &[("ignore", "ignored"), ("max_megapixels", "1")],
        expect: Expect::Reads {
            photos: 10,
            words: &["photo03.png: its mask", "photo04.png.png", "1200 x 900", "--max-megapixels allows 1"],
        },
    },
    FileCase {
        name: "a mask to keep with more megapixels than allowed",
        make: |files| large_mask(files, "masks/photo03.png"),
        settings: &[("max_megapixels", "1")],
        expect: Expect::Reads { photos: 11, words: &["photo03.png: its mask", "--max-megapixels allows 1"] },
    },
    row(
        "a focal length of a thousandth of a pixel",
        |files| other_camera(files, [1e-3, 1e-3, 24.0, 18.0]),
        left_out(&["photo03.png", "focal length of 0.001"]),
    ),
    row(
        "a focal length of ten million pixels",
        |files| other_camera(files, [1e7, 1e7, 24.0, 18.0]),
        left_out(&["photo03.png", "focal length of 10000000"]),
    ),
    row(
        "a focal length that is a hundred times the others'",
        |files| other_camera(files, [5e3, 5e3, 24.0, 18.0]),
        left_out(&["photo03.png", "where 1.0 is usual here"]),
    ),
    row(
        "a focal length that is no number",
        |files| other_camera(files, [f64::NAN, 50.0, 24.0, 18.0]),
        left_out(&["photo03.png", "NaN"]),
    ),
    row(
        "two focal lengths that cannot be of one lens",
        |files| other_camera(files, [50.0, 2000.0, 24.0, 18.0]),
        left_out(&["photo03.png", "cannot be of one lens"]),
    ),
    row(
        "a principal point far away",
        |files| other_camera(files, [50.0, 50.0, 1e6, 18.0]),
        left_out(&["photo03.png", "principal point"]),
    ),
];

/// Panics where a photo does not show what the good one shows, in brightness at least.
fn same_image(scene: &segwild_scene::Scene) {
    let good = test_image();
    let grey = |image: &segwild_scene::Image, x: usize, y: usize| {
        0.299 * image.at(0, x, y) + 0.587 * image.at(1, x, y) + 0.114 * image.at(2, x, y)
    };
    for view in &scene.views {
        let loaded = view.load(48).expect("it loads").image;
        // Means of 12 x 12 pixels: one bit is dithered.
        for tile in 0..12 {
            let mean = |image: &segwild_scene::Image| {
                let at = |k: usize| grey(image, tile % 4 * 12 + k % 12, tile / 4 * 12 + k / 12);
                (0..144).map(at).sum::<f32>() / 144.0
            };
            let (a, b) = (mean(&good), mean(&loaded));
            assert!((a - b).abs() < 0.08, "{} at {tile}: {b} for {a}", view.name);
        }
    }
}

/// Gives one photo a camera of its own.
fn other_camera(files: &Files, params: [f64; 4]) {
    files.remodel(|model| {
        let mut camera = model.cameras[0].clone();
        (camera.id, camera.params) = (2, params.to_vec());
        model.cameras.push(camera);
        model.images[3].camera_id = 2;
    });
}
