//! How the embedded engine follows a wall clock that jumps: what lies ahead moves along with it.

use rusqlite::{OptionalExtension, Transaction, params};
use segwild_flow::clock::Steady;

use crate::job::Retry;

/// How the two clocks stood at the last change.
pub(crate) const TABLE: &str = "
CREATE TABLE IF NOT EXISTS clocks (
  id INTEGER PRIMARY KEY CHECK (id = 1), wall REAL NOT NULL, since TEXT NOT NULL, steady REAL NOT NULL
);
";

/// The clocks may disagree by so many seconds: they are not read at the same instant, and are tuned while they run.
const SLACK_S: f64 = 1.0;

/// Looks at both clocks before a change. Where the wall clock has not come as far as the steady one, or further, it was
/// set (or the machine slept): the ends of rests and leases move by as much. Says by how much, in seconds.
pub(crate) fn follow(t: &Transaction<'_>, now: f64, steady: &Steady) -> rusqlite::Result<Option<f64>> {
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
            return too_far_ahead(t, now);
        }
    };
    if jump.abs() <= SLACK_S {
        return Ok(None);
    }
    t.execute("UPDATE jobs SET due = due + ?1 WHERE state = 'pending'", [jump])?;
    t.execute(
        "UPDATE jobs SET lease_until = lease_until + ?1, started = started + ?1 WHERE state = 'leased'",
        [jump],
    )?;
    remember(t, now, steady)?;
    Ok(Some(jump))
}

fn remember(t: &Transaction<'_>, now: f64, steady: &Steady) -> rusqlite::Result<()> {
    t.execute(
        "INSERT OR REPLACE INTO clocks (id, wall, since, steady) VALUES (1, ?1, ?2, ?3)",
        params![now, steady.since, steady.seconds],
    )?;
    Ok(())
}

/// A rest that would end later than its own length from now was started before the clock was set back: it is over. Says by
/// how much at least the clock was set back.
fn too_far_ahead(t: &Transaction<'_>, now: f64) -> rusqlite::Result<Option<f64>> {
    let rests: Vec<(String, f64, u32, Retry)> = t
        .prepare(
            "SELECT id, due, failures, attempts, first_delay_s, longest_delay_s FROM jobs
             WHERE state = 'pending' AND due > ?1",
        )?
        .query_map([now], |row| {
            let retry =
                Retry { attempts: row.get(3)?, first_delay_s: row.get(4)?, longest_delay_s: row.get(5)? };
            Ok((row.get(0)?, row.get(1)?, row.get(2)?, retry))
        })?
        .collect::<rusqlite::Result<_>>()?;
    let mut jump = None;
    for (id, due, failures, retry) in rests {
        let too_far = due - now - retry.delay_s(failures);
        if too_far > SLACK_S {
            t.execute("UPDATE jobs SET due = ?2 WHERE id = ?1", params![id, now])?;
            jump = Some(jump.map_or(-too_far, |so_far: f64| so_far.min(-too_far)));
        }
    }
    Ok(jump)
}
