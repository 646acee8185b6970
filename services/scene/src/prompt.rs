//! Prompts: a person's clicks and boxes.

use serde::{Deserialize, Serialize};
use wincode::{SchemaRead, SchemaWrite};

/// A click, in pixels of the photo it is made on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SchemaRead, SchemaWrite)]
pub struct PointPrompt {
    /// Pixel position, x.
    pub x: f32,
    /// Pixel position, y.
    pub y: f32,
    /// True: part of the object. False: not part of it.
    pub inside: bool,
}

/// A box around the object, in pixels, corners in any order.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SchemaRead, SchemaWrite)]
pub struct BoxPrompt {
    /// First corner, x.
    pub x0: f32,
    /// First corner, y.
    pub y0: f32,
    /// Second corner, x.
    pub x1: f32,
    /// Second corner, y.
    pub y1: f32,
}

/// All prompts for one object on one photo.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, SchemaRead, SchemaWrite)]
pub struct Prompts {
    /// Clicks, positive and negative.
    #[serde(default)]
    pub points: Vec<PointPrompt>,
    /// Boxes.
    #[serde(default)]
    pub boxes: Vec<BoxPrompt>,
    /// 0 = the finest region that fits, 1 = the coarsest; `None` lets the provider choose.
    #[serde(default)]
    pub granularity: Option<f32>,
}

impl Prompts {
    /// One positive click.
    pub fn click(x: f32, y: f32) -> Prompts {
        Prompts { points: vec![PointPrompt { x, y, inside: true }], ..Prompts::default() }
    }

    /// The same prompts on a photo resized by `(sx, sy)`.
    pub fn scaled(&self, sx: f32, sy: f32) -> Prompts {
        Prompts {
            points: self.points.iter().map(|p| PointPrompt { x: p.x * sx, y: p.y * sy, ..*p }).collect(),
            boxes: self
                .boxes
                .iter()
                .map(|b| BoxPrompt { x0: b.x0 * sx, y0: b.y0 * sy, x1: b.x1 * sx, y1: b.y1 * sy })
                .collect(),
            granularity: self.granularity,
        }
    }
}
