//! What grows, and the power law through what was measured along it.

use segwild_eval::metrics::Spread;
use segwild_eval::record::Results;

/// The protocol under which everything here is recorded.
pub const PROTOCOL: &str = "scale";
/// What grows, in the order of the page.
pub const AXES: [&str; 8] = [
    "kernels splats",
    "kernels pixels",
    "kernels channels",
    "photos",
    "splats",
    "pixels",
    "objects",
    "clicks",
];

/// A power law through measurements: `factor * size ^ slope`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// The exponent: 1 is linear, 0 does not grow.
    pub slope: f64,
    /// Value at size 1.
    pub factor: f64,
    /// Exponent between the two largest sizes: what small sizes owe to fixed costs is gone there.
    pub last: f64,
}

impl Fit {
    /// Least squares on logarithms; `None` of fewer than two positive points.
    pub fn of(points: &[(f64, f64)]) -> Option<Fit> {
        let mut logs: Vec<(f64, f64)> =
            points.iter().filter(|p| p.0 > 0.0 && p.1 > 0.0).map(|p| (p.0.ln(), p.1.ln())).collect();
        logs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mean = |pick: fn(&(f64, f64)) -> f64| Spread::of(&logs.iter().map(pick).collect::<Vec<_>>());
        let (x, y) = (mean(|p| p.0)?.mean, mean(|p| p.1)?.mean);
        let across: f64 = logs.iter().map(|p| (p.0 - x) * (p.0 - x)).sum();
        if across <= 0.0 {
            return None;
        }
        let slope = logs.iter().map(|p| (p.0 - x) * (p.1 - y)).sum::<f64>() / across;
        let (a, b) = (logs[logs.len() - 2], logs[logs.len() - 1]);
        Some(Fit { slope, factor: (y - slope * x).exp(), last: (b.1 - a.1) / (b.0 - a.0) })
    }
}

/// The measurements of one number along one axis, smallest size first.
pub fn along(results: &Results, axis: &str, number: &str) -> Vec<(f64, f64)> {
    let of = results.records.iter().filter(|r| r.setting == axis);
    let mut points: Vec<(f64, f64)> = of.filter_map(|r| Some((r.at?, *r.numbers.get(number)?))).collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    points
}

/// A value at a size that was not measured, from the largest measured one on by the growth between the two largest;
/// growth is taken to be at least `least`, since what is linear looks flat where fixed costs rule.
pub fn beyond(points: &[(f64, f64)], size: f64, least: f64) -> Option<f64> {
    let fit = Fit::of(points)?;
    let (at, value) = *points.last()?;
    Some(value * (size / at).powf(fit.last.max(least)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slopes_are_those_of_power_laws() {
        let fit = Fit::of(&[(1.0, 3.0), (10.0, 300.0), (100.0, 30_000.0)]).unwrap();
        assert!(
            (fit.slope - 2.0).abs() < 1e-9
                && (fit.factor - 3.0).abs() < 1e-9
                && (fit.last - 2.0).abs() < 1e-9
        );
        assert_eq!(Fit::of(&[(5.0, 1.0)]), None);
        assert_eq!(Fit::of(&[(5.0, 1.0), (5.0, 2.0)]), None);
        let flat = beyond(&[(1.0, 8.0), (10.0, 8.0)], 100.0, 1.0).unwrap();
        assert!((flat - 80.0).abs() < 1e-9, "{flat}");
    }
}
