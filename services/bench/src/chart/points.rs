//! The points of a chart, and how the default stands among them.

use super::sweeps::{DEFAULT, SWEEPS, Sweep};
use segwild_eval::metrics::Spread;
use segwild_eval::record::{Record, Results, means};
use segwild_scene::statistics::upper_median;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

/// CPU milliseconds of the same work before and after a point was measured.
pub(super) const PACE: &str = "pace_ms";

/// A point: its numbers over the seeds, each the mean over scenes and targets.
#[derive(Clone, Debug)]
pub(super) struct ChartPoint {
    pub sweep: Option<&'static Sweep>,
    pub value: String,
    pub chosen: bool,
    pub numbers: BTreeMap<String, Spread>,
}

impl ChartPoint {
    pub fn mean(&self, number: &str) -> Option<f64> {
        self.numbers.get(number).map(|s| s.mean)
    }

    pub fn name(&self) -> String {
        match self.sweep {
            Some(sweep) => format!("{} {}", sweep.name, self.value),
            None => self.value.clone(),
        }
    }
}

/// How the default stands among the points, by one measure of worth and one of cost.
#[derive(Clone, Debug, PartialEq)]
pub struct DefaultVerdict {
    /// `iou` or `psnr`.
    pub worth: &'static str,
    /// `cpu_s` or `peak_mib`.
    pub cost: &'static str,
    /// Points that are worth more than noise more, for no more.
    pub better: Vec<String>,
    /// Points that are worth as much, up to noise, for less than [`CHEAPER`] of its cost.
    pub cheaper: Vec<String>,
}

/// A point has to cost less than this share of the default's cost to count as cheaper.
pub const CHEAPER: f64 = 0.8;

impl DefaultVerdict {
    /// Whether nothing beats the default.
    pub fn on_front(&self) -> bool {
        self.better.is_empty() && self.cheaper.is_empty()
    }

    /// In words.
    pub fn words(&self) -> String {
        let (worth, cost) = (MEASURES[usize::from(self.worth == "psnr")].1, cost_words(self.cost));
        if self.on_front() {
            return format!("{worth} against {cost}: the default is on the front.");
        }
        let mut text = format!("{worth} against {cost}: the default is behind the front.");
        if !self.better.is_empty() {
            let _ = write!(text, " Better for no more: {}.", self.better.join("; "));
        }
        if !self.cheaper.is_empty() {
            let _ = write!(text, " As good for less: {}.", self.cheaper.join("; "));
        }
        text
    }
}

/// What is good: name of the number, words, and the least difference that means anything.
pub(super) const MEASURES: [(&str, &str, f64); 2] =
    [("iou", "IoU", 0.005), ("psnr", "held-out PSNR in dB", 0.1)];
pub(super) const COSTS: [&str; 2] = ["cpu_s", "peak_mib"];
/// What takes longer where the machine is slower.
const TIMES: [&str; 3] = ["cpu_s", "wall_s", "click_s"];

pub(super) fn cost_words(cost: &str) -> &'static str {
    if cost == "cpu_s" { "CPU time" } else { "peak memory" }
}

/// The middle one of all paces at which points were measured, in ms.
pub(super) fn usual_pace(results: &Results) -> Option<f64> {
    upper_median(results.records.iter().filter_map(|r| r.numbers.get(PACE).copied()).collect())
}

/// A record with the times it would have had at that pace of the machine.
fn at_pace(record: &Record, usual: Option<f64>) -> Record {
    let mut record = record.clone();
    if let (Some(usual), Some(&pace)) = (usual, record.numbers.get(PACE)) {
        for name in TIMES {
            record.numbers.entry(name.to_owned()).and_modify(|time| *time *= usual / pace);
        }
    }
    record
}

/// How times were made comparable, as a sentence; empty where they were not.
pub(super) fn pace_words(results: &Results) -> String {
    let Some(usual) = usual_pace(results) else { return String::new() };
    let paces = || results.records.iter().filter_map(|r| r.numbers.get(PACE)).map(|pace| pace / usual);
    let (least, most) = (paces().fold(f64::INFINITY, f64::min), paces().fold(0.0, f64::max));
    format!(
        " Times are those at the machine's usual pace: the same rendering, before and after each point, took {least:.2} to {most:.2} of \
         its usual time, and so much is divided out (the data have both)."
    )
}

/// A point of a sweep, or the one of a setting, from all that was measured there.
pub(super) fn point(results: &Results, (setting, at): (&str, Option<f64>)) -> ChartPoint {
    let usual = usual_pace(results);
    let records: Vec<Record> = results
        .records
        .iter()
        .filter(|r| r.setting == setting && r.at == at)
        .map(|r| at_pace(r, usual))
        .collect();
    let records: Vec<&Record> = records.iter().collect();
    let seeds: BTreeSet<u64> = records.iter().map(|r| r.seed).collect();
    let mut values: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for seed in seeds {
        let scenes: BTreeSet<&str> =
            records.iter().filter(|r| r.seed == seed).map(|r| r.scene.as_str()).collect();
        let mut sums: BTreeMap<String, Vec<f64>> = BTreeMap::new();
        for scene in scenes {
            let here: Vec<&Record> =
                records.iter().copied().filter(|r| r.seed == seed && r.scene == scene).collect();
            means(&here).into_iter().for_each(|(name, v)| sums.entry(name).or_default().push(v));
        }
        for (name, v) in sums {
            values.entry(name).or_default().push(v.iter().sum::<f64>() / v.len() as f64);
        }
    }
    let numbers = values.into_iter().filter_map(|(name, v)| Some((name, Spread::of(&v)?))).collect();
    let sweep = SWEEPS.iter().find(|s| setting.split(' ').next() == Some(s.name));
    let value = match at {
        Some(at) => at.to_string(),
        None => setting.split_once(' ').map_or(setting, |s| s.1).to_owned(),
    };
    ChartPoint { sweep, value, chosen: setting == DEFAULT, numbers }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_busy_host_adds_is_divided_out() {
        let mut results = Results::default();
        for (seed, cpu, pace) in [(1, 10.0, 5.0), (2, 16.0, 8.0), (3, 12.0, 6.0)] {
            let numbers =
                [("cpu_s", cpu), (PACE, pace), ("psnr", 20.0)].map(|(n, v)| (n.to_owned(), v)).into();
            results.put(Record { setting: DEFAULT.into(), seed, numbers, ..Record::default() });
        }
        let point = point(&results, (DEFAULT, None));
        assert_eq!(point.numbers["cpu_s"], Spread::of(&[12.0, 12.0, 12.0]).unwrap());
        assert_eq!(point.mean("psnr"), Some(20.0));
        assert!(pace_words(&results).contains("took 0.83 to 1.33 of"), "{}", pace_words(&results));
        assert_eq!(pace_words(&Results::default()), "");
    }
}
