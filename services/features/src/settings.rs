//! The settings of the feature field.

segwild_scene::choice! {
    /// How embeddings become the few channels of the field.
    pub enum Compression {
        /// Principal components: deterministic, fitted once.
        Pca = "pca",
        /// A linear decoder trained along with the field; starts at the principal components.
        Learned = "learned",
    }
}

segwild_scene::settings! {
    /// The feature field: one vector per splat that distinguishes the parts of the scene.
    pub struct FeatureSettings("features") {
        /// Numbers per splat. 16, 32, 64 or 128 are usual; never more than the embedding has.
        channels: u32 = 64 => 1..=256,
        /// How embeddings become that few numbers.
        compression: Compression = Compression::Pca,
        /// Share of the embedding's variance worth keeping: fewer channels serve if they keep it. 1 takes all.
        keep_variance: f32 = 1.0 => 0.0..=1.0,
        /// Cells of all photos together that the principal components are fitted on (at most 200000).
        pca_samples: u32 = 50_000 => 1..=200_000,
        /// Long side in pixels at which features are rendered. Larger is sharper at the borders and slower.
        feature_size: u32 = 128 => 16..=4096,
        /// Steps that refine the lifted features, one photo each; 0 keeps them as lifted.
        refine_steps: u32 = 60,
        /// Pixels compared with one another in a step.
        pixels_per_step: u32 = 1024 => 2..=65_536,
        /// Weight of the embedding loss.
        weight_embedding: f32 = 0.7 => 0.0..=100.0,
        /// Weight of the compactness loss.
        weight_compact: f32 = 0.3 => 0.0..=100.0,
        /// Pull features of one mask together and push those of different masks apart.
        compactness: bool = true,
        /// Learning rate of the features.
        feature_lr: f32 = 1e-3 => 0.0..=10.0,
        /// Learning rate of the learned decoder.
        decoder_lr: f32 = 1e-4 => 0.0..=10.0,
        /// Seed of everything that is sampled here.
        feature_seed: u64 = 0,
        /// Memory in MiB for projections and targets kept between steps; what does not fit is computed again.
        feature_memory: u32 = 512,
    }
}
