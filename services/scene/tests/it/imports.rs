//! Splats of other programs, as their files hold them.

use glam::Mat3;
use segwild_scene::{SplatFile, SplatLayout, Splats, UpAxis, ply};
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
    let by = SplatFile::open(&file("six.compressed.ply")).unwrap().writer.program;
    assert_eq!(by.as_deref(), Some("splat-transform 2.7.1"));
}

#[test]
fn packed_files_that_are_cut_or_changed_are_refused_in_words() {
    let dir = tempfile::tempdir().unwrap();
    for name in ["six.compressed.ply", "six-v3.spz", "six-v4.spz"] {
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
        let at = whole.windows(8).position(|w| w == b"vertex 6").map_or(8, |at| at + 7);
        let mut more = whole.clone();
        more[at] = b'9';
        if name != "six-v3.spz" {
            refused(&more).expect_err("there are six");
        }
    }
    for (bytes, words) in [
        (&b"PK\x03\x04 and more"[..], "splat-transform"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "a cloud of points"),
        (b"\x1f\x8b and no gzip", "cannot be unpacked"),
    ] {
        let path = dir.path().join("strange.sog");
        std::fs::write(&path, bytes).unwrap();
        let message = SplatFile::open(&path).unwrap_err().to_string();
        assert!(message.contains(words) && message.contains("strange.sog"), "{message}");
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

#[test]
fn the_programs_that_wrote_a_file_are_recognised() {
    let dir = tempfile::tempdir().unwrap();
    let tail = "f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    let rows = ["0 0 1 0 0 0 0 -3 -3 -3 1 0 0 0"; 2];
    let of = |comments: &str, properties: &str, rows: [&str; 2]| {
        SplatFile::open(&written(dir.path(), comments, properties, rows)).unwrap().writer
    };
    let cases = [
        (
            "comment Exported from Brush\ncomment Vertical axis: y\ncomment SplatRenderMode: mip\n",
            "Brush",
            Some(UpAxis::MinusY),
            Some(true),
        ),
        (
            "comment Generated by Nerstudio 1.1.5\ncomment Vertical Axis: z\n",
            "Nerstudio 1.1.5",
            Some(UpAxis::Z),
            None,
        ),
        ("comment antialiased 1\n", "Postshot", None, Some(true)),
        ("obj_info {\"lichtfeld_provenance\":1}\n", "LichtFeld Studio", None, None),
        ("comment SplatRenderMode: default\n", "gsplat, or in its layout", None, Some(false)),
    ];
    for (comments, program, up, antialias) in cases {
        let writer = of(comments, &format!("x y z {tail}"), rows);
        assert_eq!(writer.program.as_deref(), Some(program));
        assert_eq!((writer.up, writer.antialias), (up, antialias), "{program}");
    }
    let inria = of("", &format!("x y z nx ny nz {tail}"), ["0 0 1 0 0 0 0 0 0 0 -3 -3 -3 1 0 0 0"; 2]);
    assert_eq!(inria.program.as_deref(), Some("3D Gaussian Splatting, or in its layout"));
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
    // nerfstudio's bytes of colours.
    let plain = "x y z nx ny nz red green blue opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    let plain = read(&written(dir.path(), "", plain, ["0 0 1 0 0 0 255 0 51 0 0 0 0 1 0 0 0"; 2]));
    let colour = [0, 1, 2].map(|c| plain.sh[c] * 0.282_094_79 + 0.5);
    assert!((0..3).all(|c| (colour[c] - [1.0, 0.0, 0.2][c]).abs() < 1e-5), "{colour:?}");
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
