//! Depths of one photo's pixels.

use crate::frame::{Grey, StereoFrame};
use crate::plane::{DepthPlane, Patch, SourceView};
use glam::Vec2;
use segwild_scene::Random;

/// Sweeps over the photo at half its size, each from the other corner.
const SWEEPS: usize = 3;
/// Below this matching score at half the size, no plane is searched at full size.
const HOPELESS: f32 = 0.3;
/// How far a plane is perturbed at random in the first sweep, as a share of its inverse depth; half as far in each later one.
const JITTER: f32 = 0.04;
/// And how often in a sweep.
const JITTERED: usize = 1;
/// The same at full size, and how often; each time .7 as far.
const FINE_JITTER: f32 = 0.01;
const TRIALS: i32 = 5;
/// So many of the other photos must match: in the rest the surface may be occluded.
const BEST: usize = 2;
/// Pixels along a side of the cells in which planes start alike.
const CELL: usize = 4;
/// Points that an initial plane is fitted to.
const AROUND: usize = 8;

/// Depths of one of four pixels of a photo: rows as wide as the photo at half its size.
pub(crate) struct Depths {
    /// The plane on which other photos match best, at [`Depths::pixel`].
    pub planes: Vec<DepthPlane>,
    /// Its matching score, in [-1, 1]; -1 where nothing is known.
    pub scores: Vec<f32>,
}

impl Depths {
    /// The pixel of the photo that an entry stands for.
    pub fn pixel(x: usize, y: usize) -> (usize, usize) {
        (2 * x + 1, 2 * y + 1)
    }
}

/// The depths of a photo's pixels by comparison with others: at half its size from the points that it saw, then, for one
/// of four pixels, at full size from there.
pub(crate) fn depths(frame: &StereoFrame, others: &[&StereoFrame], seed: u64) -> Depths {
    let (w, h) = (frame.coarse.width, frame.coarse.height);
    let n = w * h;
    let mut found =
        Depths { planes: vec![DepthPlane { near: 0.0, slope: [0.0; 2] }; n], scores: vec![-1.0; n] };
    if others.is_empty() || frame.sightings.is_empty() {
        return found;
    }
    let bounds = bounds(&frame.sightings);
    let level = |of: for<'a> fn(&'a StereoFrame) -> &'a Grey| {
        let here = (of(frame), &frame.pose);
        let sources = others.iter().map(|other| SourceView::new(here, (of(other), &other.pose))).collect();
        SweepLevel { grey: of(frame), sources, bounds }
    };
    let mut random = Random::stream(seed, 0x57e2e0);
    let starts = Starts::new(frame);
    let half = level(|f| &f.coarse);
    half.each(true, |i, x, y, patch| {
        if frame.shows(Depths::pixel(x, y)) {
            let planes = starts.planes(x, y, &mut random);
            found.planes[i] = planes[0];
            for plane in planes {
                half.propose(&mut found, i, (x, y), patch, plane);
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
        let plane = DepthPlane { slope: plane.slope.map(|s| 0.5 * s), ..plane };
        full.propose(&mut found, i, (px, py), &patch, plane);
        for trial in 0..TRIALS {
            let plane = jittered(found.planes[i], FINE_JITTER * 0.7f32.powi(trial), &mut random);
            full.propose(&mut found, i, (px, py), &patch, plane);
        }
    }
    found
}

/// A plane perturbed at random, by a share `by` of its inverse depth.
fn jittered(plane: DepthPlane, by: f32, random: &mut Random) -> DepthPlane {
    let mut draw = || by * (2.0 * random.uniform() - 1.0);
    let near = plane.near * (1.0 + draw());
    DepthPlane { near, slope: plane.slope.map(|s| s + 0.5 * near * draw()) }
}

/// A photo at one size, with the others beside it.
struct SweepLevel<'a> {
    grey: &'a Grey,
    sources: Vec<SourceView<'a>>,
    /// Least and largest inverse depth.
    bounds: (f32, f32),
}

impl SweepLevel<'_> {
    /// Proposes to every pixel the planes of its neighbours, and its own perturbed.
    fn sweep(&self, found: &mut Depths, ahead: bool, jitter: f32, random: &mut Random) {
        let step = if ahead { -1i32 } else { 1 };
        self.each(ahead, |i, x, y, patch| {
            // It does not show the scene.
            if found.planes[i].near <= 0.0 {
                return;
            }
            let beside = (i as i32 + step) as usize;
            let above = (i as i32 + step * self.grey.width as i32) as usize;
            for (j, dx, dy) in [(beside, -step, 0), (above, 0, -step)] {
                if found.scores[j] > -1.0 {
                    let plane = found.planes[j].at(dx as f32, dy as f32);
                    self.propose(found, i, (x, y), patch, plane);
                }
            }
            for _ in 0..JITTERED {
                let plane = jittered(found.planes[i], jitter, random);
                self.propose(found, i, (x, y), patch, plane);
            }
        });
    }

    /// Visits the pixels that have a patch to compare, from the first or from the last.
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

    /// Takes a plane for a pixel if photos match better on it than on the one it has.
    fn propose(&self, found: &mut Depths, i: usize, at: (usize, usize), patch: &Patch, plane: DepthPlane) {
        if plane.near >= self.bounds.0 && plane.near <= self.bounds.1 {
            let score = support(&self.sources, patch, at.0, at.1, plane);
            if score > found.scores[i] {
                (found.planes[i], found.scores[i]) = (plane, score);
            }
        }
    }
}

/// Least and largest inverse depth: somewhat beyond those of the points.
fn bounds(sightings: &[(Vec2, f32)]) -> (f32, f32) {
    let mut sorted: Vec<f32> = sightings.iter().map(|s| s.1).collect();
    sorted.sort_by(f32::total_cmp);
    let few = sorted.len() / 50;
    (0.5 * sorted[few], 2.0 * sorted[sorted.len() - 1 - few])
}

/// Mean matching score of the photos that match best on the plane; -1 if too few show it.
fn support(sources: &[SourceView], patch: &Patch, x: usize, y: usize, plane: DepthPlane) -> f32 {
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

/// Initial planes, from the points that the photo observes.
struct Starts {
    across: usize,
    cells: Vec<StartCell>,
}

struct StartCell {
    /// The plane through the points around, at the cell's middle.
    fit: DepthPlane,
    /// Inverse depths of these points, nearest first.
    nears: Vec<f32>,
}

impl Starts {
    fn new(frame: &StereoFrame) -> Starts {
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
                cells.push(StartCell { fit: fit(&around, at), nears: around.iter().map(|s| s.1).collect() });
            }
        }
        Starts { across, cells }
    }

    /// For a pixel: the plane through the points around it, the nearest point's depth, and that of any of them.
    fn planes(&self, x: usize, y: usize, random: &mut Random) -> [DepthPlane; 3] {
        let (i, j) = (x / CELL, y / CELL);
        let cell = &self.cells[j * self.across + i];
        let off = |k: usize, at: usize| at as f32 + 0.5 - (k as f32 + 0.5) * CELL as f32;
        let flat = |near: f32| DepthPlane { near, slope: [0.0; 2] };
        let any = cell.nears[random.below(cell.nears.len())];
        [cell.fit.at(off(i, x), off(j, y)), flat(cell.nears[0]), flat(any)]
    }
}

/// The plane, seen from `at`, that fits best what lies around; points twice as far count for a quarter.
fn fit(around: &[(Vec2, f32)], at: Vec2) -> DepthPlane {
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
    DepthPlane { near: mean, slope }.at(-middle.x, -middle.y)
}
