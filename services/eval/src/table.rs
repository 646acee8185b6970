//! Scores per object and photo, as tables a person can read.

use crate::metrics::{MaskMetrics, Spread};
use serde::{Deserialize, Serialize};

/// One score.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhotoRow {
    /// The object.
    pub object: String,
    /// The photo it was scored on.
    pub photo: String,
    /// How well its mask fits.
    pub score: MaskMetrics,
}

/// Scores of several objects on several photos.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ScoreTable {
    /// The scores, in the order they were added.
    pub rows: Vec<PhotoRow>,
}

impl ScoreTable {
    /// Adds a score.
    pub fn push(&mut self, object: &str, photo: &str, score: MaskMetrics) {
        self.rows.push(PhotoRow { object: object.into(), photo: photo.into(), score });
    }

    /// The objects, in the order they first came.
    pub fn objects(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for row in &self.rows {
            if !names.contains(&row.object.as_str()) {
                names.push(&row.object);
            }
        }
        names
    }

    /// Spread of one number over an object's photos.
    pub fn spread(&self, object: &str, number: impl Fn(&MaskMetrics) -> f64) -> Option<Spread> {
        let values: Vec<f64> =
            self.rows.iter().filter(|r| r.object == object).map(|r| number(&r.score)).collect();
        Spread::of(&values)
    }

    /// Mean over objects of each object's mean over its photos, so that an object in many photos counts once.
    pub fn mean(&self, number: impl Fn(&MaskMetrics) -> f64) -> Option<Spread> {
        let means: Vec<f64> =
            self.objects().into_iter().filter_map(|o| self.spread(o, &number)).map(|s| s.mean).collect();
        Spread::of(&means)
    }

    /// The table in Markdown: one line per object, and the mean of the objects.
    pub fn markdown(&self) -> String {
        let mut text = String::from(
            "| object | photos | IoU | worst IoU | accuracy | Boundary IoU |\n|---|---:|---:|---:|---:|---:|\n",
        );
        for object in self.objects() {
            let of = |number: fn(&MaskMetrics) -> f64| self.spread(object, number);
            if let (Some(iou), Some(accuracy), Some(boundary)) =
                (of(|s| s.iou), of(|s| s.accuracy), of(|s| s.boundary_iou))
            {
                text += &format!(
                    "| {object} | {} | {:.3} | {:.3} | {:.3} | {:.3} |\n",
                    iou.count, iou.mean, iou.least, accuracy.mean, boundary.mean
                );
            }
        }
        if let (Some(iou), Some(accuracy), Some(boundary)) =
            (self.mean(|s| s.iou), self.mean(|s| s.accuracy), self.mean(|s| s.boundary_iou))
        {
            text += &format!(
                "| **mean** | {} | **{:.3}** | {:.3} | **{:.3}** | **{:.3}** |\n",
                self.rows.len(),
                iou.mean,
                iou.least,
                accuracy.mean,
                boundary.mean
            );
        }
        text
    }
}
