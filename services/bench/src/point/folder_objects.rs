//! The objects of a folder of photos: in which photos each is shown, and what a person would point at there.

use super::error::PointError;
use segwild_eval::protocols::clicks;
use segwild_eval::protocols::folder::{Parts, objects as true_objects};
use segwild_eval::protocols::scene::stem;
use segwild_pipeline::{PhotoPrompts, Settings};
use segwild_scene::{BoxPrompt, Mask, PointPrompt, Prompts, Scene, SceneError};
use std::path::{Path, PathBuf};

/// Photos of a folder that are clicked, one after the other.
const REFERENCES: usize = 3;

/// An object of a folder of photos.
pub(super) struct FolderObject {
    pub name: String,
    /// The folder of its true masks.
    pub truth: PathBuf,
    /// The photos it is shown in, each with what a person would point at.
    pub shown: Vec<PhotoPrompts>,
}

/// The objects of a folder; none where it has no `truth/`.
///
/// # Errors
/// When the folder cannot be read, or none of its masks covers enough of a photo.
pub(super) fn objects(
    scene: &Path,
    parts: &Parts,
    settings: &Settings,
) -> Result<Vec<FolderObject>, PointError> {
    let root = scene.join("truth");
    if !root.is_dir() {
        return Ok(Vec::new());
    }
    let opened = Scene::open(scene, &settings.scene)?;
    let trained: Vec<String> = opened.views.iter().filter(|v| !v.test).map(|v| v.name.clone()).collect();
    let mut objects = Vec::new();
    for (name, masks) in true_objects(scene, &trained)? {
        let own = root.join(&name);
        let truth = if own.is_dir() { own } else { root.clone() };
        let shown = references(&masks, parts)?;
        if !shown.is_empty() {
            objects.push(FolderObject { name, truth, shown });
        }
    }
    if objects.is_empty() {
        return Err(PointError::NoTruth(scene.into()));
    }
    Ok(objects)
}

/// Photos to show an object in, each with what a person would point at. Those in the middle of the range of what the
/// object covers, evenly over the names, so that neither a close-up of a part nor a speck is among them. `masks`: photos with
/// the files of its true masks.
fn references(masks: &[(String, PathBuf)], parts: &Parts) -> Result<Vec<PhotoPrompts>, SceneError> {
    let mut able = Vec::new();
    for (name, file) in masks.iter().filter(|(name, _)| parts.is_empty() || parts.contains_key(stem(name))) {
        let mask = Mask::read_png(file)?;
        let share = mask.count() as f64 / f64::from(mask.width() * mask.height()).max(1.0);
        if share >= 0.001 {
            able.push((share, name.clone(), mask));
        }
    }
    able.sort_by(|a, b| a.0.total_cmp(&b.0));
    let middle = able.len() / 4..able.len() - able.len() / 4;
    let mut middle: Vec<_> = able.drain(middle).collect();
    middle.sort_by(|a, b| a.1.cmp(&b.1));
    let n = REFERENCES.min(middle.len());
    let chosen = (0..n).map(|k| &middle[(2 * k + 1) * middle.len() / (2 * n)]);
    Ok(chosen
        .map(|(_, name, mask)| {
            let prompts = match parts.get(stem(name)) {
                Some(rows) => Prompts { points: clicks::parts(mask, rows), ..Prompts::default() },
                None => pointed_at(mask),
            };
            PhotoPrompts { photo: name.clone(), prompts }
        })
        .collect())
}

/// A box around a mask, and a click deep inside its upper and its lower half: what a person points at who wants a
/// statue and its pedestal.
fn pointed_at(mask: &Mask) -> Prompts {
    let mut prompts = Prompts::default();
    let rows: Vec<u32> = mask.pixels().map(|(_, y)| y).collect();
    let Some(&middle) = rows.get(rows.len() / 2) else { return prompts };
    let columns = || mask.pixels().map(|(x, _)| x);
    prompts.boxes.push(BoxPrompt {
        x0: columns().min().unwrap_or(0) as f32,
        y0: rows[0] as f32,
        x1: columns().max().unwrap_or(0) as f32 + 1.0,
        y1: rows[rows.len() - 1] as f32 + 1.0,
    });
    for upper in [true, false] {
        let half = Mask::from_fn(mask.width(), mask.height(), |x, y| (y < middle) == upper && mask.get(x, y));
        let depth = half.not().distances();
        let deepest = half.pixels().map(|(x, y)| (depth[(y * mask.width() + x) as usize], x, y));
        if let Some((_, x, y)) = deepest.max_by(|a, b| a.0.total_cmp(&b.0)) {
            prompts.points.push(PointPrompt { x: x as f32 + 0.5, y: y as f32 + 0.5, inside: true });
        }
    }
    prompts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_is_pointed_at_in_both_halves() {
        let mask = Mask::from_fn(40, 60, |x, y| (10..20).contains(&x) && (10..50).contains(&y));
        let prompts = pointed_at(&mask);
        let b = &prompts.boxes[0];
        assert_eq!([b.x0, b.y0, b.x1, b.y1], [10.0, 10.0, 20.0, 50.0]);
        assert_eq!(prompts.points.len(), 2);
        assert!(prompts.points.iter().all(|p| p.inside && mask.get(p.x as u32, p.y as u32)));
        assert!(prompts.points[0].y < 30.0 && prompts.points[1].y >= 30.0);
        assert!(pointed_at(&Mask::empty(4, 4)).points.is_empty());
    }
}
