//! Turns a person's prompts into queries to a SAM decoder.

use crate::VisionError;
use segwild_scene::{Image, Prompts};

/// The decoder's label of a point outside the object.
pub(super) const OUTSIDE: f32 = 0.0;
/// The decoder's label of a point inside the object.
pub(super) const INSIDE: f32 = 1.0;
/// The decoder's labels of the first and second corner of a box.
pub(super) const CORNERS: [f32; 2] = [2.0, 3.0];

/// A point with its label, in the photo's pixels.
pub(super) type Labelled = ([f32; 2], f32);

/// The prompts of one query: a decoder takes one box at a time.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct PromptGroup {
    /// The corners of the box, if there is one.
    pub corners: Vec<Labelled>,
    /// The clicks in the order in which they were made, except that the first one inside comes first.
    pub clicks: Vec<Labelled>,
}

/// One group per box, with the clicks inside of that box; one for clicks inside that are in no box. Clicks outside the
/// object belong to all. The masks of all groups together are the answer.
pub(super) fn groups(image: &Image, prompts: &Prompts) -> Result<Vec<PromptGroup>, VisionError> {
    let (w, h) = (image.width as f32, image.height as f32);
    if let Some(p) = prompts.points.iter().find(|p| !(p.x >= 0.0 && p.y >= 0.0 && p.x < w && p.y < h)) {
        return Err(VisionError::Image(format!(
            "the click at ({}, {}) lies outside the photo ({w} x {h})",
            p.x, p.y
        )));
    }
    if !prompts.say_where() {
        return Err(VisionError::Image(
            "nothing says what is wanted: give a click inside the object or a box".into(),
        ));
    }
    let mut boxes = Vec::new();
    for b in &prompts.boxes {
        let (x0, x1) = (b.x0.min(b.x1).clamp(0.0, w), b.x0.max(b.x1).clamp(0.0, w));
        let (y0, y1) = (b.y0.min(b.y1).clamp(0.0, h), b.y0.max(b.y1).clamp(0.0, h));
        if !(x1 > x0 && y1 > y0) {
            return Err(VisionError::Image(format!(
                "the box ({}, {}) to ({}, {}) holds nothing of the photo ({w} x {h})",
                b.x0, b.y0, b.x1, b.y1
            )));
        }
        boxes.push([x0, y0, x1, y1]);
    }
    let holds = |b: &[f32; 4], x: f32, y: f32| x >= b[0] && y >= b[1] && x <= b[2] && y <= b[3];
    let clicks = |of: &dyn Fn(f32, f32) -> bool| -> Vec<Labelled> {
        let answer_key = prompts.points.iter().filter(|p| !p.inside || of(p.x, p.y));
        let mut clicks: Vec<Labelled> =
            answer_key.map(|p| ([p.x, p.y], if p.inside { INSIDE } else { OUTSIDE })).collect();
        if let Some(first) = clicks.iter().position(|c| c.1 == INSIDE) {
            clicks[..=first].rotate_right(1);
        }
        clicks
    };
    let mut groups: Vec<PromptGroup> = boxes
        .iter()
        .map(|b| PromptGroup {
            corners: vec![([b[0], b[1]], CORNERS[0]), ([b[2], b[3]], CORNERS[1])],
            clicks: clicks(&|x, y| holds(b, x, y)),
        })
        .collect();
    let loose = clicks(&|x, y| !boxes.iter().any(|b| holds(b, x, y)));
    if loose.iter().any(|c| c.1 == INSIDE) {
        groups.push(PromptGroup { corners: Vec::new(), clicks: loose });
    }
    Ok(groups)
}

impl PromptGroup {
    /// The query of each step: the box, then click by click, each with all prompts before it.
    pub fn steps(&self) -> Vec<Vec<Labelled>> {
        let first = usize::from(self.corners.is_empty());
        (first..=self.clicks.len())
            .map(|n| self.corners.iter().chain(&self.clicks[..n]).copied().collect())
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::{BoxPrompt, PointPrompt};

    fn point(x: f32, y: f32, inside: bool) -> PointPrompt {
        PointPrompt { x, y, inside }
    }

    #[test]
    fn clicks_are_queried_one_after_another_the_first_inside_first() {
        let image = Image::zeros(100, 50, 3);
        let points = vec![point(1.0, 2.0, false), point(3.0, 4.0, true), point(5.0, 6.0, true)];
        let groups = groups(&image, &Prompts { points, ..Prompts::default() }).unwrap();
        let [group] = &groups[..] else { panic!("{groups:?}") };
        let (a, b, c) = (([3.0, 4.0], 1.0), ([1.0, 2.0], 0.0), ([5.0, 6.0], 1.0));
        assert_eq!(group.steps(), [vec![a], vec![a, b], vec![a, b, c]]);
    }

    #[test]
    fn each_box_has_its_own_clicks_and_those_in_none_are_queried_alone() {
        let image = Image::zeros(100, 50, 3);
        let boxes = vec![
            BoxPrompt { x0: 20.0, y0: 30.0, x1: 10.0, y1: 10.0 },
            BoxPrompt { x0: 60.0, y0: 10.0, x1: 900.0, y1: 20.0 },
        ];
        let points = vec![point(15.0, 15.0, true), point(40.0, 40.0, true), point(70.0, 15.0, false)];
        let groups = groups(&image, &Prompts { points, boxes, granularity: None }).unwrap();
        assert_eq!(groups.len(), 3);
        let out = ([70.0, 15.0], 0.0);
        assert_eq!(groups[0].corners, [([10.0, 10.0], 2.0), ([20.0, 30.0], 3.0)]);
        assert_eq!(groups[0].clicks, [([15.0, 15.0], 1.0), out]);
        assert_eq!(groups[1].corners[1], ([100.0, 20.0], 3.0), "cut to the photo");
        assert_eq!(groups[1].clicks, [out]);
        assert_eq!((groups[1].steps().len(), groups[1].steps()[0].len()), (2, 2), "the box begins");
        assert_eq!((groups[2].corners.len(), groups[2].clicks[0]), (0, ([40.0, 40.0], 1.0)));
    }

    #[test]
    fn prompts_that_cannot_be_queried_are_refused() {
        let image = Image::zeros(100, 50, 3);
        let says = |prompts: Prompts, word: &str| {
            let error = groups(&image, &prompts).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        };
        says(Prompts::default(), "nothing says what is wanted");
        says(Prompts { points: vec![point(1.0, 1.0, false)], ..Prompts::default() }, "nothing says");
        says(Prompts::click(100.0, 1.0), "outside the photo");
        says(Prompts::click(f32::NAN, 1.0), "outside the photo");
        let flat = BoxPrompt { x0: 5.0, y0: 5.0, x1: 5.0, y1: 9.0 };
        says(Prompts { boxes: vec![flat], ..Prompts::default() }, "holds nothing");
        let strange = BoxPrompt { x0: f32::NAN, y0: 5.0, x1: f32::NAN, y1: 9.0 };
        says(Prompts { boxes: vec![strange], ..Prompts::default() }, "holds nothing");
    }
}
