//! Files that are written and read again, and hostile ones.

use glam::DVec3;
use proptest::prelude::*;
use segwild_scene::colmap;
use segwild_scene::lens::{CameraModel, Lens};
use segwild_scene::{Image, Mask, SceneError, SceneFrame, Splats, ply};

fn splats(n: usize, sh_degree: u32) -> Splats {
    let number = |i: usize, k: usize| ((i * 31 + k * 17) as f32 * 0.37).sin() * 3.0;
    let stride = 3 * (sh_degree as usize + 1).pow(2);
    Splats {
        means: (0..n).map(|i| [0, 1, 2].map(|k| number(i, k))).collect(),
        log_scales: (0..n).map(|i| [3, 4, 5].map(|k| number(i, k))).collect(),
        rotations: (0..n).map(|i| [6, 7, 8, 9].map(|k| number(i, k))).collect(),
        opacities: (0..n).map(|i| number(i, 10)).collect(),
        sh_degree,
        sh: (0..n * stride).map(|i| number(i, 11)).collect(),
    }
}

#[test]
fn colmap_files_come_back_as_they_were() {
    let dir = tempfile::tempdir().unwrap();
    let mut r = crate::common::line(3);
    r.images[0].name = "a folder/ünï cödé.jpg".into();
    r.images[1].keypoints.clear();
    r.images[2].keypoints[0].point = None;
    r.images[2].translation = [1.0 / 3.0, -1e-300, 1e300];
    r.points[0].track.clear();
    let (binary, text) = (dir.path().join("b"), dir.path().join("t"));
    colmap::write(&binary, &r).unwrap();
    colmap::write_text(&text, &r).unwrap();
    assert_eq!(colmap::read(&binary).unwrap(), r);
    assert_eq!(colmap::read(&text).unwrap(), r);
}

#[test]
fn ply_comes_back_for_every_degree_with_labels_and_poison() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.ply");
    for degree in 0..=3 {
        let mut s = splats(7, degree);
        s.opacities[3] = f32::INFINITY;
        s.means[2] = [-0.0, f32::MIN_POSITIVE / 8.0, f32::MAX];
        ply::write(&path, &s).unwrap();
        let first = std::fs::read(&path).unwrap();
        assert_eq!(ply::read(&path).unwrap(), s);
        let labels: Vec<u8> = (0..7).map(|i| i * 40).collect();
        ply::write_with(&path, &s, &[("label", &labels)]).unwrap();
        assert_eq!(ply::read(&path).unwrap(), s);
        assert_eq!(ply::read_extra(&path, "label").unwrap(), Some(labels));
        assert_eq!(ply::read_extra(&path, "other").unwrap(), None);
        ply::write(&path, &ply::read(&path).unwrap()).unwrap();
        assert!(std::fs::read(&path).unwrap() == first);
    }
    ply::write(&path, &splats(0, 0)).unwrap();
    assert!(ply::read(&path).unwrap().is_empty());
}

#[test]
fn ply_properties_are_found_in_any_order_type_and_form() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.ply");
    // Reversed, a double among them, without normals, with an unknown property and a list element behind.
    let names = "rot_3 rot_2 rot_1 rot_0 scale_2 scale_1 scale_0 opacity f_dc_2 f_dc_1 f_dc_0 extra z y x";
    let header = |form: &str| {
        let mut h = format!("ply\r\nformat {form} 1.0\ncomment made by hand\nelement vertex 2\n");
        for name in names.split(' ') {
            let kind = match name {
                "x" => "double",
                "extra" => "short",
                _ => "float",
            };
            h += &format!("property {kind} {name}\n");
        }
        h + "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    };
    let value = |row: usize, k: usize| (row * 20 + k) as f64 * 0.5;
    let mut text = header("ascii").into_bytes();
    let mut little = header("binary_little_endian").into_bytes();
    let mut big = header("binary_big_endian").into_bytes();
    for row in 0..2 {
        for (k, name) in names.split(' ').enumerate() {
            let v = value(row, k);
            match name {
                "x" => {
                    text.extend(format!("{v}\n").bytes());
                    little.extend(v.to_le_bytes());
                    big.extend(v.to_be_bytes());
                }
                "extra" => {
                    text.extend(b"5 ");
                    little.extend(5i16.to_le_bytes());
                    big.extend(5i16.to_be_bytes());
                }
                _ => {
                    text.extend(format!("{v} ").bytes());
                    little.extend((v as f32).to_le_bytes());
                    big.extend((v as f32).to_be_bytes());
                }
            }
        }
    }
    text.extend(b"3 0 1 0\n");
    for bytes in [text, little, big] {
        std::fs::write(&path, bytes).unwrap();
        let s = ply::read(&path).unwrap();
        assert_eq!((s.len(), s.sh_degree, s.means[1]), (2, 0, [17.0, 16.5, 16.0]));
        assert_eq!((s.rotations[0], s.opacities[1]), ([1.5, 1.0, 0.5, 0.0], 13.5));
        assert_eq!(ply::read_extra(&path, "extra").unwrap(), Some(vec![5, 5]));
    }
}

#[test]
fn hostile_ply_files_are_refused_in_words() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("bad.ply");
    ply::write(&path, &splats(3, 1)).unwrap();
    let good = std::fs::read(&path).unwrap();
    let end = good.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let head = String::from_utf8(good[..end].to_vec()).unwrap();
    let refuse = |bytes: &[u8], words: &str| {
        std::fs::write(&path, bytes).unwrap();
        let message = ply::read(&path).unwrap_err().to_string();
        assert!(message.contains("bad.ply") && message.contains(words), "{message}");
    };
    let with = |from: &str, to: &str| {
        assert!(head.contains(from));
        [head.replacen(from, to, 1).as_bytes(), &good[end..]].concat()
    };
    for cut in (0..good.len()).step_by(13) {
        std::fs::write(&path, &good[..cut]).unwrap();
        assert!(ply::read(&path).is_err(), "cut at {cut}");
    }
    refuse(&good[..good.len() - 1], "vertex 3 of 3");
    refuse(&with("vertex 3", "vertex 18446744073709551615"), "vertex 4 of");
    refuse(&with("vertex 3", "vertex -3"), "`-3` is no count");
    refuse(&with("property float opacity", "property list uchar float opacity"), "list");
    refuse(&with("property float opacity", "property float capacity"), "`opacity`");
    refuse(&with("property float opacity", "property half opacity"), "`half`");
    refuse(&with("property float f_rest_0\n", ""), "SH degree");
    refuse(&with("property float nx", "property float x"), "twice");
    refuse(&with("binary_little_endian", "ascii"), "UTF-8");
    refuse(&with("binary_little_endian", "morse"), "morse");
    refuse(&with("format binary_little_endian 1.0\n", ""), "format");
    refuse(b"plyplyply", "header");
    refuse(&vec![0u8; 100_000], "header");
    refuse(b"", "header");
    let splat = dir.path().join("bad.splat");
    std::fs::write(&splat, [0u8; 70]).unwrap();
    assert!(matches!(ply::read_splat(&splat), Err(SceneError::Truncated { offset: 64, .. })));
}

#[test]
fn splats_go_to_the_frame_of_the_file_and_back() {
    let s = splats(50, 2);
    let frame = SceneFrame { origin: DVec3::new(100.0, -20.0, 3.0), scale: 250.0 };
    let out = s.to_file_frame(&frame);
    assert!((out.mean(3).as_dvec3() - (s.mean(3).as_dvec3() * 250.0 + frame.origin)).length() < 1e-4);
    assert!((out.scale(3) / s.scale(3) - 250.0).abs().max_element() < 1e-2);
    let back = out.from_file_frame(&frame);
    for i in 0..50 {
        assert!(
            (back.mean(i) - s.mean(i)).length() < 1e-6
                && (back.scale(i) / s.scale(i) - 1.0).abs().max_element() < 1e-5
        );
    }
    assert_eq!((back.sh, back.rotations, back.opacities), (s.sh, s.rotations, s.opacities));
}

#[test]
fn images_and_masks_come_back() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    let test_image = crate::common::test_image(33, 17);
    test_image.write_png(&path).unwrap();
    let back = Image::read(&path).unwrap();
    assert!(back.data.iter().zip(&test_image.data).all(|(a, b)| (a - b).abs() <= 0.5001 / 255.0));
    let odd = Image { width: 3, height: 1, channels: 1, data: vec![f32::NAN, -4.0, 9.0] };
    odd.write_png(&path).unwrap();
    assert_eq!(Image::read(&path).unwrap().plane(0), [0.0, 0.0, 1.0]);
    let mask = Mask::from_fn(65, 9, |x, y| (x * y) % 3 == 1);
    mask.write_png(&path).unwrap();
    assert_eq!(Mask::read_png(&path).unwrap(), mask);
    std::fs::write(&path, b"no image").unwrap();
    let message = Mask::read_png(&path).unwrap_err().to_string();
    assert!(message.contains("a.png"), "{message}");
}

#[test]
fn resizing_keeps_means_ranges_and_edges() {
    let test_image = crate::common::test_image(60, 45);
    for (w, h) in [(60, 45), (20, 15), (17, 13), (120, 90), (1, 1), (7, 90)] {
        let small = test_image.resized(w, h);
        let mean = |i: &Image, c: usize| i.plane(c).iter().sum::<f32>() / i.pixels() as f32;
        for c in 0..3 {
            // Growing changes the border's weights; shrinking keeps the mean exactly.
            let slack = if w <= 60 && h <= 45 { 1e-5 } else { 5e-3 };
            assert!((mean(&small, c) - mean(&test_image, c)).abs() < slack, "{w} x {h}");
        }
    }
    let step = Image { width: 4, height: 1, channels: 1, data: vec![0.0, 0.0, 1.0, 1.0] };
    assert_eq!(step.resized(2, 1).data, [0.0, 1.0]);
    assert_eq!(step.resized(8, 1).data, [0.0, 0.0, 0.0, 0.25, 0.75, 1.0, 1.0, 1.0]);
}

fn lens() -> impl Strategy<Value = Lens> {
    let k = |s: f64| -s..s;
    let model = prop_oneof![
        Just(CameraModel::SimpleRadial),
        Just(CameraModel::Radial),
        Just(CameraModel::OpenCv),
        Just(CameraModel::FullOpenCv),
        Just(CameraModel::OpenCvFisheye),
        Just(CameraModel::SimpleRadialFisheye),
        Just(CameraModel::RadialFisheye),
        Just(CameraModel::ThinPrismFisheye),
        Just(CameraModel::Fov),
        Just(CameraModel::Division),
        Just(CameraModel::Fisheye),
    ];
    (model, 200.0..900.0f64, prop::collection::vec(k(0.15), 8), 0.05..1.2f64).prop_map(
        |(model, f, k, omega)| {
            let tangential = |v: f64| v * 0.03;
            let mut params = if matches!(
                model,
                CameraModel::SimpleRadial
                    | CameraModel::Radial
                    | CameraModel::SimpleRadialFisheye
                    | CameraModel::RadialFisheye
            ) {
                vec![f, 320.0, 240.0]
            } else {
                vec![f, f * 1.02, 320.0, 240.0]
            };
            match model {
                CameraModel::Fov => params.push(omega),
                CameraModel::Division => params.push(k[0]),
                CameraModel::OpenCvFisheye => params.extend([k[0], k[1] * 0.3, k[2] * 0.1, k[3] * 0.03]),
                CameraModel::Fisheye => {}
                _ => {
                    let all = [
                        k[0],
                        k[1],
                        tangential(k[2]),
                        tangential(k[3]),
                        k[4] * 0.2,
                        k[5] * 0.2,
                        tangential(k[6]),
                        tangential(k[7]),
                    ];
                    params.extend(&all[..model.param_count() - params.len()]);
                }
            }
            Lens::new(model, 640, 480, &params).unwrap()
        },
    )
}

/// The header of a file, and what stands beside it.
fn header_and_offset(path: &std::path::Path) -> (String, Option<String>) {
    let bytes = std::fs::read(path).unwrap();
    let head = String::from_utf8_lossy(&bytes).into_owned();
    let head = head[..head.find("end_header").unwrap()].to_owned();
    (head, std::fs::read_to_string(path.with_extension("offset.json")).ok())
}

#[test]
fn a_georeferenced_export_keeps_its_precision_by_an_offset() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.ply");
    let s = splats(50, 1);
    for origin in [DVec3::new(448_262.3, 5_411_932.7, 35.0), DVec3::new(4_156_305.1, 671_404.6, -4_774_508.2)]
    {
        let frame = SceneFrame { origin, scale: 4.0 };
        segwild_scene::Export { frame: &frame, antialias: true, extra: &[], provenance: None }
            .write(&path, &s)
            .unwrap();
        let (head, beside) = header_and_offset(&path);
        let offset = frame.offset();
        assert!(head.contains(&format!("comment offset {} {} {}\n", offset.x, offset.y, offset.z)), "{head}");
        let beside: serde_json::Value = serde_json::from_str(&beside.unwrap()).unwrap();
        assert_eq!(beside["offset"], serde_json::json!(offset.to_array()));
        let read = ply::read(&path).unwrap();
        for i in 0..s.len() {
            let wanted = s.mean(i).as_dvec3() * frame.scale + frame.origin;
            let off = (read.mean(i).as_dvec3() + offset - wanted).abs().max_element();
            assert!(off < 1e-6 * frame.scale, "splat {i} is {off} m off");
        }
    }
    // Another scene into the same place: nothing of the old offset is left.
    let frame = SceneFrame { origin: DVec3::new(100.0, -20.0, 3.0), scale: 4.0 };
    segwild_scene::Export { frame: &frame, antialias: false, extra: &[], provenance: None }
        .write(&path, &s)
        .unwrap();
    let (head, beside) = header_and_offset(&path);
    assert!(!head.contains("offset") && beside.is_none(), "{head}");
}

#[test]
fn an_export_names_its_render_mode_and_is_else_as_before() {
    let dir = tempfile::tempdir().unwrap();
    let (path, plain) = (dir.path().join("a.ply"), dir.path().join("b.ply"));
    let (s, frame) = (splats(7, 2), SceneFrame { origin: DVec3::new(1.0, 2.0, 3.0), scale: 2.5 });
    ply::write_with(&plain, &s.to_file_frame(&frame), &[("label", &[1; 7])]).unwrap();
    let plain = std::fs::read(&plain).unwrap();
    for (antialias, mode) in [(true, "mip"), (false, "default")] {
        segwild_scene::Export { frame: &frame, antialias, extra: &[("label", &[1; 7])], provenance: None }
            .write(&path, &s)
            .unwrap();
        let comment = format!("comment SplatRenderMode: {mode}\n");
        let (head, _) = header_and_offset(&path);
        assert_eq!(head.matches("comment").count(), 1);
        assert!(head.contains(&comment), "{head}");
        let written = std::fs::read(&path).unwrap();
        let (at, of) = (head.find(&comment).unwrap(), comment.len());
        assert!([&written[..at], &written[at + of..]].concat() == plain);
    }
}

#[test]
fn an_export_holds_how_it_was_made_and_reads_as_without() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.ply");
    let (s, frame) = (splats(7, 2), SceneFrame { origin: DVec3::new(1.0, 2.0, 3.0), scale: 2.5 });
    // A line of its own would be part of the header.
    let made_by = serde_json::json!({
        "version": "1.2.3",
        "scene": "two words\nelement vertex 9",
        "settings": { "train": { "steps": 7 } },
    });
    let export =
        |provenance| segwild_scene::Export { frame: &frame, antialias: true, extra: &[], provenance };
    export(None).write(&path, &s).unwrap();
    let without = ply::read(&path).unwrap();
    export(Some(&made_by)).write(&path, &s).unwrap();
    let (head, _) = header_and_offset(&path);
    let line = "\ncomment segwild version=1.2.3 scene=two_words_element_vertex_9\nelement vertex 7\n";
    assert!(head.contains(line), "{head}");
    assert!(ply::read(&path).unwrap() == without);
    let glb = export(Some(&made_by)).encode(segwild_scene::SplatFormat::Glb, &s).unwrap();
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    let document: serde_json::Value = serde_json::from_slice(&glb[20..20 + length]).unwrap();
    assert_eq!(document["asset"]["extras"]["provenance"], made_by);
    assert_eq!(document["asset"]["extras"]["SplatRenderMode"], "mip");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn undistorting_undoes_distorting(lens in lens(), x in 0.0..640.0f64, y in 0.0..480.0f64) {
        // From the photo to the pinhole and back: exact wherever an answer is given.
        if let Some(p) = lens.undistort([x, y]) {
            let back = lens.distort(p).expect("an undistorted pixel can be distorted");
            prop_assert!((back[0] - x).abs() < 1e-5 && (back[1] - y).abs() < 1e-5, "{back:?}");
        }
        // And near the middle there always is one, the same way round.
        let near = [320.0 + (x - 320.0) * 0.2, 240.0 + (y - 240.0) * 0.2];
        let bent = lens.distort(near).expect("the middle is photographed");
        let back = lens.undistort(bent).expect("the middle can be undistorted");
        prop_assert!((back[0] - near[0]).abs() < 1e-5 && (back[1] - near[1]).abs() < 1e-5, "{back:?}");
    }

    #[test]
    fn no_bytes_make_a_reader_panic(bytes in prop::collection::vec(any::<u8>(), 0..400), cut in 0usize..400) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.ply");
        ply::write(&path, &splats(2, 0)).unwrap();
        let mut file = std::fs::read(&path).unwrap();
        let at = cut.min(file.len());
        let end = (at + bytes.len() / 20).min(file.len());
        file.splice(at..end, bytes.iter().copied().take(20));
        std::fs::write(&path, &file).unwrap();
        let _ = ply::read(&path);
        for name in ["cameras", "images", "points3D"] {
            std::fs::write(dir.path().join(format!("{name}.bin")), &bytes).unwrap();
        }
        let _ = colmap::read(dir.path());
        let _ = crate::common::open(dir.path());
    }
}
