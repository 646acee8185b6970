//! The supervisor's loop, and how a system ends: sources first, then one actor after another, the late ones named.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use super::shared::SystemShared;
use super::watch::Watch;
use crate::control::Phase;
use crate::events::Event;
use crate::supervise::ActorCell;

/// The supervisor's loop: heartbeats, then shutdown as far as it was requested.
pub(super) fn supervise(shared: &SystemShared) {
    let control = shared.control();
    let mut watch = Watch::default();
    let tick = (shared.options.stuck_after / 4).clamp(Duration::from_millis(10), Duration::from_secs(1));
    loop {
        let complete = || shared.complete.load(Ordering::Acquire);
        let all_ended = || complete() && shared.cells().iter().all(|cell| cell.ended());
        control.wait(tick, || control.phase() != Phase::Running || all_ended());
        watch.check(shared);
        match control.phase() {
            Phase::Running if all_ended() => break,
            Phase::Running => {}
            Phase::Draining => {
                drain(shared, &mut watch, tick);
                if control.phase() != Phase::Stopping {
                    break;
                }
            }
            Phase::Stopping => {
                stop(shared, &mut watch, tick);
                break;
            }
        }
    }
}

/// Waits for cells to end; names the late now and then.
fn wait_for(
    shared: &SystemShared,
    watch: &mut Watch,
    tick: Duration,
    deadline: Instant,
    until: Option<Phase>,
    which: &[Arc<ActorCell>],
) -> bool {
    let control = shared.control();
    let mut named = Instant::now();
    loop {
        let done =
            || which.iter().all(|cell| cell.ended()) || until.is_some_and(|phase| control.phase() >= phase);
        let left = deadline.saturating_duration_since(Instant::now());
        if control.wait(left.min(tick), done) {
            return which.iter().all(|cell| cell.ended());
        }
        watch.check(shared);
        if left.is_zero() {
            return false;
        }
        if named.elapsed() >= shared.options.name_late_every {
            named = Instant::now();
            let late = shared.cells().iter().filter(|c| !c.ended()).map(|c| c.name.to_string()).collect();
            shared.options.events.tell(Event::ShutdownWaits { actors: late, left_s: left.as_secs_f64() });
        }
    }
}

/// Sources have seen the phase; the others are closed and awaited one after another, in the data's order.
fn drain(shared: &SystemShared, watch: &mut Watch, tick: Duration) {
    let deadline = Instant::now() + shared.options.drain;
    let cells = shared.seal();
    let (sources, others): (Vec<_>, Vec<_>) = cells.into_iter().partition(|cell| cell.mailbox.is_none());
    let mut in_time = wait_for(shared, watch, tick, deadline, Some(Phase::Stopping), &sources);
    for cell in others {
        if !in_time {
            break;
        }
        if let Some(mailbox) = &cell.mailbox {
            mailbox.close();
        }
        in_time = wait_for(shared, watch, tick, deadline, Some(Phase::Stopping), std::slice::from_ref(&cell));
    }
    if !in_time {
        shared.options.stopper.stop();
        stop(shared, watch, tick);
    }
}

/// Everybody has seen the phase; closing the mailboxes wakes who waits for input or for space.
fn stop(shared: &SystemShared, watch: &mut Watch, tick: Duration) {
    let cells = shared.seal();
    cells.iter().filter_map(|cell| cell.mailbox.as_ref()).for_each(|mailbox| mailbox.close());
    let deadline = Instant::now() + shared.options.grace;
    if !wait_for(shared, watch, tick, deadline, None, &cells) {
        let late: Vec<_> = cells.iter().filter(|c| !c.ended()).map(|c| c.name.to_string()).collect();
        shared.options.events.tell(Event::ShutdownWaits { actors: late, left_s: 0.0 });
    }
}
