//! The prompts of a selection.

use crate::settings::is_removed;
use crate::{RunError, RunFolder};
use segwild_scene::{BoxPrompt, PointPrompt, Prompts, SceneError};
use segwild_segmenter::{SegmentError, SegmentSettings};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::HashSet;
use std::path::Path;

/// The prompts on one photo, in pixels of the photo as taken, at its full size.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhotoPrompts {
    /// The photo's name.
    pub photo: String,
    /// Clicks and boxes.
    #[serde(flatten)]
    pub prompts: Prompts,
}

/// An object of the scene's list, as a query.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ObjectQuery {
    /// Its number.
    pub number: usize,
    /// Key of the scene tree that the list is of.
    pub tree: String,
    /// The photo that shows it best.
    pub photo: String,
}

/// `prompts.json`: the prompts and settings of a selection, so that it can be made again.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Replay {
    /// Clicks and boxes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub prompts: Vec<PhotoPrompts>,
    /// An object of the scene's list, in the stead of prompts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub object: Option<ObjectQuery>,
    /// A text that describes the object, in the stead of prompts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
    /// The settings of the selection; `None` in a file that a person wrote, where the run's own settings serve.
    #[serde(default)]
    pub settings: Option<SegmentSettings>,
}

impl From<&[PhotoPrompts]> for Replay {
    fn from(prompts: &[PhotoPrompts]) -> Replay {
        Replay { prompts: prompts.to_vec(), ..Replay::default() }
    }
}

impl Replay {
    /// Whether nothing is requested.
    pub fn is_empty(&self) -> bool {
        self.prompts.is_empty() && self.object.is_none() && self.text.is_none()
    }

    /// Whether it is answered from the scene tree, whatever the settings are.
    pub fn needs_tree(&self) -> bool {
        self.object.is_some() || self.text.is_some()
    }

    /// Reads a file that `segment` or a person wrote; a bare list of prompts will do.
    ///
    /// # Errors
    /// When it cannot be read or is no prompts file.
    pub fn read(file: &Path) -> Result<Replay, RunError> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Either {
            Whole(Replay),
            List(Vec<PhotoPrompts>),
        }
        let text = segwild_scene::text::read(file).map_err(|e| match e {
            SceneError::Io { source, .. } => {
                RunError::Request(format!("{}: cannot be read: {source}", file.display()))
            }
            other => RunError::Request(other.to_string()),
        })?;
        match serde_json::from_str(&text).map(without_removed).and_then(serde_json::from_value) {
            Ok(Either::Whole(replay)) if !replay.is_empty() => Ok(replay),
            Ok(Either::List(prompts)) => Ok(prompts.as_slice().into()),
            _ => Err(RunError::Request(format!(
                "{}: is no prompts file: expected what `segwild segment` writes as prompts.json",
                file.display()
            ))),
        }
    }

    /// The prompts and settings of a run's selection.
    ///
    /// # Errors
    /// When there is no selection of that name; the error names those that there are.
    pub fn of(folder: &RunFolder, selection: &str) -> Result<Replay, RunError> {
        folder.has_selection(selection)?;
        Replay::read(&folder.selection(selection).join("prompts.json"))
    }
}

/// A prompts file without the settings that are gone.
fn without_removed(mut file: Value) -> Value {
    if let Some(Value::Object(settings)) = file.get_mut("settings") {
        settings.retain(|name, value| !is_removed(name, &value.to_string()));
    }
    file
}

/// Most clicks and boxes of one selection. A person gives a handful, and a scribble is some hundreds.
const MOST: usize = 10_000;

/// Refuses prompts that cannot select an object on any photo.
pub(crate) fn check_all(prompts: &[PhotoPrompts]) -> Result<(), RunError> {
    let count: usize = prompts.iter().map(|p| p.prompts.points.len() + p.prompts.boxes.len()).sum();
    if count > MOST {
        return Err(RunError::Request(format!(
            "{count} clicks and boxes are more than the {MOST} that one selection may be made from"
        )));
    }
    prompts.iter().try_for_each(PhotoPrompts::check)?;
    if !prompts.is_empty() && !prompts.iter().any(|p| p.prompts.say_where()) {
        return Err(RunError::Request(
            "all clicks mark where the object is not: mark with a click or a box where it is".into(),
        ));
    }
    Ok(())
}

impl PhotoPrompts {
    /// Refuses prompts that cannot select an object.
    pub(crate) fn check(&self) -> Result<(), RunError> {
        let Prompts { points, boxes, granularity } = &self.prompts;
        if points.is_empty() && boxes.is_empty() {
            return Err(SegmentError::NoPrompt.into());
        }
        let refuse = |reason: String| Err(RunError::Request(format!("photo {}: {reason}", self.photo)));
        // 0.0 and -0.0 are one position.
        let position = |p: &PointPrompt| [(p.x + 0.0).to_bits(), (p.y + 0.0).to_bits()];
        let outside: HashSet<_> = points.iter().filter(|p| !p.inside).map(position).collect();
        let both = points.iter().find(|p| p.inside && outside.contains(&position(p)));
        if let Some(p) = points.iter().find(|p| !(p.x.is_finite() && p.y.is_finite())) {
            return refuse(format!("({}, {}) is no position in it", p.x, p.y));
        }
        if let Some(p) = both {
            return refuse(format!("({}, {}) is marked both inside and outside", p.x, p.y));
        }
        let sides = |b: &BoxPrompt| [b.x0, b.y0, b.x1, b.y1];
        if let Some(b) = boxes.iter().find(|b| sides(b).iter().any(|side| !side.is_finite())) {
            return refuse(format!("the box {:?} has a side that is no position", sides(b)));
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_hundred_thousand_clicks_are_refused_and_ten_thousand_are_looked_through_at_once() {
        let began = std::time::Instant::now();
        let of = |count: u32| {
            let point = |i: u32| PointPrompt { x: i as f32, y: 1.0, inside: i.is_multiple_of(2) };
            let prompts = Prompts { points: (0..count).map(point).collect(), ..Prompts::default() };
            check_all(&[PhotoPrompts { photo: "a.jpg".into(), prompts }]).map_err(|e| e.to_string())
        };
        assert_eq!(of(MOST as u32), Ok(()));
        let message = of(200_000).unwrap_err();
        assert!(message.contains("200000") && message.contains("10000"), "{message}");
        assert!(began.elapsed().as_secs() < 5, "{:?}", began.elapsed());
    }

    #[test]
    fn prompts_from_before_some_settings_were_removed_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("prompts.json");
        let text = r#"{"prompts": [{"photo": "a.jpg", "points": [{"x": 1.5, "y": 2, "inside": true}]}],
            "settings": {"tau": 0.4, "seen": 0.0, "centre_visible": false, "graph_cut_smoothness": 1.0}}"#;
        std::fs::write(&file, text).unwrap();
        assert_eq!(Replay::read(&file).unwrap().settings.unwrap().tau, 0.4);
        std::fs::write(&file, text.replace("\"seen\": 0.0", "\"seen\": 0.2")).unwrap();
        assert!(Replay::read(&file).is_err());
    }

    #[test]
    fn prompts_that_a_windows_editor_saved_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("prompts.json");
        let text = "[{\"photo\": \"a.jpg\",\r\n \"points\": [{\"x\": 1, \"y\": 2, \"inside\": true}]}]";
        std::fs::write(&file, [b"\xef\xbb\xbf", text.as_bytes()].concat()).unwrap();
        assert_eq!(Replay::read(&file).unwrap().prompts[0].photo, "a.jpg");
        let wide: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
        std::fs::write(&file, [&b"\xff\xfe"[..], &wide].concat()).unwrap();
        let refused = Replay::read(&file).unwrap_err().to_string();
        assert!(refused.contains("prompts.json") && refused.contains("UTF-16"), "{refused}");
    }

    #[test]
    fn prompts_that_mean_nothing_are_refused() {
        let of = |points: Vec<PointPrompt>, granularity| {
            let prompts = Prompts { points, granularity, ..Prompts::default() };
            check_all(&[PhotoPrompts { photo: "a.jpg".into(), prompts }]).map_err(|e| e.to_string())
        };
        let at = |inside| PointPrompt { x: 3.0, y: 4.0, inside };
        assert_eq!(of(vec![at(true)], Some(1.0)), Ok(()));
        assert!(of(vec![at(false)], None).unwrap_err().contains("where it is"));
        assert!(
            of(vec![at(true), at(false)], None).unwrap_err().contains("(3, 4) is marked both inside and")
        );
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
