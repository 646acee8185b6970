//! Networks by ONNX Runtime: the real files where they are, and everything that can be wrong with them.

use segwild_scene::Image;
use segwild_vision::{EdgeChoice, Providers, SkyChoice, VisionSettings};
use std::path::{Path, PathBuf};

/// The folder of network files, or a line that says what is missing.
fn models(test: &str) -> Option<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let shared = std::env::var_os("SEGWILD_SHARED").map_or_else(|| root.join("../shared"), PathBuf::from);
    let folder = shared.join("models");
    if !folder.join("edges_bsds.onnx").is_file() {
        eprintln!("skipped: {test}: {} has no network files", folder.display());
        return None;
    }
    if let Err(error) = segwild_vision::Runtime::find("") {
        eprintln!("skipped: {test}: {error}");
        return None;
    }
    Some(folder.display().to_string())
}

/// A dark square on a bright ground, under a blue sky.
fn photo() -> Image {
    let (w, h) = (100, 75);
    let mut image = Image::zeros(w, h, 3);
    for i in 0..w * h {
        let (x, y) = (i % w, i / w);
        let colour = if (30..60).contains(&x) && (20..60).contains(&y) {
            [0.2, 0.15, 0.1]
        } else if y < 40 {
            [0.45, 0.65, 0.95]
        } else {
            [0.5, 0.55, 0.35]
        };
        (0..3).for_each(|c| image.data[c * w * h + i] = colour[c]);
    }
    image
}

#[test]
fn networks_serve_when_they_are_given() {
    let Some(models) = models("networks_serve_when_they_are_given") else { return };
    let settings = VisionSettings { models, ..VisionSettings::default() };
    let all = Providers::from_settings(&settings).unwrap();
    assert!(all.notes.iter().any(|n| n.starts_with("boundaries: network")), "{:?}", all.notes);
    assert!(all.embedder.key().contains("+edges-"), "the network is part of every key");
    // Selections are better with the built-in detector's skies; a note names the setting that takes the network.
    let is_note = |n: &String| n.starts_with("sky: built-in detector") && n.contains("network");
    assert!(all.notes.iter().any(is_note), "{:?}", all.notes);
    let image = photo();
    // A box beside the click: the network's soft outline leaves a click alone several shapes to choose from.
    let corners = segwild_scene::BoxPrompt { x0: 27.0, y0: 17.0, x1: 63.0, y1: 63.0 };
    let prompts =
        segwild_scene::Prompts { boxes: vec![corners], ..segwild_scene::Prompts::click(45.0, 40.0) };
    let mask = all.segmenter.segment(&image, &prompts).unwrap().mask;
    let square = segwild_scene::Mask::from_fn(100, 75, |x, y| (30..60).contains(&x) && (20..60).contains(&y));
    assert!(mask.iou(&square) > 0.85, "{}", mask.iou(&square));
    for sky in [SkyChoice::Network, SkyChoice::Both, SkyChoice::Deeplab] {
        let these = Providers::from_settings(&VisionSettings { sky, ..settings.clone() }).unwrap();
        assert!(these.notes.iter().any(|n| n.starts_with("sky: network")), "{:?}", these.notes);
        let mask = these.sky.sky(&image).unwrap();
        assert_eq!((mask.width(), mask.height()), (100, 75));
        assert!(!mask.at(45.0, 55.0), "{sky}: the square's foot is no sky");
    }
}

#[test]
fn the_sky_of_a_network_and_of_the_colours_is_taken_together_and_taken_back_where_points_lie() {
    let test = "the_sky_of_a_network_and_of_the_colours_is_taken_together_and_taken_back_where_points_lie";
    let Some(models) = models(test) else { return };
    let of = |sky| {
        let settings = VisionSettings { models: models.clone(), sky, ..VisionSettings::default() };
        Providers::from_settings(&settings).unwrap().sky
    };
    let (image, both) = (photo(), of(SkyChoice::Both));
    let apart = [of(SkyChoice::Network), of(SkyChoice::Builtin)].map(|s| s.sky(&image).unwrap());
    assert!(apart.iter().all(|sky| sky.count() > 1000), "each finds one: {:?}", apart.map(|s| s.count()));
    assert_eq!(both.sky(&image).unwrap(), apart[0].or(&apart[1]));
    // A grid of points over the whole photo: nothing there is open.
    let points: Vec<[f32; 2]> =
        (0..300).map(|i| [(i % 20) as f32 * 5.0 + 2.5, (i / 20) as f32 * 5.0 + 2.5]).collect();
    assert!(both.by_points() && both.sky_above(&image, &points).unwrap().is_empty());
    let unlike = [SkyChoice::Both, SkyChoice::Network, SkyChoice::Builtin].map(|sky| of(sky).key());
    assert!(unlike[0] != unlike[1] && unlike[0] != unlike[2], "{unlike:?}");
}

#[test]
fn files_that_do_not_fit_are_refused_with_a_reason() {
    let Some(models) = models("files_that_do_not_fit_are_refused_with_a_reason") else { return };
    let folder = tempfile::tempdir().unwrap();
    let text = |edges, sky| {
        let settings = VisionSettings {
            models: folder.path().display().to_string(),
            edges,
            sky,
            ..VisionSettings::default()
        };
        Providers::from_settings(&settings).map(|_| ()).unwrap_err().to_string()
    };
    // A sky network where the edge network should be answers one map and passes; Cityscapes answers 19.
    std::fs::copy(format!("{models}/deeplab_cityscapes_513.onnx"), folder.path().join("edges_bsds.onnx"))
        .unwrap();
    assert!(text(EdgeChoice::Network, SkyChoice::None).contains("answers 19 maps"));
    std::fs::write(folder.path().join("sky_small_384.onnx"), b"no network").unwrap();
    assert!(
        text(EdgeChoice::Builtin, SkyChoice::Network).contains("sky_small_384.onnx: is no whole ONNX file")
    );
    assert!(text(EdgeChoice::Builtin, SkyChoice::Deeplab).contains("has no such file"));
    // Where it is left to the program, it goes on without and says why.
    let settings =
        VisionSettings { models: folder.path().display().to_string(), ..VisionSettings::default() };
    let notes = Providers::from_settings(&settings).unwrap().notes;
    assert!(
        notes.iter().any(|n| n.contains("built-in detector, because the network cannot be used")),
        "{notes:?}"
    );
}

#[test]
fn without_networks_the_built_in_provider_serves() {
    let all = Providers::from_settings(&VisionSettings::default()).unwrap();
    assert!(all.notes.iter().all(|n| n.contains("built-in")), "{:?}", all.notes);
    assert!(all.sky.sky(&photo()).is_ok());
    let none = VisionSettings { sky: SkyChoice::None, ..VisionSettings::default() };
    assert!(Providers::from_settings(&none).unwrap().sky.sky(&photo()).unwrap().is_empty());
    let lost = VisionSettings { models: "/no/such/folder".into(), ..VisionSettings::default() };
    assert!(Providers::from_settings(&lost).map(|_| ()).unwrap_err().to_string().contains("does not exist"));
    let settings = VisionSettings { edges: EdgeChoice::Network, ..VisionSettings::default() };
    assert!(
        Providers::from_settings(&settings)
            .map(|_| ())
            .unwrap_err()
            .to_string()
            .contains("no folder of models")
    );
}

#[test]
fn persons_and_vehicles_come_from_a_network_of_classes_and_from_no_other() {
    let Some(models) = models("persons_and_vehicles_come_from_a_network_of_classes_and_from_no_other") else {
        return;
    };
    let named = |file: &str| VisionSettings {
        transient_network: Path::new(&models).join(file).display().to_string(),
        ..VisionSettings::default()
    };
    let all = Providers::from_settings(&named("deeplab_cityscapes_513.onnx")).unwrap();
    let transients = all.transients.expect("a network was named");
    let mask = transients.transients(&photo()).unwrap();
    assert_eq!((mask.width(), mask.height()), (100, 75));
    assert!(mask.count() < 750, "a square under the sky is neither person nor vehicle: {}", mask.count());
    assert!(transients.key().starts_with("transients-"), "its file is in every key");
    let refused = Providers::from_settings(&named("sky_small_384.onnx")).err().expect("one map").to_string();
    assert!(refused.contains("sky_small_384.onnx") && refused.contains("19 classes"), "{refused}");
    let missing = Providers::from_settings(&named("none.onnx")).err().expect("no file").to_string();
    assert!(missing.contains("none.onnx"), "{missing}");
    assert!(Providers::from_settings(&VisionSettings::default()).unwrap().transients.is_none());
}
