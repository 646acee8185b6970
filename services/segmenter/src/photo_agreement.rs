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
    let photos: Vec<(usize, &Mask, bool)> = prompted.chain(others).collect();
    let measured = request.in_views(&photos, |&(index, mask, prompted)| {
        let Some(ComparedSilhouette { agreement, shown }) = compared(request, &labels, index, mask)? else {
            return Ok(None);
        };
        let posed = view(request, index)?;
        let direction = direction_to(posed, middle);
        Ok(Some(MeasuredPhoto { photo: posed.name.clone(), prompted, direction, agreement, shown }))
    })?;
    let in_frame = |posed: &&PosedView| {
        let point = posed.pose.to_camera(middle);
        point.z > 0.0 && posed.camera.contains(posed.camera.pixel(point))
    };
    let facing = request.views.iter().filter(in_frame);
    let facing = facing.map(|posed| direction_to(posed, middle)).collect();
    Ok(MeasuredPhotos { photos: measured.into_iter().flatten().collect(), facing })
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Evidence, PhotoVerdict, PhotoVisit, SegmentSettings};
    use segwild_raster::{CpuEngine, ProjectOptions};
    use segwild_scene::{Camera, Pose};

    /// Two balls of splats beside each other, the first one labelled, before a camera in front and one on the right.
    struct TwoBalls {
        splats: Splats,
        labels: Vec<bool>,
        views: [PosedView; 2],
        settings: SegmentSettings,
    }

    const LEFT: Vec3 = Vec3::new(-0.6, 0.0, 3.0);

    fn two_balls() -> TwoBalls {
        let mut splats = Splats::default();
        for centre in [LEFT, Vec3::new(0.6, 0.0, 3.0)] {
            for i in 0..27 {
                let at = |n: i32| 0.15 * (n % 3 - 1) as f32;
                splats.means.push((centre + Vec3::new(at(i), at(i / 3), at(i / 9))).to_array());
                splats.log_scales.push([0.12f32.ln(); 3]);
                splats.rotations.push([1.0, 0.0, 0.0, 0.0]);
                splats.opacities.push(3.0);
                splats.sh.extend([0.0; 3]);
            }
        }
        let camera = Camera { width: 160, height: 120, fx: 130.0, fy: 130.0, cx: 80.0, cy: 60.0 };
        let posed = |name: &str, eye: Vec3| PosedView {
            name: name.into(),
            camera,
            pose: Pose::look_at(eye, Vec3::new(0.0, 0.0, 3.0), Vec3::NEG_Y),
        };
        TwoBalls {
            splats,
            labels: (0..54).map(|i| i < 27).collect(),
            views: [posed("front.jpg", Vec3::ZERO), posed("right.jpg", Vec3::new(3.0, 0.0, 0.5))],
            settings: SegmentSettings::default(),
        }
    }

    fn request<'a>(engine: &'a CpuEngine, world: &'a TwoBalls) -> Request<'a> {
        Request {
            rasterizer: engine,
            backend: engine,
            options: ProjectOptions::default(),
            splats: &world.splats,
            views: &world.views,
            prompts: &[],
            prior: None,
            features: None,
            hits: None,
            graph: None,
            affinities: None,
            shown: None,
            frozen: None,
            seen_once: None,
            skies: None,
            transients: None,
            steps: None,
            settings: &world.settings,
        }
    }

    fn silhouette(request: &Request, labels: &[bool], view: usize) -> Mask {
        let PosedView { camera, pose, .. } = &request.views[view];
        let camera = camera.scaled_to(AGREEMENT_SIZE);
        visible_mask(request.rasterizer, request.splats, labels, &request.options, &camera, pose).unwrap()
    }

    fn selection(labels: &[bool], visits: Vec<PhotoVisit>) -> Selection {
        Selection {
            labels: labels.to_vec(),
            score: vec![1.0; labels.len()],
            similarity: None,
            evidence: Evidence::none(labels.len()),
            visits,
            frozen: None,
            parts_removed: 0,
            seen_once: 0,
            agreement: 1.0,
            alone: false,
        }
    }

    fn refused(view: usize, mask: Mask) -> PhotoVisit {
        let verdict = PhotoVerdict::Disagrees;
        PhotoVisit { view, verdict, agreement: 0.0, mask: None, refused: Some(mask), visibility: Vec::new() }
    }

    fn scored(view: usize, mask: &Mask) -> (usize, ScoredMask) {
        (view, ScoredMask { mask: mask.clone(), predicted_iou: 1.0, stability: 1.0 })
    }

    #[test]
    fn a_photo_agrees_by_the_iou_of_its_mask_with_the_silhouette() {
        let (engine, world) = (CpuEngine::new(), two_balls());
        let request = request(&engine, &world);
        let own = silhouette(&request, &world.labels, 0);
        let all = silhouette(&request, &[true; 54], 1);
        let chosen = selection(&world.labels, vec![refused(1, all.clone())]);
        let measured = measure(&request, &chosen, &SpikeCut::default(), &[scored(0, &own)]).unwrap();
        let [front, right] = &measured.photos[..] else { panic!("{measured:?}") };
        assert_eq!((front.photo.as_str(), front.prompted, front.agreement), ("front.jpg", true, 1.0));
        assert_eq!(front.shown, own.count() as f32 / (own.width() * own.height()) as f32);
        let expected = all.iou(&silhouette(&request, &world.labels, 1)) as f32;
        assert!(
            (right.agreement - expected).abs() < 1e-6 && expected < 0.9,
            "{} {expected}",
            right.agreement
        );
        assert!(!right.prompted);
        // Both see the middle of the labelled ball.
        assert_eq!(measured.facing, [front.direction, right.direction]);
        assert!((front.direction - (Vec3::ZERO - LEFT).normalize()).length() < 0.05, "{}", front.direction);
    }

    #[test]
    fn what_transients_cover_counts_neither_for_nor_against() {
        let (engine, world) = (CpuEngine::new(), two_balls());
        let request = request(&engine, &world);
        let own = silhouette(&request, &world.labels, 0);
        let both = silhouette(&request, &[true; 54], 0);
        let reader = move |_: usize| Some(Mask::from_fn(160, 120, |x, _| x >= 80));
        let covered = Request { transients: Some(&reader), ..request };
        let agreement = |request: &Request| {
            let chosen = selection(&world.labels, Vec::new());
            measure(request, &chosen, &SpikeCut::default(), &[scored(0, &both)]).unwrap().photos[0].agreement
        };
        assert!(agreement(&request) < 0.6, "the mask has the other ball too: {}", agreement(&request));
        assert!(agreement(&covered) > 0.95, "{} of {}", agreement(&covered), own.count());
    }

    #[test]
    fn splats_that_the_spike_cut_drops_are_not_part_of_the_silhouette() {
        let (engine, world) = (CpuEngine::new(), two_balls());
        let request = request(&engine, &world);
        let own = silhouette(&request, &world.labels, 0);
        let chosen = selection(&[true; 54], Vec::new());
        let cut = SpikeCut { dropped: (27..54).collect(), ..SpikeCut::default() };
        let measured = measure(&request, &chosen, &cut, &[scored(0, &own)]).unwrap();
        assert_eq!(measured.photos[0].agreement, 1.0);
    }

    #[test]
    fn nothing_selected_and_nothing_shown_measure_nothing() {
        let (engine, world) = (CpuEngine::new(), two_balls());
        let request = request(&engine, &world);
        let empty = Mask::empty(160, 120);
        let none = selection(&[false; 54], vec![refused(0, empty.clone())]);
        assert_eq!(measure(&request, &none, &SpikeCut::default(), &[]).unwrap(), MeasuredPhotos::default());
        // A camera that faces the other way shows nothing of the object and has an empty mask.
        let mut turned = two_balls();
        turned.views[1].pose = Pose::look_at(Vec3::ZERO, Vec3::NEG_Z, Vec3::NEG_Y);
        let request = Request { views: &turned.views, ..request };
        let chosen = selection(&world.labels, vec![refused(1, empty)]);
        let measured = measure(&request, &chosen, &SpikeCut::default(), &[]).unwrap();
        assert!(measured.photos.is_empty() && measured.facing.len() == 1, "{measured:?}");
    }
}
