//! `segwild import`: splats of other programs become runs, with their photos and without.

use crate::common::*;
use glam::{DMat3, DVec3};
use segwild_scene::{Scene, SceneSettings, Similarity, Splats, ply};
use std::path::{Path, PathBuf};

/// Settings that keep a run short. Nothing is trained.
const SHORT: [&str; 6] = ["--size", "96", "--refine-steps", "4", "--prompt-budget", "24"];

/// Splats as another program writes them: no comments, no normals.
fn foreign(to: &Path, splats: &Splats) {
    ply::write(to, splats).expect("it is written");
}

fn trained() -> Splats {
    let made = made_once("splats", &[Path::new(env!("CARGO_BIN_EXE_segwild"))], |folder| {
        let (scene, out) = (show(scene()), show(&folder.join("run")));
        let steps = ["--size", "96", "--steps", "300", "--splats", "2000", "--until", "geometry"];
        let affine = ["--appearance-model", "affine"];
        works(&[&["run", &scene, "--out", &out][..], &steps, &affine].concat());
    });
    ply::read(&made.join("run/scene.ply")).expect("it was trained")
}

fn import(splats: &Path, out: &Path, more: &[&str]) -> (bool, String) {
    let (splats, out) = (show(splats), show(out));
    let args = [&["import", &splats, "--out", &out][..], &SHORT, more].concat();
    let done = segwild(&args);
    (done.status.success(), text(&done.stdout) + &text(&done.stderr))
}

/// Splats of a run, in the units of its scene, and what a click on the clearest object selects of them.
fn clicked(run: &Path) -> Vec<u8> {
    let (_, click) = clearest();
    let at = format!("{},{}", click.x, click.y);
    works(&["segment", &show(run), "--photo", &click.photo, "--positive", &at, "--name", "thing"]);
    let labels = run.join("selections/thing/labels.ply");
    ply::read_extra(&labels, "label").expect("it opens").expect("it has labels")
}

/// The largest distance between positions of the same splats, as a share of their extent.
fn apart(a: &Splats, b: &Splats) -> f32 {
    assert_eq!(a.len(), b.len());
    let extent = a.means.iter().flatten().fold(0.0f32, |most, v| most.max(v.abs()));
    let far = (0..a.len()).map(|i| a.mean(i).distance(b.mean(i))).fold(0.0, f32::max);
    far / extent
}

#[test]
fn splats_of_another_program_are_kept_and_can_be_clicked_and_exported() {
    let dir = folder();
    let (file, run) = (dir.path().join("other.ply"), dir.path().join("run"));
    let own = trained();
    foreign(&file, &own);
    let photos = show(scene());
    let (done, printed) = import(&file, &run, &["--photos", &photos]);
    assert!(done, "{printed}");
    assert!(printed.contains("by 3D Gaussian Splatting, or in its layout"), "{printed}");
    let exported = ply::read(&run.join("scene.ply")).expect("it opens");
    assert!(apart(&own, &exported) < 1e-5, "{}", apart(&own, &exported));
    let off = own.sh.iter().zip(&exported.sh).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(off < 1e-6, "the colours are those of the file, whatever light the photos have: {off}");
    assert_eq!(own.opacities, exported.opacities);
    let labels = clicked(&run);
    let selected = labels.iter().filter(|label| **label > 0).count();
    assert!(labels.len() == own.len() && 20 < selected && selected < own.len(), "{selected}");
    let object = ply::read(&run.join("selections/thing/object.ply")).expect("it opens");
    assert_eq!(object.len(), selected);
    let object = dir.path().join("object.spz");
    works(&["bake", &show(&run), "--selection", "thing", "--mode", "only", "--out", &show(&object)]);
    assert!(object.is_file());
    // A second import computes nothing, and the file may go.
    let (again, printed) = import(&file, &run, &["--photos", &photos, "--json"]);
    assert!(again && made(&printed) == 0, "{printed}");
    std::fs::remove_file(&file).expect("it is there");
    clicked(&run);
    works(&["render", &show(&run), "--photo", &clearest().1.photo]);
}

#[test]
fn worlds_that_programs_move_are_found_again() {
    let dir = folder();
    let own = trained();
    let photos = show(scene());
    let known = Scene::open(scene(), &SceneSettings::default()).expect("the scene opens");
    let half = DMat3::from_rotation_x(std::f32::consts::PI.into());
    let any = Similarity {
        rotation: DMat3::from_axis_angle(DVec3::new(0.48, 0.6, -0.64), 1.1),
        scale: 0.37,
        translation: DVec3::new(3.0, -1.0, 0.5),
    };
    for (name, to) in [("half a turn", Similarity::turn(half)), ("nerfstudio", nerfstudio(&known))] {
        let (file, run) = (dir.path().join("moved.ply"), dir.path().join(name.replace(' ', "_")));
        foreign(&file, &own.transformed(&to));
        let (done, printed) = import(&file, &run, &["--photos", &photos, "--until", "geometry"]);
        assert!(done, "{name}: {printed}");
        let back = ply::read(&run.join("scene.ply")).expect("it opens");
        assert!(apart(&own, &back) < 0.01, "{name}: {} {printed}", apart(&own, &back));
        let words = if name == "nerfstudio" { "nerfstudio's world" } else { "its axes exchanged" };
        assert!(printed.contains(words), "{printed}");
    }
    // Any other way is given by a file, as nerfstudio writes it.
    let (file, run) = (dir.path().join("moved.ply"), dir.path().join("given"));
    foreign(&file, &own.transformed(&any));
    let transform = dir.path().join("frame.json");
    let row = |k: usize| {
        let [x, y, z] = any.rotation.row(k).to_array();
        [x, y, z, any.translation[k] / any.scale]
    };
    let given = serde_json::json!({ "transform": [row(0), row(1), row(2)], "scale": any.scale });
    std::fs::write(&transform, given.to_string()).expect("it is written");
    let frame = ["--photos", &photos, "--until", "geometry", "--imported-frame", &show(&transform)];
    let (done, printed) = import(&file, &run, &frame);
    assert!(done, "{printed}");
    let back = ply::read(&run.join("scene.ply")).expect("it opens");
    assert!(apart(&own, &back) < 1e-4, "{}", apart(&own, &back));
}

/// nerfstudio's world, by its own words: up is z, the mean of the cameras the origin, the farthest coordinate 1.
fn nerfstudio(scene: &Scene) -> Similarity {
    let applied = DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y);
    let count = scene.views.len() as f64;
    let up = scene.views.iter().map(|view| -view.pose.rotation.row(1).as_dvec3()).sum::<DVec3>() / count;
    let up = (applied * up).normalize();
    let axis = up.cross(DVec3::Z).normalize();
    let turn = DMat3::from_axis_angle(axis, up.dot(DVec3::Z).acos()) * applied;
    let centres: Vec<DVec3> = scene
        .views
        .iter()
        .map(|view| turn * (view.pose.centre().as_dvec3() * scene.frame.scale + scene.frame.origin))
        .collect();
    let mean = centres.iter().sum::<DVec3>() / count;
    let scale = 1.0 / centres.iter().map(|c| (*c - mean).abs().max_element()).fold(0.0, f64::max);
    Similarity { rotation: turn, scale, translation: -mean * scale }
}

#[test]
fn splats_without_photos_get_views_of_their_own_and_the_run_can_move() {
    let dir = folder();
    let (file, run) = (dir.path().join("alone.ply"), dir.path().join("run"));
    let own = trained();
    foreign(&file, &own);
    let (done, printed) = import(&file, &run, &[]);
    assert!(done, "{printed}");
    let views: Vec<PathBuf> = std::fs::read_dir(run.join("views/images"))
        .expect("views were rendered")
        .map(|entry| entry.expect("it can be read").path())
        .collect();
    assert!(views.len() >= 8, "{}", views.len());
    assert!(run.join("objects/sheet.png").is_file());
    let exported = ply::read(&run.join("scene.ply")).expect("it opens");
    assert!(apart(&own, &exported) < 1e-5);
    // They are shown as they were rendered: neither their world nor their mode is left to a comparison.
    assert!(printed.contains("the photos are views of the splats: as it is"), "{printed}");
    let header = std::fs::read(run.join("scene.ply")).expect("it opens");
    let mode = b"comment SplatRenderMode: default\n";
    assert!(header.windows(mode.len()).any(|words| words == mode));
    let moved = dir.path().join("elsewhere");
    std::fs::rename(&run, &moved).expect("it moves");
    works(&["segment", &show(&moved), "--photo", "000.png", "--positive", "48,36", "--name", "middle"]);
    // Views that are there already are not rendered again.
    let rendered =
        |path: &Path| std::fs::metadata(path.join("views/images/000.png")).unwrap().modified().unwrap();
    let before = rendered(&moved);
    let (done, printed) = import(&file, &moved, &[]);
    assert!(done && rendered(&moved) == before, "{printed}");
}

#[test]
fn what_cannot_be_imported_is_refused_in_words() {
    let dir = folder();
    let (file, run) = (dir.path().join("other.ply"), dir.path().join("run"));
    let photos = show(scene());
    let mut own = trained();
    foreign(&file, &own);
    let (file_text, run_text) = (show(&file), show(&run));
    let refused = |more: &[&str], words: &[&str]| {
        let args =
            [&["import", &file_text, "--out", &run_text, "--photos", &photos][..], &SHORT, more].concat();
        refuses(&args, 2, words);
    };
    refused(&["--appearance-model", "embed"], &["none or affine"]);
    refused(&["--until", "20"], &["--until takes a stage"]);
    refuses(&["import", &show(&dir.path().join("gone.ply"))], 3, &["gone.ply"]);
    let split = scene().join("split.tsv");
    refuses(&["import", &show(&split)], 3, &["no file of splats"]);
    let (cut, bytes) = (dir.path().join("cut.ply"), std::fs::read(&file).expect("it is there"));
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).expect("it is written");
    let aside = dir.path().join("aside");
    refuses(&["import", &show(&cut), "--out", &show(&aside), "--photos", &photos], 3, &["cut.ply"]);
    assert!(!aside.exists(), "nothing was computed");
    // Splats of another scene.
    own.means.iter_mut().enumerate().for_each(|(i, mean)| *mean = mean.map(|v| v + (i % 17) as f32));
    foreign(&file, &own);
    let (done, printed) = import(&file, &run, &["--photos", &photos]);
    assert!(!done && printed.contains("they are of another scene"), "{printed}");
    let as_they_lie = ["--photos", &photos, "--imported-frame", "poses", "--until", "geometry"];
    let (done, printed) = import(&file, &run, &as_they_lie);
    assert!(done && printed.contains("as --imported-frame says"), "{printed}");
}
