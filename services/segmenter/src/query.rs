//! Clicks against the feature field (method, section 6; paper Eq. 25-28).

use crate::SegmentError;
use glam::Vec2;
use rayon::prelude::*;
use segwild_objective::FieldBackend;
use segwild_objective::field::{Queries, dot, score};
use segwild_raster::{ProjectOptions, Rasterizer, ResidentChannels};
use segwild_scene::{Camera, Image, Pose, Splats};

/// Rows that one task scores: fixed, so that nothing depends on the number of threads.
const ROWS: usize = 2048;

/// One feature vector per splat, ready for similarity queries.
pub struct SplatFeatures {
    features: ResidentChannels<'static>,
    inverse_norms: Vec<f32>,
}

impl SplatFeatures {
    /// Takes `values[splat][channel]`, flat. Rows that are zero or hold a NaN or an infinity resemble nothing.
    pub fn new(channels: usize, values: Vec<f32>) -> Result<SplatFeatures, SegmentError> {
        if channels == 0 || !values.len().is_multiple_of(channels) {
            return Err(SegmentError::Shape(format!(
                "{} feature values do not fit {channels} channels",
                values.len()
            )));
        }
        let inverse_norms = values
            .par_chunks(channels * ROWS)
            .flat_map_iter(|rows| rows.chunks_exact(channels).map(|row| inverse_norm(dot(row, row))))
            .collect();
        Ok(SplatFeatures { features: ResidentChannels::new(channels, values), inverse_norms })
    }

    /// Uploads the values to an engine that keeps them on its device: similarities are then computed there.
    pub fn upload(&mut self, engine: &dyn Rasterizer) -> Result<(), SegmentError> {
        self.features.upload(engine).map_err(SegmentError::raster("the features"))
    }

    /// Numbers per splat.
    pub fn channels(&self) -> usize {
        self.features.on_host().count
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        self.inverse_norms.len()
    }

    /// Whether there is no splat.
    pub fn is_empty(&self) -> bool {
        self.inverse_norms.is_empty()
    }

    /// The values, `[splat][channel]`, flat.
    pub fn values(&self) -> &[f32] {
        self.features.on_host().values
    }

    /// One splat's vector.
    pub fn row(&self, splat: usize) -> &[f32] {
        let channels = self.channels();
        &self.values()[splat * channels..(splat + 1) * channels]
    }

    /// Cosine of two splats' vectors, in [-1, 1]; 0 where one has no direction.
    pub fn cosine(&self, a: usize, b: usize) -> f32 {
        let scale = self.inverse_norms[a] * self.inverse_norms[b];
        if scale > 0.0 { (dot(self.row(a), self.row(b)) * scale).clamp(-1.0, 1.0) } else { 0.0 }
    }

    /// Whether a splat's vector has a direction.
    pub(crate) fn has_direction(&self, splat: usize) -> bool {
        self.inverse_norms[splat] > 0.0
    }

    /// Adds `weight` times a splat's unit vector.
    pub(crate) fn add_direction(&self, splat: usize, weight: f32, sum: &mut [f32]) {
        let scale = weight * self.inverse_norms[splat];
        sum.iter_mut().zip(self.row(splat)).for_each(|(sum, x)| *sum += scale * x);
    }

    /// Cosine of a splat's vector and a unit vector.
    pub(crate) fn cosine_to(&self, splat: usize, unit: &[f32]) -> f32 {
        dot(self.row(splat), unit) * self.inverse_norms[splat]
    }

    /// Fused similarity of every splat to some clicks: `sum_i softmax_i(s_i / temperature) s_i`, `s_i` the cosine to click
    /// `i` (paper, Eq. 27). It lies between the mean and the largest. Reads the field once, on the device if it was uploaded
    /// ([`SplatFeatures::upload`]).
    ///
    /// `clicks` are feature vectors of [`SplatFeatures::channels`] numbers; those without a direction are refused.
    pub fn similarity(
        &self,
        engine: &dyn FieldBackend,
        clicks: &[Vec<f32>],
        temperature: f32,
    ) -> Result<Vec<f32>, SegmentError> {
        if temperature.is_nan() || temperature <= 0.0 {
            return Err(SegmentError::Setting {
                name: "click_temperature",
                value: f64::from(temperature),
                reason: "it must be positive",
            });
        }
        if clicks.is_empty() {
            return Err(SegmentError::NoPrompt);
        }
        let mut queries = Vec::with_capacity(clicks.len());
        let channels = self.channels();
        for click in clicks {
            if click.len() != channels {
                return Err(SegmentError::Shape(format!(
                    "a click has {} feature values, the field has {channels} channels",
                    click.len()
                )));
            }
            let scale = inverse_norm(dot(click, click));
            if scale == 0.0 {
                return Err(SegmentError::Shape(
                    "a click has no usable feature (all zero, or not a number)".into(),
                ));
            }
            queries.push(click.iter().map(|x| x * scale).collect::<Vec<f32>>());
        }
        let queries = Queries { channels, units: &queries, sharpness: 1.0 / temperature };
        let on_device = engine.similarity(&self.features, &queries);
        if let Some(fused) = on_device.map_err(SegmentError::raster("the features"))? {
            return Ok(fused);
        }
        let mut fused = vec![0.0; self.len()];
        let rows = self.values().par_chunks(ROWS * channels).zip(self.inverse_norms.par_chunks(ROWS));
        fused
            .par_chunks_mut(ROWS)
            .zip(rows)
            .for_each(|(out, (values, norms))| score(&queries, values, norms, out));
        Ok(fused)
    }
}

/// `1 / sqrt(square)`, or 0 where that is no usable number.
fn inverse_norm(square: f32) -> f32 {
    let x = 1.0 / square.sqrt();
    if x.is_finite() && square.is_finite() { x } else { 0.0 }
}

/// The splats that make up a pixel.
#[derive(Clone, Debug, PartialEq)]
pub struct ClickHit {
    /// Splats and their share `alpha T` of the pixel, in the order of their indices.
    pub splats: Vec<(u32, f32)>,
    /// Accumulated alpha `A`, the sum of the shares, in [0, 1].
    pub alpha: f32,
}

impl ClickHit {
    /// Blended feature without the transparency: `F / A = sum alpha T f / sum alpha T` (method, section 1).
    /// Splats whose feature is not a number take no part; `None` when nothing is left.
    pub fn feature(&self, field: &SplatFeatures) -> Option<Vec<f32>> {
        let mut sum = vec![0.0f64; field.channels()];
        let mut weight = 0.0;
        for &(splat, share) in &self.splats {
            let row = field.row(splat as usize);
            if row.iter().all(|x| x.is_finite()) {
                weight += f64::from(share);
                for (sum, &x) in sum.iter_mut().zip(row) {
                    *sum += f64::from(share) * f64::from(x);
                }
            }
        }
        let feature: Vec<f32> = sum.iter().map(|x| (x / weight) as f32).collect();
        (weight > 0.0 && feature.iter().any(|&x| x != 0.0)).then_some(feature)
    }
}

/// The splats that a click hits: those that make up the square of `2 window + 1` pixels around it. Only
/// that square is rendered. `point` is in pixels of `camera`.
pub fn hit(
    engine: &dyn Rasterizer,
    splats: &Splats,
    options: &ProjectOptions,
    camera: &Camera,
    pose: &Pose,
    point: Vec2,
    window: u32,
) -> Result<ClickHit, segwild_raster::RasterError> {
    let side = 2 * window + 1;
    let crop = Camera {
        width: side,
        height: side,
        cx: camera.cx - (point.x.floor() - window as f32),
        cy: camera.cy - (point.y.floor() - window as f32),
        ..*camera
    };
    let projected = engine.project(splats, &crop, pose, options)?;
    let shares = projected.gather(&Image::filled(side as usize, side as usize, 1, 1.0))?;
    let scale = 1.0 / (side * side) as f32;
    let splats: Vec<(u32, f32)> = shares
        .iter()
        .enumerate()
        .filter(|(_, share)| **share > 0.0)
        .map(|(i, share)| (i as u32, share * scale))
        .collect();
    let alpha = splats.iter().map(|s| s.1).sum();
    Ok(ClickHit { splats, alpha })
}
