//! The vocabulary of segwild, and the readers and writers of scene files.
//!
//! The types that all other crates share are defined here: a [`View`] is one posed photo, a [`Camera`] its
//! intrinsics, [`Splats`] the Gaussians, a [`Mask`] a set of pixels, [`Prompts`] a person's clicks and boxes.
//! No async, no GPU.
//!
//! # Conventions (docs/method.md, section 0)
//! Camera frame: x right, y down, z forward; `x_cam = R x + t`; the centre of pixel (0, 0) is (0.5, 0.5).
//! Quaternions are (w, x, y, z). A loaded scene is normalised (see [`Scene::frame`]): the cameras' mean is the
//! origin and the scene extent is 1, so nothing depends on the units of the reconstruction.
//!
//! It holds no algorithm of training or selection, and decides nothing: it says what files mean.
//!
//! ```
//! use glam::Vec3;
//! use segwild_scene::{Camera, Mask, Pose};
//!
//! let camera = Camera { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 };
//! // A photo is seen at the size that a stage works at.
//! assert_eq!(camera.scaled_to(32).width, 32);
//! let pose = Pose::look_at(Vec3::ZERO, Vec3::Z, Vec3::NEG_Y);
//! assert!((pose.to_camera(Vec3::new(0.0, 0.0, 2.0)).z - 2.0).abs() < 1e-6);
//! let left = Mask::from_fn(64, 48, |x, _| x < 32);
//! assert_eq!(left.count(), 32 * 48);
//! ```
//!
//! Start reading at `view.rs` (what a photo is), then `open.rs` (how a scene is read).

mod alpha;
mod bytes;
mod camera;
pub mod colmap;
mod colourless;
mod decode;
mod digest;
mod draft;
mod embedding;
mod endings;
mod error;
mod export;
mod frame;
pub mod half;
mod half_rows;
mod image;
mod import;
mod keep_masks;
pub mod knn;
pub mod lens;
mod locate;
mod logistic;
mod mask;
mod mask_files;
mod mask_image;
mod morphology;
mod names;
mod naming;
mod open;
mod orientation;
mod packed_photo;
mod photo;
mod photo_files;
mod photo_store;
mod pieces;
mod pixel_bits;
pub mod ply;
mod posed;
mod prompt;
mod random;
mod regions;
mod scene_frame;
mod seal;
pub mod settings;
mod similarity;
mod splats;
mod split;
pub mod statistics;
mod taken;
pub mod text;
mod transforms;
mod transforms_json;
mod unposed;
mod view;
pub mod view_selection;
mod wall_time;
mod whole;
mod window;

pub use camera::{Camera, Pose};
pub use colourless::DARKEST;
pub use decode::{DecodeError, ExifCamera, limit_decoding, open_file};
pub use digest::{file_digest, hash_file};
pub use embedding::Embedding;
pub use error::{PhotoError, ReaderError, SceneError};
pub use export::{Export, SplatFormat};
pub use half_rows::HalfRows;
pub use image::{Image, write_rgba};
pub use import::{
    ImportedSplats, RENDERED_VIEWS, ReadSplats, RenderedViews, SplatFile, SplatLayout, SplatWriter, UpAxis,
};
pub use logistic::{logit, sigmoid};
pub use mask::{Mask, MaskSet, ScoredMask};
pub use mask_files::{MaskFileError, MaskFiles};
pub use naming::{few_of_photos, first_named, named_and_counted};
pub use packed_photo::{PackedPhoto, PhotoCache};
pub use photo::{LoadedPhoto, load_photo};
pub use photo_store::PhotoStore;
pub use pieces::{TASK_PIXELS, in_pieces, per_piece, per_pixel};
pub use posed::PosedPhotos;
pub use prompt::{BoxPrompt, PointPrompt, Prompts};
pub use random::{Random, split_mix};
pub use scene_frame::SceneFrame;
pub use seal::Seal;
pub use similarity::Similarity;
pub use splats::Splats;
pub use unposed::{UnposedPhoto, UnposedPhotos};
pub use view::{Observation, Photo, Point, Reading, Scene, Skipped, View};
pub use wall_time::WallTime;
pub use window::box_mean;

/// Near plane: nothing nearer to the camera is rendered. In units of the scene extent (docs/method.md, section 0).
pub const NEAR: f32 = 0.01;

choice! {
    /// What the transparent part of a photo says.
    pub enum Alpha {
        /// `empty` where most photos are cut-outs, else `ignore`.
        Auto = "auto",
        /// Nothing: it is left out.
        Ignore = "ignore",
        /// Nothing of the scene stands there, as in cut-outs of an object.
        Empty = "empty",
    }
}

/// Which photos are held out of the training, to be scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HoldOut {
    /// Those of the split; without one, a few.
    Auto,
    /// Those of the split.
    None,
    /// Every n-th photo by name, whatever the split says.
    Every(u32),
}

impl settings::Value for HoldOut {
    const KIND: &'static str = "N|WORD";
    fn read(text: &str) -> Result<Self, settings::ValueError> {
        match text {
            "auto" => Ok(HoldOut::Auto),
            "none" | "0" => Ok(HoldOut::None),
            _ => text
                .parse()
                .map(HoldOut::Every)
                .map_err(|_| settings::ValueError::Kind("a whole number, auto or none")),
        }
    }
}

impl std::fmt::Display for HoldOut {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        match self {
            HoldOut::Auto => f.write_str("auto"),
            HoldOut::None => f.write_str("none"),
            HoldOut::Every(n) => n.fmt(f),
        }
    }
}

impl serde::Serialize for HoldOut {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            HoldOut::Every(n) => serializer.serialize_u32(*n),
            word => serializer.collect_str(word),
        }
    }
}

impl<'de> serde::Deserialize<'de> for HoldOut {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Visitor;
        impl serde::de::Visitor<'_> for Visitor {
            type Value = HoldOut;
            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.write_str("a whole number, auto or none")
            }
            fn visit_i64<E: serde::de::Error>(self, n: i64) -> Result<HoldOut, E> {
                self.visit_str(&n.to_string())
            }
            fn visit_u64<E: serde::de::Error>(self, n: u64) -> Result<HoldOut, E> {
                self.visit_str(&n.to_string())
            }
            fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<HoldOut, E> {
                settings::Value::read(text).map_err(E::custom)
            }
        }
        deserializer.deserialize_any(Visitor)
    }
}

settings! {
    /// Where the photos and the reconstruction of a scene are, and how they are read.
    pub struct SceneSettings("scene", user: images ignore transient_masks hold_out size) {
        /// Folder of the photos. Empty: found automatically.
        images: String = String::new(),
        /// Folder of masks of what to ignore; white is ignored. Each is named as its photo (a/b.png or a/b.jpg.png for
        /// a/b.jpg). Empty: none.
        ignore: String = String::new(),
        /// Folder of masks of what to keep; white is kept. Named as for `ignore`. Empty: the scene's own folder
        /// `masks`, if there is one; none: no masks.
        keep_masks: String = String::new(),
        /// Folder of transient masks corrected by hand; white is transient. Named as for `ignore`. In these photos only the
        /// white pixels are left out. Empty: those changed in the run's own folder `transients`.
        transient_masks: String = String::new(),
        /// File that says which photos are held out. A table of Photo Tourism (.tsv), a split.json, or a list
        /// (test_list.txt). Empty: found automatically in the scene's folder; none: no split.
        split: String = String::new(),
        /// Hold out every n-th photo by name, from the first on. `auto`: as the split says; where there is none, one of 16 photos
        /// of a scene of 16 and more, so that there are scores of photos that were not trained on. `none`: as the split says, or
        /// none.
        hold_out: HoldOut = HoldOut::Auto,
        /// Long side in pixels to which photos are scaled down.
        size: u32 = 640 => 16..=16_384,
        /// What the transparent part of a photo says.
        alpha: Alpha = Alpha::Auto,
        /// File of splats that another program trained from these photos. They are kept as they are, in place of a training;
        /// `segwild import` sets it. Empty: none.
        imported_splats: String = String::new(),
        /// How the world of imported splats lies in that of the poses. `auto`: found by comparing them with points and photos.
        /// `poses`: it is that of the poses, however little the splats show of the photos. Otherwise the path of nerfstudio's
        /// dataparser_transforms.json.
        imported_frame: String = "auto".to_owned(),
        /// Most megapixels that a photo or mask may have; a file that claims more is left out before it is decoded.
        max_megapixels: u32 = 200 => 1..=4_300,
    }
}
