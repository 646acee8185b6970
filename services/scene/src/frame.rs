//! The normalised frame of a scene, robust to photos and points that lie absurdly far away.
//!
//! The frame is that of all cameras (docs/method.md, section 0) as long as they are of one range. A few photos from a hundred times
//! farther, or one wrong pose, would make it so large that all that is near lies before the near plane. Then the other cameras set
//! it. The far photos stay if their observations agree with those of others.

use crate::draft::{Draft, DraftPoint, DraftPose};
use crate::lens::Lens;
use crate::statistics::upper_median;
use crate::{Camera, NEAR, SceneFrame};
use glam::DVec3;
use rayon::prelude::*;

/// Cameras nearer together than this part of the points' distance coincide.
const COINCIDE: f64 = 1e-6;
/// A camera is far off at so many times the median distance of cameras, or the median depth of points, whichever is more.
const FAR_OFF: f64 = 8.0;
/// Least share of the points of a far photo that lie where it saw them, as a share of its long side.
const AGREEING: f64 = 0.5;
const ASTRAY: f64 = 0.02;
/// Least number of points that a far photo shares with others.
const SHARED: usize = 3;
/// Share of the observations before the near plane from which the plane comes nearer; where no point has a track, the share of
/// the points.
const CULLED: f64 = 0.005;
const CULLED_UNSEEN: f64 = 0.02;
/// The observation, as a share of all by depth, that then lies at twice the near plane's distance.
const NEAREST: f64 = 0.001;
/// Points beyond so many scene extents, or median distances if these are more, are outliers without multi-view support: this
/// many photos must have seen such a point where it lies.
const BEYOND: f64 = 1e3;
const SUPPORT: usize = 3;
/// Points and cameras that are sampled where no point has a track.
const SAMPLED: (usize, usize) = (2000, 200);

/// A usable photo as the reconstruction places it, in file units.
pub(crate) struct Placed<'a> {
    /// Index in [`Draft::photos`].
    pub photo: usize,
    pub pose: DraftPose,
    /// The pinhole that the photo has after undistortion, at its own size.
    pub camera: Camera,
    /// The lens at the size that the reconstruction knew.
    pub lens: &'a Lens,
}

impl Placed<'_> {
    /// A point of the file in the camera's frame.
    fn to_camera(&self, point: DVec3) -> DVec3 {
        self.pose.rotation * (point - self.pose.centre)
    }

    /// Pixel of a point in front of the camera, at the photo's own size.
    fn pixel(&self, point: DVec3) -> Option<[f64; 2]> {
        let p = self.to_camera(point);
        let Camera { fx, fy, cx, cy, .. } = self.camera;
        let at = |f: f32, c: f32, v: f64| f64::from(f) * v / p.z + f64::from(c);
        (p.z > 0.0).then(|| [at(fx, cx, p.x), at(fy, cy, p.y)])
    }

    fn shows(&self, point: DVec3) -> bool {
        let (w, h) = (f64::from(self.camera.width), f64::from(self.camera.height));
        self.pixel(point).is_some_and(|[x, y]| x >= 0.0 && y >= 0.0 && x < w && y < h)
    }

    /// Whether a point lies where the photo saw it.
    fn agrees(&self, point: DVec3, seen: Option<[f64; 2]>) -> bool {
        let Some(seen) = seen else { return self.shows(point) };
        let seen = if self.lens.is_distorted() { self.lens.undistort(seen) } else { Some(seen) };
        let (Some(seen), Some(at)) = (seen, self.pixel(point)) else { return false };
        let (w, h) = (f64::from(self.camera.width), f64::from(self.camera.height));
        let dx = at[0] - seen[0] * w / self.lens.width() as f64;
        let dy = at[1] - seen[1] * h / self.lens.height() as f64;
        dx.hypot(dy) < ASTRAY * w.max(h)
    }
}

/// The usable photos of a draft, and which of them stand far off.
pub(crate) struct Placing<'a> {
    draft: &'a Draft,
    placed: Vec<Placed<'a>>,
    /// Per photo of the draft, its index among those placed.
    index: Vec<Option<usize>>,
    far: Vec<bool>,
}

impl<'a> Placing<'a> {
    pub(crate) fn new(draft: &'a Draft, placed: Vec<Placed<'a>>) -> Placing<'a> {
        let mut index = vec![None; draft.photos.len()];
        placed.iter().enumerate().for_each(|(i, p)| index[p.photo] = Some(i));
        let mut placing = Placing { draft, far: vec![false; placed.len()], placed, index };
        placing.far = placing.far_off();
        placing
    }

    /// Takes out the photos that stand far off though their points do not agree: index in [`Draft::photos`], and why.
    pub(crate) fn take_misplaced(&mut self) -> Vec<(usize, String)> {
        let misplaced = self.misplaced();
        if !misplaced.is_empty() {
            let mut placed = std::mem::take(&mut self.placed);
            placed.retain(|p| misplaced.iter().all(|(photo, _)| *photo != p.photo));
            *self = Placing::new(self.draft, placed);
        }
        misplaced
    }

    fn misplaced(&self) -> Vec<(usize, String)> {
        let far: Vec<usize> = (0..self.placed.len()).filter(|&i| self.far[i]).collect();
        if far.is_empty() {
            return Vec::new();
        }
        let shared = self.shared();
        let tracked = self.draft.points.iter().any(|p| !p.track.is_empty());
        let why = |i: usize| {
            let reason = match shared[i] {
                _ if !tracked => (!self.shows_any(i)).then(|| "and no point projects into it".to_owned()),
                (n, _) if n < SHARED => Some("and it shares no points with them".to_owned()),
                (n, agreeing) if (agreeing as f64) < AGREEING * n as f64 => {
                    Some(format!("and of {n} points it saw, {} lie elsewhere in it", n - agreeing))
                }
                _ => None,
            };
            let words = |reason| format!("it stands far away from all others, {reason}: its pose is wrong");
            reason.map(|reason| (self.placed[i].photo, words(reason)))
        };
        far.into_iter().filter_map(why).collect()
    }

    /// The normalised frame.
    pub(crate) fn frame(&self) -> SceneFrame {
        let near = |(p, far): (&Placed, &bool)| (!far).then_some(p.pose.centre);
        let centres: Vec<DVec3> = self.placed.iter().zip(&self.far).filter_map(near).collect();
        let positions: Vec<DVec3> =
            self.draft.points.iter().map(|p| p.position).filter(|p| p.is_finite()).collect();
        let frame = frame_of(&centres, &positions);
        match self.nearest(f64::from(NEAR) * frame.scale) {
            Some(depth) => SceneFrame { scale: frame.scale.min(depth / f64::from(2.0 * NEAR)), ..frame },
            None => frame,
        }
    }

    /// Notes for the user about photos and points that lie far off.
    pub(crate) fn notes(&self, frame: &SceneFrame, outliers: &[bool]) -> Vec<String> {
        let far = self.placed.iter().zip(&self.far).filter(|(_, far)| **far);
        let names: Vec<&str> = far.map(|(p, _)| self.draft.photos[p.photo].name.as_str()).collect();
        let photos = names.first().map(|first| {
            let (n, all) = (names.len(), self.placed.len());
            format!("{n} of {all} photos stand far away from all others, such as {first}: the others set the scale")
        });
        let (count, all) = (outliers.iter().filter(|o| **o).count(), outliers.len());
        let outliers = (count > 0).then(|| {
            format!(
                "{count} of {all} points lie absurdly far away, without photos that agree, and are left out"
            )
        });
        photos.into_iter().chain(outliers).chain(self.rounded(frame)).collect()
    }

    /// A note for the user about positions that were rounded to single precision before they were read.
    fn rounded(&self, frame: &SceneFrame) -> Option<String> {
        let single = |v: f64| f64::from(v as f32) == v;
        let mut all = self.draft.points.iter().flat_map(|p| p.position.to_array());
        if self.draft.points.is_empty() || frame.offset() == DVec3::ZERO || !all.all(single) {
            return None;
        }
        let largest = frame.origin.abs().max_element();
        let step = (largest.log2().floor() - f64::from(f32::MANTISSA_DIGITS - 1)).exp2();
        Some(format!(
            "the points are 32-bit numbers, which are rounded to {step} so far from the origin: write them as `double`, or \
             subtract an offset from points and poses"
        ))
    }

    /// Per point of the draft, whether it lies so far off that it can only be an error.
    pub(crate) fn outliers(&self, frame: &SceneFrame) -> Vec<bool> {
        let distance = |p: &DraftPoint| p.position.distance(frame.origin);
        let finite = self.draft.points.iter().map(distance).filter(|d| d.is_finite());
        // Cameras may stand closely together before a scene that is far from all of them.
        let limit = BEYOND * frame.scale.max(upper_median(finite.collect()).unwrap_or(0.0));
        let agree = |p: &DraftPoint| {
            let agreeing = self.sightings(p).filter(|(photo, seen)| photo.agrees(p.position, *seen));
            agreeing.count() >= SUPPORT
        };
        self.draft.points.iter().map(|p| distance(p) > limit && !agree(p)).collect()
    }

    /// The usable photos that saw a point, and where.
    fn sightings<'b>(
        &'b self,
        point: &'b DraftPoint,
    ) -> impl Iterator<Item = (&'b Placed<'a>, Option<[f64; 2]>)> {
        point.track.iter().filter_map(|&(photo, seen)| Some((&self.placed[self.index[photo]?], seen)))
    }

    /// Per placed photo, whether it stands far off.
    fn far_off(&self) -> Vec<bool> {
        let middle = {
            let median_of = |axis: fn(&DVec3) -> f64| {
                let coordinates = self.placed.iter().map(|p| axis(&p.pose.centre)).collect();
                upper_median(coordinates).unwrap_or(0.0)
            };
            DVec3::new(median_of(|c| c.x), median_of(|c| c.y), median_of(|c| c.z))
        };
        let distances: Vec<f64> = self.placed.iter().map(|p| p.pose.centre.distance(middle)).collect();
        let largest = distances.iter().fold(0.0, |a: f64, &b| a.max(b));
        let range = upper_median(distances.clone()).unwrap_or(0.0);
        // Most scenes end here, before any point is read.
        if largest <= FAR_OFF * range {
            return vec![false; self.placed.len()];
        }
        let range = range.max(self.median_depth(middle));
        distances.into_iter().map(|d| range > 0.0 && d > FAR_OFF * range).collect()
    }

    /// Median depth of the observed points; of points without tracks, the median distance.
    fn median_depth(&self, middle: DVec3) -> f64 {
        let depth = |(p, point): (&Placed, &DraftPoint)| p.to_camera(point.position).z;
        let points = self.draft.points.iter().filter(|p| p.position.is_finite());
        let depths: Vec<f64> = points
            .clone()
            .flat_map(|point| self.sightings(point).map(move |(p, _)| depth((p, point))))
            .filter(|&z| z > 0.0)
            .collect();
        let distances = || points.map(|p| p.position.distance(middle)).collect();
        upper_median(depths).or_else(|| upper_median(distances())).unwrap_or(0.0)
    }

    /// Per photo that stands far off, how many of its points another photo saw too, and how many of these lie where it saw them.
    fn shared(&self) -> Vec<(usize, usize)> {
        let mut counts = vec![(0, 0); self.placed.len()];
        for point in &self.draft.points {
            let seen: Vec<(usize, Option<[f64; 2]>)> =
                point.track.iter().filter_map(|&(photo, seen)| Some((self.index[photo]?, seen))).collect();
            if seen.iter().all(|&(i, _)| i == seen[0].0) {
                continue;
            }
            for (i, pixel) in seen.into_iter().filter(|&(i, _)| self.far[i]) {
                counts[i].0 += 1;
                counts[i].1 += usize::from(self.placed[i].agrees(point.position, pixel));
            }
        }
        counts
    }

    fn shows_any(&self, i: usize) -> bool {
        self.draft.points.iter().any(|p| p.position.is_finite() && self.placed[i].shows(p.position))
    }

    /// How near the nearest points are, where the near plane would cut off more than a few; in file units.
    fn nearest(&self, near: f64) -> Option<f64> {
        let tracked = self.draft.points.iter().any(|p| !p.track.is_empty());
        let (mut depths, limit) =
            if tracked { (self.seen_depths(near), CULLED) } else { (self.sampled_depths(), CULLED_UNSEEN) };
        let culled = depths.iter().filter(|&&z| z <= near).count();
        if (culled as f64) <= limit * depths.len() as f64 {
            return None;
        }
        let nth = (NEAREST * depths.len() as f64) as usize;
        Some(*depths.select_nth_unstable_by(nth, f64::total_cmp).1)
    }

    /// Depths at which photos saw points; of those before the near plane, where the points lie where they were seen.
    fn seen_depths(&self, near: f64) -> Vec<f64> {
        let of = |point: &'a DraftPoint| {
            let depth = move |(p, seen): (&Placed, _)| {
                let z = p.to_camera(point.position).z;
                (z > near || z > 0.0 && p.agrees(point.position, seen)).then_some(z)
            };
            self.sightings(point).filter_map(depth).collect::<Vec<f64>>()
        };
        self.draft.points.par_iter().filter(|p| p.position.is_finite()).flat_map_iter(of).collect()
    }

    /// Of some points, the depth in the nearest of some cameras that show them.
    fn sampled_depths(&self) -> Vec<f64> {
        let every = |n: usize, most: usize| n.div_ceil(most).max(1);
        let points = self.draft.points.iter().step_by(every(self.draft.points.len(), SAMPLED.0));
        let cameras: Vec<&Placed> = self.placed.iter().step_by(every(self.placed.len(), SAMPLED.1)).collect();
        let nearest = |point: &DraftPoint| {
            let shown = cameras.iter().filter(|p| p.shows(point.position));
            shown.map(|p| p.to_camera(point.position).z).min_by(f64::total_cmp)
        };
        points.filter(|p| p.position.is_finite()).filter_map(nearest).collect()
    }
}

/// The frame of cameras that are of one range. Where they coincide, or there is one only, they do not determine the scale: then
/// it is the median distance of the points, or 1.
fn frame_of(centres: &[DVec3], points: &[DVec3]) -> SceneFrame {
    let origin = centres.iter().sum::<DVec3>() / centres.len() as f64;
    let radius = centres.iter().map(|c| c.distance(origin)).fold(0.0, f64::max);
    let distances = points.iter().map(|p| p.distance(origin)).filter(|d| d.is_finite()).collect();
    let median = upper_median(distances).unwrap_or(0.0);
    let rounding = origin.abs().max_element() * 1e-12;
    let scale = if radius > (COINCIDE * median).max(rounding) {
        1.1 * radius
    } else if median > rounding {
        median
    } else {
        1.0
    };
    SceneFrame { origin, scale }
}
