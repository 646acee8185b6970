//! A trained scene, and its renders.

use crate::TrainError;
use crate::appearances;
use crate::params::{select, splats_fit};
use crate::refined_pose::{RefinedBy, RefinedPose, with_poses};
use crate::state::appearance_fits;
use segwild_objective::background::{BASES, Background, add_background};
use segwild_objective::{AnyAppearance, VisibleSplats};
use segwild_raster::{Channels, Frame, ProjectOptions, Rasterizer};
use segwild_scene::{Camera, Image, Pose, Scene, Splats};
use std::borrow::Cow;
use std::sync::Arc;
use wincode::{SchemaRead, SchemaWrite};

/// A trained scene: splats, and the appearance and background of each photo.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Model {
    /// The splats, in the scene's normalised frame. They are shared: a copy of the model copies none.
    pub splats: Arc<Splats>,
    /// Per-splat appearance embeddings, `[splat][embedding_size]`; empty for appearance models without them.
    pub splat_embeddings: Vec<f32>,
    /// The appearances of the photos, by index of the view; one more, at the index past the last view, is the mean.
    pub appearance: AnyAppearance,
    /// Per view of the scene, the background of its photo, in the photo's colours; `None` where the
    /// photo took no part.
    pub backgrounds: Vec<Option<Background>>,
    /// Name of every view of the scene.
    pub names: Vec<String>,
    /// Indices of the views trained on.
    pub trained_on: Vec<u32>,
    /// Per view of the scene, the largest share of its photo that the training might leave out as transient; 0 where it
    /// shows none.
    pub transient_shares: Vec<f32>,
    /// Per view of the scene, the share of its photo that contradicts trainings made without it, in more than what is
    /// undertrained; `None` where that was not searched for.
    pub transient_evidence: Vec<Option<f32>>,
    /// Per view of the scene, its refined pose; `None` where the given one stays.
    pub refined_poses: Vec<Option<RefinedPose>>,
    /// Whether opacities are compensated for the pixel filter; splats must be rendered as they were trained.
    pub antialias: bool,
    /// Progress of the training.
    pub stats: Stats,
}

/// Progress of the training when the model was taken.
#[derive(Clone, Copy, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Stats {
    /// Steps done.
    pub step: u32,
    /// Mean over the training photos of the PSNR of their counted pixels, in dB, if known.
    pub psnr: Option<f32>,
}

/// Options of the rasteriser for splats trained with or without compensation.
pub(crate) fn options(antialias: bool) -> ProjectOptions {
    ProjectOptions { antialias, ..ProjectOptions::default() }
}

impl Model {
    /// Refuses a model whose parts do not fit each other: one that comes out of a file may be damaged.
    ///
    /// # Errors
    /// Says what does not fit.
    pub fn check(&self) -> Result<(), TrainError> {
        let damaged = |what: &str| Err(TrainError::Checkpoint(format!("the model is damaged: {what}")));
        if let Err(error) = splats_fit(&self.splats) {
            return damaged(&error.to_string());
        }
        let views = self.names.len();
        if !self.refined_poses.iter().flatten().all(RefinedPose::is_sound) {
            return damaged("a refined pose is no rotation with a finite translation");
        }
        let sound = |b: &Background| (1..=BASES).contains(&b.coefficients.len());
        if self.backgrounds.len() != views
            || self.transient_shares.len() != views
            || self.transient_evidence.len() != views
            || self.refined_poses.len() != views
            || self.trained_on.iter().any(|&v| v as usize >= views)
        {
            return damaged("its lists of photos differ in length");
        }
        if !self.backgrounds.iter().flatten().all(sound) {
            return damaged("a background has another number of coefficients");
        }
        if !appearance_fits(&self.appearance, views)
            || self.splat_embeddings.len()
                != self.appearance.as_appearance().embedding_size() * self.splats.len()
        {
            return damaged("its appearance does not fit its splats");
        }
        Ok(())
    }

    /// The scene as it was trained: with its refined poses.
    pub fn posed(&self, scene: &Arc<Scene>) -> Arc<Scene> {
        match with_poses(scene, &self.refined_poses) {
            Cow::Borrowed(_) => scene.clone(),
            Cow::Owned(posed) => Arc::new(posed),
        }
    }

    /// Whether a photo was aligned to the splats. Then a held-out photo's pose is fitted as its appearance is.
    pub fn is_aligned(&self) -> bool {
        self.refined_poses.iter().flatten().any(|refined| refined.by == RefinedBy::Photo)
    }

    /// The splats at `keep`, in that order, with all that belongs to them.
    pub fn select(&mut self, keep: &[usize]) {
        self.splat_embeddings = select(&self.splat_embeddings, self.splats.len(), keep);
        self.splats = Arc::new(self.splats.select(keep));
    }

    /// Options to project these splats with.
    pub fn options(&self) -> ProjectOptions {
        options(self.antialias)
    }

    /// Index in [`Model::appearance`] of the appearance of a view: the mean one where the photo took no part or none is
    /// named.
    pub fn appearance_index(&self, view: Option<usize>) -> usize {
        let known = |v: &usize| self.backgrounds.get(*v).is_some_and(Option::is_some);
        view.filter(known).unwrap_or(self.names.len())
    }

    /// The background of a view's photo; the mean of all where the photo took no part or none is
    /// named.
    pub fn background(&self, view: Option<usize>) -> Background {
        let own = view.and_then(|v| self.backgrounds.get(v)?.clone());
        own.unwrap_or_else(|| Background::mean(self.backgrounds.iter().flatten()))
    }
}

/// Blends the splats' colours for a camera, in the appearance at `index`.
pub(crate) fn render_frame(
    engine: &dyn Rasterizer,
    model: &Model,
    index: usize,
    camera: &Camera,
    pose: &Pose,
) -> Result<Frame, TrainError> {
    let projected = engine.project(&model.splats, camera, pose, &model.options())?;
    let sight = VisibleSplats {
        means: &model.splats.means,
        splat_embeddings: &model.splat_embeddings,
        radii: projected.radii(),
        eye: pose.centre().to_array(),
    };
    let light = model.appearance.appearance_maps(index, None);
    let colours = model.appearance.colour(index, light.as_ref(), &sight, projected.shade());
    Ok(projected.blend(&Channels { count: 3, values: &colours })?)
}

/// The scene from a camera, in the appearance of one of its photos (`None`: the mean appearance, one light for all), over
/// that photo's background; sRGB in [0, 1].
pub fn render_view(
    model: &Model,
    engine: &dyn Rasterizer,
    camera: &Camera,
    pose: &Pose,
    appearance: Option<usize>,
) -> Result<Image, TrainError> {
    let index = model.appearance_index(appearance);
    let frame = render_frame(engine, model, index, camera, pose)?;
    Ok(compose(&frame, &model.appearance, index, &model.background(appearance), camera, pose))
}

/// A frame over a background, in an appearance, in [0, 1]. The background is in the photo's colours.
pub(crate) fn compose(
    frame: &Frame,
    appearance: &AnyAppearance,
    index: usize,
    background: &Background,
    camera: &Camera,
    pose: &Pose,
) -> Image {
    let background_image =
        appearances::background_before(background, &appearances::matrix(appearance, index))
            .paint(camera, pose);
    let mut image = frame.image.clone();
    add_background(&mut image, &frame.alpha, &background_image);
    let mut image = appearance.as_appearance().apply(index, &image);
    for v in &mut image.data {
        *v = v.clamp(0.0, 1.0);
    }
    image
}
