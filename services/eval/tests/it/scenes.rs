//! Protocols on data that lies as they expect it, and on data that does not.

use segwild_eval::ablation::VARIANTS;
use segwild_eval::baselines::BASELINES;
use segwild_eval::protocols::folder::{self, FolderProtocol, Parts};
use segwild_eval::protocols::lego::Perturbation;
use segwild_eval::protocols::nvos::{self, NvosProtocol};
use segwild_eval::protocols::paper::{PAPER, PaperScene, PaperTarget, targets};
use segwild_eval::protocols::photo_tourism::{self, PhotoTourismProtocol};
use segwild_eval::protocols::spin_nerf::{self, SpinNerfProtocol};
use segwild_eval::protocols::{EvalScene, ProtocolBase, Table, measure};
use segwild_eval::record::Results;
use segwild_pipeline::{Preset, Settings};
use segwild_scene::Mask;
use segwild_synthetic::{LightVariation, SyntheticOptions, SyntheticScene, generate};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// A small scene; its photos are named `names`, or as they come.
fn scene(train: usize, long_side: u32, names: &[String]) -> SyntheticScene {
    let options = SyntheticOptions {
        seed: 5,
        train,
        test: 1,
        long_side,
        points: 1500,
        occlusion: 0.0,
        photo_light: LightVariation::None,
        ..SyntheticOptions::default()
    };
    let mut scene = generate(&options).unwrap();
    for (photo, name) in scene.photos.iter_mut().filter(|p| !p.test).zip(names) {
        photo.name = format!("{name}.png");
    }
    scene
}

fn words<T: std::fmt::Debug>(refused: Result<T, impl std::fmt::Display>) -> String {
    match refused {
        Err(error) => error.to_string(),
        Ok(value) => panic!("it should have been refused: {value:?}"),
    }
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to.parent().unwrap()).unwrap();
    std::fs::copy(from, to).unwrap();
}

#[test]
fn baselines_are_valid_settings_and_none_is_ours_under_another_name() {
    let base = Settings::preset(Preset::Draft);
    let mut names = BTreeSet::new();
    let mut seen = Vec::new();
    for row in BASELINES {
        assert!(names.insert(row.name), "two rows are named {}", row.name);
        let settings = row.settings(&base).unwrap();
        assert!(!seen.contains(&settings), "{} is another row under another name", row.name);
        seen.push(settings);
    }
    // The rows of both tables that share a name are the same row.
    for row in VARIANTS.iter().filter(|v| names.contains(v.name)) {
        let twin = BASELINES.iter().find(|r| r.name == row.name).unwrap();
        assert_eq!(row.settings(&base).unwrap(), twin.settings(&base).unwrap());
    }
    // Every method of the paper's Table 1 can be measured.
    let published: BTreeSet<&String> = targets().flat_map(|(_, t)| t.iou.keys()).collect();
    assert!(published.iter().all(|name| names.contains(name.as_str())), "{published:?}");
    assert!(words(Table::Baselines.rows(&["no-such-row".into()])).contains("no-such-row"));
}

#[test]
fn data_that_is_not_here_is_requested_by_name_with_its_layout() {
    let dir = tempfile::tempdir().unwrap();
    let (root, settings) = (dir.path().to_owned(), Settings::default());
    let tourism = PhotoTourismProtocol { root: root.clone(), only: Vec::new(), clicks: 1 };
    let message = words(photo_tourism::scenes(&tourism, &settings, 1));
    for scene in &PAPER.scenes {
        assert!(message.contains(&scene.name) && message.contains(&scene.folder), "{message}");
    }
    assert!(
        message.contains("dense/images") && message.contains(".tsv") && message.contains("prompts.json"),
        "{message}"
    );
    let odd = PhotoTourismProtocol { only: vec!["eiffel".into()], ..tourism };
    assert!(words(photo_tourism::scenes(&odd, &settings, 1)).contains("eiffel"));

    let nvos = NvosProtocol { root: root.clone(), only: Vec::new(), clicks: 4 };
    let message = words(nvos::scenes(&nvos, &settings, 1));
    assert!(message.contains("scribbles") && message.contains("reference_image/SCENE"), "{message}");
    let spin = SpinNerfProtocol { root: root.clone(), only: vec!["fork".into()], clicks: 1 };
    let message = words(spin_nerf::scenes(&spin, &settings, 1));
    assert!(message.contains("fork") && message.contains("ROOT/SCENE/label"), "{message}");
}

#[test]
fn photo_tourism_asks_for_the_nine_targets_and_names_each_mask_that_lacks() {
    let dir = tempfile::tempdir().unwrap();
    let eval_scene = &PAPER.scenes[0];
    let mut names: Vec<String> = eval_scene.targets.iter().flat_map(|t| t.truth.clone()).collect();
    names.extend(eval_scene.targets.iter().map(|t| t.reference.clone()));
    let root = dir.path().join(&eval_scene.folder);
    let dense = root.join("dense");
    scene(names.len(), 64, &names).write(&dense).unwrap();
    copy(&dense.join("split.tsv"), &root.join(&eval_scene.split));
    let options =
        PhotoTourismProtocol { root: dir.path().into(), only: vec![eval_scene.folder.clone()], clicks: 1 };
    let settings = Settings::default();
    let message = words(photo_tourism::scenes(&options, &settings, 1));
    assert!(message.contains(&format!("{}.png", eval_scene.targets[0].truth[1])), "{message}");
    // A mask of everything will do to be found; one target is prompted by a file.
    for target in &eval_scene.targets {
        for photo in target.truth.iter().chain([&target.reference]) {
            let file = root.join("truth").join(&target.folder).join(format!("{photo}.png"));
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            Mask::from_fn(64, 48, |x, y| x > 20 && y > 20).write_png(&file).unwrap();
        }
    }
    let (first, folder) = (&eval_scene.targets[0], root.join("truth").join(&eval_scene.targets[0].folder));
    let prompts = format!(
        r#"[{{"photo": "{}.png", "points": [{{"x": 7.0, "y": 9.0, "inside": true}}]}}]"#,
        first.reference
    );
    std::fs::write(folder.join("prompts.json"), prompts).unwrap();
    let scenes = photo_tourism::scenes(&options, &settings, 1).unwrap().scenes;
    assert_eq!((scenes.len(), scenes[0].queries.len()), (1, 3));
    for (query, target) in scenes[0].queries.iter().zip(&eval_scene.targets) {
        assert_eq!(query.target, target.name);
        assert_eq!(query.prompts[0].photo, format!("{}.png", target.reference));
        assert_eq!(query.truth.len(), 3);
    }
    assert_eq!(scenes[0].queries[0].prompts[0].prompts.points[0].x, 7.0);
    assert!(scenes[0].held_out && scenes[0].split.is_some());
}

/// Lays a scene of the paper out under `root`, whole: every photo and mask of its targets. Its split is to be put there.
fn lay_out(root: &Path, eval_scene: &PaperScene) {
    let all = |t: &PaperTarget| t.truth.iter().chain([&t.reference]).cloned().collect::<Vec<_>>();
    let names: BTreeSet<String> = eval_scene.targets.iter().flat_map(all).collect();
    let names: Vec<String> = names.into_iter().collect();
    let root = root.join(&eval_scene.folder);
    scene(names.len(), 64, &names).write(&root.join("dense")).unwrap();
    std::fs::remove_file(root.join("dense/split.tsv")).unwrap();
    for target in &eval_scene.targets {
        for photo in all(target) {
            let file = root.join("truth").join(&target.folder).join(format!("{photo}.png"));
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            Mask::from_fn(64, 48, |x, y| x > 20 && y > 20).write_png(&file).unwrap();
        }
    }
}

/// The queries on a scene that is laid out, by target: the number of photos that score it; and what is missing.
fn queried(root: &Path, eval_scene: &PaperScene) -> (Vec<(String, usize)>, Vec<String>) {
    let options =
        PhotoTourismProtocol { root: root.into(), only: vec![eval_scene.folder.clone()], clicks: 1 };
    let found = photo_tourism::scenes(&options, &Settings::default(), 1).unwrap();
    let queries = found.scenes.iter().flat_map(|p| &p.queries);
    (queries.map(|q| (q.target.clone(), q.truth.len())).collect(), found.missing)
}

#[test]
fn a_photo_that_the_published_split_lacks_costs_its_own_score_and_nothing_else() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let shared = std::env::var_os("SEGWILD_SHARED").map_or_else(|| root.join("../shared"), PathBuf::from);
    for eval_scene in &PAPER.scenes {
        let split = shared.join("data/splits").join(&eval_scene.split);
        if !split.is_file() {
            let test = "a_photo_that_the_published_split_lacks_costs_its_own_score_and_nothing_else";
            println!("skipped: {test}: {} is not there", split.display());
            continue;
        }
        let dir = tempfile::tempdir().unwrap();
        lay_out(dir.path(), eval_scene);
        // The published names end in .jpg, the rendered photos in .png.
        let rows = std::fs::read_to_string(&split).unwrap().replace(".jpg", ".png");
        std::fs::write(dir.path().join(&eval_scene.folder).join(&eval_scene.split), rows).unwrap();
        let (queried, missing) = queried(dir.path(), eval_scene);
        let missing_of =
            |target: &str| usize::from((eval_scene.short.as_str(), target) == ("TF", "left triton"));
        for target in &eval_scene.targets {
            let left = target.truth.len() - missing_of(&target.name);
            assert!(queried.contains(&(target.name.clone(), left)), "{}: {queried:?}", target.name);
        }
        // Of the nine targets' photos the published splits lack exactly this one.
        assert_eq!(missing.len(), usize::from(eval_scene.short == "TF"), "{missing:?}");
        for what in missing {
            let words = ["Trevi Fountain", "left triton", "36294258_3929962941", "not listed in the split"];
            assert!(words.iter().all(|w| what.contains(w)), "{what}");
        }
    }
}

#[test]
fn a_target_without_its_reference_photo_is_refused_by_name_and_the_others_go_on() {
    let dir = tempfile::tempdir().unwrap();
    let eval_scene = &PAPER.scenes[0];
    lay_out(dir.path(), eval_scene);
    let (lost, kept) = (&eval_scene.targets[0], &eval_scene.targets[1..]);
    let listed: Vec<String> = kept
        .iter()
        .flat_map(|t| t.truth.iter().chain([&t.reference]))
        .chain(&lost.truth)
        .enumerate()
        .map(|(i, name)| format!("{name}.png\t{i}\ttrain\tbrandenburg\n"))
        .collect();
    let split = dir.path().join(&eval_scene.folder).join(&eval_scene.split);
    let head = "filename\tid\tsplit\tdataset\n";
    std::fs::write(&split, head.to_owned() + &listed.concat()).unwrap();
    let (left, missing) = queried(dir.path(), eval_scene);
    let names: Vec<&str> = left.iter().map(|l| l.0.as_str()).collect();
    assert_eq!(names, kept.iter().map(|t| t.name.as_str()).collect::<Vec<_>>());
    assert!(missing.len() == 1 && missing[0].contains(&lost.reference), "{missing:?}");
    assert!(missing[0].contains(&format!("{}, is refused", lost.name)), "{missing:?}");
    // A target is refused, too, when none of the photos that score it is left; with nothing left all is refused.
    std::fs::remove_dir_all(dir.path().join(&eval_scene.folder).join("truth").join(&kept[0].folder)).unwrap();
    assert_eq!(queried(dir.path(), eval_scene).0.len(), 1);
    std::fs::remove_dir_all(dir.path().join(&eval_scene.folder).join("truth").join(&kept[1].folder)).unwrap();
    let options =
        PhotoTourismProtocol { root: dir.path().into(), only: vec![eval_scene.folder.clone()], clicks: 1 };
    let message = words(photo_tourism::scenes(&options, &Settings::default(), 1));
    assert!(kept.iter().all(|t| message.contains(&t.name)), "{message}");
}

#[test]
fn a_scene_without_its_masks_does_not_keep_the_others_from_being_measured() {
    let dir = tempfile::tempdir().unwrap();
    let made = scene(3, 64, &[]);
    for name in ["fork", "truck"] {
        made.write(&dir.path().join(name)).unwrap();
    }
    for photo in &made.photos {
        let file = dir.path().join("truck/label").join(&photo.name);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        Mask::from_fn(64, 48, |x, _| x < 40).write_png(&file).unwrap();
    }
    let options = SpinNerfProtocol { root: dir.path().into(), only: Vec::new(), clicks: 1 };
    let found = spin_nerf::scenes(&options, &Settings::default(), 1).unwrap();
    let names: Vec<&str> = found.scenes.iter().map(|p| p.name.as_str()).collect();
    assert_eq!(names, ["truck"]);
    assert!(found.missing.len() == 1 && found.missing[0].contains("fork"), "{:?}", found.missing);
}

#[test]
fn scribbles_and_label_folders_become_clicks_on_the_right_photo() {
    let dir = tempfile::tempdir().unwrap();
    let made = scene(4, 96, &[]);
    let stems: Vec<String> = made.photos.iter().map(|p| p.name.trim_end_matches(".png").to_owned()).collect();
    let (width, height) = (made.photos[1].camera.width, made.photos[1].camera.height);

    let nvos_root = dir.path().join("nvos");
    made.write(&nvos_root.join("scenes/horns")).unwrap();
    let photo = nvos_root.join("scenes/horns/images").join(&made.photos[1].name);
    copy(&photo, &nvos_root.join("reference_image/horns_left").join(&made.photos[1].name));
    let mask = nvos_root.join(format!("masks/horns_left/{}_mask.png", stems[2]));
    std::fs::create_dir_all(mask.parent().unwrap()).unwrap();
    Mask::full(40, 30).write_png(&mask).unwrap();
    // Scribbles at twice the photo's size: strokes on its left inside, on its right outside.
    let stroke = |name: &str, at: u32| {
        let file = nvos_root.join("scribbles/horns_left").join(name);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        let on_stroke = |x: u32, y: u32| x.abs_diff(at) < 3 && y > 10 && y + 10 < 2 * height;
        Mask::from_fn(2 * width, 2 * height, on_stroke).write_png(&file).unwrap();
    };
    stroke("pos_0_horns.png", width / 2);
    stroke("neg_0_horns.png", 3 * width / 2);
    let options = NvosProtocol { root: nvos_root, only: Vec::new(), clicks: 4 };
    let scenes = nvos::scenes(&options, &Settings::default(), 1).unwrap().scenes;
    let query = &scenes[0].queries[0];
    assert_eq!(query.prompts[0].photo, made.photos[1].name);
    assert_eq!(query.truth[0].0, made.photos[2].name);
    let points = &query.prompts[0].prompts.points;
    assert_eq!(points.len(), 8);
    assert!(
        points.iter().all(|p| p.inside == (p.x < width as f32 / 2.0) && p.y < height as f32),
        "{points:?}"
    );

    let spin_root = dir.path().join("spin");
    made.write(&spin_root.join("fork")).unwrap();
    let options = SpinNerfProtocol { root: spin_root.clone(), only: Vec::new(), clicks: 2 };
    assert!(words(spin_nerf::scenes(&options, &Settings::default(), 1)).contains("fork/label"));
    for stem in &stems[..3] {
        let file = spin_root.join("fork/label").join(format!("{stem}.png"));
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        Mask::from_fn(96, 72, |x, _| x < 40).write_png(&file).unwrap();
    }
    let scenes = spin_nerf::scenes(&options, &Settings::default(), 1).unwrap().scenes;
    let query = &scenes[0].queries[0];
    assert_eq!((query.prompts[0].prompts.points.len(), query.truth.len()), (2, 2));
    assert_eq!(query.prompts[0].photo, made.photos[0].name);
}

#[test]
fn a_folder_with_truth_is_scored_photo_by_photo() {
    let dir = tempfile::tempdir().unwrap();
    let made = scene(8, 112, &[]);
    let scene_dir = dir.path().join("scene");
    made.write(&scene_dir).unwrap();
    // Only one object has a true mask.
    for name in made.manifest().objects.iter().map(|o| o.name.clone()).filter(|name| name != "lintel") {
        std::fs::remove_dir_all(scene_dir.join("truth").join(name)).unwrap();
    }
    let options =
        FolderProtocol { scene: scene_dir, references: Vec::new(), draw: 2, clicks: 1, parts: Parts::new() };
    let mut settings = Settings::preset(Preset::Draft);
    settings.train.steps = 150;
    settings.scene.size = 112;
    (settings.features.refine_steps, settings.masks.prompt_budget) = (5, 16);
    let eval_scene: EvalScene = folder::scenes(&options, &settings, 3).unwrap().scenes.remove(0);
    assert_eq!((eval_scene.queries.len(), eval_scene.name.as_str()), (2, "scene"));
    let click = &eval_scene.queries[0].prompts[0];
    let photo = made.photos.iter().find(|p| p.name == click.photo).unwrap();
    let lintel = photo.mask(made.instance_named("lintel").unwrap());
    assert!(click.prompts.points.iter().all(|p| lintel.at(p.x, p.y)));
    assert_eq!(folder::scenes(&options, &settings, 3).unwrap().scenes[0].queries, eval_scene.queries);

    let (mut results, mut count) = (Results::default(), 0);
    let rows = Table::Baselines.rows(&["gs-w".into(), "full".into()]).unwrap();
    let base = ProtocolBase { settings, changes: Vec::new() };
    let out = dir.path().join("out");
    measure(&out, &eval_scene, &rows, &base, &mut results, &mut |_| count += 1).unwrap();
    assert_eq!((results.records.len(), count), (4, 4));
    let kept = Results::read(&out.join("results.json")).unwrap();
    assert!(kept.records.len() == 4 && kept.records.iter().zip(&results.records).all(|(a, b)| a.same(b)));
    let lines = std::fs::read_to_string(out.join("photos.jsonl")).unwrap();
    for record in &results.records {
        let number = |name: &str| record.numbers[name];
        assert_eq!(record.provider, "built-in");
        // The photo that was clicked does not count.
        assert!(number("photos") >= 4.0 && number("photos") <= 8.0, "{record:?}");
        assert!(number("worst") <= number("iou") && number("iou") <= 1.0, "{record:?}");
        let clicked = record.notes[0].trim_start_matches("clicked ");
        let of = |l: &&str| l.contains(&format!("\"{}\"", record.setting));
        let prompt = format!("\"prompt\":{},", record.prompt);
        let mine: Vec<&str> = lines.lines().filter(of).filter(|l| l.contains(&prompt)).collect();
        assert_eq!(mine.len() as f64, number("photos"));
        assert!(mine.iter().all(|l| !l.contains(&format!("\"photo\":\"{clicked}\""))));
    }
    let best = results.records.iter().map(|r| r.numbers["iou"]).fold(0.0, f64::max);
    assert!(best > 0.2, "nothing like the lintel was found: {best:.3}");
}

#[test]
fn perturbations_change_training_photos_and_leave_test_photos_alone() {
    let clean = scene(2, 96, &[]);
    for perturbation in Perturbation::ALL {
        let mut perturbed = clean.clone();
        perturbation.apply(&mut perturbed).unwrap();
        let colour = matches!(perturbation, Perturbation::Colour | Perturbation::Both);
        let square = matches!(perturbation, Perturbation::Occluders | Perturbation::Both);
        for (before, after) in clean.photos.iter().zip(&perturbed.photos) {
            let changed = !before.test && (colour || square);
            assert_eq!(before.photo != after.photo, changed, "{perturbation:?} {}", before.name);
            // A quarter of the long side, as 200 px of 800.
            let transients = if square && !before.test { 24 * 24 } else { 0 };
            assert_eq!(after.transients.count(), transients);
        }
    }
}
