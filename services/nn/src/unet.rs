//! A UNet: a residual encoder to 1/32 of the size, a decoder back to 1/2, and a head on the bottleneck.

use crate::conv::{Conv, Up};
use crate::graph::{Form, Id, NetworkGraph, Tape};
use crate::layer::WeightLayout;
use crate::map::Map;
use crate::norm::GroupNorm;

/// How wide a UNet is. All numbers of planes are multiples of 8.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UNetShape {
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
    /// Input planes at 1/2 of the size that join the decoder's before the last layer (which is linear).
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

/// The network, without its weights.
#[derive(Clone, Debug)]
pub struct UNet {
    /// Its maps and operations.
    pub graph: NetworkGraph,
    /// The result, at 1/2 of the image's size.
    pub maps: Id,
    /// Output of the head on the bottleneck: one plane at 1/4 of the image's size.
    pub plane: Id,
}

/// A network in the making.
struct UNetBuilder<'a> {
    graph: NetworkGraph,
    layout: &'a mut WeightLayout,
}

impl UNetBuilder<'_> {
    /// A convolution and its norm.
    fn double(
        &mut self,
        name: &str,
        from: Id,
        output: usize,
        (kernel, stride): (usize, usize),
        relu: bool,
    ) -> Id {
        let input = self.graph.forms()[from].channels;
        let conv = Conv::new(self.layout, name, [input, output], kernel, stride);
        let groups = output.div_ceil(GROUP);
        let norm = GroupNorm::new(self.layout, &format!("{name}.norm"), output, groups);
        let made = self.graph.conv(conv, from, false);
        self.graph.norm(norm, made, relu)
    }

    /// A residual block: two convolutions and a skip connection.
    fn block(&mut self, name: &str, from: Id, output: usize, stride: usize) -> Id {
        let input = self.graph.forms()[from].channels;
        let middle = self.double(&format!("{name}.first"), from, output, (3, stride), true);
        let made = self.double(&format!("{name}.second"), middle, output, (3, 1), false);
        let round = match input != output || stride != 1 {
            true => self.double(&format!("{name}.round"), from, output, (1, stride), false),
            false => from,
        };
        self.graph.sum([made, round], true)
    }

    /// A step of the decoder: twice the size, joined by what the encoder had there.
    fn step(&mut self, name: &str, from: Id, skip: Id, output: usize) -> Id {
        let raised = self.raise(&format!("{name}.up"), from, output, false);
        let joined = self.graph.concat([raised, skip]);
        let middle = self.double(&format!("{name}.first"), joined, output, (3, 1), true);
        self.double(&format!("{name}.second"), middle, output, (3, 1), true)
    }

    fn raise(&mut self, name: &str, from: Id, output: usize, relu: bool) -> Id {
        let up = Up::new(self.layout, name, [self.graph.forms()[from].channels, output]);
        self.graph.up(up, from, relu)
    }
}

impl UNet {
    /// Describes a network of this shape, and its head, under these names.
    pub fn new(layout: &mut WeightLayout, [name, head]: [&str; 2], shape: &UNetShape) -> UNet {
        let given = [Form { channels: shape.input, halved: 0 }, Form { channels: shape.beside, halved: 1 }];
        let [image, beside] = [0, 1];
        let mut plan = UNetBuilder { graph: NetworkGraph::given(&given), layout };
        // No norm after the first convolution: it is where the light of a photo enters, and a norm would take it away.
        let planes = [shape.input, shape.encoder[0]];
        let stem = Conv::new(plan.layout, &format!("{name}.stem"), planes, shape.stem, 2);
        let mut at = plan.graph.conv(stem, image, true);
        let mut sizes = vec![at];
        for s in 1..5 {
            for b in 0..shape.blocks.max(1) {
                let name = format!("{name}.encoder{s}.{b}");
                at = plan.block(&name, at, shape.encoder[s], if b == 0 { 2 } else { 1 });
            }
            sizes.push(at);
        }
        let bottleneck = at;
        for (k, &output) in shape.decoder.iter().enumerate() {
            at = plan.step(&format!("{name}.decoder{k}"), at, sizes[3 - k], output);
        }
        let joined = plan.graph.concat([at, beside]);
        let planes = [shape.decoder[3] + shape.beside, shape.output];
        let last = Conv::new(plan.layout, &format!("{name}.maps"), planes, 1, 1);
        let maps = plan.graph.conv(last, joined, false);
        let mut at = bottleneck;
        for (k, &output) in shape.head.iter().enumerate() {
            at = plan.raise(&format!("{head}.up{k}"), at, output, true);
        }
        let last = Conv::new(plan.layout, &format!("{head}.last"), [shape.head[2], 1], 1, 1);
        let plane = plan.graph.conv(last, at, false);
        UNet { graph: plan.graph, maps, plane }
    }

    /// Runs an image; `beside` are the planes that join before the last layer.
    ///
    /// # Panics
    /// If the image's sides are not multiples of 32.
    pub fn forward(&self, weights: &[f32], image: Map, beside: Map) -> Tape {
        assert!(image.width.is_multiple_of(GRAIN) && image.height.is_multiple_of(GRAIN), "sides");
        self.graph.forward(weights, vec![image, beside])
    }

    /// Adds the gradient of the weights to `sums`, from those of the maps and, if there is one, of the head's plane.
    pub fn backward(&self, weights: &[f32], tape: &Tape, maps: Map, plane: Option<Map>, sums: &mut [f32]) {
        let plane = plane.map(|plane| (self.plane, plane));
        self.graph.backward(weights, tape, plane.into_iter().chain([(self.maps, maps)]).collect(), sums);
    }
}
