//! Settings of the stage `poses`.

use segwild_scene::{choice, settings};

choice! {
    /// Which pairs of photos are compared.
    pub enum PairChoice {
        /// `exhaustive` up to 100 photos; of more, `sequential` for the frames of a video, else `nearest`.
        Auto = "auto",
        /// Every pair.
        Exhaustive = "exhaustive",
        /// Each photo with the 50 most similar to it, by a vocabulary tree of the photos themselves.
        Nearest = "nearest",
        /// Each photo with those that follow it by name, and with the most similar of the others.
        Sequential = "sequential",
    }
}

choice! {
    /// Which photos share the parameters of one lens.
    pub enum CameraSharing {
        /// Those of one camera at one focal length and size, as EXIF data say; all frames of a video.
        Auto = "auto",
        /// All of them.
        One = "one",
        /// None.
        Each = "each",
    }
}

choice! {
    /// Which program computes poses and points of the pairs.
    pub enum PoseMapper {
        /// `glomap` for more than 300 photos where it is found, else `colmap`.
        Auto = "auto",
        /// COLMAP's mapper, photo by photo.
        Colmap = "colmap",
        /// GLOMAP, all photos at once: `global_mapper` of a COLMAP that has it, else the program `glomap`.
        Glomap = "glomap",
    }
}

settings! {
    /// How the poses are computed of photos that come without, or of a video. COLMAP does it.
    pub struct PoseSettings("poses") {
        /// Which pairs of photos are compared.
        pair_choice: PairChoice = PairChoice::Auto,
        /// Which photos share one lens.
        camera_sharing: CameraSharing = CameraSharing::Auto,
        /// Which program computes poses and points of the pairs.
        mapper: PoseMapper = PoseMapper::Auto,
        /// Long side in pixels to which photos are scaled down for finding features; less where memory is short.
        pose_photo_size: u32 = 3200 => 320..=16_384,
        /// Most photos that are taken out of a video: the sharpest, spread evenly over the motion.
        video_frames: u32 = 150 => 3..=2_000,
    }
}
