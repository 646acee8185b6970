//! Files of the SAM family that are not what they should be: half a pair, something else, cut short, hostile. Each is refused
//! with a message that names the file; the program goes on.

use crate::toy::onnx::{OPEN, OnnxGraph, tensor, tensor_elsewhere};
use crate::toy::{self, EFFICIENT, SAM, Takes, ToyDecoder, ToyFault, can_run, decoder, encoder};
use segwild_scene::{Image, Prompts};
use segwild_vision::{DeviceChoice, ModelChoice, Providers, VisionSettings};
use std::path::Path;
use std::time::Instant;

fn settings(folder: &Path) -> VisionSettings {
    VisionSettings {
        models: folder.display().to_string(),
        masks: ModelChoice::Sam,
        ..VisionSettings::default()
    }
}

/// Asks for SAM from a folder with these files, and expects words.
fn refused(encoder: &[u8], decoder: &[u8], words: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    toy::write(folder.path(), "sam", encoder, decoder);
    let error = Providers::from_settings(&settings(folder.path())).map(|_| ()).unwrap_err().to_string();
    for word in words {
        assert!(error.contains(word), "`{error}` does not say `{word}`");
    }
    // Where it is left to the program, it goes on without and says why.
    let auto = VisionSettings { masks: ModelChoice::Auto, ..settings(folder.path()) };
    let notes = Providers::from_settings(&auto).unwrap().notes;
    assert!(notes.iter().any(|n| n.starts_with("SAM: not used:") && n.contains(words[0])), "{notes:?}");
    assert!(notes.iter().any(|n| n.starts_with("masks, clicks and refinement: built-in")), "{notes:?}");
}

/// What goes wrong with a click on a photo, by these files.
fn error_of(encoder: &[u8], decoder: &[u8], change: impl Fn(&mut VisionSettings)) -> String {
    error_with(encoder, decoder, change, &Prompts::click(20.0, 15.0))
}

fn error_with(
    encoder: &[u8],
    decoder: &[u8],
    change: impl Fn(&mut VisionSettings),
    prompts: &Prompts,
) -> String {
    let folder = tempfile::tempdir().unwrap();
    toy::write(folder.path(), "sam", encoder, decoder);
    let mut settings = settings(folder.path());
    change(&mut settings);
    let answer = Providers::from_settings(&settings)
        .and_then(|all| all.segmenter.segment(&Image::filled(40, 30, 3, 0.5), prompts));
    answer.map(|_| ()).unwrap_err().to_string()
}

fn good() -> (Vec<u8>, Vec<u8>) {
    (encoder(Takes::Planes, ToyFault::None), decoder(SAM))
}

#[test]
fn what_is_missing_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let says = |settings: &VisionSettings, words: &[&str]| {
        let error = Providers::from_settings(settings).map(|_| ()).unwrap_err().to_string();
        words.iter().for_each(|w| assert!(error.contains(w), "`{error}` does not say `{w}`"));
    };
    says(&settings(folder.path()), &["holds no pair", "mobile_sam_encoder.onnx"]);
    says(&VisionSettings { models: String::new(), ..settings(folder.path()) }, &["no folder of models"]);
    says(&VisionSettings { sam: "own".into(), ..settings(folder.path()) }, &["own_encoder.onnx"]);
    std::fs::write(folder.path().join("sam_vit_b_encoder.onnx"), b"x").unwrap();
    says(&settings(folder.path()), &["without its decoder", "sam_vit_b_decoder.onnx"]);
    let auto = VisionSettings { masks: ModelChoice::Auto, ..settings(folder.path()) };
    let notes = Providers::from_settings(&auto).unwrap().notes;
    assert!(notes.iter().any(|n| n.contains("without its decoder")), "{notes:?}");
}

#[test]
fn files_of_another_kind_are_refused() {
    if !can_run("files_of_another_kind_are_refused") {
        return;
    }
    let (e, d) = good();
    refused(b"\x89PNG\r\n\x1a\nand so on", &d, &["it is an image", "sam_encoder.onnx"]);
    refused(&e, b"PK\x03\x04and so on", &["ZIP archive", "sam_decoder.onnx"]);
    refused(b"version https://git-lfs.github.com/spec/v1\n", &d, &["Git LFS"]);
    refused(b"<!doctype html>", &d, &["web page"]);
    refused(b"", &d, &["the file is empty"]);
    refused(b"no network at all, but text", &d, &["is no whole ONNX file"]);
    refused(&d, &e, &["takes 6 inputs", "an image encoder takes one photo"]);
    refused(&e, &e, &["takes image; a prompted decoder takes image_embeddings, point_coords"]);
    let efficient = decoder(EFFICIENT);
    refused(&e, &efficient, &["a decoder of EfficientSAM's kind", "an encoder of SAM's"]);
    refused(&encoder(Takes::Whole, ToyFault::None), &d, &["a decoder of SAM's kind"]);
}

#[test]
fn a_file_that_is_cut_short_anywhere_is_refused() {
    if !can_run("a_file_that_is_cut_short_anywhere_is_refused") {
        return;
    }
    let (e, d) = good();
    for n in [1, 2, 10, d.len() / 3, d.len() / 2, d.len() - 100, d.len() - 1] {
        refused(&e, &d[..n], &["sam_decoder.onnx"]);
    }
    refused(&e[..e.len() - 1000], &d, &["is no whole ONNX file", "it ends too early"]);
}

#[test]
fn shapes_that_do_not_fit_are_refused() {
    if !can_run("shapes_that_do_not_fit_are_refused") {
        return;
    }
    let (e, d) = good();
    let strange = |input: (&str, &[i64]), output: (&str, &[i64])| {
        let mut g = OnnxGraph::default();
        g.input(input.0, 1, input.1);
        g.op_to("Identity", &[input.0], output.0, vec![]);
        g.output(output.0, 1, output.1);
        g.file()
    };
    let wide = [1, 3, OPEN, OPEN];
    refused(
        &strange(("photo", &[1, 4, 64, 64]), ("out", &[1, 4, 64, 64])),
        &d,
        &["float32 [1, 4, 64, 64]", "`photo`"],
    );
    refused(&strange(("photo", &wide), ("out", &wide)), &d, &["which", "answers", "`image_embeddings`"]);
    refused(
        &strange(("photo", &[1, 3, 90000, 3]), ("out", &[1, 3, 90000, 3])),
        &d,
        &["none of an image encoder"],
    );
    refused(
        &strange(("photo", &[1, 3, 1_000_000, 1_000_000]), ("out", &wide)),
        &d,
        &["declared as 1 x 3 x 1000000 x 1000000"],
    );
    // Answers that are not what the file declares, or no numbers, are found when they come.
    let half = error_of(&encoder(Takes::Planes, ToyFault::Half), &d, |_| ());
    assert!(half.contains("sam_encoder.onnx: answered [1, 256, 64, 32] on a photo of 40 x 30"), "{half}");
    let nan = error_of(&encoder(Takes::Planes, ToyFault::NoNumber), &d, |_| ());
    assert!(nan.contains("values that are no numbers on a photo of 40 x 30"), "{nan}");
    let spoilt = error_of(&e, &decoder(ToyDecoder { spoilt: true, ..SAM }), |_| ());
    assert!(spoilt.contains("4 values that are no numbers"), "{spoilt}");
    let many = decoder(ToyDecoder { queries: 4096, small: false, ..EFFICIENT });
    refused(&encoder(Takes::Whole, ToyFault::None), &many, &["takes 4096 prompts at a time"]);
    let one_point = decoder(ToyDecoder { points: 1, ..SAM });
    let mut two = Prompts::click(20.0, 15.0);
    two.points.extend(Prompts::click(5.0, 5.0).points);
    let few = error_with(&e, &one_point, |_| (), &two);
    assert!(few.contains("takes 1 points at a time, and 2 were given"), "{few}");
}

#[test]
fn a_network_without_end_is_stopped() {
    if !can_run("a_network_without_end_is_stopped") {
        return;
    }
    let began = Instant::now();
    let error = error_of(&encoder(Takes::Planes, ToyFault::Endless), &decoder(SAM), |s| s.network_limit = 1);
    assert!(error.contains("was stopped") && error.contains("after 1 seconds"), "{error}");
    assert!(began.elapsed().as_secs() < 60);
}

#[test]
fn a_file_that_wants_gigabytes_gets_none() {
    if !can_run("a_file_that_wants_gigabytes_gets_none") {
        return;
    }
    for fault in [ToyFault::Huge, ToyFault::HugeAtOnce] {
        let error = error_of(&encoder(Takes::Planes, fault), &decoder(SAM), |_| ());
        assert!(error.contains("`network_memory`"), "{error}");
    }
    if let Ok(status) = std::fs::read_to_string("/proc/self/status") {
        let peak = status.lines().find_map(|l| l.strip_prefix("VmHWM:")).unwrap();
        let kib: u64 = peak.trim().trim_end_matches(" kB").parse().unwrap();
        assert!(kib < 2 << 20, "the process held {kib} KiB");
    }
    // A weight that says it is larger than its file.
    let claims = |dims: &[i64]| {
        let mut g = OnnxGraph::default();
        g.input("image", 1, &[1, 3, 1024, 1024]);
        g.weight(&tensor("w", 1, dims, &[0; 64]));
        g.op_to("Identity", &["w"], "image_embeddings", vec![]);
        g.output("image_embeddings", 1, &[1, 256, 64, 64]);
        g.file()
    };
    for dims in [&[1 << 40, 4][..], &[i64::MAX, i64::MAX], &[-1, 4], &[100_000, 100_000]] {
        refused(&claims(dims), &decoder(SAM), &["its weight `w` claims"]);
    }
}

#[test]
fn weights_outside_of_the_folder_are_not_followed() {
    if !can_run("weights_outside_of_the_folder_are_not_followed") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().join("models");
    let secret = folder.path().join("secret.bin");
    std::fs::write(&secret, vec![0; 4096]).unwrap();
    let outside = secret.display().to_string();
    let wants = |entries: &[(&str, &str)]| {
        let mut g = OnnxGraph::default();
        g.input("image", 1, &[1, 3, 1024, 1024]);
        g.weight(&tensor_elsewhere("w", &[1, 256, 2, 2], entries));
        g.op_to("Identity", &["w"], "image_embeddings", vec![]);
        g.output("image_embeddings", 1, &[1, 256, 2, 2]);
        g.file()
    };
    let says = |entries: &[(&str, &str)], word: &str| {
        toy::write(&models, "sam", &wants(entries), &decoder(SAM));
        let error = Providers::from_settings(&settings(&models)).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains(word) && error.contains("sam_encoder.onnx"), "{error}");
    };
    for location in ["../secret.bin", &outside, "", "a/../../secret.bin", "..\\secret.bin"] {
        says(&[("location", location)], "outside its folder");
    }
    says(&[("location", "none.bin")], "cannot be read");
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(&secret, models.join("link.bin")).unwrap();
        says(&[("location", "link.bin")], "outside its folder");
    }
    std::fs::write(models.join("own.bin"), vec![0; 4096]).unwrap();
    says(&[("location", "own.bin"), ("offset", "4000"), ("length", "4096")], "which has 4096");
    says(&[("location", "own.bin"), ("length", "many")], "`many`");
    // Beside the file they serve, and their bytes count in the key: here they are read, and the shape is what is wrong.
    says(&[("location", "own.bin"), ("length", "4096")], "answers,");
}

#[test]
fn the_key_follows_weights_beside_the_file() {
    if !can_run("the_key_follows_weights_beside_the_file") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    // The encoder's positions: two planes of zeros, 32 KiB, in a file of their own.
    let mut g = OnnxGraph::default();
    g.input("image", 1, &[1, 3, 1024, 1024]);
    g.weight(&tensor_elsewhere("w", &[1, 256, 64, 64], &[("location", "sam.data"), ("length", "4194304")]));
    g.op_to("Identity", &["w"], "image_embeddings", vec![]);
    g.output("image_embeddings", 1, &[1, 256, 64, 64]);
    toy::write(folder.path(), "sam", &g.file(), &decoder(SAM));
    let embed = |value: f32| {
        let data: Vec<u8> = std::iter::repeat_n(value.to_le_bytes(), 1 << 20).flatten().collect();
        std::fs::write(folder.path().join("sam.data"), data).unwrap();
        let settings = VisionSettings { embedder: ModelChoice::Sam, ..settings(folder.path()) };
        let all = Providers::from_settings(&settings).unwrap();
        let image = Image::filled(40, 40, 3, 0.5);
        (all.embedder.key(), all.embedder.embed(&image).unwrap().data[5])
    };
    let (one, two) = (embed(1.0), embed(2.0));
    assert_eq!((one.1, two.1), (1.0, 2.0));
    assert_ne!(one.0, two.0);
}

#[test]
fn cuda_is_refused_where_the_runtime_has_none() {
    if !can_run("cuda_is_refused_where_the_runtime_has_none") {
        return;
    }
    if segwild_vision::Runtime::find("").unwrap().has_cuda() {
        eprintln!("skipped: cuda_is_refused_where_the_runtime_has_none: this one has it");
        return;
    }
    let (e, d) = good();
    let error = error_of(&e, &d, |s| s.network_device = DeviceChoice::Cuda);
    assert!(error.contains("built without CUDA") && error.contains("onnxruntime-gpu"), "{error}");
    let folder = tempfile::tempdir().unwrap();
    toy::write_usual(folder.path());
    // Left to itself it computes on the CPU, and says so.
    let all = Providers::from_settings(&settings(folder.path())).unwrap();
    assert!(all.notes.iter().any(|n| n.contains("on the CPU")), "{:?}", all.notes);
}

#[test]
fn a_file_with_bytes_changed_anywhere_does_not_take_the_program_down() {
    if !can_run("a_file_with_bytes_changed_anywhere_does_not_take_the_program_down") {
        return;
    }
    let (e, good) = good();
    let folder = tempfile::tempdir().unwrap();
    let image = Image::filled(40, 30, 3, 0.5);
    let mut refused = 0;
    for k in 0..150 {
        let mut d = good.clone();
        let at = k * 7919 % d.len();
        d[at] = [0, 255, d[at] ^ 1, d[at] ^ 128][k % 4];
        toy::write(folder.path(), "sam", &e, &d);
        let settings = VisionSettings { network_limit: 5, ..settings(folder.path()) };
        // Some changes do no harm; the others are errors.
        let answer = Providers::from_settings(&settings)
            .and_then(|all| all.segmenter.segment(&image, &Prompts::click(20.0, 15.0)));
        refused += usize::from(answer.is_err());
    }
    assert!(refused > 30, "{refused} of 150 were refused");
}
