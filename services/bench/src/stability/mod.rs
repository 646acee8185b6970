//! Where the method fails, and whether it reports that: quality as a curve against each kind of stress (method, section 12).
//!
//! A curve breaks at the first amount at which IoU falls under [`BREAKS`] of what it is without the stress. Breaking is
//! announced when the program reports something there that it does not report without the stress: a warning of the run, a
//! diagnostic of a click, or a refusal.

mod kernels;
mod page;
mod stress;

pub use kernels::kernels;
pub use page::{markdown, write};
pub use stress::{Harm, STRESSES, Stress};

use crate::page::{PageError, io};
use crate::point::{PhotoSource, PointJob, Prompting, means, measure};
use segwild_eval::oracle::{ORACLE, OracleOptions};
use segwild_eval::record::{Provenance, Record, Results};
use segwild_eval::stamp::{UNKNOWN, provider};
use segwild_eval::trial::ProviderKind;
use segwild_synthetic::SyntheticOptions;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// Share of the calm IoU under which a curve is broken.
pub const BREAKS: f64 = 0.8;
/// The protocol under which everything here is recorded.
pub const PROTOCOL: &str = "stability";
/// Benchmarks beside the stresses: ten trainings that differ by their seed; the same training again, on one, two and
/// four threads; the kernels against the f64 reference over sizes of splats.
pub const MORE: [&str; 3] = ["seeds", "bytes", "kernels"];

/// What to measure.
#[derive(Clone, Debug)]
pub struct StabilityOptions {
    /// Folder for `results.json`, and for scenes and runs while they are made.
    pub out: PathBuf,
    /// The command line that makes it again.
    pub command: String,
    /// Names of [`STRESSES`] and [`MORE`]; all when empty.
    pub only: Vec<String>,
    /// Seeds of the sources and of the trainings.
    pub seeds: Vec<u64>,
    /// The provider of masks and descriptors. Stresses that are faults of the oracle are left out where it is not the oracle.
    pub providers: ProviderKind,
    /// The scene, but for its seed.
    pub scene: SyntheticOptions,
    /// Settings of the trainings, by name.
    pub settings: Vec<(String, String)>,
}

/// The scene and the settings by default: small, so that all curves together take minutes.
pub fn defaults() -> (SyntheticOptions, Vec<(String, String)>) {
    let scene =
        SyntheticOptions { train: 20, test: 3, long_side: 160, points: 2500, ..SyntheticOptions::default() };
    let settings = [("preset", "draft"), ("steps", "600"), ("refine_steps", "20"), ("prompt_budget", "64")];
    (scene, settings.map(|(name, value)| (name.to_owned(), value.to_owned())).to_vec())
}

/// Measures what is not known yet; `report` receives every amount of every stress.
pub fn stability(
    options: &StabilityOptions,
    mut report: impl FnMut(&[Record]),
) -> Result<Results, PageError> {
    let can = |s: &&Stress| options.providers == ProviderKind::Oracle || !s.is_of_the_oracle();
    let names: Vec<&str> = STRESSES.iter().filter(can).map(|s| s.name).chain(MORE).collect();
    PageError::refuse("row", &options.only, &names, |o| names.contains(&o))?;
    let wanted = |name: &str| options.only.is_empty() || options.only.iter().any(|o| o == name);
    io(&options.out, std::fs::create_dir_all(&options.out))?;
    let file = options.out.join("results.json");
    let mut results = if file.is_file() { Results::read(&file)? } else { Results::default() };
    results.made = Provenance::here(options.command.clone());
    let is_oracle = options.providers == ProviderKind::Oracle;
    if results.records.iter().filter_map(provider).any(|p| (p == ORACLE) != is_oracle || p == UNKNOWN) {
        return Err(PageError::Other(options.out.clone()));
    }
    let runs = options.out.join("runs");
    // What differs only in clicks or in nothing shares a training, and its records where nothing differs.
    let mut measured: BTreeMap<String, Vec<Record>> = BTreeMap::new();
    for (stress, value) in STRESSES
        .iter()
        .filter(can)
        .filter(|s| wanted(s.name))
        .flat_map(|s| s.values.iter().map(move |v| (s, *v)))
    {
        for &seed in &options.seeds {
            let known: Vec<Record> = of(&results, stress.name, Some(value), seed).cloned().collect();
            if known.iter().any(|r| r.target.is_empty()) {
                report(&known);
                continue;
            }
            let mut job = job(options, seed);
            (stress.apply)(&mut job, value);
            let records = at(&mut job, &runs, &mut measured, stress.name, Some(value))?;
            report(&records);
            records.into_iter().for_each(|r| results.put(r));
            results.write(&file)?;
        }
    }
    if wanted("seeds") {
        for seed in 1..=10 {
            if of(&results, "seeds", None, seed).next().is_none() {
                // Another training of the same scene.
                let mut job = PointJob { seed, ..job(options, options.seeds.first().copied().unwrap_or(1)) };
                let records = at(&mut job, &runs, &mut measured, "seeds", None)?;
                report(&records);
                records.into_iter().for_each(|r| results.put(r));
                results.write(&file)?;
            }
        }
    }
    if wanted("bytes") {
        let record = bytes(options)?;
        report(std::slice::from_ref(&record));
        results.put(record);
    }
    if wanted("kernels") {
        let records = kernels();
        report(&records);
        records.into_iter().for_each(|r| results.put(r));
    }
    results.write(&file)?;
    let _ = std::fs::remove_dir_all(&runs);
    Ok(results)
}

fn of<'a>(
    results: &'a Results,
    setting: &'a str,
    at: Option<f64>,
    seed: u64,
) -> impl Iterator<Item = &'a Record> {
    results.records.iter().filter(move |r| r.setting == setting && r.at == at && r.seed == seed)
}

/// The training that nothing is wrong with.
fn job(options: &StabilityOptions, seed: u64) -> PointJob {
    PointJob {
        protocol: PROTOCOL.into(),
        setting: String::new(),
        at: None,
        source: PhotoSource::Synthetic(SyntheticOptions { seed, ..options.scene.clone() }),
        providers: options.providers,
        faults: OracleOptions::default(),
        settings: options.settings.clone(),
        harm: Harm::default(),
        prompting: Prompting::Best,
        count: false,
        seed,
        dir: PathBuf::new(),
    }
}

/// Measures a job, or finds what was measured under another name.
fn at(
    job: &mut PointJob,
    runs: &std::path::Path,
    measured: &mut BTreeMap<String, Vec<Record>>,
    setting: &str,
    value: Option<f64>,
) -> Result<Vec<Record>, PageError> {
    let whole = digest(&(&job.source, &job.faults, &job.harm, job.seed, &job.settings, &job.prompting));
    let scene = digest(&(&job.source, &job.faults, &job.harm, job.seed));
    if !measured.contains_key(&whole) {
        job.dir = runs.join(scene);
        measured.insert(whole.clone(), measure(job)?);
    }
    let named = |r: &Record| Record { setting: setting.into(), at: value, ..r.clone() };
    Ok(measured[&whole].iter().map(named).collect())
}

/// A name for what something says.
fn digest(what: &impl serde::Serialize) -> String {
    let text = serde_json::to_vec(what).unwrap_or_default();
    blake3::hash(&text).to_hex()[..16].to_owned()
}

/// Whether the same training gives the same bytes: again, and on one, two and four threads. `same` is 1 or 0.
fn bytes(options: &StabilityOptions) -> Result<Record, PageError> {
    let seed = options.seeds.first().copied().unwrap_or(1);
    let (mut digests, mut provider) = (Vec::new(), String::new());
    for (k, threads) in [1, 2, 4, 1].into_iter().enumerate() {
        let mut job = job(options, seed);
        job.settings.push(("threads".into(), threads.to_string()));
        job.dir = options.out.join(format!("bytes-{k}"));
        let _ = std::fs::remove_dir_all(&job.dir);
        if let Some(first) = measure(&job)?.into_iter().next() {
            provider = first.provider;
        }
        let mut hasher = blake3::Hasher::new();
        let run = job.dir.join("run");
        let mut files = vec![run.join("scene.ply"), run.join("features.bin")];
        let mut selections: Vec<PathBuf> = std::fs::read_dir(run.join("selections"))
            .map(|d| d.flatten().map(|e| e.path().join("object.ply")).collect())
            .unwrap_or_default();
        selections.sort();
        files.extend(selections);
        for file in files.iter().filter(|f| f.is_file()) {
            hasher.update(&io(file, std::fs::read(file))?);
        }
        digests.push((files.len(), hasher.finalize().to_hex()[..16].to_owned()));
        let _ = std::fs::remove_dir_all(&job.dir);
    }
    let same = digests.iter().all(|d| *d == digests[0]) && digests[0].0 > 2;
    Ok(Record {
        protocol: PROTOCOL.into(),
        scene: format!("seed {seed}"),
        setting: "bytes".into(),
        provider,
        seed,
        numbers: BTreeMap::from([("same".to_owned(), f64::from(u8::from(same)))]),
        notes: digests.into_iter().map(|(files, digest)| format!("{files} files {digest}")).collect(),
        ..Record::default()
    })
}

/// One amount of a stress: its numbers over the seeds, and the messages.
#[derive(Clone, Debug, PartialEq)]
pub struct Amount {
    /// How much.
    pub value: f64,
    /// Mean IoU over targets, prompts and seeds.
    pub iou: f64,
    /// The worst target's IoU.
    pub worst: f64,
    /// Mean held-out PSNR in dB.
    pub psnr: f64,
    /// The program's messages, each kind once.
    pub messages: Vec<String>,
}

/// A curve, and where it breaks.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// Its name.
    pub name: &'static str,
    /// The amounts that were measured, in order.
    pub amounts: Vec<Amount>,
    /// The first amount at which it is broken.
    pub breaks: Option<f64>,
    /// Messages there that do not come without the stress.
    pub announced: Vec<String>,
    /// The first amount with a message that does not come without the stress.
    pub warned_from: Option<f64>,
}

/// The curves of some results.
pub fn curves(results: &Results) -> Vec<Curve> {
    STRESSES.iter().filter_map(|s| curve(results, s)).collect()
}

fn curve(results: &Results, stress: &Stress) -> Option<Curve> {
    let amounts: Vec<Amount> =
        stress.values.iter().filter_map(|&value| amount(results, stress.name, Some(value))).collect();
    let calm = amounts.iter().find(|a| a.value == stress.calm)?;
    let usual: BTreeSet<String> = calm.messages.iter().map(|s| kind(s)).collect();
    let new = |a: &Amount| -> Vec<String> {
        a.messages.iter().filter(|s| !usual.contains(&kind(s))).cloned().collect()
    };
    let rising = stress.values.last() > stress.values.first();
    let beyond = |a: &&Amount| {
        a.value != stress.calm && (a.value > stress.calm) == rising || stress.calm > stress.values[0]
    };
    let broken = amounts.iter().filter(beyond).find(|a| a.iou < BREAKS * calm.iou);
    Some(Curve {
        name: stress.name,
        breaks: broken.map(|a| a.value),
        announced: broken.map(new).unwrap_or_default(),
        warned_from: amounts.iter().find(|a| !new(a).is_empty()).map(|a| a.value),
        amounts,
    })
}

/// Everything that was measured of one amount.
fn amount(results: &Results, setting: &str, at: Option<f64>) -> Option<Amount> {
    let records: Vec<&Record> =
        results.records.iter().filter(|r| r.setting == setting && r.at == at).collect();
    let numbers = means(&records);
    let mut messages: Vec<String> = Vec::new();
    for note in records.iter().flat_map(|r| &r.notes) {
        if messages.iter().all(|s| kind(s) != kind(note)) {
            messages.push(note.clone());
        }
    }
    let worst = records.iter().filter_map(|r| r.numbers.get("iou")).copied().fold(f64::INFINITY, f64::min);
    Some(Amount {
        value: at.unwrap_or(0.0),
        iou: *numbers.get("iou")?,
        worst,
        psnr: numbers.get("psnr").copied().unwrap_or(f64::NAN),
        messages,
    })
}

/// What a sentence is about: without its numbers and the names in it.
fn kind(note: &str) -> String {
    let word = |w: &&str| w.chars().all(|c| c.is_ascii_lowercase() || ":;,()".contains(c));
    note.split_whitespace().filter(word).take(8).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn results(points: &[(f64, f64, &str)]) -> Results {
        let mut results = Results::default();
        for &(value, iou, note) in points {
            let record = |target: &str, numbers: &[(&str, f64)]| Record {
                protocol: PROTOCOL.into(),
                setting: "occluders".into(),
                at: Some(value),
                target: target.into(),
                numbers: numbers.iter().map(|(n, v)| ((*n).to_owned(), *v)).collect(),
                ..Record::default()
            };
            let notes = if note.is_empty() { Vec::new() } else { vec![note.to_owned()] };
            results.put(Record { notes, ..record("", &[("psnr", 20.0)]) });
            results.put(record("dome", &[("iou", iou)]));
        }
        results
    }

    #[test]
    fn a_curve_breaks_where_it_falls_and_is_announced_by_what_is_new() {
        let usual = "22 isolated points are left out";
        let broken = results(&[
            (0.0, 0.9, usual),
            (0.1, 0.88, "25 isolated points are left out"),
            (0.25, 0.6, "in 12 of 20 photos more than 25 % contradicts the scene"),
        ]);
        let curve = &curves(&broken)[0];
        assert_eq!((curve.breaks, curve.warned_from), (Some(0.25), Some(0.25)));
        assert!(curve.announced[0].starts_with("in 12 of 20"));
        let silent = results(&[(0.0, 0.9, usual), (0.25, 0.6, usual)]);
        let curve = &curves(&silent)[0];
        assert_eq!((curve.breaks, curve.announced.len()), (Some(0.25), 0));
        let whole = results(&[(0.0, 0.9, ""), (0.25, 0.85, "")]);
        assert_eq!(curves(&whole)[0].breaks, None);
    }

    #[test]
    fn every_amount_of_every_stress_changes_the_job() {
        let (scene, settings) = defaults();
        let options = StabilityOptions {
            out: PathBuf::new(),
            command: String::new(),
            only: Vec::new(),
            seeds: vec![1],
            providers: ProviderKind::Oracle,
            scene,
            settings,
        };
        let of_the_oracle = STRESSES.iter().filter(|s| s.is_of_the_oracle()).count();
        assert_eq!(of_the_oracle, 4, "each is a stress by its name");
        for stress in STRESSES {
            assert!(stress.values.contains(&stress.calm), "{}", stress.name);
            let mut digests = BTreeSet::new();
            for value in stress.values {
                let mut job = job(&options, 1);
                (stress.apply)(&mut job, *value);
                job.settings().unwrap();
                digests.insert(serde_json::to_string(&job).unwrap());
            }
            assert_eq!(digests.len(), stress.values.len(), "{}", stress.name);
        }
    }
}
