//! The stage `evaluate`: scores of the held-out photos.

use crate::RunError;
use crate::output::evaluate::{HeldOut, held_out};
use crate::run::after::AfterActors;
use crate::run::need::{Extent, Need};
use crate::run::node::{Performer, StageNode, StageWork};
use crate::run::results::StageResults;
use crate::run::stage::Stage;
use segwild_flow::ledger::ViewOutcome;
use segwild_flow::{ActorFailure, Event};
use std::collections::BTreeSet;

/// The stage in the graph.
pub const NODE: StageNode = StageNode {
    stage: Stage::Evaluate,
    by: Performer::Run,
    feed: None,
    needs: &[
        Need { stage: Stage::Sky, extent: Extent::Whole, what: "sky*" },
        Need { stage: Stage::Geometry, extent: Extent::Whole, what: "trained scene" },
        Need { stage: Stage::Features, extent: Extent::Whole, what: "" },
    ],
    results: StageResults::Files(|keys| keys.evaluation),
    work: StageWork::Run(evaluate),
};

fn evaluate(after: &mut AfterActors<'_, '_>) -> Result<(), RunError> {
    let AfterActors { run, report, traces, holds_out, scores } = after;
    let Some(model) = run.made.model.clone() else { return Ok(()) };
    let name = Stage::Evaluate.name();
    let events = &run.setup.options.events;
    let key = run.keys().evaluation;
    let known = run.setup.folder.read_json::<HeldOut>("evaluation.json").ok();
    if run.setup.ledger.stage_is_done(name, &key)? && (known.is_some() || !*holds_out) {
        events.tell(Event::StageSkipped { stage: name.into(), key: key.to_string() });
        *scores = known.filter(|_| *holds_out);
        return Ok(());
    }
    run.setup.ledger.start_stage(name, &key)?;
    let progress = events.stage(name, None);
    let skies = run.signals.skies.clone();
    let sky = move |view: usize| skies.read(view);
    let mut unscored = BTreeSet::new();
    let scored = traces.step(report, name, || {
        let usable = |view: usize| run.keys().unreadable(view).is_none();
        let record = |view: usize, scored: Result<f64, ActorFailure>| {
            let photo = &run.scene().views[view].name;
            let outcome = match scored {
                Ok(seconds) => ViewOutcome::done(seconds),
                Err(reason) => {
                    unscored.insert(view);
                    let message = format!("photo {photo} is not scored: {reason}");
                    events.warn(Some(name), message);
                    ViewOutcome::failed(1, reason.to_string())
                }
            };
            Ok(run.setup.ledger.record_view(name, photo, &key, &outcome)?)
        };
        let (engine, lpips) = (&*run.setup.engine, run.setup.lpips.as_deref());
        held_out(
            run.setup.folder,
            run.photos(),
            &model,
            engine,
            run.setup.settings,
            lpips,
            usable,
            sky,
            record,
        )
    });
    if let Some(lost) = run.signals.skies.lost() {
        return Err(RunError::of_stage(Stage::Sky.name(), &lost));
    }
    *scores = scored?;
    run.intact()?;
    progress.finish();
    Ok(run.setup.ledger.finish_stage(name, &run.keys().evaluation_without(&unscored), None)?)
}
