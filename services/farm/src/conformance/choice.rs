//! Which job a worker is given.

use super::site::{ConformanceFailure, Site, claim, expect, job, nothing, offer};
use crate::engine::WorkerOffer;
use crate::job::{Job, Needs};
use std::collections::BTreeMap;

pub fn urgency(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    for (id, priority) in [("low", -1), ("first", 0), ("second", 0), ("high", 5)] {
        engine.publish(&Job { priority, ..job(id) })?;
    }
    for wanted in ["high", "first", "second", "low"] {
        expect("the next", claim(&*engine, "w")?.job.id.as_str(), wanted)?;
    }
    nothing(&*engine, "with every job taken")
}

pub fn fitting(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let large = Needs { cores: 8, memory_bytes: 100, accelerators: 0 };
    engine.publish(&Job { needs: large, priority: 9, ..job("large") })?;
    engine.publish(&job("small"))?;
    expect("what fits", claim(&*engine, "w")?.job.id.as_str(), "small")?;
    nothing(&*engine, "with only the large job left")?;
    let roomy = WorkerOffer { free: Needs { cores: 8, ..offer("w").free }, ..offer("roomy") };
    let given = engine.claim(&roomy)?;
    let lease = given.ok_or_else(|| ConformanceFailure::NothingGiven("a worker with the capacity".into()))?;
    expect("to the worker with the capacity", lease.job.id.as_str(), "large")
}

pub fn named_accelerator(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let wanted = |name: &str| Some(name.to_owned());
    engine.publish(&Job { accelerator: wanted("h100"), priority: 9, ..job("picky") })?;
    engine.publish(&job("any"))?;
    expect("without a name", claim(&*engine, "w")?.job.id.as_str(), "any")?;
    nothing(&*engine, "with only the picky one left")?;
    let other = WorkerOffer { accelerator: wanted("l4"), ..offer("other") };
    expect("with another one", engine.claim(&other)?, None)?;
    let given = site.engine().claim(&WorkerOffer { accelerator: wanted("h100"), ..offer("right") })?;
    expect("with the right one", given.map(|lease| lease.job.id).as_deref(), Some("picky"))
}

pub fn reserving_capacity(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let whole = Needs { accelerators: 2, ..offer("w").free };
    let with = |id: &str, priority, accelerators| {
        let needs = Needs { accelerators, ..job(id).needs };
        Job { priority, needs, ..job(id) }
    };
    for job in [with("both", 9, 2), with("one", 1, 1), with("none", 0, 0), with("too many", 99, 3)] {
        engine.publish(&job)?;
    }
    let claim = |accelerators| {
        let free = Needs { accelerators, ..whole };
        let lease = engine.claim(&WorkerOffer { free, whole, ..offer("w") })?;
        Ok::<_, ConformanceFailure>(lease.map(|lease| lease.job.id))
    };
    // One of two accelerators is free: it is kept for the job that needs both.
    expect("what needs none goes ahead", claim(1)?.as_deref(), Some("none"))?;
    expect("with one accelerator free", claim(1)?, None)?;
    expect("with both free", claim(2)?.as_deref(), Some("both"))?;
    // What this worker could never take holds nobody up.
    expect("with one free again", claim(1)?.as_deref(), Some("one"))
}

pub fn kept_by_one(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let whole = Needs { accelerators: 2, ..offer("w").free };
    let with = |id: &str, priority, accelerators| {
        let needs = Needs { accelerators, ..job(id).needs };
        Job { priority, needs, ..job(id) }
    };
    for job in [with("both", 9, 2), with("one", 1, 1), with("another", 1, 1)] {
        engine.publish(&job)?;
    }
    let claim = |worker: &str, accelerators| {
        let free = Needs { accelerators, ..whole };
        let lease = site.engine().claim(&WorkerOffer { free, whole, ..offer(worker) })?;
        Ok::<_, ConformanceFailure>(lease.map(|lease| lease.job.id))
    };
    expect("who keeps one accelerator free", claim("w", 1)?, None)?;
    expect("another worker", claim("v", 1)?.as_deref(), Some("one"))?;
    expect("who keeps it, still", claim("w", 1)?, None)?;
    // It fell silent: somebody else gets free for the job.
    site.pass(3600.0);
    expect("another worker, later", claim("v", 1)?, None)?;
    expect("who kept it before", claim("w", 1)?.as_deref(), Some("another"))?;
    expect("who is free", claim("v", 2)?.as_deref(), Some("both"))
}

pub fn one_worker_per_job(site: &dyn Site) -> Result<(), ConformanceFailure> {
    const JOBS: usize = 24;
    let engine = site.engine();
    for i in 0..JOBS {
        engine.publish(&job(&format!("job {i}")))?;
    }
    let taken = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..4)
            .map(|w| {
                scope.spawn(move || -> Result<Vec<String>, ConformanceFailure> {
                    let (engine, mut mine) = (site.engine(), Vec::new());
                    while let Some(lease) = engine.claim(&offer(&format!("w{w}")))? {
                        engine.complete(&lease, "done")?;
                        mine.push(lease.job.id);
                    }
                    Ok(mine)
                })
            })
            .collect();
        let joined = workers.into_iter().map(|w| w.join().unwrap_or(Err(ConformanceFailure::Panicked)));
        joined.collect::<Result<Vec<_>, _>>()
    })?;
    let mut counts = BTreeMap::new();
    for id in taken.into_iter().flatten() {
        *counts.entry(id).or_insert(0) += 1;
    }
    expect("jobs done", counts.len(), JOBS)?;
    expect("jobs done twice", counts.values().filter(|&&n| n != 1).count(), 0)
}
