//! The stage `sky`: the source `ingest` requests the sky of each photo from the masks actor. The trainer waits for the
//! sky of each photo that it comes to.

use crate::RunError;
use crate::run::context::RunContext;
use crate::run::need::{Extent, Need};
use crate::run::node::{Feed, Performer, StageNode, StageWork};
use crate::run::outcome::ActorOutcome;
use crate::run::products::Products;
use crate::run::results::StageResults;
use crate::run::stage::Stage;
use crate::run::work::{ActorStage, Actors, StageState};
use segwild_flow::ActorOptions;
use segwild_masks::{MaskOutcome, MaskTask};

/// The stage in the graph.
pub const NODE: StageNode = StageNode {
    stage: Stage::Sky,
    by: Performer::Actor("masks"),
    feed: Some(Feed { source: "ingest", sends: "view*" }),
    needs: &[Need { stage: Stage::Poses, extent: Extent::Whole, what: "poses" }],
    results: StageResults::PerPhoto {
        domain: "sky stage",
        keys: |keys| &keys.sky,
        held_out: true,
        described: false,
        from_snapshot: false,
    },
    work: StageWork::Actors(|| Box::new(SkyStage::Waiting)),
};

enum SkyStage {
    Waiting,
    /// Skies that are not known yet: in all, and of photos that are trained on.
    Open {
        all: usize,
        trained_on: usize,
    },
}

impl ActorStage for SkyStage {
    fn state(&self) -> StageState {
        match self {
            SkyStage::Waiting => StageState::Waiting,
            SkyStage::Open { all: 0, .. } => StageState::Over,
            SkyStage::Open { .. } => StageState::Running,
        }
    }

    /// A part: the skies of all photos that are trained on.
    fn gives(&self, extent: Extent, _: &Products) -> bool {
        match (self, extent) {
            (SkyStage::Waiting, _) => false,
            (SkyStage::Open { .. }, Extent::PerPhoto) => true,
            (SkyStage::Open { trained_on, .. }, Extent::Part) => *trained_on == 0,
            (SkyStage::Open { all, .. }, Extent::Whole) => *all == 0,
        }
    }

    fn start(&mut self, run: &mut RunContext<'_>, actors: &Actors<'_>) -> Result<(), RunError> {
        let views = run.views(true);
        let (held_out, training): (Vec<usize>, Vec<usize>) =
            views.iter().partition(|&&view| run.scene().views[view].test);
        *self = SkyStage::Open { all: views.len(), trained_on: training.len() };
        // Held-out photos come last: only the scores need their skies.
        run.signals.skies.plan(training.into_iter().chain(held_out));
        run.open(Stage::Sky, &NODE.key(run.keys()), views.len())?;
        let (masks, keys, skies) = (actors.masks.clone(), run.keys().sky.clone(), run.signals.skies.clone());
        // A source only sends and needs no threads to compute on.
        let feeder = ActorOptions { threads: Some(1), ..ActorOptions::default() };
        actors.system.source("ingest", feeder, move |context| {
            while let Some(view) = skies.next_open() {
                context.check()?;
                masks.blocking_send_urgent(MaskTask::Sky { view, key: keys[view] })?;
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
        let ActorOutcome::Mask(MaskOutcome::Sky { view, sky, seconds }) = outcome else {
            return Ok(Some(outcome));
        };
        let key = run.keys().sky[view];
        run.view_done(Stage::Sky, view, &key, sky.as_ref().err(), seconds)?;
        if sky.is_err() {
            run.do_without_sky(view)?;
        }
        // From here on the trainer may use the photo: the keys already account for its sky.
        run.signals.skies.set(view, sky.is_ok());
        if let SkyStage::Open { all, trained_on } = self {
            *all -= 1;
            *trained_on -= usize::from(!run.scene().views[view].test);
        }
        if self.state() == StageState::Over {
            run.close(Stage::Sky, &NODE.key(run.keys()))?;
        }
        Ok(None)
    }
}
