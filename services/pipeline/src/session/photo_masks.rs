//! Masks of an object on a session's photos.

use super::resident::Session;
use crate::RunError;
use crate::artifacts::selected::Selected;
use crate::output::object_masks::ObjectMasks;
use crate::settings::AT_ONCE;
use rayon::prelude::*;
use segwild_flow::Stopper;
use segwild_scene::{Image, Mask, Splats};
use segwild_segmenter::MaskMode;
use std::ops::Range;

/// An object's splats alone and among those of the scene, after the spike cut.
pub struct MaskedObject {
    scene: Splats,
    labels: Vec<bool>,
    alone: Splats,
    whole: Vec<bool>,
}

impl MaskedObject {
    /// About how many bytes it takes in memory.
    pub fn bytes(&self) -> usize {
        let numbers = |splats: &Splats| 11 * splats.len() + splats.sh.len();
        4 * (numbers(&self.scene) + numbers(&self.alone)) + self.labels.len() + self.whole.len()
    }
}

/// Renders the masks of an object. An engine may be one device: photos are rendered one after the other.
pub(crate) struct PhotoMasks<'a> {
    session: &'a Session,
    in_sight: ObjectMasks<'a>,
    alone: ObjectMasks<'a>,
}

impl<'a> PhotoMasks<'a> {
    pub fn new(session: &'a Session, object: &'a MaskedObject) -> Result<PhotoMasks<'a>, RunError> {
        let options = session.model.options();
        let MaskedObject { scene, labels, alone, whole } = object;
        Ok(PhotoMasks {
            session,
            in_sight: ObjectMasks::new(&*session.engine, scene, labels, options, MaskMode::Visible)?,
            alone: ObjectMasks::new(&*session.engine, alone, whole, options, MaskMode::Amodal)?,
        })
    }

    /// Hands on the masks of some photos, as taken: the pixels in sight, and those that the object would cover if nothing occluded
    /// it. Several are worked on at once, since photos are large.
    pub fn each<T: Send>(
        &self,
        photos: &[usize],
        with: impl Fn(usize, [Mask; 2]) -> Result<T, RunError> + Sync,
    ) -> Result<Vec<T>, RunError> {
        let views = &self.session.scene.views;
        let draw = |photo: &usize| -> Result<[Image; 2], RunError> {
            let view = &views[*photo];
            let of = |masks: &ObjectMasks| masks.share(&view.camera, &view.pose, self.session.size());
            let alone = of(&self.alone)?;
            // What the photo would not show of the object alone, it does not show among the rest: of many photos, few show it.
            let in_sight = if alone.data.iter().all(|&share| share == 0.0) {
                Image::zeros(alone.width, alone.height, 1)
            } else {
                of(&self.in_sight)?
            };
            Ok([in_sight, alone])
        };
        let shares = photos.iter().map(draw).collect::<Result<Vec<_>, _>>()?;
        let hand_on = |(&photo, [visible, amodal]): (&usize, &[Image; 2])| {
            let view = &views[photo];
            let visible = view.mask_to_taken(self.in_sight.mask(visible, &view.camera));
            with(photo, [visible, view.mask_to_taken(self.alone.mask(amodal, &view.camera))])
        };
        photos.par_iter().zip(&shares).map(hand_on).collect()
    }

    /// How many photos are worked on at once.
    pub fn at_once() -> usize {
        rayon::current_num_threads().min(AT_ONCE)
    }
}

impl Session {
    /// An object to be rendered by [`Session::mask_files`], from copies of the scene's splats without their colours: masks have none.
    pub fn masked_object(&self, selected: &Selected) -> MaskedObject {
        let of_scene = &*self.model.splats;
        let scene = selected.cut_scene(&Splats {
            means: of_scene.means.clone(),
            log_scales: of_scene.log_scales.clone(),
            rotations: of_scene.rotations.clone(),
            opacities: of_scene.opacities.clone(),
            sh: vec![0.0; 3 * of_scene.len()],
            sh_degree: 0,
        });
        let keep = selected.splats();
        let alone = scene.select(&keep);
        MaskedObject { scene, labels: selected.labels.clone(), alone, whole: vec![true; keep.len()] }
    }

    /// The masks of an object on some photos, as PNGs of the size of the photo as taken, white inside: the pixels in sight, and
    /// those that the object would cover if nothing occluded it.
    ///
    /// # Errors
    /// When the scene cannot be rendered, or `stopper` stops it.
    pub fn mask_files(
        &self,
        object: &MaskedObject,
        photos: Range<usize>,
        stopper: &Stopper,
    ) -> Result<Vec<[Vec<u8>; 2]>, RunError> {
        let masks = PhotoMasks::new(self, object)?;
        let photos: Vec<usize> = photos.collect();
        let mut files = Vec::with_capacity(photos.len());
        for some in photos.chunks(PhotoMasks::at_once()) {
            RunError::unless_running(stopper)?;
            files.extend(masks.each(some, |_, [visible, amodal]| Ok([visible.png()?, amodal.png()?]))?);
        }
        Ok(files)
    }

    /// The names under which images of the photos are written: sub-folders of photos are sub-folders, and no two photos share one.
    pub fn image_names(&self) -> &[String] {
        self.files.names()
    }
}
