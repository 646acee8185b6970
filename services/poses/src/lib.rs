//! Camera poses of photos that come without: structure from motion by COLMAP, as a child process.
//!
//! A [`PoseSource`] is a folder of photos or a video. [`PosesFolder::plan`] says whether its poses are there;
//! [`PosesFolder::estimate`] computes them: frames of a video (ffmpeg), features, pairs, model. All of it lies in one folder:
//!
//! ```text
//! poses.json    what the rest was made from, and of each photo without a pose the reason
//! colmap.db     features and pairs; a run that was stopped goes on with those that are missing
//! models/0/     the models that COLMAP made of them; poses.json says which is used
//! snapshots/    what its mapper had when it was stopped
//! frames/       the frames of a video
//! colmap.log    what the programs wrote
//! ```
//!
//! COLMAP and GLOMAP are searched on the `PATH` and nowhere else.
//!
//! It computes no pose by itself, and reads no scene: [`segwild_scene::Scene::open`] reads reconstructions that are there,
//! [`segwild_scene::Scene::open_posed`] the one that this crate leaves.
//!
//! ```
//! use segwild_poses::{PoseSettings, PoseSource, PosesFolder};
//! use segwild_scene::SceneSettings;
//!
//! # let dir = tempfile::tempdir()?;
//! # let photos = dir.path().join("photos");
//! # std::fs::create_dir(&photos)?;
//! # image::RgbImage::new(64, 48).save(photos.join("a.png"))?;
//! // A folder with photos and nothing else.
//! let source = PoseSource::of(&photos, &SceneSettings::default())?.expect("there is a photo");
//! let folder = PosesFolder::at(dir.path().join("poses"));
//! let plan = folder.plan(&source, &PoseSettings::default())?;
//! // `PosesFolder::estimate` does what the plan is about, and the next plan has nothing left.
//! assert!(!plan.is_done());
//! assert_eq!(plan.why, ["the photos have no poses yet"]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Start reading at `folder.rs` (what is to be done), then `estimate.rs` (how).

mod colmap;
mod database;
mod error;
mod estimate;
mod features;
mod folder;
mod mapper;
mod models;
mod pairs;
mod record;
mod settings;
mod snapshots;
mod source;
mod step;
mod video;

pub use colmap::Colmap;
pub use error::PosesError;
pub use folder::{PosePlan, PosesFolder};
pub use mapper::Glomap;
pub use settings::{CameraSharing, PairChoice, PoseMapper, PoseSettings};
pub use source::PoseSource;
pub use step::{PoseLimits, PoseSpan, PoseStep};
pub use video::Ffmpeg;
