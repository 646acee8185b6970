//! Files for other programs: each is opened by a program that is not ours, and shows the same scene.

use crate::common::*;
use segwild_objective::psnr;
use segwild_raster::{Channels, CpuEngine, ProjectOptions, Rasterizer};
use segwild_scene::{Image, Mask, Scene, SceneSettings, Splats, ply};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

/// Other programs, as `npm ci` installs them.
fn programs() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/programs")
}

/// Whether they are there; says by name which test is skipped where they are not.
fn installed(test: &str) -> bool {
    let there = programs().join("node_modules/.bin/splat-transform").is_file();
    if !there {
        println!(
            "skipped: {test}: `npm ci --ignore-scripts` has not been run in services/cli/tests/programs"
        );
    }
    there
}

fn is_there(program: &str) -> bool {
    Command::new(program).arg("-version").output().is_ok_and(|output| output.status.success())
}

/// Runs segwild with these folders before the `PATH`, or with them alone.
fn with_path(folders: &[PathBuf], alone: bool, args: &[&str]) -> Output {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let others = std::env::split_paths(&path).filter(|_| !alone);
    let path = std::env::join_paths(folders.iter().cloned().chain(others)).expect("paths");
    Command::new(env!("CARGO_BIN_EXE_segwild")).args(args).env("PATH", path).output().expect("it starts")
}

fn with_programs(args: &[&str]) -> String {
    let output = with_path(&[programs().join("node_modules/.bin")], false, args);
    assert_eq!(output.status.code(), Some(0), "{args:?} printed: {}", text(&output.stderr));
    text(&output.stdout)
}

/// A run with a selection.
fn selected() -> &'static Path {
    static RUN: OnceLock<PathBuf> = OnceLock::new();
    RUN.get_or_init(|| {
        let made = made_once("selected", &[Path::new(env!("CARGO_BIN_EXE_segwild"))], |folder| {
            let run = folder.join("run");
            copy_folder(&shared_run().run, &run);
            let (_, click) = clearest();
            let at = format!("{},{}", click.x, click.y);
            // What the photo itself shows there: a hall, whatever the scene tree means.
            let click =
                ["--photo", &click.photo, "--positive", &at, "--name", "thing", "--first-answer", "photo"];
            works(&[&["segment", &show(&run)][..], &click].concat());
        });
        made.join("run")
    })
}

/// A file of splats as splat-transform reads it, in the axes of a `.ply`.
fn read_by_splat_transform(file: &Path) -> Splats {
    let back = file.with_extension("again.ply");
    let done = Command::new(programs().join("node_modules/.bin/splat-transform"))
        .args(["--quiet", "--overwrite", &show(file), &show(&back)])
        .output()
        .expect("it starts");
    assert!(done.status.success(), "{}", text(&done.stderr));
    ply::read(&back).expect("it opens")
}

/// The splats from the camera of the first photo, before white. They are in the units of the scene's files.
fn image(splats: &Splats) -> Image {
    let scene = Scene::open(scene(), &SceneSettings::default()).expect("it opens");
    let splats = splats.from_file_frame(&scene.frame);
    let view = &scene.views[0];
    let camera = view.camera.scaled_to(192);
    let options = ProjectOptions::default();
    let engine = CpuEngine::default();
    let projected = engine.project(&splats, &camera, &view.pose, &options).expect("it is rendered");
    let frame = projected.blend(&Channels { count: 3, values: &projected.shade() }).expect("it is rendered");
    let (mut image, n) = (frame.image, frame.alpha.pixels());
    for (k, value) in image.data.iter_mut().enumerate() {
        *value += 1.0 - frame.alpha.data[k % n];
    }
    image
}

#[test]
fn files_of_every_format_show_the_same_scene_in_other_programs() {
    if !installed("files_of_every_format_show_the_same_scene_in_other_programs") {
        return;
    }
    let dir = folder();
    let run = show(selected());
    let baked = |name: &str, part: &[&str]| {
        let file = dir.path().join(name);
        with_programs(&[&["bake", &run, "--out", &show(&file)][..], part].concat());
        file
    };
    let object = ["--selection", "thing"];
    let [scene, thing] = [baked("scene.ply", &[]), baked("thing.ply", &object)]
        .map(|file| image(&ply::read(&file).expect("it opens")));
    assert!(scene.data.iter().any(|v| *v < 0.7) && psnr(&scene, &thing, None) < 30.0, "both show something");
    // Packed formats round: positions to 11 bits within chunks, colours to 8. The colour tables of .sog take long.
    let packed: [(&str, f32, &[&str]); 4] = [
        ("a.ply", 60.0, &[]),
        ("a.spz", 30.0, &[]),
        ("a.compressed.ply", 30.0, &[]),
        ("a.sog", 30.0, &object),
    ];
    for (name, least, part) in packed {
        let truth = if part.is_empty() { &scene } else { &thing };
        let same = psnr(&image(&read_by_splat_transform(&baked(name, part))), truth, None);
        assert!(same >= least, "{name}: {same} dB");
    }
    let page = baked("a.html", &object);
    assert!(std::fs::read_to_string(&page).expect("it is there").contains("<html"));
    let left = std::fs::read_dir(dir.path()).expect("a folder").flatten();
    let names: Vec<String> = left.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    assert!(names.iter().all(|name| !name.starts_with('.')), "nothing is left aside: {names:?}");
}

#[test]
fn all_objects_are_written_in_a_format_of_another_program() {
    if !installed("all_objects_are_written_in_a_format_of_another_program") {
        return;
    }
    let dir = folder();
    let out = dir.path().join("objects");
    with_programs(&["objects", &show(selected()), "--out", &show(&out), "--format", "compressed.ply"]);
    let files = std::fs::read_dir(&out).expect("a folder").flatten().map(|entry| entry.path());
    let packed: Vec<PathBuf> = files.filter(|path| show(path).ends_with(".compressed.ply")).collect();
    assert!(!packed.is_empty());
    let splats: usize = packed.iter().map(|file| read_by_splat_transform(file).len()).sum();
    let all = ply::read(&out.join("labels.ply")).expect("it opens");
    assert!(0 < splats && splats <= all.len(), "{splats} of {}", all.len());
}

#[test]
fn the_gltf_validator_finds_no_error_but_names_of_the_extension() {
    if !installed("the_gltf_validator_finds_no_error_but_names_of_the_extension") {
        return;
    }
    let dir = folder();
    let file = dir.path().join("thing.glb");
    works(&["bake", &show(selected()), "--selection", "thing", "--out", &show(&file)]);
    let script = "import { validateBytes } from 'gltf-validator'; import { readFileSync } from 'node:fs';\
         const report = await validateBytes(new Uint8Array(readFileSync(process.argv[1])));\
         console.log(JSON.stringify(report));";
    let done = Command::new("node")
        .args(["--input-type=module", "-e", script, &show(&file)])
        .current_dir(programs())
        .output()
        .expect("node starts");
    assert!(done.status.success(), "{}", text(&done.stderr));
    let report = json(&done.stdout);
    // It does not know the extension, and takes each of its attributes for a name that is not allowed.
    let messages = report["issues"]["messages"].as_array().expect("a list");
    let errors = messages.iter().filter(|message| message["severity"] == 0);
    let of_the_extension = |message: &serde_json::Value| {
        let at = message["pointer"].as_str().unwrap_or_default();
        message["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" && at.contains("/KHR_gaussian_splatting:")
    };
    let others: Vec<_> = errors.filter(|message| !of_the_extension(message)).collect();
    assert!(others.is_empty(), "{others:#?}");
    assert!(report["info"]["totalVertexCount"].as_u64().is_some_and(|count| count > 20), "{report:#}");
}

/// Width, height and number of the frames of a video, as ffprobe counts them.
fn frames(video: &Path) -> String {
    let entries = "stream=codec_name,width,height,nb_read_frames,r_frame_rate,color_space";
    let done = Command::new("ffprobe")
        .args(["-v", "error", "-count_frames", "-show_entries", entries, "-of", "csv=p=0", &show(video)])
        .output()
        .expect("it starts");
    text(&done.stdout).trim().to_owned()
}

#[test]
fn videos_go_around_an_object_alone_and_in_its_scene() {
    if !is_there("ffmpeg") || !is_there("ffprobe") {
        println!("skipped: videos_go_around_an_object_alone_and_in_its_scene: ffmpeg is not installed");
        return;
    }
    let dir = folder();
    let run = show(selected());
    let around = |path: &str, name: &str, more: &[&str]| {
        let out = dir.path().join(name);
        let args = ["--selection", "thing", "--path", path, "--frames", "9", "--width", "97"];
        works(&[&["render", &run, "--out", &show(&out)][..], &args, more].concat());
        out
    };
    // An encoder takes even sizes alone; a percent sign is no number of a frame.
    let alone = around("turntable", "100%d.mp4", &["--fps", "12"]);
    assert_eq!(frames(&alone), "h264,96,96,bt709,12/1,9");
    let orbit = around("orbit", "orbit.mp4", &["--mode", "without"]);
    assert!(frames(&orbit).ends_with(",bt709,30/1,9"), "{}", frames(&orbit));
    let names = || std::fs::read_dir(dir.path()).expect("a folder").count();
    assert_eq!(names(), 2, "no frames are left");
    // Without a video: the frames.
    let images = around("turntable", "images", &[]);
    let shown = |frame: usize| Image::read(&images.join(format!("path-{frame:04}.png"))).expect("it opens");
    let dark = |image: &Image| image.data.iter().filter(|v| **v < 0.9).count();
    for frame in 0..9 {
        let (all, dark) = (shown(frame).data.len(), dark(&shown(frame)));
        assert!(dark > all / 50, "frame {frame} shows the object: {dark} of {all}");
    }
    assert!(psnr(&shown(0), &shown(4), None) < 40.0, "it turns");
}

#[test]
fn of_a_scene_without_an_object_it_is_reported_what_no_photo_saw() {
    let dir = folder();
    let (_, click) = clearest();
    let out = dir.path().join("images");
    let args = ["--photo", &click.photo, "--selection", "thing", "--mode", "without", "--json"];
    let printed = works(&[&["render", &show(selected()), "--out", &show(&out)][..], &args].concat());
    let share = json(printed.as_bytes())["unseen"].as_f64().expect("a share");
    let marked =
        Mask::read_png(&out.join("unseen").join(&click.photo)).expect("a hall covers what is behind it");
    let pixels = marked.width() * marked.height();
    assert!((share - marked.count() as f64 / f64::from(pixels)).abs() < 1e-3 && share > 0.05, "{share}");
    let whole =
        works(&["render", &show(selected()), "--photo", &click.photo, "--out", &show(&out), "--json"]);
    assert!(json(whole.as_bytes())["unseen"].is_null(), "{whole}");
    let baked = dir.path().join("rest.ply");
    let bake = ["--selection", "thing", "--mode", "without", "--out", &show(&baked)];
    let printed = works(&[&["bake", &show(selected())][..], &bake].concat());
    assert!(printed.contains("no photo saw: there are holes"), "{printed}");
    let counts =
        [ply::read(&baked), ply::read(&selected().join("scene.ply"))].map(|s| s.expect("it opens").len());
    assert!(counts[0] < counts[1], "{counts:?}");
}

#[test]
fn a_missing_program_is_named_with_what_installs_it() {
    let dir = folder();
    let run = show(selected());
    let file = |name: &str| show(&dir.path().join(name));
    let refused = |args: &[&str], word: &str| {
        let output = with_path(&[dir.path().to_owned()], true, args);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(4), "{error}");
        assert!(error.contains("is not found on the PATH") && error.contains(word), "{error}");
    };
    refused(&["bake", &run, "--out", &file("a.sog")], "npm install -g @playcanvas/splat-transform");
    let turntable = ["render", &run, "--selection", "thing", "--path", "turntable"];
    refused(&[&turntable[..], &["--out", &file("a.mp4")]].concat(), "apt-get install ffmpeg");
    refuses(&["bake", &run, "--out", &file("a.obj")], 2, &[".compressed.ply", ".sog"]);
    refuses(&["render", &run, "--path", "orbit"], 2, &["--selection NAME"]);
    refuses(&["render", &run, "--out", &file("a.mp4")], 2, &["--frames N"]);
    assert_eq!(std::fs::read_dir(dir.path()).expect("a folder").count(), 0);
}

#[cfg(unix)]
#[test]
fn a_program_that_fails_leaves_no_file_and_its_words() {
    use std::os::unix::fs::PermissionsExt;
    let dir = folder();
    let bin = dir.path().join("bin");
    std::fs::create_dir(&bin).expect("a folder");
    let program = bin.join("splat-transform");
    let script = "#!/bin/sh\ncase $1 in --version) echo 'splat-transform v0 (test)';; *) echo '  x Error: no memory';\
         echo 'failed in 1 s'; exit 1;; esac\n";
    std::fs::write(&program, script).expect("it is written");
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).expect("it is executable");
    let out = dir.path().join("out/a.sog");
    let output = with_path(&[bin], false, &["bake", &show(selected()), "--out", &show(&out)]);
    let error = text(&output.stderr);
    assert_eq!(output.status.code(), Some(4), "{error}");
    assert!(error.contains("splat-transform failed: no memory"), "{error}");
    assert_eq!(std::fs::read_dir(dir.path().join("out")).expect("a folder").count(), 0);
}
