//! Folders with several networks: which pair is taken, and that `segwild doctor` and a run agree on every file.

use crate::toy::sam2::{SAMEXPORTER, TRACKER, TRANSFORMERS, blank, concept, decoder, encoder, video_decoder};
use crate::toy::{self, can_run, onnx::FLOAT, onnx::INT64};
use segwild_scene::{Image, Prompts};
use segwild_vision::{FileUse, ModelChoice, Providers, SamFileError, VisionError, VisionSettings, models_in};
use std::path::Path;

const STEM: &str = "sam2.1_hiera_tiny";

fn settings(folder: &Path, masks: ModelChoice) -> VisionSettings {
    VisionSettings { models: folder.display().to_string(), masks, ..VisionSettings::default() }
}

/// The names of the files that a run takes.
fn taken(all: &Providers) -> Vec<String> {
    let name = |file: &Path| file.file_name().unwrap().to_string_lossy().into_owned();
    all.networks.iter().map(|network| name(&network.file)).collect()
}

fn put(folder: &Path, name: &str, bytes: &[u8]) {
    std::fs::write(folder.join(name), bytes).unwrap();
}

/// Compares what the doctor says of each file with what a run takes and notes.
fn agree(folder: &Path) {
    let all = Providers::from_settings(&settings(folder, ModelChoice::Auto)).unwrap();
    let taken = taken(&all);
    let files = models_in(folder).unwrap();
    assert!(!files.is_empty());
    for file in files {
        let by_name = |note: &&String| note.contains(&format!("{}", folder.join(&file.name).display()));
        let noted: Vec<&String> = all.notes.iter().filter(by_name).collect();
        let is_taken = taken.contains(&file.name);
        assert_eq!(
            file.usage == FileUse::Taken,
            is_taken,
            "{}: {:?}; {:?}",
            file.name,
            file.usage,
            all.notes
        );
        match &file.usage {
            FileUse::Taken | FileUse::Single => {}
            FileUse::Choosable { stem } => {
                let also = |note: &String| note.contains("as well") && note.contains(stem.as_str());
                assert!(all.notes.iter().any(also), "{}: {:?}", file.name, all.notes);
            }
            usage => {
                let words = usage.to_string();
                assert!(noted.iter().any(|note| note.contains(&words)), "{}: {words}: {noted:?}", file.name);
            }
        }
    }
}

#[test]
fn the_doctor_and_a_run_agree_on_every_file() {
    if !can_run("the_doctor_and_a_run_agree_on_every_file") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    toy::write_usual(at);
    agree(at);
    toy::write(at, STEM, &encoder(&SAMEXPORTER), &decoder(&SAMEXPORTER));
    put(at, &format!("{STEM}_encoder_int8.onnx"), &encoder(&SAMEXPORTER));
    put(at, &format!("{STEM}.decoder.quant.onnx"), &decoder(&SAMEXPORTER));
    put(at, "vision_encoder.onnx", &encoder(&TRACKER));
    put(at, "prompt_encoder_mask_decoder.onnx", &decoder(&TRACKER));
    toy::write(at, "own", &encoder(&TRANSFORMERS), &decoder(&TRANSFORMERS));
    put(at, "efficientsam_s_decoder.onnx", &toy::decoder(toy::EFFICIENT));
    put(at, "sam2_hiera_small_encoder.onnx", &encoder(&SAMEXPORTER));
    put(at, "sam2_hiera_small_decoder.onnx", &video_decoder());
    concept().iter().for_each(|(name, bytes)| put(at, name, bytes));
    put(at, "a_name_of_nothing.onnx", &decoder(&SAMEXPORTER));
    put(at, "text.onnx", &blank(&[("input_ids", INT64, &[1, 8])], &[("last_hidden_state", &[1, 8, 16])]));
    put(at, "depth.onnx", &blank(&[("image", FLOAT, &[1, 3, 64, 64])], &[("depth", &[1, 1, 64, 64])]));
    put(at, "strange.onnx", b"");
    put(at, "edges_bsds.onnx", b"no network");
    agree(at);
    // Without the first pair the next one is taken, and so on.
    for name in ["mobile_sam", STEM] {
        std::fs::remove_file(at.join(format!("{name}_encoder.onnx"))).unwrap();
        agree(at);
    }
    let usage = |name: &str| models_in(at).unwrap().into_iter().find(|file| file.name == name).unwrap().usage;
    let is_refused = |name: &str| matches!(usage(name), FileUse::Refused(_));
    assert!(is_refused("sam3_decoder.onnx") && is_refused("sam3_language_encoder.onnx"));
    assert!(matches!(usage("sam2_hiera_small_decoder.onnx"), FileUse::Refused(SamFileError::Video { .. })));
    assert_eq!(usage("text.onnx"), FileUse::Unnamed { is: None });
    assert_eq!(usage("depth.onnx"), FileUse::Unnamed { is: None });
    assert_eq!(usage("a_name_of_nothing.onnx"), FileUse::Unnamed { is: Some("the decoder of SAM 2".into()) });
}

#[test]
fn a_quantised_file_is_taken_where_there_is_no_other() {
    if !can_run("a_quantised_file_is_taken_where_there_is_no_other") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    put(at, &format!("{STEM}.encoder.int8.onnx"), &encoder(&SAMEXPORTER));
    put(at, &format!("{STEM}.decoder.onnx"), &decoder(&SAMEXPORTER));
    put(at, &format!("{STEM}.decoder.int8.onnx"), &decoder(&SAMEXPORTER));
    let run = || Providers::from_settings(&settings(at, ModelChoice::Sam)).unwrap();
    let all = run();
    assert_eq!(taken(&all), [format!("{STEM}.encoder.int8.onnx"), format!("{STEM}.decoder.onnx")]);
    assert_eq!(all.name, format!("sam:{STEM}"));
    let note = all.notes.iter().find(|note| note.contains(".decoder.int8.onnx")).unwrap();
    assert!(note.contains(&format!("because {STEM}.decoder.onnx is there")), "{note}");
    put(at, &format!("{STEM}.encoder.onnx"), &encoder(&SAMEXPORTER));
    assert_eq!(taken(&run())[0], format!("{STEM}.encoder.onnx"));
}

#[test]
fn sam_3_of_text_and_exemplars_is_refused_by_name_and_its_tracker_is_served() {
    if !can_run("sam_3_of_text_and_exemplars_is_refused_by_name_and_its_tracker_is_served") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    concept().iter().for_each(|(name, bytes)| put(at, name, bytes));
    let image = Image::filled(40, 30, 3, 0.5);
    match Providers::from_settings(&settings(at, ModelChoice::Sam)).map(|_| ()) {
        Err(VisionError::Sam { file, reason }) => {
            assert!(file.display().to_string().contains("sam3_"), "{}", file.display());
            let words = reason.to_string();
            assert!(matches!(*reason, SamFileError::Concept { .. }), "{words}");
            for word in ["text", "exemplars", "no clicks", "prompt_encoder_mask_decoder.onnx"] {
                assert!(words.contains(word), "`{words}` does not say `{word}`");
            }
        }
        other => panic!("{other:?}"),
    }
    // Left to the program, it goes on without and names all three.
    let all = Providers::from_settings(&settings(at, ModelChoice::Auto)).unwrap();
    for (name, _) in concept() {
        let is = |note: &String| note.starts_with("SAM: not used:") && note.contains(name);
        assert!(all.notes.iter().any(is), "{name}: {:?}", all.notes);
    }
    assert_eq!(all.name, "built-in");
    // The decoder alone, under any name, is recognised as well.
    put(at, "decoder.onnx", &concept()[2].1);
    let files = models_in(at).unwrap();
    let bare = files.iter().find(|file| file.name == "decoder.onnx").unwrap();
    assert!(matches!(&bare.usage, FileUse::Refused(SamFileError::Concept { .. })), "{:?}", bare.usage);
    // The tracker takes clicks.
    put(at, "vision_encoder_fp16.onnx", &encoder(&TRACKER));
    put(at, "prompt_encoder_mask_decoder.onnx", &decoder(&TRACKER));
    let all = Providers::from_settings(&settings(at, ModelChoice::Sam)).unwrap();
    assert!(
        all.notes.iter().any(|note| note.starts_with("SAM: SAM 3 (tracker) `vision`")),
        "{:?}",
        all.notes
    );
    let answer = all.segmenter.segment(&image, &Prompts::click(20.0, 15.0)).unwrap();
    assert!(answer.mask.count() > 0);
    agree(at);
}

#[test]
fn parts_of_different_exports_are_refused_with_what_each_is() {
    if !can_run("parts_of_different_exports_are_refused_with_what_each_is") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let refused = |encoder: &[u8], decoder: &[u8], words: &[&str]| {
        toy::write(folder.path(), "sam", encoder, decoder);
        let error = Providers::from_settings(&settings(folder.path(), ModelChoice::Sam)).map(|_| ());
        let error = error.unwrap_err();
        assert!(matches!(error, VisionError::Sam { .. }), "{error:?}");
        let error = error.to_string();
        words.iter().for_each(|word| assert!(error.contains(word), "`{error}` does not say `{word}`"));
        agree(folder.path());
    };
    let old = toy::encoder(toy::Takes::Planes, toy::ToyFault::None);
    refused(&old, &decoder(&SAMEXPORTER), &["a decoder of SAM 2's kind", "an encoder of SAM's"]);
    let kinds = ["a decoder of SAM's kind", "an encoder of SAM 2's", "sam_encoder.onnx"];
    refused(&encoder(&SAMEXPORTER), &toy::decoder(toy::SAM), &kinds);
    // The embedding of 64 cells where the decoder takes 72.
    let sizes = ["`image_embeddings.2`", "[1, 256, 72, 72]", "float32 [1, 256, 64, 64], which"];
    refused(&encoder(&TRANSFORMERS), &decoder(&TRACKER), &sizes);
    refused(&encoder(&SAMEXPORTER), &video_decoder(), &["sam_decoder.onnx", "no scores", "export_sam2"]);
    let shape: &[i64] = &[1, 3, 1024, 1024];
    let points =
        [("image_embed", FLOAT, shape), ("high_res_feats_0", FLOAT, shape), ("clicks", FLOAT, shape)];
    let odd = blank(&points, &[("masks", shape)]);
    refused(
        &encoder(&SAMEXPORTER),
        &odd,
        &["clicks", "takes image_embed, high_res_feats_0, high_res_feats_1"],
    );
}
