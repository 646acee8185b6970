//! A farm most of whose workers are cut off by the network, again and again, ends in the bytes of one machine.

use super::error::FarmBenchError;
use super::network::CutNetwork;
use super::recovery::Strike;
use super::server::NatsProcess;
use super::small::{Children, FailureFigures, FarmSize, SmallFarm, clear, pause};
use segwild_farm::LEASE_S;
use segwild_scene::Random;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

/// The bounds of how long each cut lasts, in seconds: leases outlive the short ones, and end in the last one.
const CUTS: [(f32, f32); 4] =
    [(1.0, 5.0), (1.0, 5.0), (1.0, 5.0), (LEASE_S as f32 + 5.0, LEASE_S as f32 + 20.0)];

/// Measures; `None` where there is no server program, or this process may not make a network.
///
/// One worker is beside the server. The others are in a network of their own, and compute on while its link is down.
pub(super) fn cuts(
    program: &Path,
    server: &Path,
    dir: &Path,
    size: FarmSize,
) -> Result<Option<FailureFigures>, FarmBenchError> {
    let Some(network) = CutNetwork::new() else { return Ok(None) };
    clear(dir)?;
    let Some(queue) = NatsProcess::start(server, dir, network.address(), None)? else { return Ok(None) };
    let farm = SmallFarm::new(program, dir, size, queue.address("cuts"))?;
    let mut random = Random::new(0xc075);
    let folders: Vec<String> = (0..size.workers).map(|w| format!("w{w}")).collect();
    let mut workers = Children::default();
    for (w, folder) in folders.iter().enumerate() {
        let child = farm.worker(folder, (w > 0).then_some(&network))?;
        workers.0.push((folder.clone(), child));
    }
    let mut batch = Children(vec![("batch".into(), farm.batch()?)]);
    let (mut cut, mut strikes) = (0, Vec::new());
    let began = Instant::now();
    for (least, most) in CUTS {
        if !farm.waits_for_a_scene_of(&folders[1..], &mut batch.0[0].1)? {
            break;
        }
        pause(&mut random, 0.3, 2.0);
        strikes.push(Strike::now(farm.names(&folders[1..])));
        network.link(false)?;
        cut += 1;
        pause(&mut random, least, most);
        network.link(true)?;
    }
    farm.waits_for_the_end(&mut batch.0[0].1)?;
    let farm_s = began.elapsed().as_secs_f64();
    let failures = BTreeMap::from([("link".to_owned(), cut)]);
    farm.figures(failures, 0, &strikes, farm_s).map(Some)
}
