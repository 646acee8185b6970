//! The sides of an object that photos show: the one that was prompted, and the rest (method, section 6.8).

use glam::Vec3;
use serde::{Deserialize, Serialize};

/// Cosine of the angle to the nearest prompted photo, as seen from the object, up to which a photo shows the prompted side: 60
/// degrees (method, section 6.8). By choice: photos all around fall into two thirds that are far, and from above or below most are.
const SIDE_COSINE: f32 = 0.5;

/// A side of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShownSide {
    /// The one that the prompted photos show.
    Prompted,
    /// The rest: the back, the top, the bottom.
    Far,
}

/// How well the photos of one side agree with a selection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SideAgreement {
    /// Photos of the side that have a mask of their own.
    pub photos: usize,
    /// Their mean agreement, in [0, 1]; `None` where there are none.
    pub agreement: Option<f32>,
}

impl SideAgreement {
    /// Of the agreements of a side's photos.
    pub(crate) fn of(agreements: &[f32]) -> SideAgreement {
        let mean = agreements.iter().sum::<f32>() / agreements.len().max(1) as f32;
        SideAgreement { photos: agreements.len(), agreement: (!agreements.is_empty()).then_some(mean) }
    }
}

/// Cosine of the angle of a direction to the nearest of others; 1 where there are no others: nothing is known to be far then.
pub(crate) fn nearest_cosine(direction: Vec3, others: &[Vec3]) -> f32 {
    others.iter().map(|other| direction.dot(*other)).reduce(f32::max).unwrap_or(1.0)
}

/// The side that a photo shows, by its [`nearest_cosine`] to the prompted ones.
pub(crate) fn side_at(cosine: f32) -> ShownSide {
    if cosine >= SIDE_COSINE { ShownSide::Prompted } else { ShownSide::Far }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(degrees: f32) -> Vec3 {
        let (sin, cos) = degrees.to_radians().sin_cos();
        Vec3::new(cos, 0.0, sin)
    }

    #[test]
    fn photos_within_sixty_degrees_of_any_prompted_one_show_its_side() {
        let prompted = [at(0.0), at(90.0)];
        let side = |direction: Vec3| side_at(nearest_cosine(direction, &prompted));
        for near in [0.0, 45.0, 59.0, -59.0, 149.0] {
            assert_eq!(side(at(near)), ShownSide::Prompted, "{near}");
        }
        for far in [-61.0, 151.0, 225.0] {
            assert_eq!(side(at(far)), ShownSide::Far, "{far}");
        }
        assert_eq!(side(Vec3::Y), ShownSide::Far, "from above");
        assert_eq!(side_at(nearest_cosine(at(180.0), &[])), ShownSide::Prompted, "nothing was prompted");
    }

    #[test]
    fn a_side_without_photos_has_no_agreement() {
        assert_eq!(SideAgreement::of(&[]), SideAgreement::default());
        assert_eq!(SideAgreement::of(&[0.5, 1.0]), SideAgreement { photos: 2, agreement: Some(0.75) });
    }
}
