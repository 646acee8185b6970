//! A network as a list of kernels, forward and backward.
//!
//! All maps of a network lie in one array, and their gradients in another at the same positions; weights lie in a
//! third, as on the host. Every kernel reads its layer from one table of [`LayerUniform`]s.

use super::layer::LayerUniform;
use crate::GpuError;
use crate::device::{DeviceWork, PooledBuffer};
use crate::groups::GROUP;
use crate::layer_flags::{ADD, COUNTED, NOWHERE, RELU};
use crate::shaders::{
    ADD_MAPS, CONVOLVE, CONVOLVE_WEIGHTS, Kernel, NORM, NORM_BACKWARD, RELU_BACKWARD, SUM_WEIGHTS,
};
use segwild_nn::{Id, LayerKind, NetworkGraph, OpKind};
use std::ops::Range;

/// Planes and columns that a group of `convolve` computes.
const CONVOLVED: [usize; 2] = [32, 128];
/// Planes, and weights of each, that a group of `convolve_weights` takes.
const WEIGHTS_CONVOLVED: [usize; 2] = [32, 128];

/// Groups of `convolve_weights` that keep a device busy.
const GROUPS: usize = 256;
/// Least columns of a slice. More slices would cost more additions.
const LEAST_COLUMNS: usize = 64;
const MOST_SLICES: usize = 64;

/// A kernel that a network runs.
#[derive(Clone, Copy, Debug)]
enum NetworkKernel {
    /// From maps to maps, or from gradients to gradients.
    Convolve {
        layer: u32,
        groups: usize,
    },
    /// From maps and gradients to those of the weights.
    ConvolveWeights {
        layer: u32,
        groups: usize,
        slices: usize,
        /// Of a slice.
        columns: usize,
        numbers: usize,
    },
    Norm {
        layer: u32,
        groups: usize,
    },
    /// A map from another, or from the sum of two.
    AddMaps {
        layer: u32,
        numbers: usize,
    },
    /// A ReLU's backward pass, on gradients from a position on.
    ReluBackward {
        at: usize,
        numbers: usize,
    },
}

/// A network's kernels for one size of its input.
#[derive(Debug)]
pub(crate) struct NetworkPlan {
    layers: Vec<LayerUniform>,
    forward: Vec<NetworkKernel>,
    backward: Vec<NetworkKernel>,
    /// Where each map starts.
    positions: Vec<usize>,
    /// Numbers of maps, and of their gradients.
    maps: usize,
    grads: usize,
    /// Largest size of the partial sums of a layer.
    parts: usize,
}

impl NetworkPlan {
    fn empty() -> NetworkPlan {
        let (forward, backward) = (Vec::new(), Vec::new());
        NetworkPlan {
            layers: Vec::new(),
            forward,
            backward,
            positions: Vec::new(),
            maps: 0,
            grads: 0,
            parts: 0,
        }
    }

    /// The kernels of a network for images of this height and width.
    pub fn of(graph: &NetworkGraph, image: [usize; 2]) -> NetworkPlan {
        let mut plan = NetworkPlan::empty();
        let size = |id: Id| graph.forms()[id].size(image).map(|n| n as u32);
        for form in graph.forms() {
            plan.positions.push(plan.maps);
            plan.maps += form.numbers(image);
        }
        plan.grads = plan.maps;
        let mut forms = Vec::new();
        for op in graph.ops() {
            let numbers = graph.forms()[op.from].numbers(image);
            let mut layer = LayerUniform {
                reads: plan.positions[op.from] as u32,
                writes: plan.positions[op.to] as u32,
                ..LayerUniform::of_sizes(size(op.from), size(op.to))
            };
            layer.flags = if op.relu { RELU } else { 0 };
            match &op.what {
                OpKind::Conv(conv) => layer.is(conv.kind(), conv.weights()),
                OpKind::Up(up) => layer.is(up.kind(), up.weights()),
                OpKind::Norm(norm) => {
                    layer.is(norm.kind(), norm.weights());
                    layer.other = plan.maps as u32;
                    plan.maps += numbers + layer.groups();
                }
                OpKind::Add(other) => layer.other = plan.positions[*other] as u32,
                OpKind::Concat(_) => {}
            }
            forms.push(layer);
            match &op.what {
                OpKind::Conv(_) | OpKind::Up(_) => plan.convolve(layer, true),
                OpKind::Norm(_) => {
                    let (groups, layer) = (layer.groups(), plan.layer(layer));
                    plan.forward.push(NetworkKernel::Norm { layer, groups });
                }
                OpKind::Add(_) => plan.add_maps(layer, numbers, true),
                OpKind::Concat(other) => {
                    plan.add_maps(layer, numbers, true);
                    let reads = plan.positions[*other] as u32;
                    let rest = graph.forms()[*other].numbers(image);
                    plan.add_maps(
                        LayerUniform { reads, writes: layer.writes + numbers as u32, ..layer },
                        rest,
                        true,
                    );
                }
            }
        }
        plan.turn(graph, image, &forms);
        plan
    }

    /// The backward pass of a network with these forward layers.
    fn turn(&mut self, graph: &NetworkGraph, image: [usize; 2], forms: &[LayerUniform]) {
        let numbers = |id: Id| graph.forms()[id].numbers(image);
        // Maps that already have gradients: further ones are added.
        let mut started: Vec<bool> =
            (0..graph.forms().len()).map(|id| graph.ops().iter().all(|op| !op.reads(id))).collect();
        let mut flags = |id: Id| if std::mem::replace(&mut started[id], true) { ADD } else { 0 };
        for (op, &layer) in graph.ops().iter().zip(forms).rev() {
            let at = self.positions[op.to];
            if op.relu {
                self.backward.push(NetworkKernel::ReluBackward { at, numbers: numbers(op.to) });
            }
            let plain = LayerUniform { flags: 0, other: NOWHERE, reads: layer.writes, ..layer };
            match &op.what {
                OpKind::Conv(_) | OpKind::Up(_) => {
                    self.convolve_weights(layer);
                    if op.from >= graph.inputs() {
                        let back = layer.back(flags(op.from));
                        self.convolve(back, false);
                    }
                }
                OpKind::Norm(_) => {
                    let (groups, layer) = (layer.groups(), self.layer(layer));
                    self.backward.push(NetworkKernel::Norm { layer, groups });
                }
                OpKind::Add(other) | OpKind::Concat(other) => {
                    let rest = match op.what {
                        OpKind::Add(_) => 0,
                        _ => numbers(op.from) as u32,
                    };
                    for (id, start) in [(op.from, 0), (*other, rest)] {
                        if id >= graph.inputs() {
                            let (reads, writes) = (plain.reads + start, self.positions[id] as u32);
                            let flags = flags(id);
                            self.add_maps(LayerUniform { reads, writes, flags, ..plain }, numbers(id), false);
                        }
                    }
                }
            }
        }
    }

    /// The kernels of dense layers over pieces of so many splats, in chains; each link reads `from` and writes `to`,
    /// which are planes of an array of `planes`. A link computes gradients for its first `wanted` inputs.
    pub fn of_points(chain: &[Link], planes: usize, capacity: usize) -> NetworkPlan {
        let mut plan = NetworkPlan::empty();
        (plan.maps, plan.grads) = (planes * capacity, planes * capacity);
        for link in chain {
            let layer = link.layer(capacity);
            plan.convolve(layer, true);
        }
        for link in chain.iter().rev() {
            let layer = link.layer(capacity);
            if link.relu {
                plan.backward.push(NetworkKernel::ReluBackward {
                    at: link.to * capacity,
                    numbers: link.output * capacity,
                });
            }
            plan.convolve_weights(layer);
            let back = LayerUniform { output: link.wanted as u32, ..layer.back(COUNTED) };
            plan.convolve(back, false);
        }
        plan
    }

    /// The kernels of the products of so many pixels' unit features with themselves, `[channel][pixel]`, in pieces of
    /// `capacity` columns: forward, the columns' cosines with every pixel; backward, the gradients of the columns' unit
    /// features from those of the cosines. The unit features are the weights, and the first of the maps.
    pub fn of_pairs(channels: usize, pixels: usize, capacity: usize) -> NetworkPlan {
        let mut plan = NetworkPlan::empty();
        let capacity = capacity.min(pixels);
        (plan.maps, plan.grads) =
            (channels * pixels + pixels * capacity, channels * capacity + pixels * capacity);
        let all = |n: usize| n as u32;
        for first in (0..pixels).step_by(capacity.max(1)) {
            let columns = [1, all(capacity.min(pixels - first))];
            let forward = LayerUniform {
                reads: all(first),
                writes: all(channels * pixels),
                offsets: NOWHERE,
                input: all(channels),
                output: all(pixels),
                by_output: 1,
                by_input: all(pixels),
                ..LayerUniform::of_sizes([1, all(pixels)], columns)
            };
            plan.convolve(forward, true);
            let back = LayerUniform {
                reads: all(channels * capacity),
                writes: 0,
                input: all(pixels),
                output: all(channels),
                by_output: all(pixels),
                by_input: 1,
                ..LayerUniform { input_size: forward.output_size, ..forward }
            };
            plan.convolve(back, false);
        }
        plan
    }

    /// Pieces of [`NetworkPlan::of_pairs`].
    pub fn pieces(&self) -> usize {
        self.forward.len()
    }

    fn layer(&mut self, layer: LayerUniform) -> u32 {
        self.layers.push(layer);
        self.layers.len() as u32 - 1
    }

    fn convolve(&mut self, layer: LayerUniform, forward: bool) {
        let groups = (layer.output as usize).div_ceil(CONVOLVED[0]) * layer.columns().div_ceil(CONVOLVED[1]);
        let run = NetworkKernel::Convolve { layer: self.layer(layer), groups };
        if forward { self.forward.push(run) } else { self.backward.push(run) }
    }

    fn convolve_weights(&mut self, layer: LayerUniform) {
        let (output, wide) =
            (layer.output as usize, (layer.input * layer.kernel * layer.kernel) as usize + 1);
        let tiles = output.div_ceil(WEIGHTS_CONVOLVED[0]) * wide.div_ceil(WEIGHTS_CONVOLVED[1]);
        let wanted = GROUPS.div_ceil(tiles).min(MOST_SLICES);
        let columns = layer.columns().div_ceil(wanted).max(LEAST_COLUMNS);
        let slices = layer.columns().div_ceil(columns);
        let groups = tiles * slices;
        self.parts = self.parts.max(slices * output * wide);
        let layer = self.layer(layer);
        self.backward.push(NetworkKernel::ConvolveWeights {
            layer,
            groups,
            slices,
            columns,
            numbers: output * wide,
        });
    }

    fn add_maps(&mut self, layer: LayerUniform, numbers: usize, forward: bool) {
        let run = NetworkKernel::AddMaps { layer: self.layer(layer), numbers };
        if forward { self.forward.push(run) } else { self.backward.push(run) }
    }

    /// Where a map starts.
    pub fn position(&self, map: Id) -> usize {
        self.positions[map]
    }

    /// Numbers of all maps.
    pub fn maps(&self) -> usize {
        self.maps
    }

    /// Multiplications and additions forward and backward, and the least bytes that must move: every map, its gradient
    /// and every weight written and read once.
    pub fn floor(&self, weights: usize) -> (f64, f64) {
        let products = |run: &NetworkKernel| match *run {
            NetworkKernel::Convolve { layer, .. } | NetworkKernel::ConvolveWeights { layer, .. } => {
                let layer = &self.layers[layer as usize];
                let taps = (layer.input * layer.kernel * layer.kernel) as f64;
                2.0 * taps * f64::from(layer.output) * layer.columns() as f64
            }
            NetworkKernel::Norm { .. }
            | NetworkKernel::AddMaps { .. }
            | NetworkKernel::ReluBackward { .. } => 0.0,
        };
        let operations = self.forward.iter().chain(&self.backward).map(products).sum();
        (8.0 * (self.maps + self.grads + weights) as f64, operations)
    }

    /// Bytes that its maps, gradients and slices take on the device.
    pub fn bytes(&self) -> usize {
        4 * (self.maps + self.grads + self.parts)
    }
}

/// A dense layer between planes.
#[derive(Clone, Debug)]
pub(crate) struct Link {
    /// `[in][out]`, then offsets.
    pub weights: Range<usize>,
    pub input: usize,
    pub output: usize,
    /// First planes of its input and of its output.
    pub from: usize,
    pub to: usize,
    pub relu: bool,
    pub wanted: usize,
}

impl Link {
    fn layer(&self, capacity: usize) -> LayerUniform {
        let mut layer = LayerUniform {
            reads: (self.from * capacity) as u32,
            writes: (self.to * capacity) as u32,
            ..LayerUniform::of_sizes([1, capacity as u32], [1, capacity as u32])
        };
        layer.flags = COUNTED | if self.relu { RELU } else { 0 };
        layer.is(LayerKind::Dense { input: self.input, output: self.output }, self.weights.clone());
        layer
    }
}

/// Networks' weights on the device, and their gradients.
#[derive(Clone, Copy)]
pub(crate) struct GpuWeights<'a> {
    pub values: &'a PooledBuffer,
    pub grads: &'a PooledBuffer,
}

/// Maps of a network on the device, and their gradients.
pub(crate) struct GpuTape {
    pub layers: PooledBuffer,
    pub maps: PooledBuffer,
    pub grads: PooledBuffer,
    parts: PooledBuffer,
}

impl GpuTape {
    /// Allocates the maps of a network.
    pub fn new(work: &mut DeviceWork, plan: &NetworkPlan) -> Result<GpuTape, GpuError> {
        Ok(GpuTape {
            layers: work.upload("a network's layers", &plan.layers)?,
            maps: work.take::<f32>("a network's maps", plan.maps)?,
            grads: work.take::<f32>("the gradients of a network's maps", plan.grads)?,
            parts: work.take::<f32>("parts of the weights' gradients", plan.parts)?,
        })
    }

    /// Runs the network on its first maps. `in_sight` and `first` as for the kernels.
    pub fn forward(
        &self,
        work: &mut DeviceWork,
        plan: &NetworkPlan,
        weights: &PooledBuffer,
        in_sight: &PooledBuffer,
        first: usize,
    ) {
        let GpuTape { layers, maps, .. } = self;
        for run in &plan.forward {
            match *run {
                NetworkKernel::Convolve { .. } => self.convolve(work, *run, maps, weights, in_sight, first),
                NetworkKernel::Norm { layer, groups } => {
                    work.run(&NORM, 1, [layer, 0, 0, 0], &[layers, weights, maps], groups);
                }
                NetworkKernel::AddMaps { layer, numbers } => {
                    each(work, &ADD_MAPS, layer, numbers, &[layers, maps])
                }
                NetworkKernel::ConvolveWeights { .. } | NetworkKernel::ReluBackward { .. } => {
                    unreachable!("in the backward pass only")
                }
            }
        }
    }

    /// Adds to the gradients of the weights, from those of the maps that nothing reads.
    pub fn backward(
        &self,
        work: &mut DeviceWork,
        plan: &NetworkPlan,
        weights: GpuWeights,
        in_sight: &PooledBuffer,
        first: usize,
    ) {
        let GpuTape { layers, maps, grads, parts } = self;
        for run in &plan.backward {
            match *run {
                NetworkKernel::Convolve { .. } => {
                    self.convolve(work, *run, grads, weights.values, in_sight, first)
                }
                NetworkKernel::ConvolveWeights { layer, groups, slices, columns, numbers } => {
                    let job = [layer, first as u32, slices as u32, columns as u32];
                    work.run(&CONVOLVE_WEIGHTS, 1, job, &[layers, maps, grads, parts, in_sight], groups);
                    let job = [layer, slices as u32, 0, 0];
                    work.run(&SUM_WEIGHTS, 1, job, &[layers, parts, weights.grads], numbers.div_ceil(GROUP));
                }
                NetworkKernel::Norm { layer, groups } => {
                    let buffers = [layers, weights.values, maps, grads, weights.grads];
                    work.run(&NORM_BACKWARD, 1, [layer, 0, 0, 0], &buffers, groups);
                }
                NetworkKernel::AddMaps { layer, numbers } => {
                    each(work, &ADD_MAPS, layer, numbers, &[layers, grads])
                }
                NetworkKernel::ReluBackward { at, numbers } => {
                    each(work, &RELU_BACKWARD, at as u32, numbers, &[maps, grads])
                }
            }
        }
    }

    /// A piece of [`NetworkPlan::of_pairs`], forward. `any` is bound and not read.
    pub fn forward_piece(
        &self,
        work: &mut DeviceWork,
        plan: &NetworkPlan,
        piece: usize,
        units: &PooledBuffer,
        any: &PooledBuffer,
    ) {
        self.convolve(work, plan.forward[piece], &self.maps, units, any, 0);
    }

    /// And backward.
    pub fn backward_piece(
        &self,
        work: &mut DeviceWork,
        plan: &NetworkPlan,
        piece: usize,
        units: &PooledBuffer,
        any: &PooledBuffer,
    ) {
        self.convolve(work, plan.backward[piece], &self.grads, units, any, 0);
    }

    fn convolve(
        &self,
        work: &mut DeviceWork,
        run: NetworkKernel,
        maps: &PooledBuffer,
        weights: &PooledBuffer,
        in_sight: &PooledBuffer,
        first: usize,
    ) {
        let NetworkKernel::Convolve { layer, groups } = run else { return };
        let buffers = [&self.layers, weights, maps, in_sight];
        work.run(&CONVOLVE, 1, [layer, first as u32, 0, 0], &buffers, groups);
    }
}

/// A kernel with a thread per number.
fn each(work: &mut DeviceWork, kernel: &Kernel, what: u32, numbers: usize, buffers: &[&PooledBuffer]) {
    work.run(kernel, 1, [what, numbers as u32, 0, 0], buffers, numbers.div_ceil(GROUP));
}
