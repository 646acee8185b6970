//! Why scenes of a batch wait, in words.

use std::collections::BTreeMap;

use segwild_farm::{JobStatus, JobTurn, Needs};

use crate::view::{FarmWorkerView, SceneState, SceneView};
use crate::words::{bytes, count, duration};

/// Scenes wait for their turn, for space, for the end of a rest, or for what keeps their process from starting.
pub(crate) fn scenes(
    all: &mut [SceneView],
    turns: &BTreeMap<&str, JobTurn<'_>>,
    waits: &BTreeMap<String, String>,
    batch_runs: bool,
) {
    for scene in all.iter_mut() {
        let in_use = scene.run.as_ref().and_then(|run| run.owner.clone());
        scene.why = match scene.state {
            SceneState::Done => None,
            SceneState::Dead => scene.error.as_ref().map(|e| format!("given up: {e}")),
            SceneState::Running if in_use.is_none() => Some("its process is starting or stopping".into()),
            SceneState::Running => None,
            SceneState::Waiting if !batch_runs => Some("no process runs this batch".into()),
            SceneState::Waiting if waits.contains_key(&scene.name) => waits.get(&scene.name).cloned(),
            SceneState::Waiting => Some(match (scene.rests_s, &scene.error) {
                (Some(s), Some(error)) => format!("tries again in {} after: {error}", duration(s)),
                (Some(s), None) => format!("starts in {}", duration(s)),
                (None, _) => turns
                    .get(scene.name.as_str())
                    .map_or_else(|| "about to start".into(), |turn| missing_capacity(&scene.needs, turn)),
            }),
        };
    }
}

/// Scenes of a farm wait for a worker that has what they need, for the end of a rest, or for what keeps a process from starting.
pub(crate) fn farm_scenes(
    all: &mut [SceneView],
    jobs: &[JobStatus],
    waits: &BTreeMap<String, String>,
    workers: &[FarmWorkerView],
) {
    for (scene, status) in all.iter_mut().zip(jobs) {
        scene.why = match scene.state {
            SceneState::Done => None,
            SceneState::Dead => scene.error.as_ref().map(|e| format!("given up: {e}")),
            SceneState::Running => scene.worker.as_ref().map(|worker| format!("on {worker}")),
            SceneState::Waiting if waits.contains_key(&scene.name) => waits.get(&scene.name).cloned(),
            SceneState::Waiting => Some(match (scene.rests_s, &scene.error) {
                (Some(s), Some(error)) => format!("tries again in {} after: {error}", duration(s)),
                (Some(s), None) => format!("starts in {}", duration(s)),
                (None, _) => missing_worker(&scene.needs, status.job.accelerator.as_deref(), workers),
            }),
        };
    }
}

/// What a worker must have, and whether one is there that has it once it is free.
fn missing_worker(needs: &Needs, accelerator: Option<&str>, workers: &[FarmWorkerView]) -> String {
    let memory = bytes(needs.memory_bytes);
    let mut text = format!("waits for a worker with {} and {memory} of memory", count(needs.cores, "core"));
    if needs.accelerators > 0 {
        text += &format!(" and {}", count(needs.accelerators, "accelerator"));
    }
    if let Some(name) = accelerator {
        text += &format!(" ({name})");
    }
    let there: Vec<&FarmWorkerView> = workers.iter().filter(|worker| worker.is_there()).collect();
    // One that has not announced itself yet may have it.
    let could = |worker: &&FarmWorkerView| {
        let has_it = accelerator.is_none() || worker.accelerator.as_deref() == accelerator;
        worker.whole.is_none_or(|whole| needs.fit(&whole) && has_it)
    };
    let could: Vec<&FarmWorkerView> = there.iter().copied().filter(could).collect();
    let paused: Vec<(&str, &str)> =
        could.iter().filter_map(|worker| Some((worker.name.as_str(), worker.paused.as_deref()?))).collect();
    match (there.len(), could.len(), paused.first()) {
        (0, ..) => text + "; no worker is there",
        (n, 0, _) => format!("{text}; of {} none has that", count(n as u32, "worker")),
        (_, 1, Some((_, reason))) => format!("{text}; the one that has it takes no scene: {reason}"),
        (_, n, Some((name, reason))) if paused.len() == n => {
            format!("{text}; the {n} that have it take no scene, as {name}: {reason}")
        }
        _ => text,
    }
}

/// What a scene still needs, and whom that is kept for.
fn missing_capacity(needs: &Needs, turn: &JobTurn<'_>) -> String {
    let free = &turn.free;
    let still = |n: u64, words: String| if n > 0 { format!(" ({words} free)") } else { String::new() };
    let mut lacks = Vec::new();
    if needs.cores > free.cores {
        lacks.push(count(needs.cores, "core") + &still(free.cores.into(), free.cores.to_string()));
    }
    if needs.memory_bytes > free.memory_bytes {
        let free = still(free.memory_bytes, bytes(free.memory_bytes));
        lacks.push(format!("{} of memory{free}", bytes(needs.memory_bytes)));
    }
    if needs.accelerators > free.accelerators {
        let free = still(free.accelerators.into(), free.accelerators.to_string());
        lacks.push(count(needs.accelerators, "accelerator") + &free);
    }
    match (lacks.is_empty(), turn.kept_for) {
        (true, _) => "about to start".into(),
        (false, None) => format!("waits for {}", lacks.join(", ")),
        (false, Some(urgent)) => format!("waits for {}; `{urgent}` goes first", lacks.join(", ")),
    }
}
