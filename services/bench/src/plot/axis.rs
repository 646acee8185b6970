//! Axes with labels that a person would write.

use plotters::coord::ranged1d::{KeyPointHint, NoDefaultFormatting, Ranged, ValueFormatter};
use std::ops::Range;

/// An axis that is even or by factors, with labels that a person would write.
pub(super) struct Axis {
    pub from: f64,
    pub to: f64,
    log: bool,
    names: Vec<String>,
}

impl Axis {
    /// One that holds all values, with some margin on both sides.
    pub fn around(values: &[f64], log: bool, names: &[String]) -> Axis {
        let usable = values.iter().copied().filter(|v| v.is_finite() && (!log || *v > 0.0));
        let to_line = |v: f64| if log { v.ln() } else { v };
        let line: Vec<f64> = usable.map(to_line).collect();
        let least = line.iter().copied().fold(f64::INFINITY, f64::min);
        let most = line.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let (least, most) = if least <= most { (least, most) } else { (0.0, 1.0) };
        let tiny = if log { 0.2 } else { (0.02 * most.abs()).max(1e-6) };
        let margin = (0.1 * (most - least)).max(tiny);
        let back = |v: f64| if log { v.exp() } else { v };
        if !names.is_empty() {
            return Axis { from: -0.5, to: names.len() as f64 - 0.5, log: false, names: names.to_vec() };
        }
        Axis { from: back(least - margin), to: back(most + margin), log, names: Vec::new() }
    }

    pub fn share(&self, v: f64) -> f64 {
        if self.log {
            (v.max(1e-300) / self.from).ln() / (self.to / self.from).ln()
        } else {
            (v - self.from) / (self.to - self.from)
        }
    }

    pub fn ticks(&self, most: usize) -> Vec<f64> {
        if !self.names.is_empty() {
            return (0..self.names.len()).map(|i| i as f64).collect();
        }
        let inside = |v: &f64| *v >= self.from && *v <= self.to;
        if self.log {
            // As many digits per decade as fit.
            for digits in [&[1.0, 1.5, 2.0, 3.0, 5.0, 7.0][..], &[1.0, 2.0, 5.0], &[1.0, 3.0], &[1.0]] {
                let decades = self.from.log10().floor() as i32..=self.to.log10().ceil() as i32;
                let all = decades.flat_map(|d| digits.iter().map(move |x| x * 10f64.powi(d)));
                let ticks: Vec<f64> = all.filter(inside).collect();
                if ticks.len() <= most {
                    return ticks;
                }
            }
            let decades = (self.to / self.from).log10() / most as f64;
            let every = decades.ceil().max(1.0) as i32;
            let from = self.from.log10().ceil() as i32;
            return (0..).map(|k| 10f64.powi(from + k * every)).take_while(|v| *v <= self.to).collect();
        }
        let rough = (self.to - self.from) / most.max(1) as f64;
        let decade = 10f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].map(|f| f * decade).into_iter().find(|s| *s >= rough);
        let step = step.unwrap_or(10.0 * decade);
        let first = (self.from / step).ceil();
        (0..).map(|k| (first + f64::from(k)) * step).take_while(|v| *v <= self.to).collect()
    }
}

impl Ranged for Axis {
    type FormatOption = NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, (from, to): (i32, i32)) -> i32 {
        // Far outside is still a coordinate that an SVG file can hold.
        let at = self.share(*value).clamp(-3.0, 4.0);
        from + (f64::from(to - from) * at).round() as i32
    }

    fn key_points<H: KeyPointHint>(&self, hint: H) -> Vec<f64> {
        self.ticks(hint.max_num_points())
    }

    fn range(&self) -> Range<f64> {
        self.from..self.to
    }
}

impl ValueFormatter<f64> for Axis {
    fn format(value: &f64) -> String {
        short(*value)
    }
}

/// A number as a person would write it beside an axis: 0.75, 12, 3k, 1.5M.
pub fn short(value: f64) -> String {
    let plain = |v: f64| {
        let text = format!("{v:.3}");
        let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
        text.to_owned()
    };
    match value.abs() {
        v if v >= 1e6 => format!("{}M", plain(value / 1e6)),
        v if v >= 1e4 => format!("{}k", plain(value / 1e3)),
        v if v >= 100.0 => format!("{value:.0}"),
        v if v >= 1e-3 || v == 0.0 => plain(value),
        _ => format!("{value:.0e}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_labelled_with_round_numbers() {
        let axis = Axis::around(&[0.31, 0.92], false, &[]);
        assert!(axis.ticks(8).iter().all(|t| (t * 10.0).fract().abs() < 1e-6 || (t * 10.0).fract() > 0.999));
        let factors = Axis::around(&[0.2, 900.0], true, &[]);
        let ticks = factors.ticks(8);
        assert!(ticks.len() >= 3 && ticks.len() <= 8, "{ticks:?}");
        let wide = Axis::around(&[1e-6, 1e12], true, &[]);
        assert!((3..=9).contains(&wide.ticks(8).len()), "{:?}", wide.ticks(8));
        assert_eq!([0.75, 12.0, 30_000.0, 1.5e6, 0.0].map(short), ["0.75", "12", "30k", "1.5M", "0"]);
    }
}
