//! What a scene folder can hold, good and bad.

use crate::common::{SIZE, line, open, test_image, write, write_photo};
use glam::Vec3;
use segwild_scene::colmap::{self, CameraModel, CameraRecord};
use segwild_scene::settings::Group;
use segwild_scene::{HoldOut, Mask, Scene, SceneError, SceneSettings, Seal, Skipped};
use std::path::Path;

fn temp() -> tempfile::TempDir {
    tempfile::tempdir().unwrap()
}

fn reason<'a>(skipped: &'a [Skipped], name: &str) -> &'a str {
    &skipped
        .iter()
        .find(|s| s.name == name)
        .unwrap_or_else(|| panic!("{name} is not skipped: {skipped:?}"))
        .reason
}

fn message(result: Result<Scene, SceneError>) -> String {
    result.expect_err("this scene must be refused").to_string()
}

#[test]
fn the_frame_is_the_documented_one_and_leads_back_to_the_file() {
    let dir = temp();
    write(dir.path(), &line(5));
    let scene = open(dir.path()).unwrap();
    // Cameras at x = 0, .25, .5, .75, 1.
    assert!((scene.frame.origin.x - 0.5).abs() < 1e-12 && (scene.frame.scale - 0.55).abs() < 1e-12);
    for (i, view) in scene.views.iter().enumerate() {
        let file = view.pose.centre().as_dvec3() * scene.frame.scale + scene.frame.origin;
        assert!((file.x - 0.25 * i as f64).abs() < 1e-6 && file.y.abs() < 1e-6 && file.z.abs() < 1e-6);
        assert!(!view.test);
    }
    for point in &scene.points {
        assert_eq!(point.track.len(), 5);
        for o in &point.track {
            let view = &scene.views[o.view as usize];
            assert!(view.camera.pixel(view.pose.to_camera(point.position)).distance(o.pixel.into()) < 1e-4);
        }
    }
}

#[test]
fn units_a_thousand_times_larger_give_the_same_scene() {
    let (small, large) = (temp(), temp());
    let mut reconstruction = line(4);
    write(small.path(), &reconstruction);
    for image in &mut reconstruction.images {
        image.translation = image.translation.map(|v| v * 1000.0);
    }
    for point in &mut reconstruction.points {
        point.position = point.position.map(|v| v * 1000.0);
    }
    write(large.path(), &reconstruction);
    let (a, b) = (open(small.path()).unwrap(), open(large.path()).unwrap());
    assert!((b.frame.scale / a.frame.scale - 1000.0).abs() < 1e-9);
    for (a, b) in a.views.iter().zip(&b.views) {
        assert!(
            (a.pose.translation - b.pose.translation).length() < 1e-6 && a.pose.rotation == b.pose.rotation
        );
    }
    for (a, b) in a.points.iter().zip(&b.points) {
        assert!((a.position - b.position).length() < 2e-6 && a.track == b.track);
    }
}

#[test]
fn every_folder_and_both_forms_are_found() {
    let reconstruction = line(3);
    let mut scenes = Vec::new();
    for (folder, images) in [
        ("sparse/0", "images"),
        ("sparse", "images"),
        ("dense/sparse", "dense/images"),
        (".", "images"),
        (".", "."),
    ] {
        for text in [false, true] {
            let dir = temp();
            let to = dir.path().join(folder);
            if text { colmap::write_text(&to, &reconstruction) } else { colmap::write(&to, &reconstruction) }
                .unwrap();
            for image in &reconstruction.images {
                std::fs::create_dir_all(dir.path().join(images)).unwrap();
                test_image(SIZE.0, SIZE.1).write_png(&dir.path().join(images).join(&image.name)).unwrap();
            }
            let mut scene = open(dir.path()).unwrap();
            for view in &mut scene.views {
                view.photo.path.clear();
                view.photo.seal = Seal::default();
            }
            scenes.push(scene);
        }
    }
    assert!(scenes.iter().all(|s| *s == scenes[0]));
    // The reconstruction's own folder may be named, too.
    let dir = temp();
    write(dir.path(), &reconstruction);
    assert_eq!(open(&dir.path().join("sparse/0")).unwrap().views.len(), 3);
}

#[test]
fn photos_that_cannot_be_used_are_skipped_with_the_reason() {
    let dir = temp();
    let mut r = line(18);
    r.cameras.push(CameraRecord { id: 100, params: vec![-5.0, 50.0, 20.0, 15.0], ..r.cameras[0].clone() });
    r.cameras.push(CameraRecord {
        id: 8,
        model: CameraModel::RadTanThinPrismFisheye,
        params: vec![1.0; 16],
        ..r.cameras[0].clone()
    });
    r.cameras.push(CameraRecord { id: 9, width: 30, height: 40, ..r.cameras[0].clone() });
    r.cameras.push(CameraRecord { id: 10, width: 0, ..r.cameras[0].clone() });
    r.cameras.push(CameraRecord { id: 11, width: u64::MAX, ..r.cameras[0].clone() });
    r.cameras.push(CameraRecord { id: 12, params: vec![50.0, f64::NAN, 20.0, 15.0], ..r.cameras[0].clone() });
    r.images[0].rotation[2] = f64::NAN;
    r.images[1].rotation = [0.0; 4];
    r.images[2].translation[0] = f64::INFINITY;
    for (image, camera) in [(3, 100), (4, 8), (5, 9), (6, 10), (7, 11), (8, 12), (9, 55)] {
        r.images[image].camera_id = camera;
    }
    r.images[11].name = r.images[10].name.clone();
    r.images[12].name = "../outside.png".into();
    r.images[13].name = "unter ordner/Straße 東京.png".into();
    r.images[14].id = r.images[13].id;
    write(dir.path(), &r);
    std::fs::remove_file(dir.path().join("images/photo15.png")).unwrap();
    std::fs::write(dir.path().join("images/photo16.png"), b"this is no image").unwrap();
    r.points[0].position[1] = f64::NAN;
    r.points[1].track.retain(|t| t.0 < 103);
    r.points[2].track.clear();
    colmap::write(&dir.path().join("sparse/0"), &r).unwrap();

    let scene = open(dir.path()).unwrap();
    let names: Vec<&str> = scene.views.iter().map(|v| v.name.as_str()).collect();
    assert_eq!(names, ["photo10.png", "photo17.png", "unter ordner/Straße 東京.png"]);
    for (i, words) in [
        (0, "not finite"),
        (1, "quaternion"),
        (2, "not finite"),
        (3, "focal length -5"),
        (4, "RAD_TAN_THIN_PRISM_FISHEYE"),
        (5, "40 x 30"),
        (6, "0 x 30"),
        (7, "18446744073709551615"),
        (8, "NaN"),
        (9, "no camera 55"),
        (10, "same name"),
        (14, "image id 113"),
        (15, "no file"),
        (16, "does not decode"),
    ] {
        let text = reason(&scene.skipped, &format!("photo{i:02}.png"));
        assert!(text.contains(words), "photo {i}: {text}");
    }
    assert!(reason(&scene.skipped, "../outside.png").contains("inside the photo folder"));
    assert_eq!(scene.views.len() + scene.skipped.len(), 18);
    // The NaN point and the one that only skipped photos saw are gone; the one without a track is kept.
    let tracks: Vec<usize> = scene.points.iter().map(|p| p.track.len()).collect();
    assert_eq!(tracks, [0, 3]);
    assert!(scene.points.iter().flat_map(|p| &p.track).all(|o| o.view < 3));
    assert_eq!(scene.view_named("Straße 東京"), Some(2));
}

#[test]
fn one_photo_is_a_scene_with_or_without_points() {
    let dir = temp();
    let mut r = line(1);
    write(dir.path(), &r);
    let scene = open(dir.path()).unwrap();
    assert!(scene.views[0].pose.centre().length() < 1e-6);
    // The scale is the points' median distance.
    let mut far: Vec<f32> = scene.points.iter().map(|p| p.position.length()).collect();
    far.sort_by(f32::total_cmp);
    assert!((far[2] - 1.0).abs() < 1e-6, "{far:?}");

    r.points.clear();
    colmap::write(&dir.path().join("sparse/0"), &r).unwrap();
    assert_eq!(open(dir.path()).unwrap().frame.scale, 1.0);
    std::fs::remove_file(dir.path().join("sparse/0/points3D.bin")).unwrap();
    assert_eq!(open(dir.path()).unwrap().points.len(), 0);

    r.images[0].rotation = [f64::NAN; 4];
    colmap::write(&dir.path().join("sparse/0"), &r).unwrap();
    let text = message(open(dir.path()));
    assert!(
        text.contains("photo00.png") && text.contains("not finite") && text.contains("sparse/0"),
        "{text}"
    );
}

#[test]
fn a_file_cut_anywhere_is_refused_with_name_record_and_byte() {
    let dir = temp();
    write(dir.path(), &line(3));
    for (file, what) in [("cameras.bin", "camera"), ("images.bin", "image"), ("points3D.bin", "point")] {
        let path = dir.path().join("sparse/0").join(file);
        let whole = std::fs::read(&path).unwrap();
        for cut in 0..whole.len() {
            std::fs::write(&path, &whole[..cut]).unwrap();
            let error = open(dir.path()).expect_err("cut");
            let SceneError::Truncated { record, offset, .. } = &error else {
                panic!("{file} cut at {cut}: {error}")
            };
            assert!(*offset <= cut as u64 && (cut < 8 || record.starts_with(what)), "{error}");
            assert!(error.to_string().contains(file));
        }
        // Too much is damage, too; and a count is believed only as far as records follow.
        std::fs::write(&path, [&whole[..], b"xy"].concat()).unwrap();
        assert!(message(open(dir.path())).contains("2 bytes follow"));
        let mut absurd = whole.clone();
        absurd[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        std::fs::write(&path, &absurd).unwrap();
        assert!(message(open(dir.path())).contains("of 18446744073709551615"));
        std::fs::write(&path, &whole).unwrap();
    }
    // The count of keypoints inside an image and the number of a camera model.
    let path = dir.path().join("sparse/0/images.bin");
    let whole = std::fs::read(&path).unwrap();
    let name = whole.windows(4).position(|w| w == b".png").unwrap();
    let mut absurd = whole.clone();
    absurd[name + 5..name + 13].copy_from_slice(&(u64::MAX / 24 + 2).to_le_bytes());
    std::fs::write(&path, &absurd).unwrap();
    assert!(message(open(dir.path())).contains("image 1 of 3"));
    std::fs::write(&path, &whole).unwrap();
    let path = dir.path().join("sparse/0/cameras.bin");
    let mut cameras = std::fs::read(&path).unwrap();
    cameras[12] = 99;
    std::fs::write(&path, &cameras).unwrap();
    assert!(message(open(dir.path())).contains("model number 99"));
}

#[test]
fn bad_text_is_refused_with_its_line() {
    let dir = temp();
    let to = dir.path().join("sparse/0");
    colmap::write_text(&to, &line(2)).unwrap();
    for (file, from, with, line, words) in [
        ("cameras.txt", " 20 15", "", 2, "ends before"),
        ("images.txt", "100 1 0", "100 1 zero", 3, "`zero` is no quaternion"),
        ("points3D.txt", "10 20 30", "10 20 300", 2, "`300` is no colour"),
    ] {
        let path = to.join(file);
        let good = std::fs::read_to_string(&path).unwrap();
        assert!(good.contains(from), "{good}");
        std::fs::write(&path, good.replacen(from, with, 1)).unwrap();
        let text = message(open(dir.path()));
        assert!(
            text.contains(file) && text.contains(&format!("line {line}")) && text.contains(words),
            "{text}"
        );
        std::fs::write(&path, good).unwrap();
    }
}

#[test]
fn an_endless_word_of_a_text_file_is_not_quoted_whole() {
    let dir = temp();
    let to = dir.path().join("sparse/0");
    colmap::write_text(&to, &line(2)).unwrap();
    std::fs::write(to.join("cameras.txt"), "9".repeat(1 << 20)).unwrap();
    let text = message(open(dir.path()));
    assert!(text.contains("999...` is no camera id") && text.len() < 1_000, "{} bytes", text.len());
}

#[test]
fn a_folder_without_a_scene_says_what_was_looked_for() {
    let dir = temp();
    let text = message(open(dir.path()));
    assert!(
        text.contains("cameras") && text.contains("sparse/0") && text.contains("transforms.json"),
        "{text}"
    );
    let text = message(open(&dir.path().join("nowhere")));
    assert!(text.contains("nowhere"), "{text}");
    // A reconstruction without its photos.
    colmap::write(&dir.path().join("sparse/0"), &line(2)).unwrap();
    let text = message(open(dir.path()));
    assert!(
        text.contains("none of the 2 photos") && text.contains("photo00.png") && text.contains("`images`"),
        "{text}"
    );
    colmap::write(&dir.path().join("sparse/0"), &colmap::Reconstruction::default()).unwrap();
    assert!(message(open(dir.path())).contains("no photo"));
}

#[test]
fn settings_choose_folders_and_photos() {
    let dir = temp();
    write(dir.path(), &line(6));
    let with = |change: &dyn Fn(&mut SceneSettings)| {
        let mut settings = SceneSettings::default();
        change(&mut settings);
        Scene::open(dir.path(), &settings)
    };
    let tests = |scene: &Scene| scene.views.iter().map(|v| v.test).collect::<Vec<_>>();
    assert_eq!(
        tests(&with(&|s| s.hold_out = HoldOut::Every(4)).unwrap()),
        [true, false, false, false, true, false]
    );
    assert!(message(with(&|s| s.hold_out = HoldOut::Every(1))).contains("hold_out"));
    assert!(!tests(&with(&|_| {}).unwrap()).contains(&true), "six photos are too few to hold any out");
    assert!(message(with(&|s| s.images = "nowhere".into())).contains("nowhere"));
    assert!(message(with(&|s| s.size = 0)).contains("size"));

    // A split found by itself: no id, no row, no photo.
    let rows = "filename\tid\tsplit\tdataset\nphoto00.png\t1.0\ttest\tx\nphoto01.png\t2.0\ttrain\tx\n\
                photo02.png\t\ttrain\tx\nphoto03.png\t3.0\ttrain\tx\nother.jpg\t4.0\ttrain\tx\n";
    std::fs::write(dir.path().join("x.tsv"), rows).unwrap();
    let scene = with(&|_| {}).unwrap();
    assert_eq!(tests(&scene), [true, false, false]);
    assert!(reason(&scene.skipped, "photo02.png").contains("no id"));
    assert!(reason(&scene.skipped, "photo05.png").contains("not listed"));
    assert!(reason(&scene.skipped, "other.jpg").contains("no pose"));
    assert_eq!(tests(&with(&|s| s.hold_out = HoldOut::Every(2)).unwrap()), [true, false, true]);
    std::fs::write(dir.path().join("y.tsv"), rows).unwrap();
    assert!(message(with(&|_| {})).contains("x.tsv"));
    assert!(message(with(&|s| s.split = "z.tsv".into())).contains("z.tsv"));
    std::fs::write(dir.path().join("y.tsv"), rows.replace("\ttest", "\tteset")).unwrap();
    let text = message(with(&|s| s.split = "y.tsv".into()));
    assert!(text.contains("y.tsv") && text.contains("line 2") && text.contains("teset"), "{text}");
}

/// Writes a `transforms.json` of the cameras of `line(n)`, the way nerfstudio does: OpenGL, camera to world.
fn write_transforms(dir: &Path, frames: &[(&str, f64)], head: &str) {
    let frames: Vec<String> = frames
        .iter()
        .map(|(file, x)| {
            format!(r#"{{"file_path": "{file}", "transform_matrix": [[1,0,0,{x}],[0,-1,0,0],[0,0,-1,0],[0,0,0,1]]}}"#)
        })
        .collect();
    let text = format!("{{{head} \"frames\": [{}]}}", frames.join(",\n"));
    std::fs::write(dir.join("transforms.json"), text).unwrap();
}

const INTRINSICS: &str = r#""fl_x": 50, "fl_y": 50.0, "cx": 20, "cy": 15, "w": 40, "h": 30,"#;

#[test]
fn transforms_json_is_the_same_scene() {
    let (by_colmap, dir) = (temp(), temp());
    write(by_colmap.path(), &line(3));
    for i in 0..3 {
        write_photo(dir.path(), &format!("photo{i:02}.png"));
    }
    let ply = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
               property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0 0 5 10 20 30\n";
    std::fs::write(dir.path().join("points 1.ply"), ply).unwrap();
    let head =
        format!(r#""camera_model": "OPENCV", "k1": 0.0, "ply_file_path": "points 1.ply", {INTRINSICS}"#);
    // With an ending, without one, and by a roundabout path.
    let files = [("./images/photo00.png", 0.0), ("images/photo01", 0.25), ("images/photo02.png", 0.5)];
    write_transforms(dir.path(), &files, &head);
    let (a, b) = (open(by_colmap.path()).unwrap(), open(dir.path()).unwrap());
    assert_eq!(b.skipped, []);
    for (a, b) in a.views.iter().zip(&b.views) {
        assert_eq!((&a.name, a.camera, &b.photo.lens), (&b.name, b.camera, &None));
        assert!((a.pose.translation - b.pose.translation).length() < 1e-6);
        assert!(
            (a.pose.rotation.to_cols_array().iter().zip(b.pose.rotation.to_cols_array()))
                .all(|(a, b)| (a - b).abs() < 1e-6)
        );
    }
    assert!((b.points[0].position - a.points[0].position).length() < 1e-5 && b.points[0].track.is_empty());
    assert_eq!(b.views[0].pose.rotation * Vec3::Z, Vec3::Z);
    assert_eq!(open(&dir.path().join("transforms.json")).unwrap(), b);
}

#[test]
fn black_pixels_of_a_frames_mask_path_are_not_used() {
    let dir = temp();
    ["a.png", "b.png", "c.png"].iter().for_each(|name| write_photo(dir.path(), name));
    std::fs::create_dir(dir.path().join("masks")).unwrap();
    // At half the size: black on the left.
    Mask::from_fn(20, 15, |x, _| x >= 5).write_png(&dir.path().join("masks/a.png")).unwrap();
    let frame = |name: &str, x: u32, mask: &str| {
        let pose = format!("[[1,0,0,{x}],[0,-1,0,0],[0,0,-1,0],[0,0,0,1]]");
        format!(r#"{{"file_path": "images/{name}.png", {mask} "transform_matrix": {pose}}}"#)
    };
    let [masked, lost] = ["a", "lost"].map(|m| format!(r#""mask_path": "masks/{m}.png","#));
    let frames = [frame("a", 0, &masked), frame("b", 1, ""), frame("c", 2, &lost)];
    let text = format!("{{{INTRINSICS} \"frames\": [{}]}}", frames.join(","));
    std::fs::write(dir.path().join("transforms.json"), text).unwrap();
    let scene = open(dir.path()).unwrap();
    let valid = |i: usize| scene.views[i].load(40).unwrap().valid;
    assert_eq!(valid(0), Some(Mask::from_fn(40, 30, |x, _| x >= 10)));
    assert_eq!(valid(1), None);
    let text = reason(&scene.skipped, "c.png");
    assert!(text.contains("lost.png") && text.contains("mask"), "{text}");
}

#[test]
fn frames_of_transforms_json_that_cannot_be_used_are_skipped() {
    let dir = temp();
    for name in ["a.png", "b.png", "c.png", "d.png", "e.png", "g.png"] {
        write_photo(dir.path(), name);
    }
    let text = r#"{"camera_angle_x": 0.7610, "frames": [
        {"file_path": "images/a", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]},
        {"file_path": "images/b", "transform_matrix": [[NaN,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]},
        {"file_path": "images/c", "transform_matrix": [[1,0,0,0],[0,1,0,0]]},
        {"file_path": "images/d", "transform_matrix": [[0,0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,1]]},
        {"file_path": "images/e", "camera_model": "EQUIRECTANGULAR", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0]]},
        {"file_path": "images/missing", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]},
        {"file_path": "images/g", "fl_x": 70, "transform_matrix": [[1,0,0,1],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}"#;
    std::fs::write(dir.path().join("transforms.json"), text).unwrap();
    let scene = open(dir.path()).unwrap();
    assert_eq!(scene.views.iter().map(|v| v.name.as_str()).collect::<Vec<_>>(), ["a.png", "g.png"]);
    // 20 / tan(0.3805) for the frame without its own.
    assert!((scene.views[0].camera.fx - 50.0).abs() < 0.05 && scene.views[1].camera.fy == 70.0);
    for (name, words) in [
        ("b.png", "not finite"),
        ("c.png", "4 x 4"),
        ("d.png", "not a rotation"),
        ("e.png", "EQUIRECTANGULAR"),
        ("missing", "no file"),
    ] {
        let text = reason(&scene.skipped, name);
        assert!(text.contains(words), "{name}: {text}");
    }
    std::fs::write(dir.path().join("transforms.json"), &text[..200]).unwrap();
    let text = message(open(dir.path()));
    assert!(text.contains("transforms.json") && text.contains("line"), "{text}");
}

#[test]
fn odd_points_are_noted() {
    let dir = tempfile::tempdir().unwrap();
    let mut reconstruction = line(3);
    reconstruction.points[0].position[1] = f64::NAN;
    reconstruction.points[1].track.clear();
    write(dir.path(), &reconstruction);
    let notes = open(dir.path()).unwrap().notes.join("\n");
    assert!(notes.contains("1 of 4 points lie nowhere") && notes.contains("sparse/0"), "{notes}");
    assert!(notes.contains("1 of 4 points name no photo"), "{notes}");

    let dir = tempfile::tempdir().unwrap();
    let mut reconstruction = line(1);
    reconstruction.points.clear();
    reconstruction.images[0].keypoints.clear();
    write(dir.path(), &reconstruction);
    let notes = open(dir.path()).unwrap().notes.join("\n");
    assert!(notes.contains("there are no points") && notes.contains("there is one photo"), "{notes}");

    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &line(3));
    assert_eq!(open(dir.path()).unwrap().notes, [""; 0], "nothing is odd");
}

#[test]
fn one_camera_of_an_unknown_model_does_not_cost_the_others() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &line(3));
    let sparse = dir.path().join("sparse/0");
    std::fs::remove_dir_all(&sparse).unwrap();
    std::fs::create_dir_all(&sparse).unwrap();
    let text = |name: &str, text: &str| std::fs::write(sparse.join(name), text).unwrap();
    text("cameras.txt", "7 PINHOLE 40 30 50 50 20 15\n8 EQUIRECTANGULAR 40 30\n");
    text(
        "images.txt",
        "1 1 0 0 0 0 0 0 7 photo00.png\n\n2 1 0 0 0 -0.2 0 0 7 photo01.png\n\n3 1 0 0 0 -0.4 0 0 8 photo02.png\n\n",
    );
    text("points3D.txt", "1 0 0 5 9 9 9 0.5\n");
    let scene = open(dir.path()).unwrap();
    assert_eq!((scene.views.len(), scene.skipped.len()), (2, 1));
    let reason = &scene.skipped[0].reason;
    assert!(reason.contains("camera 8 has the model EQUIRECTANGULAR"), "{reason}");
}

#[test]
fn a_lens_that_folds_the_photo_over_is_not_trained_with() {
    let dir = temp();
    let mut reconstruction = line(3);
    let camera = &mut reconstruction.cameras[0];
    (camera.model, camera.params) = (CameraModel::SimpleRadial, vec![50.0, 20.0, 15.0, -5.0]);
    write(dir.path(), &reconstruction);
    let words = message(open(dir.path()));
    assert!(words.contains("its lens cannot be right") && words.contains("can be filled"), "{words}");
    // A lens as they are is no such thing.
    reconstruction.cameras[0].params[3] = -0.2;
    write(dir.path(), &reconstruction);
    assert_eq!(open(dir.path()).unwrap().views.len(), 3);
}

#[test]
fn points_that_are_not_where_transforms_json_says_do_not_cost_the_scene() {
    let dir = temp();
    write_photo(dir.path(), "photo00.png");
    let head = format!(r#""ply_file_path": "sparse_pc.ply", {INTRINSICS}"#);
    write_transforms(dir.path(), &[("images/photo00.png", 0.0)], &head);
    let scene = open(dir.path()).unwrap();
    assert_eq!((scene.views.len(), scene.points.len()), (1, 0));
    assert!(scene.notes.iter().any(|n| n.contains("sparse_pc.ply, which is not there")), "{:?}", scene.notes);
}

#[test]
fn masks_that_ignore_everything_are_refused_before_anything_is_computed() {
    let dir = temp();
    write(dir.path(), &line(2));
    std::fs::create_dir(dir.path().join("masks")).unwrap();
    let all = |name: &str, mask: Mask| mask.write_png(&dir.path().join("masks").join(name)).unwrap();
    all("photo00.png", Mask::full(40, 30));
    all("photo01.png", Mask::full(40, 30));
    let settings = SceneSettings { ignore: "masks".into(), ..SceneSettings::default() };
    let words = message(Scene::open(dir.path(), &settings));
    assert!(words.contains("leave nothing of any photo") && words.contains("photo00.png"), "{words}");
    all("photo01.png", Mask::from_fn(40, 30, |x, _| x > 0));
    assert_eq!(Scene::open(dir.path(), &settings).unwrap().views.len(), 2);
}

/// So many photos that are not there must not take minutes.
const MANY: u32 = 200_000;

#[test]
fn two_hundred_thousand_missing_photos_take_seconds() {
    let dir = temp();
    let mut r = line(3);
    write(dir.path(), &r);
    let lost = |i: u32| colmap::ImageRecord {
        id: 1000 + i,
        name: format!("lost{i}.png"),
        keypoints: vec![],
        camera_id: if i < MANY / 2 { 7 } else { i + 10 },
        ..r.images[0].clone()
    };
    let lost: Vec<_> = (0..MANY).map(lost).collect();
    r.images.extend(lost);
    // One point that all of them saw.
    r.points[0].track.extend((0..MANY).map(|i| (1000 + i, 0)));
    colmap::write(&dir.path().join("sparse/0"), &r).unwrap();
    let rows: String = (0..MANY).map(|i| format!("gone{i}.png\n")).collect();
    std::fs::write(dir.path().join("test_list.txt"), format!("photo00.png\n{rows}")).unwrap();
    let began = std::time::Instant::now();
    let scene = open(dir.path()).unwrap();
    let words = Skipped::in_words(&scene.skipped);
    assert_eq!((scene.views.len(), scene.skipped.len()), (3, 2 * MANY as usize));
    assert!(words.len() < 10, "one reason, one sentence: {}", words.len());
    assert!((0..2000).all(|_| scene.view_named("nobody").is_none()));
    // A few seconds of computing; the machine may have other work.
    assert!(began.elapsed().as_secs() < 60, "{:?}", began.elapsed());
}

#[test]
fn two_hundred_thousand_missing_frames_of_transforms_json_take_seconds() {
    let dir = temp();
    write_photo(dir.path(), "photo00.png");
    let names: Vec<String> = (0..MANY).map(|i| format!("images/lost{i}.png")).collect();
    let mut frames = vec![("images/photo00.png", 0.0)];
    frames.extend(names.iter().map(|name| (name.as_str(), 1.0)));
    write_transforms(dir.path(), &frames, INTRINSICS);
    let began = std::time::Instant::now();
    let scene = open(dir.path()).unwrap();
    assert_eq!((scene.views.len(), scene.skipped.len()), (1, MANY as usize));
    assert!(Skipped::in_words(&scene.skipped).len() < 10);
    assert!(began.elapsed().as_secs() < 60, "{:?}", began.elapsed());
}

#[test]
fn a_person_may_name_a_photo_as_another_system_does() {
    let dir = temp();
    let mut r = line(3);
    r.images[0].name = "cam 0/IMG_1.PNG".into();
    write(dir.path(), &r);
    let scene = open(dir.path()).unwrap();
    for name in ["cam 0/IMG_1.PNG", r"cam 0\img_1.png", "IMG_1", "img_1.png"] {
        assert_eq!(scene.view_named(name), Some(0), "{name}");
    }
    assert_eq!(scene.view_named("photo"), None);
}

#[test]
fn without_a_split_one_of_sixteen_photos_is_held_out_unless_all_are_wanted() {
    let dir = temp();
    write(dir.path(), &line(33));
    let open = |hold_out: &str| {
        let mut settings = SceneSettings::default();
        settings.set("hold_out", hold_out).unwrap();
        // What is written is read again.
        let text = serde_json::to_string(&settings).unwrap();
        assert_eq!(serde_json::from_str::<SceneSettings>(&text).unwrap(), settings);
        Scene::open(dir.path(), &settings).unwrap()
    };
    let held_out =
        |scene: &Scene| -> Vec<usize> { (0..scene.views.len()).filter(|&i| scene.views[i].test).collect() };
    let reported = |scene: &Scene| scene.notes.iter().any(|note| note.contains("--hold-out none"));
    let few = open("auto");
    assert_eq!(held_out(&few), [8, 24]);
    assert!(reported(&few), "{:?}", few.notes);
    for all in ["none", "0"] {
        let all = open(all);
        assert!(held_out(&all).is_empty() && !reported(&all), "{:?}", all.notes);
    }
    assert_eq!(held_out(&open("16")), [0, 16, 32]);
    let mut settings = SceneSettings::default();
    assert!(settings.set("hold_out", "some").unwrap_err().to_string().contains("auto or none"));
}
