//! The optimiser on the device: the groups of parameters, and their rules.

use crate::GpuError;
use crate::bin::Cloud;
use crate::device::{DeviceWork, PooledBuffer};
use crate::groups::GROUP;
use crate::parameters::GpuTraining;
use crate::passes::ShapeGrads;
use crate::shaders::ADAM;
use bytemuck::{Pod, Zeroable};
use segwild_objective::{DeviceTraining, NetworksStep, OptimiserRules, Rule};

/// `OptimiserRules` of `adam.wgsl`.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct AdamRules {
    first: [f32; 4],
    second: [f32; 4],
    item: [u32; 4],
}

/// Gradients of all parameters.
pub(crate) struct StepGrads {
    /// Of [`ShapeGrads`].
    pub shapes: PooledBuffer,
    /// As [`GpuParameters::sh`].
    pub sh: PooledBuffer,
    /// As [`GpuSplatEmbeddings::values`].
    pub splat_embeddings: Option<PooledBuffer>,
}

/// A group of parameters of `adam`.
struct ParameterGroup {
    /// Where the gradients of the first item start, and the distance to those of the next.
    from: usize,
    stride: usize,
    /// How many items, and numbers of each; of these, how many are parameters, and how many follow the first of two rules.
    items: usize,
    width: usize,
    live: usize,
    split: usize,
    rules: [Rule; 2],
    /// Only splats in sight are stepped; the factor by which parameters of the second rule decay.
    seen: Option<f32>,
}

impl ParameterGroup {
    fn rules(&self) -> AdamRules {
        let rule = |Rule { beta1, beta2, rate, epsilon }: Rule| [beta1, beta2, rate, epsilon];
        AdamRules {
            first: rule(self.rules[0]),
            second: rule(self.rules[1]),
            item: [self.from, self.stride, self.live, self.split].map(|v| v as u32),
        }
    }
}

/// The optimiser's groups, with their rules on the device.
pub(crate) struct Groups(Vec<(ParameterGroup, PooledBuffer)>);

impl GpuTraining {
    /// The groups of parameters under these rules: centres and opacities, scales, rotations, harmonics and, where there
    /// are some, embeddings.
    pub fn groups(
        &self,
        work: &mut DeviceWork,
        rules: &OptimiserRules,
        networks: Option<&NetworksStep>,
    ) -> Result<Groups, GpuError> {
        let shape = |from, live, split, rules| ParameterGroup {
            from,
            stride: size_of::<ShapeGrads>() / 4,
            items: self.count(),
            width: 4,
            live,
            split,
            rules,
            seen: None,
        };
        let whole = |items, width, split, rules, seen| ParameterGroup {
            from: 0,
            stride: width,
            items,
            width,
            live: width,
            split,
            rules,
            seen,
        };
        let mut groups = vec![
            shape(0, 4, 3, [rules.means, rules.opacities]),
            shape(4, 3, 3, [rules.log_scales; 2]),
            shape(8, 4, 4, [rules.rotations; 2]),
            whole(self.count(), self.sh_stride(), 3, [rules.base, rules.higher], None),
        ];
        if let Some(splat_embeddings) = &self.splat_embeddings {
            groups.push(whole(
                self.count(),
                splat_embeddings.width,
                splat_embeddings.before(),
                [rules.splat_embeddings; 2],
                Some(rules.kept),
            ));
        }
        if let (Some(networks), Some(step)) = (&self.networks, networks) {
            groups.push(whole(1, networks.len(), networks.nets().border, step.rules, None));
        }
        let up = groups.into_iter().map(|group| {
            let rules = work.upload("the rules", &[group.rules()])?;
            Ok((group, rules))
        });
        up.collect::<Result<_, _>>().map(Groups)
    }

    /// The optimiser's step of every group of parameters; `weights` are the gradients of the networks'.
    pub fn adam(
        &self,
        work: &mut DeviceWork,
        grads: &StepGrads,
        weights: Option<&PooledBuffer>,
        seen: &PooledBuffer,
        found: &PooledBuffer,
        groups: &Groups,
    ) {
        let all = [&self.splats, &self.first, &self.second];
        let shapes =
            |of: fn(&Cloud) -> &PooledBuffer| (all.map(|numbers| of(&numbers.shapes)), &grads.shapes);
        let mut arrays = vec![
            shapes(|of| &of.means),
            shapes(|of| &of.log_scales),
            shapes(|of| &of.rotations),
            (all.map(|numbers| &numbers.sh), &grads.sh),
        ];
        if let (Some(splat_embeddings), Some(grads)) = (&self.splat_embeddings, &grads.splat_embeddings) {
            arrays
                .push(([&splat_embeddings.values, &splat_embeddings.first, &splat_embeddings.second], grads));
        }
        if let (Some(networks), Some(weights)) = (&self.networks, weights) {
            arrays.push(([&networks.weights, &networks.first, &networks.second], weights));
        }
        for (([parameters, first, second], grads), (group, rules)) in arrays.into_iter().zip(&groups.0) {
            let numbers = group.items * group.width;
            let only_seen = u32::from(group.seen.is_some());
            let job = [numbers as u32, group.width as u32, only_seen, group.seen.unwrap_or(1.0).to_bits()];
            let buffers = [rules, grads, parameters, first, second, seen, found];
            work.run(&ADAM, 1, job, &buffers, numbers.div_ceil(GROUP));
        }
    }
}
