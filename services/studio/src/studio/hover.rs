//! What a click would select, without the click.

use super::show::label_map;
use super::state::{Studio, StudioError};
use super::turns::IN_TIME;
use crate::fronts::FrontMap;
use crate::messages::{ANSWER_LABEL, HoverRequest, LabelMap, ViewMessage};
use segwild_flow::lock;
use segwild_scene::{Mask, PointPrompt, Prompts};
use segwild_segmenter::scene_tree::{NONE, SceneTree};
use std::sync::atomic::Ordering;
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

/// A turn of the provider, ended when it is dropped.
struct ProviderTurn {
    studio: Arc<Studio>,
    /// How long its candidate took, if there was one.
    took: Option<Duration>,
}

impl Drop for ProviderTurn {
    fn drop(&mut self) {
        lock(&self.studio.turns).end(self.took, Instant::now());
    }
}

/// The one photo at a time that a provider analyses ahead of a click. It ends when it is dropped.
struct Preparation(Arc<Studio>);

impl Preparation {
    fn start(studio: &Arc<Studio>) -> Option<Preparation> {
        let is_free = !studio.preparing.swap(true, Ordering::AcqRel);
        is_free.then(|| Preparation(studio.clone()))
    }

    fn of(&self, photo: usize) {
        let Preparation(studio) = self;
        // A photo that cannot be read is not tried again before another one was.
        if !matches!(studio.session.is_prepared(photo), Ok(true)) {
            studio.session.prepare(photo);
        }
        studio.prepared.store(photo, Ordering::Relaxed);
    }
}

impl Drop for Preparation {
    fn drop(&mut self) {
        self.0.preparing.store(false, Ordering::Release);
    }
}

impl Studio {
    /// The candidate at a position of a photo, without a click; `None` where there is none. It is the mask of a provider that finds
    /// objects, as that of a click would be, where the provider has it in time; otherwise the group of the scene tree. In a view of the
    /// scene it is always the group.
    ///
    /// # Errors
    /// When the photo cannot be read, the camera of the view is none, or the scene cannot be rendered.
    pub fn hover(self: &Arc<Self>, request: &HoverRequest) -> Result<Option<LabelMap>, StudioError> {
        let HoverRequest { photo, x, y, granularity, ref view } = *request;
        if let Some(view) = view {
            return self.hover_view(view, [x, y], granularity);
        }
        self.check_photo(photo)?;
        let camera = &self.session.scene().views[photo].camera;
        let share = [x / camera.width as f32, y / camera.height as f32];
        if !share.iter().all(|v| (0.0..1.0).contains(v))
            || granularity.is_some_and(|g| !(0.0..=1.0).contains(&g))
        {
            return Ok(None);
        }
        let small = self.session.working_camera(photo);
        let (x, y) = (share[0] * small.width as f32, share[1] * small.height as f32);
        let point = PointPrompt { x, y, inside: true };
        let prompts = Prompts { points: vec![point], boxes: Vec::new(), granularity };
        let Some(tree) = self.session.tree() else {
            return Ok(Some(label_map(&self.session.candidate_mask(photo, &prompts)?, 0)));
        };
        if let Some(mask) = self.mask_in_time(photo, prompts) {
            return Ok(Some(label_map(&mask, 0)));
        }
        self.prepare(photo);
        let front = self.fronts.of(&self.session, photo)?;
        Ok(self.group_at(tree, &front, share, granularity))
    }

    /// The candidate at a pixel of a view of the scene; `None` where there is none.
    fn hover_view(
        &self,
        view: &ViewMessage,
        at: [f32; 2],
        granularity: Option<f32>,
    ) -> Result<Option<LabelMap>, StudioError> {
        let (camera, pose) = view.view().map_err(StudioError::Request)?;
        let Some(tree) = self.session.tree() else { return Ok(None) };
        if !camera.contains(at.into()) || granularity.is_some_and(|g| !(0.0..=1.0).contains(&g)) {
            return Ok(None);
        }
        let front = self.fronts.of_view(&self.session, &camera, &pose)?;
        let share = [at[0] / camera.width as f32, at[1] / camera.height as f32];
        Ok(self.group_at(tree, &front, share, granularity))
    }

    /// The group of the scene tree at a position, in shares of width and height.
    fn group_at(
        &self,
        tree: &SceneTree,
        front: &FrontMap,
        share: [f32; 2],
        granularity: Option<f32>,
    ) -> Option<LabelMap> {
        let leaf = tree.leaf[front.at(share[0], share[1])? as usize];
        if leaf == NONE {
            return None;
        }
        let boundaries = self.settings.tree_boundaries;
        let found = match granularity {
            Some(granularity) => tree.candidates_of_size(leaf, granularity, boundaries),
            None => tree.candidates(leaf, boundaries),
        };
        let labels = tree.labels(found.first()?);
        let runs = front.runs(|splat| if labels[splat as usize] { ANSWER_LABEL } else { 0 });
        Some(LabelMap { width: front.width, height: front.height, runs, revision: 0 })
    }

    /// Lets a provider that finds no objects by itself analyse the photo under the pointer: a click in it needs that.
    /// The answer is the same without. While one is analysed, no other one is: a pointer that goes over many photos starts no
    /// thread for each.
    fn prepare(self: &Arc<Self>, photo: usize) {
        if self.session.finds_objects() || self.prepared.load(Ordering::Relaxed) == photo {
            return;
        }
        let Some(preparation) = Preparation::start(self) else { return };
        // Without a thread the click does it.
        let work = move || preparation.of(photo);
        let _ = std::thread::Builder::new().name("studio prepare".into()).spawn(work);
    }

    /// The mask of a provider that finds objects, if it is there in time. A photo that the provider has not encoded yet is encoded for
    /// the next ones. A provider that keeps nothing of it, such as a vision service, is not tried again.
    fn mask_in_time(self: &Arc<Self>, photo: usize, prompts: Prompts) -> Option<Mask> {
        let began = Instant::now();
        if !self.session.finds_objects() || !lock(&self.turns).take(began) {
            return None;
        }
        let mut turn = ProviderTurn { studio: self.clone(), took: None };
        let (send, answer) = mpsc::sync_channel(1);
        let work = move || {
            let found = turn.studio.session.prepared_mask(photo, &prompts);
            let encoded = !matches!(found, Ok(None));
            // One that fails is as good as late: a click reports why.
            turn.took = encoded.then(|| if found.is_ok() { began.elapsed() } else { Duration::MAX });
            // Who waited may have gone on without it.
            let _ = send.send(found.ok().flatten());
            if !encoded {
                let session = &turn.studio.session;
                session.prepare(photo);
                // Each motion would only start a thread. A photo that cannot be read says nothing about the provider.
                if matches!(session.is_prepared(photo), Ok(false)) {
                    lock(&turn.studio.turns).retire();
                }
            }
        };
        // Without a thread the turn ends here.
        std::thread::Builder::new().name("studio hover".into()).spawn(work).ok()?;
        answer.recv_timeout(IN_TIME).ok().flatten()
    }
}
