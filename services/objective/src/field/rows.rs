//! The optimiser of rows of numbers.

use rayon::prelude::*;

/// Decay of the first moments.
pub const BETA1: f32 = 0.9;
/// And of the second ones.
pub const BETA2: f32 = 0.999;
/// Added to the root of the second moments.
pub const EPSILON: f32 = 1e-15;
/// Rows per task. Fixed, so that results do not depend on the number of threads.
const CHUNK: usize = 4096;

/// Adam whose rows keep their own step count and rest while their gradient is zero.
///
/// A step renders one photo, which leaves most splats of a scene unseen: moving those by stale momentum would cost time
/// and pull them without evidence from any photo.
#[derive(Clone, Debug)]
pub struct RowAdam {
    row: usize,
    rate: f32,
    first: Vec<f32>,
    second: Vec<f32>,
    steps: Vec<u32>,
}

impl RowAdam {
    /// An optimiser of `rows` rows of `row` numbers with learning rate `rate`.
    pub fn new(rows: usize, row: usize, rate: f32) -> RowAdam {
        let (first, second) = (vec![0.0; rows * row], vec![0.0; rows * row]);
        RowAdam { row, rate, first, second, steps: vec![0; rows] }
    }

    /// The learning rate.
    pub fn rate(&self) -> f32 {
        self.rate
    }

    /// Moves `values` against `grads`, both `[row][number]`, flat. Rows whose gradient is all zero or not
    /// finite stay where they are.
    ///
    /// # Panics
    /// If there are not as many as there are rows for.
    pub fn step(&mut self, values: &mut [f32], grads: &[f32]) {
        assert_eq!((values.len(), grads.len()), (self.first.len(), self.first.len()));
        let (row, rate) = (self.row.max(1), self.rate);
        values
            .par_chunks_mut(CHUNK * row)
            .zip(grads.par_chunks(CHUNK * row))
            .zip(self.first.par_chunks_mut(CHUNK * row))
            .zip(self.second.par_chunks_mut(CHUNK * row))
            .zip(self.steps.par_chunks_mut(CHUNK))
            .for_each(|((((values, grads), first), second), steps)| {
                for (i, step) in steps.iter_mut().enumerate() {
                    let at = i * row..(i + 1) * row;
                    let grads = &grads[at.clone()];
                    if grads.iter().all(|&g| g == 0.0) || !grads.iter().all(|g| g.is_finite()) {
                        continue;
                    }
                    *step += 1;
                    let bias1 = 1.0 / (1.0 - BETA1.powi(*step as i32));
                    let bias2 = 1.0 / (1.0 - BETA2.powi(*step as i32));
                    let moments = first[at.clone()].iter_mut().zip(&mut second[at.clone()]);
                    for ((value, &g), (m, v)) in values[at].iter_mut().zip(grads).zip(moments) {
                        *m = BETA1 * *m + (1.0 - BETA1) * g;
                        *v = BETA2 * *v + (1.0 - BETA2) * g * g;
                        *value -= rate * (*m * bias1) / ((*v * bias2).sqrt() + EPSILON);
                    }
                }
            });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn follows_the_textbook_and_lets_quiet_rows_rest() {
        let (mut values, mut adam) = (vec![1.0f32, -2.0, 5.0, 5.0, 7.0, 7.0], RowAdam::new(3, 2, 0.1));
        let (mut exact, mut m, mut v) = ([1.0f64, -2.0], [0.0; 2], [0.0; 2]);
        for t in 1..=50 {
            let g = [2.0 * values[0], 0.5 * values[1]];
            let g64 = [2.0 * exact[0], 0.5 * exact[1]];
            adam.step(&mut values, &[g[0], g[1], 0.0, 0.0, f32::NAN, 1.0]);
            for k in 0..2 {
                m[k] = 0.9 * m[k] + 0.1 * g64[k];
                v[k] = 0.999 * v[k] + 0.001 * g64[k] * g64[k];
                let (mh, vh) = (m[k] / (1.0 - 0.9f64.powi(t)), v[k] / (1.0 - 0.999f64.powi(t)));
                exact[k] -= 0.1 * mh / (vh.sqrt() + 1e-15);
            }
        }
        assert!((0..2).all(|k| (f64::from(values[k]) - exact[k]).abs() < 1e-3), "{values:?} {exact:?}");
        assert_eq!(values[2..], [5.0, 5.0, 7.0, 7.0]);
    }
}
