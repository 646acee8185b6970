//! The scene: a gate on a square, a domed hall at its back, minarets, pavilions, statues.

use crate::builder::Builder;
use crate::material::{Material, colour};
use crate::random::Rng;
use crate::shape::SolidShape;
use crate::statue;
use crate::surroundings;
use crate::world::{ObjectKind, SyntheticWorld, WorldPart};
use glam::{Vec2, Vec3};

/// Colours of a scene.
struct Palette {
    gate: Vec3,
    lintel: Vec3,
    hall: Vec3,
    shell: Vec3,
    rib: Vec3,
    bands: [Vec3; 2],
    pavilions: [Vec3; 2],
    roofs: [Vec3; 2],
    bronze: [Vec3; 2],
    flag: Vec3,
    lawn: Vec3,
}

impl Palette {
    fn random(rng: &mut Rng) -> Palette {
        // Each row: gate, lintel, hall, shell, rib, two bands, two pavilions, two roofs.
        const SETS: [[u32; 11]; 4] = [
            [
                0xcdb68c, 0xe6dcc4, 0xc99a72, 0x4f8f8b, 0xd8c48a, 0xe9dfc8, 0xb5664a, 0xd9b27a, 0xc9c3b4,
                0xa9512f, 0x566a7c,
            ],
            [
                0xb9b4a6, 0xdad0b4, 0xe0d8c8, 0xe8e2d4, 0xb08d4f, 0xf0eadc, 0x6f7f92, 0xc48f74, 0xb7b48f,
                0x6a8272, 0x9c4a34,
            ],
            [
                0xc58f74, 0xe2cfae, 0xb8705a, 0xeee6d8, 0xa9683f, 0xeadfca, 0xa3493a, 0xd8c39a, 0xa9a79f,
                0x4d6f86, 0x8c5a3a,
            ],
            [
                0xdacdae, 0xb58f66, 0xd0ad72, 0x3f6ea3, 0xe3c777, 0xf0e6cf, 0x3f7f8c, 0xcfa58a, 0xbcc0c0,
                0x7d4f6a, 0xb06a35,
            ],
        ];
        let set = SETS[rng.below(SETS.len())];
        let mut tint = |code: u32| {
            let shade = rng.range(0.88, 1.1);
            (colour(code) * shade * rng.triple(0.94, 1.06)).min(Vec3::splat(0.9))
        };
        Palette {
            gate: tint(set[0]),
            lintel: tint(set[1]),
            hall: tint(set[2]),
            shell: tint(set[3]),
            rib: tint(set[4]),
            bands: [tint(set[5]), tint(set[6])],
            pavilions: [tint(set[7]), tint(set[8])],
            roofs: [tint(set[9]), tint(set[10])],
            bronze: [tint(0x3c6f60), tint(0x6b5136)],
            flag: tint(0xb3a996),
            lawn: tint(0x5f7f3a),
        }
    }
}

/// Sizes that every building shares.
struct LayoutPlan {
    columns: usize,
    bay: f32,
    column: f32,
    radius: f32,
    /// Height of the platform the gate stands on.
    floor: f32,
    /// Half the width of the gate.
    half: f32,
}

/// Builds the scene of a seed.
pub fn build(seed: u64) -> SyntheticWorld {
    let mut rng = Rng::new(seed, 1);
    let palette = Palette::random(&mut rng);
    let columns = [6, 6, 8][rng.below(3)];
    let bay = if columns == 8 { rng.range(0.78, 0.88) } else { rng.range(0.98, 1.14) };
    let plan = LayoutPlan {
        columns,
        bay,
        column: rng.range(2.35, 2.9),
        radius: bay * rng.range(0.185, 0.225),
        floor: rng.range(0.30, 0.48),
        half: bay * (columns as f32 - 1.0) / 2.0,
    };
    let mut b = Builder::new();
    b.instance("sky", ObjectKind::Surface);
    b.part("sky");
    b.instance("ground", ObjectKind::Surface);
    b.part("ground");
    let ground = Material::Plaza {
        flag: palette.flag,
        band: palette.lintel * 0.9,
        lawn: palette.lawn,
        centre: Vec2::new(0.0, -1.0),
        half: Vec2::new(plan.half + 6.2, 10.1),
    };
    b.ground(ground);
    gate(&mut b, &mut rng, &palette, &plan);
    let hall = hall(&mut b, &mut rng, &palette, &plan);
    minarets(&mut b, &mut rng, &palette, &plan, hall.y);
    pavilions(&mut b, &mut rng, &palette, &plan);
    statues(&mut b, &mut rng, &palette, &plan);
    surroundings::occluded_wall(&mut b, &mut rng, hall);
    surroundings::landscape(&mut b, &mut rng, plan.half);
    b.finish()
}

/// Steps, columns in front of piers, and the lintel with what stands on it.
fn gate(b: &mut Builder, rng: &mut Rng, palette: &Palette, plan: &LayoutPlan) {
    let stone = b.material(Material::Ashlar { base: palette.gate, block: Vec2::new(0.52, 0.26) });
    let step = b.material(Material::Ashlar { base: palette.gate * 0.92, block: Vec2::new(0.8, 0.4) });
    let shaft = b.material(Material::Fluted {
        base: (palette.gate * 1.12).min(Vec3::splat(0.88)),
        flutes: 14.0,
        drum: plan.column / 5.0,
    });
    b.instance("facade", ObjectKind::Surface);
    b.part("steps");
    let depth = 2.5;
    for i in 0..3 {
        let out = 0.26 * (3 - i) as f32;
        let size = Vec3::new(2.0 * (plan.half + 0.55 + out), depth + 2.0 * out, plan.floor / 3.0);
        b.add(SolidShape::block(Vec3::new(0.0, 0.75, plan.floor * i as f32 / 3.0), size, 0.0), step);
    }
    b.part("piers");
    let middle = plan.columns as f32 / 2.0 - 0.5;
    let at = |i: usize| (i as f32 - middle) * plan.bay;
    for i in 0..plan.columns {
        // The gate's middle bay is open, the outer bays are walled.
        let outer = i == 0 || i + 1 == plan.columns;
        let width = if outer { plan.bay * 0.95 } else { plan.bay * 0.5 };
        let foot = Vec3::new(at(i), 1.25, plan.floor);
        b.add(SolidShape::block(foot, Vec3::new(width, 0.75, plan.column), 0.0), stone);
    }
    b.part("wall");
    let arch_top = plan.column * 0.30;
    let foot = Vec3::new(0.0, 1.25, plan.floor + plan.column - arch_top);
    b.add(SolidShape::block(foot, Vec3::new(2.0 * plan.half, 0.6, arch_top), 0.0), stone);

    b.instance("columns", ObjectKind::Group);
    for i in 0..plan.columns {
        b.part(&format!("column_{}", i + 1));
        let base = Vec3::new(at(i), 0.0, plan.floor);
        let r = plan.radius;
        let top = plan.column;
        b.add(SolidShape::block(base, Vec3::new(2.7 * r, 2.7 * r, 0.10), 0.0), stone);
        b.add_all(
            SolidShape::turned(base, &[(0.10, 1.22 * r), (0.15, 1.28 * r), (0.22, 1.05 * r), (0.26, r)]),
            stone,
        );
        b.add_all(
            SolidShape::turned(base, &[(0.26, r), (top * 0.45, 0.97 * r), (top - 0.28, 0.84 * r)]),
            shaft,
        );
        b.add_all(
            SolidShape::turned(base, &[(top - 0.28, 0.84 * r), (top - 0.2, 0.9 * r), (top - 0.1, 1.25 * r)]),
            stone,
        );
        b.add(
            SolidShape::block(base + Vec3::Z * (top - 0.10), Vec3::new(2.7 * r, 2.7 * r, 0.10), 0.0),
            stone,
        );
    }

    let carved = b.material(Material::Frieze {
        base: palette.lintel,
        carved: palette.roofs[0].lerp(palette.lintel, 0.25),
        period: plan.bay / 2.0,
    });
    let smooth =
        b.material(Material::Marble { base: palette.lintel, vein: palette.lintel * 0.72, size: 0.55 });
    b.instance("lintel", ObjectKind::Object);
    let over = plan.floor + plan.column;
    let (low, mid, high) = (rng.range(0.22, 0.28), rng.range(0.32, 0.42), rng.range(0.14, 0.2));
    let wide = 2.0 * plan.half + 2.9 * plan.radius;
    let beam = |z: f32, out: f32, height: f32| {
        let size = Vec3::new(wide + 2.0 * out, 2.05 + 2.0 * out, height);
        SolidShape::block(Vec3::new(0.0, 0.66, z), size, 0.0)
    };
    b.part("architrave");
    b.add(beam(over, 0.0, low), smooth);
    b.part("frieze");
    b.add(beam(over + low, -0.04, mid), carved);
    b.part("cornice");
    b.add(beam(over + low + mid, 0.12, high * 0.5), smooth);
    b.add(beam(over + low + mid + high * 0.5, 0.24, high * 0.5), smooth);

    // The crown belongs to the facade: the lintel ends at its cornice.
    let crown = over + low + mid + high;
    let facade = b.world.instances.iter().position(|i| i.name == "facade").unwrap_or(1) as u16;
    b.world.parts.push(WorldPart { name: "crown".into(), instance: facade });
    if rng.chance(0.5) {
        let roof = b.material(Material::Tiles { base: palette.roofs[1] });
        let rise = rng.range(0.62, 0.85);
        b.add(SolidShape::block(Vec3::new(0.0, 0.66, crown), Vec3::new(wide * 0.96, 1.9, 0.06), 0.0), stone);
        b.add(
            SolidShape::roof(Vec3::new(0.0, 0.66, crown + 0.06), wide * 0.96, 1.9, rise, wide * 0.55),
            roof,
        );
        b.add(
            SolidShape::block(Vec3::new(0.0, -0.05, crown + 0.06), Vec3::new(0.9, 0.5, rise * 0.9), 0.0),
            stone,
        );
    } else {
        let rise = rng.range(0.42, 0.6);
        b.add(SolidShape::block(Vec3::new(0.0, 0.66, crown), Vec3::new(wide * 0.78, 1.6, rise), 0.0), stone);
        b.add(
            SolidShape::block(Vec3::new(0.0, 0.66, crown + rise), Vec3::new(wide * 0.82, 1.7, 0.1), 0.0),
            smooth,
        );
        b.add(
            SolidShape::block(Vec3::new(0.0, 0.5, crown + rise + 0.1), Vec3::new(1.5, 1.2, 0.22), 0.0),
            stone,
        );
    }
    b.world.centre.z = (crown + 1.0) * 0.5;
}

/// The hall and its dome; returns the hall's half width (x), where its back is (y) and how high its walls are (z).
fn hall(b: &mut Builder, rng: &mut Rng, palette: &Palette, plan: &LayoutPlan) -> Vec3 {
    let half = plan.half * rng.range(0.72, 0.84) + 0.35;
    let depth = rng.range(2.9, 3.4);
    let front = 3.1;
    let y = front + depth / 2.0;
    let height = rng.range(3.7, 4.2);
    let wall = b.material(Material::Windows {
        base: palette.hall,
        pane: colour(0x26384a),
        bay: rng.range(0.75, 0.95),
        rise: Vec2::new(height * 0.38, height * 0.8),
    });
    let stone = b.material(Material::Ashlar { base: palette.hall * 1.05, block: Vec2::new(0.5, 0.2) });
    b.instance("hall", ObjectKind::Surface);
    b.part("walls");
    b.add(SolidShape::block(Vec3::new(0.0, y, 0.0), Vec3::new(2.0 * half, depth, height), 0.0), wall);
    b.add(
        SolidShape::block(Vec3::new(0.0, y, 0.0), Vec3::new(2.0 * half + 0.3, depth + 0.3, 0.5), 0.0),
        stone,
    );
    b.part("cornice");
    b.add(
        SolidShape::block(Vec3::new(0.0, y, height), Vec3::new(2.0 * half + 0.3, depth + 0.3, 0.16), 0.0),
        stone,
    );

    let r = (depth * 0.46).min(half * 0.75) * rng.range(0.92, 1.0);
    let drum_height = rng.range(0.75, 1.05);
    let drum = b.material(Material::Frieze {
        base: palette.bands[0],
        carved: palette.shell * 0.8,
        period: std::f32::consts::TAU / 16.0,
    });
    let ring = b.material(Material::Marble { base: palette.bands[0], vein: palette.rib, size: 0.5 });
    let shell = b.material(Material::Ribbed {
        base: palette.shell,
        rib: palette.rib,
        ribs: [12.0, 16.0][rng.below(2)],
    });
    let gold = b.material(Material::Marble { base: colour(0xd9a83a), vein: colour(0x8a6420), size: 0.3 });
    let onion = rng.chance(0.5);
    let rise = r * if onion { rng.range(1.45, 1.7) } else { rng.range(1.02, 1.2) };
    b.instance("dome", ObjectKind::Object);
    b.part("drum");
    let base = Vec3::new(0.0, y, height + 0.16);
    b.add(SolidShape::frustum(base, drum_height, r * 0.97, r * 0.97), drum);
    b.add(SolidShape::frustum(base + Vec3::Z * (drum_height - 0.1), 0.14, r * 1.06, r * 1.06), ring);
    b.part("shell");
    let foot = base + Vec3::Z * (drum_height + 0.04);
    b.add_all(SolidShape::turned(foot, &dome_profile(r, rise, onion)), shell);
    b.part("lantern");
    let top = foot + Vec3::Z * rise;
    b.add_all(lantern(top - Vec3::Z * 0.08, r * 0.11), gold);
    b.world.centre.y = 1.5;
    Vec3::new(half, y + depth / 2.0 + 0.15, height)
}

/// Outline of a dome that starts at radius `r`: a half ellipse, or an onion that swells and draws to a point.
fn dome_profile(r: f32, rise: f32, onion: bool) -> Vec<(f32, f32)> {
    const SLICES: usize = 12;
    (0..=SLICES)
        .map(|i| {
            let s = i as f32 / SLICES as f32;
            if onion {
                // Swelling first, then the cosine's S-shape up to the point.
                let swell = 1.0 + 0.30 * (s * 2.6).min(1.0) * (std::f32::consts::PI * s.powf(0.8)).sin();
                let draw = (std::f32::consts::FRAC_PI_2 * s).cos().powf(0.85);
                (rise * s, (r * 0.93 * swell * draw).max(0.02))
            } else {
                let angle = std::f32::consts::FRAC_PI_2 * s;
                (rise * angle.sin(), (r * angle.cos()).max(0.02))
            }
        })
        .collect()
}

/// A finial: a ball, a smaller ball and a spike.
fn lantern(foot: Vec3, r: f32) -> Vec<SolidShape> {
    let mut shapes = SolidShape::turned(
        foot,
        &[(0.0, r * 1.3), (r * 0.8, r * 0.6), (r * 1.6, r * 0.45), (r * 6.0, 0.012)],
    );
    shapes.push(SolidShape::ball(foot + Vec3::Z * r * 1.9, r * 0.95));
    shapes.push(SolidShape::ball(foot + Vec3::Z * r * 3.3, r * 0.6));
    shapes
}

fn minarets(b: &mut Builder, rng: &mut Rng, palette: &Palette, plan: &LayoutPlan, back: f32) {
    let x = plan.half + rng.range(0.75, 1.0);
    let y = back - rng.range(1.2, 1.9);
    let height = rng.range(5.9, 7.2);
    let r = rng.range(0.34, 0.42);
    let shaft =
        b.material(Material::Bands { a: palette.bands[0], b: palette.bands[1], period: rng.range(0.5, 0.7) });
    let stone =
        b.material(Material::Marble { base: palette.bands[0], vein: palette.bands[0] * 0.7, size: 0.4 });
    let cap = b.material(Material::Ribbed { base: palette.shell, rib: palette.rib, ribs: 8.0 });
    let gold = b.material(Material::Marble { base: colour(0xd9a83a), vein: colour(0x8a6420), size: 0.3 });
    for (name, side) in [("left_minaret", -1.0), ("right_minaret", 1.0)] {
        b.instance(name, ObjectKind::Object);
        let foot = Vec3::new(side * x, y, 0.0);
        b.part("base");
        b.add(SolidShape::block(foot, Vec3::new(3.2 * r, 3.2 * r, 0.9), 0.0), stone);
        b.part("shaft");
        b.add_all(SolidShape::turned(foot, &[(0.9, r), (height * 0.5, r * 0.86), (height, r * 0.74)]), shaft);
        b.part("balconies");
        for z in [height * 0.55, height * 0.985] {
            let ring = [(z - 0.22, r * 0.8), (z - 0.06, r * 1.35), (z + 0.12, r * 1.4)];
            b.add_all(SolidShape::turned(foot, &ring), stone);
        }
        b.part("top");
        b.add_all(SolidShape::turned(foot, &[(height, r * 0.62), (height + 0.55, r * 0.6)]), shaft);
        let crown = foot + Vec3::Z * (height + 0.55);
        b.add(SolidShape::frustum(crown, 0.07, r * 0.8, r * 0.8), stone);
        b.add_all(SolidShape::turned(crown + Vec3::Z * 0.07, &dome_profile(r * 0.72, r * 1.5, true)), cap);
        b.add_all(lantern(crown + Vec3::Z * (r * 1.45), r * 0.13), gold);
    }
}

/// Two garden houses beside the gate, alike in form, unlike in stone and roof.
fn pavilions(b: &mut Builder, rng: &mut Rng, palette: &Palette, plan: &LayoutPlan) {
    let side_length = rng.range(1.95, 2.3);
    let height = rng.range(1.45, 1.75);
    let x = plan.half + rng.range(2.5, 2.9);
    let y = rng.range(-0.9, 0.2);
    let rise = rng.range(0.75, 1.15);
    let ridge = if rng.chance(0.5) { 0.0 } else { side_length * 0.4 };
    for (i, (name, side)) in [("left_pavilion", -1.0), ("right_pavilion", 1.0)].into_iter().enumerate() {
        let base = palette.pavilions[i];
        let wall = b.material(Material::Windows {
            base,
            pane: colour(0x2c3338),
            bay: side_length * 0.82 / 3.0,
            rise: Vec2::new(0.35, height * 0.82),
        });
        let stone = b.material(Material::Ashlar { base: base * 0.95, block: Vec2::new(0.42, 0.2) });
        let trim = b.material(Material::Marble {
            base: palette.lintel.lerp(base, 0.4),
            vein: base * 0.7,
            size: 0.4,
        });
        let roof = b.material(Material::Tiles { base: palette.roofs[i] });
        b.instance(name, ObjectKind::Object);
        let foot = Vec3::new(side * x, y, 0.0);
        let square = |z: f32, size: f32, height: f32| {
            SolidShape::block(foot + Vec3::Z * z, Vec3::new(size, size, height), 0.0)
        };
        b.part("base");
        b.add(square(0.0, side_length + 0.36, 0.13), stone);
        b.add(square(0.13, side_length + 0.12, 0.13), stone);
        b.part("walls");
        b.add(square(0.26, side_length * 0.82, height), wall);
        b.part("columns");
        let reach = side_length * 0.5 - 0.12;
        for (cx, cy) in [(-1.0, -1.0), (-0.36, -1.0), (0.36, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            let stand = foot + Vec3::new(cx * reach, cy * reach, 0.26);
            b.add_all(
                SolidShape::turned(
                    stand,
                    &[(0.0, 0.13), (0.08, 0.1), (height - 0.12, 0.085), (height, 0.13)],
                ),
                trim,
            );
        }
        b.part("cornice");
        b.add(square(0.26 + height, side_length + 0.02, 0.14), trim);
        b.add(square(0.40 + height, side_length + 0.2, 0.09), trim);
        b.part("roof");
        let eaves = 0.49 + height;
        b.add(
            SolidShape::roof(foot + Vec3::Z * eaves, side_length + 0.16, side_length + 0.16, rise, ridge),
            roof,
        );
        b.add_all(lantern(foot + Vec3::Z * (eaves + rise - 0.08), 0.07), trim);
    }
}

/// Two figures on pedestals before the gate, a rider on top of it.
fn statues(b: &mut Builder, rng: &mut Rng, palette: &Palette, plan: &LayoutPlan) {
    let bronze: [u16; 2] = palette
        .bronze
        .map(|base| b.material(Material::Marble { base: base * 1.25, vein: base * 0.45, size: 0.22 }));
    let y = -rng.range(2.5, 3.3);
    let x = plan.half * rng.range(0.62, 0.85);
    let high = rng.range(0.75, 1.0);
    let tall = rng.range(1.15, 1.35);
    for (i, (name, side)) in [("statue_left", -1.0), ("statue_right", 1.0)].into_iter().enumerate() {
        let base = if i == 0 { palette.lintel } else { palette.hall * 0.9 };
        let plinth = b.material(Material::Marble { base, vein: base * 0.6, size: 0.35 });
        b.instance(name, ObjectKind::Object);
        b.part("pedestal");
        let foot = Vec3::new(side * x, y, 0.0);
        b.add(SolidShape::block(foot, Vec3::new(0.92, 0.92, 0.14), 0.0), plinth);
        b.add(SolidShape::block(foot + Vec3::Z * 0.14, Vec3::new(0.68, 0.68, high - 0.24), 0.0), plinth);
        b.add(SolidShape::block(foot + Vec3::Z * (high - 0.10), Vec3::new(0.84, 0.84, 0.10), 0.0), plinth);
        b.part("figure");
        let pose = if i == 0 { statue::StatuePose::TorchBearer } else { statue::StatuePose::Winged };
        b.add_all(statue::figure(foot + Vec3::Z * high, tall, side, pose), bronze[i]);
    }
    let crown = b
        .world
        .shapes
        .iter()
        .zip(&b.world.part_of)
        .filter(|(_, part)| b.world.parts[**part as usize].name == "crown")
        .map(|(shape, _)| shape.bounds().1.z)
        .fold(0.0, f32::max);
    b.instance("statue_centre", ObjectKind::Object);
    b.part("plinth");
    let plinth = b.material(Material::Ashlar { base: palette.lintel * 0.9, block: Vec2::new(0.4, 0.15) });
    let foot = Vec3::new(0.0, 0.66, crown - 0.25);
    b.add(SolidShape::block(foot, Vec3::new(1.2, 0.6, 0.42), 0.0), plinth);
    b.part("rider");
    let way = if rng.chance(0.5) { 1.0 } else { -1.0 };
    b.add_all(statue::rider(foot + Vec3::Z * 0.42, rng.range(1.05, 1.25), way), bronze[1]);
}
