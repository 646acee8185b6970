//! Medians and quantiles of numbers.
//!
//! Numbers are sorted by IEEE 754's total order: NaN counts as a number beyond the infinity of its sign. So a result depends on
//! the numbers alone, and not on the order in which they come.

use std::cmp::Ordering;

/// A number of which there are medians and quantiles: `f32` or `f64`.
pub trait Real: Copy {
    /// The total order of IEEE 754.
    fn order(&self, other: &Self) -> Ordering;
    /// The mean of two numbers.
    fn midway(self, other: Self) -> Self;
    /// The rank at this share of the ranks 0 to `last`, rounded to the nearest one, halves up; computed in this type.
    fn rank(self, last: usize) -> usize;
}

macro_rules! real {
    ($float:ty) => {
        impl Real for $float {
            fn order(&self, other: &Self) -> Ordering {
                self.total_cmp(other)
            }

            fn midway(self, other: Self) -> Self {
                0.5 * (self + other)
            }

            fn rank(self, last: usize) -> usize {
                (self * last as $float).round() as usize
            }
        }
    };
}

real!(f32);
real!(f64);

/// The median; of an even number of values the mean of the middle two, as NumPy has it. `None` of nothing; NaN where a middle one
/// is NaN.
///
/// ```
/// use segwild_scene::statistics::median;
/// assert_eq!(median(vec![4.0, 1.0, 2.0]), Some(2.0));
/// assert_eq!(median(vec![4.0, 1.0, 2.0, 3.0]), Some(2.5));
/// assert_eq!(median(vec![4.0, f32::NAN, 2.0]), Some(4.0));
/// assert_eq!(median(Vec::<f64>::new()), None);
/// ```
pub fn median<T: Real>(mut values: Vec<T>) -> Option<T> {
    values.sort_unstable_by(T::order);
    let last = values.len().checked_sub(1)?;
    Some(values[last / 2].midway(values[values.len() / 2]))
}

/// The upper median: one of the values always, of an even number of them the larger of the middle two. `None` of nothing; NaN
/// where that one is NaN.
///
/// ```
/// use segwild_scene::statistics::upper_median;
/// assert_eq!(upper_median(vec![4.0, 1.0, 2.0]), Some(2.0));
/// assert_eq!(upper_median(vec![4.0, 1.0, 2.0, 3.0]), Some(3.0));
/// assert_eq!(upper_median(vec![4.0, f32::NAN, 2.0]), Some(4.0));
/// assert_eq!(upper_median(Vec::<f64>::new()), None);
/// ```
pub fn upper_median<T: Real>(values: Vec<T>) -> Option<T> {
    let middle = values.len() / 2;
    nth(values, middle)
}

/// The quantile at a share in [0, 1] by the nearest rank: one of the values always. `None` of nothing; NaN where that one is NaN.
///
/// The rank is computed in the type of the values. In another type it may be rounded to a neighbouring one.
///
/// ```
/// use segwild_scene::statistics::quantile;
/// assert_eq!(quantile(vec![5.0, 3.0, 1.0], 0.0), Some(1.0));
/// assert_eq!(quantile(vec![5.0, 3.0, 1.0], 0.7), Some(3.0));
/// assert_eq!(quantile(vec![5.0, 3.0, 1.0, f32::NAN], 0.7), Some(5.0));
/// assert_eq!(quantile(Vec::<f64>::new(), 0.5), None);
/// ```
pub fn quantile<T: Real>(values: Vec<T>, share: T) -> Option<T> {
    let last = values.len().checked_sub(1)?;
    nth(values, share.rank(last))
}

/// The quantile at a share in [0, 1] of values sorted by rising order, interpolated from the two at the nearest ranks. `None` of
/// nothing; NaN where one of the two is NaN.
///
/// ```
/// use segwild_scene::statistics::interpolated_quantile;
/// assert_eq!(interpolated_quantile(&[1.0, 3.0, 5.0], 0.5), Some(3.0));
/// assert_eq!(interpolated_quantile(&[1.0, 3.0, 5.0], 0.625), Some(3.5));
/// assert!(interpolated_quantile(&[1.0, 3.0, f64::NAN], 0.625).is_some_and(f64::is_nan));
/// assert_eq!(interpolated_quantile(&[], 0.5), None);
/// ```
///
/// # Panics
/// If the share is above 1.
pub fn interpolated_quantile(sorted: &[f64], share: f64) -> Option<f64> {
    let at = share * sorted.len().checked_sub(1)? as f64;
    let (low, high) = (at.floor() as usize, at.ceil() as usize);
    Some(sorted[low] + at.fract() * (sorted[high] - sorted[low]))
}

/// The value at a rank from 0; `None` beyond the last.
fn nth<T: Real>(mut values: Vec<T>, rank: usize) -> Option<T> {
    (rank < values.len()).then(|| *values.select_nth_unstable_by(rank, T::order).1)
}
