//! The networks of the rung `gsw`, in two widths.

use segwild_nn::{Layout, Mlp, Shape, UNet};
use std::sync::OnceLock;

segwild_scene::choice! {
    /// How wide the networks of the look `gsw` are.
    pub enum GswWidth {
        /// Narrow, on a small photo: for machines without an accelerator.
        Cpu = "cpu",
        /// As the GS-W paper has them.
        Paper = "paper",
    }
}

/// Numbers read from one map.
pub const SAMPLE: usize = 16;
/// Maps that are read at a splat's own coordinates; one more is read where the photo shows the splat.
pub const MAPS: usize = 2;
/// Numbers of the light that falls on a splat in a photo: what is read from the maps.
pub const DYNAMIC: usize = SAMPLE * (MAPS + 1);
/// Numbers of what a splat is made of, in every photo.
pub const INTRINSIC: usize = 48;
/// Numbers that say how a splat looks in a photo, from any side: what is kept per look.
pub const VECTOR: usize = 48;
/// Numbers of the colour head before its last layer.
pub const HIDDEN_LAYER: usize = 48;
/// Numbers of the colour head's last layer: `[HIDDEN_LAYER][3]`, then `[3]` offsets.
pub const LAYER: usize = 3 * HIDDEN_LAYER + 3;
/// Planes of what the UNet is given: colours, and whether they are known.
pub const PLANES: usize = 4;
/// Planes that go round the UNet: the same at half the size, and mean and deviation of the colours.
pub const BESIDE: usize = PLANES + 6;

/// The networks of one width; their weights lie in one slice.
pub struct Networks {
    /// Where they lie.
    pub layout: Layout,
    /// Of a photo; its head tells what of it is the scene, and not transients.
    pub unet: UNet,
    /// From a photo to the light on a splat.
    pub light: Mlp,
    /// From light and substance to the vector.
    pub fuse: Mlp,
    /// From vector and direction to what colours are made of.
    pub colour: Mlp,
    /// From that to a colour. Its weights are a slice of their own: photos differ in them.
    pub last: Mlp,
    /// Where the weights of UNet and head end and those of the others begin.
    pub border: usize,
    /// Long side of the photo as the UNet gets it.
    pub side: usize,
    /// Octaves of the position's encoding.
    pub octaves: usize,
}

impl Networks {
    /// Those of a width.
    pub fn of(width: GswWidth) -> &'static Networks {
        static CPU: OnceLock<Networks> = OnceLock::new();
        static PAPER: OnceLock<Networks> = OnceLock::new();
        match width {
            GswWidth::Cpu => CPU.get_or_init(|| {
                let shape = Shape {
                    input: PLANES,
                    stem: 3,
                    encoder: [16, 16, 32, 48, 64],
                    blocks: 1,
                    decoder: [48, 32, 16, 16],
                    beside: BESIDE,
                    output: DYNAMIC,
                    head: [32, 16, 16],
                };
                Networks::new(&shape, &[64, 48], 128, 4)
            }),
            GswWidth::Paper => PAPER.get_or_init(|| {
                let shape = Shape {
                    input: PLANES,
                    stem: 7,
                    encoder: [64, 64, 128, 256, 512],
                    blocks: 2,
                    decoder: [256, 128, 64, 64],
                    beside: BESIDE,
                    output: DYNAMIC,
                    head: [256, 128, 64],
                };
                Networks::new(&shape, &[128, 96, 64, 48], 256, 10)
            }),
        }
    }

    fn new(shape: &Shape, light: &[usize], side: usize, octaves: usize) -> Networks {
        let mut layout = Layout::new();
        let unet = UNet::new(&mut layout, ["unet", "visible"], shape);
        let border = layout.len();
        let encoded = DYNAMIC + INTRINSIC + 3 + 6 * octaves;
        let sizes = [&[encoded], light].concat();
        let last = light[light.len() - 1];
        let light = Mlp::new(&mut layout, "light", &sizes, true);
        let fuse = Mlp::new(&mut layout, "fuse", &[last + INTRINSIC, VECTOR, VECTOR], true);
        let colour = Mlp::new(&mut layout, "colour", &[VECTOR + 3, HIDDEN_LAYER], true);
        let last = Mlp::new(&mut Layout::new(), "last", &[HIDDEN_LAYER, 3], false);
        Networks { layout, unet, light, fuse, colour, last, border, side, octaves }
    }
}
