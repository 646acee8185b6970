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

    /// Whether they say where the object is: a box or a positive click does.
    pub fn say_where(&self) -> bool {
        !self.boxes.is_empty() || self.points.iter().any(|point| point.inside)
    }

    /// The same prompts with their boxes cut to a photo's frame, corners in order; `None` where a box has no area in it.
    pub fn within(&self, width: f32, height: f32) -> Option<Prompts> {
        let cut = |b: &BoxPrompt| {
            let (x, y) =
                ([b.x0, b.x1].map(|x| x.clamp(0.0, width)), [b.y0, b.y1].map(|y| y.clamp(0.0, height)));
            let cut =
                BoxPrompt { x0: x[0].min(x[1]), y0: y[0].min(y[1]), x1: x[0].max(x[1]), y1: y[0].max(y[1]) };
            (cut.x1 > cut.x0 && cut.y1 > cut.y0).then_some(cut)
        };
        let boxes = self.boxes.iter().map(cut).collect::<Option<_>>()?;
        Some(Prompts { boxes, ..self.clone() })
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_that_reaches_past_the_photo_ends_at_its_frame() {
        let of = |x0, y0, x1, y1| {
            let prompts = Prompts { boxes: vec![BoxPrompt { x0, y0, x1, y1 }], ..Prompts::default() };
            prompts.within(40.0, 30.0).map(|cut| cut.boxes[0])
        };
        assert_eq!(of(99.0, 20.0, -5.0, 9999.0), Some(BoxPrompt { x0: 0.0, y0: 20.0, x1: 40.0, y1: 30.0 }));
        assert_eq!(of(41.0, 2.0, 99.0, 9.0), None);
    }

    #[test]
    fn negative_clicks_do_not_say_where_the_object_is() {
        let negative = PointPrompt { x: 1.0, y: 1.0, inside: false };
        let mut prompts = Prompts { points: vec![negative], ..Prompts::default() };
        assert!(!prompts.say_where() && !Prompts::default().say_where());
        prompts.boxes.push(BoxPrompt { x0: 0.0, y0: 0.0, x1: 2.0, y1: 2.0 });
        assert!(prompts.say_where() && Prompts::click(1.0, 1.0).say_where());
    }
}
