//! A run by networks of the SAM family: its masks, its embeddings and a click into it; what is kept, and what is made again
//! when a file changes; objects by a text with CLIP. The networks are small ones of the same interfaces.

#[path = "../../../vision/tests/it/toy/mod.rs"]
mod toy;

use crate::common::*;
use segwild_flow::Stopper;
use segwild_pipeline::{Code, RunFolder};
use segwild_scene::Prompts;
use segwild_studio::Studio;
use segwild_studio::messages::HoverRequest;
use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};
use toy::{SAM, Takes, ToyDecoder, ToyFault, can_run, decoder, encoder};

#[test]
fn a_run_by_sam_is_whole_kept_and_made_again_when_a_file_changes() {
    if !can_run("a_run_by_sam_is_whole_kept_and_made_again_when_a_file_changes") {
        return;
    }
    let dir = folder();
    let (models, run) = (dir.path().join("models"), dir.path().join("run"));
    toy::write_usual(&models);
    let models_flag = show(&models);
    let args = again(&run, &["--models", &models_flag, "--json"]);
    let (stdout, _) = completes(&args);
    assert!(stdout.contains("masks, clicks and refinement: SAM"), "{stdout}");
    assert!(stdout.contains("descriptors: SAM"), "{stdout}");
    // 8 photos of a sky, an embedding and masks each, and the skies of 2 that are held out.
    assert_eq!(made(&stdout), 26, "{stdout}");
    // 8 photos and 8 renders were encoded; 8 times the budget's prompts answered, at most.
    let stderr = stdout.lines().find(|l| l.contains("images encoded")).expect("the speed is printed");
    assert!(stderr.contains("16 images encoded in") && stderr.contains("prompts answered at"), "{stderr}");
    let rate = json(stdout.lines().find(|l| l.contains("prompts_per_s")).expect("a metric").as_bytes());
    assert!(rate["value"].as_f64().is_some_and(|v| v > 0.0), "{rate}");

    // Once more: nothing is made, so no network runs.
    let before = results(&run);
    let (stdout, _) = completes(&args);
    assert_eq!(made(&stdout), 0, "{stdout}");
    assert!(!stdout.contains("images encoded"), "{stdout}");
    assert_eq!(results(&run), before);

    // A click is answered by the networks, and selects something.
    let picked = select(&run, &["--models", &models_flag]);
    assert_eq!(picked.status.code(), Some(0), "{}", text(&picked.stderr));
    let summary = std::fs::read(run.join("selections/it/summary.json")).expect("it is there");
    assert!(json(&summary)["splats"].as_u64().is_some_and(|n| n > 0), "{}", text(&summary));

    // Another decoder: the masks are made again, and nothing else per photo.
    let other = decoder(ToyDecoder { masks: 3, ..SAM });
    toy::write(&models, "mobile_sam", &encoder(Takes::Planes, ToyFault::None), &other);
    let (stdout, _) = completes(&args);
    assert_eq!(made(&stdout), 8, "{stdout}");
    // Another encoder: the embeddings as well.
    let packed = encoder(Takes::Pixels(toy::PIXEL_KINDS[1]), ToyFault::None);
    toy::write(&models, "mobile_sam", &packed, &other);
    let (stdout, _) = completes(&args);
    assert_eq!(made(&stdout), 16, "{stdout}");
}

/// Runs a command that may load the networks of a folder.
fn with_models(models: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_segwild"));
    command.args(args).env("SEGWILD_MODELS", models).output().expect("the program starts")
}

/// A network that keeps what it encodes has its turn: the first motion over a photo encodes it, for the masks of the next ones.
fn hovering_encodes_the_photo(run: &Path, models: &Path, photo: &str, [x, y]: [f32; 2]) {
    let folder = RunFolder::open(run).expect("a run");
    let code = Code::given(&[("models".to_owned(), show(models))]);
    let studio = Studio::open_at(&folder, "run", None, &code, &Stopper::new()).expect("it opens");
    let session = studio.session();
    let photo = session.scene().view_named(photo).expect("a photo of the run");
    let is_encoded = || session.is_prepared(photo).expect("it is read");
    assert!(session.finds_objects() && session.tree().is_some() && !is_encoded());
    studio.hover(&HoverRequest { photo, x, y, ..HoverRequest::default() }).expect("it answers");
    let began = Instant::now();
    while !is_encoded() {
        assert!(began.elapsed() < Duration::from_secs(60), "the photo is never encoded");
        std::thread::park_timeout(Duration::from_millis(5));
    }
    let mask = session.prepared_mask(photo, &Prompts::click(1.0, 1.0)).expect("it answers");
    assert!(mask.is_some());
}

#[test]
fn a_scene_tree_is_grown_from_masks_of_sam_and_sam_stays_the_first_answer() {
    if !can_run("a_scene_tree_is_grown_from_masks_of_sam_and_sam_stays_the_first_answer") {
        return;
    }
    let dir = folder();
    let (models, run) = (dir.path().join("models"), dir.path().join("run"));
    toy::write_usual(&models);
    let (models_text, run_text) = (show(&models), show(&run));
    let args = again(&run, &["--models", &models_text]);
    completes(&args);
    let tree = || {
        let list = std::fs::read(run.join("objects/objects.json")).expect("the run listed its objects");
        json(&list)["tree"].as_str().expect("a key").to_owned()
    };
    let before = tree();
    let (_, click) = clearest();
    hovering_encodes_the_photo(&run, &models, &click.photo, [click.x, click.y]);
    let at = format!("{},{}", click.x, click.y);
    let alternatives = || {
        let output = with_models(
            &models,
            &["segment", &run_text, "--photo", &click.photo, "--positive", &at, "--json"],
        );
        assert!(output.status.success(), "{}", text(&output.stderr));
        json(&output.stdout)["alternatives"].as_array().expect("a list").clone()
    };
    let found = alternatives();
    assert!(found.len() > 1 && found[0] == "photo", "{found:?}");
    let listed = with_models(&models, &["objects", &run_text, "--json"]);
    assert!(listed.status.success(), "{}", text(&listed.stderr));
    assert!(json(&listed.stdout)["objects"].is_array(), "{}", text(&listed.stdout));

    // Other masks: another tree.
    let other = decoder(ToyDecoder { masks: 3, ..SAM });
    toy::write(&models, "mobile_sam", &encoder(Takes::Planes, ToyFault::None), &other);
    completes(&args);
    assert_ne!(tree(), before);

    // No tree without masks; a run makes them again, and grows it.
    for domain in ["masks.d", "objects.d"] {
        std::fs::remove_dir_all(run.join("cache").join(domain)).expect("it goes");
    }
    assert!(alternatives().is_empty());
    let refused = with_models(&models, &["objects", &run_text]);
    assert_eq!(refused.status.code(), Some(2), "{}", text(&refused.stderr));
    assert!(text(&refused.stderr).contains("no scene tree"), "{}", text(&refused.stderr));
    completes(&args);
    assert!(alternatives().len() > 1);
}

#[test]
fn a_text_selects_what_it_describes_and_its_alternatives_are_the_next_best() {
    if !can_run("a_text_selects_what_it_describes_and_its_alternatives_are_the_next_best") {
        return;
    }
    let dir = folder();
    let (models, run) = (dir.path().join("models"), copied_run(&dir));
    toy::clip::write_usual(&models);
    let (models_text, run_text) = (show(&models), show(&run));
    let args = ["segment", &run_text, "--text", "the red", "--name", "it", "--json"];
    let models_flag = ["--models", &models_text];
    let answer = json(works(&[&args[..], &models_flag].concat()).as_bytes());
    let matches = answer["ranking"]["matches"].as_array().expect("a list");
    assert!(matches.len() > 1 && matches[0]["photo"].is_string(), "{answer}");
    assert_eq!(answer["alternatives"].as_array().map(Vec::len), Some(matches.len()), "{answer}");
    let scores: Vec<f64> = matches.iter().map(|m| m["score"].as_f64().expect("a score")).collect();
    assert!(scores.is_sorted_by(|a, b| a >= b) && scores[0] <= 1.0, "{scores:?}");
    assert!(answer["splats"].as_u64().is_some_and(|splats| splats > 0), "{answer}");
    works(&["cache", "gc", &run_text]);
    let kept = works(&["cache", "ls", &run_text]);
    assert!(kept.contains("described"), "crops are embedded once: {kept}");
    // A text is kept as one, and ranked again.
    let prompts = show(&run.join("selections/it/prompts.json"));
    assert!(std::fs::read_to_string(&prompts).expect("it is there").contains("\"text\": \"the red\""));
    let of_file = ["segment", &run_text, "--prompts", &prompts, "--name", "again"];
    works(&[&of_file[..], &models_flag].concat());
    let object = |name: &str| {
        std::fs::read(run.join("selections").join(name).join("object.ply")).expect("it is there")
    };
    assert!(object("it") == object("again"));
    // Every match of the list can be selected.
    let last = (matches.len() - 1).to_string();
    let all = ["segment", &run_text, "--text", "all blue", "--name", "other", "--alternative", &last];
    let shown = works(&[&all[..], &models_flag].concat());
    assert!(shown.contains("`all blue` is "), "{shown}");
    assert!(object("it") != object("other"));
    // What cannot be answered.
    refuses(&["segment", &run_text, "--text", " ", "--models", &models_text], 2, &["the text is empty"]);
    refuses(&["segment", &run_text, "--text", "x", "--object", "1"], 2, &["--object"]);
    let without = ["segment", &run_text, "--text", "the dome"];
    refuses(&without, 3, &["no model of texts is here.", "clip-vit-base-patch32", "licence"]);
    std::fs::remove_file(models.join("tokenizer.json")).expect("it goes");
    refuses(
        &[&without[..], &models_flag].concat(),
        3,
        &["without its tokenizer: put `tokenizer.json` beside it"],
    );
    let page = works(&["doctor", "--models", &models_text]);
    assert!(page.contains("text_model.onnx: CLIP, text encoder, inputs and outputs of CLIP"), "{page}");
}

#[test]
fn half_a_pair_stops_a_run_that_asks_for_sam_and_no_other() {
    if !can_run("half_a_pair_stops_a_run_that_asks_for_sam_and_no_other") {
        return;
    }
    let dir = folder();
    let models = dir.path().join("models");
    toy::write_usual(&models);
    std::fs::remove_file(models.join("mobile_sam_decoder.onnx")).expect("it goes");
    let (models, run) = (show(&models), show(&dir.path().join("run")));
    let scene = show(scene());
    refuses(
        &["run", &scene, "--out", &run, "--models", &models, "--masks", "sam"],
        3,
        &["mobile_sam_encoder.onnx is an encoder without its decoder"],
    );
    let run = show(&dir.path().join("another"));
    let args = [&["run", &scene, "--out", &run, "--models", &models, "--until", "sky"][..], &QUICK].concat();
    works(&args);
}

#[test]
fn the_doctor_lists_networks_with_their_hash_and_licence() {
    if !can_run("the_doctor_lists_networks_with_their_hash_and_licence") {
        return;
    }
    let dir = folder();
    let models = dir.path().to_owned();
    toy::write_usual(&models);
    std::fs::write(models.join("edges_bsds.onnx"), b"\x89PNG and so on").expect("it is written");
    std::fs::write(models.join("strange.onnx"), b"").expect("it is written");
    let page = works(&["doctor", "--models", &show(&models)]);
    let file = std::fs::read(models.join("mobile_sam_encoder.onnx")).expect("it is there");
    let hash = blake3::hash(&file).to_hex().to_string();
    let line = page.lines().find(|l| l.contains("mobile_sam_encoder.onnx:")).expect("it is listed");
    assert!(line.contains("MobileSAM, encoder") && line.contains(&hash), "{line}");
    assert!(line.contains("inputs and outputs of SAM") && line.ends_with("; it is used"), "{line}");
    assert!(line.contains("licence: Apache-2.0"), "{line}");
    assert!(page.contains(
        "edges_bsds.onnx: edge network, boundaries, cannot be used: is no network: it is an image"
    ));
    assert!(page.contains("strange.onnx: a name that is not known"), "{page}");
    assert!(
        page.contains("SAM: MobileSAM `mobile_sam`") && page.contains("masks, clicks and refinement: SAM")
    );
    // And without any: what is used instead.
    let bare = folder();
    let page = works(&["doctor", "--models", &show(bare.path())]);
    assert!(page.contains("holds no .onnx file") && page.contains("built-in (SAM is not there"), "{page}");
    assert!(works(&["doctor"]).contains("no folder of models is given"));
}
