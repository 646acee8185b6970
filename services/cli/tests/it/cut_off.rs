//! A worker that the network cuts off: another one continues its scene, and it goes on when the network is back.
#![cfg(target_os = "linux")]

use crate::common::*;
use crate::farm::nats_server::NatsServer;
use crate::farm::{batch, engine, log, manifest, worker, worker_by};
use segwild_bench::farm::CutNetwork;
use segwild_farm::{ChangeKind, JobEngine, JobState};
use std::path::Path;

/// A worker in a network of its own.
fn worker_in(network: &CutNetwork, dir: &Path, farm: &str, name: &str) -> Guarded {
    worker_by(network.command(Path::new(env!("CARGO_BIN_EXE_segwild"))), dir, farm, name, &[])
}

#[test]
fn a_worker_that_is_cut_off_loses_its_scene_to_another_and_goes_on_when_the_network_is_back() {
    let dir = folder();
    let path = dir.path();
    let Some(network) = CutNetwork::new() else {
        eprintln!(
            "skipped: a_worker_that_is_cut_off_loses_its_scene_to_another_and_goes_on_when_the_network_is_back: \
             no network namespace can be made here (that takes root, and `ip`: apt-get install iproute2)"
        );
        return;
    };
    let Some(server) = NatsServer::start_with(path, network.address(), &[]) else { return };
    let farm = server.farm("f");
    let jobs = engine(&farm);
    let watching = batch(path, &farm, &manifest(path, &["a"]), &[]);
    let _first = worker_in(&network, path, &farm, "first");
    until("a stored state", || log(path, "first").contains("is stored").then_some(()));
    network.link(false).expect("the link goes down");
    // Its process computes on, and its worker reaches nobody. The lease ends, and a moment later another may take the scene.
    jobs.pass(70.0).expect("the server answers");
    let second = worker(path, &farm, "second", &[]);
    let count = |kind: ChangeKind| jobs.count(kind).expect("the server answers");
    until("the end of the lease", || (count(ChangeKind::Expired) == 1).then_some(()));
    jobs.pass(10.0).expect("the server answers");
    until("the scene on another worker", || log(path, "second").contains("night/a begins").then_some(()));
    network.link(true).expect("the link goes up");
    let ended = watching.wait_with_output().expect("it ends");
    let logs = || format!("-- first\n{}\n-- second\n{}", log(path, "first"), log(path, "second"));
    assert_eq!(ended.status.code(), Some(0), "{}\n{}", text(&ended.stderr), logs());
    same_as_untouched(&path.join("night/a"));
    assert!(log(path, "second").contains("to continue what another attempt stored"), "{}", logs());
    // Both may have come to the end of the scene: one end counts.
    assert!(!log(path, "first").contains("night/a done"), "{}", logs());
    assert_eq!((count(ChangeKind::Expired), count(ChangeKind::Completed)), (1, 1), "{}", logs());
    let job = jobs.jobs().expect("the server answers").remove(0);
    assert_eq!((job.state, job.attempt, job.failures), (JobState::Done, 2, 1), "{job:?}");
    // The one that was cut off has left the scene, and takes the next.
    drop(second);
    let handed = batch(path, &farm, &manifest(path, &["a", "b"]), &["--no-wait"]);
    let handed = handed.wait_with_output().expect("it ends");
    assert!(handed.status.success(), "{}", text(&handed.stderr));
    until("the next scene", || log(path, "first").contains("night/b begins").then_some(()));
    assert_eq!(count(ChangeKind::Completed), 1, "{}", logs());
}
