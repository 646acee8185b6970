//! The feature target of one photo.

use crate::FeatureError;
use crate::error::check_planes;
use segwild_scene::{Camera, Image, MaskSet, Pose};
use std::sync::Arc;

/// One photo's target in the feature losses.
#[derive(Clone, Debug)]
pub struct ViewTarget {
    /// The photo's name, for errors.
    pub name: String,
    /// Its intrinsics at any size; features are rendered at the size the settings give.
    pub camera: Camera,
    /// World to camera.
    pub pose: Pose,
    /// What the features should be, on the embedding's grid: compressed by [`crate::Pca::encode`] for
    /// [`crate::Compression::Pca`], the embedding itself for [`crate::Compression::Learned`].
    pub target: Image,
    /// How far each pixel is to be trusted (VM), one plane of any size, in [0, 1]. Sky and
    /// whatever is to be ignored are 0 here.
    pub validity: Image,
    /// The photo's masks at any size; a photo without masks takes no part in compactness.
    pub masks: MaskSet,
}

impl ViewTarget {
    /// Refuses what cannot be worked with.
    pub(crate) fn check(&self) -> Result<(), FeatureError> {
        let Image { width, height, channels, ref data } = self.target;
        check_planes(&self.name, "feature target", (width, height, channels), data)?;
        let Image { width, height, ref data, .. } = self.validity;
        check_planes(&self.name, "validity map", (width, height, 1), data)?;
        if self.camera.width == 0 || self.camera.height == 0 {
            return Err(FeatureError::Shape(format!("{}: the photo has no pixels", self.name)));
        }
        self.check_masks(&self.masks)
    }

    /// Refuses masks of this photo that do not fit each other.
    pub(crate) fn check_masks(&self, masks: &MaskSet) -> Result<(), FeatureError> {
        let size = (masks.width, masks.height);
        match masks.masks.iter().find(|m| (m.mask.width(), m.mask.height()) != size) {
            None => Ok(()),
            Some(m) => Err(FeatureError::Shape(format!(
                "{}: a mask of {}x{} pixels among masks of {}x{}",
                self.name,
                m.mask.width(),
                m.mask.height(),
                size.0,
                size.1
            ))),
        }
    }

    /// Bytes this target holds.
    pub(crate) fn bytes(&self) -> usize {
        let mask = (self.masks.width as usize * self.masks.height as usize).div_ceil(8);
        4 * (self.target.data.len() + self.validity.data.len()) + mask * self.masks.masks.len()
    }
}

/// Where the targets come from. A thousand photos' targets do not fit in memory, so they are loaded one at
/// a time; a target must not depend on when or how often it is loaded.
pub trait TargetSource: Sync {
    /// Number of photos, in the order in which they are lifted.
    fn len(&self) -> usize;

    /// Whether there is no photo.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Target of one photo.
    fn load(&self, view: usize) -> Result<Arc<ViewTarget>, FeatureError>;

    /// The photo's masks. Loaded only when its compactness is first computed, so that photos can be lifted while
    /// their masks are still being made; the call may wait for them.
    fn masks(&self, _view: usize, target: &ViewTarget) -> Result<MaskSet, FeatureError> {
        Ok(target.masks.clone())
    }
}

impl TargetSource for &[Arc<ViewTarget>] {
    fn len(&self) -> usize {
        <[Arc<ViewTarget>]>::len(self)
    }

    fn load(&self, view: usize) -> Result<Arc<ViewTarget>, FeatureError> {
        Ok(self[view].clone())
    }
}
