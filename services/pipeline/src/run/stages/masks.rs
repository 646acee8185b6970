//! The stage `masks`: the source `intrinsic renders` renders the snapshot from every camera, in order, into the masks
//! actor's mailbox, while the training goes on.

use crate::RunError;
use crate::run::context::RunContext;
use crate::run::inputs::SnapshotRenders;
use crate::run::need::{Extent, Need};
use crate::run::node::{Feed, Performer, StageNode, StageWork};
use crate::run::outcome::ActorOutcome;
use crate::run::results::StageResults;
use crate::run::stage::Stage;
use crate::run::work::{ActorStage, Actors, StageState};
use segwild_flow::{ActorFailure, ActorOptions};
use segwild_masks::{MaskOutcome, MaskSource, MaskTask, Snapshot};
use std::sync::Arc;

/// The stage in the graph.
pub const NODE: StageNode = StageNode {
    stage: Stage::Masks,
    by: Performer::Actor("masks"),
    feed: Some(Feed { source: "intrinsic renders", sends: "render*" }),
    needs: &[
        // The key of each photo's masks depends on every sky that is trained on.
        Need { stage: Stage::Sky, extent: Extent::Part, what: "skies" },
        Need { stage: Stage::Geometry, extent: Extent::Part, what: "snapshot at a fixed step" },
    ],
    results: StageResults::PerPhoto {
        domain: "masks stage",
        keys: |keys| &keys.masks,
        held_out: false,
        described: true,
        from_snapshot: true,
    },
    work: StageWork::Actors(|| Box::new(MasksStage::Waiting)),
};

enum MasksStage {
    Waiting,
    /// Photos of which it is not known yet if they have masks.
    Open(usize),
}

impl ActorStage for MasksStage {
    fn state(&self) -> StageState {
        match self {
            MasksStage::Waiting => StageState::Waiting,
            MasksStage::Open(0) => StageState::Over,
            MasksStage::Open(_) => StageState::Running,
        }
    }

    fn start(&mut self, run: &mut RunContext<'_>, actors: &Actors<'_>) -> Result<(), RunError> {
        let Some(snapshot) = run.made.snapshot.take() else { return Ok(()) };
        let views = run.described_views();
        *self = MasksStage::Open(views.len());
        run.open_described(Stage::Masks, &NODE.key(run.keys()), &views)?;
        let (size, keys, skies) =
            (run.setup.settings.scene.size, run.keys().masks.clone(), run.signals.skies.clone());
        let (cache, mask_source, out) =
            (run.setup.cache.clone(), run.setup.settings.masks.mask_source, actors.masks.clone());
        let renders =
            Arc::new(SnapshotRenders::new(snapshot, run.setup.engine.clone(), &run.setup.given, size));
        actors.system.source("intrinsic renders", ActorOptions::default(), move |context| {
            for &view in &views {
                context.check()?;
                // Rendered ahead of the actor. Where masks in the cache are damaged, the actor renders for itself.
                let render = if mask_source == MaskSource::Photo || cache.contains(&keys[view]) {
                    None
                } else {
                    Some(Arc::new(renders.render(view).map_err(ActorFailure::retry)?))
                };
                let (key, sky) = (keys[view], skies.read(view)?.map(Arc::new));
                out.blocking_send(MaskTask::Masks { view, key, render, snapshot: renders.clone(), sky })?;
            }
            Ok(())
        })?;
        Ok(())
    }

    fn handle(
        &mut self,
        outcome: ActorOutcome,
        run: &mut RunContext<'_>,
    ) -> Result<Option<ActorOutcome>, RunError> {
        let ActorOutcome::Mask(MaskOutcome::Masks { view, masks, seconds }) = outcome else {
            return Ok(Some(outcome));
        };
        let key = run.keys().masks[view];
        run.view_done(Stage::Masks, view, &key, masks.as_ref().err(), seconds)?;
        run.signals.masks_known.set(view, masks.is_ok());
        if let MasksStage::Open(open) = self {
            *open -= 1;
        }
        let training = run.has_bar(Stage::Geometry);
        run.mask_speed.add(seconds, training);
        if self.state() == StageState::Over {
            run.mask_speed.report(&run.setup.options.events);
            run.close(Stage::Masks, &NODE.key(run.keys()))?;
        }
        Ok(None)
    }
}
