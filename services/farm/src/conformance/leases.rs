//! Who holds a job: heartbeats, silence, zombies, late and double completions.

use super::site::{ConformanceFailure, JUMPS_S, LEASE_S, REST_S, Site, claim, expect, job, lost, nothing};
use crate::engine::{ChangeKind, Completed, ErrorClass, JobEngine, JobLease};

pub fn heartbeat_holds(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    let lease = claim(&*engine, "w")?;
    for _ in 0..4 {
        site.pass(LEASE_S * 0.6);
        nothing(&*site.engine(), "while its worker beats")?;
        engine.heartbeat(&lease)?;
    }
    expect("completing it", engine.complete(&lease, "done")?, Completed::Now)
}

/// Publishes a job, lets a worker take it and fall silent, and another one take over.
fn taken_over(site: &dyn Site, engine: &dyn JobEngine) -> Result<(JobLease, JobLease), ConformanceFailure> {
    engine.publish(&job("a"))?;
    let zombie = claim(engine, "zombie")?;
    nothing(engine, "before the lease ends")?;
    site.pass(LEASE_S * 1.5);
    // Whoever looks first notices; the job then rests as after any failure.
    nothing(engine, "during the rest after a lost lease")?;
    site.pass(REST_S * 1.5);
    Ok((zombie, claim(&*site.engine(), "heir")?))
}

pub fn silence(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let (zombie, heir) = taken_over(site, &*engine)?;
    expect("the same job", &heir.job.id, &zombie.job.id)?;
    expect("a higher fence", heir.attempt > zombie.attempt, true)?;
    let changes = engine.watch(0, usize::MAX)?;
    expect("it is reported", changes.iter().any(|c| c.kind == ChangeKind::Expired), true)
}

pub fn zombie(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let (zombie, heir) = taken_over(site, &*engine)?;
    lost("a zombie's heartbeat", engine.heartbeat(&zombie))?;
    lost("a zombie's completion", engine.complete(&zombie, "stale"))?;
    lost("a zombie's failure", engine.fail(&zombie, ErrorClass::Fatal, "stale"))?;
    expect("the heir completes", engine.complete(&heir, "fresh")?, Completed::Now)?;
    lost("a zombie's completion after the end", engine.complete(&zombie, "stale"))?;
    let jobs = engine.jobs()?;
    expect("the outcome", jobs[0].outcome.as_deref(), Some("fresh"))
}

pub fn late_completion(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    let lease = claim(&*engine, "w")?;
    site.pass(LEASE_S * 1.5);
    expect("completing late", engine.complete(&lease, "done")?, Completed::Now)?;
    nothing(&*engine, "after that")
}

pub fn completing_twice(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    let lease = claim(&*engine, "w")?;
    expect("the first time", engine.complete(&lease, "done")?, Completed::Now)?;
    expect("the second time", site.engine().complete(&lease, "done")?, Completed::Before)?;
    lost("another outcome", engine.complete(&lease, "something else"))?;
    lost("a failure after the end", engine.fail(&lease, ErrorClass::Retryable, "late"))?;
    let changes = engine.watch(0, usize::MAX)?;
    expect("completions reported", changes.iter().filter(|c| c.kind == ChangeKind::Completed).count(), 1)
}

pub fn lease_under_jumps(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    for (id, jump) in ["a", "b"].into_iter().zip(JUMPS_S) {
        engine.publish(&job(id))?;
        let lease = claim(&*engine, "w")?;
        site.jump(jump);
        nothing(&*site.engine(), &format!("while its worker holds it, after a jump of {jump} s"))?;
        engine.heartbeat(&lease)?;
        site.jump(jump);
        site.pass(LEASE_S * 1.5);
        nothing(&*engine, "as the lease ends")?;
        site.pass(REST_S * 1.5);
        let heir = claim(&*engine, "heir")?;
        expect("a silent worker has lost it", heir.attempt > lease.attempt, true)?;
        engine.complete(&heir, "done")?;
    }
    Ok(())
}

pub fn releasing(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    for id in ["a", "b"] {
        engine.publish(&job(id))?;
    }
    let (mine, other) = (claim(&*engine, "w")?, claim(&*engine, "v")?);
    engine.note_wait(&mine, Some("its folder is in use"))?;
    expect("what waits", site.engine().waits()?.into_keys().collect::<Vec<_>>(), vec!["a".to_owned()])?;
    expect("how many", engine.release(Some("w"), "started again")?, 1)?;
    expect("what waits after that", engine.waits()?.len(), 0)?;
    lost("what was handed back", engine.complete(&mine, "stale"))?;
    let again = claim(&*engine, "w")?;
    expect("no attempt is counted", (again.job.id.as_str(), again.failures), ("a", 0))?;
    expect("the other one's", engine.complete(&other, "done")?, Completed::Now)
}
