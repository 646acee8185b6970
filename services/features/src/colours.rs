//! Features as colours, for viewing only.

use crate::{FeatureError, FeatureField, Pca};
use segwild_raster::Frame;
use segwild_scene::Image;

/// Features that the colours are chosen from.
const SAMPLES: usize = 20_000;
/// Pixels covered less than this stay black.
const COVERED: f32 = 0.05;

/// A choice of colours under which different features have different colours: the three main components of the
/// directions of a field's features. One choice serves all views, so an object keeps its colour.
#[derive(Clone, Debug)]
pub struct FeatureColours {
    pca: Option<Pca>,
    /// Value of each component that becomes 0, and the one that becomes 1.
    ranges: Vec<(f32, f32)>,
}

impl FeatureColours {
    /// Chooses colours for a field. A field of one feature is grey.
    pub fn of(field: &FeatureField) -> Result<FeatureColours, FeatureError> {
        let stride = field.len().div_ceil(SAMPLES).max(1);
        let mut samples = Vec::new();
        for splat in (0..field.len()).step_by(stride) {
            samples.extend(direction(&field.feature(splat)).unwrap_or_default());
        }
        let pca = match Pca::fit(&samples, field.channels(), 3, 1.0) {
            Ok(pca) => pca,
            Err(FeatureError::Flat | FeatureError::NoSamples) => {
                return Ok(FeatureColours { pca: None, ranges: Vec::new() });
            }
            Err(other) => return Err(other),
        };
        let mut axes = vec![Vec::new(); pca.channels];
        for sample in samples.chunks_exact(field.channels()) {
            project(&pca, sample).zip(&mut axes).for_each(|(v, axis)| axis.push(v));
        }
        let range = |axis: &mut Vec<f32>| {
            axis.sort_by(f32::total_cmp);
            let at = |share: f32| axis[((axis.len() - 1) as f32 * share) as usize];
            (at(0.01), at(0.99))
        };
        Ok(FeatureColours { ranges: axes.iter_mut().map(range).collect(), pca: Some(pca) })
    }

    /// Colours a rendered feature image: three planes in [0, 1], black where no splat is.
    pub fn paint(&self, frame: &Frame) -> Image {
        let (n, c) = (frame.image.pixels(), frame.image.channels);
        let mut out = Image::zeros(frame.image.width, frame.image.height, 3);
        for p in 0..n {
            let feature: Vec<f32> = (0..c).map(|k| frame.image.data[k * n + p]).collect();
            let Some(unit) = direction(&feature).filter(|_| frame.alpha.data[p] > COVERED) else { continue };
            for k in 0..3 {
                out.data[k * n + p] = 0.5;
            }
            let Some(pca) = self.pca.as_ref().filter(|pca| pca.embedding_channels == c) else { continue };
            for (k, v) in project(pca, &unit).enumerate() {
                let (low, high) = self.ranges[k];
                if high > low {
                    out.data[k * n + p] = ((v - low) / (high - low)).clamp(0.0, 1.0);
                }
            }
        }
        out
    }
}

fn direction(feature: &[f32]) -> Option<Vec<f32>> {
    let length = feature.iter().map(|v| v * v).sum::<f32>().sqrt();
    (length > 0.0 && length.is_finite()).then(|| feature.iter().map(|v| v / length).collect())
}

fn project<'a>(pca: &'a Pca, sample: &'a [f32]) -> impl Iterator<Item = f32> + 'a {
    pca.basis
        .chunks_exact(pca.embedding_channels)
        .map(move |axis| axis.iter().zip(sample).zip(&pca.mean).map(|((b, s), m)| b * (s - m)).sum())
}
