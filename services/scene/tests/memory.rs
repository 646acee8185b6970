//! Measures the memory that decoding images takes: a program of its own with one test, for nothing else may run beside it.

use rayon::prelude::*;
use segwild_scene::colmap::{self, CameraModel, CameraRecord, ImageRecord, Reconstruction};
use segwild_scene::{Image, Mask, Scene, SceneSettings, settings::Group};
use std::path::Path;

/// Bits, the highest first.
#[derive(Default)]
struct BitWriter(Vec<u8>, u32);

impl BitWriter {
    fn put(&mut self, bits: &str) {
        for bit in bits.bytes() {
            if self.1.is_multiple_of(8) {
                self.0.push(0);
            }
            let last = self.0.len() - 1;
            self.0[last] |= u8::from(bit == b'1') << (7 - self.1 % 8);
            self.1 += 1;
        }
    }
}

fn segment(marker: u8, data: &[u8]) -> Vec<u8> {
    [&[0xff, marker][..], &(data.len() as u16 + 2).to_be_bytes(), data].concat()
}

/// A grey-blue JPEG of any size, three components of one sample each, in a few bytes per thousand pixels.
fn jpeg(width: u16, height: u16, progressive: bool) -> Vec<u8> {
    let [w1, w0] = width.to_be_bytes();
    let [h1, h0] = height.to_be_bytes();
    let blocks = usize::from(width).div_ceil(8) * usize::from(height).div_ceil(8);
    // Symbol 0 is the code `0` in both tables: no difference, and the end of the block.
    let table = |class: u8| segment(0xc4, &[&[class, 1][..], &[0; 15], &[0]].concat());
    let scan = |components: &[u8], band: [u8; 3]| {
        let list: Vec<u8> = components.iter().flat_map(|&c| [c, 0]).collect();
        segment(0xda, &[&[components.len() as u8][..], &list, &band].concat())
    };
    let data = |bits: usize| vec![0u8; bits.div_ceil(8)];
    let mut file = vec![0xff, 0xd8];
    file.extend(segment(0xdb, &[&[0][..], &[16; 64]].concat()));
    let sof = [8, h1, h0, w1, w0, 3, 1, 0x11, 0, 2, 0x11, 0, 3, 0x11, 0];
    file.extend(segment(if progressive { 0xc2 } else { 0xc0 }, &sof));
    file.extend(table(0x00));
    file.extend(table(0x10));
    if progressive {
        file.extend(scan(&[1, 2, 3], [0, 0, 0]));
        file.extend(data(3 * blocks));
        for c in 1..4 {
            file.extend(scan(&[c], [1, 63, 0]));
            file.extend(data(blocks));
        }
    } else {
        file.extend(scan(&[1, 2, 3], [0, 63, 0]));
        file.extend(data(6 * blocks));
    }
    file.extend([0xff, 0xd9]);
    file
}

fn crc(bytes: &[u8]) -> u32 {
    let step = |c: u32| (0..8).fold(c, |c, _| if c & 1 == 1 { 0xedb8_8320 ^ (c >> 1) } else { c >> 1 });
    !bytes.iter().fold(u32::MAX, |c, &b| step((c ^ u32::from(b)) & 0xff) ^ (c >> 8))
}

fn chunk(kind: &[u8; 4], data: &[u8]) -> Vec<u8> {
    let named = [&kind[..], data].concat();
    [&(data.len() as u32).to_be_bytes()[..], &named, &crc(&named).to_be_bytes()].concat()
}

/// Zeros, a thousand and more of them to a byte, as zlib packs them.
fn packed_zeros(bytes: usize) -> Vec<u8> {
    // Deflate's bits come the lowest first, its codes the highest first.
    let mut bits = BitWriter::default();
    bits.put("110"); // the last block, of fixed codes
    bits.put("00110000"); // a zero
    for _ in 0..bytes / 258 {
        bits.put("11000101"); // 258 more
        bits.put("00000"); // of the byte before
    }
    bits.put("0000000");
    let turned = bits.0.iter().map(|b| b.reverse_bits());
    [0x78, 0x01].into_iter().chain(turned).chain([0; 4]).collect()
}

fn png(width: u32, height: u32, more: &[u8], data: &[u8]) -> Vec<u8> {
    let head = [&width.to_be_bytes()[..], &height.to_be_bytes(), &[8, 2, 0, 0, 0]].concat();
    let parts = [chunk(b"IHDR", &head), more.to_vec(), chunk(b"IDAT", data), chunk(b"IEND", &[])];
    [b"\x89PNG\r\n\x1a\n".to_vec(), parts.concat()].concat()
}

/// A TIFF of transparent black, packed as zlib does.
fn tiff(width: u32, height: u32) -> Vec<u8> {
    let data = packed_zeros(4 * width as usize * height as usize);
    let entry = |tag: u16, kind: u16, count: u32, value: u32| {
        [&tag.to_le_bytes()[..], &kind.to_le_bytes(), &count.to_le_bytes(), &value.to_le_bytes()].concat()
    };
    let entries = [
        entry(256, 4, 1, width),
        entry(257, 4, 1, height),
        entry(258, 3, 4, 8), // four depths, which lie behind the head
        entry(259, 3, 1, 8), // zlib
        entry(262, 3, 1, 2), // red, green, blue
        entry(273, 4, 1, 1_000),
        entry(277, 3, 1, 4),
        entry(278, 4, 1, height),
        entry(279, 4, 1, data.len() as u32),
        entry(284, 3, 1, 1),
        entry(338, 3, 1, 2), // and alpha
    ];
    let depths = [8, 0, 8, 0, 8, 0, 8, 0];
    let directory = [&(entries.len() as u16).to_le_bytes()[..], &entries.concat(), &[0; 4]].concat();
    let mut file = [b"II*\0\x10\0\0\0", &depths[..], &directory].concat();
    file.resize(1_000, 0);
    file.extend(data);
    file
}

/// A PNG of a disc on a transparent ground, 112 x 84 pixels.
fn disc(i: u32) -> Vec<u8> {
    let within = |x: u32, y: u32| x.abs_diff(56).pow(2) + y.abs_diff(42).pow(2) < 150 + 30 * i;
    let pixel = |x, y| image::Rgba([90, 90, 90, if within(x, y) { 255 } else { 0 }]);
    let mut bytes = std::io::Cursor::new(Vec::new());
    let image_of_file = image::RgbaImage::from_fn(112, 84, pixel);
    image_of_file.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

/// A scene of photos of one size, each with its file.
fn scene(dir: &Path, (width, height): (u64, u64), files: &[(&str, Vec<u8>)]) {
    let camera = CameraRecord {
        id: 1,
        model: CameraModel::Pinhole,
        width,
        height,
        params: vec![width as f64, width as f64, width as f64 / 2.0, height as f64 / 2.0],
    };
    let image = |(i, (name, _)): (usize, &(&str, Vec<u8>))| ImageRecord {
        id: i as u32 + 1,
        rotation: [1.0, 0.0, 0.0, 0.0],
        translation: [i as f64, 0.0, 0.0],
        camera_id: 1,
        name: (*name).to_owned(),
        keypoints: vec![],
    };
    let images = files.iter().enumerate().map(image).collect();
    let model = Reconstruction { cameras: vec![camera], unknown_cameras: vec![], images, points: vec![] };
    colmap::write(&dir.join("sparse/0"), &model).unwrap();
    std::fs::create_dir_all(dir.join("images")).unwrap();
    for (name, bytes) in files {
        std::fs::write(dir.join("images").join(name), bytes).unwrap();
    }
}

/// MiB that the process has held at most since the start, or the last [`forget`].
fn peak() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|l| l.starts_with("VmHWM")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() / 1024.0
}

/// Makes the peak what is held now.
fn forget() -> f64 {
    std::fs::write("/proc/self/clear_refs", "5").unwrap();
    peak()
}

/// MiB that some work adds to what was held before it.
fn taken(work: impl FnOnce()) -> f64 {
    let before = forget();
    work();
    peak() - before
}

#[test]
#[cfg(target_os = "linux")]
fn files_that_claim_much_and_photos_that_are_large_take_little_memory() {
    let dir = tempfile::tempdir().unwrap();
    let bombs = dir.path().join("bombs");
    let zeros = packed_zeros(400 << 20);
    let iccp = chunk(b"iCCP", &[b"x\0\0", &zeros[..]].concat());
    let ztxt = chunk(b"zTXt", &[b"x\0\0", &zeros[..]].concat());
    let itxt = chunk(b"iTXt", &[b"XML:com.adobe.xmp\0\x01\0\0\0", &zeros[..]].concat());
    let exif = chunk(b"eXIf", &vec![0x49; 40 << 20]);
    let row = [&[0x78, 0x01, 0x01, 4, 0, 0xfb, 0xff, 0, 90, 90, 90][..], &[0; 4]].concat();
    let files = [
        ("a_claim.jpg", jpeg_head(65_535, 65_535)),
        ("b_claim.png", png(60_000, 60_000, &[], &packed_zeros(1 << 20))),
        ("c_iccp.png", png(1, 1, &iccp, &row)),
        ("d_ztxt.png", png(1, 1, &ztxt, &row)),
        ("e_itxt.png", png(1, 1, &itxt, &row)),
        ("f_exif.png", png(1, 1, &exif, &row)),
        ("g_wide.png", png(199_000_000, 1, &[], &packed_zeros(1 << 20))),
        ("h_tall.jpg", jpeg_head(65_535, 3_000)),
        ("i_good.png", png(1, 1, &[], &row)),
    ];
    scene(&bombs, (1, 1), &files);
    drop((zeros, iccp, ztxt, itxt, exif, files));
    let mut opened = None;
    let mib = taken(|| {
        let scene = Scene::open(&bombs, &SceneSettings::default()).unwrap();
        scene.views.par_iter().for_each(|view| drop(view.examine(640)));
        opened = Some(scene);
    });
    assert!(mib < 60.0, "opening and examining the bombs takes {mib:.0} MiB");
    let opened = opened.unwrap();
    for name in ["a_claim.jpg", "b_claim.png"] {
        let skipped =
            opened.skipped.iter().find(|s| s.name == name).unwrap_or_else(|| panic!("{name} is used"));
        assert!(skipped.reason.contains("megapixels"), "{name}: {}", skipped.reason);
    }
    for view in &opened.views {
        let usable = view.examine(640);
        assert_eq!(usable.is_ok(), view.name != "h_tall.jpg", "{}: {usable:?}", view.name);
    }
    // Masks and other images have the same bound.
    let mib = taken(|| {
        for name in ["a_claim.jpg", "b_claim.png", "c_iccp.png", "g_wide.png"] {
            let file = bombs.join("images").join(name);
            let (mask, image_of_file) = (Mask::read_png(&file), Image::read(&file));
            assert!(name == "c_iccp.png" || (mask.is_err() && image_of_file.is_err()), "{name}");
        }
    });
    assert!(mib < 60.0, "masks take {mib:.0} MiB");

    // Cut-outs, of which the first is large: what they are, the small ones say.
    let cut_outs = dir.path().join("cut_outs");
    let mut files = vec![("00.tif".to_owned(), tiff(11_200, 8_400))];
    files.extend((1..16).map(|i| (format!("{i:02}.png"), disc(i))));
    let files: Vec<(&str, Vec<u8>)> = files.iter().map(|(name, bytes)| (&**name, bytes.clone())).collect();
    scene(&cut_outs, (11_200, 8_400), &files);
    let mut opened = None;
    let mib = taken(|| opened = Some(Scene::open(&cut_outs, &SceneSettings::default()).unwrap()));
    assert!(mib < 60.0, "opening a scene with one large cut-out takes {mib:.0} MiB");
    let opened = opened.unwrap();
    assert_eq!(opened.views.len(), 16, "{:?}", opened.skipped);
    assert!(opened.views.iter().all(|view| view.photo.reading.empty), "{:?}", opened.notes);

    // Eight of 95 megapixels: each whole would be 272 MiB, and with its coefficients twice as much again.
    for progressive in [false, true] {
        let large = dir.path().join(format!("large{progressive}"));
        let names: Vec<String> = (0..8).map(|i| format!("{i}.jpg")).collect();
        let file = jpeg(11_250, 8_438, progressive);
        let files: Vec<(&str, Vec<u8>)> = names.iter().map(|n| (n.as_str(), file.clone())).collect();
        scene(&large, (11_250, 8_438), &files);
        drop(files);
        let mut settings = SceneSettings::default();
        settings.set("size", "320").unwrap();
        let mut claimed = 0;
        segwild_scene::limit_decoding(Some(0));
        let mib = taken(|| {
            let scene = Scene::open(&large, &settings).unwrap();
            claimed = scene.views.iter().map(|v| v.photo.reading.bytes).max().unwrap();
            let grey = |view: &segwild_scene::View| {
                let photo = view.load(320).unwrap();
                assert!((photo.image.data[0] - 128.0 / 255.0).abs() < 0.01, "{}", photo.image.data[0]);
            };
            scene.views.par_iter().for_each(grey);
        });
        segwild_scene::limit_decoding(None);
        let claimed = claimed as f64 / f64::from(1 << 20);
        // What each thread holds of its own comes on top: file and rows.
        assert!(
            mib < claimed + 40.0,
            "progressive {progressive}: {mib:.0} MiB, and {claimed:.0} were claimed"
        );
        assert!(claimed < 90.0, "progressive {progressive}: {claimed:.0} MiB for one photo");
        assert_eq!(Scene::open(&large, &settings).unwrap().skipped, []);
        settings.set("max_megapixels", "50").unwrap();
        let refused = Scene::open(&large, &settings).unwrap_err().to_string();
        assert!(
            refused.contains("95 megapixels") && refused.contains("--max-megapixels allows 50"),
            "{refused}"
        );
    }
}

/// The head of a JPEG of any size, with next to no data: 562 bytes that claim much.
fn jpeg_head(width: u16, height: u16) -> Vec<u8> {
    let small = jpeg(16, 16, false);
    let mut bytes = small;
    let at = bytes.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
    bytes[at + 5..at + 7].copy_from_slice(&height.to_be_bytes());
    bytes[at + 7..at + 9].copy_from_slice(&width.to_be_bytes());
    bytes
}
