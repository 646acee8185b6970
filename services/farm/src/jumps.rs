//! How the embedded engine follows a wall clock that jumps: what lies ahead moves along with it.

use rusqlite::{OptionalExtension, Transaction, params};
use segwild_flow::clock::Steady;

use crate::table::{CLOCK_SLACK_S, JobTable};
use crate::transition::Transition;

/// How the two clocks stood at the last change.
pub(crate) const TABLE: &str = "
CREATE TABLE IF NOT EXISTS clocks (
  id INTEGER PRIMARY KEY CHECK (id = 1), wall REAL NOT NULL, since TEXT NOT NULL, steady REAL NOT NULL
);
";

/// What has to happen before a change because of the clocks.
#[derive(Default)]
pub(crate) struct Jump {
    pub transitions: Vec<Transition>,
    /// By how much the wall clock was set, in seconds.
    pub seconds: Option<f64>,
}

/// Compares both clocks before a change. Where the wall clock has not come as far as the steady one, or further, it was
/// set (or the machine slept): the ends of rests and leases move by as much.
pub(crate) fn follow(
    t: &Transaction<'_>,
    table: &JobTable,
    now: f64,
    steady: &Steady,
) -> rusqlite::Result<Jump> {
    let before: Option<(f64, String, f64)> = t
        .query_row("SELECT wall, since, steady FROM clocks", [], |row| {
            Ok((row.get(0)?, row.get(1)?, row.get(2)?))
        })
        .optional()?;
    let known = before.filter(|(_, since, _)| *since == steady.since);
    let jump = match &known {
        Some((wall, _, then)) => (now - wall) - (steady.seconds - then),
        // The first change, or the first since the machine was started: only what cannot be is seen.
        None => {
            remember(t, now, steady)?;
            return Ok(too_far_ahead(table, now));
        }
    };
    if jump.abs() <= CLOCK_SLACK_S {
        return Ok(Jump::default());
    }
    remember(t, now, steady)?;
    let moved = Transition::ClockSet { seconds: jump, since: u64::MAX };
    Ok(Jump { transitions: vec![moved], seconds: Some(jump) })
}

fn remember(t: &Transaction<'_>, now: f64, steady: &Steady) -> rusqlite::Result<()> {
    t.execute(
        "INSERT OR REPLACE INTO clocks (id, wall, since, steady) VALUES (1, ?1, ?2, ?3)",
        params![now, steady.since, steady.seconds],
    )?;
    Ok(())
}

/// A rest that would end later than its own length from now was started before the clock was set back: it is over. The
/// clock was set back by at least the most by which one is too long.
fn too_far_ahead(table: &JobTable, now: f64) -> Jump {
    let rests = table.rests_too_long(now);
    let longest = rests.iter().map(|(_, too_far)| *too_far).reduce(f64::max);
    let transitions = rests.into_iter().map(|(job, _)| Transition::RestEnded { job }).collect();
    Jump { transitions, seconds: longest.map(|seconds| -seconds) }
}
