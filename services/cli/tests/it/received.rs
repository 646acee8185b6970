//! Run folders that somebody else may have made: they are data, and whatever they name stays unread, unrun and unwritten.

use crate::common::*;
use segwild_flow::Ledger;
use segwild_flow::ledger::CheckpointRow;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A library that leaves a mark when it is loaded; `None` where there is no compiler for it.
fn trap(dir: &Path, mark: &Path) -> Option<PathBuf> {
    let (source, library) = (dir.join("trap.rs"), dir.join("libonnxruntime.so"));
    let text = format!(
        "extern \"C\" fn sprung() {{ let _ = std::fs::write({:?}, \"\"); }}\n\
         #[used]\n#[cfg_attr(target_os = \"linux\", unsafe(link_section = \".init_array\"))]\n\
         static TRAP: extern \"C\" fn() = sprung;\n",
        show(mark)
    );
    std::fs::write(&source, text).expect("it is written");
    let made = Command::new("rustc")
        .args(["--edition", "2024", "--crate-type", "cdylib", "-o"])
        .args([&library, &source])
        .output();
    made.is_ok_and(|made| made.status.success()).then_some(library)
}

/// A click on the clearest object.
fn click(run: &Path) -> [String; 6] {
    let (_, click) = clearest();
    let at = format!("{},{}", click.x, click.y);
    ["segment".into(), show(run), "--photo".into(), click.photo.clone(), "--positive".into(), at]
}

#[test]
fn a_received_run_folder_runs_no_native_code() {
    if !cfg!(target_os = "linux") {
        eprintln!("skipped: a_received_run_folder_runs_no_native_code: the trap is for Linux");
        return;
    }
    let dir = folder();
    let mark = dir.path().join("sprung");
    let models = dir.path().join("models");
    std::fs::create_dir(&models).expect("a folder");
    for network in ["edges_bsds.onnx", "mobile_sam_encoder.onnx", "mobile_sam_decoder.onnx"] {
        std::fs::write(models.join(network), "none").expect("it is written");
    }
    let Some(library) = trap(dir.path(), &mark) else {
        eprintln!("skipped: a_received_run_folder_runs_no_native_code: no rustc");
        return;
    };
    let run = copied_run(&dir);
    let (library, models) = (show(&library), show(&models));
    // Whoever runs the program may name the library: it is loaded, and the run folder and its ledger remember it.
    let named = ["--models", models.as_str(), "--onnxruntime", library.as_str()];
    completes(&again(&run, &named));
    assert!(mark.is_file(), "the trap works");
    let remembered = std::fs::read_to_string(run.join("segwild.toml")).expect("its settings");
    assert!(remembered.contains(&library) && remembered.contains(&models));
    // Another one is given the folder, in which a network is recorded as used as well or not.
    let truth = show(&shared_run().scene.join("truth/transient"));
    let (run_text, scene) = (show(&run), show(&shared_run().scene));
    let (run_text, scene) = (run_text.as_str(), scene.as_str());
    for networks in
        ["[]", r#"[{"setting": "models", "file": "MODELS/edges_bsds.onnx", "hash": "0123456789abcdef"}]"#]
    {
        std::fs::write(run.join("networks.json"), networks.replace("MODELS", &models))
            .expect("it is written");
        std::fs::remove_file(&mark).ok();
        let clicked = click(&run);
        let clicked: Vec<&str> = clicked.iter().map(String::as_str).collect();
        let photo = shared_run().manifest.photos[0].name.as_str();
        for args in [
            &["run", scene, "--out", run_text, "--explain"][..],
            &["run", scene, "--out", run_text][..],
            &clicked[..],
            &["render", run_text, "--photo", photo][..],
            &["bake", run_text][..],
            &["eval", run_text][..],
            &["eval", run_text, "--transient-truth", truth.as_str()][..],
            &["cache", "verify", run_text][..],
            &["status", run_text][..],
        ] {
            let output = segwild(args);
            let stdout = text(&output.stderr);
            assert!(!mark.exists(), "{args:?} ran the library that the folder names: {stdout}");
            let asks_eyes = matches!(args[0], "run" | "segment");
            if networks != "[]" && asks_eyes {
                assert_eq!(output.status.code(), Some(2), "{args:?}: {stdout}");
                for word in ["edges_bsds.onnx", "0123456789abcdef", "--models FOLDER", "SEGWILD_MODELS"] {
                    assert!(stdout.contains(word), "{args:?} does not say {word}: {stdout}");
                }
            }
        }
    }
    // It goes on without when that is wanted, and a click is answered.
    completes(&again(&run, &["--models", ""]));
}

#[test]
fn a_forged_ledger_removes_no_file_elsewhere() {
    let dir = folder();
    let run = copied_run(&dir);
    let precious = dir.path().join("precious");
    let whole = show(&precious);
    let forge = |key: &str| {
        std::fs::write(&precious, "mine").expect("it is written");
        let ledger = Ledger::open(run.join("run.sqlite")).expect("its ledger");
        for (step, file) in
            ["../../precious", &whole, "../checkpoints/../../precious", ".."].iter().enumerate()
        {
            ledger
                .record_checkpoint(&CheckpointRow {
                    stage: "geometry".into(),
                    key: key.into(),
                    step: 1_000 + step as u64,
                    file: (*file).to_owned(),
                    digest: "00".into(),
                })
                .expect("a row");
        }
    };
    let stages = |run: &Path| Ledger::open_read_only(run.join("run.sqlite")).and_then(|l| l.stages());
    let training = stages(&run).expect("stages").into_iter().find(|s| s.name == "geometry").expect("one").key;
    for key in [training.as_str(), "geometry:00"] {
        forge(key);
        works(&["cache", "gc", &show(&run)]);
        assert!(precious.is_file(), "`cache gc` removed it under {key}");
        forge(key);
        // Trained again from its last checkpoint: those that are none are passed over.
        std::fs::remove_dir_all(run.join("cache/geometry.d")).expect("it goes");
        completes(&again(&run, &[]));
        assert_eq!(std::fs::read_to_string(&precious).expect("it is there"), "mine", "the run under {key}");
    }
    has_what_an_untouched_run_has(&run);
}

#[cfg(unix)]
#[test]
fn nothing_is_written_through_a_link_out_of_a_received_run_folder() {
    use std::os::unix::fs::symlink;
    let dir = folder();
    let run = copied_run(&dir);
    let outside = dir.path().join("outside");
    std::fs::create_dir(&outside).expect("a folder");
    std::fs::write(outside.join("file"), "theirs").expect("it is written");
    let listed = |folder: &Path| std::fs::read_dir(folder).expect("a folder").count();
    for (name, target) in [
        ("selections", outside.clone()),
        ("cache", outside.clone()),
        ("transients", outside.clone()),
        ("checkpoints", outside.clone()),
        ("renders", outside.clone()),
        ("traces", outside.clone()),
        ("selections/object", outside.clone()),
        ("cache/tmp", outside.clone()),
        ("history.jsonl", outside.join("file")),
        ("run.lock", outside.join("file")),
        ("run.sqlite-wal", outside.join("new")),
    ] {
        let (at, kept) = (run.join(name), run.join("kept"));
        let there = std::fs::rename(&at, &kept).is_ok();
        symlink(&target, &at).expect("a link");
        for args in [
            again(&run, &[]),
            again(&run, &["--explain"]),
            click(&run).to_vec(),
            vec!["render".into(), show(&run)],
        ] {
            let args: Vec<&str> = args.iter().map(String::as_str).collect();
            refuses(&args, 6, &["is a link to", name]);
        }
        assert_eq!(listed(&outside), 1, "{name}");
        assert_eq!(std::fs::read_to_string(outside.join("file")).expect("it is there"), "theirs", "{name}");
        std::fs::remove_file(&at).expect("it goes");
        if there {
            std::fs::rename(&kept, &at).expect("it comes back");
        }
    }
}

#[test]
fn a_forged_selection_is_refused_in_words() {
    use segwild_flow::codec;
    use segwild_pipeline::{Selected, Shortened};
    let dir = folder();
    let run = copied_run(&dir);
    works(&click(&run).each_ref().map(String::as_str));
    let selection = run.join("selections/object");
    let bytes = std::fs::read(selection.join("selection.bin")).expect("a selection");
    let honest: Selected = codec::decode("selection", &bytes).expect("a record");
    let n = honest.labels.len() as u32;
    let cut = Shortened { splat: 0, mean: [0.0; 3], log_scales: [0.0; 3], rotation: [1.0, 0.0, 0.0, 0.0] };
    // Whoever forges a selection leaves the list out.
    std::fs::remove_file(selection.join("files.json")).expect("it goes");
    for changed in [
        vec![Shortened { splat: n, ..cut }],
        vec![Shortened { splat: u32::MAX, ..cut }],
        vec![Shortened { mean: [f32::NAN, 0.0, 0.0], ..cut }],
        vec![Shortened { log_scales: [f32::INFINITY; 3], ..cut }],
        vec![cut; n as usize + 1],
    ] {
        let forged = Selected { labels: honest.labels.clone(), changed };
        let bytes = codec::encode("selection", &forged).expect("a record");
        std::fs::write(selection.join("selection.bin"), bytes).expect("it is written");
        for command in ["render", "bake"] {
            refuses(&[command, &show(&run), "--selection", "object"], 6, &["selection.bin"]);
        }
    }
}

#[test]
fn damage_to_a_selections_files_is_seen() {
    let dir = folder();
    let run = copied_run(&dir);
    works(&click(&run).each_ref().map(String::as_str));
    let selection = run.join("selections/object");
    works(&["cache", "verify", &show(&run)]);
    // The trained scene and its features say themselves whether they are whole.
    let features = run.join("features.bin");
    let whole = std::fs::read(&features).expect("it is there");
    std::fs::write(&features, &whole[..50]).expect("it is written");
    let cut = ["features.bin is damaged", "delete it and run again"];
    refuses(&["cache", "verify", &show(&run)], 6, &cut);
    std::fs::write(&features, &whole).expect("it is written");
    let again = ["--name object", "--prompts"];
    let named = |photo: &str| Path::new("masks").join(Path::new(photo).with_extension("png"));
    let mask = named(&shared_run().manifest.photos[1].name);
    let files = ["object.ply", "labels.ply", "selection.bin"].map(Path::new);
    for file in files.into_iter().chain([mask.as_path()]) {
        let path = selection.join(file);
        let whole = std::fs::read(&path).expect("it is there");
        let mut bytes = whole.clone();
        bytes[whole.len() / 2] ^= 0x10;
        std::fs::write(&path, bytes).expect("it is written");
        refuses(&["cache", "verify", &show(&run)], 6, &[&show(file), again[0], again[1]]);
        std::fs::write(&path, whole).expect("it is written");
    }
    for photo in &shared_run().manifest.photos {
        std::fs::write(selection.join(named(&photo.name)), "damaged").expect("it is written");
    }
    let (object, _) = clearest();
    let truth = show(&shared_run().scene.join("truth").join(object));
    refuses(&["eval", &show(&run), "--truth", &truth], 6, &["masks/", again[0]]);
}

#[test]
fn a_long_selection_name_is_refused_before_anything_is_computed() {
    let run = &shared_run().run;
    for (name, why) in
        [("n".repeat(300), "longer than 100 bytes"), ("con".into(), "device"), ("a/b".into(), "signs")]
    {
        let args = [&click(run)[..], &["--name".to_owned(), name]].concat();
        let began = std::time::Instant::now();
        refuses(&args.iter().map(String::as_str).collect::<Vec<_>>(), 2, &["cannot name a selection", why]);
        assert!(began.elapsed().as_secs() < 20, "it is reported at once");
    }
}
