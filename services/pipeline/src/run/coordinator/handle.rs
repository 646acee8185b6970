//! Handles the outcomes that the actors send to the coordinator.

use super::start::ATTEMPTS;
use super::{Bars, Coordinator, HISTORY};
use crate::RunError;
use crate::artifacts::folder::{FEATURES, MODEL};
use crate::artifacts::history::{self, Moment};
use crate::output::light;
use crate::run::outcome::ActorOutcome;
use segwild_features::{FeatureField, FeatureOutcome};
use segwild_flow::ledger::ViewOutcome;
use segwild_flow::{ActorFailure, Event, Key, Quarantined, StageProgress};
use segwild_masks::MaskOutcome;
use segwild_scene::Skipped;
use segwild_trainer::{Model, TrainOutcome};
use std::sync::{Arc, PoisonError};
use std::time::Instant;

impl Coordinator<'_> {
    pub(super) fn handle(&mut self, outcome: ActorOutcome, bars: &mut Bars) -> Result<(), RunError> {
        match outcome {
            ActorOutcome::Mask(MaskOutcome::Sky { view, sky, seconds }) => {
                self.view_done(
                    "sky",
                    view,
                    &self.keys.sky[view].clone(),
                    sky.as_ref().err(),
                    seconds,
                    &mut bars.sky,
                )?;
                if sky.is_err() {
                    self.do_without_sky(view)?;
                }
                // From here on the trainer may use the photo: the keys already account for its sky.
                self.skies.set(view, sky.is_ok());
                self.state.sky_open -= 1;
                self.state.training_sky_open -= usize::from(!self.scene.views[view].test);
                self.close("sky", self.state.sky_open, &mut bars.sky)
            }
            ActorOutcome::Mask(MaskOutcome::Masks { view, masks, seconds }) => {
                let key = self.keys.masks[view];
                self.view_done("masks", view, &key, masks.as_ref().err(), seconds, &mut bars.masks)?;
                self.masks_known.set(view, masks.is_ok());
                self.state.masks_open -= 1;
                self.state.mask_speed.add(seconds, bars.geometry.is_some());
                if self.state.masks_open == 0 {
                    self.state.mask_speed.report(&self.options.events);
                }
                self.close("masks", self.state.masks_open, &mut bars.masks)
            }
            ActorOutcome::Feature(FeatureOutcome::Embedded { view, seconds }) => {
                let key = self.keys.embedding[view];
                self.view_done("embed", view, &key, None, seconds, &mut bars.embed)?;
                self.state.embedded[view] = true;
                self.state.embed_open -= 1;
                self.close("embed", self.state.embed_open, &mut bars.embed)
            }
            ActorOutcome::Feature(FeatureOutcome::EmbedFailed { view, given_up }) => {
                let key = self.keys.embedding[view];
                self.view_done("embed", view, &key, Some(&given_up), None, &mut bars.embed)?;
                self.state.embed_open -= 1;
                self.close("embed", self.state.embed_open, &mut bars.embed)
            }
            ActorOutcome::Feature(FeatureOutcome::Field(field)) => {
                self.state.made_field = Some(field);
                Ok(())
            }
            ActorOutcome::Feature(FeatureOutcome::FieldFailed(reason)) => {
                self.state.failed = Some(("features", ActorFailure::fatal(reason)));
                Ok(())
            }
            ActorOutcome::Visibility(failed) => self.handle_visibility(failed),
            ActorOutcome::Train(outcome) => self.handle_trainer(outcome, bars),
        }
    }

    /// Leaves the photos without a known visibility out of the feature field.
    fn handle_visibility(&mut self, failed: Vec<(usize, String)>) -> Result<(), RunError> {
        for (view, error) in &failed {
            let key = self.keys.visibility[*view];
            let label = self.scene.views[*view].name.clone();
            let given_up = Quarantined { label, error: error.clone(), attempts: ATTEMPTS };
            self.view_done("visibility", *view, &key, Some(&given_up), None, &mut None)?;
        }
        self.state.unseen = failed.into_iter().map(|(view, _)| view).collect();
        self.state.visible = true;
        self.weigh_failures("visibility", "features", self.views(false).len());
        Ok(())
    }

    /// Fails a stage that failed on all of its photos, and warns when it failed on more than half of them: the photos
    /// are hardly the cause.
    fn weigh_failures(&mut self, work: &'static str, stage: &'static str, photos: usize) {
        let Some((failed, first)) = self.state.failures.get(work).cloned() else { return };
        if failed == photos {
            self.state.failed.get_or_insert((
                stage,
                ActorFailure::fatal(format!(
                    "not one of {photos} photos could be done ({work}); the first: {first}"
                )),
            ));
        } else if failed * 2 > photos {
            let message =
                format!("{failed} of {photos} photos could not be done ({work}); the first: {first}");
            self.options.events.warn(Some(stage), message);
        }
    }

    /// Changes the keys to those of a run without this view's sky. The trainer has not used the photo before, so that
    /// its work so far is right under either key.
    fn do_without_sky(&mut self, view: usize) -> Result<(), RunError> {
        self.state.without_sky.insert(view);
        let test = |view: &usize| self.scene.views[*view].test;
        let (held_out, training) = self.state.without_sky.iter().copied().partition(test);
        self.keys = self.full_keys.without_skies(&training, &held_out);
        *self.names.lock().unwrap_or_else(PoisonError::into_inner) = self.keys.clone();
        if self.state.geometry_started {
            self.ledger.start_stage("geometry", &self.keys.geometry)?;
            self.name_training()?;
        }
        Ok(())
    }

    pub(super) fn handle_trainer(&mut self, outcome: TrainOutcome, bars: &mut Bars) -> Result<(), RunError> {
        match outcome {
            TrainOutcome::Began { step, upcoming } => {
                self.skies.prefer(&upcoming);
                if step > 0 {
                    self.options.events.info(Some("geometry"), format!("goes on from step {step}"));
                }
                if let Some(bar) = &mut bars.geometry {
                    bar.cached(u64::from(step).saturating_sub(bar.done()));
                }
                if self.state.only_to_snapshot { Ok(()) } else { history::trim(self.folder, step) }
            }
            TrainOutcome::Progress { step, loss, psnr, splats, left_out } => {
                let moment = Moment { step, loss, psnr, splats, left_out };
                if !self.state.only_to_snapshot {
                    history::append(self.folder, &moment)?;
                }
                if let Some(bar) = &mut bars.geometry {
                    bar.advance(u64::from(step).saturating_sub(bar.done()));
                }
                let at = Some(u64::from(step));
                for (name, value) in [("loss", loss), ("psnr_db", psnr), ("left_out", left_out)] {
                    self.options.events.metric("geometry", name, f64::from(value), at);
                }
                self.options.events.metric("geometry", "splats", splats as f64, at);
                self.options.events.metric("geometry", "stall_s", self.skies.waited_s(), None);
                Ok(())
            }
            TrainOutcome::Snapshot(snapshot) => {
                self.intact()?;
                self.cache.put_typed(&self.keys.snapshot, MODEL, &*snapshot)?;
                // A training that was restarted passes its snapshot step again.
                self.state.snapshot = Some(snapshot).filter(|_| !self.state.masks_started);
                Ok(())
            }
            TrainOutcome::Checkpoint(checkpoint) => {
                self.intact()?;
                let began = Instant::now();
                self.keeper().save(&checkpoint)?;
                let seconds = began.elapsed().as_secs_f64();
                self.options.events.metric("geometry", "checkpoint_s", seconds, None);
                Ok(())
            }
            TrainOutcome::Paused(_) | TrainOutcome::Done(..) if self.state.only_to_snapshot => {
                self.state.only_to_snapshot = false;
                self.ledger.finish_stage("geometry", &self.keys.geometry, None)?;
                if let Some(bar) = bars.geometry.take() {
                    bar.finish();
                }
                Ok(())
            }
            TrainOutcome::Paused(step) => {
                self.state.paused = Some(step);
                Ok(())
            }
            TrainOutcome::Done(model, skipped) => {
                self.intact()?;
                self.cache.put_typed(&self.keys.history, HISTORY, &history::read(self.folder))?;
                self.cache.put_typed(&self.keys.geometry, MODEL, &*model)?;
                self.ledger.finish_stage("geometry", &self.keys.geometry, None)?;
                if let Some(bar) = bars.geometry.take() {
                    bar.finish();
                }
                self.state.mask_speed.training_ended();
                for s in skipped {
                    if !self.state.skipped.iter().any(|known| known.name == s.name) {
                        self.options
                            .events
                            .warn(Some("geometry"), format!("photo {} is left out: {}", s.name, s.reason));
                        self.state.skipped.push(s);
                    }
                }
                self.take_model(model)
            }
            TrainOutcome::Failed(reason) => {
                self.state.failed = Some(("geometry", ActorFailure::fatal(reason)));
                Ok(())
            }
        }
    }

    /// Records the work on one view: in the ledger, the progress bar and the counts.
    fn view_done(
        &mut self,
        stage: &'static str,
        view: usize,
        key: &Key,
        error: Option<&Quarantined>,
        seconds: Option<f64>,
        bar: &mut Option<StageProgress>,
    ) -> Result<(), RunError> {
        let name = self.scene.views[view].name.clone();
        if let Some(error) = error {
            self.scene.views[view].intact()?;
            if self.cache.was_damaged(key) {
                // It was made once: without it the result would differ from that of the run before.
                let reason = format!(
                    "photo {name}: what was made of it was damaged in the cache and cannot be made again ({}); \
                     run again",
                    error.error
                );
                self.state.failed.get_or_insert((stage, ActorFailure::fatal(reason)));
            }
            let failures =
                self.state.failures.entry(stage).or_insert_with(|| (0, format!("{name}: {}", error.error)));
            failures.0 += 1;
        }
        let outcome = match (error, seconds) {
            (Some(error), _) => ViewOutcome::failed(error.attempts, error.error.clone()),
            (None, Some(seconds)) => ViewOutcome::done(seconds),
            (None, None) => ViewOutcome::cached(),
        };
        self.ledger.record_view(stage, &name, key, &outcome)?;
        match (error, seconds) {
            (Some(error), _) => {
                if let Some(bar) = bar {
                    bar.failed(1);
                }
                self.options.events.tell(Event::ViewFailed {
                    stage: stage.into(),
                    view: name.clone(),
                    error: error.error.clone(),
                    attempts: error.attempts,
                });
                if !self.state.skipped.iter().any(|s| s.name == name) {
                    self.state.skipped.push(Skipped { name, reason: format!("{stage}: {}", error.error) });
                }
            }
            (None, Some(_)) => {
                if let Some(bar) = bar {
                    bar.advance(1);
                }
                self.state.made += 1;
            }
            (None, None) => {
                if let Some(bar) = bar {
                    bar.cached(1);
                }
                self.state.cached += 1;
            }
        }
        Ok(())
    }

    fn close(
        &mut self,
        stage: &'static str,
        open: usize,
        bar: &mut Option<StageProgress>,
    ) -> Result<(), RunError> {
        if open == 0
            && let Some(bar) = bar.take()
        {
            bar.finish();
            self.weigh_failures(stage, stage, self.views(stage == "sky").len());
            self.ledger.finish_stage(stage, &self.keys.stage(stage), None)?;
        }
        Ok(())
    }

    pub(super) fn take_model(&mut self, model: Arc<Model>) -> Result<(), RunError> {
        self.folder.write_record("model.bin", MODEL, &*model)?;
        let splats = light::shown(&self.scene, &model, "")?;
        light::export(&self.scene, &model).write(&self.folder.path().join("scene.ply"), &splats)?;
        self.state.model = Some(model);
        Ok(())
    }

    pub(super) fn take_field(&mut self, field: FeatureField) -> Result<(), RunError> {
        self.folder.write_record("features.bin", FEATURES, &field)?;
        self.state.field = Some(Arc::new(field));
        Ok(())
    }
}
