//! The paper's own protocol: nine targets in three places of Photo Tourism, one reference photo and three true masks
//! each, and PSNR on the held-out photos by left and right halves. The photos and masks are the user's.

use super::paper::{PAPER, PaperScene, PaperTarget};
use super::place::{photo_of, photos};
use super::{Missing, Place, ProtocolError, Question, clicks};
use segwild_pipeline::{PhotoPrompts, Replay, Settings};
use segwild_scene::{Mask, Prompts};
use std::path::{Path, PathBuf};

/// Which data, and how it is clicked.
#[derive(Clone, Debug)]
pub struct PhotoTourismProtocol {
    /// Folder of the three places.
    pub root: PathBuf,
    /// Places to measure, by folder; all that are there if empty.
    pub only: Vec<String>,
    /// Clicks on each reference photo, by [`clicks::inside`], where there is no file of prompts.
    pub clicks: usize,
}

/// How the data must lie.
pub const LAYOUT: &str = "The photos are those of the Image Matching Challenge's Photo Tourism (\"phototourism\", training set); \
    the masks are drawn by hand, for the paper's are not published. Put them so:\n\
    ROOT/brandenburg_gate/dense/images/*.jpg, dense/sparse/*.bin   as in the archive (ROOT/PLACE/images and sparse/0 will do)\n\
    ROOT/brandenburg_gate/brandenburg.tsv                          NeRF-W's split: which photos take part, which are held out\n\
    ROOT/brandenburg_gate/truth/lintel/PHOTO.png                   white where the target is, at the photo's size: for the three\n\
    \u{20}                                                              photos that are scored, and for the reference photo, which is\n\
    \u{20}                                                              clicked deep inside its mask\n\
    ROOT/brandenburg_gate/truth/lintel/prompts.json                instead of the reference photo's mask: clicks and boxes, in\n\
    \u{20}                                                              the form of a selection's prompts.json\n\
    and the same for trevi_fountain (trevi.tsv) and taj_mahal (taj_mahal.tsv). `--scenes` measures some of them.";

/// The places that are there, with their questions.
///
/// # Errors
/// When something is missing: all of it, with what to put where.
pub fn places(
    options: &PhotoTourismProtocol,
    settings: &Settings,
    seed: u64,
) -> Result<Vec<Place>, ProtocolError> {
    let mut missing = Vec::new();
    if let Some(odd) = options.only.iter().find(|o| PAPER.scenes.iter().all(|s| s.folder != **o)) {
        missing.push(format!("a place named `{odd}`: there are {}", folders().join(", ")));
    }
    let wanted = |s: &&PaperScene| options.only.is_empty() || options.only.contains(&s.folder);
    let mut places = Vec::new();
    for scene in PAPER.scenes.iter().filter(wanted) {
        let root = options.root.join(&scene.folder);
        if !root.is_dir() {
            missing.push(format!("{}: {}", scene.name, root.display()));
            continue;
        }
        let dense = root.join("dense");
        let path = if dense.is_dir() { dense } else { root.clone() };
        let mut settings = settings.clone();
        let split = root.join(&scene.split);
        if !split.is_file() {
            missing.push(format!("{}: the split, {}", scene.name, split.display()));
            continue;
        }
        settings.scene.split = split.display().to_string();
        let photos = photos(&path, &settings)?;
        let mut questions = Vec::new();
        for target in &scene.targets {
            questions.extend(question(&root, scene, target, &photos, options.clicks, &mut missing)?);
        }
        places.push(Place {
            protocol: "photo-tourism",
            name: scene.name.clone(),
            scene: path,
            split: Some(split),
            seed,
            questions,
            held_out: true,
        });
    }
    if missing.is_empty() {
        Ok(places)
    } else {
        Err(ProtocolError::Missing(Missing { what: missing, layout: LAYOUT.into() }))
    }
}

/// Folders of the places.
fn folders() -> Vec<&'static str> {
    PAPER.scenes.iter().map(|s| s.folder.as_str()).collect()
}

fn question(
    root: &Path,
    scene: &PaperScene,
    target: &PaperTarget,
    photos: &[String],
    clicks: usize,
    missing: &mut Vec<String>,
) -> Result<Option<Question>, ProtocolError> {
    let folder = root.join("truth").join(&target.folder);
    let before = missing.len();
    let named = |what: &str| format!("{}, {}: {what}", scene.name, target.name);
    let mut truth = Vec::new();
    for wanted in &target.truth {
        let mask = folder.join(format!("{wanted}.png"));
        match photo_of(photos, wanted) {
            None => missing
                .push(named(&format!("the photo {wanted}.jpg, which is scored, or its line in the split"))),
            Some(_) if !mask.is_file() => {
                missing.push(named(&format!("the true mask {}", mask.display())));
            }
            Some(photo) => truth.push((photo.clone(), mask)),
        }
    }
    let Some(photo) = photo_of(photos, &target.reference) else {
        missing
            .push(named(&format!("the reference photo {}.jpg, or its line in the split", target.reference)));
        return Ok(None);
    };
    let (mask, file) = (folder.join(format!("{}.png", target.reference)), folder.join("prompts.json"));
    let prompts = if file.is_file() {
        Replay::read(&file)?.prompts
    } else if mask.is_file() {
        let points = clicks::inside(&Mask::read_png(&mask)?, clicks);
        vec![PhotoPrompts { photo: photo.clone(), prompts: Prompts { points, ..Prompts::default() } }]
    } else {
        missing.push(named(&format!(
            "the reference photo's mask {}, or prompts.json beside it",
            mask.display()
        )));
        Vec::new()
    };
    let question = Question { target: target.name.clone(), prompt: 0, prompts, truth };
    Ok((missing.len() == before).then_some(question))
}
