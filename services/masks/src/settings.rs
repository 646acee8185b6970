//! The settings of automatic masks.

segwild_scene::choice! {
    /// The image that masks are made from.
    pub enum MaskSource {
        /// The scene rendered from the photo's camera: no transients, one light.
        Render = "render",
        /// The photo itself.
        Photo = "photo",
    }
}

segwild_scene::settings! {
    /// Automatic masks: where to prompt (SASM) and which answers to keep.
    pub struct MaskSettings("masks") {
        /// Place prompts by the scene's depth (SASM). Off: a uniform grid with the same budget.
        sasm: bool = true,
        /// Most prompts per photo. More finds smaller parts and takes longer.
        prompt_budget: u32 = 256 => 1..=65_536,
        /// Most prompts along one side of a cell of the prompt grid.
        max_points_per_cell: u32 = 20 => 1..=100,
        /// Let the sky lower the number of prompts where it is seen, and count as one region.
        sky_prompts: bool = true,
        /// Image that masks are made from.
        mask_source: MaskSource = MaskSource::Render,
        /// Prompts handed to the mask provider at once; bounds memory, not quality.
        prompt_batch: u32 = 256 => 1..,
        /// Keep masks whose predicted IoU is at least this.
        min_predicted_iou: f32 = 0.88 => 0.0..=1.0,
        /// Keep masks at least this stable when their threshold moves.
        min_stability: f32 = 0.95 => 0.0..=1.0,
        /// Where fewer masks than this are stable enough, the most stable of the others fill up: what counts as
        /// stable differs from one mask provider to the next. 0 never fills up.
        min_masks: u32 = 24,
        /// Of two masks whose IoU is over this, keep the better one.
        mask_nms: f32 = 0.7 => 0.0..=1.0,
        /// Remove islands and holes smaller than this share of the photo, and masks that are smaller.
        min_mask_area: f32 = 0.0005 => 0.0..=1.0,
    }
}
