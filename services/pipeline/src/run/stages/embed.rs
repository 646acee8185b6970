//! The stage `embed`: the source `photos` requests the embedding of each photo from the features actor.

use crate::RunError;
use crate::run::context::RunContext;
use crate::run::need::{Extent, Need};
use crate::run::node::{Feed, Performer, StageNode, StageWork};
use crate::run::outcome::ActorOutcome;
use crate::run::results::StageResults;
use crate::run::stage::Stage;
use crate::run::work::{ActorStage, Actors, StageState};
use segwild_features::{FeatureOutcome, FeatureTask};
use segwild_flow::ActorOptions;

/// The stage in the graph.
pub const NODE: StageNode = StageNode {
    stage: Stage::Embed,
    by: Performer::Actor("features"),
    feed: Some(Feed { source: "photos", sends: "view*" }),
    needs: &[Need { stage: Stage::Poses, extent: Extent::Whole, what: "poses" }],
    results: StageResults::PerPhoto {
        domain: "embed stage",
        keys: |keys| &keys.embedding,
        held_out: false,
        described: true,
        from_snapshot: false,
    },
    work: StageWork::Actors(|| Box::new(EmbedStage::Waiting)),
};

enum EmbedStage {
    Waiting,
    /// Photos that are neither embedded nor given up.
    Open(usize),
}

impl ActorStage for EmbedStage {
    fn state(&self) -> StageState {
        match self {
            EmbedStage::Waiting => StageState::Waiting,
            EmbedStage::Open(0) => StageState::Over,
            EmbedStage::Open(_) => StageState::Running,
        }
    }

    fn start(&mut self, run: &mut RunContext<'_>, actors: &Actors<'_>) -> Result<(), RunError> {
        let views = run.described_views();
        *self = EmbedStage::Open(views.len());
        run.open_described(Stage::Embed, &NODE.key(run.keys()), &views)?;
        let (features, keys) = (actors.features.clone(), run.keys().embedding.clone());
        // A source only sends and needs no threads to compute on.
        let feeder = ActorOptions { threads: Some(1), ..ActorOptions::default() };
        actors.system.source("photos", feeder, move |context| {
            for &view in &views {
                context.check()?;
                features.blocking_send(FeatureTask::Embed { view, key: keys[view] })?;
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
        let (view, given_up, seconds) = match outcome {
            ActorOutcome::Feature(FeatureOutcome::Embedded { view, seconds }) => (view, None, seconds),
            ActorOutcome::Feature(FeatureOutcome::EmbedFailed { view, given_up }) => {
                (view, Some(given_up), None)
            }
            other => return Ok(Some(other)),
        };
        let key = run.keys().embedding[view];
        run.view_done(Stage::Embed, view, &key, given_up.as_ref(), seconds)?;
        run.made.embedded[view] = given_up.is_none();
        if let EmbedStage::Open(open) = self {
            *open -= 1;
        }
        if self.state() == StageState::Over {
            run.close(Stage::Embed, &NODE.key(run.keys()))?;
        }
        Ok(None)
    }
}
