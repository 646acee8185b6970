//! The stage `features`: the features actor makes the feature field. It may start while the last masks are being made:
//! photos are lifted without them, and the compactness loss waits for the masks of each photo that it comes to.

use crate::RunError;
use crate::artifacts::folder::FEATURES;
use crate::run::context::RunContext;
use crate::run::need::{Extent, Need};
use crate::run::node::{Performer, StageNode, StageWork};
use crate::run::outcome::ActorOutcome;
use crate::run::results::StageResults;
use crate::run::stage::Stage;
use crate::run::work::{ActorStage, Actors, StageState};
use segwild_features::{FeatureField, FeatureOutcome, FeatureTask};
use segwild_flow::Key;
use segwild_flow::ledger::ViewOutcome;
use std::sync::Arc;

/// The stage in the graph.
pub const NODE: StageNode = StageNode {
    stage: Stage::Features,
    by: Performer::Actor("features"),
    feed: None,
    needs: &[
        Need { stage: Stage::Embed, extent: Extent::Whole, what: "embedding*" },
        Need { stage: Stage::Masks, extent: Extent::PerPhoto, what: "masks*" },
        Need { stage: Stage::Visibility, extent: Extent::Whole, what: "visibility*" },
    ],
    results: StageResults::Cached(|keys| keys.features),
    work: StageWork::Actors(|| Box::new(FeatureStage::Waiting)),
};

enum FeatureStage {
    Waiting,
    /// The cache most likely has the field; its key is certain when all masks are known.
    LikelyKept,
    /// The actor makes the field.
    Ordered,
    /// The field is there; its key is certain when all masks are known.
    Made(Box<FeatureField>),
    Kept,
}

impl ActorStage for FeatureStage {
    fn state(&self) -> StageState {
        match self {
            FeatureStage::Waiting => StageState::Waiting,
            FeatureStage::LikelyKept | FeatureStage::Ordered | FeatureStage::Made(_) => StageState::Running,
            FeatureStage::Kept => StageState::Over,
        }
    }

    fn start(&mut self, run: &mut RunContext<'_>, actors: &Actors<'_>) -> Result<(), RunError> {
        *self = FeatureStage::LikelyKept;
        self.go_on(run, actors)
    }

    fn handle(
        &mut self,
        outcome: ActorOutcome,
        run: &mut RunContext<'_>,
    ) -> Result<Option<ActorOutcome>, RunError> {
        match outcome {
            ActorOutcome::Feature(FeatureOutcome::Field(field)) => *self = FeatureStage::Made(field),
            ActorOutcome::Feature(FeatureOutcome::FieldFailed(reason)) => {
                run.fail(Stage::Features, reason);
            }
            other => return Ok(Some(other)),
        }
        Ok(None)
    }

    fn go_on(&mut self, run: &mut RunContext<'_>, actors: &Actors<'_>) -> Result<(), RunError> {
        match std::mem::replace(self, FeatureStage::Waiting) {
            FeatureStage::LikelyKept => *self = order(run, actors)?,
            FeatureStage::Made(field) if run.all_masks_known() => {
                run.intact()?;
                let key = field_key(run);
                run.name_features(key);
                run.setup.cache.put_typed(&key, FEATURES, &*field)?;
                run.setup.ledger.finish_stage(Stage::Features.name(), &key, None)?;
                run.setup.folder.write_record("features.bin", FEATURES, &*field)?;
                *self = FeatureStage::Kept;
            }
            unchanged => *self = unchanged,
        }
        Ok(())
    }
}

/// Takes the field from the cache, or orders it.
fn order(run: &mut RunContext<'_>, actors: &Actors<'_>) -> Result<FeatureStage, RunError> {
    let (key, masks_known) = (field_key(run), run.all_masks_known());
    if !masks_known && run.setup.cache.contains(&key) {
        return Ok(FeatureStage::LikelyKept);
    }
    let Some(inputs) = run.made.inputs.clone() else { return Ok(FeatureStage::LikelyKept) };
    let views = run.views(false);
    for &view in views.iter().filter(|view| !run.made.unseen.contains(view)) {
        let (name, key) = (&run.scene().views[view].name, &run.keys().visibility[view]);
        run.setup.ledger.record_view(Stage::Visibility.name(), name, key, &ViewOutcome::cached())?;
    }
    if masks_known
        && let Some(field) = run.setup.cache.get_typed::<FeatureField>(&key, FEATURES)?
        && field.check().is_ok()
    {
        run.name_features(key);
        run.skip_stage(Stage::Features, &key)?;
        run.setup.folder.write_record("features.bin", FEATURES, &field)?;
        return Ok(FeatureStage::Kept);
    }
    run.setup.ledger.start_stage(Stage::Features.name(), &key)?;
    let given = |view: &usize| run.made.embedded[*view] && !run.made.unseen.contains(view);
    let task = FeatureTask::Field {
        splats: inputs.model.splats.clone(),
        options: inputs.model.options(),
        views: Arc::new(views.into_iter().filter(given).collect()),
        inputs,
    };
    actors.features.blocking_send(task).map_err(|_| RunError::Interrupted)?; // closed: everything stops
    Ok(FeatureStage::Ordered)
}

/// The key of the field, as far as is known. A field without the embedding, the masks or the visibility of photos that
/// were given up has another key than the field with them.
fn field_key(run: &RunContext<'_>) -> Key {
    let views = run.described_views();
    let no_embedding = views.iter().copied().filter(|&view| !run.made.embedded[view]).collect();
    let no_masks = views.iter().copied().filter(|&v| run.signals.masks_known.get(v) == Some(false)).collect();
    run.keys().features_without(&no_embedding, &no_masks, &run.made.unseen)
}
