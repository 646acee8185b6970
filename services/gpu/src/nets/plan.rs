//! A network as a list of kernels, forward and back.
//!
//! All maps of a network lie in one array, and their gradients in another at the same places; weights lie in a third, as they
//! do on the host. Every kernel reads what it is about from one table of [`Layer`]s.

use super::layer::{ADD, COUNTED, Layer, NOWHERE, RELU};
use crate::GpuError;
use crate::device::{Lent, Work};
use crate::engine::GROUP;
use crate::shaders::{CONVOLVE, CONVOLVE_WEIGHTS, GATE, JOIN, Kernel, NORM, NORM_BACKWARD, SUM_WEIGHTS};
use segwild_nn::{Graph, Id, Kind, What};
use std::ops::Range;

/// Planes and columns that a group of `convolve` makes.
const CONVOLVED: [usize; 2] = [32, 128];
/// Planes, and weights of each, that a group of `convolve_weights` takes.
const WEIGHED: [usize; 2] = [32, 128];

/// Groups of `convolve_weights` that keep a device busy.
const GROUPS: usize = 256;
/// A slice of the columns has no fewer, and there are no more slices: somebody has to add them up.
const LEAST_COLUMNS: usize = 64;
const MOST_SLICES: usize = 64;

/// A kernel that a network runs.
#[derive(Clone, Copy, Debug)]
enum Run {
    /// From maps to maps, or from gradients to gradients.
    Convolve {
        layer: u32,
        groups: usize,
    },
    /// From maps and gradients to those of the weights.
    Weights {
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
    Join {
        layer: u32,
        numbers: usize,
    },
    /// Of the gradients from a place on.
    Gate {
        at: usize,
        numbers: usize,
    },
}

/// A network's kernels for one size of what it is given.
#[derive(Debug)]
pub(crate) struct Plan {
    layers: Vec<Layer>,
    forward: Vec<Run>,
    backward: Vec<Run>,
    /// Where each map begins.
    positions: Vec<usize>,
    /// Numbers of maps, and of their gradients.
    maps: usize,
    grads: usize,
    /// Most numbers that the slices of a layer's columns leave.
    parts: usize,
}

impl Plan {
    fn empty() -> Plan {
        let (forward, backward) = (Vec::new(), Vec::new());
        Plan { layers: Vec::new(), forward, backward, positions: Vec::new(), maps: 0, grads: 0, parts: 0 }
    }

    /// The kernels of a network for images of this height and width.
    pub fn of(graph: &Graph, image: [usize; 2]) -> Plan {
        let mut plan = Plan::empty();
        let size = |id: Id| graph.forms()[id].size(image).map(|n| n as u32);
        for form in graph.forms() {
            plan.positions.push(plan.maps);
            plan.maps += form.numbers(image);
        }
        plan.grads = plan.maps;
        let mut forms = Vec::new();
        for op in graph.ops() {
            let numbers = graph.forms()[op.from].numbers(image);
            let mut layer = Layer {
                reads: plan.positions[op.from] as u32,
                writes: plan.positions[op.to] as u32,
                ..Layer::of_sizes(size(op.from), size(op.to))
            };
            layer.flags = if op.relu { RELU } else { 0 };
            match &op.what {
                What::Conv(conv) => layer.is(conv.kind(), conv.weights()),
                What::Up(up) => layer.is(up.kind(), up.weights()),
                What::Norm(norm) => {
                    layer.is(norm.kind(), norm.weights());
                    layer.other = plan.maps as u32;
                    plan.maps += numbers + layer.groups();
                }
                What::Join(other) => layer.other = plan.positions[*other] as u32,
                What::Beside(_) => {}
            }
            forms.push(layer);
            match &op.what {
                What::Conv(_) | What::Up(_) => plan.convolve(layer, true),
                What::Norm(_) => {
                    let (groups, layer) = (layer.groups(), plan.layer(layer));
                    plan.forward.push(Run::Norm { layer, groups });
                }
                What::Join(_) => plan.join(layer, numbers, true),
                What::Beside(other) => {
                    plan.join(layer, numbers, true);
                    let reads = plan.positions[*other] as u32;
                    let rest = graph.forms()[*other].numbers(image);
                    plan.join(Layer { reads, writes: layer.writes + numbers as u32, ..layer }, rest, true);
                }
            }
        }
        plan.turn(graph, image, &forms);
        plan
    }

    /// The way back of a network whose layers forward are these.
    fn turn(&mut self, graph: &Graph, image: [usize; 2], forms: &[Layer]) {
        let numbers = |id: Id| graph.forms()[id].numbers(image);
        // Maps whose gradients there are by then: more is added to them.
        let mut started: Vec<bool> =
            (0..graph.forms().len()).map(|id| graph.ops().iter().all(|op| !op.reads(id))).collect();
        let mut flags = |id: Id| if std::mem::replace(&mut started[id], true) { ADD } else { 0 };
        for (op, &layer) in graph.ops().iter().zip(forms).rev() {
            let at = self.positions[op.to];
            if op.relu {
                self.backward.push(Run::Gate { at, numbers: numbers(op.to) });
            }
            let plain = Layer { flags: 0, other: NOWHERE, reads: layer.writes, ..layer };
            match &op.what {
                What::Conv(_) | What::Up(_) => {
                    self.weigh(layer);
                    if op.from >= graph.inputs() {
                        let back = layer.back(flags(op.from));
                        self.convolve(back, false);
                    }
                }
                What::Norm(_) => {
                    let (groups, layer) = (layer.groups(), self.layer(layer));
                    self.backward.push(Run::Norm { layer, groups });
                }
                What::Join(other) | What::Beside(other) => {
                    let rest = match op.what {
                        What::Join(_) => 0,
                        _ => numbers(op.from) as u32,
                    };
                    for (id, start) in [(op.from, 0), (*other, rest)] {
                        if id >= graph.inputs() {
                            let (reads, writes) = (plain.reads + start, self.positions[id] as u32);
                            let flags = flags(id);
                            self.join(Layer { reads, writes, flags, ..plain }, numbers(id), false);
                        }
                    }
                }
            }
        }
    }

    /// The kernels of dense layers over pieces of so many splats, in chains; each link reads `from` and writes `to`, which are
    /// planes of an array of `planes`. A link's gradient is asked of its first `wanted` inputs.
    pub fn of_points(chain: &[Link], planes: usize, capacity: usize) -> Plan {
        let mut plan = Plan::empty();
        (plan.maps, plan.grads) = (planes * capacity, planes * capacity);
        for link in chain {
            let layer = link.layer(capacity);
            plan.convolve(layer, true);
        }
        for link in chain.iter().rev() {
            let layer = link.layer(capacity);
            if link.relu {
                plan.backward.push(Run::Gate { at: link.to * capacity, numbers: link.output * capacity });
            }
            plan.weigh(layer);
            let back = Layer { output: link.wanted as u32, ..layer.back(COUNTED) };
            plan.convolve(back, false);
        }
        plan
    }

    /// The kernels of the products of so many pixels' units with themselves, `[channel][pixel]`, at pieces of `capacity` columns:
    /// forward, the columns' cosines with every pixel; back, the gradients of the columns' units from those of the cosines. The
    /// units are the weights, and the first of the maps.
    pub fn of_pairs(channels: usize, pixels: usize, capacity: usize) -> Plan {
        let mut plan = Plan::empty();
        let capacity = capacity.min(pixels);
        (plan.maps, plan.grads) =
            (channels * pixels + pixels * capacity, channels * capacity + pixels * capacity);
        let all = |n: usize| n as u32;
        for first in (0..pixels).step_by(capacity.max(1)) {
            let columns = [1, all(capacity.min(pixels - first))];
            let forward = Layer {
                reads: all(first),
                writes: all(channels * pixels),
                offsets: NOWHERE,
                input: all(channels),
                output: all(pixels),
                by_output: 1,
                by_input: all(pixels),
                ..Layer::of_sizes([1, all(pixels)], columns)
            };
            plan.convolve(forward, true);
            let back = Layer {
                reads: all(channels * capacity),
                writes: 0,
                input: all(pixels),
                output: all(channels),
                by_output: all(pixels),
                by_input: 1,
                ..Layer { input_size: forward.output_size, ..forward }
            };
            plan.convolve(back, false);
        }
        plan
    }

    /// Pieces of [`Plan::of_pairs`].
    pub fn pieces(&self) -> usize {
        self.forward.len()
    }

    fn layer(&mut self, layer: Layer) -> u32 {
        self.layers.push(layer);
        self.layers.len() as u32 - 1
    }

    fn convolve(&mut self, layer: Layer, forward: bool) {
        let groups = (layer.output as usize).div_ceil(CONVOLVED[0]) * layer.columns().div_ceil(CONVOLVED[1]);
        let run = Run::Convolve { layer: self.layer(layer), groups };
        if forward { self.forward.push(run) } else { self.backward.push(run) }
    }

    fn weigh(&mut self, layer: Layer) {
        let (output, wide) =
            (layer.output as usize, (layer.input * layer.kernel * layer.kernel) as usize + 1);
        let tiles = output.div_ceil(WEIGHED[0]) * wide.div_ceil(WEIGHED[1]);
        let wanted = GROUPS.div_ceil(tiles).min(MOST_SLICES);
        let columns = layer.columns().div_ceil(wanted).max(LEAST_COLUMNS);
        let slices = layer.columns().div_ceil(columns);
        let groups = tiles * slices;
        self.parts = self.parts.max(slices * output * wide);
        let layer = self.layer(layer);
        self.backward.push(Run::Weights { layer, groups, slices, columns, numbers: output * wide });
    }

    fn join(&mut self, layer: Layer, numbers: usize, forward: bool) {
        let run = Run::Join { layer: self.layer(layer), numbers };
        if forward { self.forward.push(run) } else { self.backward.push(run) }
    }

    /// Where a map begins.
    pub fn position(&self, map: Id) -> usize {
        self.positions[map]
    }

    /// Numbers of all maps.
    pub fn maps(&self) -> usize {
        self.maps
    }

    /// Multiplications and additions forward and back, and bytes that must move at the least: every map, its gradient and every
    /// weight written and read once.
    pub fn floor(&self, weights: usize) -> (f64, f64) {
        let products = |run: &Run| match *run {
            Run::Convolve { layer, .. } | Run::Weights { layer, .. } => {
                let layer = &self.layers[layer as usize];
                let taps = (layer.input * layer.kernel * layer.kernel) as f64;
                2.0 * taps * f64::from(layer.output) * layer.columns() as f64
            }
            Run::Norm { .. } | Run::Join { .. } | Run::Gate { .. } => 0.0,
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
    /// First planes of what it reads and of what it writes.
    pub from: usize,
    pub to: usize,
    pub relu: bool,
    pub wanted: usize,
}

impl Link {
    fn layer(&self, capacity: usize) -> Layer {
        let mut layer = Layer {
            reads: (self.from * capacity) as u32,
            writes: (self.to * capacity) as u32,
            ..Layer::of_sizes([1, capacity as u32], [1, capacity as u32])
        };
        layer.flags = COUNTED | if self.relu { RELU } else { 0 };
        layer.is(Kind::Dense { input: self.input, output: self.output }, self.weights.clone());
        layer
    }
}

/// Networks' weights on the device, and where their gradients go.
#[derive(Clone, Copy)]
pub(crate) struct Weights<'a> {
    pub values: &'a Lent,
    pub grads: &'a Lent,
}

/// What a network makes of what it is given, on the device.
pub(crate) struct Tape {
    pub layers: Lent,
    pub maps: Lent,
    pub grads: Lent,
    parts: Lent,
}

impl Tape {
    /// Room for what a network makes.
    pub fn new(work: &mut Work, plan: &Plan) -> Result<Tape, GpuError> {
        Ok(Tape {
            layers: work.upload("a network's layers", &plan.layers)?,
            maps: work.take::<f32>("a network's maps", plan.maps)?,
            grads: work.take::<f32>("the gradients of a network's maps", plan.grads)?,
            parts: work.take::<f32>("parts of the weights' gradients", plan.parts)?,
        })
    }

    /// Runs what lies at the network's first maps. `in_sight` and `first` as for the kernels.
    pub fn forward(&self, work: &mut Work, plan: &Plan, weights: &Lent, in_sight: &Lent, first: usize) {
        let Tape { layers, maps, .. } = self;
        for run in &plan.forward {
            match *run {
                Run::Convolve { .. } => self.convolve(work, *run, maps, weights, in_sight, first),
                Run::Norm { layer, groups } => {
                    work.run(&NORM, 1, [layer, 0, 0, 0], &[layers, weights, maps], groups);
                }
                Run::Join { layer, numbers } => each(work, &JOIN, layer, numbers, &[layers, maps]),
                Run::Weights { .. } | Run::Gate { .. } => unreachable!("on the way back only"),
            }
        }
    }

    /// Adds to the gradients of the weights, from those of the maps that nothing reads.
    pub fn backward(&self, work: &mut Work, plan: &Plan, weights: Weights, in_sight: &Lent, first: usize) {
        let Tape { layers, maps, grads, parts } = self;
        for run in &plan.backward {
            match *run {
                Run::Convolve { .. } => self.convolve(work, *run, grads, weights.values, in_sight, first),
                Run::Weights { layer, groups, slices, columns, numbers } => {
                    let job = [layer, first as u32, slices as u32, columns as u32];
                    work.run(&CONVOLVE_WEIGHTS, 1, job, &[layers, maps, grads, parts, in_sight], groups);
                    let job = [layer, slices as u32, 0, 0];
                    work.run(&SUM_WEIGHTS, 1, job, &[layers, parts, weights.grads], numbers.div_ceil(GROUP));
                }
                Run::Norm { layer, groups } => {
                    let buffers = [layers, weights.values, maps, grads, weights.grads];
                    work.run(&NORM_BACKWARD, 1, [layer, 0, 0, 0], &buffers, groups);
                }
                Run::Join { layer, numbers } => each(work, &JOIN, layer, numbers, &[layers, grads]),
                Run::Gate { at, numbers } => each(work, &GATE, at as u32, numbers, &[maps, grads]),
            }
        }
    }

    /// A piece of [`Plan::of_pairs`], forward. `any` is bound and not read.
    pub fn forward_piece(&self, work: &mut Work, plan: &Plan, piece: usize, units: &Lent, any: &Lent) {
        self.convolve(work, plan.forward[piece], &self.maps, units, any, 0);
    }

    /// And back.
    pub fn backward_piece(&self, work: &mut Work, plan: &Plan, piece: usize, units: &Lent, any: &Lent) {
        self.convolve(work, plan.backward[piece], &self.grads, units, any, 0);
    }

    fn convolve(
        &self,
        work: &mut Work,
        run: Run,
        maps: &Lent,
        weights: &Lent,
        in_sight: &Lent,
        first: usize,
    ) {
        let Run::Convolve { layer, groups } = run else { return };
        let buffers = [&self.layers, weights, maps, in_sight];
        work.run(&CONVOLVE, 1, [layer, first as u32, 0, 0], &buffers, groups);
    }
}

/// A kernel with a thread per number.
fn each(work: &mut Work, kernel: &Kernel, what: u32, numbers: usize, buffers: &[&Lent]) {
    work.run(kernel, 1, [what, numbers as u32, 0, 0], buffers, numbers.div_ceil(GROUP));
}
