//! The settings of a selection.

segwild_scene::choice! {
    /// How a mask on a photo decides which splats lie in it.
    pub enum EvidenceMode {
        /// By the share of the splat's visible light that falls in the mask.
        Coverage = "coverage",
        /// By whether the projected centre lies in the mask (the paper; also takes what lies behind it).
        Centre = "centre"
    }
}

segwild_scene::choice! {
    /// Which splats have to resemble the clicks.
    pub enum SimilarityUse {
        /// Every selected splat (the paper).
        Gate = "gate",
        /// Only splats that no mask decides.
        Unseen = "unseen",
        /// Every selected splat, and nothing else decides: masks take no part (Feature 3DGS, SAGA).
        Alone = "alone",
        /// None: features take no part.
        Off = "off"
    }
}

segwild_scene::choice! {
    /// What one photo's mask is worth as evidence on a splat.
    pub enum Vote {
        /// The share of the splat's light that the photo sees: a photo counts once, however large the splat is on it.
        View = "view",
        /// The light itself, in pixels (FlashSplat): close photos count more.
        Light = "light"
    }
}

segwild_scene::choice! {
    /// What becomes of splats that no mask decides.
    pub enum Undecided {
        /// They follow their neighbours, and what resembles the clicks.
        Neighbours = "neighbours",
        /// They are left out (FlashSplat, projection).
        Out = "out"
    }
}

segwild_scene::choice! {
    /// Which connected parts of a selection stay.
    pub enum ComponentRule {
        /// Those that hold a click, and large ones.
        Clicked = "clicked",
        /// All.
        All = "all"
    }
}

segwild_scene::choice! {
    /// How splats that stick out of the mask are cut.
    pub enum SpikeMode {
        /// Shrunk along the direction that sticks out.
        Axis = "axis",
        /// Shrunk in every direction (the paper, Eq. 32).
        Isotropic = "isotropic",
        /// Not cut.
        Off = "off"
    }
}

segwild_scene::choice! {
    /// Whose masks cut spikes.
    pub enum CutBy {
        /// All photos whose own boundaries took part, by majority.
        PhotoRefiner = "photos",
        /// The prompted photos, one after the other (the paper).
        Prompts = "prompts"
    }
}

segwild_scene::choice! {
    /// What the first answer to prompts comes from, before other photos refine it.
    pub enum FirstAnswer {
        /// The scene tree. Several boxes in one photo, and prompts that SAM answers, come from the photo all the same.
        Tree = "tree",
        /// The prompted photo alone (the paper).
        Photo = "photo"
    }
}

segwild_scene::choice! {
    /// Which boundaries the trees are grown from that answer prompts.
    pub enum TreeBoundaries {
        /// Those of the photos, those of the geometry, and both together: the candidates of all trees are pooled.
        All = "all",
        /// Those of the photos alone.
        Photo = "photo",
        /// Those of the geometry alone.
        Geometry = "geometry"
    }
}

segwild_scene::settings! {
    /// How clicks and masks become a selection of splats.
    pub struct SegmentSettings("segment", user: alternative propagate spikes object_appearance) {
        /// What the first answer to prompts comes from.
        first_answer: FirstAnswer = FirstAnswer::Tree,
        /// Boundaries of the trees that answer the first click or a box; further clicks correct the answer by all trees.
        tree_boundaries: TreeBoundaries = TreeBoundaries::All,
        /// Which of the listed alternatives is selected.
        alternative: u32 = 0 => 0..=31,
        /// Least fused cosine similarity to the positive clicks, in [-1, 1] (paper, Eq. 28).
        tau: f32 = 0.5 => -1.0..=1.0,
        /// Temperature of the softmax that fuses several clicks: towards 0 the best click counts, far above 1 their mean; the
        /// paper's formula is 1.
        click_temperature: f32 = 0.1 => 1e-4..=1e4,
        /// With negative clicks: by how much the similarity to the positive ones must be larger.
        negative_margin: f32 = 0.05 => -2.0..=2.0,
        /// Pixels around a click whose features are read with it: 1 reads 3 x 3.
        click_window: u32 = 1 => 0..=64,
        /// Which splats must pass `tau` and `negative_margin`.
        similarity_use: SimilarityUse = SimilarityUse::Unseen,
        /// How masks decide splats.
        evidence_mode: EvidenceMode = EvidenceMode::Coverage,
        /// What one photo's mask is worth in coverage mode.
        vote: Vote = Vote::View,
        /// What becomes of splats that no mask decides.
        undecided: Undecided = Undecided::Neighbours,
        /// Share of a splat's evidence that must lie inside the masks.
        rho: f32 = 0.5 => 0.0..=1.0,
        /// Extra evidence against selecting, in views (in pixels with `vote` = light): larger keeps fewer splats.
        gamma: f32 = 0.0 => -1e4..=1e4,
        /// Least evidence of all views together that decides a splat, in views (in pixels with `vote` = light): what is
        /// known less of follows its neighbours.
        least_evidence: f32 = 0.03 => 0.0..=1e4,
        /// Long side in pixels at which masks are compared with the splats; 0 takes the mask's own size.
        evidence_size: u32 = 480,
        /// Nearest neighbours per splat in the graph that carries labels to unseen splats.
        neighbours: usize = 10 => 1..=256,
        /// Share of a label's weight that survives one step in that graph, in (0, 1).
        spread_decay: f32 = 0.97 => 0.001..=0.999,
        /// Prior probability that a splat belongs to the object when nothing is known of it, in (0, 1).
        unseen_prior: f32 = 0.5 => 0.001..=0.999,
        /// Which connected parts stay.
        components: ComponentRule = ComponentRule::Clicked,
        /// A part without a click stays as well when it holds this share of what the masks saw of the selection, or when most
        /// of its evidence from the other photos lies inside.
        component_share: f32 = 0.05 => 0.0..=1.0,
        /// Smooth the selection by a graph cut over position and colour.
        graph_cut: bool = false,
        /// Rounds in which other photos refine the selection. 0 uses the prompted photos only.
        propagate: u32 = 2 => 0..=16,
        /// Photos that a round visits at most. Where more than 64 could be visited, it visits at most 64, those that add most.
        propagate_views: usize = 80,
        /// Least agreement (IoU) between a photo's refined mask and what is already known, for the mask to count.
        propagate_gate: f32 = 0.6 => 0.0..=1.0,
        /// How much the prompted masks count against those of other photos.
        prompt_weight: f32 = 1.0 => 0.0..=1e4,
        /// How spikes are cut.
        spikes: SpikeMode = SpikeMode::Axis,
        /// Whose masks cut them.
        cut_by: CutBy = CutBy::PhotoRefiner,
        /// Photo whose appearance the exported object has. Empty: the scene's own. It holds for `object.ply` and `labels.ply`.
        object_appearance: String = String::new(),
    }
}
