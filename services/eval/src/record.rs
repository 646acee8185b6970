//! What a benchmark leaves: records, and what made them. Tables, charts, comparisons and floors all read these.

use crate::metrics::Spread;
use segwild_flow::files::{self, FileError};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The numbers of LPIPS in records, each with the heading of its column: one per network, since distances of one do not
/// compare with those of the other. Tables have the columns that were measured.
pub const LPIPS_COLUMNS: [(&str, &str); 2] = [("lpips_vgg", "LPIPS (vgg)"), ("lpips_alex", "LPIPS (alex)")];

/// One measurement: which scene, under which setting, and the numbers.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// The protocol: `synthetic`, `folder`, `photo-tourism`, `lego`, `nvos`, `spin-nerf`, `chart`, `stability`, `scale`.
    pub protocol: String,
    /// The scene: its folder's name, or `seed 3`.
    pub scene: String,
    /// What is compared within a protocol: a row of the ablation, a baseline, a point of a sweep (`steps`).
    pub setting: String,
    /// Who made the masks ([`segwild_vision::Providers::name`]): `built-in`, `sam:` and a model, `oracle`. Empty where no
    /// masks take part, and in results of before it was kept.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub provider: String,
    /// Where on its axis a point of a sweep lies; `None` outside sweeps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub at: Option<f64>,
    /// The object; empty where the record speaks of the whole scene.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub target: String,
    /// Seed of all random numbers, training included.
    pub seed: u64,
    /// Which of several prompts for the same target.
    #[serde(default)]
    pub prompt: u32,
    /// The numbers by name, units in the name where they have one: `iou`, `boundary_iou`, `accuracy`, `amodal_iou`,
    /// `label_iou`, `occluded_leak`, `psnr`, `ssim`, `lpips_vgg`, `lpips_alex`, `wall_s`, `cpu_s`, `peak_mib`, `splats`.
    pub numbers: BTreeMap<String, f64>,
    /// What the program reported about it: warnings, reasons, evidence.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub notes: Vec<String>,
}

/// What made the records.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// The command line that makes them again.
    pub command: String,
    /// Version of the program, with the commit where it is known.
    pub version: String,
    /// Processor, cores and memory of the machine.
    pub machine: String,
}

/// A benchmark's results, as `results.json` holds them.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Results {
    /// What made them.
    pub made: Provenance,
    /// The measurements, in the order they were made.
    pub records: Vec<Record>,
    /// What should have been measured and was not, a sentence each: a target without its photo, a photo without its mask.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub missing: Vec<String>,
}

/// Why results cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file cannot be read.
    #[error("cannot read {0}: {1}")]
    Read(PathBuf, #[source] std::io::Error),
    /// What is in it is no results file.
    #[error("{0} holds no benchmark results: {1}")]
    Form(PathBuf, #[source] serde_json::Error),
    /// The file cannot be written.
    #[error(transparent)]
    Write(#[from] FileError),
}

impl Provenance {
    /// This program, run as `command`, here.
    pub fn here(command: String) -> Provenance {
        let line = |file: &str, key: &str| {
            let text = std::fs::read_to_string(file).ok()?;
            let line = text.lines().find(|l| l.starts_with(key))?;
            Some(line.split_once(':')?.1.trim().to_owned())
        };
        let memory = line("/proc/meminfo", "MemTotal")
            .and_then(|m| m.split(' ').next()?.parse::<u64>().ok())
            .map_or(String::new(), |kib| format!(", {} GiB", (kib + (1 << 19)) >> 20));
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let processor = line("/proc/cpuinfo", "model name").unwrap_or_else(|| std::env::consts::ARCH.into());
        let version = env!("CARGO_PKG_VERSION").to_owned();
        let version = commit().map_or(version.clone(), |commit| format!("{version} ({commit})"));
        Provenance { command, version, machine: format!("{processor}, {cores} cores{memory}") }
    }
}

/// The commit of the checkout in which this program was built, if it still lies there.
fn commit() -> Option<String> {
    let program = std::env::current_exe().ok()?;
    let describe = ["describe", "--always", "--dirty", "--exclude=*"];
    let output = Command::new("git").current_dir(program.parent()?).args(describe).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?.trim().to_owned();
    (output.status.success() && !text.is_empty()).then_some(text)
}

impl Record {
    /// Whether another record measures the same thing: all but its numbers and notes agree.
    pub fn same(&self, other: &Record) -> bool {
        self.provider == other.provider && self.same_but_provider(other)
    }

    /// Whether another record measures the same thing, perhaps on the masks of another provider.
    pub fn same_but_provider(&self, other: &Record) -> bool {
        let key = |r: &Record| {
            let at = r.at.map(f64::to_bits);
            (r.protocol.clone(), r.scene.clone(), r.setting.clone(), at, r.target.clone(), r.seed, r.prompt)
        };
        key(self) == key(other)
    }
}

impl Results {
    /// Reads a results file.
    pub fn read(file: &Path) -> Result<Results, RecordError> {
        let text = std::fs::read(file).map_err(|e| RecordError::Read(file.into(), e))?;
        serde_json::from_slice(&text).map_err(|e| RecordError::Form(file.into(), e))
    }

    /// Writes a results file, whole or not at all.
    pub fn write(&self, file: &Path) -> Result<(), RecordError> {
        let text = serde_json::to_vec_pretty(self).map_err(|e| RecordError::Form(file.into(), e))?;
        Ok(files::write_atomic(file, &text)?)
    }

    /// Adds a record in place of the one that measures the same thing, if there is one. Numbers that are not finite
    /// are left out: JSON has no word for them.
    pub fn put(&mut self, mut record: Record) {
        record.numbers.retain(|_, value| value.is_finite());
        match self.records.iter_mut().find(|r| r.same(&record)) {
            Some(old) => *old = record,
            None => self.records.push(record),
        }
    }

    /// Notes what should have been measured and was not; what is known already is not added twice.
    pub fn miss(&mut self, what: impl IntoIterator<Item = String>) {
        for sentence in what {
            if !self.missing.contains(&sentence) {
                self.missing.push(sentence);
            }
        }
    }

    /// Spread of one number over the records that fit and have it.
    pub fn spread(&self, number: &str, fits: impl Fn(&Record) -> bool) -> Option<Spread> {
        let fitting = self.records.iter().filter(|r| fits(r));
        let values: Vec<f64> = fitting.filter_map(|r| r.numbers.get(number).copied()).collect();
        Spread::of(&values)
    }

    /// The records as comma-separated values, a column per number that any of them has.
    pub fn csv(&self) -> String {
        let names: std::collections::BTreeSet<&str> =
            self.records.iter().flat_map(|r| r.numbers.keys().map(String::as_str)).collect();
        let mut text = String::from("protocol,scene,setting,provider,at,target,seed,prompt");
        names.iter().for_each(|n| text += &format!(",{n}"));
        for r in &self.records {
            let at = r.at.map_or(String::new(), |a| a.to_string());
            let words = [&r.protocol, &r.scene, &r.setting, &r.provider, &at, &r.target].map(|w| quoted(w));
            text += &format!("\n{},{},{}", words.join(","), r.seed, r.prompt);
            for name in &names {
                text += &r.numbers.get(*name).map_or(",".into(), |v| format!(",{v}"));
            }
        }
        text + "\n"
    }
}

/// Mean of a number over the targets and prompts of one training, or the number itself where it speaks of the whole
/// scene; by name.
pub fn means(records: &[&Record]) -> BTreeMap<String, f64> {
    let mut sums: BTreeMap<String, (f64, u32)> = BTreeMap::new();
    for (name, value) in records.iter().flat_map(|r| &r.numbers) {
        let entry = sums.entry(name.clone()).or_default();
        *entry = (entry.0 + value, entry.1 + 1);
    }
    sums.into_iter().map(|(name, (sum, n))| (name, sum / f64::from(n))).collect()
}

/// A word as a field of comma-separated values (RFC 4180).
fn quoted(word: &str) -> String {
    if word.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", word.replace('"', "\"\""))
    } else {
        word.to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(setting: &str, iou: f64) -> Record {
        let numbers = BTreeMap::from([("iou".to_owned(), iou)]);
        Record {
            protocol: "synthetic".into(),
            setting: setting.into(),
            provider: "oracle".into(),
            numbers,
            ..Record::default()
        }
    }

    #[test]
    fn a_measurement_made_again_replaces_the_old_one() {
        let mut results = Results::default();
        results.put(record("full", 0.5));
        results.put(record("no-sgc", 0.4));
        results.put(record("full", 0.9));
        assert_eq!(results.records.len(), 2);
        assert_eq!(results.spread("iou", |r| r.setting == "full").unwrap().mean, 0.9);
        assert!(results.spread("psnr", |_| true).is_none());
    }

    #[test]
    fn figures_of_another_provider_replace_none() {
        let mut results = Results::default();
        results.put(record("full", 0.9));
        results.put(Record { provider: "built-in".into(), ..record("full", 0.4) });
        assert_eq!(results.records.len(), 2, "both stand beside one another");
    }

    #[test]
    fn results_survive_their_file_and_other_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("results.json");
        let results = Results {
            made: Provenance::here("segwild bench".into()),
            records: vec![record("a, b", 0.25)],
            ..Results::default()
        };
        results.write(&file).unwrap();
        assert_eq!(Results::read(&file).unwrap(), results);
        std::fs::write(&file, "[1]").unwrap();
        assert!(Results::read(&file).unwrap_err().to_string().contains("results.json"));
        assert!(results.csv().ends_with("synthetic,,\"a, b\",oracle,,,0,0,0.25\n"), "{}", results.csv());
    }
}
