//! Why stages and workers of a run wait, in words.

use segwild_flow::WorkerState;
use segwild_flow::ledger::LiveMailbox;
use segwild_pipeline::{Extent, Need, Stage, needs, stages_of};

use crate::view::{ActorView, StageView};
use crate::words::{bytes, duration};

/// How far a stage is: `geometry 120/500 (8.0 s left)`.
fn how_far(stage: &StageView) -> String {
    let mut text = stage.name.clone();
    if stage.state != "running" {
        return text;
    }
    if let Some(part) = &stage.part {
        text += &format!(" ({part})");
    }
    if let Some(total) = stage.total {
        text += &format!(" {}/{total}", stage.done);
    }
    if let Some(s) = stage.eta_s.filter(|s| s.is_finite()) {
        text += &format!(" ({} left)", duration(s));
    }
    text
}

/// What a stage needs, while it is not there: how far the other stage is.
fn open(need: &Need, all: &[StageView]) -> Option<String> {
    let stage = all.iter().find(|s| s.name == need.stage.name() && s.state != "done")?;
    Some(match (need.stage, need.extent) {
        (Stage::Geometry, Extent::Part) => format!("the snapshot of {}", how_far(stage)),
        _ => how_far(stage),
    })
}

/// Stages that have not started wait for those before them.
pub(crate) fn stages(all: &mut [StageView], running: bool) {
    let before = all.to_vec();
    for stage in all.iter_mut().filter(|s| s.state == "waiting" || s.state == "pending") {
        if !running {
            stage.why = Some("no process works on this run".into());
            continue;
        }
        let needs = Stage::named(&stage.name).map_or_else(Vec::new, needs);
        let open: Vec<String> = needs.iter().filter_map(|need| open(need, &before)).collect();
        stage.why = Some(match open.is_empty() {
            true => "about to start, or not requested".into(),
            false => format!("waits for {}", open.join(", ")),
        });
    }
}

/// Workers wait for messages, for space, for a rest to end, or in the middle of their work.
pub(crate) fn actors(all: &mut [ActorView], mailboxes: &[LiveMailbox], stages: &[StageView], running: bool) {
    for actor in all.iter_mut() {
        if !running || actor.exit != "running" {
            continue;
        }
        let rest = actor.last_error.as_deref().map_or(String::new(), |e| format!(" after {e}"));
        for worker in &mut actor.workers {
            worker.why = match worker.state {
                WorkerState::Busy if worker.stuck => {
                    Some(format!("stuck: no progress on `{}` for {}", worker.item, duration(worker.for_s)))
                }
                WorkerState::Busy | WorkerState::Ended => None,
                WorkerState::Starting => Some("is being built (a model loads)".into()),
                WorkerState::BackOff => Some(format!("rests before another attempt{rest}")),
                WorkerState::Blocked => Some(blocked_by(&worker.item, mailboxes)),
                WorkerState::Waiting if !worker.item.is_empty() => Some(format!("waits for {}", worker.item)),
                WorkerState::Waiting => Some(no_work(&actor.name, stages)),
            };
        }
    }
}

/// A blocked worker names what it waits for.
fn blocked_by(mailbox: &str, mailboxes: &[LiveMailbox]) -> String {
    match mailboxes.iter().find(|m| m.name == mailbox) {
        Some(m) => format!(
            "waits for space in mailbox `{mailbox}`: {} of {} messages, {} of {}",
            m.depth,
            m.capacity,
            bytes(m.bytes),
            bytes(m.capacity_bytes)
        ),
        // What is waited for is a mailbox, or else what another actor makes.
        None => format!("waits for {mailbox}"),
    }
}

/// An empty mailbox: the next stage of the actor says why.
fn no_work(actor: &str, stages: &[StageView]) -> String {
    let going: Vec<&str> = stages.iter().filter(|s| s.state == "running").map(|s| s.name.as_str()).collect();
    if actor == "coordinator" && !going.is_empty() {
        return format!("no message: {} under way", going.join(", "));
    }
    let next = stages_of(actor).iter().find_map(|own| {
        stages.iter().find(|s| s.name == own.name() && s.state != "done" && s.state != "failed")
    });
    match next {
        None => "no work left".into(),
        Some(StageView { name, why: Some(_), .. }) => format!("no work until {name} can start"),
        Some(stage) => format!("no work: the next of {} is not there yet", how_far(stage)),
    }
}
