//! Densification as sampling (Kheradmand et al. 2024): a cap, dead splats relocated onto living ones so that
//! the image stays, and noise on the centres of nearly transparent splats.

use super::control::{Density, DensityChange, StepObservation, Surroundings};
use super::reshaping::Reshaping;
use crate::{TrainError, TrainSettings};
use glam::Vec3;
use segwild_raster::SplatGrads;
use segwild_scene::{Random, Splats, logit, sigmoid};
use wincode::{SchemaRead, SchemaWrite};

/// A splat of at most this opacity is dead.
const DEAD: f32 = 0.005;
/// Weight of the mean opacity and of the mean scale in the loss.
const REGULARISER: f32 = 0.01;
/// The paper's noise factor times its learning rate of the centres, at the start.
const NOISE: f32 = 5e5 * 1.6e-4;
/// Most copies of one splat that one relocation makes.
const COPIES: usize = 51;

#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct Mcmc {
    steps: u32,
    from: u32,
    until: u32,
    every: u32,
}

impl Mcmc {
    pub fn new(settings: &TrainSettings) -> Mcmc {
        let steps = settings.steps;
        Mcmc { steps, from: (steps / 20).min(500), until: steps / 6 * 5, every: (steps / 60).clamp(8, 100) }
    }

    /// Noise along each splat's own shape, strong where it is nearly transparent, fading over the run as the learning
    /// rate of the centres does.
    fn shake(&self, splats: &mut Splats, step: u32, random: &mut Random) {
        let strength = NOISE * 0.001f32.powf(step as f32 / self.steps as f32);
        for i in 0..splats.len() {
            let transparency = sigmoid(100.0 * (DEAD - splats.opacity(i)));
            let noise = Vec3::new(random.normal(), random.normal(), random.normal());
            let moved = splats.mean(i) + splats.covariance(i) * noise * transparency * strength;
            if moved.is_finite() {
                splats.means[i] = moved.into();
            }
        }
    }
}

/// Opacity and scale factor of each of `n` equal splats at one position whose blended image is that of one splat of
/// opacity `o` (paper, Eq. 9).
pub(crate) fn relocated(o: f32, n: usize) -> (f32, f32) {
    let o = f64::from(o).min(0.999_999);
    let each = 1.0 - (1.0 - o).powf(1.0 / n as f64);
    let mut sum = 0.0;
    for i in 1..=n {
        let mut binomial = 1.0;
        for k in 0..i {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            sum += sign * binomial * each.powi(k as i32 + 1) / ((k + 1) as f64).sqrt();
            binomial *= (i - 1 - k) as f64 / (k + 1) as f64;
        }
    }
    (each as f32, (o / sum) as f32)
}

/// Samples `count` splats with probability proportional to opacity, among those alive.
fn sample(splats: &Splats, alive: &[usize], count: usize, random: &mut Random) -> Vec<usize> {
    let mut sums = Vec::with_capacity(alive.len());
    let mut total = 0.0f64;
    for &i in alive {
        total += f64::from(splats.opacity(i));
        sums.push(total);
    }
    (0..count)
        .map(|_| {
            let u = f64::from(random.uniform()) * total;
            alive[sums.partition_point(|&s| s <= u).min(alive.len() - 1)]
        })
        .collect()
}

/// Puts a copy of `sources[k]` at `targets[k]`, lowering opacity and scale of all copies and of the source
/// so that the image stays.
pub(crate) fn copy_splats(splats: &mut Splats, sources: &[usize], targets: &[usize]) {
    let mut copies = vec![1usize; splats.len()];
    for &s in sources {
        copies[s] += 1;
    }
    for s in 0..copies.len() {
        if copies[s] > 1 {
            let (o, factor) = relocated(splats.opacity(s), copies[s].min(COPIES));
            splats.opacities[s] = logit(o.clamp(DEAD, 1.0 - 1e-6));
            for a in &mut splats.log_scales[s] {
                *a += factor.ln();
            }
        }
    }
    let k = splats.sh_stride();
    for (&s, &t) in sources.iter().zip(targets) {
        splats.means[t] = splats.means[s];
        splats.log_scales[t] = splats.log_scales[s];
        splats.rotations[t] = splats.rotations[s];
        splats.opacities[t] = splats.opacities[s];
        splats.sh.copy_within(s * k..(s + 1) * k, t * k);
    }
}

impl Density for Mcmc {
    fn observe(&mut self, _seen: &StepObservation) {}

    fn regularise(&self, splats: &Splats, grads: &mut SplatGrads) {
        let weight = REGULARISER / splats.len().max(1) as f32;
        for i in 0..splats.len() {
            let o = splats.opacity(i);
            grads.opacities[i] += weight * o * (1.0 - o);
            let scale = splats.scale(i);
            for a in 0..3 {
                grads.log_scales[i][a] += weight / 3.0 * scale[a];
            }
        }
    }

    /// At every step: it shakes the splats.
    fn acts(&self, _step: u32) -> bool {
        true
    }

    fn act(
        &mut self,
        all: &mut Reshaping,
        around: &mut Surroundings,
    ) -> Result<Option<DensityChange>, TrainError> {
        let step = around.step;
        let mut change = None;
        if step >= self.from && step <= self.until && step.is_multiple_of(self.every) {
            let n = all.splats.len();
            let lives = |i: usize| all.healthy(i) && all.splats.opacity(i) > DEAD;
            let (alive, dead): (Vec<usize>, Vec<usize>) = (0..n).partition(|&i| lives(i));
            if !alive.is_empty() {
                let grown = (n + n / 20 + 1).min(around.cap.max(n));
                let mut targets = dead.clone();
                targets.extend(n..grown);
                let sources = sample(&all.splats, &alive, targets.len(), around.random);
                let mut parents: Vec<usize> = (0..grown).collect();
                targets.iter().zip(&sources).for_each(|(&target, &source)| parents[target] = source);
                all.remap(&parents);
                copy_splats(&mut all.splats, &sources, &targets);
                all.forget(sources.iter().chain(&targets).copied());
                change =
                    Some(DensityChange { added: grown - n, removed: dead.len(), ..DensityChange::default() });
            }
        }
        self.shake(&mut all.splats, step, around.random);
        Ok(change)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_together_are_as_opaque_and_as_heavy_as_the_one() {
        for o in [0.05f32, 0.4, 0.9, 0.999] {
            for n in [1usize, 2, 5, 20] {
                let (each, factor) = relocated(o, n);
                assert!((1.0 - (1.0 - f64::from(each)).powi(n as i32) - f64::from(o)).abs() < 1e-4);
                // The defining property: the integral along a line through the centre stays.
                let (mut one, mut many) = (0.0f64, 0.0f64);
                for k in -4000..=4000 {
                    let x = f64::from(k) * 0.005;
                    one += f64::from(o) * (-0.5 * x * x).exp();
                    let y = x / f64::from(factor);
                    many += 1.0 - (1.0 - f64::from(each) * (-0.5 * y * y).exp()).powi(n as i32);
                }
                assert!((many / one - 1.0).abs() < 5e-3, "o {o} n {n}: {many} {one}");
            }
        }
    }
}
