//! Clicks against the feature field (method, section 6; paper Eq. 25-28).

use crate::SegmentError;
use glam::Vec2;
use rayon::prelude::*;
use segwild_flow::lock;
use segwild_objective::FieldBackend;
use segwild_objective::field::{Queries, dot, score};
use segwild_raster::{Channels, ProjectOptions, Rasterizer, jacobian_limits};
use segwild_scene::half::from_half;
use segwild_scene::{Camera, HalfRows, Image, Pose, Splats};
use std::any::Any;
use std::sync::Mutex;

/// Rows that one task scores. Their numbers of 32 bits fit the second-level cache for the usual widths.
const ROWS: usize = 512;

/// Lanes of a dot product of rows: sums are formed per lane and added in one fixed order.
const LANES: usize = 16;

/// One feature vector per splat, ready for similarity queries. The numbers have 16 bits, in units of one power of two for the whole
/// field: beside the splats they are the largest array of a session.
pub struct SplatFeatures {
    /// A row per splat.
    rows: HalfRows,
    /// Of [`HalfRows::halves`].
    inverse_norms: Vec<f32>,
    on_device: Option<Box<dyn Any + Send + Sync>>,
}

impl SplatFeatures {
    /// Takes `values[splat][channel]`, flat, in any unit. Rows that are zero, hold a NaN, or have a number more than 64 times as
    /// large as 999 of 1000 rows have resemble nothing.
    pub fn new(channels: usize, values: Vec<f32>) -> Result<SplatFeatures, SegmentError> {
        match HalfRows::rounded(channels, &values) {
            Some(rows) => Ok(SplatFeatures::of(rows)),
            None => Err(SegmentError::Shape(format!(
                "{} feature values do not fit {channels} channels",
                values.len()
            ))),
        }
    }

    /// Takes rows that were rounded before, a row per splat, as they are.
    pub fn of(rows: HalfRows) -> SplatFeatures {
        let channels = rows.channels();
        let inverse_norms = rows
            .halves()
            .par_chunks(channels.saturating_mul(ROWS))
            .flat_map_iter(|rows| {
                rows.chunks_exact(channels).map(|row| inverse_norm(dot_rows(row, row, from_half)))
            })
            .collect();
        SplatFeatures { rows, inverse_norms, on_device: None }
    }

    /// Uploads the values to an engine that keeps them on its device: similarities are then computed there.
    pub fn upload(&mut self, engine: &dyn Rasterizer) -> Result<(), SegmentError> {
        self.on_device = None;
        if !engine.keeps_channels(self.len(), self.channels()) {
            return Ok(());
        }
        // As they are kept: a cosine has no unit.
        let values: Vec<f32> = self.rows.halves().par_iter().map(|&half| from_half(half)).collect();
        let channels = Channels { count: self.channels(), values: &values };
        self.on_device = engine.upload_channels(&channels).map_err(SegmentError::raster("the features"))?;
        Ok(())
    }

    /// Numbers per splat.
    pub fn channels(&self) -> usize {
        self.rows.channels()
    }

    /// Bytes that they take in the host's memory.
    pub fn bytes(&self) -> usize {
        size_of_val(self.rows.halves()) + size_of_val(self.inverse_norms.as_slice())
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        self.inverse_norms.len()
    }

    /// Whether there is no splat.
    pub fn is_empty(&self) -> bool {
        self.inverse_norms.is_empty()
    }

    /// The values as they were rounded, `[splat][channel]`, flat.
    pub fn values(&self) -> Vec<f32> {
        self.rows.values()
    }

    /// One splat's vector.
    pub fn row(&self, splat: usize) -> Vec<f32> {
        self.rows.row(splat)
    }

    /// Cosine of two splats' vectors, in [-1, 1]; 0 where one has no direction.
    pub fn cosine(&self, a: usize, b: usize) -> f32 {
        let scale = self.inverse_norms[a] * self.inverse_norms[b];
        if scale > 0.0 {
            (dot_rows(self.rows.halves_of(a), self.rows.halves_of(b), from_half) * scale).clamp(-1.0, 1.0)
        } else {
            0.0
        }
    }

    /// Whether a splat's vector has a direction.
    pub(crate) fn has_direction(&self, splat: usize) -> bool {
        self.inverse_norms[splat] > 0.0
    }

    /// Adds `weight` times a splat's unit vector.
    pub(crate) fn add_direction(&self, splat: usize, weight: f32, sum: &mut [f32]) {
        let scale = weight * self.inverse_norms[splat];
        let row = self.rows.halves_of(splat);
        sum.iter_mut().zip(row).for_each(|(sum, &half)| *sum += scale * from_half(half));
    }

    /// Cosine of a splat's vector and a unit vector.
    pub(crate) fn cosine_to(&self, splat: usize, unit: &[f32]) -> f32 {
        dot_rows(self.rows.halves_of(splat), unit, |x| x) * self.inverse_norms[splat]
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
        if let Some(features) = &self.on_device {
            let fused = engine.similarity(&**features, &queries);
            if let Some(fused) = fused.map_err(SegmentError::raster("the features"))? {
                return Ok(fused);
            }
        }
        let mut fused = vec![0.0; self.len()];
        let rows = self.rows.halves().par_chunks(ROWS * channels).zip(self.inverse_norms.par_chunks(ROWS));
        fused.par_chunks_mut(ROWS).zip(rows).for_each_init(
            Vec::new,
            |values: &mut Vec<f32>, (out, (halves, norms))| {
                values.clear();
                values.extend(halves.iter().map(|&half| from_half(half)));
                score(&queries, values, norms, out);
            },
        );
        Ok(fused)
    }
}

/// Dot product of a row of 16-bit numbers and another row, whose numbers `read` gives. The order of additions is fixed.
#[inline(always)]
fn dot_rows<T: Copy>(row: &[u16], other: &[T], read: impl Fn(T) -> f32) -> f32 {
    let ((a, a_rest), (b, b_rest)) = (row.as_chunks::<LANES>(), other.as_chunks::<LANES>());
    let mut lanes = [0.0f32; LANES];
    for (x, y) in a.iter().zip(b) {
        for l in 0..LANES {
            lanes[l] += from_half(x[l]) * read(y[l]);
        }
    }
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(&x, &y)| from_half(x) * read(y)).sum();
    lanes.iter().sum::<f32>() + rest
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
                for (sum, x) in sum.iter_mut().zip(row) {
                    *sum += f64::from(share) * f64::from(x);
                }
            }
        }
        let feature: Vec<f32> = sum.iter().map(|x| (x / weight) as f32).collect();
        (weight > 0.0 && feature.iter().any(|&x| x != 0.0)).then_some(feature)
    }
}

/// A view, a position in it by the bits of its numbers, and a window.
type HitKey = (usize, [u32; 2], u32);

/// What the clicks of one query hit: the scene tree and the selection both need it.
#[derive(Debug, Default)]
pub struct ClickHits(Mutex<Vec<(HitKey, ClickHit)>>);

impl ClickHits {
    /// What a click on a view hits, rendered where that is not known yet.
    pub(crate) fn of<E>(
        &self,
        view: usize,
        point: Vec2,
        window: u32,
        render: impl FnOnce() -> Result<ClickHit, E>,
    ) -> Result<ClickHit, E> {
        let key = (view, point.to_array().map(f32::to_bits), window);
        let known = lock(&self.0).iter().find(|(other, _)| *other == key).map(|(_, hit)| hit.clone());
        if let Some(hit) = known {
            return Ok(hit);
        }
        let hit = render()?;
        lock(&self.0).push((key, hit.clone()));
        Ok(hit)
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
    let whole = ProjectOptions { jacobian_limits: Some(jacobian_limits(camera)), ..*options };
    let projected = engine.project(splats, &crop, pose, &whole)?;
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
