//! What follows a failure: rests, dead letters, stops.

use super::site::{
    ConformanceFailure, JUMPS_S, LEASE_S, REST_S, Site, claim, expect, job, nothing, offer, outcome, state,
};
use crate::engine::{Completed, EngineError, ErrorClass, JobFate, JobState, WorkerOffer};
use crate::job::{Job, Needs, Retry};

pub fn back_off(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&Job { retry: Retry { attempts: 9, ..job("a").retry }, ..job("a") })?;
    for failures in 0..3 {
        let lease = claim(&*engine, "w")?;
        match engine.fail(&lease, ErrorClass::Retryable, "no luck")? {
            JobFate::Retry { .. } => {}
            fate => return Err(ConformanceFailure::NoRest { failures, fate }),
        }
        let rest = REST_S * f64::from(1 << failures);
        site.pass(rest * 0.5);
        nothing(&*engine, "during the rest")?;
        site.pass(rest * 0.75);
    }
    claim(&*engine, "w").map(drop)
}

pub fn attempts_end(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    for last in [false, false, true] {
        let lease = claim(&*engine, "w")?;
        let fate = engine.fail(&lease, ErrorClass::Retryable, "no luck")?;
        expect("a dead letter", fate == JobFate::Dead, last)?;
        site.pass(60.0 * REST_S);
    }
    expect("its state", state(&*engine, "a")?, JobState::Dead)?;
    nothing(&*engine, "dead")?;
    let jobs = engine.jobs()?;
    expect("its last error", jobs[0].error.as_deref(), Some("no luck"))
}

pub fn rest_under_jumps(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let retry = Retry { attempts: 9, longest_delay_s: REST_S, ..job("a").retry };
    engine.publish(&Job { retry, ..job("a") })?;
    for jump in JUMPS_S {
        let lease = claim(&*engine, "w")?;
        engine.fail(&lease, ErrorClass::Retryable, "no luck")?;
        site.jump(jump);
        nothing(&*engine, &format!("in a rest, after a jump of {jump} s"))?;
        site.pass(REST_S * 1.5);
    }
    claim(&*engine, "w").map(drop)
}

pub fn fatal(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    engine.publish(&job("b"))?;
    let lease = claim(&*engine, "w")?;
    expect("its fate", engine.fail(&lease, ErrorClass::Fatal, "bad input")?, JobFate::Dead)?;
    expect("the rest goes on", claim(&*engine, "w")?.job.id.as_str(), "b")?;
    nothing(&*engine, "with the other one dead")
}

pub fn silent_to_death(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    for _ in 0..3 {
        claim(&*engine, "w")?;
        site.pass(LEASE_S * 1.5);
        nothing(&*engine, "as the lease ends")?;
        site.pass(60.0 * REST_S);
    }
    nothing(&*engine, "after it has silenced three workers")?;
    expect("its state", state(&*engine, "a")?, JobState::Dead)
}

pub fn tried_alone(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("innocent"))?;
    engine.publish(&job("poison"))?;
    for _ in 0..2 {
        let both = [claim(&*engine, "w")?, claim(&*engine, "w")?];
        expect("not alone yet", both.map(|lease| lease.alone), [false, false])?;
        site.pass(LEASE_S * 1.5);
        nothing(&*engine, "as the leases end")?;
        site.pass(60.0 * REST_S);
    }
    let busy = WorkerOffer { free: Needs { cores: 3, ..offer("w").free }, ..offer("w") };
    expect("who has something else to do", engine.claim(&busy)?, None)?;
    let lease = claim(&*site.engine(), "w")?;
    expect("the last attempt", (lease.job.id.as_str(), lease.alone, lease.failures), ("innocent", true, 2))?;
    expect("it was not the one", engine.complete(&lease, "done")?, Completed::Now)?;
    claim(&*engine, "w")?;
    site.pass(LEASE_S * 1.5);
    nothing(&*engine, "as the last lease ends")?;
    expect("the other one", state(&*engine, "poison")?, JobState::Dead)
}

pub fn stopping(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    for _ in 0..5 {
        let lease = claim(&*engine, "w")?;
        let fate = engine.fail(&lease, ErrorClass::Stopped, "stopped")?;
        expect("its fate", fate, JobFate::Released)?;
    }
    let lease = claim(&*engine, "w")?;
    expect("completing it", engine.complete(&lease, "done")?, Completed::Now)
}

pub fn shortage(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    for _ in 0..5 {
        let lease = claim(&*engine, "w")?;
        expect("the failures before", lease.failures, 0)?;
        match engine.fail(&lease, ErrorClass::Shortage, "too many open files")? {
            JobFate::Retry { .. } => {}
            fate => return Err(ConformanceFailure::NoShortage(fate)),
        }
        nothing(&*engine, "in its rest")?;
        site.pass(REST_S * 1.1);
    }
    let lease = claim(&*engine, "w")?;
    expect("completing it", engine.complete(&lease, "done")?, Completed::Now)
}

pub fn reviving(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    match engine.revive("a") {
        Err(EngineError::Unknown(_)) => {}
        other => return Err(outcome("reviving who lives", &other)),
    }
    let lease = claim(&*engine, "w")?;
    engine.fail(&lease, ErrorClass::Fatal, "bad input")?;
    engine.revive("a")?;
    let again = claim(&*engine, "w")?;
    expect("a higher fence", again.attempt > lease.attempt, true)?;
    match engine.fail(&again, ErrorClass::Retryable, "no luck")? {
        JobFate::Retry { .. } => Ok(()),
        other => Err(outcome("its attempts are not counted from 0 again", &other)),
    }
}
