//! How well each photo's own mask agrees with a selection (method, section 6.8).

use crate::request::view;
use crate::sides::ShownSide;
use crate::{PosedView, Request, SegmentError, Selection, SpikeCut, visible_mask};
use glam::Vec3;
use segwild_scene::statistics::upper_median;
use segwild_scene::{Mask, ScoredMask, Splats};
use serde::{Deserialize, Serialize};

/// Long side in pixels at which silhouettes and masks are compared (method, section 6.8). By choice: outlines that are less than
/// a pixel apart there agree, and a photo is rendered in little time.
const AGREEMENT_SIZE: u32 = 256;

/// How well one photo agrees with a selection.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhotoAgreement {
    /// The photo's name.
    pub photo: String,
    /// Whether it was prompted.
    pub prompted: bool,
    /// The side of the object that it shows.
    pub side: ShownSide,
    /// IoU of the selection's silhouette in it with its own mask, in [0, 1], transients left out.
    pub agreement: f32,
    /// Share of its pixels that show the selection, in [0, 1].
    pub shown: f32,
    /// Whether the agreement is less than a mask needs to count.
    pub disagrees: bool,
}

/// A photo with a mask of its own, compared with a selection.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct MeasuredPhoto {
    /// The photo's name.
    pub photo: String,
    /// Whether it was prompted.
    pub prompted: bool,
    /// From the middle of the object to the camera, a unit vector; zero where the camera stands there.
    pub direction: Vec3,
    /// As [`PhotoAgreement::agreement`].
    pub agreement: f32,
    /// As [`PhotoAgreement::shown`].
    pub shown: f32,
}

/// The photos with masks of their own, compared with a selection.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct MeasuredPhotos {
    /// The prompted ones first.
    pub photos: Vec<MeasuredPhoto>,
    /// Of each view in whose frame the middle of the object lies, as [`MeasuredPhoto::direction`].
    pub facing: Vec<Vec3>,
}

/// Compares a selection with the masks of the prompts and with those that its last round over the photos gave. A photo that
/// neither shows the selection nor has a mask of it is left out. Spikes are not cut: what they add is rarely a pixel here.
///
/// # Errors
/// When the scene cannot be rendered, or nobody waits for the answer any more.
pub(crate) fn measure(
    request: &Request,
    selection: &Selection,
    cut: &SpikeCut,
    masks: &[(usize, ScoredMask)],
) -> Result<MeasuredPhotos, SegmentError> {
    let mut labels = selection.labels.clone();
    // What joins by a piece would stick out whole.
    cut.dropped.iter().for_each(|&i| labels[i as usize] = false);
    let Some(middle) = middle(request.splats, &labels) else { return Ok(MeasuredPhotos::default()) };
    let prompted = masks.iter().map(|(view, mask)| (*view, &mask.mask, true));
    let others = selection.visits.iter().filter_map(|visit| Some((visit.view, visit.own_mask()?, false)));
    let mut measured = Vec::new();
    for (index, mask, prompted) in prompted.chain(others) {
        request.wanted()?;
        let Some(ComparedSilhouette { agreement, shown }) = compared(request, &labels, index, mask)? else {
            continue;
        };
        let posed = view(request, index)?;
        let direction = direction_to(posed, middle);
        measured.push(MeasuredPhoto { photo: posed.name.clone(), prompted, direction, agreement, shown });
    }
    let in_frame = |posed: &&PosedView| {
        let point = posed.pose.to_camera(middle);
        point.z > 0.0 && posed.camera.contains(posed.camera.pixel(point))
    };
    let facing = request.views.iter().filter(in_frame);
    let facing = facing.map(|posed| direction_to(posed, middle)).collect();
    Ok(MeasuredPhotos { photos: measured, facing })
}

/// From a point to a view's camera, a unit vector; zero where the camera stands there.
fn direction_to(posed: &PosedView, point: Vec3) -> Vec3 {
    (posed.pose.centre() - point).normalize_or_zero()
}

/// The middle of labelled splats, by medians of coordinates; `None` where there are none.
fn middle(splats: &Splats, labels: &[bool]) -> Option<Vec3> {
    let coordinates = |axis: usize| {
        let labelled = splats.means.iter().zip(labels).filter(|(_, label)| **label);
        upper_median(labelled.map(|(mean, _)| mean[axis]).collect())
    };
    Some(Vec3::new(coordinates(0)?, coordinates(1)?, coordinates(2)?))
}

/// A silhouette beside a mask.
struct ComparedSilhouette {
    agreement: f32,
    shown: f32,
}

/// Renders labelled splats into a view and compares them with its own mask; `None` where both are empty.
fn compared(
    request: &Request,
    labels: &[bool],
    index: usize,
    mask: &Mask,
) -> Result<Option<ComparedSilhouette>, SegmentError> {
    let posed = view(request, index)?;
    let camera = posed.camera.scaled_to(AGREEMENT_SIZE);
    let (rasterizer, options) = (request.rasterizer, &request.options);
    let silhouette = visible_mask(rasterizer, request.splats, labels, options, &camera, &posed.pose)
        .map_err(SegmentError::raster(&posed.name))?;
    let shown = silhouette.count() as f32 / (camera.width as f32 * camera.height as f32).max(1.0);
    let fitted = |mask: &Mask| mask.resized(camera.width, camera.height);
    let (own, silhouette) = match request.transients_in(index).as_ref().map(fitted) {
        Some(transients) => (fitted(mask).minus(&transients), silhouette.minus(&transients)),
        None => (fitted(mask), silhouette),
    };
    if own.is_empty() && silhouette.is_empty() {
        return Ok(None);
    }
    Ok(Some(ComparedSilhouette { agreement: own.iou(&silhouette) as f32, shown }))
}
