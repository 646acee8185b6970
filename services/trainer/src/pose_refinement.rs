//! Refinement of poses that the points leave open, where photos are of one light (method, section 3): between steps of the
//! training each such photo is aligned to the splats, which show what the photos agree on.

use crate::alignment::{RenderedDepth, align, depth_sum};
use crate::model::options;
use crate::poses_by_points::GOOD;
use crate::refined_pose::{RefinedBy, RefinedPose};
use crate::trainer::Trainer;
use crate::{AppearanceModel, TrainError};
use segwild_scene::{Camera, Pose, first_named};

/// A photo is not aligned farther than this from its given pose, as a share of its long side: what it shows would be elsewhere in
/// the scene.
const FARTHEST: f32 = 0.05;
/// Nor is it moved by less than this, in pixels at the size trained at: photos with good poses move by up to .35 px
/// (docs/experiments/2026-11-30-poses-that-are-off.md).
const MIN_MOTION: f32 = 0.75;

impl Trainer {
    /// Whether photos may be aligned to the splats.
    ///
    /// On photos of many lights it is no help: poses of `liberty` that are right to .3 px moved by 1 px in the median, and
    /// by up to 20 (docs/experiments/2026-11-30-poses-that-are-off.md).
    pub(crate) fn aligns(&self) -> bool {
        self.settings.refine_poses && self.settings.appearance_model == AppearanceModel::None
    }

    /// Aligns the photos whose poses are open to the splats, where this step is for that.
    pub(crate) fn refine_poses(&mut self) -> Result<(), TrainError> {
        let open: Vec<usize> =
            self.state.sampler.views().into_iter().filter(|&view| self.state.open_poses[view]).collect();
        if open.is_empty() || !self.aligns() || !self.schedule.pose_refinement(self.state.step) {
            return Ok(());
        }
        self.download()?;
        let engine = self.engine.clone();
        let resident = engine.upload_splats(&self.state.params.splats)?;
        let engine = resident.as_deref().unwrap_or(&*engine);
        let finest = self.schedule.level(self.state.step).max(1);
        let mut aligned = Vec::new();
        for view in open {
            if self.state.backgrounds[view].is_none() {
                continue;
            }
            let Some(stored) = self.photos.usable(view)? else { continue };
            let (painter, params) = (self.state.painter(view), &self.state.params);
            let antialias = self.settings.antialias;
            let mut show = |camera: &Camera, pose: &Pose| {
                let projected = engine.project(&params.splats, camera, pose, &options(antialias))?;
                let rendered = painter.render(params, &*projected, pose, None)?;
                let shown = painter.show(&rendered.frame, camera, pose);
                let depth = depth_sum(&*projected, &params.splats.means, pose)?;
                Ok(RenderedDepth { shown, alpha: rendered.frame.alpha, depth })
            };
            let mut pose = self.views[view].pose;
            for level in (finest..=2).rev() {
                let (level, photo) = stored.level(level);
                let camera = stored.camera(&self.views[view].camera, level);
                pose = align(pose, &camera, photo, &|_| true, &mut show)?;
            }
            let camera = stored.camera(&self.views[view].camera, finest);
            let long = |camera: &Camera| camera.width.max(camera.height) as f32;
            let motion = show(&camera, &pose)?.motion(&camera, &pose, &self.given[view]) / long(&camera);
            let full = stored.camera(&self.views[view].camera, 0);
            aligned.push((view, pose, motion, 1.0 / long(&full)));
        }
        drop(resident);
        for (view, pose, motion, pixel) in aligned {
            let refined = (GOOD.max(MIN_MOTION * pixel)..FARTHEST).contains(&motion);
            self.views[view].pose = if refined { pose } else { self.given[view] };
            self.state.refined[view] = refined.then(|| RefinedPose::new(&pose, motion, RefinedBy::Photo));
        }
        Ok(())
    }

    /// What the points say of the poses, in sentences, for the start of a training.
    pub fn poses_by_points_in_words(&self) -> Vec<String> {
        let mut words =
            Vec::from_iter(self.refined_in_words(RefinedBy::Points, "by the points that they saw"));
        if !self.aligns() {
            words.extend(self.open_in_words("of photos of many lights they stay as given"));
        }
        words
    }

    /// What became of the poses that the points left open, in sentences, for the end of a training.
    pub fn aligned_poses_in_words(&self) -> Vec<String> {
        let mut words =
            Vec::from_iter(self.refined_in_words(RefinedBy::Photo, "by aligning them to the scene"));
        if self.aligns() {
            words.extend(self.open_in_words(
                "aligned to the scene, they moved too little to count, or too far to be right",
            ));
        }
        words
    }

    fn refined_in_words(&self, by: RefinedBy, how: &str) -> Option<String> {
        let of = |(view, refined): (usize, &Option<RefinedPose>)| {
            let refined = refined.filter(|refined| refined.by == by)?;
            Some((view, format!("{:.1} %", 100.0 * refined.motion)))
        };
        let photos: Vec<_> = self.state.refined.iter().enumerate().filter_map(of).collect();
        (!photos.is_empty()).then(|| {
            let (count, some) = (photos.len(), self.some(&photos));
            format!("the poses of {count} photos were off and are refined {how}, in shares of the long side: {some}")
        })
    }

    /// `None` also where no photo saw any point: then none was expected to confirm a pose.
    fn open_in_words(&self, then: &str) -> Option<String> {
        let open = |&view: &usize| self.state.open_poses[view] && self.state.refined[view].is_none();
        let with_points = self.views.iter().any(|view| view.sighted() > 0);
        let photos = (0..self.views.len()).filter(|view| with_points && open(view));
        let photos: Vec<_> =
            photos.map(|view| (view, format!("with {} points", self.views[view].sighted()))).collect();
        (!photos.is_empty()).then(|| {
            let (count, some) = (photos.len(), self.some(&photos));
            format!("the points that {count} photos saw leave their poses open ({some}): {then}")
        })
    }

    fn some(&self, photos: &[(usize, String)]) -> String {
        let name = |(view, words): &(usize, String)| format!("{} {words}", self.views[*view].name);
        first_named(&photos.iter().map(name).collect::<Vec<_>>())
    }
}
