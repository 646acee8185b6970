//! Rows of numbers of 16 bits: the feature vectors of splats, in memory and in files.

use crate::half::{from_half, is_finite, to_half};
use crate::whole::read_whole;
use rayon::prelude::*;
use wincode::SchemaWrite;

/// Share of the rows whose largest number is at most about [`LARGEST`] as it is kept (method, section 6.2). By choice: a row may be
/// 32 times as large as these, and few are damaged. Not varied yet.
const USUAL_ROWS: f64 = 0.999;

/// Exponent of two of the largest number of the usual rows as it is kept: 16 bits have 11 significant ones from 2^-14 to 2^16.
const LARGEST: i32 = 10;

/// A vector per row, its numbers rounded to 16 bits in units of one power of two for all rows: beside the splats, features are the
/// largest array of a session and of a run folder. Records have the same numbers, so that nothing is rounded twice. A record with
/// numbers that are not finite, as they are kept or times the unit, is refused.
#[derive(Clone, Debug, PartialEq, SchemaWrite)]
pub struct HalfRows {
    /// Numbers per row, at least 1.
    channels: usize,
    /// A power of two.
    unit: f32,
    /// `[row][channel]`, flat, as [`to_half`] gives them, in units of `unit`.
    halves: Vec<u16>,
}

read_whole!(
    HalfRows as HalfRowsRecord { channels: usize, unit: f32, halves: Vec<u16> }
    where HalfRows::is_whole,
    "rows of 16-bit numbers do not fit their channels, have no unit, or are not finite"
);

impl HalfRows {
    /// Rounds `values[row][channel]`, flat, in any unit: each to the nearest number of 16 bits. A number may be 32 times as large as
    /// those of 999 of 1000 rows; from 64 times on it becomes infinite. `None` where the numbers do not fill rows of so many
    /// channels.
    pub fn rounded(channels: usize, values: &[f32]) -> Option<HalfRows> {
        if channels == 0 || !values.len().is_multiple_of(channels) {
            return None;
        }
        let unit = unit_of(channels, values);
        let halves = values.par_iter().map(|&value| to_half(value / unit)).collect();
        Some(HalfRows { channels, unit, halves })
    }

    /// Sets all numbers of a row to 0 where one of them is not finite, as it is kept or times the unit.
    pub fn clear_damaged(&mut self) {
        let unit = self.unit;
        self.halves.par_chunks_mut(self.channels).for_each(|row| {
            if !row.iter().all(|&half| is_number(half, unit)) {
                row.fill(0);
            }
        });
    }

    fn is_whole(&self) -> bool {
        self.channels > 0
            && self.halves.len().is_multiple_of(self.channels)
            && self.unit.is_normal()
            && self.unit == f32::from_bits(self.unit.to_bits() & 0x7f80_0000)
            && self.halves.par_iter().all(|&half| is_number(half, self.unit))
    }

    /// Numbers per row.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.halves.len() / self.channels
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.halves.is_empty()
    }

    /// The numbers as they are kept, `[row][channel]`, flat: [`from_half`] gives them in units that differ from those of
    /// [`HalfRows::values`] by a power of two.
    pub fn halves(&self) -> &[u16] {
        &self.halves
    }

    /// A row as it is kept.
    pub fn halves_of(&self, row: usize) -> &[u16] {
        &self.halves[row * self.channels..(row + 1) * self.channels]
    }

    /// All numbers, `[row][channel]`, flat.
    pub fn values(&self) -> Vec<f32> {
        self.halves.par_iter().map(|&half| from_half(half) * self.unit).collect()
    }

    /// A row's numbers.
    pub fn row(&self, row: usize) -> Vec<f32> {
        self.halves_of(row).iter().map(|&half| from_half(half) * self.unit).collect()
    }
}

/// Whether a number is finite, as it is kept and times the unit. Numbers near the largest of 32 bits may be rounded beyond it.
fn is_number(half: u16, unit: f32) -> bool {
    is_finite(half) && (from_half(half) * unit).is_finite()
}

/// The power of two in units of which the largest number of the usual rows is about 2^[`LARGEST`]; 1 where all rows are zero or no
/// numbers. Quotients by it are exact, as far as 32 bits have them.
fn unit_of(channels: usize, values: &[f32]) -> f32 {
    let largest = |row: &[f32]| row.iter().fold(0.0f32, |largest, value| largest.max(value.abs()));
    let mut rows: Vec<f32> =
        values.par_chunks(channels).map(largest).filter(|row| row.is_finite() && *row > 0.0).collect();
    let Some(last) = rows.len().checked_sub(1) else { return 1.0 };
    let (_, usual, _) = rows.select_nth_unstable_by((last as f64 * USUAL_ROWS) as usize, f32::total_cmp);
    let exponent = (usual.to_bits() >> 23) as i32 - 127;
    f32::from_bits((((exponent - LARGEST).clamp(-126, 127) + 127) as u32) << 23)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn again(rows: &HalfRows) -> Option<HalfRows> {
        wincode::deserialize(&wincode::serialize(rows).unwrap()).ok()
    }

    #[test]
    fn a_record_has_the_rounded_numbers_and_half_the_bytes() {
        let values: Vec<f32> = (0..50 * 12).map(|i| ((i * 7919 % 1013) as f32 - 500.0) * 1e-4).collect();
        let rows = HalfRows::rounded(12, &values).unwrap();
        assert_eq!((rows.channels(), rows.len(), rows.is_empty()), (12, 50, false));
        // The channels, the unit, the number of numbers.
        assert_eq!(wincode::serialize(&rows).unwrap().len(), 8 + 4 + 8 + 2 * values.len());
        assert_eq!(again(&rows), Some(rows.clone()));
        assert!(rows.values().iter().zip(&values).all(|(a, b)| (a - b).abs() <= b.abs() / 2048.0));
        assert_eq!(rows.row(3), rows.values()[36..48]);
    }

    #[test]
    fn numbers_that_fill_no_rows_are_refused() {
        assert_eq!(HalfRows::rounded(0, &[]), None);
        assert_eq!(HalfRows::rounded(3, &[0.0; 4]), None);
        assert_eq!(HalfRows::rounded(3, &[]).map(|rows| rows.len()), Some(0));
    }

    #[test]
    fn a_row_with_a_number_that_cannot_be_kept_is_cleared_and_the_others_stay() {
        let values = [1.0, 0.5, f32::NAN, 1.0, -2.0, 0.25, 1e30, 3.0, f32::INFINITY, 0.0];
        let mut rows = HalfRows::rounded(2, &[&values[..], &[1.0; 4000]].concat()).unwrap();
        assert_eq!(again(&rows), None, "a record of these is refused");
        rows.clear_damaged();
        assert_eq!(rows.values()[..10], [1.0, 0.5, 0.0, 0.0, -2.0, 0.25, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(again(&rows), Some(rows.clone()));
        // It is rounded up to 2^128.
        let mut largest = HalfRows::rounded(1, &[f32::MAX, 1e38]).unwrap();
        largest.clear_damaged();
        assert_eq!((largest.row(0), again(&largest)), (vec![0.0], Some(largest.clone())));
    }

    #[test]
    fn a_forged_record_is_refused() {
        let rows = HalfRows::rounded(2, &[1.0, 2.0, 3.0, 4.0]).unwrap();
        let forged = |change: &dyn Fn(&mut HalfRows)| {
            let mut rows = rows.clone();
            change(&mut rows);
            again(&rows)
        };
        assert!(forged(&|rows| rows.unit = 4.0).is_some(), "another power of two is a unit");
        for channels in [0, 3, usize::MAX] {
            assert_eq!(forged(&|rows| rows.channels = channels), None, "{channels}");
        }
        for unit in [0.0, -1.0, 3.0, f32::NAN, f32::INFINITY, 1e-40] {
            assert_eq!(forged(&|rows| rows.unit = unit), None, "{unit}");
        }
        assert_eq!(forged(&|rows| rows.halves[1] = to_half(f32::INFINITY)), None);
        // A half and a unit that are finite, and their product.
        let of = |half: f32, unit: u32| {
            forged(&move |rows| {
                rows.halves[1] = to_half(half);
                rows.unit = f32::from_bits((unit + 127) << 23);
            })
        };
        assert_eq!([of(65504.0, 127), of(-65504.0, 113), of(-2.0, 127)], [None, None, None]);
        assert!(of(65504.0, 112).is_some_and(|rows| rows.values()[1].is_finite()));
        // More numbers than there are bytes.
        let mut bytes = wincode::serialize(&rows).unwrap();
        bytes[12..20].copy_from_slice(&(1u64 << 40).to_le_bytes());
        let read: wincode::ReadResult<HalfRows> = wincode::deserialize(&bytes);
        assert!(read.is_err());
    }
}
