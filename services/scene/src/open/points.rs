//! The points of a scene, and which views saw them.

use crate::draft::Draft;
use crate::lens::Lens;
use crate::{DARKEST, Observation, Point, SceneFrame, View};
use glam::Vec3;
use rayon::prelude::*;

/// The points of a draft in the scene's frame: those that lie somewhere, are no outliers, and that a view saw if any photo did.
/// `view_of` has the view of each photo of the draft, `outliers` whether each point is one.
pub(super) fn points(
    draft: &Draft,
    views: &[View],
    view_of: &[Option<u32>],
    frame: &SceneFrame,
    outliers: &[bool],
) -> Vec<Point> {
    let lenses: Vec<_> = draft.photos.iter().map(|p| p.lens.as_ref().ok()).collect();
    draft
        .points
        .par_iter()
        .zip(outliers)
        .filter_map(|(point, &outlier)| {
            if !point.position.is_finite() || outlier {
                return None;
            }
            let position = ((point.position - frame.origin) / frame.scale).as_vec3();
            let seen = |&(photo, pixel): &(usize, Option<[f64; 2]>)| {
                let (view, lens) = (view_of[photo]?, lenses[photo]?);
                let pixel = observed(&views[view as usize], lens, position, pixel)?;
                Some(Observation { view, pixel })
            };
            let mut track: Vec<Observation> = point.track.iter().filter_map(seen).collect();
            // Of several sightings in one photo the first counts.
            track.sort_by_key(|o| o.view);
            track.dedup_by_key(|o| o.view);
            // A list that grew holds up to twice its content, and tracks are most of what a scene of many photos holds.
            track.shrink_to_fit();
            // A point that only unusable photos saw is of no use; one without a track is taken as it is.
            let lost =
                !point.track.is_empty() && point.track.iter().all(|(photo, _)| view_of[*photo].is_none());
            let colour = point.colour.map(|c| (f32::from(c) / 255.0).max(DARKEST));
            (position.is_finite() && !lost).then_some(Point { position, colour, track })
        })
        .collect()
}

/// The pixel of a sighting after undistortion, if the view shows it. Where the file gives no pixel, the point's own
/// projection stands for it.
fn observed(view: &View, lens: &Lens, position: Vec3, pixel: Option<[f64; 2]>) -> Option<[f32; 2]> {
    let camera = &view.camera;
    let pixel = match pixel {
        Some(p) => {
            let p = if lens.is_distorted() { lens.undistort(p)? } else { p };
            // From the size the reconstruction knew to that of the file.
            let scale = [
                f64::from(camera.width) / f64::from(lens.width()),
                f64::from(camera.height) / f64::from(lens.height()),
            ];
            [(p[0] * scale[0]) as f32, (p[1] * scale[1]) as f32]
        }
        None => {
            let p = view.pose.to_camera(position);
            if p.z <= 0.0 {
                return None;
            }
            camera.pixel(p).to_array()
        }
    };
    camera.contains(pixel.into()).then_some(pixel)
}
