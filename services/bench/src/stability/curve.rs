//! Curves of quality against each stress, and where they break.

use super::stress::{STRESSES, Stress};
use segwild_eval::record::{Record, Results, means};
use std::collections::BTreeSet;

/// Share of the calm IoU under which a curve is broken.
pub const BREAKS: f64 = 0.8;

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
                protocol: "stability".into(),
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
}
