//! Splats that a person marks by hand: inside a polygon or a brush stroke of a view, or inside a sphere.

use glam::{Vec2, Vec3};
use segwild_pipeline::{RunError, Session};
use segwild_raster::NO_SPLAT;
use segwild_scene::{Camera, NEAR, Pose};
use serde::{Deserialize, Serialize};

/// Corners or points of a region at most.
pub const MOST_POINTS: usize = 4096;

/// A region, in pixels of its camera or in units of the scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "shape", rename_all = "snake_case")]
pub enum Region {
    /// A polygon of a view: a rectangle or a lasso.
    Polygon {
        /// Its corners.
        points: Vec<[f32; 2]>,
    },
    /// A brush stroke of a view.
    Brush {
        /// Points along it.
        points: Vec<[f32; 2]>,
        /// Radius in pixels.
        radius: f32,
    },
    /// A sphere around the splat in front at a pixel.
    Sphere {
        /// The pixel.
        at: [f32; 2],
        /// Radius, as pixels at that depth.
        radius: f32,
    },
}

/// Which splats of a region are taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RegionRule {
    /// Those whose centre lies in it.
    #[default]
    Centre,
    /// Those whose centre lies in it and that show in the view.
    Visible,
    /// Those that are in front at one of its pixels.
    Footprint,
}

/// How a region changes a selection.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Combination {
    /// Its splats are added.
    Add,
    /// Its splats are taken away.
    Subtract,
    /// Only its splats stay.
    Intersect,
}

impl Combination {
    /// Changes a selection by another.
    pub fn apply(self, labels: &mut [bool], other: &[bool]) {
        for (label, other) in labels.iter_mut().zip(other) {
            *label = match self {
                Combination::Add => *label || *other,
                Combination::Subtract => *label && !*other,
                Combination::Intersect => *label && *other,
            };
        }
    }
}

impl Region {
    /// Why the region cannot be used, if it cannot.
    pub fn flaw(&self) -> Option<&'static str> {
        let (points, radius) = match self {
            Region::Polygon { points } => (points.as_slice(), 1.0),
            Region::Brush { points, radius } => (points.as_slice(), *radius),
            Region::Sphere { at, radius } => (std::slice::from_ref(at), *radius),
        };
        let least = if matches!(self, Region::Polygon { .. }) { 3 } else { 1 };
        if points.len() < least || points.len() > MOST_POINTS {
            return Some("it has too few or too many points");
        }
        let sound = points.iter().flatten().all(|x| x.is_finite()) && radius.is_finite() && radius > 0.0;
        if sound { None } else { Some("its positions are no numbers") }
    }

    /// Whether it holds a position of its view.
    pub(crate) fn holds(&self, p: Vec2) -> bool {
        match self {
            Region::Polygon { points } => in_polygon(points, p),
            Region::Brush { points, radius } => {
                let near = |pair: &[[f32; 2]]| to_segment(pair[0].into(), pair[1].into(), p) <= *radius;
                match points.as_slice() {
                    [one] => Vec2::from(*one).distance(p) <= *radius,
                    all => all.windows(2).any(near),
                }
            }
            Region::Sphere { .. } => false,
        }
    }

    /// Whether each splat of a session's scene is taken.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn splats(
        &self,
        session: &Session,
        camera: &Camera,
        pose: &Pose,
        rule: RegionRule,
    ) -> Result<Vec<bool>, RunError> {
        let splats = &session.model().splats;
        let n = splats.len();
        if let Region::Sphere { at, radius } = self {
            let front = session.front_from(camera, pose)?;
            let inside = camera.contains((*at).into());
            let index = if inside { at[1] as usize * front.width + at[0] as usize } else { usize::MAX };
            let Some(centre) = front.splats.get(index).filter(|s| **s != NO_SPLAT) else {
                return Ok(vec![false; n]);
            };
            let centre = splats.mean(*centre as usize);
            let radius = radius * pose.to_camera(centre).z / camera.fx;
            return Ok((0..n).map(|i| splats.mean(i).distance(centre) <= radius).collect());
        }
        if rule == RegionRule::Footprint {
            let front = session.front_from(camera, pose)?;
            let mut taken = vec![false; n];
            for (i, &splat) in front.splats.iter().enumerate().filter(|(_, s)| **s != NO_SPLAT) {
                let at = Vec2::new((i % front.width) as f32 + 0.5, (i / front.width) as f32 + 0.5);
                taken[splat as usize] |= self.holds(at);
            }
            return Ok(taken);
        }
        let centre_in = |i: usize| {
            let p: Vec3 = pose.to_camera(splats.mean(i));
            p.z > NEAR && self.holds(camera.pixel(p))
        };
        let mut taken: Vec<bool> = (0..n).map(centre_in).collect();
        if rule == RegionRule::Visible {
            let front = session.front_from(camera, pose)?;
            let mut shows = vec![false; n];
            front.splats.iter().filter(|s| **s != NO_SPLAT).for_each(|&s| shows[s as usize] = true);
            Combination::Intersect.apply(&mut taken, &shows);
        }
        Ok(taken)
    }
}

/// Whether a point lies in a polygon, by the parity of the edges that a ray to the right crosses.
fn in_polygon(corners: &[[f32; 2]], p: Vec2) -> bool {
    let mut inside = false;
    let mut last = corners[corners.len() - 1];
    for &corner in corners {
        let ([x0, y0], [x1, y1]) = (last, corner);
        if (y0 > p.y) != (y1 > p.y) && p.x < (x1 - x0) * (p.y - y0) / (y1 - y0) + x0 {
            inside = !inside;
        }
        last = corner;
    }
    inside
}

/// Distance of a point to a line segment.
fn to_segment(a: Vec2, b: Vec2, p: Vec2) -> f32 {
    let along = b - a;
    let t = ((p - a).dot(along) / along.length_squared().max(1e-12)).clamp(0.0, 1.0);
    (a + t * along).distance(p)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_polygon_holds_what_lies_inside() {
        // A ring of corners that is dented from the right.
        let dented = [[0.0, 0.0], [10.0, 0.0], [4.0, 5.0], [10.0, 10.0], [0.0, 10.0]];
        let polygon = Region::Polygon { points: dented.to_vec() };
        for (p, inside) in [([2.0, 5.0], true), ([8.0, 5.0], false), ([8.0, 1.0], true), ([-1.0, 5.0], false)]
        {
            assert_eq!(polygon.holds(p.into()), inside, "{p:?}");
        }
    }

    #[test]
    fn a_stroke_holds_what_its_radius_reaches() {
        let stroke = Region::Brush { points: vec![[0.0, 0.0], [10.0, 0.0]], radius: 2.0 };
        for (p, inside) in
            [([5.0, 1.9], true), ([5.0, 2.1], false), ([-1.9, 0.0], true), ([12.1, 0.0], false)]
        {
            assert_eq!(stroke.holds(p.into()), inside, "{p:?}");
        }
        let dot = Region::Brush { points: vec![[3.0, 3.0]], radius: 1.0 };
        assert!(dot.holds([3.5, 3.5].into()) && !dot.holds([4.5, 3.0].into()));
    }

    #[test]
    fn regions_without_an_inside_or_with_positions_that_are_no_numbers_are_refused() {
        let polygon = |points: Vec<[f32; 2]>| Region::Polygon { points }.flaw();
        assert!(polygon(vec![[0.0, 0.0], [1.0, 1.0]]).is_some());
        assert!(polygon(vec![[0.0, 0.0]; MOST_POINTS + 1]).is_some());
        assert!(polygon(vec![[0.0, f32::NAN], [1.0, 0.0], [1.0, 1.0]]).is_some());
        assert!(Region::Brush { points: vec![[0.0, 0.0]], radius: 0.0 }.flaw().is_some());
        assert!(Region::Sphere { at: [0.0, 0.0], radius: f32::INFINITY }.flaw().is_some());
        assert_eq!(polygon(vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), None);
    }

    #[test]
    fn selections_combine_as_sets() {
        let with = |how: Combination| {
            let mut labels = [true, true, false, false];
            how.apply(&mut labels, &[true, false, true, false]);
            labels
        };
        assert_eq!(with(Combination::Add), [true, true, true, false]);
        assert_eq!(with(Combination::Subtract), [false, true, false, false]);
        assert_eq!(with(Combination::Intersect), [true, false, false, false]);
    }
}
