//! The networks of the appearance model `gsw`, in two widths.

use segwild_nn::{Mlp, UNet, UNetShape, WeightLayout};
use std::sync::OnceLock;

segwild_scene::choice! {
    /// Width of the networks of the appearance model `gsw`.
    pub enum GswWidth {
        /// Narrow, on a small photo: for machines without an accelerator.
        Cpu = "cpu",
        /// As in the GS-W paper.
        Paper = "paper",
    }
}

/// Numbers sampled from one map.
pub const SAMPLE: usize = 16;
/// Maps that are sampled at a splat's own coordinates; one more is sampled where the splat projects into the photo.
pub const MAPS: usize = 2;
/// Length of the dynamic appearance feature of a splat in a photo: the numbers sampled from all maps.
pub const DYNAMIC: usize = SAMPLE * (MAPS + 1);
/// Length of the intrinsic feature of a splat, the same in every photo.
pub const INTRINSIC: usize = 48;
/// Length of the vector of a splat in a photo, before the viewing direction.
pub const VECTOR: usize = 48;
/// Width of the colour head before its last layer.
pub const HIDDEN_LAYER: usize = 48;
/// Weights of the colour head's last layer: `[HIDDEN_LAYER][3]`, then `[3]` offsets.
pub const LAYER: usize = 3 * HIDDEN_LAYER + 3;
/// Input planes of the UNet: colours, and whether they are known.
pub const PLANES: usize = 4;
/// Planes that bypass the UNet: the same at half the size, and mean and deviation of the colours.
pub const BESIDE: usize = PLANES + 6;

/// The networks of one width; their weights lie in one slice.
pub struct Networks {
    /// Ranges of their weights.
    pub layout: WeightLayout,
    /// From a photo to maps; its head predicts visibility: scene or transient.
    pub unet: UNet,
    /// From samples and position to the dynamic feature of a splat.
    pub light: Mlp,
    /// From dynamic and intrinsic feature to the vector.
    pub fuse: Mlp,
    /// From vector and direction to the colour head's hidden layer.
    pub colour: Mlp,
    /// From the hidden layer to a colour. Its weights are a slice of their own, since they are fitted per photo.
    pub last: Mlp,
    /// Where the weights of UNet and head end and those of the others start.
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
                let shape = UNetShape {
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
                let shape = UNetShape {
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

    fn new(shape: &UNetShape, light: &[usize], side: usize, octaves: usize) -> Networks {
        let mut layout = WeightLayout::new();
        let unet = UNet::new(&mut layout, ["unet", "visible"], shape);
        let border = layout.len();
        let encoded = DYNAMIC + INTRINSIC + 3 + 6 * octaves;
        let sizes = [&[encoded], light].concat();
        let last = light[light.len() - 1];
        let light = Mlp::new(&mut layout, "light", &sizes, true);
        let fuse = Mlp::new(&mut layout, "fuse", &[last + INTRINSIC, VECTOR, VECTOR], true);
        let colour = Mlp::new(&mut layout, "colour", &[VECTOR + 3, HIDDEN_LAYER], true);
        let last = Mlp::new(&mut WeightLayout::new(), "last", &[HIDDEN_LAYER, 3], false);
        Networks { layout, unet, light, fuse, colour, last, border, side, octaves }
    }
}
