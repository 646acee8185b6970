//! A farm of small scenes on this machine, whose parts are made to fail, and what became of it.

use super::error::{FarmBenchError, io_error};
use super::network::CutNetwork;
use super::recovery::{Strike, recoveries};
use segwild_farm::{ChangeKind, FarmAccess, JobEngine, JobState, NatsEngine};
use segwild_flow::files;
use segwild_scene::Random;
use segwild_synthetic::{LightVariation, SyntheticOptions, generate};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// What must not depend on what happened to a scene.
const FILES: [&str; 5] = ["model.bin", "features.bin", "scene.ply", "history.jsonl", "evaluation.json"];
/// A farm that is not done by then is stuck.
const LONGEST: Duration = Duration::from_secs(3600);
/// How long a server may take to answer.
const PATIENCE: Duration = Duration::from_secs(30);

/// The hashes of these files of a scene; `None` for one that is not there.
type ResultHashes = BTreeMap<&'static str, Option<blake3::Hash>>;

/// How large a farm is.
#[derive(Clone, Copy)]
pub(super) struct FarmSize {
    pub scenes: usize,
    pub workers: usize,
}

/// What failures did to a farm.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FailureFigures {
    /// Scenes of the farm.
    pub scenes: usize,
    /// Its workers.
    pub workers: usize,
    /// How often each of its parts failed.
    pub failures: BTreeMap<String, usize>,
    /// Machines that did not come back.
    pub machines_lost: usize,
    /// Scenes that were never completed.
    pub lost: usize,
    /// Scenes whose result differs from one machine's in any byte.
    pub differing: usize,
    /// Scenes that were completed more than once.
    pub completed_twice: usize,
    /// Scenes that were taken in all.
    pub taken: u64,
    /// How long each interrupted scene waited, from the failure of its worker until one took it again, in seconds, the shortest
    /// first.
    pub recoveries_s: Vec<f64>,
    /// How long the farm took, in seconds.
    pub farm_s: f64,
    /// How long one scene took on one machine, in seconds.
    pub alone_s: f64,
}

impl FailureFigures {
    /// Scenes that were lost, differ or were completed twice.
    pub fn wrong(&self) -> usize {
        self.lost + self.differing + self.completed_twice
    }

    /// The middle and the longest recovery, in seconds; `None` where no scene was interrupted.
    pub fn recovery_s(&self) -> Option<(f64, f64)> {
        Some((*self.recoveries_s.get(self.recoveries_s.len() / 2)?, *self.recoveries_s.last()?))
    }
}

/// Children that do not outlive the benchmark, with the folders that they work in.
#[derive(Default)]
pub(super) struct Children(pub Vec<(String, Child)>);

impl Drop for Children {
    fn drop(&mut self) {
        self.0.iter_mut().for_each(|(_, child)| end(child));
    }
}

/// Ends a process at once.
pub(super) fn end(child: &mut Child) {
    // One that has ended by itself is as good.
    let _ = child.kill();
    let _ = child.wait();
}

pub(super) fn pause(random: &mut Random, least: f32, most: f32) {
    std::thread::park_timeout(Duration::from_secs_f32(least + (most - least) * random.uniform()));
}

/// A folder with nothing in it.
pub(super) fn clear(dir: &Path) -> Result<(), FarmBenchError> {
    if dir.exists() {
        std::fs::remove_dir_all(dir).map_err(io_error(dir))?;
    }
    std::fs::create_dir_all(dir).map_err(io_error(dir))
}

/// A farm of small scenes.
pub(super) struct SmallFarm<'a> {
    program: &'a Path,
    dir: &'a Path,
    size: FarmSize,
    address: String,
    manifest: PathBuf,
    /// What one machine makes of a scene, and how long it takes, in seconds.
    reference: ResultHashes,
    alone_s: f64,
}

impl<'a> SmallFarm<'a> {
    /// Makes the scene, and runs it on one machine.
    pub fn new(
        program: &'a Path,
        dir: &'a Path,
        size: FarmSize,
        address: String,
    ) -> Result<SmallFarm<'a>, FarmBenchError> {
        let options = SyntheticOptions {
            train: 10,
            test: 1,
            long_side: 128,
            points: 800,
            occlusion: 0.0,
            photo_light: LightVariation::Affine,
            ..SyntheticOptions::small()
        };
        let made = generate(&options).and_then(|made| made.write(&dir.join("scene")));
        made.map_err(|e| FarmBenchError::Scene(e.to_string()))?;
        let manifest = |scenes: usize| {
            let settings = "preset = \"draft\", appearance_model = \"affine\", size = 128, steps = 200, \
                            refine_steps = 20, prompt_budget = 24, checkpoint_every = 1";
            let scenes = (0..scenes).map(|i| format!("[[scene]]\npath = \"scene\"\nname = \"s{i:02}\"\n"));
            format!("[budget]\ncores = 1\n[defaults]\nattempts = 9\nsettings = {{ {settings} }}\n")
                + &scenes.collect::<String>()
        };
        let [one, all] = ["one.toml", "all.toml"].map(|name| dir.join(name));
        files::write_plain(&one, manifest(1)).map_err(io_error(dir))?;
        files::write_plain(&all, manifest(size.scenes)).map_err(io_error(dir))?;
        let began = Instant::now();
        let mut alone = Command::new(program);
        alone.arg("batch").arg(&one).arg("--out").arg(dir.join("one"));
        let ended = quiet(&mut alone).status().map_err(io_error(dir))?;
        if !ended.success() {
            return Err(FarmBenchError::Scene(format!("one scene on one machine ended with {ended}")));
        }
        let reference = results(&dir.join("one/s00"));
        let alone_s = began.elapsed().as_secs_f64();
        Ok(SmallFarm { program, dir, size, address, manifest: all, reference, alone_s })
    }

    /// Starts a worker with a folder, in a network of its own where one is given.
    pub fn worker(&self, folder: &str, network: Option<&CutNetwork>) -> Result<Child, FarmBenchError> {
        let alone = || Command::new(self.program);
        let mut command = network.map_or_else(alone, |network| network.command(self.program));
        command.args(["worker", "--farm", &self.address, "--needs", "cores=1,memory=2"]);
        command.args(["--store-every", "2", "--work"]).arg(self.dir.join(folder));
        quiet(&mut command).spawn().map_err(io_error(self.dir))
    }

    /// Starts who hands the scenes in, watches and fetches the results.
    pub fn batch(&self) -> Result<Child, FarmBenchError> {
        let mut command = Command::new(self.program);
        command.arg("batch").arg(&self.manifest).arg("--out").arg(self.dir.join("night"));
        quiet(command.args(["--farm", &self.address])).spawn().map_err(io_error(self.dir))
    }

    /// The names of the workers of these folders, as far as they have one yet.
    pub fn names(&self, folders: &[String]) -> Vec<String> {
        let name = |folder: &String| std::fs::read_to_string(self.dir.join(folder).join("worker.id")).ok();
        folders.iter().filter_map(name).map(|name| name.trim().to_owned()).collect()
    }

    fn engine(&self) -> Result<NatsEngine, FarmBenchError> {
        Ok(NatsEngine::connect(&self.address.parse()?, &FarmAccess::default(), "bench", PATIENCE)?)
    }

    /// Waits until one of the workers of these folders has a scene; `false` where the batch ends first.
    pub fn waits_for_a_scene_of(
        &self,
        folders: &[String],
        batch: &mut Child,
    ) -> Result<bool, FarmBenchError> {
        let (engine, began) = (self.engine()?, Instant::now());
        while began.elapsed() < LONGEST {
            let names = self.names(folders);
            let has = |worker: Option<&String>| worker.is_some_and(|worker| names.contains(worker));
            let jobs = engine.jobs()?;
            if jobs.iter().any(|job| job.state == JobState::Leased && has(job.worker.as_ref())) {
                return Ok(true);
            }
            if batch.try_wait().map_err(io_error(self.dir))?.is_some() {
                return Ok(false);
            }
            std::thread::park_timeout(Duration::from_millis(100));
        }
        Err(FarmBenchError::Stuck)
    }

    /// Waits until the batch ends, and refuses one that does not end well.
    pub fn waits_for_the_end(&self, batch: &mut Child) -> Result<(), FarmBenchError> {
        let began = Instant::now();
        while began.elapsed() < LONGEST {
            match batch.try_wait().map_err(io_error(self.dir))? {
                Some(ended) if ended.success() => return Ok(()),
                Some(ended) => return Err(FarmBenchError::Scene(format!("the batch ended with {ended}"))),
                None => std::thread::park_timeout(Duration::from_millis(100)),
            }
        }
        Err(FarmBenchError::Stuck)
    }

    /// What became of the scenes.
    pub fn figures(
        &self,
        failures: BTreeMap<String, usize>,
        machines_lost: usize,
        strikes: &[Strike],
        farm_s: f64,
    ) -> Result<FailureFigures, FarmBenchError> {
        let FarmSize { scenes, workers } = self.size;
        let differs = |i: &usize| results(&self.dir.join(format!("night/s{i:02}"))) != self.reference;
        let engine = self.engine()?;
        let changes = engine.watch(0, usize::MAX)?;
        let mut completed = BTreeMap::<&str, usize>::new();
        for change in changes.iter().filter(|change| change.kind == ChangeKind::Completed) {
            *completed.entry(&change.job).or_default() += 1;
        }
        let mut recoveries_s = recoveries(&changes, strikes);
        recoveries_s.sort_by(f64::total_cmp);
        Ok(FailureFigures {
            scenes,
            workers,
            failures,
            machines_lost,
            lost: scenes.saturating_sub(completed.len()),
            differing: (0..scenes).filter(differs).count(),
            completed_twice: completed.values().filter(|times| **times > 1).count(),
            taken: engine.count(ChangeKind::Claimed)?,
            recoveries_s,
            farm_s,
            alone_s: self.alone_s,
        })
    }
}

fn quiet(command: &mut Command) -> &mut Command {
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null())
}

/// The hash of everything that must not depend on what happened.
fn results(run: &Path) -> ResultHashes {
    let hash = |name: &'static str| (name, std::fs::read(run.join(name)).ok().map(|b| blake3::hash(&b)));
    FILES.into_iter().map(hash).collect()
}
