//! Points without a colour of their own.
//!
//! Many programs write points without colouring them: all are black, white or grey then, or those of one of several merged
//! models are black. Such a colour is not that of the scene, and the photos have to give the right one.

use crate::{Point, Scene};

/// The darkest colour that a point has, in [0, 1]. A splat's colour is held at 0 from below and takes no gradient there, so one
/// that starts at 0 would stay black for good.
pub const DARKEST: f32 = 1.0 / 255.0;

/// Share of the points from which black stands for no colour, and from which any one colour does.
const BLACK: f64 = 0.1;
const ALIKE: f64 = 0.9;
/// Fewer points than this may well be of one colour.
const FEW: usize = 32;

impl Scene {
    /// The colour that stands for none in this scene: black where a tenth of the points is black, or that of nine points in ten
    /// where they are not few.
    /// `None` where the points are coloured.
    ///
    /// ```
    /// # use segwild_scene::{DARKEST, Point, Scene};
    /// # let point = |colour| Point { position: glam::Vec3::ZERO, colour, track: vec![] };
    /// # let of = |points| Scene::new(vec![], points);
    /// let coloured = (0..10).map(|i| point([0.1 * i as f32; 3])).collect();
    /// assert_eq!(of(coloured).colourless(), None);
    /// assert_eq!(of(vec![point([DARKEST; 3]); 10]).colourless(), Some([DARKEST; 3]));
    /// ```
    pub fn colourless(&self) -> Option<[f32; 3]> {
        colourless(&self.points)
    }

    /// A note for the user about points without colour.
    pub(crate) fn about_colours(&self) -> Option<String> {
        let none = self.colourless()?;
        let alike = self.points.iter().filter(|p| p.colour == none).count();
        let byte = |c: f32| if c > DARKEST { (c * 255.0).round() as u8 } else { 0 };
        let [r, g, b] = none.map(byte);
        Some(format!(
            "{alike} of {} points have no colour of their own (they are RGB {r} {g} {b}): photos give them theirs",
            self.points.len()
        ))
    }
}

/// [`Scene::colourless`] of its points.
pub(crate) fn colourless(points: &[Point]) -> Option<[f32; 3]> {
    let share = |colour: [f32; 3]| {
        let alike = points.iter().filter(|p| p.colour == colour).count();
        alike as f64 / points.len() as f64
    };
    let black = [DARKEST; 3];
    if share(black) >= BLACK {
        return Some(black);
    }
    let alike = |&colour: &[f32; 3]| points.len() >= FEW && share(colour) >= ALIKE;
    most_frequent(points).filter(alike)
}

/// The colour of more than half of the points, if one has so many; any other or none otherwise.
fn most_frequent(points: &[Point]) -> Option<[f32; 3]> {
    let mut candidate = (None, 0usize);
    for point in points {
        candidate = match candidate {
            (_, 0) => (Some(point.colour), 1),
            (colour, votes) if colour == Some(point.colour) => (colour, votes + 1),
            (colour, votes) => (colour, votes - 1),
        };
    }
    candidate.0
}
