//! The stage `report`: one page with all that the run did, read back from the run folder.

use crate::RunError;
use crate::output::report::write_report;
use crate::run::after::EndOfRun;
use crate::run::need::{Extent, Need};
use crate::run::node::{Performer, StageNode, StageWork};
use crate::run::results::StageResults;
use crate::run::stage::Stage;
use segwild_flow::Key;

/// The stage in the graph.
pub const NODE: StageNode = StageNode {
    stage: Stage::Report,
    by: Performer::Run,
    feed: None,
    needs: &[
        Need { stage: Stage::Evaluate, extent: Extent::Whole, what: "scores" },
        Need { stage: Stage::Objects, extent: Extent::Whole, what: "object list" },
    ],
    results: StageResults::Rewritten(|keys| Key::of("report").key("features", &keys.features).finish()),
    work: StageWork::End(report),
};

fn report(end: &mut EndOfRun<'_>) -> Result<(), RunError> {
    let name = Stage::Report.name();
    end.ledger.start_stage(name, &end.key)?;
    let progress = end.options.events.stage(name, None);
    let folder = end.folder;
    for left_out in end.traces.step(&mut end.report, name, || write_report(folder))? {
        end.options.events.warn(
            Some(name),
            format!("photo {} is not shown whole in the report: {}", left_out.name, left_out.reason),
        );
    }
    end.traces.write(&end.report)?;
    progress.finish();
    Ok(end.ledger.finish_stage(name, &end.key, None)?)
}
