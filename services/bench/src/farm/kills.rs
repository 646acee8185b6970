//! A farm whose workers, server and batch are killed at random moments ends in the bytes of one machine.

use super::error::FarmBenchError;
use super::recovery::Strike;
use super::server::{LOCAL, NatsProcess};
use super::small::{Children, FailureFigures, FarmSize, SmallFarm, clear, end, pause};
use segwild_scene::Random;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

/// What is killed.
const VICTIMS: [&str; 3] = ["worker", "server", "batch"];
/// After every so many killed workers, one does not come back with its folder: its machine is lost.
const LOST_EVERY: usize = 12;

/// Measures; `None` where there is no server program.
pub(super) fn kills(
    program: &Path,
    server: &Path,
    dir: &Path,
    size: FarmSize,
    kills: usize,
) -> Result<Option<FailureFigures>, FarmBenchError> {
    clear(dir)?;
    let Some(mut queue) = NatsProcess::start(server, dir, LOCAL, None)? else { return Ok(None) };
    let farm = SmallFarm::new(program, dir, size, queue.address("kills"))?;
    let mut random = Random::new(0x5e97);
    let mut workers = Children::default();
    for w in 0..size.workers {
        let folder = format!("w{w}");
        let child = farm.worker(&folder, None)?;
        workers.0.push((folder, child));
    }
    let mut batch = Children(vec![("batch".into(), farm.batch()?)]);
    let (mut killed, mut machines_lost, mut strikes) = (BTreeMap::<String, usize>::new(), 0, Vec::new());
    let began = Instant::now();
    for _ in 0..kills {
        pause(&mut random, 0.3, 2.0);
        // Most of a farm are workers.
        let victim = VICTIMS[[0, 0, 0, 0, 1, 2][random.below(6)]];
        *killed.entry(victim.to_owned()).or_default() += 1;
        match victim {
            "server" => {
                queue.kill();
                pause(&mut random, 0.0, 2.0);
                let port = Some(queue.port());
                queue = NatsProcess::start(server, dir, LOCAL, port)?.ok_or(FarmBenchError::Stuck)?;
            }
            "batch" => {
                end(&mut batch.0[0].1);
                batch.0[0].1 = farm.batch()?;
            }
            _ => {
                let (folder, child) = &mut workers.0[random.below(size.workers)];
                strikes.push(Strike::now(farm.names(std::slice::from_ref(folder))));
                end(child);
                pause(&mut random, 0.0, 1.0);
                if killed["worker"].is_multiple_of(LOST_EVERY) {
                    machines_lost += 1;
                    *folder = format!("w{}", size.workers + machines_lost);
                }
                *child = farm.worker(folder, None)?;
            }
        }
    }
    farm.waits_for_the_end(&mut batch.0[0].1)?;
    let farm_s = began.elapsed().as_secs_f64();
    farm.figures(killed, machines_lost, &strikes, farm_s).map(Some)
}
