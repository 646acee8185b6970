//! Compression of embeddings by principal components (method, section 4a).

use crate::FeatureError;
use crate::error::check_planes;
use segwild_nn::eigen;
use segwild_nn::{matmul, transpose};
use segwild_scene::Random;
use segwild_scene::{Embedding, Image, Mask};
use wincode::{SchemaRead, SchemaWrite};

/// Most samples that a fit uses (method, section 4).
pub const MAX_SAMPLES: usize = 200_000;
/// Samples whose products are summed in f32 before they enter the f64 sum.
const CHUNK: usize = 1024;

/// Embedding cells sampled from one photo after another, so that embeddings need not all be in memory.
#[derive(Clone, Debug)]
pub struct EmbeddingSamples {
    channels: usize,
    values: Vec<f32>,
    per_view: usize,
    seed: u64,
}

impl EmbeddingSamples {
    /// At most `limit` cells in all from `views` photos (each gives the same number at most).
    pub fn new(limit: usize, views: usize, seed: u64) -> EmbeddingSamples {
        let per_view = limit.clamp(1, MAX_SAMPLES).div_ceil(views.max(1));
        EmbeddingSamples { channels: 0, values: Vec::new(), per_view, seed }
    }

    /// Samples cells of photo number `view`, named `name` in errors. Cells in `sky` and cells whose `validity`
    /// (one plane, any size) is 0.5 or less are left out. The result depends on the order of calls only in
    /// the order of the samples.
    pub fn add(
        &mut self,
        view: usize,
        name: &str,
        embedding: &Embedding,
        validity: Option<&Image>,
        sky: Option<&Mask>,
    ) -> Result<(), FeatureError> {
        let (w, h, c) = (embedding.width, embedding.height, embedding.channels);
        check_planes(name, "embedding", (w, h, c), &embedding.data)?;
        if self.channels != 0 && self.channels != c {
            return Err(FeatureError::Shape(format!(
                "{name}: the embedding has {c} channels, those before it have {}",
                self.channels
            )));
        }
        self.channels = c;
        let under = |i: usize, width: usize, height: usize| {
            let (x, y) = (2 * (i % w) + 1, 2 * (i / w) + 1);
            (x * width / (2 * w), y * height / (2 * h))
        };
        let trusted = |i: usize| {
            validity.is_none_or(|v| {
                let (x, y) = under(i, v.width, v.height);
                v.at(0, x, y) > 0.5
            }) && sky.is_none_or(|s| {
                let (x, y) = under(i, s.width() as usize, s.height() as usize);
                !s.get(x as u32, y as u32)
            })
        };
        let mut cells: Vec<usize> = (0..w * h).filter(|&i| trusted(i)).collect();
        Random::stream(self.seed, view as u64).draw(&mut cells, self.per_view);
        cells.truncate(self.per_view);
        for i in cells {
            self.values.extend((0..c).map(|k| embedding.data[k * w * h + i]));
        }
        Ok(())
    }

    /// Number of cells sampled.
    pub fn len(&self) -> usize {
        self.values.len() / self.channels.max(1)
    }

    /// Whether no cell was sampled.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Fits the components; see [`Pca::fit`]. This frees the cells: they are tens of MiB that nobody needs again.
    pub fn fit(self, channels: usize, keep_variance: f32) -> Result<Pca, FeatureError> {
        if self.is_empty() {
            return Err(FeatureError::NoSamples);
        }
        Pca::fit(&self.values, self.channels, channels, keep_variance)
    }
}

/// Principal components of an embedding.
///
/// Mean-centred, no whitening; one common factor brings the compressed vectors to a mean squared length of 1, so that
/// learning rates mean the same for every embedder. Cosines of compressed vectors are those of the centred, projected
/// embeddings.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Pca {
    /// Numbers per cell of the embedding.
    pub embedding_channels: usize,
    /// Numbers per compressed vector.
    pub channels: usize,
    /// Mean of the embedding, one number per embedding channel.
    pub mean: Vec<f32>,
    /// Unit components, `[channel][embedding channel]`, flat.
    pub basis: Vec<f32>,
    /// What `basis (e - mean)` is multiplied with.
    pub scale: f32,
    /// Variance along each component, in the embedding's units.
    pub variances: Vec<f32>,
    /// Variance of the embedding over all its channels.
    pub total_variance: f32,
}

impl Pca {
    /// Fits to `samples`, `[sample][embedding channel]`, flat. At most `channels` components; fewer if the
    /// embedding has no more dimensions, or if fewer keep the share `keep_variance` of the variance.
    pub fn fit(
        samples: &[f32],
        embedding_channels: usize,
        channels: usize,
        keep_variance: f32,
    ) -> Result<Pca, FeatureError> {
        let e = embedding_channels;
        if e == 0 || !samples.len().is_multiple_of(e) || channels == 0 {
            return Err(FeatureError::Shape(format!(
                "{} values of {e} channels cannot be compressed to {channels} channels",
                samples.len()
            )));
        }
        let n = samples.len() / e;
        if n == 0 {
            return Err(FeatureError::NoSamples);
        }
        check_planes("samples", "embedding", (e, n, 1), samples)?;
        let mut mean = vec![0.0f64; e];
        for sample in samples.chunks_exact(e) {
            mean.iter_mut().zip(sample).for_each(|(m, &v)| *m += f64::from(v));
        }
        mean.iter_mut().for_each(|m| *m /= n as f64);
        let covariance = covariance(samples, &mean);
        let total: f64 = (0..e).map(|i| covariance[i * e + i]).sum();
        let size: f64 = mean.iter().map(|m| m * m).sum::<f64>() + total;
        // f32 samples of one value still differ by their rounding from the mean.
        if total.is_nan() || total <= 1e-12 * size {
            return Err(FeatureError::Flat);
        }
        let (values, vectors) = eigen::symmetric(covariance, e);
        // Directions that hold only the rounding of f32 sums are no components.
        let rank = values.iter().take_while(|&&v| v > 1e-6 * total).count();
        let mut kept = rank.min(channels);
        let mut sum = 0.0;
        for (i, v) in values[..kept].iter().enumerate() {
            sum += v;
            if keep_variance < 1.0 && sum >= f64::from(keep_variance) * total {
                kept = i + 1;
                break;
            }
        }
        let held: f64 = values[..kept].iter().sum();
        Ok(Pca {
            embedding_channels: e,
            channels: kept,
            mean: mean.iter().map(|&m| m as f32).collect(),
            basis: vectors[..kept * e].iter().map(|&v| v as f32).collect(),
            scale: (1.0 / held.sqrt()) as f32,
            variances: values[..kept].iter().map(|&v| v as f32).collect(),
            total_variance: total as f32,
        })
    }

    /// Share of the embedding's variance that the compressed channels keep, in [0, 1].
    pub fn explained_variance(&self) -> f32 {
        let held: f64 = self.variances.iter().map(|&v| f64::from(v)).sum();
        (held / f64::from(self.total_variance)).clamp(0.0, 1.0) as f32
    }

    /// Compresses a photo's embedding to one plane per channel; `name` is the photo's in errors.
    ///
    /// # Errors
    /// When the embedding has another number of channels, or a value that is not finite.
    pub fn encode(&self, name: &str, embedding: &Embedding) -> Result<Image, FeatureError> {
        let (w, h, e) = (embedding.width, embedding.height, embedding.channels);
        check_planes(name, "embedding", (w, h, e), &embedding.data)?;
        if e != self.embedding_channels {
            return Err(FeatureError::Shape(format!(
                "{name}: the embedding has {e} channels, the compression was fitted on {}",
                self.embedding_channels
            )));
        }
        let mut centred = embedding.data.clone();
        for (plane, mean) in centred.chunks_exact_mut(w * h).zip(&self.mean) {
            plane.iter_mut().for_each(|v| *v -= mean);
        }
        let mut image = Image::zeros(w, h, self.channels);
        matmul(&self.basis, &centred, self.channels, e, w * h, &mut image.data);
        image.data.iter_mut().for_each(|v| *v *= self.scale);
        Ok(image)
    }

    /// The linear map back to the embedding.
    pub fn decoder(&self) -> FeatureDecoder {
        FeatureDecoder {
            channels: self.channels,
            embedding_channels: self.embedding_channels,
            weights: self.basis.iter().map(|b| b / self.scale).collect(),
            bias: self.mean.clone(),
        }
    }
}

/// The linear map from features f to embeddings e: `e = weights^T f + bias`.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct FeatureDecoder {
    /// Numbers per compressed vector.
    pub channels: usize,
    /// Numbers per embedding.
    pub embedding_channels: usize,
    /// `[channel][embedding channel]`, flat.
    pub weights: Vec<f32>,
    /// One number per embedding channel.
    pub bias: Vec<f32>,
}

impl FeatureDecoder {
    /// Decodes planes of features to planes of the embedding.
    pub fn decode(&self, compressed: &Image) -> Result<Embedding, FeatureError> {
        check_planes(
            "the features",
            "feature image",
            (compressed.width, compressed.height, compressed.channels),
            &compressed.data,
        )?;
        let (n, c, e) = (compressed.pixels(), self.channels, self.embedding_channels);
        if compressed.channels != c {
            let got = compressed.channels;
            return Err(FeatureError::Shape(format!("features of {got} channels for a decoder of {c}")));
        }
        let mut data = vec![0.0; n * e];
        matmul(&transpose(&self.weights, c, e), &compressed.data, e, c, n, &mut data);
        for (plane, bias) in data.chunks_exact_mut(n).zip(&self.bias) {
            plane.iter_mut().for_each(|v| *v += bias);
        }
        Ok(Embedding { width: compressed.width, height: compressed.height, channels: e, data })
    }
}

/// Covariance of the samples about `mean`.
fn covariance(samples: &[f32], mean: &[f64]) -> Vec<f64> {
    let e = mean.len();
    let n = samples.len() / e;
    let mut sum = vec![0.0f64; e * e];
    let mut product = vec![0.0f32; e * e];
    for chunk in samples.chunks(CHUNK * e) {
        let rows = chunk.len() / e;
        let centred: Vec<f32> =
            chunk.iter().enumerate().map(|(i, &v)| (f64::from(v) - mean[i % e]) as f32).collect();
        matmul(&transpose(&centred, rows, e), &centred, e, rows, e, &mut product);
        sum.iter_mut().zip(&product).for_each(|(s, &p)| *s += f64::from(p));
    }
    // Both halves come from the same sums in the same order, so the matrix is symmetric to the bit.
    sum.iter_mut().for_each(|s| *s /= n as f64);
    sum
}
