//! A UNet: a residual encoder to 1/32 of the size, a decoder back to 1/2, and a head on what is between them.

use crate::conv::{Conv, Up};
use crate::layer::Layout;
use crate::map::Map;
use crate::norm::{GroupNorm, NormState};

/// How wide a UNet is. All numbers of planes are multiples of 8.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Planes of the image.
    pub input: usize,
    /// Side of the first kernel.
    pub stem: usize,
    /// Planes of the encoder at 1/2, 1/4, 1/8, 1/16 and 1/32 of the size.
    pub encoder: [usize; 5],
    /// Residual blocks at each size from 1/4 on.
    pub blocks: usize,
    /// Planes of the decoder at 1/16, 1/8, 1/4 and 1/2.
    pub decoder: [usize; 4],
    /// Planes that are given at 1/2 of the size and join the decoder's before the last layer (which is linear).
    pub beside: usize,
    /// Planes of the result, at 1/2.
    pub output: usize,
    /// Planes of the head at 1/16, 1/8 and 1/4.
    pub head: [usize; 3],
}

/// The image's sides must be multiples of this.
const GRAIN: usize = 32;
/// Planes that are normalised together.
const GROUP: usize = 8;

/// Two convolutions beside a way round.
#[derive(Clone, Debug)]
struct Block {
    first: Double,
    second: Double,
    round: Option<Double>,
}

/// A convolution and its norm.
#[derive(Clone, Debug)]
struct Double {
    conv: Conv,
    norm: GroupNorm,
}

impl Double {
    fn new(layout: &mut Layout, name: &str, planes: [usize; 2], kernel: usize, stride: usize) -> Double {
        let conv = Conv::new(layout, name, planes, kernel, stride);
        let groups = planes[1].div_ceil(GROUP);
        Double { conv, norm: GroupNorm::new(layout, &format!("{name}.norm"), planes[1], groups) }
    }

    fn forward(&self, weights: &[f32], x: &Map) -> (Map, NormState) {
        self.norm.forward(weights, self.conv.forward(weights, x))
    }

    fn backward(&self, weights: &[f32], x: &Map, state: &NormState, grad: Map, sums: &mut [f32]) -> Map {
        let grad = self.norm.backward(weights, state, grad, sums);
        self.conv.backward(weights, x, &grad, sums, true).expect("wanted")
    }
}

/// What a [`Block`] remembers.
#[derive(Clone, Debug)]
struct BlockTape {
    x: Map,
    first: NormState,
    middle: Map,
    second: NormState,
    round: Option<NormState>,
    out: Map,
}

impl Block {
    fn new(layout: &mut Layout, name: &str, [input, output]: [usize; 2], stride: usize) -> Block {
        let first = Double::new(layout, &format!("{name}.first"), [input, output], 3, stride);
        let second = Double::new(layout, &format!("{name}.second"), [output, output], 3, 1);
        let round = (input != output || stride != 1)
            .then(|| Double::new(layout, &format!("{name}.round"), [input, output], 1, stride));
        Block { first, second, round }
    }

    fn forward(&self, weights: &[f32], x: Map) -> BlockTape {
        let (middle, first) = self.first.forward(weights, &x);
        let middle = middle.relu();
        let (mut out, second) = self.second.forward(weights, &middle);
        let round = self.round.as_ref().map(|round| {
            let (way, state) = round.forward(weights, &x);
            out.add(&way);
            state
        });
        if round.is_none() {
            out.add(&x);
        }
        BlockTape { x, first, middle, second, round, out: out.relu() }
    }

    fn backward(&self, weights: &[f32], tape: &BlockTape, grad: Map, sums: &mut [f32]) -> Map {
        let grad = grad.relu_backward(&tape.out);
        let way = match (&self.round, &tape.round) {
            (Some(round), Some(state)) => round.backward(weights, &tape.x, state, grad.clone(), sums),
            _ => grad.clone(),
        };
        let middle = self.second.backward(weights, &tape.middle, &tape.second, grad, sums);
        let middle = middle.relu_backward(&tape.middle);
        let mut out = self.first.backward(weights, &tape.x, &tape.first, middle, sums);
        out.add(&way);
        out
    }
}

/// A step of the decoder: twice the size, joined by what the encoder had there.
#[derive(Clone, Debug)]
struct Step {
    up: Up,
    first: Double,
    second: Double,
}

#[derive(Clone, Debug)]
struct StepTape {
    x: Map,
    joined: Map,
    first: NormState,
    middle: Map,
    second: NormState,
    out: Map,
}

impl Step {
    fn new(layout: &mut Layout, name: &str, input: usize, skip: usize, output: usize) -> Step {
        Step {
            up: Up::new(layout, &format!("{name}.up"), [input, output]),
            first: Double::new(layout, &format!("{name}.first"), [output + skip, output], 3, 1),
            second: Double::new(layout, &format!("{name}.second"), [output, output], 3, 1),
        }
    }

    fn forward(&self, weights: &[f32], x: Map, skip: &Map) -> StepTape {
        let joined = self.up.forward(weights, &x).beside(skip);
        let (middle, first) = self.first.forward(weights, &joined);
        let middle = middle.relu();
        let (out, second) = self.second.forward(weights, &middle);
        StepTape { x, joined, first, middle, second, out: out.relu() }
    }

    /// Gradients of the input and of what the encoder had.
    fn backward(&self, weights: &[f32], tape: &StepTape, grad: Map, sums: &mut [f32]) -> (Map, Map) {
        let grad = grad.relu_backward(&tape.out);
        let middle = self.second.backward(weights, &tape.middle, &tape.second, grad, sums);
        let middle = middle.relu_backward(&tape.middle);
        let joined = self.first.backward(weights, &tape.joined, &tape.first, middle, sums);
        let (up, skip) = joined.split(tape.out.channels);
        (self.up.backward(weights, &tape.x, &up, sums), skip)
    }
}

/// The network, without its weights.
#[derive(Clone, Debug)]
pub struct UNet {
    stem: Conv,
    blocks: Vec<Vec<Block>>,
    steps: Vec<Step>,
    last: Conv,
}

/// What a UNet made of an image.
#[derive(Clone, Debug)]
pub struct Tape {
    image: Map,
    stem: Map,
    blocks: Vec<Vec<BlockTape>>,
    steps: Vec<StepTape>,
    joined: Map,
    /// The planes of the result, at 1/2 of the image's size.
    pub maps: Map,
}

impl Tape {
    /// What is between encoder and decoder, at 1/32.
    pub fn bottleneck(&self) -> &Map {
        &self.blocks[3].last().expect("a block").out
    }
}

impl UNet {
    /// Describes a network of this shape.
    pub fn new(layout: &mut Layout, name: &str, shape: &Shape) -> UNet {
        // No norm after the first convolution: it is where the light of a photo enters, and a norm would take it away.
        let stem = Conv::new(layout, &format!("{name}.stem"), [shape.input, shape.encoder[0]], shape.stem, 2);
        let blocks = (1..5)
            .map(|s| {
                let block = |b: usize| {
                    let input = if b == 0 { shape.encoder[s - 1] } else { shape.encoder[s] };
                    let name = format!("{name}.encoder{s}.{b}");
                    Block::new(layout, &name, [input, shape.encoder[s]], if b == 0 { 2 } else { 1 })
                };
                (0..shape.blocks.max(1)).map(block).collect()
            })
            .collect();
        let mut input = shape.encoder[4];
        let step = |(k, &output): (usize, &usize)| {
            let step = Step::new(layout, &format!("{name}.decoder{k}"), input, shape.encoder[3 - k], output);
            input = output;
            step
        };
        let steps = shape.decoder.iter().enumerate().map(step).collect();
        let joined = shape.decoder[3] + shape.beside;
        let last = Conv::new(layout, &format!("{name}.maps"), [joined, shape.output], 1, 1);
        UNet { stem, blocks, steps, last }
    }

    /// Runs an image; `beside` are the planes that join before the last layer.
    ///
    /// # Panics
    /// If the image's sides are not multiples of 32.
    pub fn forward(&self, weights: &[f32], image: Map, beside: &Map) -> Tape {
        assert!(image.width.is_multiple_of(GRAIN) && image.height.is_multiple_of(GRAIN), "sides");
        let stem = self.stem.forward(weights, &image).relu();
        let mut blocks: Vec<Vec<BlockTape>> = Vec::new();
        let mut x = stem.clone();
        for stage in &self.blocks {
            let mut tapes = Vec::new();
            for block in stage {
                let tape = block.forward(weights, x);
                x = tape.out.clone();
                tapes.push(tape);
            }
            blocks.push(tapes);
        }
        let mut steps: Vec<StepTape> = Vec::new();
        for (k, step) in self.steps.iter().enumerate() {
            let skip = if k < 3 { &blocks[2 - k].last().expect("a block").out } else { &stem };
            let tape = step.forward(weights, x, skip);
            x = tape.out.clone();
            steps.push(tape);
        }
        let joined = x.beside(beside);
        let maps = self.last.forward(weights, &joined);
        Tape { image, stem, blocks, steps, joined, maps }
    }

    /// Adds the gradient of the weights to `sums`, from those of the maps and, if there is one, of the bottleneck.
    pub fn backward(
        &self,
        weights: &[f32],
        tape: &Tape,
        maps: &Map,
        bottleneck: Option<&Map>,
        sums: &mut [f32],
    ) {
        let joined = self.last.backward(weights, &tape.joined, maps, sums, true).expect("wanted");
        let own = tape.steps[3].out.channels;
        let mut grad = joined.split(own).0;
        let mut skips = Vec::new();
        for (step, tape) in self.steps.iter().zip(&tape.steps).rev() {
            let (x, skip) = step.backward(weights, tape, grad, sums);
            grad = x;
            skips.push(skip);
        }
        if let Some(more) = bottleneck {
            grad.add(more);
        }
        // The skips of the decoder's steps came from 1/2 on; the encoder goes the other way.
        for (s, (stage, tapes)) in self.blocks.iter().zip(&tape.blocks).enumerate().rev() {
            for (block, tape) in stage.iter().zip(tapes).rev() {
                grad = block.backward(weights, tape, grad, sums);
            }
            grad.add(&skips[s]);
        }
        let grad = grad.relu_backward(&tape.stem);
        self.stem.backward(weights, &tape.image, &grad, sums, false);
    }
}

/// A head on the bottleneck: one plane at 1/4 of the image's size.
#[derive(Clone, Debug)]
pub struct Head {
    ups: Vec<Up>,
    last: Conv,
}

/// What a [`Head`] made of a bottleneck.
#[derive(Clone, Debug)]
pub struct HeadTape {
    /// The bottleneck, then what each step made.
    inputs: Vec<Map>,
    /// The plane, without a sigmoid.
    pub plane: Map,
}

impl Head {
    /// Describes a head for networks of this shape.
    pub fn new(layout: &mut Layout, name: &str, shape: &Shape) -> Head {
        let mut input = shape.encoder[4];
        let up = |(k, &output): (usize, &usize)| {
            let up = Up::new(layout, &format!("{name}.up{k}"), [input, output]);
            input = output;
            up
        };
        let ups = shape.head.iter().enumerate().map(up).collect();
        Head { ups, last: Conv::new(layout, &format!("{name}.last"), [shape.head[2], 1], 1, 1) }
    }

    /// Runs a bottleneck.
    pub fn forward(&self, weights: &[f32], bottleneck: &Map) -> HeadTape {
        let mut inputs = vec![bottleneck.clone()];
        for (k, up) in self.ups.iter().enumerate() {
            inputs.push(up.forward(weights, &inputs[k]).relu());
        }
        let plane = self.last.forward(weights, inputs.last().expect("the bottleneck"));
        HeadTape { inputs, plane }
    }

    /// Gradient of the bottleneck; adds that of the weights to `sums`.
    pub fn backward(&self, weights: &[f32], tape: &HeadTape, grad: &Map, sums: &mut [f32]) -> Map {
        let top = &tape.inputs[self.ups.len()];
        let mut grad = self.last.backward(weights, top, grad, sums, true).expect("wanted");
        for (k, up) in self.ups.iter().enumerate().rev() {
            grad = up.backward(weights, &tape.inputs[k], &grad.relu_backward(&tape.inputs[k + 1]), sums);
        }
        grad
    }
}
