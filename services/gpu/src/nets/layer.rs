//! The uniform of a layer of a network.

use crate::layer_flags::{NOWHERE, READ_QUARTERS, TURNED, WRITE_QUARTERS};
use bytemuck::{Pod, Zeroable};
use segwild_nn::LayerKind;
use std::ops::Range;

/// `Layer` of `shaders/shared/layer.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct LayerUniform {
    pub reads: u32,
    pub writes: u32,
    pub weights: u32,
    pub offsets: u32,
    pub input: u32,
    pub output: u32,
    pub kernel: u32,
    pub border: u32,
    pub input_size: [u32; 2],
    pub output_size: [u32; 2],
    pub step: u32,
    pub gap: u32,
    pub by_output: u32,
    pub by_input: u32,
    pub other: u32,
    pub flags: u32,
    pub unused: [u32; 2],
}

impl LayerUniform {
    /// An empty layer between maps of such a height and width.
    pub fn of_sizes([in_height, in_width]: [u32; 2], [out_height, out_width]: [u32; 2]) -> LayerUniform {
        LayerUniform {
            input_size: [in_width, in_height],
            output_size: [out_width, out_height],
            kernel: 1,
            step: 1,
            gap: 1,
            other: NOWHERE,
            ..LayerUniform::zeroed()
        }
    }

    pub fn is(&mut self, kind: LayerKind, weights: Range<usize>) {
        let all = |n: usize| n as u32;
        let (input, output, kernel) = match kind {
            LayerKind::Conv { input, output, kernel, stride } => {
                (self.step, self.border) = (all(stride), all(kernel / 2));
                (self.by_output, self.by_input) = (all(input * kernel * kernel), all(kernel * kernel));
                (input, output, kernel)
            }
            LayerKind::Up { input, output } => {
                // Each pixel's four outputs are planes of their own, as many and as wide as the input.
                self.output_size = self.input_size;
                self.flags |= WRITE_QUARTERS;
                (self.by_output, self.by_input) = (all(input), 1);
                (input, 4 * output, 1)
            }
            // The kernel's field holds a group's planes.
            LayerKind::Norm { channels, groups } => (channels, channels, channels / groups),
            LayerKind::Dense { input, output } => {
                (self.by_output, self.by_input) = (1, all(output));
                (input, output, 1)
            }
        };
        (self.input, self.output, self.kernel) = (all(input), all(output), all(kernel));
        let offsets = match kind {
            LayerKind::Conv { output, .. }
            | LayerKind::Up { output, .. }
            | LayerKind::Dense { output, .. } => output,
            LayerKind::Norm { channels, .. } => channels,
        };
        (self.weights, self.offsets) = (all(weights.start), all(weights.end - offsets));
    }

    pub fn groups(&self) -> usize {
        (self.input / self.kernel) as usize
    }

    pub fn columns(&self) -> usize {
        self.output_size.iter().map(|&n| n as usize).product()
    }

    /// The backward pass of a convolution or dense layer, from the gradients of its output to those of its input.
    pub fn back(&self, flags: u32) -> LayerUniform {
        let quarters = if self.flags & WRITE_QUARTERS != 0 { READ_QUARTERS } else { 0 };
        LayerUniform {
            reads: self.writes,
            writes: self.reads,
            offsets: NOWHERE,
            input: self.output,
            output: self.input,
            border: self.kernel - 1 - self.border,
            input_size: self.output_size,
            output_size: self.input_size,
            step: 1,
            gap: self.step,
            by_output: self.by_input,
            by_input: self.by_output,
            flags: flags | quarters | TURNED,
            ..*self
        }
    }
}
