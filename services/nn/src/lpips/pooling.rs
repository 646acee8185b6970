//! Max pooling without a border: of each window the largest number.

use crate::map::Map;
use rayon::prelude::*;

/// Windows of `window` x `window`, `stride` apart. Windows that would reach over the edge are left out.
#[derive(Clone, Copy, Debug)]
pub(super) struct MaxPool {
    pub window: usize,
    pub stride: usize,
}

/// Which number of its window each result is, from left to right and down.
pub(super) type Winners = Vec<u8>;

impl MaxPool {
    /// Windows along an edge of so many numbers.
    pub fn size(&self, edge: usize) -> usize {
        if edge < self.window { 0 } else { (edge - self.window) / self.stride + 1 }
    }

    /// The largest numbers, and where they are. Of equal ones the first counts; NaN is larger than all.
    pub fn forward(&self, x: &Map) -> (Map, Winners) {
        let (height, width) = (self.size(x.height), self.size(x.width));
        let mut out = Map::zeros(x.channels, height, width);
        let n = out.pixels();
        let mut winners = vec![0; out.data.len()];
        if n == 0 {
            return (out, winners);
        }
        let planes = out.data.par_chunks_exact_mut(n).zip(winners.par_chunks_exact_mut(n));
        planes.enumerate().for_each(|(c, (out, winners))| {
            let plane = x.plane(c);
            for (k, (out, winner)) in out.iter_mut().zip(winners).enumerate() {
                let from = k / width * self.stride * x.width + k % width * self.stride;
                (*out, *winner) = (plane[from], 0);
                for t in 1..self.window * self.window {
                    let v = plane[from + t / self.window * x.width + t % self.window];
                    if v > *out || v.is_nan() {
                        (*out, *winner) = (v, t as u8);
                    }
                }
            }
        });
        (out, winners)
    }

    /// The gradient before it, of `height` rows of `width`, from that after it.
    pub fn backward(&self, grad: &Map, winners: &[u8], (height, width): (usize, usize)) -> Map {
        let mut before = Map::zeros(grad.channels, height, width);
        let n = grad.pixels();
        if n == 0 {
            return before;
        }
        before.data.par_chunks_exact_mut(height * width).enumerate().for_each(|(c, before)| {
            for (k, (g, winner)) in grad.plane(c).iter().zip(&winners[c * n..]).enumerate() {
                let from = k / grad.width * self.stride * width + k % grad.width * self.stride;
                let t = usize::from(*winner);
                before[from + t / self.window * width + t % self.window] += g;
            }
        });
        before
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn overlapping_windows_add_their_gradients_to_the_number_that_won_both() {
        let pool = MaxPool { window: 3, stride: 2 };
        let data = (0..30).map(|k| if k == 7 { 99.0 } else { k as f32 }).collect();
        let x = Map { channels: 1, height: 5, width: 6, data };
        let (out, winners) = pool.forward(&x);
        assert_eq!((out.height, out.width), (2, 2), "the last column is in no window");
        assert_eq!(out.data, [99.0, 16.0, 26.0, 28.0]);
        let x = Map { data: x.data.iter().map(|&v| if v == 14.0 { 200.0 } else { v }).collect(), ..x };
        let (out, again) = pool.forward(&x);
        assert_eq!(out.data, [200.0, 200.0, 200.0, 200.0]);
        assert_ne!(winners, again);
        let before = pool.backward(&Map { data: vec![1.0, 2.0, 3.0, 4.0], ..out }, &again, (5, 6));
        let expected: Vec<f32> = (0..30).map(|k| if k == 14 { 10.0 } else { 0.0 }).collect();
        assert_eq!(before.data, expected);
    }

    #[test]
    fn equal_numbers_and_numbers_that_are_none_have_a_winner() {
        let pool = MaxPool { window: 2, stride: 2 };
        let of =
            |data: [f32; 4]| pool.forward(&Map { channels: 1, height: 2, width: 2, data: data.to_vec() });
        assert_eq!(of([1.0; 4]).1, [0]);
        let (out, winners) = of([1.0, f32::NAN, 5.0, 2.0]);
        assert!(out.data[0].is_nan() && winners == [1]);
        let (none, winners) = pool.forward(&Map::zeros(3, 1, 9));
        assert!(none.data.is_empty() && winners.is_empty());
        assert_eq!(pool.backward(&none, &winners, (1, 9)), Map::zeros(3, 1, 9));
    }
}
