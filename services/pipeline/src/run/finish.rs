//! Finishes a run: what is made from its folder alone, and its summary.

use super::after::EndOfRun;
use super::execute::ExecutedRun;
use super::node::StageWork;
use super::options::{RunOptions, Summary};
use super::plan::RunPlan;
use super::prepare::PreparedRun;
use super::stages::NODES;
use crate::artifacts::{cache, seams};
use crate::transients::TrainFit;
use crate::{RunError, RunFolder};
use segwild_flow::{cpu, trace};

/// Frees the run's own data, makes what is made from its folder, and removes what the cache holds too much.
///
/// # Errors
/// When the report cannot be made, or the disk fails.
pub fn finish(
    prepared: PreparedRun,
    plan: RunPlan,
    executed: ExecutedRun<'_>,
    folder: &RunFolder,
    options: &RunOptions,
) -> Result<Summary, RunError> {
    let ledger = &prepared.ledger;
    let RunPlan { settings, cache: artefacts, last, known, .. } = plan;
    // The report reads the run folder again: the run's own data is freed first.
    drop((prepared.scene, prepared.engine, known));
    let ExecutedRun { report, traces, intake, scores, splats, paused, counts, report_key: key } = executed;
    let mut end = EndOfRun { folder, ledger, options, key, report, traces };
    for node in NODES.iter().filter(|node| splats.is_some() && node.stage <= last) {
        if let StageWork::End(compute) = node.work {
            compute(&mut end)?;
        }
    }
    if settings.run.cache_limit > 0 {
        let swept = cache::sweep(ledger, &artefacts, settings.run.cache_limit << 20, false)?;
        if swept.files > 0 {
            let mib = swept.bytes as f64 / f64::from(1 << 20);
            options.events.info(
                None,
                format!("{} files ({mib:.1} MiB) of earlier settings left the cache", swept.files),
            );
        }
    }
    Ok(Summary {
        photos: intake.photos.len(),
        skipped: intake.skipped,
        provider: intake.provider,
        splats: splats.unwrap_or(0),
        paused_at: paused,
        train_fit: splats.and_then(|_| TrainFit::of(folder)),
        seams: splats.and_then(|_| seams::of(folder)),
        held_out: scores,
        made: counts[0],
        cached: counts[1],
        wall_s: prepared.began.elapsed().as_secs_f64(),
        peak_bytes: cpu::peak_memory(),
        actors: trace::summary(&end.report),
    })
}
