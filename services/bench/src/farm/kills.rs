//! A farm whose workers, server and batch are killed at random moments ends in the bytes of one machine.

use super::error::FarmBenchError;
use super::server::NatsProcess;
use segwild_farm::{ChangeKind, FarmAccess, JobEngine, NatsEngine};
use segwild_flow::files;
use segwild_scene::Random;
use segwild_synthetic::{LightVariation, SyntheticOptions, generate};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// What is killed.
const VICTIMS: [&str; 3] = ["worker", "server", "batch"];
/// What must not depend on what happened to a scene.
const FILES: [&str; 5] = ["model.bin", "features.bin", "scene.ply", "history.jsonl", "evaluation.json"];
/// After every so many killed workers, one does not come back with its folder: its machine is lost.
const LOST_EVERY: usize = 12;
/// A farm that is not done by then is stuck.
const LONGEST: Duration = Duration::from_secs(3600);
/// How long a server may take to answer, at the end.
const PATIENCE: Duration = Duration::from_secs(30);

/// How large the farm is whose parts are killed.
#[derive(Clone, Copy)]
pub(super) struct FarmSize {
    pub scenes: usize,
    pub workers: usize,
}

/// What kills did to a farm.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct KillFigures {
    /// Scenes of the farm.
    pub scenes: usize,
    /// Its workers.
    pub workers: usize,
    /// How often each of worker, server and batch was killed.
    pub killed: BTreeMap<String, usize>,
    /// Machines that did not come back.
    pub machines_lost: usize,
    /// Scenes whose result differs from one machine's in any byte.
    pub differing: usize,
    /// Scenes that were completed more than once.
    pub completed_twice: usize,
    /// Scenes that were taken in all.
    pub taken: u64,
    /// How long the farm took, in seconds.
    pub farm_s: f64,
    /// How long one scene took on one machine, in seconds.
    pub alone_s: f64,
}

/// What the farm consists of.
struct KilledFarm<'a> {
    program: &'a Path,
    dir: PathBuf,
    address: String,
    manifest: PathBuf,
}

impl KilledFarm<'_> {
    fn worker(&self, folder: &str) -> std::io::Result<Child> {
        let mut command = Command::new(self.program);
        command.args(["worker", "--farm", &self.address, "--needs", "cores=1,memory=2"]);
        command.args(["--store-every", "2", "--work"]).arg(self.dir.join(folder));
        quiet(&mut command).spawn()
    }

    fn batch(&self) -> std::io::Result<Child> {
        let mut command = Command::new(self.program);
        command.arg("batch").arg(&self.manifest).arg("--out").arg(self.dir.join("night"));
        quiet(command.args(["--farm", &self.address])).spawn()
    }
}

fn quiet(command: &mut Command) -> &mut Command {
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null())
}

/// Children that do not outlive the benchmark.
struct Children(Vec<(String, Child)>);

impl Drop for Children {
    fn drop(&mut self) {
        for (_, child) in &mut self.0 {
            // One that has ended by itself is as good.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Measures; `None` where there is no server program.
pub(super) fn kills(
    program: &Path,
    server: &Path,
    dir: &Path,
    farm: FarmSize,
    kills: usize,
) -> Result<Option<KillFigures>, FarmBenchError> {
    let io = |source| FarmBenchError::Io { path: dir.to_owned(), source };
    if dir.exists() {
        std::fs::remove_dir_all(dir).map_err(io)?;
    }
    std::fs::create_dir_all(dir).map_err(io)?;
    let Some(mut queue) = NatsProcess::start(server, dir, None)? else { return Ok(None) };
    let options = SyntheticOptions {
        train: 10,
        test: 1,
        long_side: 128,
        points: 800,
        occlusion: 0.0,
        photo_light: LightVariation::Affine,
        ..SyntheticOptions::small()
    };
    let scene = dir.join("scene");
    let made = generate(&options).and_then(|made| made.write(&scene));
    made.map_err(|e| FarmBenchError::Scene(e.to_string()))?;
    let manifest = |scenes: usize| {
        let settings = "preset = \"draft\", appearance_model = \"affine\", size = 128, steps = 200, \
                        refine_steps = 20, prompt_budget = 24, checkpoint_every = 1";
        let scenes = (0..scenes).map(|i| format!("[[scene]]\npath = \"scene\"\nname = \"s{i:02}\"\n"));
        format!("[budget]\ncores = 1\n[defaults]\nattempts = 9\nsettings = {{ {settings} }}\n")
            + &scenes.collect::<String>()
    };
    let [one, all] = ["one.toml", "all.toml"].map(|name| dir.join(name));
    files::write_plain(&one, manifest(1)).map_err(io)?;
    files::write_plain(&all, manifest(farm.scenes)).map_err(io)?;
    let began = Instant::now();
    let mut alone = Command::new(program);
    let alone = quiet(alone.arg("batch").arg(&one).arg("--out").arg(dir.join("one"))).status().map_err(io)?;
    if !alone.success() {
        return Err(FarmBenchError::Scene(format!("one scene on one machine ended with {alone}")));
    }
    let reference = results(&dir.join("one/s00"));
    let alone_s = began.elapsed().as_secs_f64();

    let address = queue.address("kills");
    let site = KilledFarm { program, dir: dir.to_owned(), address, manifest: all };
    let mut random = Random::new(0x5e97);
    let mut workers = Children(Vec::new());
    for w in 0..farm.workers {
        let folder = format!("w{w}");
        workers.0.push((folder.clone(), site.worker(&folder).map_err(io)?));
    }
    let mut batch = Children(vec![("batch".into(), site.batch().map_err(io)?)]);
    let (mut killed, mut machines_lost, mut ends) = (BTreeMap::<String, usize>::new(), 0, None);
    let began = Instant::now();
    while ends.is_none() {
        if began.elapsed() > LONGEST {
            return Err(FarmBenchError::Stuck);
        }
        pause(&mut random, 0.3, 2.0);
        let count: usize = killed.values().sum();
        if count >= kills {
            ends = batch.0[0].1.try_wait().map_err(io)?;
            continue;
        }
        // Most of a farm are workers.
        let victim = VICTIMS[[0, 0, 0, 0, 1, 2][random.below(6)]];
        *killed.entry(victim.to_owned()).or_default() += 1;
        match victim {
            "server" => {
                queue.kill();
                pause(&mut random, 0.0, 2.0);
                queue = NatsProcess::start(server, dir, Some(queue.port()))?.ok_or(FarmBenchError::Stuck)?;
            }
            "batch" => {
                end(&mut batch.0[0].1);
                batch.0[0].1 = site.batch().map_err(io)?;
            }
            _ => {
                let (folder, child) = &mut workers.0[random.below(farm.workers)];
                end(child);
                pause(&mut random, 0.0, 1.0);
                if killed["worker"].is_multiple_of(LOST_EVERY) {
                    machines_lost += 1;
                    *folder = format!("w{}", farm.workers + machines_lost);
                }
                *child = site.worker(folder).map_err(io)?;
            }
        }
    }
    let farm_s = began.elapsed().as_secs_f64();
    if !ends.is_some_and(|status| status.success()) {
        return Err(FarmBenchError::Scene(format!("the batch ended with {ends:?}")));
    }
    let differs = |i: &usize| results(&dir.join(format!("night/s{i:02}"))) != reference;
    let differing = (0..farm.scenes).filter(differs).count();
    let engine = NatsEngine::connect(&site.address.parse()?, &FarmAccess::default(), "bench", PATIENCE)?;
    let mut completed = BTreeMap::<String, usize>::new();
    for change in engine.watch(0, usize::MAX)?.into_iter().filter(|c| c.kind == ChangeKind::Completed) {
        *completed.entry(change.job).or_default() += 1;
    }
    let completed_twice = completed.values().filter(|n| **n > 1).count();
    let taken = engine.count(ChangeKind::Claimed)?;
    let FarmSize { scenes, workers } = farm;
    Ok(Some(KillFigures {
        scenes,
        workers,
        killed,
        machines_lost,
        differing,
        completed_twice,
        taken,
        farm_s,
        alone_s,
    }))
}

fn end(child: &mut Child) {
    // One that has ended by itself is as good.
    let _ = child.kill();
    let _ = child.wait();
}

fn pause(random: &mut Random, least: f32, most: f32) {
    std::thread::park_timeout(Duration::from_secs_f32(least + (most - least) * random.uniform()));
}

/// The hash of everything that must not depend on what happened.
fn results(run: &Path) -> BTreeMap<&'static str, Option<blake3::Hash>> {
    let hash = |name: &'static str| (name, std::fs::read(run.join(name)).ok().map(|b| blake3::hash(&b)));
    FILES.into_iter().map(hash).collect()
}
