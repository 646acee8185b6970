//! Splats of other programs, as their files hold them.

use glam::{DVec3, Mat3, Vec3};
use segwild_scene::{Export, RenderedViews, SceneFrame, SplatFile, SplatLayout, Splats, UpAxis, ply};
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/files").join(name)
}

fn read(path: &Path) -> Splats {
    let file = SplatFile::open(path).unwrap();
    let read = file.read().unwrap();
    assert_eq!((file.splats, file.sh_degree), (read.splats.len(), read.splats.sh_degree));
    read.splats
}

/// How far the splats are from others: positions, logarithms of scales, opacities, covariances as a share, colours.
fn differences(a: &Splats, b: &Splats) -> [f32; 5] {
    assert_eq!((a.len(), a.sh_degree), (b.len(), b.sh_degree));
    let largest = |values: &mut dyn Iterator<Item = f32>| values.fold(0.0, f32::max);
    let pairs = |a: &[[f32; 3]], b: &[[f32; 3]]| {
        let all: Vec<f32> = a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| (a - b).abs()).collect();
        largest(&mut all.into_iter())
    };
    let spread = |m: Mat3| m.to_cols_array().iter().fold(0.0f32, |m, v| m.max(v.abs()));
    [
        pairs(&a.means, &b.means),
        pairs(&a.log_scales, &b.log_scales),
        largest(&mut (0..a.len()).map(|i| (a.opacity(i) - b.opacity(i)).abs())),
        largest(&mut (0..a.len()).map(|i| {
            let (own, other) = (a.covariance(i), b.covariance(i));
            spread(own - other) / spread(own)
        })),
        largest(&mut a.sh.iter().zip(&b.sh).map(|(a, b)| (a - b).abs())),
    ]
}

#[test]
fn what_another_program_packed_is_what_it_was() {
    let whole = read(&file("six.ply"));
    assert_eq!(whole, ply::read(&file("six.ply")).unwrap());
    let cases = [
        ("six.compressed.ply", SplatLayout::CompressedPly, [0.006, 0.002, 0.003, 0.02, 0.02]),
        ("six-v3.spz", SplatLayout::Spz, [2e-4, 0.04, 0.003, 0.08, 0.07]),
        ("six-v4.spz", SplatLayout::Spz, [2e-4, 0.04, 0.003, 0.08, 0.07]),
        ("six.glb", SplatLayout::Glb, [1e-6, 1e-6, 1e-6, 1e-5, 1e-6]),
        // Colour coefficients are those of the nearest of four groups.
        ("six.sog", SplatLayout::Sog, [2e-4, 1e-6, 0.003, 0.02, 0.3]),
    ];
    for (name, layout, most) in cases {
        let path = file(name);
        assert_eq!(SplatFile::open(&path).unwrap().layout, layout);
        let packed = read(&path);
        // The program may sort them.
        let same = |i: usize| {
            let distance = |k: &usize| (packed.mean(*k) - whole.mean(i)).length();
            (0..6).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap()
        };
        let order: Vec<usize> = (0..6).map(same).collect();
        let off = differences(&whole, &packed.select(&order));
        assert!(off.iter().zip(most).all(|(off, most)| *off <= most), "{name}: {off:?} of {most:?}");
    }
    // As the program that wrote it reads it again, in the same order.
    let off = differences(&read(&file("six-sog.ply")), &read(&file("six.sog")));
    assert!(off.iter().zip([1e-5, 1e-6, 0.002, 1e-4, 1e-6]).all(|(off, most)| *off <= most), "{off:?}");
    for (name, program) in [
        ("six.compressed.ply", "splat-transform 2.7.1"),
        ("six.glb", "splat-transform 2.7.1"),
        ("six.sog", "splat-transform v2.7.1"),
    ] {
        assert_eq!(SplatFile::open(&file(name)).unwrap().writer.program.as_deref(), Some(program));
    }
}

#[test]
fn packed_files_that_are_cut_or_changed_are_refused_in_words() {
    let dir = tempfile::tempdir().unwrap();
    for name in ["six.compressed.ply", "six-v3.spz", "six-v4.spz", "six.glb", "six.sog"] {
        let whole = std::fs::read(file(name)).unwrap();
        let path = dir.path().join(name);
        let refused = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            SplatFile::open(&path)
                .and_then(|file| file.read())
                .map(|read| read.splats.len())
                .map_err(|e| e.to_string())
        };
        for cut in (0..whole.len()).step_by(7) {
            let message = refused(&whole[..cut]).expect_err("it is cut");
            assert!(message.contains(name), "{message}");
        }
        // A head that promises more than there is.
        let counts = |w: &[u8]| w == b"vertex 6" || w == b"count\":6";
        let at = whole.windows(8).position(counts).map_or(8, |at| at + 7);
        let mut more = whole.clone();
        more[at] = b'9';
        if name != "six-v3.spz" {
            refused(&more).expect_err("there are six");
        }
    }
    for (bytes, words) in [
        (&b"PK\x03\x04 and more"[..], "cut short"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "a cloud of points"),
        (b"\x1f\x8b and no gzip", "cannot be unpacked"),
    ] {
        let path = dir.path().join("strange.sog");
        std::fs::write(&path, bytes).unwrap();
        let message = SplatFile::open(&path).unwrap_err().to_string();
        assert!(message.contains(words) && message.contains("strange.sog"), "{message}");
    }
}

/// The bytes of a `.spz` of version 3 without its gzip stream.
fn unpacked_spz() -> Vec<u8> {
    let packed = std::fs::read(file("six-v3.spz")).unwrap();
    let mut bytes = Vec::new();
    flate2::read::GzDecoder::new(&packed[..]).read_to_end(&mut bytes).unwrap();
    bytes
}

/// Where the flags of an `.spz` stand, and those of extensions and of levels of detail.
const SPZ_FLAGS: usize = 14;
const HAS_EXTENSIONS: u8 = 2;
const HAS_LEVELS: u8 = 0x80;

/// An extension of an `.spz`.
fn extension(kind: u32, payload: &[u8]) -> Vec<u8> {
    [&kind.to_le_bytes()[..], &(payload.len() as u32).to_le_bytes(), payload].concat()
}

#[test]
fn an_spz_that_is_not_in_a_gzip_stream_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("raw.spz");
    let bytes = unpacked_spz();
    std::fs::write(&path, &bytes).unwrap();
    assert_eq!(read(&path), read(&file("six-v3.spz")));
    std::fs::write(&path, &bytes[..bytes.len() - 1]).unwrap();
    let message = SplatFile::open(&path).unwrap().read().unwrap_err().to_string();
    assert!(message.contains("raw.spz") && message.contains("of an array"), "{message}");
}

/// Adobe's extension of the axes: `CoordinateSystem` of nianticlabs/spz, `src/cc/splat-types.h`, from 1 on.
const AXES: &str = "LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU";

#[test]
fn an_spz_that_declares_its_axes_is_not_turned_over() {
    const AXES_EXTENSION: u32 = 0xadbe_0003;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("axes.spz");
    let plain = read(&file("six-v3.spz"));
    // What the numbers of the file are, whatever its axes: without a declaration, y and z point up and back.
    let stored = Mat3::from_diagonal(Vec3::new(1.0, -1.0, -1.0));
    for (i, axes) in AXES.split(' ').enumerate() {
        let way = |letter: char| match letter {
            'R' => Vec3::X,
            'L' => Vec3::NEG_X,
            'D' => Vec3::Y,
            'U' => Vec3::NEG_Y,
            'F' => Vec3::Z,
            _ => Vec3::NEG_Z,
        };
        let [x, y, z] = [0, 1, 2].map(|k| way(axes.as_bytes()[k].into()));
        let to = Mat3::from_cols(x, y, z) * stored;
        let mut bytes = unpacked_spz();
        bytes[SPZ_FLAGS] |= HAS_EXTENSIONS;
        bytes.extend(extension(0x1234_5678, b"of another program"));
        bytes.extend(extension(AXES_EXTENSION, &(i as u32 + 1).to_le_bytes()));
        std::fs::write(&path, bytes).unwrap();
        let opened = SplatFile::open(&path).unwrap().read().unwrap();
        assert_eq!(opened.notes.len(), usize::from(axes != "RUB"), "{axes}: {:?}", opened.notes);
        let turned = opened.splats;
        for k in 0..6 {
            assert!((turned.mean(k) - to * plain.mean(k)).length() < 1e-5, "{axes}");
            let off = turned.covariance(k) - to * plain.covariance(k) * to.transpose();
            assert!(off.to_cols_array().iter().all(|v| v.abs() < 1e-6), "{axes}: {off}");
            // The same colour from the side that is turned with them.
            let from = Vec3::new(0.36, -0.48, 0.8);
            let colour = |splats: &Splats, from: Vec3| {
                let [_, a, b, c] = [0, 3, 6, 9].map(|at| splats.sh[k * splats.sh_stride() + at]);
                -a * from.y + b * from.z - c * from.x
            };
            assert!((colour(&turned, to * from) - colour(&plain, from)).abs() < 1e-5, "{axes}");
        }
    }
}

#[test]
fn an_spz_of_lichtfeld_studio_names_it() {
    const CONTENTS: usize = 16;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("stamped.spz");
    let whole = std::fs::read(file("six-v4.spz")).unwrap();
    let at = u32::from_le_bytes(whole[CONTENTS..CONTENTS + 4].try_into().unwrap()) as usize;
    // Its writer, src/io/formats/spz.cpp, declares the axes that are the format's own, and then signs.
    let stamp = br#"{"lichtfeld_provenance":1,"app_version":"v0.5.1","build_commit":"1a2b"}"#;
    let more = [extension(0xadbe_0003, &4u32.to_le_bytes()), extension(0x4c46_0001, stamp)].concat();
    let mut bytes = [&whole[..at], &more, &whole[at..]].concat();
    bytes[SPZ_FLAGS] |= HAS_EXTENSIONS;
    bytes[CONTENTS..CONTENTS + 4].copy_from_slice(&((at + more.len()) as u32).to_le_bytes());
    std::fs::write(&path, bytes).unwrap();
    let opened = SplatFile::open(&path).unwrap();
    assert_eq!(opened.writer.program.as_deref(), Some("LichtFeld Studio v0.5.1"));
    assert_eq!(read(&path), read(&file("six-v4.spz")));
}

#[test]
fn an_spz_of_spark_with_levels_of_detail_does_not_show_all_of_them_at_once() {
    const OPACITIES: usize = 16 + 9 * 6;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("levels.spz");
    // rust/spark-lib/src/spz.rs: half of each opacity; after the arrays, how many children each splat has, and the
    // first of them.
    let mut bytes = unpacked_spz();
    bytes[SPZ_FLAGS] |= HAS_LEVELS;
    bytes[OPACITIES..OPACITIES + 6].copy_from_slice(&[127, 20, 50, 127, 100, 127]);
    bytes.extend([2u16, 0, 0, 1, 0, 0].map(u16::to_le_bytes).concat());
    bytes.extend([1u32, 0, 0, 4, 0, 0].map(u32::to_le_bytes).concat());
    let packed = |bytes: &[u8]| {
        let mut stream = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        stream.write_all(bytes).unwrap();
        std::fs::write(&path, stream.finish().unwrap()).unwrap();
        SplatFile::open(&path).unwrap()
    };
    let opened = packed(&bytes);
    assert_eq!((opened.splats, opened.writer.program.as_deref()), (6, Some("Spark")));
    let finest = opened.read().unwrap();
    assert_eq!(finest.notes, ["2 of 6 splats are left out: they are of coarser levels of detail"]);
    let whole = read(&file("six-v3.spz")).select(&[1, 2, 4, 5]);
    assert_eq!((&finest.splats.means, &finest.splats.sh), (&whole.means, &whole.sh));
    let opacities = [0, 1, 2, 3].map(|i| finest.splats.opacity(i) * 255.0);
    let wanted = [40.0, 100.0, 200.0, 254.0];
    assert!((0..4).all(|i| (opacities[i] - wanted[i]).abs() < 0.01), "{opacities:?}");
    let message = packed(&bytes[..bytes.len() - 1]).read().unwrap_err().to_string();
    assert!(message.contains("levels of detail"), "{message}");
}

/// A zip archive of stored files.
fn zip(files: &[(&str, &[u8])]) -> Vec<u8> {
    let (mut archive, mut list) = (Vec::new(), Vec::new());
    for (name, data) in files {
        let mut crc = flate2::Crc::new();
        crc.update(data);
        let at = archive.len() as u32;
        // Version, flags, method and time.
        let start = [20_u8, 0, 0, 0, 0, 0, 0, 0, 0, 0];
        let sizes = [crc.sum(), data.len() as u32, data.len() as u32].map(u32::to_le_bytes).concat();
        let lengths = [name.len() as u16, 0].map(u16::to_le_bytes).concat();
        archive.extend([&b"PK\x03\x04"[..], &start, &sizes, &lengths, name.as_bytes(), data].concat());
        let rest = [&[0; 10][..], &at.to_le_bytes(), name.as_bytes()].concat();
        list.extend([&b"PK\x01\x02\x14\0"[..], &start, &sizes, &lengths, &rest].concat());
    }
    let count = (files.len() as u16).to_le_bytes();
    let sizes = [list.len() as u32, archive.len() as u32].map(u32::to_le_bytes).concat();
    let end = [&b"PK\x05\x06\0\0\0\0"[..], &count, &count, &sizes, &[0, 0]].concat();
    [archive, list, end].concat()
}

#[test]
fn an_archive_that_is_no_sog_is_refused_in_words() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("odd.sog");
    let table: Vec<f32> = (0..256).map(|i| i as f32 / 256.0).collect();
    let whole = json!({
        "version": 2, "count": 2,
        "means": { "mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["low", "high"] },
        "scales": { "codebook": table, "files": ["scales"] },
        "quats": { "files": ["quats"] },
        "sh0": { "codebook": table, "files": ["sh0"] }
    });
    let with = |name: &str, value: Value| {
        let mut meta = whole.clone();
        meta[name] = value;
        meta
    };
    let image = |width: u32, height: u32| {
        let mut bytes = std::io::Cursor::new(Vec::new());
        let pixels = image::RgbaImage::from_pixel(width, height, image::Rgba([9, 8, 7, 255]));
        pixels.write_to(&mut bytes, image::ImageFormat::WebP).unwrap();
        bytes.into_inner()
    };
    let result = |meta: &Value, image: &[u8]| {
        let meta = meta.to_string().into_bytes();
        let images = ["low", "high", "scales", "quats", "sh0"].map(|name| (name, image));
        let files = [&[("meta.json", &meta[..])][..], &images].concat();
        std::fs::write(&path, zip(&files)).unwrap();
        SplatFile::open(&path).and_then(|file| file.read()).map_err(|e| e.to_string())
    };
    let fits = image(2, 1);
    // Whole as it is: the same pixel for all that it stores.
    let read = result(&whole, &fits).unwrap().splats;
    let scales = [9.0, 8.0, 7.0].map(|v: f32| v / 256.0);
    assert_eq!((read.len(), read.sh_degree, read.log_scales[1]), (2, 0, scales));
    let mean = (f32::from(9 + 256 * 9_u16) / 65_535.0).exp_m1();
    assert!((read.means[0][0] - mean).abs() < 1e-6, "{:?}", read.means);
    for (meta, image, words) in [
        (with("version", json!(null)), &fits, "of version 1"),
        (with("version", json!(3)), &fits, "of version 3"),
        (with("means", json!(null)), &fits, "`means` is missing"),
        (with("count", json!(3)), &fits, "2 x 1 pixels"),
        (with("count", json!(20_000_000)), &fits, "thin them out"),
        (with("scales", json!({ "codebook": [], "files": ["scales"] })), &fits, "0 numbers"),
        (with("scales", json!({ "codebook": vec![1.0; 257], "files": ["scales"] })), &fits, "257 numbers"),
        // The images take the numbers 7 to 9 of a table of one.
        (with("scales", json!({ "codebook": [1.0], "files": ["scales"] })), &fits, "none of its splats"),
        (with("quats", json!({ "files": ["\u{7}gone"] })), &fits, "`gone` in the archive"),
        (with("shN", json!({ "bands": 4, "files": ["a", "b"] })), &fits, "degree 4"),
        (whole.clone(), &image(1048, 1024), "1048 x 1024 pixels"),
        (whole.clone(), &b"no image".to_vec(), "cannot be decoded"),
    ] {
        let message = result(&meta, image).unwrap_err();
        assert!(message.contains(words) && message.contains("odd.sog"), "{words}: {message}");
    }
    // What GaussForge says of its training.
    result(&with("antialias", json!(true)), &fits).unwrap();
    assert_eq!(SplatFile::open(&path).unwrap().writer.antialias, Some(true));
    std::fs::write(&path, zip(&[("other.txt", b"text")])).unwrap();
    assert!(
        SplatFile::open(&path).unwrap_err().to_string().contains("`meta.json` in the archive: it is missing")
    );
}

#[test]
fn colours_of_a_sog_whose_groups_are_not_counted_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("groups.sog");
    let table: Vec<f32> = (0..200).map(|i| i as f32 / 256.0).collect();
    let image = |width: u32, pixel: &dyn Fn(u32) -> [u8; 4]| {
        let mut bytes = std::io::Cursor::new(Vec::new());
        let pixels = image::RgbaImage::from_fn(width, 1, |x, _| image::Rgba(pixel(x)));
        pixels.write_to(&mut bytes, image::ImageFormat::WebP).unwrap();
        bytes.into_inner()
    };
    let own = image(2, &|_| [9, 8, 7, 255]);
    // Three coefficients of each of 64 groups; the splats take the first and the third group.
    let centroids = image(192, &|x| [x as u8, x as u8, x as u8, 255]);
    let labels = image(2, &|x| [2 * x as u8, 0, 0, 255]);
    // src/core/sogs.cpp of LichtFeld Studio in 2025 has another name for their number; others have had none.
    for count in [json!({ "count": 3 }), json!({ "palette_size": 3, "coeffs": 3 }), json!({})] {
        let mut palette = json!({ "bands": 1, "codebook": table, "files": ["centroids", "labels"] });
        palette.as_object_mut().unwrap().extend(count.as_object().unwrap().clone());
        let meta = json!({
            "version": 2, "count": 2,
            "means": { "mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["own", "own"] },
            "scales": { "codebook": table, "files": ["own"] },
            "quats": { "files": ["own"] },
            "sh0": { "codebook": table, "files": ["own"] },
            "shN": palette
        });
        let meta = meta.to_string().into_bytes();
        let images = [("own", &own[..]), ("centroids", &centroids[..]), ("labels", &labels[..])];
        let files = [&[("meta.json", &meta[..])][..], &images].concat();
        std::fs::write(&path, zip(&files)).unwrap();
        let splats = read(&path);
        assert_eq!(splats.sh_degree, 1);
        for (i, group) in [(0, 0), (1, 2)] {
            let wanted: Vec<f32> = (0..9).map(|k| (3 * group + k / 3) as f32 / 256.0).collect();
            assert_eq!(&splats.sh[12 * i + 3..12 * i + 12], wanted, "{count}");
        }
    }
}

#[test]
fn a_glb_that_this_program_wrote_comes_back() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("own.glb");
    let frame = SceneFrame { origin: DVec3::new(1.0, -2.0, 3.0), scale: 2.5 };
    for sh_degree in 0..=3 {
        let stride = 3 * (sh_degree as usize + 1).pow(2);
        let splats = Splats {
            means: vec![[1.0, -2.0, 0.5], [3.0, 4.0, -5.0], [-0.1, 0.0, 9.0]],
            log_scales: vec![[-3.0, 0.0, 2.0], [-9.0, -1.0, -1.5], [0.1; 3]],
            rotations: vec![[0.6, 0.0, -0.8, 0.0], [0.5; 4], [0.1, 0.7, -0.7, 0.1]],
            // One is almost transparent, one opaque.
            opacities: vec![-18.0, 0.3, 12.0],
            sh_degree,
            sh: (0..3 * stride).map(|i| (i as f32).sin()).collect(),
        };
        for antialias in [true, false] {
            Export { frame: &frame, antialias, extra: &[], provenance: None }.write(&path, &splats).unwrap();
            let file = SplatFile::open(&path).unwrap();
            assert_eq!((file.layout, file.sh_degree), (SplatLayout::Glb, sh_degree));
            assert_eq!((file.writer.antialias, file.writer.up), (Some(antialias), Some(UpAxis::MinusY)));
            assert!(file.writer.program.unwrap().starts_with("segwild "));
            let off = differences(&splats.to_file_frame(&frame), &read(&path));
            assert!(
                off.iter().zip([1e-6, 2e-6, 1e-6, 1e-5, 1e-6]).all(|(off, most)| *off <= most),
                "{off:?}"
            );
        }
    }
    let logit = read(&path).opacities[0];
    assert!((logit + 18.0).abs() < 1e-4, "a small opacity keeps its logarithm: {logit}");
}

/// A `.glb` of a description and its data.
fn glb(description: &Value, data: &[u8]) -> Vec<u8> {
    let mut json = description.to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let word = |n: usize| (n as u32).to_le_bytes();
    let length = 12 + 8 + json.len() + 8 + data.len();
    let header =
        [&b"glTF"[..], &word(2)[..], &word(length)[..], &word(json.len())[..], &b"JSON"[..]].concat();
    [&header[..], &json[..], &word(data.len())[..], &b"BIN\0"[..], data].concat()
}

/// Two splats whose numbers take turns in 40 bytes each, their opacities and rotations as whole numbers,
/// at a node that turns, scales and moves them below another.
fn mixed() -> (Value, Vec<u8>) {
    let mut data = Vec::new();
    for x in [1.0f32, -1.0] {
        data.extend([x, 0.0, 0.0].iter().flat_map(|v| v.to_le_bytes()));
        data.extend([0.5f32, 0.25, 0.125].iter().flat_map(|v| v.to_le_bytes()));
        data.extend([0.1f32, 0.2, 0.3].iter().flat_map(|v| v.to_le_bytes()));
        // The rotation about x by half a turn, as shares of 127, and then the opacities of both, as shares of 255.
        data.extend([127, 0, 0, 0]);
    }
    data.extend([51, 204, 0, 0]);
    let accessor = |view: u32, offset: u32, component: u32, shape: &str| {
        json!({
            "bufferView": view, "byteOffset": offset, "componentType": component, "count": 2, "type": shape,
            "normalized": component != 5126
        })
    };
    let document = json!({
        "asset": { "version": "2.0" },
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scenes": [{ "nodes": [1] }],
        "nodes": [
            { "mesh": 0, "scale": [2.0, 2.0, 2.0], "rotation": [0.0, 0.0, 0.5f64.sqrt(), 0.5f64.sqrt()] },
            { "children": [0], "translation": [0.0, 0.0, 10.0] }
        ],
        "meshes": [{ "primitives": [
            { "attributes": { "POSITION": 0 } },
            {
                "attributes": {
                    "POSITION": 0,
                    "KHR_gaussian_splatting:SCALE": 1,
                    "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": 2,
                    "KHR_gaussian_splatting:ROTATION": 3,
                    "KHR_gaussian_splatting:OPACITY": 4
                },
                "extensions": { "KHR_gaussian_splatting": { "kernel": "ellipse", "colorSpace": "srgb_rec709_display" } }
            }
        ] }],
        "accessors": [
            accessor(0, 0, 5126, "VEC3"),
            accessor(0, 12, 5126, "VEC3"),
            accessor(0, 24, 5126, "VEC3"),
            accessor(0, 36, 5120, "VEC4"),
            accessor(1, 0, 5121, "SCALAR")
        ],
        "bufferViews": [
            { "buffer": 0, "byteOffset": 0, "byteLength": 80, "byteStride": 40 },
            { "buffer": 0, "byteOffset": 80, "byteLength": 4 }
        ],
        "buffers": [{ "byteLength": 84 }]
    });
    (document, data)
}

#[test]
fn a_glb_is_read_with_its_nodes_strides_and_whole_numbers() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("mixed.glb");
    let (document, data) = mixed();
    std::fs::write(&path, glb(&document, &data)).unwrap();
    let splats = read(&path);
    assert_eq!((splats.len(), splats.sh_degree), (2, 0));
    // A quarter of a turn about z takes x to y, twice as far; half a turn about z leads to the axes of `.ply`.
    for (i, y) in [(0, -2.0), (1, 2.0)] {
        assert!((splats.mean(i) - Vec3::new(0.0, y, 10.0)).length() < 1e-5, "{:?}", splats.means);
        let variances = splats.covariance(i);
        assert!(
            variances.abs_diff_eq(Mat3::from_diagonal(Vec3::new(0.25, 1.0, 0.0625)), 1e-5),
            "{variances}"
        );
    }
    assert!((splats.opacity(0) - 0.2).abs() < 1e-6 && (splats.opacity(1) - 0.8).abs() < 1e-6);
    assert_eq!(splats.sh, [0.1, 0.2, 0.3, 0.1, 0.2, 0.3]);
}

#[test]
fn a_glb_that_is_no_plain_splats_is_refused_in_words() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("odd.glb");
    let (whole, data) = mixed();
    let form = "/meshes/0/primitives/1/extensions/KHR_gaussian_splatting";
    let cases = [
        ("/nodes/0/scale", json!([2.0, 2.0, 1.0]), "squeezes or mirrors"),
        ("/nodes/0/scale", json!([2.0, 2.0, -2.0]), "squeezes or mirrors"),
        ("/nodes/0/children", json!([1]), "two parents"),
        ("/nodes/0/mesh", json!(7), "no mesh 7"),
        ("/scenes/0/nodes", json!([]), "no splats"),
        ("/extensionsRequired", json!(["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
        ("/accessors/0/count", json!(3), "cut short"),
        ("/accessors/0/count", json!(0), "has none"),
        ("/accessors/0/count", json!(u64::MAX), "thin them out"),
        ("/meshes/0/primitives/1/mode", json!(4), "mode 4"),
        ("/accessors/1/count", json!(1), "1 values for 2 splats"),
        ("/accessors/1/type", json!("VEC4"), "`VEC3` is read"),
        ("/accessors/1/componentType", json!(5125), "a type"),
        ("/accessors/1/sparse", json!({ "count": 1 }), "sparse"),
        ("/accessors/1/byteOffset", json!(70), "cut short"),
        ("/accessors/1/byteOffset", json!(u64::MAX), "cut short"),
        ("/bufferViews/0/byteStride", json!(8), "overlap"),
        ("/bufferViews/0/byteLength", json!(40), "cut short"),
        ("/bufferViews/0/byteOffset", json!(u64::MAX), "cut short"),
        ("/bufferViews/1/buffer", json!(1), "another file"),
        ("/buffers/0/uri", json!("data.bin"), "another file"),
    ];
    let changed = |pointer: &str, value: &Value| {
        let mut document = whole.clone();
        let (parent, name) = pointer.rsplit_once('/').unwrap();
        document.pointer_mut(parent).unwrap()[name] = value.clone();
        document
    };
    let refused = |document: &Value| {
        std::fs::write(&path, glb(document, &data)).unwrap();
        let read = SplatFile::open(&path).and_then(|file| file.read());
        read.expect_err("it is no plain splats").to_string()
    };
    for (pointer, value, words) in cases {
        let message = refused(&changed(pointer, &value));
        assert!(message.contains(words) && message.contains("odd.glb"), "{pointer}: {message}");
    }
    for (name, value, words) in [
        ("kernel", json!("sphere"), "`sphere`"),
        ("projection", json!("spherical"), "`spherical`"),
        ("colorSpace", json!("lin_rec709_display"), "`lin_rec709_display`"),
        ("extensions", json!({ "KHR_gaussian_splatting_compression_spz_2": {} }), "compression_spz_2"),
    ] {
        let message = refused(&changed(&format!("{form}/{name}"), &value));
        assert!(message.contains(words), "{name}: {message}");
    }
    let mut missing = whole.clone();
    let attributes = "/meshes/0/primitives/1/attributes";
    missing.pointer_mut(attributes).unwrap()["KHR_gaussian_splatting:SH_DEGREE_1_COEF_2"] = json!(2);
    assert!(refused(&missing).contains("degree 1 is missing"), "{}", refused(&missing));
}

#[test]
fn a_small_glb_that_shows_its_splats_at_very_many_nodes_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("many.glb");
    // Each of the nodes shows all primitives of the mesh: 40 million of them, from a description below 1 MiB.
    let (nodes, primitives) = (20_000, 2_000);
    let refused = |splats: usize| {
        let extensions = json!({ "KHR_gaussian_splatting": {} });
        let primitive = json!({ "attributes": { "POSITION": 0 }, "extensions": extensions });
        let document = json!({
            "asset": { "version": "2.0" },
            "nodes": vec![json!({ "mesh": 0 }); nodes],
            "meshes": [{ "primitives": vec![primitive; primitives] }],
            "accessors": [{ "componentType": 5126, "count": splats, "type": "VEC3" }]
        });
        let file = glb(&document, &[]);
        assert!(file.len() < 1 << 20, "{} bytes", file.len());
        std::fs::write(&path, file).unwrap();
        SplatFile::open(&path).expect_err("it is too much").to_string()
    };
    for (splats, words) in [(0, "has none"), (1, "65536 primitives"), (1_000, "thin them out")] {
        let message = refused(splats);
        assert!(message.contains(words) && message.contains("many.glb"), "{splats}: {message}");
    }
}

/// A `.ply` with this head and a row of numbers per splat.
fn written(dir: &Path, comments: &str, properties: &str, rows: [&str; 2]) -> PathBuf {
    let path = dir.join("of.ply");
    let properties: String = properties.split(' ').map(|name| format!("property float {name}\n")).collect();
    let rows = rows.join("\n");
    let head = format!("ply\nformat ascii 1.0\n{comments}element vertex 2\n{properties}end_header\n{rows}\n");
    std::fs::write(&path, head).unwrap();
    path
}

/// The header of a binary `.ply` of two splats: comments, and properties as 32-bit floats.
fn header_of(comments: &[&str], properties: &[&str]) -> String {
    let comments: String = comments.iter().map(|comment| format!("{comment}\n")).collect();
    let properties: String = properties.iter().map(|name| format!("property float {name}\n")).collect();
    format!("ply\nformat binary_little_endian 1.0\n{comments}element vertex 2\n{properties}end_header\n")
}

/// What a property holds in the files that are written here: each name another number.
fn number_of(name: &str) -> f32 {
    let indexed = name.rsplit_once('_').and_then(|(stem, k)| Some((stem, k.parse::<f32>().ok()?)));
    let (stem, k) = indexed.unwrap_or((name, 0.0));
    match stem {
        "x" => 1.0,
        "y" => 2.0,
        "z" => 3.0,
        "f_dc" => 0.1 * (k + 1.0),
        "f_rest" => 0.01 * k,
        "opacity" => 0.5,
        "scale" => -3.0 - k,
        "rot" => [0.8, 0.0, -0.6, 0.0][k as usize],
        "red" => 255.0,
        "blue" => 51.0,
        _ => 0.0,
    }
}

/// A file with this header and the numbers that its properties hold.
fn filled(header: &str) -> Vec<u8> {
    let mut row = Vec::new();
    for line in header.lines() {
        match line.split(' ').collect::<Vec<_>>()[..] {
            ["property", "uchar", name] => row.push(number_of(name) as u8),
            ["property", _, name] => row.extend(number_of(name).to_le_bytes()),
            _ => {}
        }
    }
    [header.as_bytes(), &row.repeat(2)[..]].concat()
}

/// Names of properties, those of `f_rest` in the place of the word.
fn properties(names: &str, rest: usize) -> Vec<String> {
    let of = |name: &str| match name {
        "f_rest" => (0..rest).map(|k| format!("f_rest_{k}")).collect(),
        name => vec![name.to_owned()],
    };
    names.split(' ').flat_map(of).collect()
}

#[test]
fn files_of_each_program_are_recognised_and_read_in_its_order() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("splats.ply");
    const COLOURS: &str = "f_dc_0 f_dc_1 f_dc_2 f_rest";
    const SHAPE: &str = "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    let plain = format!("x y z {COLOURS} {SHAPE}");
    let with_normals = format!("x y z nx ny nz {COLOURS} {SHAPE}");
    let of_brush = format!("x y z scale_0 scale_1 scale_2 opacity rot_0 rot_1 rot_2 rot_3 {COLOURS}");
    let (up, down) = (Some(UpAxis::Z), Some(UpAxis::MinusY));
    // Comments, properties, coefficients beyond the constant, program, axis, mode. Each names the writer that it
    // follows; of these, splat-transform's alone was read when the test was written.
    type Case<'a> = (&'a [&'a str], &'a str, usize, &'a str, Option<UpAxis>, Option<bool>);
    let ahead = Some(UpAxis::Direction([0.0, -0.6, -0.8]));
    let cases: [Case; 12] = [
        // graphdeco-inria/gaussian-splatting, scene/gaussian_model.py, `save_ply`.
        (&[], &with_normals, 45, "3D Gaussian Splatting, or in its layout", None, None),
        // nerfstudio-project/gsplat, gsplat/exporter.py, `splat2ply_bytes`.
        (&[], &plain, 45, "gsplat, or in its layout", None, None),
        // nerfstudio-project/nerfstudio, nerfstudio/scripts/exporter.py, `ExportGaussianSplat.write_ply`: y and z of
        // the world are those of its data parser, which turns and scales the poses.
        (
            &["comment Generated by Nerstudio 1.1.5", "comment Vertical Axis: z"],
            &with_normals,
            45,
            "nerfstudio 1.1.5",
            up,
            None,
        ),
        // ArthurBrussee/brush, crates/brush-serde/src/export.rs; the mode since it has one.
        (&["comment Exported from Brush", "comment Vertical axis: y"], &of_brush, 45, "Brush", down, None),
        (
            &["comment Vertical axis: y", "comment Exported from Brush", "comment SplatRenderMode: mip"],
            &of_brush,
            24,
            "Brush",
            down,
            Some(true),
        ),
        // Since it estimates which way is up, it writes a vector.
        (
            &["comment Exported from Brush", "comment Vertical axis: 0 -3 -4", "comment SH degree: 2"],
            &of_brush,
            24,
            "Brush",
            ahead,
            None,
        ),
        // Postshot, whose source is closed: the comment as playcanvas/splat-transform reads it.
        (&["comment antialiased 0"], &plain, 45, "Postshot", None, Some(false)),
        (&["comment antialiased 1"], &plain, 45, "Postshot", None, Some(true)),
        // MrNeRF/LichtFeld-Studio, src/io/formats/ply.cpp.
        (
            &["obj_info {\"lichtfeld_provenance\":{\"version\":1}}"],
            &with_normals,
            9,
            "LichtFeld Studio",
            None,
            None,
        ),
        // The note since it has the version, src/core/provenance.cpp.
        (
            &["obj_info {\"lichtfeld_provenance\":1,\"iteration\":30000,\"app_version\":\"v0.5.1\"}"],
            &with_normals,
            0,
            "LichtFeld Studio v0.5.1",
            None,
            None,
        ),
        // pierotofy/OpenSplat, model.cpp, `Model::savePly`.
        (
            &["comment Generated by opensplat at iteration 2000"],
            &with_normals,
            45,
            "opensplat at iteration 2000",
            None,
            None,
        ),
        // playcanvas/splat-transform, src/lib/writers/write-ply.ts, of version 3; another mode than those known is
        // none.
        (
            &["comment Generated by splat-transform 3.7.0", "comment SplatRenderMode: other"],
            &plain,
            0,
            "splat-transform 3.7.0",
            None,
            None,
        ),
    ];
    for (comments, names, rest, program, up, antialias) in cases {
        let names = properties(names, rest);
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        std::fs::write(&path, filled(&header_of(comments, &names))).unwrap();
        let writer = SplatFile::open(&path).unwrap().writer;
        assert_eq!(writer.program.as_deref(), Some(program));
        assert_eq!((writer.up, writer.antialias), (up, antialias), "{program}");
        let splats = read(&path);
        assert_eq!(
            (splats.means[1], splats.log_scales[1]),
            ([1.0, 2.0, 3.0], [-3.0, -4.0, -5.0]),
            "{program}"
        );
        assert_eq!((splats.rotations[1], splats.opacities[1]), ([0.8, 0.0, -0.6, 0.0], 0.5), "{program}");
        // Red's coefficients come first, then green's, then blue's.
        let own = &splats.sh[splats.sh_stride()..];
        let wanted = (0..rest).map(|i| number_of(&format!("f_rest_{}", i % 3 * (rest / 3) + i / 3)));
        let wanted: Vec<f32> = (0..3).map(|c| number_of(&format!("f_dc_{c}"))).chain(wanted).collect();
        assert_eq!(own, wanted, "{program}");
    }
    // nerfstudio's `--ply-color-mode rgb`: bytes of colours in the place of the coefficients.
    let names = format!("x y z nx ny nz red green blue {SHAPE}");
    let names: Vec<&str> = names.split(' ').collect();
    let bytes = header_of(&["comment Generated by Nerstudio 1.1.5", "comment Vertical Axis: z"], &names);
    let bytes = ["red", "green", "blue"]
        .iter()
        .fold(bytes, |text, name| text.replace(&format!("float {name}"), &format!("uchar {name}")));
    std::fs::write(&path, filled(&bytes)).unwrap();
    let splats = read(&path);
    let colour = [0, 1, 2].map(|c| splats.sh[3 + c] * 0.282_094_79 + 0.5);
    assert!((0..3).all(|c| (colour[c] - [1.0, 0.0, 0.2][c]).abs() < 1e-5), "{colour:?}");
    assert_eq!((splats.rotations[1], splats.opacities[1]), ([0.8, 0.0, -0.6, 0.0], 0.5));
}

#[test]
fn flat_splats_filters_and_high_degrees_become_plain_splats() {
    let dir = tempfile::tempdir().unwrap();
    let head = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2";
    let row = "0 0 1 0 0 0 0.1 0.2 0.3";
    // 2D Gaussian splatting.
    let flat = format!("{head} opacity scale_0 scale_1 rot_0 rot_1 rot_2 rot_3");
    let flat = read(&written(dir.path(), "", &flat, [&*format!("{row} 0 -2 -3 1 0 0 0"); 2]));
    assert_eq!(flat.log_scales[0][..2], [-2.0, -3.0]);
    assert!(flat.log_scales[0][2] < -9.0);
    // Mip-Splatting: variances add, and the opacity shrinks as the volume grows.
    let mip = format!("{head} opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 filter_3D");
    let path = written(dir.path(), "", &mip, [&*format!("{row} 0 0 0 0 1 0 0 0 1"); 2]);
    let widened = read(&path);
    assert!((widened.scale(0).x - 2f32.sqrt()).abs() < 1e-5);
    assert!((widened.opacity(0) - 0.5 / 8f32.sqrt()).abs() < 1e-5);
    let notes = SplatFile::open(&path).unwrap().read().unwrap().notes;
    assert!(notes[0].contains("filter_3D"), "{notes:?}");
    // Degree 4: the lower degrees of each channel.
    let rest: Vec<String> = (0..72).map(|k| format!("f_rest_{k}")).collect();
    let high = format!("{head} {} opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3", rest.join(" "));
    let values: Vec<String> = (0..72).map(|k| k.to_string()).collect();
    let high =
        read(&written(dir.path(), "", &high, [&*format!("{row} {} 0 0 0 0 1 0 0 0", values.join(" ")); 2]));
    assert_eq!(high.sh_degree, 3);
    assert_eq!(high.sh[3..9], [0.0, 24.0, 48.0, 1.0, 25.0, 49.0]);
}

#[test]
fn splats_that_cannot_be_rendered_are_left_out_and_counted() {
    let dir = tempfile::tempdir().unwrap();
    let properties = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    let rows = ["0 0 1 0 0 0 0 -3 -3 -3 1 0 0 0", "nan 0 1 0 0 0 0 -3 -3 -3 1 0 0 0"];
    let path = written(dir.path(), "", properties, rows);
    let left = SplatFile::open(&path).unwrap().read().unwrap();
    assert_eq!(left.splats.len(), 1);
    assert!(left.notes[0].starts_with("1 of 2 splats are left out"), "{:?}", left.notes);
    let path = written(dir.path(), "", properties, [rows[1]; 2]);
    assert!(SplatFile::open(&path).unwrap().read().is_err());
}

#[test]
fn the_last_iteration_of_a_folder_is_taken() {
    let dir = tempfile::tempdir().unwrap();
    for iteration in [7000, 30_000] {
        let folder = dir.path().join(format!("point_cloud/iteration_{iteration}"));
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::copy(file("six.ply"), folder.join("point_cloud.ply")).unwrap();
    }
    let path = SplatFile::open(dir.path()).unwrap().path;
    assert!(path.ends_with("iteration_30000/point_cloud.ply"), "{}", path.display());
    let empty = tempfile::tempdir().unwrap();
    assert!(SplatFile::open(empty.path()).unwrap_err().to_string().contains("name the file"));
}

#[test]
fn a_file_of_that_name_alone_makes_no_folder_one_of_renders() {
    let dir = tempfile::tempdir().unwrap();
    let (splats, other) =
        (SplatFile::open(&file("six.ply")).unwrap(), SplatFile::open(&file("six.glb")).unwrap());
    let says = |text: &str| {
        std::fs::write(dir.path().join("views.json"), text).unwrap();
        splats.is_rendered_in(dir.path()).unwrap()
    };
    let of = |file: &SplatFile| {
        let views = RenderedViews { rule: 2, splats: file.digest().unwrap(), size: 640 };
        serde_json::to_string(&views).unwrap()
    };
    assert!(!splats.is_rendered_in(dir.path()).unwrap());
    assert!(!says("[{\"name\": \"a view of another program\"}]"));
    assert!(!says(&of(&other)));
    assert!(says(&of(&splats)));
}
