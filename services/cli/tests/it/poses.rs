//! Photos without poses, and videos: COLMAP and ffmpeg as a user has them.

use crate::common::*;
use glam::{DMat3, DVec3};
use segwild_scene::{Image, PosedPhotos, Scene, SceneSettings};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Photos of a corner of walls.
const PHOTOS: usize = 12;
/// Enough of them where poses are not all that matters.
const FEW: usize = 8;
const SIZE: (usize, usize) = (320, 240);
const FOCAL: f64 = 300.0;

/// Whether a program is there; says which test is skipped without it.
fn has(program: &str, test: &str) -> bool {
    let found = Command::new(program).arg("-h").output().is_ok();
    if !found {
        eprintln!("skipped: {test}: there is no {program}");
    }
    found
}

/// A number in [0, 1) for a cell of a grid.
fn noise(x: i64, y: i64, layer: i64) -> f64 {
    let mut h =
        (x.wrapping_mul(0x9e37_79b9) ^ y.wrapping_mul(0x85eb_ca6b) ^ layer.wrapping_mul(0xc2b2_ae35)) as u64;
    for _ in 0..3 {
        h = (h ^ (h >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    }
    (h >> 40) as f64 / (1u64 << 24) as f64
}

/// Brightness of a wall at a point: smooth noise of four sizes.
fn wall(u: f64, v: f64, wall: i64) -> f64 {
    let mut sum = 0.0;
    for octave in 0..4 {
        let (u, v) = (u * 4.0 * f64::from(1 << octave), v * 4.0 * f64::from(1 << octave));
        let (i, j) = (u.floor(), v.floor());
        let smooth = |t: f64| t * t * (3.0 - 2.0 * t);
        let (a, b) = (smooth(u - i), smooth(v - j));
        let at = |di: i64, dj: i64| noise(i as i64 + di, j as i64 + dj, 10 * wall + octave);
        let row = |dj: i64| at(0, dj) * (1.0 - a) + at(1, dj) * a;
        sum += row(0) * (1.0 - b) + row(1) * b;
    }
    sum / 4.0
}

/// Where photo `i` was taken: its rotation from world to camera, and its centre.
fn camera(i: usize) -> (DMat3, DVec3) {
    let t = i as f64 / (PHOTOS - 1) as f64 - 0.5;
    let centre = DVec3::new(2.4 * t, -0.5 + 0.5 * (9.0 * t).sin() * 0.4, -0.4 + 0.6 * t.abs());
    let forward = (DVec3::new(-0.3, 0.2, 3.2) - centre).normalize();
    let right = DVec3::Y.cross(forward).normalize();
    (DMat3::from_cols(right, forward.cross(right), forward).transpose(), centre)
}

/// A photo of a corner: a wall ahead, one to the left and the floor.
fn photo(i: usize) -> Image {
    let (rotation, centre) = camera(i);
    let mut image = Image::zeros(SIZE.0, SIZE.1, 3);
    for y in 0..SIZE.1 {
        for x in 0..SIZE.0 {
            let pixel = DVec3::new(
                (x as f64 + 0.5 - SIZE.0 as f64 / 2.0) / FOCAL,
                (y as f64 + 0.5 - SIZE.1 as f64 / 2.0) / FOCAL,
                1.0,
            );
            let ray = rotation.transpose() * pixel;
            let to = |plane: f64, axis: usize| (plane - centre[axis]) / ray[axis];
            let walls = [(4.0, 2, 0, 1), (-2.0, 0, 2, 1), (1.2, 1, 0, 2)];
            let hits = walls.iter().enumerate().map(|(k, &(plane, axis, u, v))| (to(plane, axis), k, u, v));
            let (t, k, u, v) =
                hits.filter(|hit| hit.0 > 0.0).min_by(|a, b| a.0.total_cmp(&b.0)).expect("a wall");
            let point = centre + ray * t;
            let value = wall(point[u], point[v], k as i64) as f32;
            let n = SIZE.0 * SIZE.1;
            for channel in 0..3 {
                let tint = [1.0, 0.85, 0.7][(channel + k) % 3];
                image.data[channel * n + y * SIZE.0 + x] = (value * tint).clamp(0.0, 1.0);
            }
        }
    }
    image
}

/// So many of them, in a folder of their own.
fn photos(folder: &Path, count: usize) -> PathBuf {
    let photos = folder.join("photos");
    std::fs::create_dir(&photos).expect("a folder");
    for i in 0..count {
        photo(i).write_png(&photos.join(format!("{i:02}.png"))).expect("a photo");
    }
    photos
}

/// The scene of photos as a run has posed it.
fn posed(photos: &Path, run: &Path) -> Scene {
    let record: serde_json::Value = json(&std::fs::read(run.join("poses/poses.json")).expect("a record"));
    let number = record["done"]["models"][0]["number"].as_u64().expect("a model");
    let posed = PosedPhotos {
        scene: photos.to_owned(),
        photos: photos.to_owned(),
        model: run.join(format!("poses/models/{number}")),
        unposed: Vec::new(),
        notes: Vec::new(),
    };
    Scene::open_posed(posed, &SceneSettings::default()).expect("a scene")
}

/// Asserts that poses are the true ones, up to where it lies and how large it is.
fn are_the_true_ones(scene: &Scene) {
    let truth: Vec<(DMat3, DVec3)> =
        scene.views.iter().map(|v| camera(v.name[..2].parse().expect("a number"))).collect();
    let found: Vec<(DMat3, DVec3)> = scene
        .views
        .iter()
        .map(|v| {
            let rotation = v.pose.rotation.as_dmat3();
            (rotation, -(rotation.transpose() * v.pose.translation.as_dvec3()))
        })
        .collect();
    let span = |cameras: &[(DMat3, DVec3)]| cameras[0].1.distance(cameras[cameras.len() - 1].1);
    let scale = span(&truth) / span(&found);
    for (t, f) in truth.iter().zip(&found) {
        let turned = (f.0 * found[0].0.transpose()).transpose() * (t.0 * truth[0].0.transpose());
        let angle =
            ((turned.x_axis.x + turned.y_axis.y + turned.z_axis.z - 1.0) / 2.0).clamp(-1.0, 1.0).acos();
        assert!(angle.to_degrees() < 1.0, "a camera is turned by {:.2} degrees", angle.to_degrees());
        let off = (f.1.distance(found[0].1) * scale - t.1.distance(truth[0].1)).abs() / span(&truth);
        assert!(off < 0.02, "a camera is off by {:.1} % of the span of all", 100.0 * off);
    }
}

/// How often COLMAP's log has a command.
fn calls(run: &Path, command: &str) -> usize {
    let log = std::fs::read_to_string(run.join("poses/colmap.log")).expect("a log");
    log.lines().filter(|line| line.starts_with("== ") && line.contains(command)).count()
}

#[test]
fn a_bare_folder_of_photos_becomes_an_object_with_one_command_and_one_click() {
    if !has("colmap", "a_bare_folder_of_photos_becomes_an_object_with_one_command_and_one_click") {
        return;
    }
    let dir = folder();
    let (scene, run) = (photos(dir.path(), PHOTOS), dir.path().join("run"));
    // Too dark to show anything.
    Image::zeros(SIZE.0, SIZE.1, 3).write_png(&scene.join("night.png")).expect("a photo");
    let explained = works(&["run", &show(&scene), "--out", &show(&run), "--explain"]);
    assert!(explained.contains("the photos have no poses yet") && explained.contains("waits for the poses"));
    let mut command = vec!["run".to_owned(), show(&scene), "--out".into(), show(&run)];
    command.extend(QUICK.map(str::to_owned));
    let command: Vec<&str> = command.iter().map(String::as_str).collect();
    let summary = works(&command);
    assert!(summary.contains("12 photos"), "{summary}");
    assert!(
        summary.contains("photo night.png is left out: it has no pose: it shows too little"),
        "{summary}"
    );
    are_the_true_ones(&posed(&scene, &run));

    let trace = std::fs::read_to_string(run.join("trace.json")).expect("a trace");
    for step in ["features of photos", "pairs of photos", "poses and points"] {
        assert!(trace.contains(step), "{step} is not in the trace");
    }
    let status = works(&["status", &show(&run)]);
    assert!(
        status.lines().any(|line| line.trim_start().starts_with("poses") && line.contains("done")),
        "{status}"
    );
    let again = segwild(&command);
    let messages = text(&again.stderr);
    assert!(again.status.success() && messages.contains("poses was done before"), "{messages}");

    // The poses move with the run.
    let moved = dir.path().join("moved");
    std::fs::rename(&run, &moved).expect("a rename");
    let (photo, pixel) = ("05.png", "160,150");
    works(&["segment", &show(&moved), "--photo", photo, "--positive", pixel, "--name", "wall"]);
    let exported = moved.join("selections/wall/object.ply");
    assert!(exported.is_file(), "{:?}", std::fs::read_dir(moved.join("selections/wall")).map(|d| d.count()));
}

#[test]
fn poses_that_were_interrupted_go_on_and_a_further_photo_is_added_to_them() {
    if !has("colmap", "poses_that_were_interrupted_go_on_and_a_further_photo_is_added_to_them") {
        return;
    }
    let dir = folder();
    let (scene, run) = (photos(dir.path(), FEW), dir.path().join("run"));
    let last = scene.join("07.png");
    std::fs::rename(&last, dir.path().join("kept.png")).expect("a rename");
    let command = ["run", &show(&scene), "--out", &show(&run), "--until", "poses"];
    let mut child = in_background(&command);
    until("the comparison of photos", || {
        (run.join("poses").is_dir() && calls_or_none(&run) > 0).then_some(())
    });
    child.0.kill().expect("it runs");
    child.0.wait().expect("it ends");
    let explained = works(&["run", &show(&scene), "--out", &show(&run), "--until", "poses", "--explain"]);
    assert!(explained.contains("it was interrupted"), "{explained}");
    works(&command);
    assert_eq!(calls(&run, "feature_extractor"), 1, "features are kept");
    are_the_true_ones(&posed(&scene, &run));

    // The mapper goes on from a snapshot: the model of before, as it would have left it.
    let (record, snapshots) = (run.join("poses/poses.json"), run.join("poses/snapshots"));
    assert!(!snapshots.exists(), "nothing of it is left once it is done");
    std::fs::create_dir(&snapshots).expect("a folder");
    std::fs::rename(run.join("poses/models/0"), snapshots.join("0123456789")).expect("a rename");
    let mut undone: serde_json::Value = json(&std::fs::read(&record).expect("a record"));
    undone["done"] = serde_json::Value::Null;
    std::fs::write(&record, undone.to_string()).expect("a record");
    let continued = segwild(&command);
    let messages = text(&continued.stderr);
    assert!(
        continued.status.success() && messages.contains("goes on from the poses of 7 of 7"),
        "{messages}"
    );
    assert_eq!(calls(&run, "--input_path"), 1);
    are_the_true_ones(&posed(&scene, &run));

    std::fs::rename(dir.path().join("kept.png"), &last).expect("a rename");
    let explained = works(&["run", &show(&scene), "--out", &show(&run), "--until", "poses", "--explain"]);
    assert!(explained.contains("07.png is new"), "{explained}");
    works(&command);
    let log = std::fs::read_to_string(run.join("poses/colmap.log")).expect("a log");
    let features = log.rsplit("== ").find(|part| part.contains("feature_extractor")).expect("its part");
    assert!(features.contains("Processed file [1/1]"), "the features of one photo are computed: {features}");
    assert_eq!(posed(&scene, &run).views.len(), FEW);
}

/// How often photos were compared so far.
fn calls_or_none(run: &Path) -> usize {
    if run.join("poses/colmap.log").is_file() { calls(run, "exhaustive_matcher") } else { 0 }
}

#[test]
fn a_machine_without_colmap_or_ffmpeg_says_how_to_get_them() {
    let dir = folder();
    let (scene, video) = (photos(dir.path(), FEW), dir.path().join("walk.mp4"));
    std::fs::write(&video, "no video").expect("a file");
    let without = |path: &Path| {
        let run = dir.path().join("run").display().to_string();
        let output = Command::new(env!("CARGO_BIN_EXE_segwild"))
            .args(["run", &show(path), "--out", &run, "--until", "poses"])
            .env("PATH", dir.path())
            .output()
            .expect("the program starts");
        (output.status.code(), text(&output.stderr))
    };
    for path in [&scene, &video] {
        let (code, error) = without(path);
        assert_eq!(code, Some(4), "another machine may have it: {error}");
        assert!(error.contains("apt-get install colmap"), "{error}");
    }
    let empty = dir.path().join("empty");
    std::fs::create_dir(&empty).expect("a folder");
    refuses(&["run", &show(&empty), "--out", &show(&dir.path().join("none"))], 3, &["is empty", "no photos"]);
}

#[cfg(unix)]
#[test]
fn a_global_mapper_that_is_not_there_is_missed_before_anything_is_computed() {
    let name = "a_global_mapper_that_is_not_there_is_missed_before_anything_is_computed";
    if !has("colmap", name) {
        return;
    }
    let path = std::env::var_os("PATH").expect("colmap is on it");
    let colmap = std::env::split_paths(&path).map(|folder| folder.join("colmap")).find(|file| file.is_file());
    let colmap = colmap.expect("it has started");
    let help = Command::new(&colmap).arg("help").output().expect("it starts");
    if text(&help.stdout).contains("global_mapper") {
        eprintln!("skipped: {name}: COLMAP has a global mapper here");
        return;
    }
    let dir = folder();
    let (scene, alone) = (photos(dir.path(), 3), dir.path().join("alone"));
    std::fs::create_dir(&alone).expect("a folder");
    std::os::unix::fs::symlink(&colmap, alone.join("colmap")).expect("a link");
    let run = dir.path().join("run");
    let output = Command::new(env!("CARGO_BIN_EXE_segwild"))
        .args(["run", &show(&scene), "--out", &show(&run), "--until", "poses", "--mapper", "glomap"])
        .env("PATH", &alone)
        .output()
        .expect("the program starts");
    let error = text(&output.stderr);
    assert_eq!(output.status.code(), Some(4), "another machine may have it: {error}");
    assert!(error.contains("global_mapper") && error.contains("--mapper colmap"), "{error}");
    assert!(!run.join("poses/colmap.db").exists(), "nothing was computed");
}

#[test]
fn photos_that_show_nothing_in_common_are_refused_in_words() {
    if !has("colmap", "photos_that_show_nothing_in_common_are_refused_in_words") {
        return;
    }
    let dir = folder();
    let scene = dir.path().join("photos");
    std::fs::create_dir(&scene).expect("a folder");
    for i in 0..3 {
        Image::zeros(64, 48, 3).write_png(&scene.join(format!("{i}.png"))).expect("a photo");
    }
    let run = show(&dir.path().join("run"));
    refuses(&["run", &show(&scene), "--out", &run], 3, &["no poses of the 3 photos", "show the same"]);
    std::fs::remove_file(scene.join("0.png")).expect("a photo");
    refuses(&["run", &show(&scene), "--out", &run], 3, &["2 usable photos", "at least 3"]);
}

#[test]
fn a_video_becomes_photos_with_poses() {
    if !has("colmap", "a_video_becomes_photos_with_poses")
        || !has("ffmpeg", "a_video_becomes_photos_with_poses")
    {
        return;
    }
    let dir = folder();
    let (scene, run, video) = (photos(dir.path(), FEW), dir.path().join("run"), dir.path().join("walk.mp4"));
    // Each photo stands for three frames, as in a slow walk.
    let made = Command::new("ffmpeg")
        .args(["-v", "error", "-framerate", "10", "-i", &show(&scene.join("%02d.png")), "-r", "30"])
        .args(["-c:v", "mpeg4", "-q:v", "2", &show(&video)])
        .output()
        .expect("ffmpeg starts");
    assert!(made.status.success(), "{}", text(&made.stderr));
    let command = ["run", &show(&video), "--out", &show(&run), "--until", "poses"];
    let output = segwild(&command);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let frames = std::fs::read_dir(run.join("poses/frames")).expect("frames").count();
    assert!((6..=FEW).contains(&frames), "{frames} of 24 frames, of which three show the same");
    let scene = posed(&run.join("poses/frames"), &run);
    assert!(scene.views.len() >= 6, "{} of {frames} frames have poses", scene.views.len());
    let again = segwild(&command);
    assert!(again.status.success() && text(&again.stderr).contains("poses was done before"));
    std::fs::write(&video, "no video any more").expect("a file");
    refuses(&command, 3, &["walk.mp4", "no photo can be taken out of the video"]);
}
