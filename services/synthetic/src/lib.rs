//! The synthetic wild set: a scene that is sampled from a seed, photographed by tourists in all weathers, with everything
//! known exactly (method, section 11).
//!
//! The photos come from a ray tracer of its own, never from the rasteriser that learns from them.
//!
//! ```
//! use segwild_synthetic::{SyntheticOptions, generate};
//! let options = SyntheticOptions { train: 3, test: 1, long_side: 48, points: 50, ..SyntheticOptions::small() };
//! let scene = generate(&options).unwrap();
//! assert_eq!(scene.photos.iter().filter(|p| p.test).count(), 1);
//! assert_eq!(scene.instances[scene.instance_named("dome").unwrap() as usize].name, "dome");
//! ```

mod bvh;
mod cameras;
mod layout;
mod light;
mod material;
mod points;
pub mod random;
mod shape;
mod statue;
mod surroundings;
mod trace;
mod transient;
mod world;
mod write;

pub use light::{Day, PhotoLight};
pub use points::SyntheticPoint;
pub use world::{Instance, ObjectKind, WorldPart};
pub use write::{CLICKS, Click, Manifest, ObjectTruth, PhotoTruth};

use glam::{DVec3, Vec3};
use random::Rng;
use segwild_scene::{Camera, Image, Mask, Pose, SceneError, SceneFrame};
use serde::{Deserialize, Serialize};
use transient::Crowd;
use world::SyntheticWorld;

segwild_scene::choice! {
    /// What differs from photo to photo.
    pub enum LightVariation {
        /// Nothing: every photo has the canonical light.
        None = "none",
        /// NeRF-W's affine colour.
        Affine = "affine",
        /// Sun, sky, colour temperature and the shadows that go with them.
        Sun = "sun",
        /// Exposure, gamma and vignette.
        Camera = "camera",
        /// One of the three, sampled for each photo.
        Mixed = "mixed",
    }
}

/// What to generate.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SyntheticOptions {
    /// Selects the scene and its visitors.
    pub seed: u64,
    /// Number of training photos.
    pub train: usize,
    /// Number of test photos, which have an appearance of their own but no transients.
    pub test: usize,
    /// Long side of every photo in pixels.
    pub long_side: u32,
    /// Share of each training photo that transients cover, 0 to 0.6.
    pub occlusion: f32,
    /// What differs from photo to photo.
    pub photo_light: LightVariation,
    /// How much it differs: 1 is NeRF-W's range for the affine appearance and a day's range for the sun.
    pub appearance_strength: f32,
    /// Number of reconstructed points.
    pub points: usize,
    /// Share of points that are wrong.
    pub outliers: f32,
    /// Standard deviation of observations, in pixels.
    pub pixel_noise: f32,
    /// File units per unit of the scene (which is about 12 across): nothing but the units may depend on it.
    pub units: f64,
}

impl Default for SyntheticOptions {
    fn default() -> Self {
        SyntheticOptions {
            seed: 1,
            train: 60,
            test: 12,
            long_side: 320,
            occlusion: 0.10,
            photo_light: LightVariation::Mixed,
            appearance_strength: 1.0,
            points: 4000,
            outliers: 0.02,
            pixel_noise: 0.5,
            units: 1.0,
        }
    }
}

impl SyntheticOptions {
    /// The set of the demo: few small photos.
    pub fn small() -> SyntheticOptions {
        SyntheticOptions { train: 24, test: 4, long_side: 240, points: 2500, ..SyntheticOptions::default() }
    }

    fn check(&self) -> Result<(), SyntheticError> {
        let refuse = |what: &str| Err(SyntheticError::Options(what.into()));
        if self.train == 0 || self.train + self.test > 4000 {
            return refuse("a set has 1 to 4000 photos, at least one of them for training");
        }
        if !(16..=4096).contains(&self.long_side) {
            return refuse("the long side of the photos is 16 to 4096 pixels");
        }
        if !(0.0..=0.6).contains(&self.occlusion) {
            return refuse("transients cover a share of 0 to 0.6 of a photo");
        }
        if !(0.0..=2.0).contains(&self.appearance_strength) {
            return refuse("the strength of the appearances is 0 to 2");
        }
        if !(0.0..=0.9).contains(&self.outliers) || !(0.0..=20.0).contains(&self.pixel_noise) {
            return refuse("outliers are a share of 0 to 0.9 and the pixel noise is 0 to 20 px");
        }
        if !(self.units > 1e-9 && self.units < 1e9) {
            return refuse("the units are a positive number between 1e-9 and 1e9");
        }
        Ok(())
    }
}

/// Why a set cannot be made or written.
#[derive(Debug, thiserror::Error)]
pub enum SyntheticError {
    /// An option is out of its range.
    #[error("{0}")]
    Options(String),
    /// No camera position shows enough of the scene.
    #[error("seed {seed}: no camera position was found for photo {index}; choose another seed")]
    NoViewpoint {
        /// The seed.
        seed: u64,
        /// The photo within its split.
        index: usize,
    },
    /// A file cannot be written.
    #[error(transparent)]
    Scene(#[from] SceneError),
}

/// One photo and all that is true of it.
#[derive(Clone, Debug)]
pub struct SyntheticPhoto {
    /// File name.
    pub name: String,
    /// Intrinsics.
    pub camera: Camera,
    /// World to camera, in file units.
    pub pose: Pose,
    /// The translation of `pose` before it was rounded: what is written, so that units change nothing else.
    pub translation: DVec3,
    /// Whether it is held out.
    pub test: bool,
    /// Whether it was taken from the front: such photos never show the occluded wall.
    pub front: bool,
    /// What a visitor's camera recorded, three planes, exactly as an 8-bit file keeps it.
    pub photo: Image,
    /// The view under the canonical light with nobody in it.
    pub clean: Image,
    /// Distance along the optical axis at each pixel's centre, in file units; 0 where the sky is.
    pub depth: Vec<f32>,
    /// Instance at each pixel's centre, transients aside; 0 is the sky.
    pub instances: Vec<u16>,
    /// Part at each pixel's centre, transients aside; 0 is the sky.
    pub parts: Vec<u16>,
    /// Pixels that a transient touches.
    pub transients: Mask,
    /// Light and camera.
    pub photo_light: PhotoLight,
}

impl SyntheticPhoto {
    /// The pixels of an instance, transients aside; id 0 gives the sky.
    pub fn mask(&self, instance: u16) -> Mask {
        select(&self.camera, &self.instances, instance)
    }

    /// The pixels of a part, transients aside.
    pub fn part_mask(&self, part: u16) -> Mask {
        select(&self.camera, &self.parts, part)
    }

    /// The sky's pixels, transients aside.
    pub fn sky(&self) -> Mask {
        self.mask(0)
    }

    /// The pixel position deepest inside what is seen of an instance, at least 2 px from its outline and from
    /// transients; `None` when there is no such pixel.
    pub fn click(&self, instance: u16) -> Option<[f32; 2]> {
        let seen = self.mask(instance).minus(&self.transients);
        if seen.is_empty() {
            return None;
        }
        let (w, h) = (self.camera.width, self.camera.height);
        let depth = seen.not().distances();
        let clear = |x: u32, y: u32| {
            let border = (x + 1).min(y + 1).min(w - x).min(h - y) as f32;
            depth[(y * w + x) as usize].min(border)
        };
        let mut best = (2.0, None);
        for (x, y) in seen.pixels() {
            let margin = clear(x, y);
            if margin > best.0 {
                best = (margin, Some([x as f32 + 0.5, y as f32 + 0.5]));
            }
        }
        best.1
    }
}

fn select(camera: &Camera, ids: &[u16], id: u16) -> Mask {
    Mask::from_fn(camera.width, camera.height, |x, y| ids[(y * camera.width + x) as usize] == id)
}

/// A whole set in memory.
#[derive(Clone, Debug)]
pub struct SyntheticScene {
    /// The options that it was made with.
    pub options: SyntheticOptions,
    /// The named things; an id is an index, 0 is the sky.
    pub instances: Vec<Instance>,
    /// The parts of all instances; an id is an index, 0 is the sky.
    pub parts: Vec<WorldPart>,
    /// The photos, training and test mixed, in the order of their names.
    pub photos: Vec<SyntheticPhoto>,
    /// The points a reconstruction would have.
    pub points: Vec<SyntheticPoint>,
    world: SyntheticWorld,
}

impl SyntheticScene {
    /// Id of the instance of that name.
    pub fn instance_named(&self, name: &str) -> Option<u16> {
        self.instances.iter().position(|i| i.name == name).map(|i| i as u16)
    }

    /// Ids of the instances that one click can name.
    pub fn objects(&self) -> Vec<u16> {
        let is_object = |i: &u16| self.instances[usize::from(*i)].kind == ObjectKind::Object;
        (0..self.instances.len() as u16).filter(is_object).collect()
    }

    /// The pixels that an instance would cover on every photo if only the ground stood there with it, in the order of
    /// the photos.
    pub fn amodal(&self, instance: u16) -> Vec<Mask> {
        use rayon::prelude::*;
        let world = self.world.alone(instance);
        let amodal_mask = |photo: &SyntheticPhoto| {
            let eye = photo.pose.centre() / self.options.units as f32;
            let back = photo.pose.rotation.transpose();
            Mask::from_fn(photo.camera.width, photo.camera.height, |x, y| {
                let towards = back * photo.camera.ray(glam::Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
                world.closest(eye, towards.normalize()).is_some_and(|hit| hit.solid.is_some())
            })
        };
        self.photos.par_iter().map(amodal_mask).collect()
    }

    /// Part of the surface nearest to a position in file units, and the distance to that surface in file units; a
    /// position inside a solid belongs to that solid.
    pub fn nearest_part(&self, position: DVec3) -> (u16, f64) {
        let (part, distance) = self.world.nearest((position / self.options.units).as_vec3());
        (part, f64::from(distance) * self.options.units)
    }

    /// Instance of the surface nearest to a position in file units, and the distance to it in file units.
    pub fn nearest_instance(&self, position: DVec3) -> (u16, f64) {
        let (part, distance) = self.nearest_part(position);
        (self.parts[usize::from(part)].instance, distance)
    }

    /// Instances of the surfaces nearest to positions in a scene's normalised frame.
    pub fn label(&self, frame: &SceneFrame, positions: &[[f32; 3]]) -> Vec<u16> {
        use rayon::prelude::*;
        let one =
            |p: &[f32; 3]| self.nearest_instance(Vec3::from(*p).as_dvec3() * frame.scale + frame.origin).0;
        positions.par_iter().map(one).collect()
    }
}

/// Makes the set. The same options give the same bytes, whatever the number of threads.
pub fn generate(options: &SyntheticOptions) -> Result<SyntheticScene, SyntheticError> {
    options.check()?;
    let world = layout::build(options.seed);
    let count = options.train + options.test;
    let (mut trained, mut tested) = (0, 0);
    let mut photos = Vec::with_capacity(count);
    let mut shots = Vec::with_capacity(count);
    for index in 0..count {
        let test = (index + 1) * options.test / count > index * options.test / count;
        let (stream, rank) = if test { (2 << 20, &mut tested) } else { (1 << 20, &mut trained) };
        let shot = cameras::sample_camera(&world, options, stream, *rank)?;
        let mut rng = Rng::new(options.seed, (3 << 20) + stream + *rank as u64);
        *rank += 1;
        let photo_light = photo_light_of(options, &mut rng);
        let share = if test { 0.0 } else { options.occlusion * rng.range(0.88, 1.12) };
        let crowd = Crowd::random(&mut rng, share, shot.camera.width, shot.camera.height);
        let exposed = trace::expose(&world, &shot, &photo_light, &crowd);
        let instances = exposed.parts.iter().map(|&p| world.parts[usize::from(p)].instance).collect();
        let units = options.units as f32;
        photos.push(SyntheticPhoto {
            name: format!("photo_{index:03}.png"),
            camera: shot.camera,
            pose: Pose { translation: shot.pose.translation * units, ..shot.pose },
            translation: shot.pose.translation.as_dvec3() * options.units,
            test,
            front: shot.front,
            photo: exposed.photo,
            clean: exposed.clean,
            depth: exposed.depth.iter().map(|d| d * units).collect(),
            instances,
            parts: exposed.parts,
            transients: exposed.transients,
            photo_light,
        });
        shots.push(shot);
    }
    let points = points::reconstruct(&world, options, &photos, &shots);
    Ok(SyntheticScene {
        options: options.clone(),
        instances: world.instances.clone(),
        parts: world.parts.clone(),
        photos,
        points,
        world,
    })
}

/// Samples a photo's appearance.
fn photo_light_of(options: &SyntheticOptions, rng: &mut Rng) -> PhotoLight {
    let mut photo_light = PhotoLight::canonical();
    let s = options.appearance_strength;
    let (sun, camera, affine) = match options.photo_light {
        LightVariation::None => (false, false, false),
        LightVariation::Affine => (false, false, true),
        LightVariation::Sun => (true, false, false),
        LightVariation::Camera => (false, true, false),
        LightVariation::Mixed => {
            let (sun, camera, affine) = (rng.chance(0.65), rng.chance(0.6), rng.chance(0.3));
            (sun || !(camera || affine), camera, affine)
        }
    };
    if sun {
        photo_light.day = Day::random(rng, s);
        photo_light.own_day = true;
    }
    if camera {
        photo_light.exposure = s * rng.range(-0.65, 0.65);
        photo_light.gamma = 1.0 + s * rng.range(-0.18, 0.25);
        photo_light.vignette = (s * rng.range(0.0, 0.5)).min(0.95);
    }
    if affine {
        // On top of another appearance, or as one among many, the full range would not pass for a photo.
        let s = if options.photo_light == LightVariation::Mixed { 0.4 * s } else { s };
        photo_light.scale = Vec3::ONE + rng.triple(-0.2, 0.2) * s;
        photo_light.shift = rng.triple(-0.2, 0.2) * s;
    }
    photo_light
}
