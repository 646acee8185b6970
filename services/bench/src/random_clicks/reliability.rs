//! Whether answers are as sure as they are good: the confidence of clicks beside their IoU (method, section 6.8).

use segwild_eval::record::Record;
use std::fmt::Write as _;

/// Name of the confidence of an answer.
pub const CONFIDENCE: &str = "confidence";

/// Bins of the confidence, .2 wide each.
const BINS: usize = 5;

/// Cells of the bar that stands for a mean IoU of 1.
const BAR: f64 = 20.0;

/// The clicks whose confidence lies in one bin.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct ReliabilityBin {
    /// How many.
    clicks: usize,
    /// Sum of their confidences.
    confidence: f64,
    /// Sum of their IoUs.
    iou: f64,
}

impl ReliabilityBin {
    /// Means of confidence and IoU; `None` of no clicks.
    fn means(&self) -> Option<[f64; 2]> {
        let mean = |sum: f64| sum / self.clicks as f64;
        (self.clicks > 0).then(|| [mean(self.confidence), mean(self.iou)])
    }
}

/// Sorts pairs of confidence and IoU into bins, the least sure ones first.
fn bins(pairs: &[[f64; 2]]) -> [ReliabilityBin; BINS] {
    let mut bins = [ReliabilityBin::default(); BINS];
    for [confidence, iou] in pairs {
        // The cast takes what is negative, and what is no number, to 0.
        let bin = &mut bins[((confidence * BINS as f64) as usize).min(BINS - 1)];
        bin.clicks += 1;
        bin.confidence += confidence;
        bin.iou += iou;
    }
    bins
}

/// The expected calibration error: the mean over all clicks of how far the mean IoU of their bin is from its mean confidence.
fn calibration_error(bins: &[ReliabilityBin]) -> f64 {
    let clicks: usize = bins.iter().map(|bin| bin.clicks).sum();
    let apart: f64 = bins.iter().map(|bin| (bin.confidence - bin.iou).abs()).sum();
    apart / clicks.max(1) as f64
}

/// The section of the page; empty where no answer has a confidence.
pub fn section(records: &[Record]) -> String {
    let pair = |r: &Record| Some([*r.numbers.get(CONFIDENCE)?, *r.numbers.get("iou")?]);
    let pairs: Vec<[f64; 2]> = records.iter().filter_map(pair).collect();
    if pairs.is_empty() {
        return String::new();
    }
    let bins = bins(&pairs);
    let mut text = String::from(
        "\n## How sure the answers are\n\nAn answer knows its confidence, the IoU that it expects of itself, without any true mask. Clicks of all \
         sizes, by their confidence; the bars are mean IoUs.\n\n\
         | confidence | clicks | mean confidence | mean IoU | |\n|---|---:|---:|---:|---|\n",
    );
    for (k, bin) in bins.iter().enumerate() {
        let edge = |k: usize| k as f64 / BINS as f64;
        let _ = write!(text, "| {:.1} to {:.1} | {} |", edge(k), edge(k + 1), bin.clicks);
        let _ = match bin.means() {
            Some([confidence, iou]) => {
                writeln!(text, " {confidence:.3} | {iou:.3} | {} |", "█".repeat((BAR * iou).round() as usize))
            }
            None => writeln!(text, " - | - | |"),
        };
    }
    let _ = writeln!(text, "\nExpected calibration error: {:.3}.", calibration_error(&bins));
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clicks_are_sorted_by_confidence_and_their_errors_weigh_by_their_number() {
        let pairs = [[0.1, 0.3], [0.9, 0.7], [1.0, 0.9], [0.8, 0.8], [0.5, 0.5]];
        let sorted = bins(&pairs);
        assert_eq!(sorted.map(|bin| bin.clicks), [1, 0, 1, 0, 3]);
        let [confidence, iou] = sorted[4].means().expect("there are clicks");
        assert!((confidence - 0.9).abs() < 1e-12 && (iou - 0.8).abs() < 1e-12);
        assert_eq!(sorted[1].means(), None);
        // One click is .2 off, three are .1 off in the mean, one is right.
        assert!((calibration_error(&sorted) - (0.2 + 3.0 * 0.1) / 5.0).abs() < 1e-12);
        assert_eq!(bins(&[[-0.5, 0.0], [f64::NAN, 0.0], [7.0, 0.0]]).map(|bin| bin.clicks), [2, 0, 0, 0, 1]);
        assert_eq!(calibration_error(&[]), 0.0);
    }

    #[test]
    fn the_section_has_a_row_for_each_bin_and_none_without_confidences() {
        let record = |numbers: &[(&str, f64)]| Record {
            numbers: numbers.iter().map(|(name, number)| ((*name).to_owned(), *number)).collect(),
            ..Record::default()
        };
        let text = section(&[record(&[(CONFIDENCE, 0.7), ("iou", 0.5)]), record(&[("iou", 0.0)])]);
        assert!(text.contains("| 0.6 to 0.8 | 1 | 0.700 | 0.500 | ██████████ |\n"), "{text}");
        assert!(text.contains("| 0.0 to 0.2 | 0 | - | - | |\n"), "{text}");
        assert!(text.contains("calibration error: 0.200."), "{text}");
        assert_eq!(section(&[record(&[("iou", 0.5)])]), "");
    }
}
