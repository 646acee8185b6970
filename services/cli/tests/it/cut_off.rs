//! A worker that the network cuts off: another one continues its scene, and it goes on when the network is back.
#![cfg(target_os = "linux")]

use crate::common::*;
use crate::farm::nats_server::NatsServer;
use crate::farm::{batch, engine, log, manifest, worker, worker_by};
use segwild_farm::{ChangeKind, JobEngine, JobState};
use std::path::Path;
use std::process::Command;

/// A network of its own, with a link to this machine's; removed when dropped.
struct Network {
    name: String,
    /// The ends of the link.
    outside: String,
    inside: String,
    /// The address of the outer end.
    address: String,
}

fn ip(args: &[&str]) -> bool {
    Command::new("ip").args(args).output().is_ok_and(|output| output.status.success())
}

impl Network {
    /// `None` where this process may not make one.
    fn new() -> Option<Network> {
        let id = std::process::id();
        let net = format!("10.{}.{}", 200 + (id >> 8) % 50, id % 256);
        let network = Network {
            name: format!("segwild-{id}"),
            outside: format!("sw{id}o"),
            inside: format!("sw{id}i"),
            address: format!("{net}.1"),
        };
        let Network { name, outside, inside, address } = &network;
        let (outer, inner) = (format!("{address}/30"), format!("{net}.2/30"));
        let made = ip(&["netns", "add", name])
            && ip(&["link", "add", outside, "type", "veth", "peer", "name", inside])
            && ip(&["link", "set", inside, "netns", name])
            && ip(&["addr", "add", &outer, "dev", outside])
            && ip(&["link", "set", outside, "up"])
            && ip(&["-n", name, "addr", "add", &inner, "dev", inside])
            && ip(&["-n", name, "link", "set", inside, "up"]);
        made.then_some(network)
    }

    /// A worker in it.
    fn worker(&self, dir: &Path, farm: &str, name: &str) -> Guarded {
        let mut program = Command::new("ip");
        program.args(["netns", "exec", &self.name, env!("CARGO_BIN_EXE_segwild")]);
        worker_by(program, dir, farm, name, &[])
    }

    /// Cuts or heals its link: nobody on either side closes a connection.
    fn link(&self, state: &str) {
        assert!(ip(&["-n", &self.name, "link", "set", &self.inside, state]), "the link goes {state}");
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        // Its end goes with the other one.
        let _ = ip(&["link", "del", &self.outside]);
        let _ = ip(&["netns", "del", &self.name]);
    }
}

#[test]
fn a_worker_that_is_cut_off_loses_its_scene_to_another_and_goes_on_when_the_network_is_back() {
    let dir = folder();
    let path = dir.path();
    let Some(network) = Network::new() else {
        eprintln!(
            "skipped: a_worker_that_is_cut_off_loses_its_scene_to_another_and_goes_on_when_the_network_is_back: \
             no network namespace can be made here (that takes root, and `ip`: apt-get install iproute2)"
        );
        return;
    };
    let Some(server) = NatsServer::start_with(path, &network.address, &[]) else { return };
    let farm = server.farm("f");
    let jobs = engine(&farm);
    let watching = batch(path, &farm, &manifest(path, &["a"]), &[]);
    let _first = network.worker(path, &farm, "first");
    until("a stored state", || log(path, "first").contains("is stored").then_some(()));
    network.link("down");
    // Its process computes on, and its worker reaches nobody. The lease ends, and a moment later another may take the scene.
    jobs.pass(70.0).expect("the server answers");
    let second = worker(path, &farm, "second", &[]);
    let count = |kind: ChangeKind| jobs.count(kind).expect("the server answers");
    until("the end of the lease", || (count(ChangeKind::Expired) == 1).then_some(()));
    jobs.pass(10.0).expect("the server answers");
    until("the scene on another worker", || log(path, "second").contains("night/a begins").then_some(()));
    network.link("up");
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
