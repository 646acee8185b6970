//! The embedding loss L_FE (method, section 4; paper Eq. 10).

use crate::matmul::{matmul, transpose};
use crate::{Decoder, Pca};
use segwild_raster::RowAdam;
use segwild_scene::Image;

/// `mean(VM |rendered - target|)` over cells and channels, both images on the embedding's grid and `validity`
/// (VM) one number per cell; writes the gradient with respect to `rendered` to `grad`.
pub fn embedding_loss(rendered: &Image, target: &Image, validity: &[f32], grad: &mut Image) -> f32 {
    assert_eq!((rendered.data.len(), validity.len()), (target.data.len(), target.pixels()));
    assert_eq!(rendered.data.len(), grad.data.len());
    let n = rendered.pixels();
    let share = 1.0 / rendered.data.len().max(1) as f32;
    let planes = rendered.data.chunks_exact(n).zip(target.data.chunks_exact(n));
    let losses = planes.zip(grad.data.chunks_exact_mut(n)).map(|((rendered, target), grad)| {
        for (((g, f), t), vm) in grad.iter_mut().zip(rendered).zip(target).zip(validity) {
            let sign = i8::from(f > t) - i8::from(f < t);
            *g = vm * share * f32::from(sign);
        }
        // Several sums, so that the compiler may use SIMD.
        let mut sums = [0.0f32; 16];
        let at = |k: usize| validity[k] * (rendered[k] - target[k]).abs();
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

/// The learned 1x1 decoder (method, section 4b), in embedding units times [`Pca::scale`].
///
/// It starts at the principal components' decoder: from a random one, features need tens of thousands of steps
/// before they mean anything.
pub(crate) struct LearnedDecoder {
    channels: usize,
    scale: f32,
    /// `[channel][embedding channel]`.
    weights: Vec<f32>,
    bias: Vec<f32>,
    weights_adam: RowAdam,
    bias_adam: RowAdam,
}

impl LearnedDecoder {
    pub(crate) fn new(pca: &Pca, rate: f32) -> LearnedDecoder {
        LearnedDecoder {
            channels: pca.channels,
            scale: pca.scale,
            weights: pca.basis.clone(),
            bias: pca.mean.iter().map(|m| m * pca.scale).collect(),
            weights_adam: RowAdam::new(pca.channels, pca.embedding_channels, rate),
            bias_adam: RowAdam::new(1, pca.embedding_channels, rate),
        }
    }

    /// L_FE between the decoded `rendered` codes and the embedding `target`; steps the decoder and writes the
    /// gradient with respect to the codes.
    pub(crate) fn step(
        &mut self,
        rendered: &Image,
        target: &Image,
        validity: &[f32],
        grad: &mut Image,
    ) -> f32 {
        let (loss, gradient) = self.gradients(rendered, target, validity, grad);
        let (c, e, n) = (self.channels, self.bias.len(), rendered.pixels());
        let mut weights = vec![0.0; c * e];
        matmul(&rendered.data, &transpose(&gradient.data, e, n), c, n, e, &mut weights);
        let bias: Vec<f32> = gradient.data.chunks_exact(n).map(|plane| plane.iter().sum()).collect();
        self.weights_adam.step(&mut self.weights, &weights);
        self.bias_adam.step(&mut self.bias, &bias);
        loss
    }

    /// The loss, the gradient with respect to the decoded image (returned) and to the codes (written).
    fn gradients(
        &self,
        rendered: &Image,
        target: &Image,
        validity: &[f32],
        grad: &mut Image,
    ) -> (f32, Image) {
        let (c, e, n) = (self.channels, self.bias.len(), rendered.pixels());
        let mut decoded = Image::zeros(rendered.width, rendered.height, e);
        matmul(&transpose(&self.weights, c, e), &rendered.data, e, c, n, &mut decoded.data);
        for (plane, bias) in decoded.data.chunks_exact_mut(n).zip(&self.bias) {
            plane.iter_mut().for_each(|v| *v += bias);
        }
        let mut scaled = target.clone();
        scaled.data.iter_mut().for_each(|v| *v *= self.scale);
        let mut gradient = Image::zeros(rendered.width, rendered.height, e);
        let loss = embedding_loss(&decoded, &scaled, validity, &mut gradient);
        matmul(&self.weights, &gradient.data, c, e, n, &mut grad.data);
        (loss, gradient)
    }

    /// The decoder in the embedding's units.
    pub(crate) fn finish(self) -> Decoder {
        Decoder {
            channels: self.channels,
            embedding_channels: self.bias.len(),
            weights: self.weights.iter().map(|w| w / self.scale).collect(),
            bias: self.bias.iter().map(|b| b / self.scale).collect(),
        }
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
        embedding_loss(&rendered, &target, &validity, &mut grad);
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
        let samples: Vec<f32> = (0..200 * 6).map(|_| random.normal() * 40.0).collect();
        let pca = Pca::fit(&samples, 6, 2, 1.0).unwrap();
        let (rendered, target) = (noise(&mut random, 5, 4, 2), noise(&mut random, 5, 4, 6));
        let validity = vec![1.0; 20];
        let decoder = LearnedDecoder::new(&pca, 1e-2);
        let mut grad = Image::zeros(5, 4, 2);
        decoder.gradients(&rendered, &target, &validity, &mut grad);
        let exact = |codes: &[f64]| -> f64 {
            let term = |j: usize, p: usize| {
                let weights = (0..2).map(|k| f64::from(decoder.weights[k * 6 + j]) * codes[k * 20 + p]);
                let target = f64::from(target.data[j * 20 + p]) * f64::from(decoder.scale);
                (weights.sum::<f64>() + f64::from(decoder.bias[j]) - target).abs()
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
        let truth = Decoder {
            channels: 2,
            embedding_channels: 6,
            weights: pca.decoder().weights.iter().map(|w| w * 1.3).collect(),
            bias: vec![5.0; 6],
        };
        let made = truth.decode(&rendered).unwrap();
        let target = Image { width: 5, height: 4, channels: 6, data: made.data };
        let mut decoder = LearnedDecoder::new(&pca, 1e-2);
        let losses: Vec<f32> =
            (0..400).map(|_| decoder.step(&rendered, &target, &validity, &mut grad)).collect();
        assert!(losses[399] < 0.1 * losses[0], "{} -> {}", losses[0], losses[399]);
        let found = decoder.finish();
        assert!(found.bias.iter().all(|b| (b - 5.0).abs() < 2.0), "{:?}", found.bias);
    }
}
