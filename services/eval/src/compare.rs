//! Two results of the same benchmark: what got better or worse beyond the noise.
//!
//! Records that measure the same thing are set beside each other, so that what both have in common (an easy scene, an
//! object that is hard to see) falls out. A number of a setting has changed when two things hold:
//! - the mean difference is larger than the number's [`Margin`]: smaller ones mean nothing to anybody;
//! - a paired t-test over the trainings (scene and seed) rejects at [`ALPHA`] that the difference is 0, corrected by
//!   Holm's method for how many numbers are tested. Where there are fewer than [`LEAST`] trainings, their targets take
//!   their place. With fewer than that the noise is unknown, and the difference must be twice the margin.
//!
//! What the old results have and the new ones have not counts as worse: nothing passes by not being measured.

use crate::record::{Record, Results};
use crate::stamp::{UNKNOWN, providers};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt;

/// Probability of calling noise a change, over all numbers together.
pub const ALPHA: f64 = 0.05;
/// Least number of pairs that tell how large the noise is.
pub const LEAST: usize = 3;

/// How to compare.
#[derive(Clone, Copy, Debug)]
pub struct CompareOptions {
    /// Decide by the margins alone: for results of fixed seeds, where the same code gives the same bytes.
    pub strict: bool,
    /// Factor on all margins.
    pub margins: f64,
}

impl Default for CompareOptions {
    fn default() -> Self {
        CompareOptions { strict: false, margins: 1.0 }
    }
}

/// Which way is better, and from what difference on it matters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Margin {
    /// More is better; the least difference that matters.
    More(f64),
    /// Less is better; the least difference that matters.
    Less(f64),
    /// More is better; the least share of the old value that matters.
    MoreBy(f64),
    /// Less is better; the least share of the old value that matters.
    LessBy(f64),
}

impl Margin {
    /// The margin of a number; `None` for numbers that are neither good nor bad.
    pub fn of(number: &str) -> Option<Margin> {
        Some(match number {
            "psnr" | "train_psnr" => Margin::More(0.1),
            "ssim" => Margin::More(0.005),
            "lpips_vgg" | "lpips_alex" => Margin::Less(0.005),
            "occluded_leak" => Margin::Less(0.005),
            // On a machine that others use, less is noise.
            "wall_s" | "click_s" => Margin::LessBy(0.2),
            "cpu_s" => Margin::LessBy(0.1),
            "peak_mib" | "server_mib" | "run_mib" => Margin::LessBy(0.05),
            // What a person waits for on the page.
            "first_photo_s" | "first_frame_s" | "hover_ms" | "crowd_hover_ms" | "first_answer_s"
            | "last_answer_s" | "sure_s" => Margin::LessBy(0.2),
            "frames_per_s" => Margin::MoreBy(0.2),
            // Counted work is exact; a training of other splats may take a few more.
            "splats" | "pairs" | "calls" | "steps" | "photo_steps" => Margin::LessBy(0.02),
            // One request of many, which the system may have held up; by choice.
            name if name.starts_with("slowest_") => Margin::LessBy(0.5),
            name if name.ends_with("iou") || name == "accuracy" => Margin::More(0.005),
            _ => return None,
        })
    }

    /// A difference as a multiple of the margin, positive when it is for the better.
    fn weigh(self, old: f64, difference: f64) -> f64 {
        match self {
            Margin::More(least) => difference / least,
            Margin::Less(least) => -difference / least,
            Margin::MoreBy(share) => difference / (share * old.abs()).max(f64::MIN_POSITIVE),
            Margin::LessBy(share) => -difference / (share * old.abs()).max(f64::MIN_POSITIVE),
        }
    }
}

/// What became of a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Change {
    /// It is worse beyond the noise.
    Worse,
    /// The old results have it, the new ones have not.
    Missing,
    /// It is better beyond the noise.
    Better,
    /// Neither.
    Same,
}

/// One number of one setting, old and new.
#[derive(Clone, Debug, Serialize)]
pub struct Line {
    /// Protocol and setting, with the position on its axis.
    pub setting: String,
    /// The number.
    pub number: String,
    /// Mean over what both have.
    pub old: f64,
    /// The same, new.
    pub new: f64,
    /// How many pairs were compared, and of what.
    pub pairs: usize,
    /// What a pair is.
    pub of: &'static str,
    /// Probability of such a difference by chance, before Holm's correction; `None` where there are too few pairs.
    pub p: Option<f64>,
    /// The verdict.
    pub change: Change,
}

impl fmt::Display for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = match self.change {
            Change::Worse => "worse",
            Change::Missing => "missing",
            Change::Better => "better",
            Change::Same => "same",
        };
        let Line { setting, number, old, new, pairs, of, .. } = self;
        if self.change == Change::Missing {
            return write!(f, "{word:>7}  {setting:32} {number:14} was {old:.4}, is not measured");
        }
        write!(
            f,
            "{word:>7}  {setting:32} {number:14} {old:.4} -> {new:.4} ({:+.4}; {pairs} {of}",
            new - old
        )?;
        match self.p {
            Some(p) => write!(f, ", p = {p:.3})"),
            None => write!(f, ")"),
        }
    }
}

/// Results of different providers: their figures do not compare.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the old results are of the provider {old}, the new ones of {new}: figures of different providers do not compare; measure \
     one of them again by the other's (`--providers oracle|builtin`, `--masks`)"
)]
pub struct OtherProvider {
    /// The old results' provider.
    pub old: String,
    /// The new ones'.
    pub new: String,
}

/// Whether results say whose masks theirs are, where they have masks.
pub fn names_its_provider(results: &Results) -> bool {
    !providers([results]).contains(&UNKNOWN)
}

/// The measurement of the same thing in other results: on the same provider's masks, or on those of nobody knows whom.
fn twin<'a>(record: &Record, others: &'a Results) -> Result<Option<&'a Record>, OtherProvider> {
    let mut all = others.records.iter().filter(|r| r.same_but_provider(record));
    let known = |r: &Record| !r.provider.is_empty();
    let Some(first) = all.clone().next() else { return Ok(None) };
    match all.find(|r| r.provider == record.provider || !known(r) || !known(record)) {
        Some(twin) => Ok(Some(twin)),
        None => Err(OtherProvider { old: record.provider.clone(), new: first.provider.clone() }),
    }
}

/// Everything that both results have, worst first.
///
/// # Errors
/// When a measurement of the old results was made again on the masks of another provider only.
pub fn compare(old: &Results, new: &Results, options: CompareOptions) -> Result<Vec<Line>, OtherProvider> {
    let mut groups: BTreeMap<(String, String), Vec<ComparedRecord>> = BTreeMap::new();
    for record in &old.records {
        let twin = twin(record, new)?;
        for (number, &value) in &record.numbers {
            if Margin::of(number).is_some() {
                let now = twin.and_then(|t| t.numbers.get(number).copied());
                groups.entry((name(record), number.clone())).or_default().push((record, value, now));
            }
        }
    }
    let mut lines: Vec<(Line, f64)> =
        groups.iter().filter_map(|((setting, number), pairs)| line(setting, number, pairs)).collect();
    let thresholds = holm(&lines.iter().filter_map(|(l, _)| l.p).collect::<Vec<_>>());
    for (line, weight) in &mut lines {
        if line.change == Change::Missing {
            continue;
        }
        let least = match line.p {
            _ if options.strict => 1.0,
            Some(p) if p > thresholds => f64::INFINITY,
            Some(_) => 1.0,
            None => 2.0,
        };
        line.change = match *weight / options.margins {
            w if w <= -least => Change::Worse,
            w if w >= least => Change::Better,
            _ => Change::Same,
        };
    }
    let mut lines: Vec<Line> = lines.into_iter().map(|(line, _)| line).collect();
    lines.sort_by(|a, b| a.change.cmp(&b.change).then_with(|| a.setting.cmp(&b.setting)));
    Ok(lines)
}

/// A measurement, its old value, and the new one where there is one.
type ComparedRecord<'a> = (&'a Record, f64, Option<f64>);

fn name(record: &Record) -> String {
    let at = record.at.map_or(String::new(), |at| format!(" {at}"));
    format!("{} {}{at}", record.protocol, record.setting)
}

/// One number of one setting, not compared yet, and its difference in margins.
fn line(setting: &str, number: &str, all: &[ComparedRecord]) -> Option<(Line, f64)> {
    let pairs: Vec<(&Record, f64, f64)> =
        all.iter().filter_map(|&(r, old, new)| Some((r, old, new?))).collect();
    let mut line = Line {
        setting: setting.into(),
        number: number.into(),
        old: all.iter().map(|p| p.1).sum::<f64>() / all.len() as f64,
        new: f64::NAN,
        pairs: pairs.len(),
        of: "pairs",
        p: None,
        change: Change::Missing,
    };
    if pairs.len() < all.len() {
        return Some((line, 0.0));
    }
    let mut trainings: BTreeMap<(&str, u64), Vec<(f64, f64)>> = BTreeMap::new();
    for (r, old, new) in &pairs {
        trainings.entry((&r.scene, r.seed)).or_default().push((*old, *new));
    }
    let mean = |v: &[(f64, f64)]| {
        let n = v.len() as f64;
        (v.iter().map(|p| p.0).sum::<f64>() / n, v.iter().map(|p| p.1).sum::<f64>() / n)
    };
    let by_training: Vec<(f64, f64)> = trainings.values().map(|v| mean(v)).collect();
    let by_target: Vec<(f64, f64)> = pairs.iter().map(|p| (p.1, p.2)).collect();
    let (samples, of) =
        if by_training.len() >= LEAST { (&by_training, "trainings") } else { (&by_target, "targets") };
    let of = if by_target.len() == by_training.len() { "trainings" } else { of };
    (line.old, line.new) = mean(samples);
    (line.pairs, line.of) = (samples.len(), of);
    let differences: Vec<f64> = samples.iter().map(|(old, new)| new - old).collect();
    line.p = (samples.len() >= LEAST).then(|| paired_t(&differences));
    line.change = Change::Same;
    let weight = Margin::of(number)?.weigh(line.old, line.new - line.old);
    Some((line, weight))
}

/// The largest p that is still a rejection by Holm's method: 0 where none is.
fn holm(ps: &[f64]) -> f64 {
    let mut sorted = ps.to_vec();
    sorted.sort_by(f64::total_cmp);
    let n = sorted.len();
    let rejected = sorted.iter().enumerate().take_while(|(k, p)| **p <= ALPHA / (n - k) as f64);
    rejected.map(|(_, p)| *p).last().unwrap_or(-1.0)
}

/// Two-sided p of a t-test that differences have the mean 0.
fn paired_t(differences: &[f64]) -> f64 {
    let n = differences.len() as f64;
    let mean = differences.iter().sum::<f64>() / n;
    let variance = differences.iter().map(|d| (d - mean) * (d - mean)).sum::<f64>() / (n - 1.0);
    if variance <= 1e-24 * mean * mean {
        return if mean == 0.0 { 1.0 } else { 0.0 };
    }
    two_sided(mean / (variance / n).sqrt(), n - 1.0)
}

/// Probability that Student's t with so many degrees of freedom is at least as far from 0: with t = sqrt(f) tan(a) its
/// density becomes cos(a)^(f-1), which is summed.
fn two_sided(t: f64, freedom: f64) -> f64 {
    const PARTS: usize = 2000;
    let from = (t.abs() / freedom.sqrt()).atan();
    let integral = |from: f64| {
        let step = (std::f64::consts::FRAC_PI_2 - from) / PARTS as f64;
        let middle = |k: usize| from + (k as f64 + 0.5) * step;
        (0..PARTS).map(|k| middle(k).cos().powf(freedom - 1.0)).sum::<f64>() * step
    };
    integral(from) / integral(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn results(numbers: impl Fn(u64, &str) -> Vec<(&'static str, f64)>) -> Results {
        let mut results = Results::default();
        for seed in 1..=5 {
            for target in ["", "dome", "lintel"] {
                let numbers = numbers(seed, target).into_iter().map(|(n, v)| (n.to_owned(), v)).collect();
                let (protocol, setting) = ("synthetic".into(), "full".into());
                results.put(Record {
                    protocol,
                    setting,
                    target: target.into(),
                    seed,
                    numbers,
                    ..Record::default()
                });
            }
        }
        results
    }

    /// IoU of the targets with noise that depends on the seed, all moved by `shift`; CPU time of the whole.
    fn measured(shift: f64, noise: f64, cpu: f64) -> Results {
        results(move |seed, target| match target {
            "" => vec![("cpu_s", cpu), ("psnr", 20.0 + seed as f64)],
            _ => {
                let swing = if seed % 2 == 0 { noise } else { -noise };
                vec![("iou", 0.5 + 0.07 * seed as f64 + shift + swing * seed as f64)]
            }
        })
    }

    fn change(lines: &[Line], number: &str) -> Change {
        lines.iter().find(|l| l.number == number).unwrap().change
    }

    #[test]
    fn figures_of_another_provider_are_not_compared() {
        let of = |name: &str| {
            let mut results = measured(0.0, 0.01, 10.0);
            results.records.iter_mut().for_each(|r| r.provider = name.into());
            results
        };
        let refused = compare(&of("oracle"), &of("built-in"), CompareOptions::default()).unwrap_err();
        assert_eq!((refused.old.as_str(), refused.new.as_str()), ("oracle", "built-in"));
        assert!(compare(&of("oracle"), &of("oracle"), CompareOptions::default()).is_ok());
        // Both providers beside one another: each is compared with its own.
        let both = Results { records: [of("built-in").records, of("oracle").records].concat(), ..of("") };
        let lines = compare(&of("oracle"), &both, CompareOptions::default()).unwrap();
        assert!(lines.iter().all(|l| l.change == Change::Same));
        assert!(!names_its_provider(&of("")) && names_its_provider(&both));
    }

    #[test]
    fn the_same_results_have_not_changed() {
        let old = measured(0.0, 0.01, 10.0);
        let lines = compare(&old, &old, CompareOptions::default()).unwrap();
        assert_eq!(lines.len(), 3);
        assert!(lines.iter().all(|l| l.change == Change::Same));
    }

    #[test]
    fn a_fall_in_every_training_is_worse_and_a_swing_is_noise() {
        let old = measured(0.0, 0.0, 10.0);
        let worse = compare(&old, &measured(-0.03, 0.001, 10.0), CompareOptions::default()).unwrap();
        assert_eq!(change(&worse, "iou"), Change::Worse);
        assert_eq!(worse[0].number, "iou", "the worst comes first");
        assert_eq!((worse[0].pairs, worse[0].of), (5, "trainings"));
        let better = compare(&old, &measured(0.03, 0.001, 10.0), CompareOptions::default()).unwrap();
        assert_eq!(change(&better, "iou"), Change::Better);
        let noise = compare(&old, &measured(-0.008, 0.02, 10.0), CompareOptions::default()).unwrap();
        assert_eq!(change(&noise, "iou"), Change::Same);
        let strict = CompareOptions { strict: true, margins: 1.0 };
        assert_eq!(
            change(&compare(&old, &measured(-0.008, 0.02, 10.0), strict).unwrap(), "iou"),
            Change::Worse
        );
        let lax = CompareOptions { strict: true, margins: 10.0 };
        assert_eq!(change(&compare(&old, &measured(-0.008, 0.02, 10.0), lax).unwrap(), "iou"), Change::Same);
    }

    #[test]
    fn what_is_certain_but_tiny_is_the_same_and_cost_counts_by_its_share() {
        let old = measured(0.0, 0.0, 10.0);
        let lines = compare(&old, &measured(-0.001, 0.0, 10.5), CompareOptions::default()).unwrap();
        assert_eq!((change(&lines, "iou"), change(&lines, "cpu_s")), (Change::Same, Change::Same));
        assert_eq!(
            change(&compare(&old, &measured(0.0, 0.0, 12.0), CompareOptions::default()).unwrap(), "cpu_s"),
            Change::Worse
        );
        assert_eq!(
            change(&compare(&old, &measured(0.0, 0.0, 8.0), CompareOptions::default()).unwrap(), "cpu_s"),
            Change::Better
        );
    }

    #[test]
    fn what_is_no_longer_measured_is_reported() {
        let old = measured(0.0, 0.0, 10.0);
        let mut new = old.clone();
        new.records.retain(|r| r.target != "dome");
        let lines = compare(&old, &new, CompareOptions::default()).unwrap();
        assert_eq!(change(&lines, "iou"), Change::Missing);
        assert!(lines[0].to_string().contains("is not measured"), "{}", lines[0]);
    }

    #[test]
    fn with_two_trainings_of_the_whole_the_difference_must_be_twice_the_margin() {
        let few = |psnr: f64| {
            let mut results =
                results(|_, target| if target.is_empty() { vec![("psnr", psnr)] } else { vec![] });
            results.records.retain(|r| r.seed <= 2);
            results
        };
        let of =
            |psnr: f64| change(&compare(&few(20.0), &few(psnr), CompareOptions::default()).unwrap(), "psnr");
        assert_eq!([of(19.85), of(19.75), of(20.3)], [Change::Same, Change::Worse, Change::Better]);
    }

    #[test]
    fn probabilities_are_those_of_the_tables() {
        // Two-sided 5 % points of Student's t.
        for (freedom, t) in [(1.0, 12.706), (2.0, 4.303), (4.0, 2.776), (10.0, 2.228), (30.0, 2.042)] {
            assert!((two_sided(t, freedom) - 0.05).abs() < 2e-4, "{freedom}: {}", two_sided(t, freedom));
        }
        assert_eq!(holm(&[0.001, 0.02, 0.03, 0.6]), 0.001);
        assert_eq!(holm(&[0.001, 0.01, 0.02, 0.6]), 0.02);
        assert_eq!(holm(&[0.2]), -1.0);
    }
}
