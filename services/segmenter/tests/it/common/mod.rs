//! Small scenes of known objects.

use glam::{Quat, Vec3};
use segwild_objective::Engine;
use segwild_raster::{CpuEngine, ProjectOptions};
use segwild_scene::{Camera, Pose, Splats};
use segwild_segmenter::scene_tree::SceneTree;
use segwild_segmenter::{PosedView, PromptedView, Request, SegmentSettings, SplatFeatures, hit};

/// Numbers in [0, 1) from a seed.
pub struct TestRandom(pub u64);

impl TestRandom {
    pub fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u64 << 24) as f32
    }
}

/// Splats, and which thing each of them is part of.
#[derive(Clone, Default)]
pub struct TestWorld {
    pub splats: Splats,
    pub thing: Vec<usize>,
}

impl TestWorld {
    /// Adds a disc with its normal along `normal`.
    pub fn disc(&mut self, thing: usize, at: Vec3, normal: Vec3, radius: f32, colour: [f32; 3]) {
        let q = Quat::from_rotation_arc(Vec3::Z, normal);
        let s = &mut self.splats;
        s.means.push(at.to_array());
        s.log_scales.push([radius.ln(), radius.ln(), (radius * 0.05).ln()]);
        s.rotations.push([q.w, q.x, q.y, q.z]);
        s.opacities.push(4.0);
        s.sh.extend(colour.map(|c| (c - 0.5) / 0.282_094_8));
        self.thing.push(thing);
    }

    /// Adds a wall that faces the -z direction: `side` x `side` discs over the square of half width `half`.
    pub fn wall(
        &mut self,
        thing: usize,
        centre: Vec3,
        half: f32,
        side: usize,
        colour: [f32; 3],
        dice: &mut TestRandom,
    ) {
        let step = 2.0 * half / side as f32;
        for y in 0..side {
            for x in 0..side {
                let at =
                    |k: usize, d: &mut TestRandom| (k as f32 + 0.5 + 0.1 * (d.next() - 0.5)) * step - half;
                let p = Vec3::new(at(x, dice), at(y, dice), 0.02 * step * dice.next());
                self.disc(thing, centre + p, Vec3::NEG_Z, 0.5 * step, colour);
            }
        }
    }

    /// Adds the surface of an ellipsoid.
    pub fn ball(
        &mut self,
        thing: usize,
        centre: Vec3,
        radii: Vec3,
        count: usize,
        colour: [f32; 3],
        dice: &mut TestRandom,
    ) {
        let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
        let size = (4.0 * std::f32::consts::PI / count as f32).sqrt() * radii.max_element() * 0.5;
        for i in 0..count {
            let y = 1.0 - 2.0 * (i as f32 + 0.5) / count as f32;
            let (r, turn) = ((1.0 - y * y).sqrt(), golden * i as f32 + 0.05 * dice.next());
            let unit = Vec3::new(r * turn.cos(), y, r * turn.sin());
            self.disc(thing, centre + unit * radii, (unit / radii).normalize(), size, colour);
        }
    }

    pub fn len(&self) -> usize {
        self.thing.len()
    }

    /// Labels of one thing.
    pub fn is(&self, thing: usize) -> Vec<bool> {
        self.thing.iter().map(|t| *t == thing).collect()
    }

    /// Share of a thing's splats that are labelled.
    pub fn share(&self, thing: usize, labels: &[bool]) -> f32 {
        let of: Vec<bool> =
            self.thing.iter().zip(labels).filter(|(t, _)| **t == thing).map(|(_, l)| *l).collect();
        of.iter().filter(|l| **l).count() as f32 / of.len() as f32
    }
}

pub fn engine() -> CpuEngine {
    CpuEngine::new()
}

pub fn options() -> ProjectOptions {
    ProjectOptions::default()
}

pub fn posed(name: &str, eye: Vec3, target: Vec3) -> PosedView {
    let camera = Camera { width: 160, height: 120, fx: 130.0, fy: 130.0, cx: 80.0, cy: 60.0 };
    PosedView { name: name.into(), camera, pose: Pose::look_at(eye, target, Vec3::NEG_Y) }
}

/// A front wall (thing 0), a second one wholly occluded by it (1) and a far backdrop (3, the sky).
pub fn walls() -> (TestWorld, PosedView) {
    let mut world = TestWorld::default();
    let mut dice = TestRandom(1);
    world.wall(0, Vec3::new(0.0, 0.0, 2.0), 0.5, 30, [0.8, 0.3, 0.2], &mut dice);
    world.wall(1, Vec3::new(0.0, 0.0, 3.0), 0.5, 30, [0.8, 0.3, 0.2], &mut dice);
    world.wall(3, Vec3::new(0.0, 0.0, 30.0), 40.0, 30, [0.5, 0.7, 1.0], &mut dice);
    let view = posed("front.jpg", Vec3::ZERO, Vec3::Z);
    (world, view)
}

/// One unit vector per thing, slightly noisy.
pub fn features(world: &TestWorld, channels: usize) -> SplatFeatures {
    let mut dice = TestRandom(99);
    let values = world
        .thing
        .iter()
        .flat_map(|&t| (0..channels).map(move |c| f32::from(u8::from(c == t))).collect::<Vec<_>>())
        .map(|v| v + 0.02 * (dice.next() - 0.5))
        .collect();
    SplatFeatures::new(channels, values).unwrap()
}

/// A request with nothing but what it needs.
pub fn request<'a>(
    engine: &'a dyn Engine,
    splats: &'a Splats,
    views: &'a [PosedView],
    prompts: &'a [PromptedView<'a>],
    settings: &'a SegmentSettings,
) -> Request<'a> {
    Request {
        rasterizer: engine,
        backend: engine,
        options: options(),
        splats,
        views,
        prompts,
        prior: None,
        features: None,
        hits: None,
        graph: None,
        affinities: None,
        frozen: None,
        shown: None,
        seen_once: None,
        skies: None,
        transients: None,
        steps: None,
        settings,
    }
}

/// The leaf under a point of the world in a view.
pub fn leaf(tree: &SceneTree, world: &TestWorld, view: &PosedView, at: Vec3) -> u32 {
    let pixel = view.camera.pixel(view.pose.to_camera(at));
    let hit = hit(&engine(), &world.splats, &options(), &view.camera, &view.pose, pixel, 1).unwrap();
    tree.leaf_of(&hit).expect("a leaf")
}
