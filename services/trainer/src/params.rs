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
///
/// The first [`Params::trained`] splats are trained. The others are frozen: they are rendered, have gradients and no
/// moments, and stay as they are. A step so takes as long as with all of them trained, and less memory.
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

/// The shapes of some splats, without their colours.
fn shapes_of(splats: &Splats, which: Range<usize>) -> Splats {
    Splats {
        means: splats.means[which.clone()].to_vec(),
        log_scales: splats.log_scales[which.clone()].to_vec(),
        rotations: splats.rotations[which.clone()].to_vec(),
        opacities: splats.opacities[which.clone()].to_vec(),
        sh_degree: 0,
        sh: vec![0.0; 3 * which.len()],
    }
}

/// Splats followed by others, whose colours have the same degree.
pub(crate) fn joined(mut splats: Splats, others: &Splats) -> Splats {
    splats.means.extend_from_slice(&others.means);
    splats.log_scales.extend_from_slice(&others.log_scales);
    splats.rotations.extend_from_slice(&others.rotations);
    splats.opacities.extend_from_slice(&others.opacities);
    splats.sh.extend_from_slice(&others.sh);
    splats
}

impl Params {
    /// The initial splats and their appearance embeddings.
    pub fn new(splats: Splats, splat_embeddings: Vec<f32>) -> Params {
        let n = splats.len();
        Params::with_frozen(splats, splat_embeddings, n)
    }

    /// Splats of which the first `n` are trained, with moments 0.
    fn with_frozen(splats: Splats, splat_embeddings: Vec<f32>, n: usize) -> Params {
        let embedding_size = splat_embeddings.len().checked_div(splats.len()).unwrap_or(0);
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

    /// Number of splats that are trained: the first ones.
    pub fn trained(&self) -> usize {
        self.opacities.len()
    }

    /// The shapes of the splats that are not trained, without their colours.
    pub fn frozen_shapes(&self) -> Splats {
        shapes_of(&self.splats, self.trained()..self.splats.len())
    }

    /// Trains the marked splats from now on, and `added` ones with their embeddings after them; the others are frozen
    /// and go to the end. The optimiser starts over.
    pub fn train_only(&mut self, marked: &[bool], (added, added_embeddings): (&Splats, &[f32])) {
        let n = self.splats.len();
        let (trained, frozen): (Vec<usize>, Vec<usize>) = (0..n).partition(|&i| marked[i]);
        let first = joined(self.splats.select(&trained), added);
        let count = first.len();
        let splats = joined(first, &self.splats.select(&frozen));
        let mut splat_embeddings = select(&self.splat_embeddings, n, &trained);
        splat_embeddings.extend_from_slice(added_embeddings);
        splat_embeddings.extend(select(&self.splat_embeddings, n, &frozen));
        *self = Params::with_frozen(splats, splat_embeddings, count);
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

    /// One optimiser step of the splats that are trained. The gradients are those of all splats; `sh` are those of
    /// [`Splats::sh`].
    pub fn update(&mut self, grads: &SplatGrads, sh: &[f32], rates: &Rates) {
        let n = self.trained();
        let s = &mut self.splats;
        let k = s.sh_stride();
        self.means.step(s.means[..n].as_flattened_mut(), grads.means[..n].as_flattened(), rates.mean);
        let (log_scales, grads_of) = (&mut s.log_scales[..n], &grads.log_scales[..n]);
        self.log_scales.step(log_scales.as_flattened_mut(), grads_of.as_flattened(), rates.scale);
        let (rotations, grads_of) = (&mut s.rotations[..n], &grads.rotations[..n]);
        self.rotations.step(rotations.as_flattened_mut(), grads_of.as_flattened(), rates.rotation);
        self.opacities.step(&mut s.opacities[..n], &grads.opacities[..n], rates.opacity);
        let (colours, sh) = (&mut s.sh[..n * k], &sh[..n * k]);
        if s.sh_degree == 0 {
            self.base.step(colours, sh, rates.colour);
            return;
        }
        // The two groups lie interleaved: take them apart, step, put them back.
        let ((mut base, mut higher), (base_grads, higher_grads)) = (apart(colours, k), apart(sh, k));
        self.base.step(&mut base, &base_grads, rates.colour);
        self.higher.step(&mut higher, &higher_grads, rates.colour * HIGHER);
        colours.copy_from_slice(&together(&base, &higher, k));
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

    /// All of it, to be trained on the device: none is frozen.
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

    /// The shapes that density control works on: of the splats that are trained.
    pub fn lend(&self) -> Reshaping {
        let (s, n) = (&self.splats, self.trained());
        let k = s.sh_stride();
        let finite = |numbers: &[f32]| numbers.iter().all(|v| v.is_finite());
        let colours = &s.sh[..n * k];
        let sound = match finite(colours) {
            true => vec![true; n],
            false => colours.chunks_exact(k).map(finite).collect(),
        };
        Reshaping::new(shapes_of(s, 0..n), sound)
    }

    /// Takes the result of density control on [`Params::lend`].
    pub fn reshape(&mut self, reshaped: Reshaped) {
        let Reshaped { shapes, parents, forgotten, opacities_forgotten } = reshaped;
        let same = parents.len() == self.trained() && parents.iter().zip(0..).all(|(&p, i)| p == i);
        if !same {
            let parents: Vec<usize> = parents.iter().map(|&p| p as usize).collect();
            self.remap(&parents);
        }
        let forgotten = (0..forgotten.len()).filter(|&i| forgotten[i]);
        self.groups().for_each(|g| g.forget(forgotten.clone()));
        if opacities_forgotten {
            self.opacities.forget(0..parents.len());
        }
        let frozen = self.frozen_shapes();
        let sh = std::mem::take(&mut self.splats.sh);
        self.splats = Splats { sh, sh_degree: self.splats.sh_degree, ..joined(shapes, &frozen) };
    }

    /// One optimiser step of the embeddings, of splats that are trained and have `radii` above 0; the numbers `fading`
    /// have weight decay. Gradients and radii are those of all splats.
    pub fn update_embeddings(&mut self, grads: &[f32], radii: &[f32], rates: &Rates, fading: Range<usize>) {
        let size = self.embedding_size();
        if size == 0 {
            return;
        }
        let n = self.trained();
        let values = &mut self.splat_embeddings[..n * size];
        let (grads, radii) = (&grads[..n * size], &radii[..n]);
        self.embedding_moments.step_visible(values, grads, rates.splat_embedding, radii);
        let keep = kept(rates);
        for (embedding, _) in values.chunks_exact_mut(size).zip(radii).filter(|(_, r)| **r > 0.0) {
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

    /// Of the splats that are trained those at `parents`, in that order, with their optimiser states. Frozen splats
    /// stay.
    pub fn remap(&mut self, parents: &[usize]) {
        let frozen = self.trained()..self.splats.len();
        self.groups().for_each(|g| g.select(parents));
        let all: Vec<usize> = parents.iter().copied().chain(frozen).collect();
        self.splat_embeddings = select(&self.splat_embeddings, self.splats.len(), &all);
        self.splats = self.splats.select(&all);
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
        self.higher = Adam::new(self.trained(), new - 3);
    }

    /// Whether every array has one entry per splat, or per splat that is trained; the error names one that has not.
    pub fn consistent(&self) -> Result<(), SplatArrayError> {
        splats_fit(&self.splats)?;
        let (all, n) = (self.splats.len(), self.trained());
        let k = self.splats.sh_stride();
        let arrays = [
            ("moments of the centres", self.means.len() == 3 * n),
            ("moments of the scales", self.log_scales.len() == 3 * n),
            ("moments of the rotations", self.rotations.len() == 4 * n),
            ("moments of the opacities", n <= all),
            ("moments of the colours", self.base.len() + self.higher.len() == n * k),
            ("embeddings", self.splat_embeddings.len().is_multiple_of(all.max(1))),
            ("moments of the embeddings", self.embedding_moments.len() == self.embedding_size() * n),
        ];
        all_fit(all, &arrays)
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

#[cfg(test)]
mod tests {
    use super::*;

    fn splats(n: usize, sh_degree: u32) -> Splats {
        let k = 3 * (sh_degree as usize + 1).pow(2);
        Splats {
            means: (0..n).map(|i| [i as f32, 0.0, 0.0]).collect(),
            log_scales: vec![[-3.0; 3]; n],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacities: vec![0.0; n],
            sh_degree,
            sh: (0..n * k).map(|i| (i / k) as f32).collect(),
        }
    }

    const RATES: Rates =
        Rates { mean: 0.1, opacity: 0.1, scale: 0.1, rotation: 0.1, colour: 0.1, splat_embedding: 0.1 };

    fn step(params: &mut Params) {
        let n = params.splats.len();
        let grads = SplatGrads {
            means: vec![[1.0; 3]; n],
            log_scales: vec![[1.0; 3]; n],
            rotations: vec![[1.0; 4]; n],
            opacities: vec![1.0; n],
            ..SplatGrads::default()
        };
        let sh = vec![1.0; params.splats.sh.len()];
        params.update(&grads, &sh, &RATES);
        params.update_embeddings(&vec![1.0; 2 * n], &vec![1.0; n], &RATES, 0..2);
    }

    type SplatNumbers = ([f32; 3], [f32; 3], [f32; 4], f32, Vec<f32>, Vec<f32>);

    /// All numbers of a splat.
    fn at(params: &Params, i: usize) -> SplatNumbers {
        let (s, k) = (&params.splats, params.splats.sh_stride());
        let embedding = params.splat_embeddings[2 * i..2 * i + 2].to_vec();
        let sh = s.sh[i * k..(i + 1) * k].to_vec();
        (s.means[i], s.log_scales[i], s.rotations[i], s.opacities[i], sh, embedding)
    }

    #[test]
    fn frozen_splats_stay_through_steps_density_control_and_pruning() {
        for degree in [0, 1] {
            let embeddings: Vec<f32> = (0..12).map(|v| v as f32).collect();
            let mut params = Params::new(splats(6, degree), embeddings);
            let before: Vec<_> = (0..6).map(|i| at(&params, i)).collect();
            let marked = [false, true, false, true, true, false];
            params.train_only(&marked, (&splats(1, degree), &[7.0, 7.0][..]));
            assert_eq!((params.trained(), params.splats.len()), (4, 7));
            params.consistent().unwrap();
            step(&mut params);
            for (frozen, from) in (4..7).zip([0, 2, 5]) {
                assert_eq!(at(&params, frozen), before[from], "{frozen}");
            }
            for (trained, from) in (0..3).zip([1, 3, 4]) {
                let (now, was) = (at(&params, trained), &before[from]);
                assert!(now.0 != was.0 && now.1 != was.1 && now.2 != was.2 && now.3 != was.3);
                assert!(now.4.iter().zip(&was.4).all(|(a, b)| a != b) && now.5 != was.5);
            }
            let mut reshaping = params.lend();
            assert_eq!(reshaping.len(), 4, "density control works on those that are trained");
            reshaping.remap(&[3, 0, 0]);
            params.reshape(reshaping.done());
            params.remap(&[1, 2]);
            params.raise_sh_degree(2);
            params.consistent().unwrap();
            assert_eq!((params.trained(), params.splats.len()), (2, 5));
            let kept = |i: usize| (params.splats.means[i], params.splats.opacities[i]);
            for (frozen, from) in (2..5).zip([0, 2, 5]) {
                assert_eq!(kept(frozen), (before[from].0, before[from].3), "{frozen}");
                assert_eq!(params.splat_embeddings[2 * frozen..2 * frozen + 2], before[from].5);
            }
            step(&mut params);
            assert_eq!(params.splats.means[4], before[5].0);
        }
    }
}
