//! What a selection was made from, and what its files are called.

use crate::{RunError, RunFolder};
use segwild_scene::Prompts;
use segwild_segmenter::{SegmentError, SegmentSettings};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// What was said on one photo, in pixels of the photo at its full size.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhotoPrompts {
    /// The photo's name.
    pub photo: String,
    /// Clicks and boxes.
    #[serde(flatten)]
    pub prompts: Prompts,
}

/// `prompts.json`: everything that a selection was made from, so that it can be made again.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Replay {
    /// Clicks and boxes.
    pub prompts: Vec<PhotoPrompts>,
    /// How they became a selection; `None` in a file that a person wrote, where the run's own settings serve.
    #[serde(default)]
    pub settings: Option<SegmentSettings>,
}

impl Replay {
    /// Reads a file that `segment` or a person wrote; a bare list of prompts will do.
    ///
    /// # Errors
    /// In words, when it cannot be read or is something else.
    pub fn read(file: &Path) -> Result<Replay, RunError> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Either {
            Whole(Replay),
            List(Vec<PhotoPrompts>),
        }
        let text = std::fs::read_to_string(file)
            .map_err(|e| RunError::Request(format!("{}: cannot be read: {e}", file.display())))?;
        match serde_json::from_str(&text) {
            Ok(Either::Whole(replay)) => Ok(replay),
            Ok(Either::List(prompts)) => Ok(Replay { prompts, settings: None }),
            Err(_) => Err(RunError::Request(format!(
                "{}: is no prompts file: expected what `segwild segment` writes as prompts.json",
                file.display()
            ))),
        }
    }

    /// What a run's selection was made from.
    ///
    /// # Errors
    /// When there is no selection of that name; the error names those that there are.
    pub fn of(folder: &RunFolder, selection: &str) -> Result<Replay, RunError> {
        folder.has_selection(selection)?;
        Replay::read(&folder.selection(selection).join("prompts.json"))
    }
}

/// Refuses prompts that mean no object whatever the photos show.
pub(crate) fn check_all(prompts: &[PhotoPrompts]) -> Result<(), RunError> {
    prompts.iter().try_for_each(PhotoPrompts::check)?;
    let says_where =
        |p: &PhotoPrompts| !p.prompts.boxes.is_empty() || p.prompts.points.iter().any(|p| p.inside);
    if !prompts.is_empty() && !prompts.iter().any(says_where) {
        return Err(RunError::Request(
            "all clicks say where the object is not: say with a click or a box where it is".into(),
        ));
    }
    Ok(())
}

impl PhotoPrompts {
    /// Refuses prompts that cannot mean an object.
    pub(crate) fn check(&self) -> Result<(), RunError> {
        let Prompts { points, boxes, granularity } = &self.prompts;
        if points.is_empty() && boxes.is_empty() {
            return Err(SegmentError::NoPrompt.into());
        }
        let refuse = |reason: String| Err(RunError::Request(format!("photo {}: {reason}", self.photo)));
        let both = points
            .iter()
            .filter(|p| p.inside)
            .find(|p| points.iter().any(|q| !q.inside && (p.x, p.y) == (q.x, q.y)));
        if let Some(p) = both {
            return refuse(format!("({}, {}) is said to be inside and outside", p.x, p.y));
        }
        if let Some(b) = boxes.iter().find(|b| b.x0 == b.x1 || b.y0 == b.y1) {
            return refuse(format!("the box {},{},{},{} holds nothing", b.x0, b.y0, b.x1, b.y1));
        }
        match granularity {
            Some(g) if !(0.0..=1.0).contains(g) => refuse(format!("granularity {g}: expected 0 to 1")),
            _ => Ok(()),
        }
    }
}

/// File name of each photo's mask: its stem, sub-folders flattened, with the ending `.png`; the whole name where two
/// photos have one stem.
pub(crate) fn png_names<'a>(photos: impl Iterator<Item = &'a str> + Clone) -> Vec<String> {
    let flat = |photo: &str| photo.replace(['/', '\\'], "_");
    let stem = |photo: &str| {
        let flat = flat(photo);
        flat.rsplit_once('.').map_or(flat.clone(), |(stem, _)| stem.to_owned())
    };
    let mut seen: BTreeMap<String, usize> = BTreeMap::new();
    photos.clone().for_each(|photo| *seen.entry(stem(photo)).or_default() += 1);
    photos
        .map(|photo| {
            let stem = stem(photo);
            let name = if seen[&stem] > 1 { flat(photo) } else { stem };
            format!("{name}.png")
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photos_of_one_stem_do_not_overwrite_each_others_masks() {
        let names = png_names(["a/x.jpg", "b.png", "y.jpg", "y.png"].into_iter());
        assert_eq!(names, ["a_x.png", "b.png", "y.jpg.png", "y.png.png"]);
    }

    #[test]
    fn prompts_that_mean_nothing_are_refused() {
        use segwild_scene::PointPrompt;
        let of = |points: Vec<PointPrompt>, granularity| {
            let prompts = Prompts { points, granularity, ..Prompts::default() };
            check_all(&[PhotoPrompts { photo: "a.jpg".into(), prompts }]).map_err(|e| e.to_string())
        };
        let at = |inside| PointPrompt { x: 3.0, y: 4.0, inside };
        assert_eq!(of(vec![at(true)], Some(1.0)), Ok(()));
        assert!(of(vec![at(false)], None).unwrap_err().contains("where it is"));
        assert!(of(vec![at(true), at(false)], None).unwrap_err().contains("(3, 4) is said to be inside and"));
        // One photo may say where the object is, and another only where it is not.
        let on = |photo: &str, inside| {
            let prompts = Prompts { points: vec![at(inside)], ..Prompts::default() };
            PhotoPrompts { photo: photo.into(), prompts }
        };
        assert!(check_all(&[on("a.jpg", true), on("b.jpg", false)]).is_ok());
        assert!(check_all(&[on("a.jpg", false), on("b.jpg", false)]).is_err());
        for g in [7.0, -0.1, f32::NAN] {
            assert!(of(vec![at(true)], Some(g)).unwrap_err().contains("granularity"), "{g}");
        }
    }
}
