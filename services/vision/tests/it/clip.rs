//! CLIP by small networks of its interface: which files of a folder are taken, and what texts and images are embedded as.

use crate::toy::can_run;
use crate::toy::clip::{
    FIXED_TEXT, USUAL_TEXT, both_encoders, image_encoder, text_encoder, tokenizer, tokenizer_parts,
    write_usual,
};
use crate::toy::onnx::OPEN;
use segwild_scene::Image;
use segwild_vision::{FileUse, Providers, VisionServiceOptions, VisionSettings, models_in, serve_vision};
use std::path::Path;

fn providers(folder: &Path) -> Providers {
    let settings = VisionSettings { models: folder.display().to_string(), ..VisionSettings::default() };
    Providers::from_settings(&settings).unwrap()
}

fn put(folder: &Path, name: &str, bytes: &[u8]) {
    std::fs::write(folder.join(name), bytes).unwrap();
}

fn coloured(colour: [f32; 3], side: usize) -> Image {
    let data = colour.iter().flat_map(|&v| std::iter::repeat_n(v, side * side)).collect();
    Image { width: side, height: side, channels: 3, data }
}

/// Cosines of texts, row by row, with a red, a green and a blue image.
fn cosines(folder: &Path, texts: &[&str]) -> Vec<[f32; 3]> {
    let all = providers(folder);
    let model = all.text_embedder().unwrap();
    let images = [[0.9, 0.1, 0.1], [0.1, 0.9, 0.1], [0.1, 0.1, 0.9]].map(|colour| coloured(colour, 40));
    let images = model.embed_images(&images).unwrap();
    let texts: Vec<String> = texts.iter().map(|text| (*text).to_owned()).collect();
    let texts = model.embed_texts(&texts).unwrap();
    for embedding in images.iter().chain(&texts) {
        let length: f32 = embedding.iter().map(|v| v * v).sum();
        assert!((length - 1.0).abs() < 1e-4, "{embedding:?}");
    }
    let cosine = |text: &[f32], image: &[f32]| -> f32 { text.iter().zip(image).map(|(a, b)| a * b).sum() };
    texts.iter().map(|text| [0, 1, 2].map(|k| cosine(text, &images[k]))).collect()
}

#[test]
fn a_text_is_nearest_to_the_image_that_it_describes_in_every_export() {
    if !can_run("a_text_is_nearest_to_the_image_that_it_describes_in_every_export") {
        return;
    }
    let texts = ["a photo of red", "a photo of GREEN things", "blue"];
    let of = |fill: &dyn Fn(&Path)| {
        let folder = tempfile::tempdir().unwrap();
        fill(folder.path());
        cosines(folder.path(), &texts)
    };
    let usual = of(&|at| write_usual(at));
    for (k, row) in usual.iter().enumerate() {
        let others = row.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, cosine)| *cosine);
        assert!(others.fold(f32::MIN, f32::max) + 0.5 < row[k], "{usual:?}");
    }
    let same = |other: &[[f32; 3]]| {
        usual.iter().flatten().zip(other.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-4)
    };
    let together = of(&|at| {
        put(at, "model.onnx", &both_encoders());
        put(at, "tokenizer.json", tokenizer().as_bytes());
    });
    assert!(same(&together), "{together:?}");
    let fixed = of(&|at| {
        put(at, "clip_image_encoder.onnx", &image_encoder(32));
        put(at, "clip_text_encoder.onnx", &text_encoder(FIXED_TEXT));
        let [vocabulary, merges] = tokenizer_parts();
        put(at, "clip_vocab.json", vocabulary.as_bytes());
        put(at, "merges.txt", merges.as_bytes());
    });
    assert!(same(&fixed), "{fixed:?}");
}

#[test]
fn a_service_embeds_texts_and_crops_as_its_model_does() {
    if !can_run("a_service_embeds_texts_and_crops_as_its_model_does") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    write_usual(folder.path());
    let here = providers(folder.path());
    let address = "127.0.0.1:0".parse().unwrap();
    let serve = |models: &Path| {
        let options = VisionServiceOptions { address, token: None, memory: 64 << 20, parallel: 1, tls: None };
        serve_vision(providers(models), options).unwrap()
    };
    // One of two machines has no files of CLIP: runs use both, and texts go to the other one.
    let empty = tempfile::tempdir().unwrap();
    let (plain, server) = (serve(empty.path()), serve(folder.path()));
    let settings = VisionSettings {
        vision_service: format!("grpc://{},grpc://{}", plain.address(), server.address()),
        ..VisionSettings::default()
    };
    let there = Providers::from_settings(&settings).unwrap();
    let (here, there) = (here.text_embedder().unwrap(), there.text_embedder().unwrap());
    assert_eq!(there.key().unwrap(), format!("service {}", here.key().unwrap()));
    let crops = [coloured([0.8, 0.2, 0.3], 24), coloured([0.1, 0.5, 0.7], 30)];
    assert_eq!(there.embed_images(&crops).unwrap(), here.embed_images(&crops).unwrap());
    // More than one call may have.
    let texts: Vec<String> = (0..70).map(|i| ["a photo of red", "blue things"][i % 2].to_owned()).collect();
    assert_eq!(there.embed_texts(&texts).unwrap(), here.embed_texts(&texts).unwrap());
}

#[test]
fn files_of_clip_are_known_by_their_inputs_and_say_what_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let usage = |name: &str| models_in(at).unwrap().into_iter().find(|file| file.name == name).unwrap().usage;
    let words = |name: &str| usage(name).to_string();
    let refusal = || providers(at).text_embedder().map(|_| ()).unwrap_err().to_string();
    let none = refusal();
    assert!(!none.contains("  "), "`{none}` has runs of spaces");
    for word in ["vision_model.onnx", "tokenizer.json", "Xenova/clip-vit-base-patch32", "licence"] {
        assert!(none.contains(word), "`{none}` does not say `{word}`");
    }
    put(at, "text_model_quantized.onnx", &text_encoder(USUAL_TEXT));
    assert!(
        words("text_model_quantized.onnx").contains("without its image encoder: put `vision_model.onnx`")
    );
    assert!(
        refusal().contains("text_model_quantized.onnx is a text encoder of CLIP without"),
        "{}",
        refusal()
    );
    put(at, "vision_model.onnx", &image_encoder(OPEN));
    assert!(words("vision_model.onnx").contains("without its tokenizer: put `tokenizer.json`"));
    put(at, "tokenizer.json", tokenizer().as_bytes());
    assert_eq!(
        [usage("vision_model.onnx"), usage("text_model_quantized.onnx")],
        [FileUse::Texts, FileUse::Texts]
    );
    put(at, "text_model.onnx", &text_encoder(USUAL_TEXT));
    put(at, "model.onnx", &both_encoders());
    put(at, "other_model.onnx", &both_encoders());
    assert_eq!(usage("text_model.onnx"), FileUse::Texts);
    assert_eq!(words("text_model_quantized.onnx"), "is not used, because text_model.onnx is there");
    for name in ["model.onnx", "other_model.onnx"] {
        assert_eq!(words(name), "is not used, because vision_model.onnx is there");
    }
    let listed = models_in(at).unwrap();
    let of = |name: &str| listed.iter().find(|file| file.name == name).unwrap();
    assert_eq!(
        (of("text_model.onnx").role, of("text_model.onnx").interface),
        (Some("text encoder"), Some("CLIP"))
    );
    assert_eq!(of("model.onnx").role, Some("image and text encoder"));
    // SAM's search passes over them, and a run notes each.
    let all = providers(at);
    assert_eq!(all.name, "built-in");
    assert!(!all.notes.iter().any(|note| note.starts_with("SAM: not used")), "{:?}", all.notes);
    for file in &listed {
        assert!(all.notes.iter().any(|note| note.contains(&at.join(&file.name).display().to_string())));
    }
    assert!(all.networks.is_empty(), "no run depends on them");
    // Encoders that cannot be used.
    put(
        at,
        "text_model.onnx",
        &crate::toy::sam2::blank(
            &[("input_ids", crate::toy::onnx::INT64, &[1, 8])],
            &[("text_embeds", &[1, 7])],
        ),
    );
    assert!(
        words("text_model.onnx").contains("answers 7 numbers per text, and vision_model.onnx 4 per image")
    );
    assert!(words("vision_model.onnx").contains("because text_model.onnx cannot be"));
    put(at, "vision_model.onnx", &image_encoder(9000));
    assert!(words("vision_model.onnx").contains("16 to 1024 pixels"), "{}", words("vision_model.onnx"));
}

#[test]
fn a_damaged_tokenizer_is_an_error_with_its_file() {
    if !can_run("a_damaged_tokenizer_is_an_error_with_its_file") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    write_usual(at);
    for (text, word) in [
        ("{\"model\": {\"type\": \"WordPiece\"}}", "WordPiece"),
        ("{\"model\": {}}", "ends a word"),
        ("[", "stands beside a CLIP model"),
    ] {
        put(at, "tokenizer.json", text.as_bytes());
        let error = providers(at).text_embedder().unwrap().key().unwrap_err().to_string();
        assert!(error.contains("tokenizer.json") && error.contains(word), "{error}");
    }
    put(at, "tokenizer.json", tokenizer().as_bytes());
    put(at, "preprocessor_config.json", b"{\"crop_size\": 7}");
    let error = providers(at).text_embedder().unwrap().key().unwrap_err().to_string();
    assert!(error.contains("preprocessor_config.json") && error.contains("`crop_size`"), "{error}");
    let of_sam = br#"{"image_processor_type": "SamImageProcessor", "size": {"longest_edge": 1024}}"#;
    put(at, "preprocessor_config.json", of_sam);
    let all = providers(at);
    all.text_embedder().unwrap().key().unwrap();
    assert!(all.notes.iter().any(|note| note.contains("`SamImageProcessor`")), "{:?}", all.notes);
}
