//! The kernels' sources: files of `shaders/`, embedded in the program, with their imports resolved.

use crate::groups::DEPTH_BITS;
use crate::layer_flags::CONSTANTS;
use segwild_objective::compare::{self, PhotoTarget};
use segwild_objective::{background, field, gsw, transients};
use segwild_raster::{ALPHA_MAX, ALPHA_MIN, LOG2_ALPHA_MIN, SLACK, T_MIN};

/// A kernel: a file of `shaders/`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Kernel {
    /// Name of the file.
    pub name: &'static str,
    /// Name of the function in it.
    pub entry: &'static str,
    /// The numbers of vec4 of channels it is built for: one program each.
    pub blocks: &'static [u32],
    text: &'static str,
}

macro_rules! kernels {
    ($($constant:ident = $name:literal . $entry:literal, $blocks:expr;)*) => {
        $(
            #[doc = concat!("`shaders/", $name, ".wgsl`.")]
            pub(crate) const $constant: Kernel = Kernel {
                name: $name,
                entry: $entry,
                blocks: &$blocks,
                text: include_str!(concat!("../../../shaders/", $name, ".wgsl")),
            };
        )*
        /// All kernels.
        pub const KERNELS: &[Kernel] = &[$($constant),*];
    };
}

kernels! {
    PROJECT = "project"."project", [1];
    HISTOGRAM = "histogram"."histogram", [1];
    SCAN = "scan"."scan", [1];
    SCAN_ADD = "scan_add"."scan_add", [1];
    SCATTER = "scatter"."scatter", [1];
    SORTED_TILE_COUNTS = "sorted_tile_counts"."sorted_tile_counts", [1];
    EMIT = "emit"."emit", [1];
    RANGES = "ranges"."ranges", [1];
    BUCKET_COUNT = "bucket_count"."bucket_count", [1];
    BUCKETS = "buckets"."buckets_of", [1];
    BLEND = "blend"."blend", [1, 4];
    GATHER = "gather"."gather", [1, 2];
    SUM_SLOTS = "sum_slots"."sum_slots", [1];
    BUCKET_STATES = "bucket_states"."bucket_states", [0, 1, 2];
    BACKWARD = "backward"."backward", [0, 1, 2];
    PROJECT_BACKWARD = "project_backward"."project_backward", [1];
    SHADE = "shade"."shade", [1];
    SHADE_BACKWARD = "shade_backward"."shade_backward", [1];
    TINT = "tint"."tint", [1];
    TINT_BACKWARD = "tint_backward"."tint_backward", [1];
    OBSERVE = "observe"."observe", [1];
    ADAM = "adam"."adam", [1];
    SELECT = "select"."select_items", [1];
    COMPOSE = "compose"."compose", [1];
    BOX_MEAN = "box_mean"."box_mean", [1];
    RESIDUAL_HISTOGRAM = "residual_histogram"."residual_histogram", [1];
    RESIDUAL_LIMITS = "residual_limits"."residual_limits", [1];
    PIXEL_WEIGHTS = "pixel_weights"."pixel_weights", [1];
    SSIM = "ssim"."ssim", [1];
    L1_SSIM_BACKWARD = "l1_ssim_backward"."l1_ssim_backward", [1];
    COMPOSE_BACKWARD = "compose_backward"."compose_backward", [1];
    SKY_SUMS = "sky_sums"."sky_sums", [1];
    COLOUR_SUMS = "colour_sums"."colour_sums", [1];
    SUM_GROUPS = "sum_groups"."sum_groups", [1];
    CONVOLVE = "convolve"."convolve", [1];
    CONVOLVE_WEIGHTS = "convolve_weights"."convolve_weights", [1];
    SUM_WEIGHTS = "sum_weights"."sum_weights", [1];
    NORM = "norm"."norm", [1];
    NORM_BACKWARD = "norm_backward"."norm_backward", [1];
    ADD_MAPS = "add_maps"."add_maps", [1];
    RELU_BACKWARD = "relu_backward"."relu_backward", [1];
    IN_SIGHT = "in_sight"."in_sight", [1];
    COMPACT_IN_SIGHT = "compact_in_sight"."compact_in_sight", [1];
    GSW_INPUTS = "gsw_inputs"."gsw_inputs", [1];
    GSW_INPUTS_BACKWARD = "gsw_inputs_backward"."gsw_inputs_backward", [1];
    MAP_SUMS = "map_sums"."map_sums", [1];
    GSW_COLOURS = "gsw_colours"."gsw_colours", [1];
    GSW_COLOURS_BACKWARD = "gsw_colours_backward"."gsw_colours_backward", [1];
    PART_RESIDUALS = "part_residuals"."part_residuals", [1];
    VISIBILITY_GRADIENT = "visibility_gradient"."visibility_gradient", [1];
    VISIBILITY_WEIGHTS = "visibility_weights"."visibility_weights", [1];
    CHOOSE_WEIGHTS = "choose_weights"."choose_weights", [1];
    AREA_AVERAGE = "area_average"."area_average", [1, 4];
    AREA_SPREAD = "area_spread"."area_spread", [1, 2];
    EMBEDDING_LOSS = "embedding_loss"."embedding_loss", [1];
    SAMPLED_FEATURES = "sampled_features"."sampled_features", [1, 4];
    UNIT_FEATURES = "unit_features"."unit_features", [1];
    MASK_PAIR_COUNTS = "mask_pair_counts"."mask_pair_counts", [1];
    COMPACTNESS_LOSS = "compactness_loss"."compactness_loss", [1];
    UNIT_FEATURES_BACKWARD = "unit_features_backward"."unit_features_backward", [1];
    SAMPLED_FEATURES_BACKWARD = "sampled_features_backward"."sampled_features_backward", [1, 2];
    COSINES = "cosines"."cosines", [1, 4];
    FUSE = "fuse"."fuse", [1];
    ROW_STATE = "row_state"."row_state", [1];
    ROW_STEP = "row_step"."row_step", [1];
    ROW_ADD = "row_add"."row_add", [1];
    MULTIPLY_ADD = "multiply_add"."multiply_add", [1];
}

/// Constants of the losses (`objective/src/compare.rs`).
const COMPARED: [(&str, f32); 12] = [
    ("DECAY", transients::DECAY),
    ("FLOOR", transients::FLOOR),
    ("INITIAL_TRANSIENT_SHARE", transients::INITIAL_TRANSIENT),
    ("CONTRAST", transients::CONTRAST),
    ("SURPRISE", transients::SURPRISE),
    ("LEAST_OPEN", compare::LEAST_OPEN),
    ("LEAST_SEEN", background::LEAST_SEEN),
    ("SURE", transients::SURE),
    ("OCCLUDED", transients::OCCLUDED),
    ("MOST", transients::MOST),
    ("LEAST", transients::LEAST),
    ("WRONG", transients::WRONG),
];
/// Constants of the appearance model `gsw` (`objective/src/appearance/gsw/`), of its networks, and of the feature field
/// (`objective/src/field/`).
const LIT: [(&str, f32); 8] = [
    ("COORDINATE", gsw::COORDINATE),
    ("DROPPED", gsw::DROPPED),
    ("VISIBILITY", gsw::VISIBILITY),
    ("EPSILON", segwild_nn::EPSILON as f32),
    ("BETA1", field::BETA1),
    ("BETA2", field::BETA2),
    ("ROOT", field::EPSILON),
    ("SHORTEST", field::SHORTEST),
];
const LIGHT: [(&str, u32); 6] = [
    ("NO_MASK", field::Membership::NONE),
    ("SAMPLE", gsw::SAMPLE as u32),
    ("MAPS", gsw::MAPS as u32),
    ("INTRINSIC", gsw::INTRINSIC as u32),
    ("VECTOR", gsw::VECTOR as u32),
    ("EMBEDDING_SIZE", gsw::EMBEDDING_SIZE as u32),
];
const COUNTED: [(&str, u32); 7] = [
    ("DEPTH_BITS", DEPTH_BITS),
    ("BINS", transients::BINS as u32),
    ("STRIDE", background::STRIDE as u32),
    ("COUNTS", PhotoTarget::COUNTS as u32),
    ("SKY", PhotoTarget::SKY as u32),
    ("INNER", PhotoTarget::INNER as u32),
    ("INITIAL_TRANSIENT", PhotoTarget::INITIAL_TRANSIENT as u32),
];

/// Files of `#import name`.
const SHARED: &[(&str, &str)] = &[
    ("common", include_str!("../../../shaders/shared/common.wgsl")),
    ("view", include_str!("../../../shaders/shared/view.wgsl")),
    ("footprint", include_str!("../../../shaders/shared/footprint.wgsl")),
    ("cover", include_str!("../../../shaders/shared/cover.wgsl")),
    ("path", include_str!("../../../shaders/shared/path.wgsl")),
    ("harmonics", include_str!("../../../shaders/shared/harmonics.wgsl")),
    ("light", include_str!("../../../shaders/shared/light.wgsl")),
    ("loss_inputs", include_str!("../../../shaders/shared/loss_inputs.wgsl")),
    ("background", include_str!("../../../shaders/shared/background.wgsl")),
    ("bins", include_str!("../../../shaders/shared/bins.wgsl")),
    ("window", include_str!("../../../shaders/shared/window.wgsl")),
    ("sum", include_str!("../../../shaders/shared/sum.wgsl")),
    ("running", include_str!("../../../shaders/shared/running.wgsl")),
    ("weight_grad", include_str!("../../../shaders/shared/weight_grad.wgsl")),
    ("cells", include_str!("../../../shaders/shared/cells.wgsl")),
    ("masks", include_str!("../../../shaders/shared/masks.wgsl")),
    ("layer", include_str!("../../../shaders/shared/layer.wgsl")),
    ("reader", include_str!("../../../shaders/shared/reader.wgsl")),
];

/// Variants of these files for devices with subgroups.
const BY_SUBGROUPS: &[(&str, &str)] =
    &[("running", include_str!("../../../shaders/shared/running_subgroups.wgsl"))];

/// The whole text of a kernel for so many vec4 of channels: the constants of its twin, then the file with its imports,
/// some of which have a variant for a device with `subgroups`.
///
/// # Panics
/// If the file imports what is not in `shaders/shared/`; a test builds every kernel.
pub fn source(kernel: &Kernel, blocks: u32, subgroups: bool) -> String {
    let mut text = format!(
        "const ALPHA_MIN: f32 = {ALPHA_MIN:e}f;\nconst ALPHA_MAX: f32 = {ALPHA_MAX:e}f;\n\
         const T_MIN: f32 = {T_MIN:e}f;\nconst LOG2_ALPHA_MIN: f32 = {LOG2_ALPHA_MIN:e}f;\n\
         const SLACK: f32 = {SLACK:e}f;\nconst BLOCKS: u32 = {blocks}u;\n"
    );
    for (name, value) in COMPARED.into_iter().chain(LIT) {
        text.push_str(&format!("const {name}: f32 = {value:e}f;\n"));
    }
    for (name, value) in COUNTED.into_iter().chain(LIGHT).chain(CONSTANTS) {
        text.push_str(&format!("const {name}: u32 = {value}u;\n"));
    }
    for line in kernel.text.lines() {
        let Some(name) = line.strip_prefix("#import ") else {
            text.push_str(line);
            text.push('\n');
            continue;
        };
        let rather = if subgroups { BY_SUBGROUPS } else { &[] };
        let part = rather.iter().chain(SHARED).find(|(known, _)| *known == name.trim());
        text.push_str(part.unwrap_or_else(|| panic!("{}.wgsl imports {name}", kernel.name)).1);
    }
    text
}
