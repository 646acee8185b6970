//! The splats as parameters of the optimiser.

use crate::density::Reshaping;
use segwild_objective::{Adam, OptimiserRules, Reshaped, SplatEmbeddings, TrainingSplats, VisibleSplats};
use segwild_raster::{Projected, SplatGrads};
use segwild_scene::{Pose, Splats};
use std::ops::Range;
use wincode::{SchemaRead, SchemaWrite};

/// Learning rates of one step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rates {
    /// In scene units.
    pub mean: f32,
    pub opacity: f32,
    pub scale: f32,
    pub rotation: f32,
    /// Of the base colour; higher degrees take a twentieth.
    pub colour: f32,
    /// Of the per-splat appearance embeddings.
    pub splat_embedding: f32,
}

/// Splats with their optimisers, one per property; the base colour and the higher degrees are two.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct Params {
    pub splats: Splats,
    means: Adam,
    log_scales: Adam,
    rotations: Adam,
    opacities: Adam,
    base: Adam,
    higher: Adam,
    /// Per-splat appearance embeddings, `[splat][embedding_size]`.
    pub splat_embeddings: Vec<f32>,
    embedding_moments: Adam,
}

/// Share of the base colour's learning rate that higher degrees take.
const HIGHER: f32 = 1.0 / 20.0;

/// Weight decay of the per-splat embeddings in a step, as a multiple of their learning rate.
const EMBEDDING_DECAY: f32 = 0.5;

/// Factor of the weight decay in a step.
fn kept(rates: &Rates) -> f32 {
    1.0 - EMBEDDING_DECAY * rates.splat_embedding
}

/// The embeddings of the splats at `which` among `n`, in that order.
pub(crate) fn select(splat_embeddings: &[f32], n: usize, which: &[usize]) -> Vec<f32> {
    let size = splat_embeddings.len().checked_div(n).unwrap_or(0);
    which.iter().flat_map(|&i| &splat_embeddings[i * size..(i + 1) * size]).copied().collect()
}

/// The constant part of the colours and their higher degrees, which lie interleaved in items of `k`.
fn apart(values: &[f32], k: usize) -> (Vec<f32>, Vec<f32>) {
    let n = values.len() / k;
    let (mut base, mut higher) = (Vec::with_capacity(3 * n), Vec::with_capacity((k - 3) * n));
    for splat in values.chunks_exact(k) {
        base.extend_from_slice(&splat[..3]);
        higher.extend_from_slice(&splat[3..]);
    }
    (base, higher)
}

/// The reverse of [`apart`].
fn together(base: &[f32], higher: &[f32], k: usize) -> Vec<f32> {
    if k == 3 {
        return base.to_vec();
    }
    let mut values = Vec::with_capacity(base.len() + higher.len());
    for (base, higher) in base.chunks_exact(3).zip(higher.chunks_exact(k - 3)) {
        values.extend_from_slice(base);
        values.extend_from_slice(higher);
    }
    values
}

impl Params {
    /// The initial splats and their appearance embeddings.
    pub fn new(splats: Splats, splat_embeddings: Vec<f32>) -> Params {
        let n = splats.len();
        let embedding_size = splat_embeddings.len().checked_div(n).unwrap_or(0);
        Params {
            means: Adam::new(n, 3),
            log_scales: Adam::new(n, 3),
            rotations: Adam::new(n, 4),
            opacities: Adam::new(n, 1),
            base: Adam::new(n, 3),
            higher: Adam::new(if splats.sh_degree > 0 { n } else { 0 }, splats.sh_stride() - 3),
            splat_embeddings,
            embedding_moments: Adam::new(if embedding_size > 0 { n } else { 0 }, embedding_size),
            splats,
        }
    }

    /// The splats from a camera, for the appearance model.
    pub fn sight<'a>(&'a self, projected: &'a dyn Projected, pose: &Pose) -> VisibleSplats<'a> {
        let Params { splats, splat_embeddings, .. } = self;
        VisibleSplats {
            means: &splats.means,
            splat_embeddings,
            radii: projected.radii(),
            eye: pose.centre().to_array(),
        }
    }

    /// One optimiser step; `sh` are the gradients of [`Splats::sh`].
    pub fn update(&mut self, grads: &SplatGrads, sh: &[f32], rates: &Rates) {
        let s = &mut self.splats;
        self.means.step(s.means.as_flattened_mut(), grads.means.as_flattened(), rates.mean);
        self.log_scales.step(s.log_scales.as_flattened_mut(), grads.log_scales.as_flattened(), rates.scale);
        self.rotations.step(s.rotations.as_flattened_mut(), grads.rotations.as_flattened(), rates.rotation);
        self.opacities.step(&mut s.opacities, &grads.opacities, rates.opacity);
        if s.sh_degree == 0 {
            self.base.step(&mut s.sh, sh, rates.colour);
            return;
        }
        // The two groups lie interleaved: take them apart, step, put them back.
        let k = s.sh_stride();
        let ((mut base, mut higher), (base_grads, higher_grads)) = (apart(&s.sh, k), apart(sh, k));
        self.base.step(&mut base, &base_grads, rates.colour);
        self.higher.step(&mut higher, &higher_grads, rates.colour * HIGHER);
        s.sh = together(&base, &higher, k);
    }

    /// Starts a step that runs on the device.
    pub fn advance(&mut self, rates: &Rates) -> OptimiserRules {
        let base = self.base.advance(rates.colour);
        let higher = match self.splats.sh_degree {
            0 => base,
            _ => self.higher.advance(rates.colour * HIGHER),
        };
        OptimiserRules {
            means: self.means.advance(rates.mean),
            log_scales: self.log_scales.advance(rates.scale),
            rotations: self.rotations.advance(rates.rotation),
            opacities: self.opacities.advance(rates.opacity),
            base,
            higher,
            splat_embeddings: if self.splat_embeddings.is_empty() {
                base
            } else {
                self.embedding_moments.advance(rates.splat_embedding)
            },
            kept: kept(rates),
        }
    }

    /// All of it, to be trained on the device.
    pub fn training_splats(&self, sums: Vec<[f32; 4]>) -> TrainingSplats {
        let moments = |which: usize| {
            let of = |adam: &Adam| adam.moments()[which].to_vec();
            Splats {
                means: of(&self.means).as_chunks().0.to_vec(),
                log_scales: of(&self.log_scales).as_chunks().0.to_vec(),
                rotations: of(&self.rotations).as_chunks().0.to_vec(),
                opacities: of(&self.opacities),
                sh: together(&of(&self.base), &of(&self.higher), self.splats.sh_stride()),
                sh_degree: self.splats.sh_degree,
            }
        };
        let [first, second] = self.embedding_moments.moments().map(<[f32]>::to_vec);
        let splat_embeddings = SplatEmbeddings { values: self.splat_embeddings.clone(), first, second };
        TrainingSplats {
            splats: self.splats.clone(),
            first: moments(0),
            second: moments(1),
            sums,
            splat_embeddings,
            networks: None,
        }
    }

    /// Takes back what [`Params::training_splats`] returned; density control may have changed the splats since.
    pub fn restore(&mut self, trained: TrainingSplats) {
        let TrainingSplats { splats, first, second, splat_embeddings, sums: _, networks: _ } = trained;
        self.splat_embeddings = splat_embeddings.values;
        self.embedding_moments.set_moments(splat_embeddings.first, splat_embeddings.second);
        self.splats = splats;
        let flat = |of: &[[f32; 3]]| of.as_flattened().to_vec();
        self.means.set_moments(flat(&first.means), flat(&second.means));
        self.log_scales.set_moments(flat(&first.log_scales), flat(&second.log_scales));
        let rotations = [first.rotations, second.rotations].map(|of| of.as_flattened().to_vec());
        let [a, b] = rotations;
        self.rotations.set_moments(a, b);
        self.opacities.set_moments(first.opacities, second.opacities);
        let k = self.splats.sh_stride();
        let ((base, higher), (base2, higher2)) = (apart(&first.sh, k), apart(&second.sh, k));
        self.base.set_moments(base, base2);
        if self.splats.sh_degree > 0 {
            self.higher.set_moments(higher, higher2);
        }
    }

    /// The shapes that density control works on.
    pub fn lend(&self) -> Reshaping {
        let s = &self.splats;
        let k = s.sh_stride();
        let finite = |numbers: &[f32]| numbers.iter().all(|v| v.is_finite());
        let sound = match finite(&s.sh) {
            true => vec![true; s.len()],
            false => s.sh.chunks_exact(k).map(finite).collect(),
        };
        Reshaping::new(s.uncoloured(), sound)
    }

    /// Takes the result of density control on [`Params::lend`].
    pub fn reshape(&mut self, reshaped: Reshaped) {
        let Reshaped { shapes, parents, forgotten, opacities_forgotten } = reshaped;
        let same = parents.len() == self.splats.len() && parents.iter().zip(0..).all(|(&p, i)| p == i);
        if !same {
            let parents: Vec<usize> = parents.iter().map(|&p| p as usize).collect();
            self.remap(&parents);
        }
        let forgotten = (0..forgotten.len()).filter(|&i| forgotten[i]);
        self.groups().for_each(|g| g.forget(forgotten.clone()));
        if opacities_forgotten {
            self.opacities.forget(0..parents.len());
        }
        let sh = std::mem::take(&mut self.splats.sh);
        self.splats = Splats { sh, sh_degree: self.splats.sh_degree, ..shapes };
    }

    /// One optimiser step of the embeddings, of splats with `radii` above 0; the numbers `fading` have weight decay.
    pub fn update_embeddings(&mut self, grads: &[f32], radii: &[f32], rates: &Rates, fading: Range<usize>) {
        let size = self.embedding_size();
        if size == 0 {
            return;
        }
        self.embedding_moments.step_visible(&mut self.splat_embeddings, grads, rates.splat_embedding, radii);
        let keep = kept(rates);
        for (embedding, _) in
            self.splat_embeddings.chunks_exact_mut(size).zip(radii).filter(|(_, r)| **r > 0.0)
        {
            embedding[fading.clone()].iter_mut().for_each(|v| *v *= keep);
        }
    }

    fn embedding_size(&self) -> usize {
        self.splat_embeddings.len().checked_div(self.splats.len()).unwrap_or(0)
    }

    fn groups(&mut self) -> impl Iterator<Item = &mut Adam> {
        let higher = (self.splats.sh_degree > 0).then_some(&mut self.higher);
        let splat_embeddings = (!self.splat_embeddings.is_empty()).then_some(&mut self.embedding_moments);
        [&mut self.means, &mut self.log_scales, &mut self.rotations, &mut self.opacities, &mut self.base]
            .into_iter()
            .chain(higher)
            .chain(splat_embeddings)
    }

    /// The splats at `parents`, in that order, with their optimiser states.
    pub fn remap(&mut self, parents: &[usize]) {
        self.splat_embeddings = select(&self.splat_embeddings, self.splats.len(), parents);
        self.splats = self.splats.select(parents);
        self.groups().for_each(|g| g.select(parents));
    }

    /// Gives the colours more basis functions, zero at first; never fewer.
    pub fn raise_sh_degree(&mut self, degree: u32) {
        if degree <= self.splats.sh_degree {
            return;
        }
        let old = self.splats.sh_stride();
        self.splats.sh_degree = degree;
        let new = self.splats.sh_stride();
        let mut sh = vec![0.0; self.splats.len() * new];
        for (to, from) in sh.chunks_exact_mut(new).zip(self.splats.sh.chunks_exact(old)) {
            to[..old].copy_from_slice(from);
        }
        self.splats.sh = sh;
        // The degrees before start over in the optimiser; their values stay.
        self.higher = Adam::new(self.splats.len(), new - 3);
    }

    /// Whether every array has one entry per splat; the error names one that has not.
    pub fn consistent(&self) -> Result<(), SplatArrayError> {
        splats_fit(&self.splats)?;
        let n = self.splats.len();
        let k = self.splats.sh_stride();
        let arrays = [
            ("moments of the centres", self.means.len() == 3 * n),
            ("moments of the scales", self.log_scales.len() == 3 * n),
            ("moments of the rotations", self.rotations.len() == 4 * n),
            ("moments of the opacities", self.opacities.len() == n),
            ("moments of the colours", self.base.len() + self.higher.len() == n * k),
            ("embeddings", self.splat_embeddings.len().is_multiple_of(n.max(1))),
            ("moments of the embeddings", self.embedding_moments.len() == self.splat_embeddings.len()),
        ];
        all_fit(n, &arrays)
    }
}

/// Why the arrays of splats do not fit each other.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum SplatArrayError {
    /// An array has another length than there are splats.
    #[error("{splats} splats, but another number of {array}")]
    Length {
        /// Number of splats.
        splats: usize,
        /// The array.
        array: &'static str,
    },
    /// Spherical harmonics go to degree 3.
    #[error("spherical harmonics of degree {0}")]
    Degree(u32),
}

fn all_fit(splats: usize, arrays: &[(&'static str, bool)]) -> Result<(), SplatArrayError> {
    match arrays.iter().find(|(_, fits)| !fits) {
        Some((array, _)) => Err(SplatArrayError::Length { splats, array }),
        None => Ok(()),
    }
}

/// Whether splats that come out of a file have one entry each in every array; the error names one that has not.
pub(crate) fn splats_fit(s: &Splats) -> Result<(), SplatArrayError> {
    let n = s.len();
    if s.sh_degree > 3 {
        return Err(SplatArrayError::Degree(s.sh_degree));
    }
    all_fit(
        n,
        &[
            ("log scales", s.log_scales.len() == n),
            ("rotations", s.rotations.len() == n),
            ("opacities", s.opacities.len() == n),
            ("colours", s.sh.len() == n * s.sh_stride()),
        ],
    )
}
