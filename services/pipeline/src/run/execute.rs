//! Executes a planned run: the stages that actors compute, then those that the thread of the run computes.

use super::after::AfterActors;
use super::context::{RunContext, RunSetup, RunSignals};
use super::coordinator::Coordinator;
use super::diagnostics;
use super::graph::{node_of, stage_of_failure};
use super::node::StageWork;
use super::options::RunOptions;
use super::plan::RunPlan;
use super::prepare::PreparedRun;
use super::skies::Skies;
use super::stage::Stage;
use super::stages::NODES;
use super::wiring::Wiring;
use crate::artifacts::folder::Intake;
use crate::artifacts::recompute::Recompute;
use crate::artifacts::traces::Traces;
use crate::output::evaluate::HeldOut;
use crate::transients::TrainFit;
use crate::{RunError, RunFolder};
use segwild_flow::{ActorFailure, Event, Key, Report};
use segwild_masks::{MaskMaker, sasm};
use segwild_scene::PhotoStore;
use std::sync::Arc;

/// What is left of a run whose own data is freed.
pub struct ExecutedRun<'a> {
    /// What the actors and the stages did when.
    pub report: Report,
    pub traces: Traces<'a>,
    pub intake: Intake,
    pub scores: Option<HeldOut>,
    /// Splats of the trained scene, if it is there.
    pub splats: Option<usize>,
    /// The step that the training stands at, when it was to stop before its end.
    pub paused: Option<u32>,
    /// Per-photo artefacts that were made, and that were in the cache.
    pub counts: [usize; 2],
    /// Key of the report.
    pub report_key: Key,
}

/// Executes a run up to what is computed from its folder alone.
///
/// # Errors
/// When a stage fails, the disk fails, or the run is stopped.
pub fn execute<'a>(
    prepared: &PreparedRun,
    plan: &RunPlan,
    folder: &'a RunFolder,
    options: &RunOptions,
    wiring: &dyn Wiring,
) -> Result<ExecutedRun<'a>, RunError> {
    let events = &options.events;
    // A stop while actors are still being started is a stop like any other.
    let stopped = |error| match error {
        RunError::Spawn(spawn) if spawn.is_stopping() => RunError::Interrupted,
        other => other,
    };
    let memory = plan.settings.run.photo_memory as usize * (1 << 20);
    let photos = Arc::new(prepared.photos.store(memory));
    let setup = setup(prepared, plan, folder, options, &photos);
    if let Some(words) = left_out_in_words(prepared, plan) {
        events.info(Some(Stage::Masks.name()), words);
    }
    let signals = RunSignals::new(skies(&setup, &photos, prepared, plan));
    let mut coordinator = Coordinator::new(RunContext::new(&setup, photos, &plan.keys, signals))?;
    let traces = Traces::start(folder, &prepared.pose_spans)?;
    let (mut report, outcome) =
        coordinator.flow(&prepared.providers, &prepared.recorder, wiring).map_err(stopped)?;
    let mut run = coordinator.run;
    traces.add_poses(&mut report, &prepared.pose_spans);
    traces.write(&report)?;
    end_of_actors(&run, &report, outcome.map_err(stopped))?;
    let mut intake = prepared.intake.clone();
    intake.skipped.extend(run.take_skipped());
    intake.undescribed = plan.keys.left_out();
    folder.write_intake(&intake)?;

    let holds_out = !intake.held_out.is_empty();
    let mut after = AfterActors { run, report, traces, holds_out, scores: None };
    for node in NODES {
        if let StageWork::Run(compute) = node.work
            && after.run.wants(node.stage)
        {
            compute(&mut after)?;
        }
    }
    let AfterActors { run, report, traces, scores, .. } = after;
    let model = run.made.model.as_ref();
    if let Some(words) = model.and_then(|m| m.stats.psnr).and_then(diagnostics::unlike) {
        events.warn(Some(Stage::Geometry.name()), words);
    }
    let learnt = TrainFit::of(folder).map(|fit| fit.psnr).zip(scores.as_ref().map(|s| s.psnr));
    if let Some(words) = learnt.and_then(|(train, held)| diagnostics::overfitted(train, held)) {
        events.warn(Some(Stage::Evaluate.name()), words);
    }
    Ok(ExecutedRun {
        report,
        traces,
        intake,
        scores,
        splats: model.map(|model| model.splats.len()),
        paused: run.made.paused,
        counts: run.counts(),
        report_key: node_of(Stage::Report).key(run.keys()),
    })
}

/// Of how many photos masks and descriptors are made and why not of the others, in words; `None` where of all.
fn left_out_in_words(prepared: &PreparedRun, plan: &RunPlan) -> Option<String> {
    let (views, left_out) = (&prepared.scene.views, plan.keys.left_out());
    let trained = |view: &usize| !views[*view].test && plan.keys.unreadable(*view).is_none();
    let photos = (0..views.len()).filter(trained).count();
    (left_out > 0 && plan.last >= Stage::Embed).then(|| {
        format!(
            "masks and descriptors are made of {} of {photos} photos: the other {left_out} show from the same directions what these \
             do (--described-photos all makes them of all)",
            photos - left_out
        )
    })
}

/// What the stages of a run work with.
fn setup<'a>(
    prepared: &'a PreparedRun,
    plan: &'a RunPlan,
    folder: &'a RunFolder,
    options: &'a RunOptions,
    photos: &Arc<PhotoStore>,
) -> RunSetup<'a> {
    let PreparedRun { scene, providers, .. } = prepared;
    let RunPlan { settings, cache, .. } = plan;
    let maker = MaskMaker {
        photos: photos.clone(),
        proposer: providers.proposer.clone(),
        settings: settings.masks.clone(),
        depths: sasm::SceneDepths::of(scene),
    };
    RunSetup {
        folder,
        settings,
        options,
        ledger: &prepared.ledger,
        cache: cache.clone(),
        given: scene.clone(),
        engine: prepared.engine.clone(),
        elsewhere: plan.elsewhere.clone(),
        origin: plan.origin.clone(),
        last: plan.last,
        steps: plan.steps,
        known: plan.known.clone(),
        lpips: prepared.digests.lpips.as_ref().map(|file| file.lpips.clone()),
        segmenter: providers.segmenter.clone(),
        embedder: providers.embedder.clone(),
        maker: Arc::new(maker),
    }
}

/// The skies of a run, of which none is known yet.
fn skies(setup: &RunSetup<'_>, photos: &Arc<PhotoStore>, prepared: &PreparedRun, plan: &RunPlan) -> Skies {
    let recompute = Recompute {
        scene: setup.given.clone(),
        cache: setup.cache.clone(),
        events: setup.options.events.clone(),
    };
    Skies::new(recompute, photos.clone(), plan.keys.sky.clone(), prepared.providers.sky.clone())
}

/// Ends the run in the ledger where its actors failed or were stopped.
fn end_of_actors(
    run: &RunContext<'_>,
    report: &Report,
    outcome: Result<(), RunError>,
) -> Result<(), RunError> {
    // An actor that gave up has stopped the others: that is not a stop by the user.
    let failed = |(actor, failure): (&str, ActorFailure)| (stage_of_failure(actor), failure);
    let gave_up =
        run.signals.skies.lost().map(|lost| (Stage::Sky, lost)).or_else(|| report.failure().map(failed));
    match (outcome, gave_up) {
        (Ok(()) | Err(RunError::Interrupted), Some((stage, failure))) => {
            let (name, reason) = (stage.name(), failure.to_string());
            run.setup.ledger.fail_stage(name, &node_of(stage).key(run.keys()), &reason)?;
            run.setup.ledger.leave_stages()?;
            run.setup.options.events.tell(Event::StageFailed { stage: name.into(), error: reason });
            return Err(RunError::of_stage(name, &failure));
        }
        (Err(RunError::Interrupted), None) => {
            run.setup.ledger.leave_stages()?;
            return Err(RunError::Interrupted);
        }
        (Err(error), _) => return Err(error),
        (Ok(()), None) => {}
    }
    if run.is_stopping() {
        run.setup.ledger.leave_stages()?;
        return Err(RunError::Interrupted);
    }
    if run.made.paused.is_some() {
        run.setup.ledger.leave_stages()?;
    }
    Ok(())
}
