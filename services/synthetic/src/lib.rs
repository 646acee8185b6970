//! The synthetic wild set: a scene that is sampled from a seed, photographed by tourists in all weathers, with everything
//! known exactly (method, section 11): masks of objects and parts, transients, depth, light, points.
//!
//! The photos come from a ray tracer of its own, never from the rasteriser that learns from them. This crate makes and
//! writes scenes and knows nothing of training, masks or scores: `segwild-eval` puts scenes through the program.
//!
//! Start reading at `plan.rs`: `layout.rs` builds the world, `cameras.rs` chooses the views, `points.rs` samples the points,
//! `trace.rs` takes the photos, one by one. `write.rs` has the files. `generate.rs` keeps all photos in memory.
//!
//! ```
//! use segwild_synthetic::{SyntheticOptions, generate};
//!
//! let options = SyntheticOptions { train: 3, test: 1, long_side: 48, points: 50, ..SyntheticOptions::small() };
//! let scene = generate(&options).unwrap();
//! assert_eq!(scene.photos.iter().filter(|p| p.test).count(), 1);
//! let dome = scene.instance_named("dome").unwrap();
//! assert_eq!(scene.instances[usize::from(dome)].name, "dome");
//!
//! let folder = tempfile::tempdir().unwrap();
//! let manifest = scene.write(folder.path()).unwrap();
//! assert!(folder.path().join("truth/dome").join(&manifest.photos[0].name).is_file());
//! ```

mod builder;
mod bvh;
mod cameras;
mod error;
mod generate;
mod layout;
mod light;
mod material;
mod options;
mod photo;
mod plan;
mod planned;
mod points;
pub mod random;
mod scene;
mod shape;
mod statue;
mod surroundings;
mod trace;
mod transient;
mod truth;
mod world;
mod write;

pub use error::SyntheticError;
pub use generate::generate;
pub use light::{Day, PhotoLight};
pub use options::{LightVariation, SyntheticOptions};
pub use photo::SyntheticPhoto;
pub use plan::SyntheticPlan;
pub use points::SyntheticPoint;
pub use scene::SyntheticScene;
pub use truth::{CLICKS, Click, Manifest, ObjectTruth, PhotoTruth};
pub use world::{Instance, ObjectKind, WorldPart};
