//! The embedding loss L_FE (method, section 4; paper Eq. 10).

use super::RowAdam;
use segwild_nn::{matmul, transpose};
use segwild_scene::Image;

/// `mean(VM |rendered - scale target|)` over cells and channels, both images on the embedding's grid and `validity`
/// (VM) one number per cell; writes the gradient with respect to `rendered` to `grad`.
pub fn embedding_loss(
    rendered: &Image,
    (target, scale): (&Image, f32),
    validity: &[f32],
    grad: &mut Image,
) -> f32 {
    assert_eq!((rendered.data.len(), validity.len()), (target.data.len(), target.pixels()));
    assert_eq!(rendered.data.len(), grad.data.len());
    let n = rendered.pixels();
    let share = 1.0 / rendered.data.len().max(1) as f32;
    let planes = rendered.data.chunks_exact(n).zip(target.data.chunks_exact(n));
    let losses = planes.zip(grad.data.chunks_exact_mut(n)).map(|((rendered, target), grad)| {
        for (((g, f), t), vm) in grad.iter_mut().zip(rendered).zip(target).zip(validity) {
            let t = &(t * scale);
            let sign = i8::from(f > t) - i8::from(f < t);
            *g = vm * share * f32::from(sign);
        }
        // Several sums, so that the compiler may use SIMD.
        let mut sums = [0.0f32; 16];
        let at = |k: usize| validity[k] * (rendered[k] - target[k] * scale).abs();
        let whole = n / 16 * 16;
        for first in (0..whole).step_by(16) {
            for (l, sum) in sums.iter_mut().enumerate() {
                *sum += at(first + l);
            }
        }
        let rest: f32 = (whole..n).map(at).sum();
        f64::from(rest + sums.iter().sum::<f32>())
    });
    (losses.sum::<f64>() * f64::from(share)) as f32
}

/// The learned 1x1 decoder (method, section 4b).
#[derive(Clone, Debug)]
pub struct LearnedDecoder {
    channels: usize,
    embedding_channels: usize,
    /// `[channel][embedding channel]`, then what is added to each embedding channel.
    numbers: Vec<f32>,
    adam: RowAdam,
}

impl LearnedDecoder {
    /// A decoder with these initial weights, `[channel][embedding channel]`, and offsets. `rate` is the optimiser's.
    ///
    /// # Panics
    /// If there are not as many weights as channels need.
    pub fn new(weights: &[f32], offsets: &[f32], rate: f32) -> LearnedDecoder {
        let e = offsets.len();
        assert_eq!(weights.len() % e.max(1), 0, "weights of each channel");
        let channels = weights.len() / e.max(1);
        let adam = RowAdam::new(channels + 1, e, rate);
        LearnedDecoder { channels, embedding_channels: e, numbers: [weights, offsets].concat(), adam }
    }

    /// Its input and output channels.
    pub fn size(&self) -> (usize, usize) {
        (self.channels, self.embedding_channels)
    }

    /// Weights, `[channel][embedding channel]`, then offsets.
    pub fn numbers(&self) -> &[f32] {
        &self.numbers
    }

    /// The optimiser's rate.
    pub fn rate(&self) -> f32 {
        self.adam.rate()
    }

    /// L_FE between the decoded `rendered` channels and the scaled embedding; steps the decoder and writes the gradient
    /// with respect to the channels.
    pub fn step(
        &mut self,
        rendered: &Image,
        target: (&Image, f32),
        validity: &[f32],
        grad: &mut Image,
    ) -> f32 {
        let (loss, gradient) = self.gradients(rendered, target, validity, grad);
        let (c, e, n) = (self.channels, self.embedding_channels, rendered.pixels());
        let mut numbers = vec![0.0; (c + 1) * e];
        let (weights, offsets) = numbers.split_at_mut(c * e);
        matmul(&rendered.data, &transpose(&gradient.data, e, n), c, n, e, weights);
        for (offset, plane) in offsets.iter_mut().zip(gradient.data.chunks_exact(n)) {
            *offset = plane.iter().sum();
        }
        self.adam.step(&mut self.numbers, &numbers);
        loss
    }

    /// The loss, the gradient with respect to the decoded image (returned) and to the compressed channels (written).
    fn gradients(
        &self,
        rendered: &Image,
        target: (&Image, f32),
        validity: &[f32],
        grad: &mut Image,
    ) -> (f32, Image) {
        let (c, e, n) = (self.channels, self.embedding_channels, rendered.pixels());
        let (weights, offsets) = self.numbers.split_at(c * e);
        let mut decoded = Image::zeros(rendered.width, rendered.height, e);
        matmul(&transpose(weights, c, e), &rendered.data, e, c, n, &mut decoded.data);
        for (plane, offset) in decoded.data.chunks_exact_mut(n).zip(offsets) {
            plane.iter_mut().for_each(|v| *v += offset);
        }
        let mut gradient = Image::zeros(rendered.width, rendered.height, e);
        let loss = embedding_loss(&decoded, target, validity, &mut gradient);
        matmul(weights, &gradient.data, c, e, n, &mut grad.data);
        (loss, gradient)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::Random;

    fn noise(random: &mut Random, width: usize, height: usize, channels: usize) -> Image {
        let data = (0..width * height * channels).map(|_| random.normal()).collect();
        Image { width, height, channels, data }
    }

    #[test]
    fn gradients_agree_with_central_differences() {
        let mut random = Random::new(11);
        let (rendered, target) = (noise(&mut random, 5, 4, 3), noise(&mut random, 5, 4, 3));
        let validity: Vec<f32> = (0..20).map(|i| if i == 7 { 0.0 } else { (i % 4) as f32 / 3.0 }).collect();
        let mut grad = Image::filled(5, 4, 3, f32::NAN);
        embedding_loss(&rendered, (&target, 1.0), &validity, &mut grad);
        let exact = |rendered: &[f64]| -> f64 {
            let terms = rendered.iter().zip(&target.data).enumerate();
            terms.map(|(i, (f, t))| f64::from(validity[i % 20]) * (f - f64::from(*t)).abs()).sum::<f64>()
                / 60.0
        };
        let start: Vec<f64> = rendered.data.iter().map(|&v| f64::from(v)).collect();
        for i in 0..60 {
            let (mut up, mut down) = (start.clone(), start.clone());
            up[i] += 1e-6;
            down[i] -= 1e-6;
            let slope = (exact(&up) - exact(&down)) / 2e-6;
            assert!((slope - f64::from(grad.data[i])).abs() < 1e-7, "{i}");
        }
    }

    #[test]
    fn the_learned_decoder_has_the_gradient_of_its_loss_and_learns() {
        let mut random = Random::new(12);
        let (rendered, target) = (noise(&mut random, 5, 4, 2), noise(&mut random, 5, 4, 6));
        let validity = vec![1.0; 20];
        let weights: Vec<f32> = (0..12).map(|_| random.normal()).collect();
        let offsets: Vec<f32> = (0..6).map(|_| random.normal()).collect();
        let decoder = LearnedDecoder::new(&weights, &offsets, 1e-2);
        let (mut grad, scale) = (Image::zeros(5, 4, 2), 0.3);
        decoder.gradients(&rendered, (&target, scale), &validity, &mut grad);
        let exact = |splat_embeddings: &[f64]| -> f64 {
            let term = |j: usize, p: usize| {
                let decoded = (0..2).map(|k| f64::from(weights[k * 6 + j]) * splat_embeddings[k * 20 + p]);
                let target = f64::from(target.data[j * 20 + p]) * f64::from(scale);
                (decoded.sum::<f64>() + f64::from(offsets[j]) - target).abs()
            };
            (0..120).map(|i| term(i / 20, i % 20)).sum::<f64>() / 120.0
        };
        let start: Vec<f64> = rendered.data.iter().map(|&v| f64::from(v)).collect();
        for i in 0..40 {
            let (mut up, mut down) = (start.clone(), start.clone());
            up[i] += 1e-6;
            down[i] -= 1e-6;
            let slope = (exact(&up) - exact(&down)) / 2e-6;
            assert!((slope - f64::from(grad.data[i])).abs() < 1e-6, "{i}: {slope} {}", grad.data[i]);
        }
        // The decoder that made a target is found again.
        let truth = LearnedDecoder::new(&weights.iter().map(|w| w * 1.3).collect::<Vec<_>>(), &[5.0; 6], 0.0);
        let mut made = Image::zeros(5, 4, 6);
        for (j, plane) in made.data.chunks_exact_mut(20).enumerate() {
            for (p, v) in plane.iter_mut().enumerate() {
                let splat_embeddings = (0..2).map(|k| truth.numbers[k * 6 + j] * rendered.data[k * 20 + p]);
                *v = splat_embeddings.sum::<f32>() + 5.0;
            }
        }
        let mut decoder = LearnedDecoder::new(&weights, &[4.0; 6], 1e-2);
        let losses: Vec<f32> =
            (0..400).map(|_| decoder.step(&rendered, (&made, 1.0), &validity, &mut grad)).collect();
        assert!(losses[399] < 0.1 * losses[0], "{} -> {}", losses[0], losses[399]);
        assert!(decoder.numbers[12..].iter().all(|b| (b - 5.0).abs() < 0.2), "{:?}", decoder.numbers);
    }
}
