//! Work on the pixels of an image by several cores.

use rayon::prelude::*;
use std::ops::Range;

/// Pixels of a task. By choice: a photo at 320 px is one task, as handing it over costs more than the work; one at 1600 px has
/// fifteen. What is computed does not depend on it, unless sums say so.
pub const TASK_PIXELS: usize = 1 << 17;

/// Calls `f` with the index of the first value and some values in a row, for all of them, by several cores.
///
/// ```
/// let mut squares = vec![0; 100_000];
/// segwild_scene::in_pieces(&mut squares, |first, piece| {
///     piece.iter_mut().zip(first..).for_each(|(square, i)| *square = i * i);
/// });
/// assert_eq!(squares[99_999], 99_999 * 99_999);
/// ```
#[inline]
pub fn in_pieces<T: Send>(values: &mut [T], f: impl Fn(usize, &mut [T]) + Sync) {
    values.par_chunks_mut(TASK_PIXELS).enumerate().for_each(|(task, piece)| f(task * TASK_PIXELS, piece));
}

/// What `f` makes of each pixel of an image with so many, by several cores.
#[inline]
pub fn per_pixel<T: Copy + Default + Send>(pixels: usize, f: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let mut out = vec![T::default(); pixels];
    in_pieces(&mut out, |first, piece| {
        for (value, i) in piece.iter_mut().zip(first..) {
            *value = f(i);
        }
    });
    out
}

/// What `f` makes of ranges of pixels that follow each other, in their order: the same ranges on any number of cores.
#[inline]
pub fn per_piece<T: Send>(pixels: usize, f: impl Fn(Range<usize>) -> T + Sync) -> Vec<T> {
    let tasks = pixels.div_ceil(TASK_PIXELS);
    let piece = |task: usize| task * TASK_PIXELS..((task + 1) * TASK_PIXELS).min(pixels);
    (0..tasks).into_par_iter().map(|task| f(piece(task))).collect()
}

/// Rows of an image of this width that make a task.
pub(crate) fn task_rows(width: usize) -> usize {
    TASK_PIXELS.div_ceil(width.max(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_cover_all_pixels_once_and_in_order() {
        for pixels in [0, 1, TASK_PIXELS, TASK_PIXELS + 1, 3 * TASK_PIXELS - 1] {
            let ranges = per_piece(pixels, |range| range);
            assert!(ranges.iter().cloned().flatten().eq(0..pixels), "{pixels}");
            assert!(per_pixel(pixels, |i| i).into_iter().eq(0..pixels), "{pixels}");
            let mut values = vec![0; pixels];
            in_pieces(&mut values, |first, piece| {
                piece.iter_mut().zip(first..).for_each(|(v, i)| *v += i + 1)
            });
            assert!(values.into_iter().eq(1..=pixels), "{pixels}");
        }
    }
}
