//! The chart: accuracy against time and memory, one setting varied at a time around a default.
//!
//! Every point is trained from nothing in a process of its own, once per seed, and kept in `results.json` as soon as it
//! is known: a second start goes on where the first one stopped.

mod page;
mod points;
mod sweeps;

pub use page::{ChartPage, write};
pub use points::DefaultVerdict;
pub use sweeps::{DEFAULT, SWEEPS, Sweep};

use crate::harm::Harm;
use crate::page::{PageError, io};
use crate::point::{self, PhotoSource, PointError, PointJob, Prompting};
use crate::scale::kernels::pace;
use points::PACE;
use segwild_eval::oracle::OracleOptions;
use segwild_eval::record::{Provenance, Record, Results};
use segwild_eval::trial::ProviderKind;
use segwild_flow::files;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The protocol under which points are recorded.
pub const PROTOCOL: &str = "chart";

/// What to chart.
#[derive(Clone, Debug)]
pub struct ChartOptions {
    /// Folder for `results.json`, and for scenes and runs while they are made.
    pub out: PathBuf,
    /// The `segwild` program.
    pub program: PathBuf,
    /// The command line that makes it again.
    pub command: String,
    /// Names of [`SWEEPS`], or of single points as in `appearance=embed`; all when empty.
    pub only: Vec<String>,
    /// Seeds of the training: what error bars are over.
    pub seeds: Vec<u64>,
    /// What must stay the same for points to be comparable.
    pub base: ChartBase,
}

/// What all points of a chart have in common.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChartBase {
    /// The scenes; a point is their mean.
    pub sources: Vec<PhotoSource>,
    /// The provider of masks and descriptors.
    pub providers: ProviderKind,
    /// How the oracle errs.
    pub faults: OracleOptions,
    /// The default's settings, by name.
    pub settings: Vec<(String, String)>,
}

/// What is reported while points are measured.
#[derive(Clone, Debug)]
pub enum ChartEvent<'a> {
    /// A point was measured, or was known.
    Point {
        /// Its records, the scene's first.
        records: &'a [Record],
        /// Whether it was known from an earlier start.
        known: bool,
    },
    /// A point could not be measured; the next start tries again.
    Failed {
        /// Sweep and value.
        point: &'a str,
        /// Why.
        error: &'a PointError,
    },
}

/// Measures every point that is not known yet; all that is known afterwards.
///
/// # Errors
/// When the default cannot be measured, or results cannot be kept. A point that fails is reported and left out.
pub fn chart(options: &ChartOptions, mut report: impl FnMut(ChartEvent)) -> Result<Results, PageError> {
    let known = |o: &str| SWEEPS.iter().any(|s| s.name == o || s.values.iter().any(|v| one(s, v) == o));
    let names: Vec<&str> = SWEEPS.iter().map(|s| s.name).collect();
    PageError::refuse("sweep", &options.only, &names, known)?;
    io(&options.out, std::fs::create_dir_all(&options.out))?;
    same_base(options)?;
    let file = options.out.join("results.json");
    let mut results = if file.is_file() { Results::read(&file)? } else { Results::default() };
    results.made = Provenance::here(options.command.clone());
    for plan in plans(options)? {
        for source in &options.base.sources {
            for &seed in &options.seeds {
                let job = plan.job(options, source, seed);
                let known: Vec<Record> = results.records.iter().filter(|r| of(r, &job)).cloned().collect();
                if known.iter().any(|r| r.target.is_empty()) {
                    report(ChartEvent::Point { records: &known, known: true });
                    continue;
                }
                empty(&job.dir)?;
                let before = pace()?;
                match point::apart(&options.program, &job) {
                    Ok(mut records) => {
                        let pace = (before + pace()?) / 2.0;
                        records.iter_mut().filter(|r| r.target.is_empty()).for_each(|r| {
                            r.numbers.insert(PACE.into(), pace);
                        });
                        report(ChartEvent::Point { records: &records, known: false });
                        records.into_iter().for_each(|r| results.put(r));
                        results.write(&file)?;
                    }
                    Err(error) if plan.setting == DEFAULT => return Err(error.into()),
                    Err(error) => report(ChartEvent::Failed { point: &plan.name(), error: &error }),
                }
                empty(&job.dir)?;
            }
        }
    }
    Ok(results)
}

/// A point that is to be measured.
struct SweepPlan {
    setting: String,
    at: Option<f64>,
    settings: Vec<(String, String)>,
}

impl SweepPlan {
    fn name(&self) -> String {
        self.at.map_or(self.setting.clone(), |at| format!("{} {at}", self.setting))
    }

    fn job(&self, options: &ChartOptions, source: &PhotoSource, seed: u64) -> PointJob {
        let base = &options.base;
        PointJob {
            protocol: PROTOCOL.into(),
            setting: self.setting.clone(),
            at: self.at,
            source: source.clone(),
            providers: base.providers,
            faults: base.faults.clone(),
            settings: self.settings.clone(),
            harm: Harm::default(),
            prompting: Prompting::Best,
            count: false,
            seed,
            dir: options.out.join("point"),
        }
    }
}

/// The points, the default first. A value that is the default's own is not measured twice.
fn plans(options: &ChartOptions) -> Result<Vec<SweepPlan>, PageError> {
    let base = &options.base.settings;
    let mut plans = vec![SweepPlan { setting: DEFAULT.into(), at: None, settings: base.clone() }];
    let wanted = |s: &Sweep, value: &str| {
        options.only.is_empty() || options.only.iter().any(|o| o == s.name || *o == one(s, value))
    };
    for sweep in SWEEPS {
        for value in sweep.values.iter().filter(|v| wanted(sweep, v)) {
            let nothing_new =
                sweep.is_base(base, value)? || sweep.setting == "size" && too_large(options, value);
            if !nothing_new {
                let (setting, at) = sweep.setting_of(value);
                plans.push(SweepPlan { setting, at, settings: sweep.settings(base, value) });
            }
        }
    }
    Ok(plans)
}

/// How a person names one point of a sweep.
fn one(sweep: &Sweep, value: &str) -> String {
    format!("{}={value}", sweep.name)
}

/// Whether synthetic photos have fewer pixels than a value of `size` asks for: such a point would be the default's.
fn too_large(options: &ChartOptions, value: &str) -> bool {
    let long_side = |source: &PhotoSource| match source {
        PhotoSource::Synthetic(scene) => Some(scene.long_side),
        PhotoSource::Folder { .. } => None,
    };
    let most = options.base.sources.iter().filter_map(long_side).max();
    value.parse::<u32>().ok().zip(most).is_some_and(|(value, most)| value >= most)
}

/// Whether a record is of the job's point.
fn of(record: &Record, job: &PointJob) -> bool {
    record.setting == job.setting
        && record.at == job.at
        && record.seed == job.seed
        && record.scene == job.source.name()
}

/// Refuses a folder with points of another chart; marks an empty one as this chart's.
fn same_base(options: &ChartOptions) -> Result<(), PageError> {
    let file = options.out.join("base.json");
    let here = serde_json::to_value(&options.base).unwrap_or_default();
    let Ok(text) = std::fs::read(&file) else {
        return io(&file, files::write_plain(&file, format!("{here:#}\n")));
    };
    let there: serde_json::Value = serde_json::from_slice(&text).unwrap_or_default();
    if there == here { Ok(()) } else { Err(PageError::Other(options.out.clone())) }
}

fn empty(dir: &Path) -> Result<(), PageError> {
    if dir.exists() { io(dir, std::fs::remove_dir_all(dir)) } else { Ok(()) }
}
