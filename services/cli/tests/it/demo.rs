//! `segwild demo --photos-only`: photos of any number and size, one by one; what is out of bounds; disks that are full.

use crate::common::*;
use segwild_scene::{Scene, SceneSettings};
use std::path::Path;

/// The names of the files in a folder.
fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).expect("a folder").flatten();
    let mut names: Vec<String> = entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

#[test]
fn the_number_and_the_size_of_the_photos_have_bounds() {
    for (flag, value, allowed) in [
        ("--photo-count", "0", "2..=3600"),
        ("--photo-count", "1", "2..=3600"),
        ("--photo-count", "3601", "2..=3600"),
        ("--pixels", "15", "16..=4096"),
        ("--pixels", "1000000", "16..=4096"),
    ] {
        refuses(&["demo", "--photos-only", flag, value], 2, &[flag, value, allowed]);
    }
    let whole = ["demo", "--photo-count", "1000", "--pixels", "1600", "--out", "/nowhere/demo"];
    refuses(&whole, 2, &["1084 photos of 1600 px", "--photos-only"]);
}

#[test]
fn photos_are_written_or_the_file_is_named_that_cannot_be() {
    let dir = folder();
    let out = show(&dir.path().join("demo"));
    let photos_only = |count: &str| {
        let args = ["demo", "--photos-only", "--photo-count", count, "--pixels", "32", "--out", &out];
        args.map(str::to_owned)
    };
    let (stdout, stderr) = completes(&photos_only("4"));
    let scene = dir.path().join("demo/scene");
    assert!(stdout.contains("5 tourist photos") && stdout.contains(&show(&scene)), "{stdout}");
    assert!(stderr.contains("photos done") && stderr.contains("5 done"), "{stderr}");
    let opened = Scene::open(&scene, &SceneSettings::default()).expect("a scene");
    assert_eq!((opened.views.len(), opened.views.iter().filter(|v| v.test).count()), (5, 1));
    assert!(opened.views.iter().all(|v| v.camera.width.max(v.camera.height) == 32));
    let photos: Vec<String> = (0..5).map(|i| format!("photo_{i:03}.png")).collect();
    assert_eq!((names(&scene.join("images")), names(&scene.join("truth/dome"))), (photos.clone(), photos));

    // Photos of another set are no scene with the poses of this one, and no part of a file stays.
    let other = photos_only("5");
    let full = [&other[..], &["--fault", "full@file.write:30+"].map(str::to_owned)].concat();
    let full: Vec<&str> = full.iter().map(String::as_str).collect();
    refuses(&full, 6, &["cannot write", "photo_00", "the disk is full"]);
    assert!(!scene.join("truth.json").exists() && names(&scene.join("sparse/0")).is_empty());
    let all = [names(&scene.join("images")), names(&scene.join("truth/depth"))].concat();
    assert!(all.iter().all(|name| name.starts_with("photo_")), "{all:?}");
    completes(&other);
    assert_eq!(Scene::open(&scene, &SceneSettings::default()).expect("a scene").views.len(), 6);

    let file = dir.path().join("file");
    std::fs::write(&file, "no folder").expect("it is written");
    let below = show(&file.join("demo"));
    refuses(&["demo", "--photos-only", "--out", &below], 6, &["cannot write", &below]);
}
