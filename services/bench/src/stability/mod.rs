//! Where the method fails, and whether it reports that: quality as a curve against each kind of stress (method, section 12).
//!
//! A curve breaks at the first amount at which IoU falls under [`BREAKS`] of what it is without the stress. Breaking is
//! announced when the program reports something there that it does not report without the stress: a warning of the run, a
//! diagnostic of a click, or a refusal.

mod curve;
mod kernels;
mod page;
mod stress;

pub use curve::{Amount, BREAKS, Curve, curves};
pub use kernels::kernels;
pub use page::{markdown, write};
pub use stress::{PROTOCOL, STRESSES, Stress};

use crate::harm::Harm;
use crate::page::{PageError, io};
use crate::point::{PhotoSource, PointJob, Prompting, measure};
use segwild_eval::oracle::{ORACLE, OracleOptions};
use segwild_eval::record::{Provenance, Record, Results};
use segwild_eval::stamp::{UNKNOWN, provider};
use segwild_eval::trial::ProviderKind;
use segwild_synthetic::SyntheticOptions;
use std::collections::BTreeMap;
use std::path::PathBuf;

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

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

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
