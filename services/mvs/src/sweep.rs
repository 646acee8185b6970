//! Depths of one photo's pixels.

use crate::frame::{Frame, Grey};
use crate::plane::{Patch, Plane, Source};
use glam::Vec2;
use segwild_scene::Random;

/// Sweeps over the photo at half its size, each from the other corner.
const SWEEPS: usize = 3;
/// Where photos are less alike than this at half the size, none is looked for at full size.
const HOPELESS: f32 = 0.3;
/// How far a plane is moved at random in the first sweep, as a share of one over the depth; half as far in each other.
const JITTER: f32 = 0.04;
/// And how often in a sweep.
const JITTERED: usize = 1;
/// The same at full size, and how often; each time .7 as far.
const FINE_JITTER: f32 = 0.01;
const TRIALS: i32 = 5;
/// Of the other photos so many must show the same: the rest may have something before it.
const BEST: usize = 2;
/// Pixels along a side of the cells in which planes start alike.
const CELL: usize = 4;
/// Points of which a plane is made at the start.
const AROUND: usize = 8;

/// What a photo says of one of four of its pixels: rows as wide as the picture at half its size.
pub(crate) struct Depths {
    /// The plane on which other photos look most alike, at [`Depths::pixel`].
    pub planes: Vec<Plane>,
    /// How alike, in [-1, 1]; -1 where nothing is known.
    pub scores: Vec<f32>,
}

impl Depths {
    /// The pixel of the picture that an entry tells of.
    pub fn pixel(x: usize, y: usize) -> (usize, usize) {
        (2 * x + 1, 2 * y + 1)
    }
}

/// The depths of a photo's pixels by comparison with others: at half its size from the points that it saw, then, for one
/// of four pixels, at full size from there.
pub(crate) fn depths(frame: &Frame, others: &[&Frame], seed: u64) -> Depths {
    let (w, h) = (frame.coarse.width, frame.coarse.height);
    let n = w * h;
    let mut found = Depths { planes: vec![Plane { near: 0.0, slope: [0.0; 2] }; n], scores: vec![-1.0; n] };
    if others.is_empty() || frame.sightings.is_empty() {
        return found;
    }
    let bounds = bounds(&frame.sightings);
    let level = |of: for<'a> fn(&'a Frame) -> &'a Grey| {
        let here = (of(frame), &frame.pose);
        let sources = others.iter().map(|other| Source::new(here, (of(other), &other.pose))).collect();
        Level { grey: of(frame), sources, bounds }
    };
    let mut random = Random::stream(seed, 0x57e2e0);
    let starts = Starts::new(frame);
    let half = level(|f| &f.coarse);
    half.each(true, |i, x, y, patch| {
        if frame.shows(Depths::pixel(x, y)) {
            let planes = starts.planes(x, y, &mut random);
            found.planes[i] = planes[0];
            for plane in planes {
                half.offer(&mut found, i, (x, y), patch, plane);
            }
        }
    });
    for sweep in 0..SWEEPS {
        half.sweep(&mut found, sweep % 2 == 0, JITTER * 0.5f32.powi(sweep as i32), &mut random);
    }
    let full = level(|f| &f.fine);
    for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
        let i = y * w + x;
        let (score, plane) = (found.scores[i], found.planes[i]);
        found.scores[i] = -1.0;
        let (px, py) = Depths::pixel(x, y);
        if score <= HOPELESS || !full.grey.holds(px, py) {
            continue;
        }
        let Some(patch) = Patch::new(full.grey, px, py) else { continue };
        // The middle of the pixel lies a quarter of a half-size one from that of the half-size one.
        let plane = plane.at(0.25, 0.25);
        let plane = Plane { slope: plane.slope.map(|s| 0.5 * s), ..plane };
        full.offer(&mut found, i, (px, py), &patch, plane);
        for trial in 0..TRIALS {
            let plane = jittered(found.planes[i], FINE_JITTER * 0.7f32.powi(trial), &mut random);
            full.offer(&mut found, i, (px, py), &patch, plane);
        }
    }
    found
}

/// A plane moved at random, by a share of what it is.
fn jittered(plane: Plane, by: f32, random: &mut Random) -> Plane {
    let mut draw = || by * (2.0 * random.uniform() - 1.0);
    let near = plane.near * (1.0 + draw());
    Plane { near, slope: plane.slope.map(|s| s + 0.5 * near * draw()) }
}

/// A photo at one size, with the others beside it.
struct Level<'a> {
    grey: &'a Grey,
    sources: Vec<Source<'a>>,
    /// Least and largest that one over the depth may be.
    bounds: (f32, f32),
}

impl Level<'_> {
    /// Offers every pixel the planes of its neighbours, and its own, moved a little.
    fn sweep(&self, found: &mut Depths, ahead: bool, jitter: f32, random: &mut Random) {
        let step = if ahead { -1i32 } else { 1 };
        self.each(ahead, |i, x, y, patch| {
            // Never asked: it does not show the scene.
            if found.planes[i].near <= 0.0 {
                return;
            }
            let beside = (i as i32 + step) as usize;
            let above = (i as i32 + step * self.grey.width as i32) as usize;
            for (j, dx, dy) in [(beside, -step, 0), (above, 0, -step)] {
                if found.scores[j] > -1.0 {
                    let plane = found.planes[j].at(dx as f32, dy as f32);
                    self.offer(found, i, (x, y), patch, plane);
                }
            }
            for _ in 0..JITTERED {
                let plane = jittered(found.planes[i], jitter, random);
                self.offer(found, i, (x, y), patch, plane);
            }
        });
    }

    /// Goes through the pixels that have a patch to compare, from the first or from the last.
    fn each(&self, ahead: bool, mut act: impl FnMut(usize, usize, usize, &Patch)) {
        let (w, h) = (self.grey.width, self.grey.height);
        for k in 0..w * h {
            let i = if ahead { k } else { w * h - 1 - k };
            let (x, y) = (i % w, i / w);
            if self.grey.holds(x, y)
                && let Some(patch) = Patch::new(self.grey, x, y)
            {
                act(i, x, y, &patch);
            }
        }
    }

    /// Takes a plane for a pixel if photos are more alike on it than on the one it has.
    fn offer(&self, found: &mut Depths, i: usize, at: (usize, usize), patch: &Patch, plane: Plane) {
        if plane.near >= self.bounds.0 && plane.near <= self.bounds.1 {
            let score = support(&self.sources, patch, at.0, at.1, plane);
            if score > found.scores[i] {
                (found.planes[i], found.scores[i]) = (plane, score);
            }
        }
    }
}

/// Least and largest that one over the depth may be: somewhat beyond what the points say.
fn bounds(sightings: &[(Vec2, f32)]) -> (f32, f32) {
    let mut sorted: Vec<f32> = sightings.iter().map(|s| s.1).collect();
    sorted.sort_by(f32::total_cmp);
    let few = sorted.len() / 50;
    (0.5 * sorted[few], 2.0 * sorted[sorted.len() - 1 - few])
}

/// How alike the photos that show the plane best are on it; -1 if too few show it.
fn support(sources: &[Source], patch: &Patch, x: usize, y: usize, plane: Plane) -> f32 {
    let wanted = BEST.min(sources.len());
    let mut best = [-1.0f32; BEST];
    for source in sources {
        let Some(alike) = source.alike(patch, x, y, plane) else { continue };
        if alike > best[0] {
            best = [alike, best[0]];
        } else if alike > best[1] {
            best[1] = alike;
        }
    }
    best[..wanted].iter().sum::<f32>() / wanted as f32
}

/// Planes to start with, by the points that the photo saw.
struct Starts {
    across: usize,
    cells: Vec<Cell>,
}

struct Cell {
    /// The plane through the points around, at the cell's middle.
    fit: Plane,
    /// One over the depths of these points, nearest first.
    nears: Vec<f32>,
}

impl Starts {
    fn new(frame: &Frame) -> Starts {
        let (w, h) = (frame.coarse.width, frame.coarse.height);
        let sightings: Vec<(Vec2, f32)> = frame.sightings.iter().map(|&(p, near)| (0.5 * p, near)).collect();
        let (across, down) = (w.div_ceil(CELL), h.div_ceil(CELL));
        let middle = |k: usize| (k * CELL) as f32 + 0.5 * CELL as f32;
        let mut cells = Vec::with_capacity(across * down);
        let mut order: Vec<(f32, usize)> = Vec::new();
        for j in 0..down {
            for i in 0..across {
                let at = Vec2::new(middle(i), middle(j));
                order.clear();
                order.extend(sightings.iter().enumerate().map(|(k, s)| (s.0.distance_squared(at), k)));
                let count = AROUND.min(order.len());
                if count < order.len() {
                    order.select_nth_unstable_by(count, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
                }
                order.truncate(count);
                order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
                let around: Vec<(Vec2, f32)> = order.iter().map(|&(_, k)| sightings[k]).collect();
                cells.push(Cell { fit: fit(&around, at), nears: around.iter().map(|s| s.1).collect() });
            }
        }
        Starts { across, cells }
    }

    /// For a pixel: the plane through the points around it, the nearest point's depth, and that of any of them.
    fn planes(&self, x: usize, y: usize, random: &mut Random) -> [Plane; 3] {
        let (i, j) = (x / CELL, y / CELL);
        let cell = &self.cells[j * self.across + i];
        let off = |k: usize, at: usize| at as f32 + 0.5 - (k as f32 + 0.5) * CELL as f32;
        let flat = |near: f32| Plane { near, slope: [0.0; 2] };
        let any = cell.nears[random.below(cell.nears.len())];
        [cell.fit.at(off(i, x), off(j, y)), flat(cell.nears[0]), flat(any)]
    }
}

/// The plane, seen from `at`, that fits best what lies around; points twice as far count for a quarter.
fn fit(around: &[(Vec2, f32)], at: Vec2) -> Plane {
    // Few points, or points on a line, leave slopes at 0: the ridge holds them there.
    const RIDGE: f32 = 1.0;
    let (mut total, mut mean, mut middle) = (0.0f32, 0.0f32, Vec2::ZERO);
    let weight = |p: Vec2| 1.0 / (1.0 + (p - at).length_squared() / 16.0);
    for &(p, near) in around {
        total += weight(p);
        mean += weight(p) * near;
        middle += weight(p) * (p - at);
    }
    mean /= total;
    middle /= total;
    let (mut xx, mut xy, mut yy, mut xn, mut yn) = (RIDGE, 0.0f32, RIDGE, 0.0f32, 0.0f32);
    for &(p, near) in around {
        let (d, n, k) = (p - at - middle, near - mean, weight(p));
        xx += k * d.x * d.x;
        xy += k * d.x * d.y;
        yy += k * d.y * d.y;
        xn += k * d.x * n;
        yn += k * d.y * n;
    }
    let det = xx * yy - xy * xy;
    let slope = [(xn * yy - yn * xy) / det, (yn * xx - xn * xy) / det];
    Plane { near: mean, slope }.at(-middle.x, -middle.y)
}
