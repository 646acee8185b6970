//! The stage `objects`: the list of the trained scene's objects, from its tree.

use crate::RunError;
use crate::artifacts::keys::Keys;
use crate::output::objects::{ListRequest, ObjectList};
use crate::run::after::AfterActors;
use crate::run::context::RunContext;
use crate::run::diagnostics;
use crate::run::inputs::Inputs;
use crate::run::need::{Extent, Need};
use crate::run::node::{Performer, StageNode, StageWork};
use crate::run::results::StageResults;
use crate::run::stage::Stage;
use crate::run::tree::tree_source;
use segwild_flow::{Event, Key};
use segwild_raster::CpuEngine;

/// The stage in the graph.
pub const NODE: StageNode = StageNode {
    stage: Stage::Objects,
    by: Performer::Run,
    feed: None,
    needs: &[
        Need { stage: Stage::Geometry, extent: Extent::Whole, what: "trained scene" },
        Need { stage: Stage::Visibility, extent: Extent::Whole, what: "scene tree" },
    ],
    results: StageResults::Files(list_key),
    work: StageWork::Run(objects),
};

/// Raised when the list of the same objects changes.
const FORMAT: u32 = 1;

fn list_key(keys: &Keys) -> Key {
    list_of(&keys.scene_tree())
}

fn list_of(tree: &Key) -> Key {
    Key::of("objects stage").key("tree", tree).value("format", FORMAT).finish()
}

fn objects(after: &mut AfterActors<'_, '_>) -> Result<(), RunError> {
    let AfterActors { run, report, traces, .. } = after;
    match run.made.inputs.clone() {
        Some(inputs) => traces.step(report, Stage::Objects.name(), || list(run, &inputs)),
        None => Ok(()),
    }
}

fn list(run: &RunContext<'_>, inputs: &Inputs) -> Result<(), RunError> {
    let geometry = run.keys().geometry.to_string();
    let stopping = || run.is_stopping();
    let source = tree_source(inputs, &geometry, &*run.setup.segmenter, &stopping)?;
    // Of a tree without the masks of photos that were given up, it is another list.
    let (folder, name, key) = (run.setup.folder, Stage::Objects.name(), list_of(&source.key()));
    let events = &run.setup.options.events;
    let before = ObjectList::read(folder);
    if run.setup.ledger.stage_is_done(name, &key)? && before.is_some() {
        events.tell(Event::StageSkipped { stage: name.into(), key: key.to_string() });
        return Ok(());
    }
    run.setup.ledger.start_stage(name, &key)?;
    let progress = events.stage(name, None);
    match source.tree(&run.setup.cache, &stopping)? {
        Some(tree) => {
            let (photos, model, key) = (source.photos, source.model, source.key().to_string());
            let request = ListRequest { engine: &CpuEngine::new(), photos, model, tree: &tree, key };
            let listed = request.list(before.as_ref(), &run.setup.options.stopper)?;
            listed.write(folder)?;
            if let Some(words) = listed.list.seen_once.as_ref().and_then(diagnostics::seen_once) {
                events.info(Some(name), words);
            }
        }
        None if stopping() => return Err(RunError::Interrupted),
        // A list of another tree is of no use.
        None => ObjectList::remove(folder)?,
    }
    progress.finish();
    Ok(run.setup.ledger.finish_stage(name, &key, None)?)
}
