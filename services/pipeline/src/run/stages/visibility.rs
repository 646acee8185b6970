//! The stage `visibility`: a source compares every photo with the trained scene, while masks are still being made. It
//! counts as the start of the stage `features`. Afterwards the source writes the mask images of transients and grows
//! the scene tree.

use crate::RunError;
use crate::artifacts::cache::SNAPSHOT;
use crate::artifacts::scene_tree::OBJECTS;
use crate::run::context::RunContext;
use crate::run::inputs::{Inputs, VISIBILITY};
use crate::run::memory;
use crate::run::need::{Extent, Need};
use crate::run::node::{Performer, StageNode, StageWork};
use crate::run::outcome::ActorOutcome;
use crate::run::results::StageResults;
use crate::run::stage::Stage;
use crate::run::tree::tree_source;
use crate::run::work::{ActorStage, Actors, StageState};
use segwild_flow::ledger::ViewOutcome;
use segwild_flow::{ActorFailure, ActorOptions, Context, Quarantined, fault};
use segwild_scene::Mask;
use std::sync::Arc;
use std::time::Duration;

/// The stage in the graph.
pub const NODE: StageNode = StageNode {
    stage: Stage::Visibility,
    by: Performer::Source,
    feed: None,
    needs: &[
        Need { stage: Stage::Sky, extent: Extent::Part, what: "skies" },
        // A tree that is grown from masks waits for those of all photos.
        Need { stage: Stage::Masks, extent: Extent::PerPhoto, what: "masks*" },
        Need { stage: Stage::Geometry, extent: Extent::Whole, what: "trained scene" },
    ],
    results: StageResults::PerPhoto {
        domain: "visibility stage",
        keys: |keys| &keys.visibility,
        held_out: false,
        described: false,
        from_snapshot: false,
    },
    work: StageWork::Actors(|| Box::new(VisibilityStage::Waiting)),
};

/// How often a photo is compared with the trained scene before it is left out.
const ATTEMPTS: u32 = 3;

enum VisibilityStage {
    Waiting,
    Comparing,
    /// The visibility of every photo is known.
    Known,
}

impl ActorStage for VisibilityStage {
    fn state(&self) -> StageState {
        match self {
            VisibilityStage::Waiting => StageState::Waiting,
            VisibilityStage::Comparing => StageState::Running,
            VisibilityStage::Known => StageState::Over,
        }
    }

    fn start(&mut self, run: &mut RunContext<'_>, actors: &Actors<'_>) -> Result<(), RunError> {
        let Some(model) = run.made.model.clone() else { return Ok(()) };
        *self = VisibilityStage::Comparing;
        let inputs = Arc::new(Inputs {
            given: run.setup.given.clone(),
            recompute: run.recompute(),
            keys: run.keys().clone(),
            photos: run.photos().clone(),
            model,
            engine: run.setup.engine.clone(),
            skies: run.signals.skies.clone(),
            masks_known: run.signals.masks_known.clone(),
            embedder: run.setup.embedder.clone(),
            maker: run.setup.maker.clone(),
            known: run.setup.known.clone(),
            photos_at_once: memory::photos_at_once(run.setup.settings, run.scene()),
        });
        run.made.inputs = Some(inputs.clone());
        let (views, out) = (run.views(false), actors.own.clone());
        let geometry = run.keys().geometry.to_string();
        let (folder, segmenter, events) =
            (run.setup.folder.clone(), run.setup.segmenter.clone(), run.setup.options.events.clone());
        let ledger = run.setup.ledger.clone();
        actors.system.source(Stage::Visibility.name(), ActorOptions::default(), move |context| {
            let mut failed = Vec::new();
            for &view in &views {
                match compare(&inputs, view, context) {
                    Err(failure) if failure.is_local() => failed.push((view, failure.to_string())),
                    seen => seen?,
                }
            }
            let seen: Vec<usize> =
                views.iter().copied().filter(|view| failed.iter().all(|(f, _)| f != view)).collect();
            out.blocking_send(ActorOutcome::Visibility(failed))?;
            // The field does not need the mask images and does not wait for them.
            for note in inputs.write_transient_masks(&folder, &seen, &*segmenter, context)? {
                events.warn(Some(Stage::Geometry.name()), note);
            }
            context.check()?;
            let _step = context.span("scene tree");
            let stopping = || {
                context.progress();
                context.check().is_err()
            };
            let grow = || -> Result<(), RunError> {
                let source = tree_source(&inputs, &geometry, &*segmenter, &stopping)?;
                // The ledger names it, so that the cache keeps it.
                ledger.record_view(SNAPSHOT, OBJECTS, &source.key(), &ViewOutcome::cached())?;
                source.tree(&inputs.recompute.cache, &stopping)?;
                Ok(())
            };
            match grow() {
                Ok(()) | Err(RunError::Interrupted) => {}
                // Clicks try again, and say so where they cannot do without it.
                Err(error) => {
                    events.warn(Some(Stage::Geometry.name()), format!("no scene tree was grown: {error}"))
                }
            }
            Ok(())
        })?;
        Ok(())
    }

    /// Leaves the photos without a known visibility out of the feature field.
    fn handle(
        &mut self,
        outcome: ActorOutcome,
        run: &mut RunContext<'_>,
    ) -> Result<Option<ActorOutcome>, RunError> {
        let ActorOutcome::Visibility(failed) = outcome else { return Ok(Some(outcome)) };
        for (view, error) in &failed {
            let key = run.keys().visibility[*view];
            let label = run.scene().views[*view].name.clone();
            let given_up = Quarantined { label, error: error.clone(), attempts: ATTEMPTS };
            run.view_done(Stage::Visibility, *view, &key, Some(&given_up), None)?;
        }
        run.made.unseen = failed.into_iter().map(|(view, _)| view).collect();
        *self = VisibilityStage::Known;
        run.weigh_failures(Stage::Visibility, run.views(false).len());
        Ok(None)
    }
}

/// Computes the visibility of a photo into the cache, if it is not there.
fn compare(inputs: &Inputs, view: usize, context: &Context) -> Result<(), ActorFailure> {
    let (key, cache) = (&inputs.keys.visibility[view], &inputs.recompute.cache);
    let mut attempt = 1;
    loop {
        context.check()?;
        if cache.get_typed::<Mask>(key, VISIBILITY)?.is_some() {
            return Ok(());
        }
        let compare = || -> Result<(), ActorFailure> {
            let _step = context.span(&inputs.recompute.scene.views[view].name);
            let seen = inputs.compare(view)?;
            fault::point("visibility.photo")?;
            Ok(cache.put_typed(key, VISIBILITY, &seen)?)
        };
        match compare() {
            Err(failure) if failure.is_local() && attempt < ATTEMPTS => {
                context.sleep(Duration::from_millis(100 * u64::from(attempt)));
                attempt += 1;
            }
            done => {
                context.progress();
                return done;
            }
        }
    }
}
