//! Adam over flat slices (method, section 2).

use rayon::prelude::*;
use segwild_raster::simd::{self, Isa, LANES, Simd, SimdKernel};
use wincode::{SchemaRead, SchemaWrite};

/// Numbers that one task updates.
const CHUNK: usize = 4096;

/// The moments of one group of parameters. A group has one learning rate, given at every step, and items of a
/// fixed number of parameters (3 for centres, 4 for rotations), which can be selected and appended when
/// splats come and go.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Adam {
    item: usize,
    first: Vec<f32>,
    second: Vec<f32>,
    steps: u32,
    beta1: f32,
    beta2: f32,
    epsilon: f32,
}

impl Adam {
    /// Moments 0 for `items` items of `item` parameters each; betas 0.9 and 0.999, epsilon 1e-15.
    pub fn new(items: usize, item: usize) -> Adam {
        let len = items * item;
        let (first, second) = (vec![0.0; len], vec![0.0; len]);
        Adam { item: item.max(1), first, second, steps: 0, beta1: 0.9, beta2: 0.999, epsilon: 1e-15 }
    }

    /// The same with other decay rates and another epsilon.
    pub fn with(mut self, beta1: f32, beta2: f32, epsilon: f32) -> Adam {
        (self.beta1, self.beta2, self.epsilon) = (beta1, beta2, epsilon);
        self
    }

    /// Number of parameters.
    pub fn len(&self) -> usize {
        self.first.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.first.is_empty()
    }

    /// One step for all parameters.
    ///
    /// # Panics
    /// If `parameters` or `grads` has another length than this group.
    pub fn step(&mut self, parameters: &mut [f32], grads: &[f32], rate: f32) {
        let rule = self.advance(rate);
        self.update(parameters, grads, rule, None);
    }

    /// One step for all parameters, by a given rule.
    ///
    /// # Panics
    /// If `parameters` or `grads` has another length than this group.
    pub fn step_by(&mut self, parameters: &mut [f32], grads: &[f32], rule: Rule) {
        self.update(parameters, grads, rule, None);
    }

    /// One step for the items with `radii` above 0 ([`crate::Projected::radii`]); the others keep their values
    /// and moments, so that a splat out of sight does not drift.
    ///
    /// # Panics
    /// If the lengths do not belong together.
    pub fn step_visible(&mut self, parameters: &mut [f32], grads: &[f32], rate: f32, radii: &[f32]) {
        let rule = self.advance(rate);
        self.update(parameters, grads, rule, Some(radii));
    }

    /// Counts a step that a device computes, and returns its rule.
    pub fn advance(&mut self, rate: f32) -> Rule {
        self.steps += 1;
        let power = |beta: f32| 1.0 - f64::from(beta).powi(self.steps.min(1 << 20) as i32);
        let root = power(self.beta2).sqrt();
        Rule {
            beta1: self.beta1,
            beta2: self.beta2,
            rate: (f64::from(rate) * root / power(self.beta1)) as f32,
            epsilon: (f64::from(self.epsilon) * root) as f32,
        }
    }

    /// First and second moments, one of each per parameter.
    pub fn moments(&self) -> [&[f32]; 2] {
        [&self.first, &self.second]
    }

    /// Replaces the moments.
    ///
    /// # Panics
    /// If they are not those of whole items, as many of one as of the other.
    pub fn set_moments(&mut self, first: Vec<f32>, second: Vec<f32>) {
        assert_eq!(first.len(), second.len(), "moments: length");
        assert!(first.len().is_multiple_of(self.item.max(1)), "moments: items");
        (self.first, self.second) = (first, second);
    }

    fn update(&mut self, parameters: &mut [f32], grads: &[f32], rule: Rule, radii: Option<&[f32]>) {
        assert_eq!(parameters.len(), self.first.len(), "parameters: length");
        assert_eq!(grads.len(), self.first.len(), "gradients: length");
        if let Some(radii) = radii {
            assert_eq!(radii.len() * self.item, self.first.len(), "radii: length");
        }
        let isa = Isa::detect_once();
        let item = self.item;
        let chunk = CHUNK.div_ceil(item) * item;
        parameters
            .par_chunks_mut(chunk)
            .zip(grads.par_chunks(chunk))
            .zip(self.first.par_chunks_mut(chunk))
            .zip(self.second.par_chunks_mut(chunk))
            .enumerate()
            .for_each(|(k, (((p, g), m), v))| match radii {
                None => simd::run(isa, Update { rule, p, g, m, v }),
                Some(radii) => {
                    // Runs of visible items.
                    let radii = &radii[k * (chunk / item)..];
                    let count = p.len() / item;
                    let mut i = 0;
                    while i < count {
                        let from = i;
                        while i < count && radii[i] > 0.0 {
                            i += 1;
                        }
                        if from < i {
                            let run = from * item..i * item;
                            let (p, g) = (&mut p[run.clone()], &g[run.clone()]);
                            let (m, v) = (&mut m[run.clone()], &mut v[run]);
                            simd::run(isa, Update { rule, p, g, m, v });
                        }
                        i += 1;
                    }
                }
            });
    }

    /// The items at `keep`, in that order; an index may occur more than once.
    pub fn select(&mut self, keep: &[usize]) {
        let item = self.item;
        let pick =
            |from: &[f32]| keep.iter().flat_map(|&i| &from[i * item..(i + 1) * item]).copied().collect();
        (self.first, self.second) = (pick(&self.first), pick(&self.second));
    }

    /// Adds items with moments 0 at the end.
    pub fn append(&mut self, items: usize) {
        let len = self.first.len() + items * self.item;
        self.first.resize(len, 0.0);
        self.second.resize(len, 0.0);
    }

    /// Sets the moments of some items to 0, as after an opacity reset or a relocation.
    pub fn forget(&mut self, items: impl IntoIterator<Item = usize>) {
        for i in items {
            self.first[i * self.item..(i + 1) * self.item].fill(0.0);
            self.second[i * self.item..(i + 1) * self.item].fill(0.0);
        }
    }
}

/// How one step goes: `m = beta1 m + (1 - beta1) g`, `v = beta2 v + (1 - beta2) g²`, and the parameter less
/// `rate m / (sqrt(v) + epsilon)`. What is not finite counts as 0.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rule {
    /// Decay of the first moment.
    pub beta1: f32,
    /// Decay of the second.
    pub beta2: f32,
    /// Learning rate, after the bias correction.
    pub rate: f32,
    /// Epsilon, after the bias correction.
    pub epsilon: f32,
}

struct Update<'a> {
    rule: Rule,
    p: &'a mut [f32],
    g: &'a [f32],
    m: &'a mut [f32],
    v: &'a mut [f32],
}

impl SimdKernel for Update<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let rule = self.rule;
        let (p, p_rest) = self.p.as_chunks_mut::<LANES>();
        let (g, g_rest) = self.g.as_chunks::<LANES>();
        let (m, m_rest) = self.m.as_chunks_mut::<LANES>();
        let (v, v_rest) = self.v.as_chunks_mut::<LANES>();
        for (((p, g), m), v) in p.iter_mut().zip(g).zip(m).zip(v) {
            eight(s, rule, p, g, m, v);
        }
        let n = p_rest.len();
        let pad = |from: &[f32]| {
            let mut out = [0.0; LANES];
            out[..n].copy_from_slice(&from[..n]);
            out
        };
        let (mut pp, gg, mut mm, mut vv) = (pad(p_rest), pad(g_rest), pad(m_rest), pad(v_rest));
        eight(s, rule, &mut pp, &gg, &mut mm, &mut vv);
        p_rest.copy_from_slice(&pp[..n]);
        m_rest.copy_from_slice(&mm[..n]);
        v_rest.copy_from_slice(&vv[..n]);
    }
}

type Eight = [f32; LANES];

#[inline(always)]
fn eight<S: Simd>(s: S, rule: Rule, p: &mut Eight, g: &Eight, m: &mut Eight, v: &mut Eight) {
    let Rule { beta1, beta2, rate, epsilon } = rule;
    // SAFETY: all four have eight numbers.
    unsafe {
        // A gradient that is not finite would stay in the moments for ever: it counts as 0.
        let g = s.load(g.as_ptr());
        let g = s.keep(g, s.lt(s.abs(g), s.splat(f32::INFINITY)));
        let m1 = s.add(s.mul(s.splat(beta1), s.load(m.as_ptr())), s.mul(s.splat(1.0 - beta1), g));
        let gg = s.mul(s.mul(s.splat(1.0 - beta2), g), g);
        let v1 = s.min(s.add(s.mul(s.splat(beta2), s.load(v.as_ptr())), gg), s.splat(f32::MAX));
        s.store(m.as_mut_ptr(), m1);
        s.store(v.as_mut_ptr(), v1);
        let step = s.div(s.mul(s.splat(rate), m1), s.add(s.sqrt(v1), s.splat(epsilon)));
        // 0 / 0 where a parameter never had a gradient and epsilon is 0.
        let step = s.keep(step, s.lt(s.abs(step), s.splat(f32::INFINITY)));
        s.store(p.as_mut_ptr(), s.sub(s.load(p.as_ptr()), step));
    }
}
