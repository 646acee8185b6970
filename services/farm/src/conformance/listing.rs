//! The list of jobs: publishing, withdrawing, checkpoints, changes.

use super::site::{ConformanceFailure, Site, claim, expect, job, lost, nothing, outcome};
use crate::engine::{ChangeKind, Completed, EngineError, ErrorClass, Published};
use crate::job::Job;

pub fn publishing_twice(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    expect("the first time", engine.publish(&job("a"))?, Published::New)?;
    expect("the second time", site.engine().publish(&job("a"))?, Published::Known)?;
    let lease = claim(&*engine, "w")?;
    expect("while it is worked on", engine.publish(&job("a"))?, Published::Known)?;
    engine.complete(&lease, "done")?;
    expect("when it is done", engine.publish(&job("a"))?, Published::Known)?;
    nothing(&*engine, "done and published again")?;
    expect("jobs", engine.jobs()?.len(), 1)
}

pub fn another_payload(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    let changed = Job { payload: "do it differently".into(), ..job("a") };
    let lease = claim(&*engine, "w")?;
    match engine.publish(&changed) {
        Err(EngineError::InProgress(_)) => {}
        other => return Err(outcome("changing it under a worker's hands", &other)),
    }
    engine.complete(&lease, "done")?;
    expect("when it is done", engine.publish(&changed)?, Published::Changed)?;
    let again = claim(&*engine, "w")?;
    expect("the payload", again.job.payload.as_str(), "do it differently")?;
    expect("a higher fence", again.attempt > lease.attempt, true)
}

pub fn withdrawing(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    for id in ["a", "b"] {
        engine.publish(&job(id))?;
    }
    let lease = claim(&*engine, "w")?;
    let all = ["a", "b", "unknown"].map(str::to_owned);
    expect("how many", engine.withdraw(&all)?, 1)?;
    expect("completing the other", engine.complete(&lease, "done")?, Completed::Now)?;
    nothing(&*engine, "withdrawn")?;
    expect("later", site.engine().withdraw(&all)?, 1)?;
    expect("jobs", engine.jobs()?.len(), 0)?;
    expect("published again", engine.publish(&job("a"))?, Published::New)
}

pub fn checkpoints(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    let first = claim(&*engine, "w")?;
    engine.checkpoint(&first, "half of it")?;
    engine.fail(&first, ErrorClass::Stopped, "stopped")?;
    lost("a zombie's checkpoint", engine.checkpoint(&first, "stale"))?;
    let heir = claim(&*site.engine(), "heir")?;
    let stored = || -> Result<Option<String>, ConformanceFailure> { Ok(engine.jobs()?.remove(0).checkpoint) };
    expect("what the heir finds", stored()?.as_deref(), Some("half of it"))?;
    engine.complete(&heir, "done")?;
    engine.publish(&Job { payload: "do it differently".into(), ..job("a") })?;
    expect("of another payload", stored()?, None)
}

pub fn watching(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    let lease = claim(&*engine, "w")?;
    engine.complete(&lease, "done")?;
    let changes = site.engine().watch(0, usize::MAX)?;
    let kinds: Vec<_> = changes.iter().map(|c| c.kind).collect();
    expect(
        "what is reported",
        kinds,
        vec![ChangeKind::Published, ChangeKind::Claimed, ChangeKind::Completed],
    )?;
    expect("in order", changes.windows(2).all(|w| w[0].revision < w[1].revision), true)?;
    let rest = engine.watch(changes[0].revision, usize::MAX)?;
    expect("from a revision on", &rest[..], &changes[1..])?;
    expect("at most so many", engine.watch(0, 1)?.len(), 1)?;
    expect("nothing new", engine.watch(changes[2].revision, usize::MAX)?.len(), 0)
}
