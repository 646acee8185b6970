//! Surfaces that run on under and past what stands on them: ground, tables, walls (method, section 13).
//!
//! The trees have no group for them: outlines of what stands there, joints and shadows part a surface before it parts from the
//! things. So they are found by their shape. A surface is flat, the photos' frames cut it off, and things stand before it.

use super::graph::SplatGraph;
use super::node_surface::NodeSurface;
use super::tree::SceneSurface;
use crate::svd;
use glam::{DMat3, DVec3, Vec3};

/// How far before its plane a surface reaches, in sides there ([`NodeSurface::side`]): at most, and at least (method, section 13). By choice.
const MAX_THICKNESS: f32 = 8.0;
const MIN_THICKNESS: f32 = 2.0;

/// That reach, in median distances of its nodes from the plane (method, section 13). By choice.
const THICKNESS_MEDIANS: f32 = 3.0;

/// How far past its plane a surface reaches, on the side that no view sees, relative to the reach before it (method, section 13):
/// nothing is seen through it, so that what lies there is its own noise. By choice.
const REACH_PAST: f32 = 8.0;

/// Cosine of the largest angle of a node's normal with the plane's (method, section 13): 45 degrees. By choice.
const MIN_FACING: f32 = std::f32::consts::FRAC_1_SQRT_2;

/// Least share of all light that a surface has (method, section 13). By choice: what is smaller is a thing, or a part of one.
const MIN_SURFACE_AREA: f32 = 0.05;

/// Least share of its outline that lies on the photos' frames (method, section 13). From
/// docs/experiments/2026-11-30-surfaces.md.
pub(super) const MIN_SURFACE_FRAME: f32 = 0.1;

/// Least share of the occlusions at its outline in which it is the farther side, less that in which it is the nearer one (method,
/// section 13). From docs/experiments/2026-11-30-surfaces.md.
const MIN_FARTHER: f32 = 0.2;

/// Planes that are tried, at most.
const MOST_PLANES: usize = 6;

/// Nodes whose planes are compared, and nodes that vote for one. By choice.
const CANDIDATES: usize = 400;
const VOTERS: usize = 8192;

/// Fits of a plane to the nodes near it. By choice: it hardly moves after five.
const FITS: usize = 10;

/// Rounds in which gaps are filled and single nodes left out (method, section 13), and the shares of a node's neighbours that must
/// belong to the surface: for one on the plane that faces elsewhere, for one near the plane, and for one that stays. By choice.
const FILL_ROUNDS: usize = 3;
const SHARE_ON_PLANE: f32 = 0.3;
const SHARE_NEAR_PLANE: f32 = 0.5;
const SHARE_OF_MEMBERS: f32 = 0.15;

/// Reach of what is near the plane, relative to that of what is on it: before it, and behind it.
const NEAR_BEFORE: f32 = 1.5;
const NEAR_PAST: f32 = 2.0;

/// A plane with the side that the cameras see.
#[derive(Clone, Copy, Debug)]
struct Plane {
    point: Vec3,
    normal: Vec3,
    /// How far before it a surface reaches, in sides.
    thickness: f32,
}

impl Plane {
    /// Distance of a surface before it, in sides there; negative behind it.
    fn before(&self, surface: &NodeSurface) -> f32 {
        (surface.point - self.point).dot(self.normal) / surface.side
    }

    fn faces(&self, surface: &NodeSurface) -> bool {
        surface.normal.is_some_and(|normal| normal.dot(self.normal) > MIN_FACING)
    }
}

impl SplatGraph {
    /// The surfaces of the scene. No node belongs to two.
    pub(super) fn find_surfaces(&self) -> Vec<SceneSurface> {
        let nodes = &self.surfaces[..];
        let all: f32 = self.areas.iter().sum();
        let mut free = vec![true; nodes.len()];
        let mut found = Vec::new();
        for _ in 0..MOST_PLANES {
            let Some(plane) = self.largest_plane(nodes, &free, MIN_SURFACE_AREA * all) else { break };
            let inside = self.on_plane(nodes, &free, &plane);
            let faces = |i: usize| nodes[i].as_ref().is_some_and(|surface| plane.faces(surface));
            let surface = self.described_surface(&inside, faces, all);
            // What is no surface is a thing's side: no other plane takes it.
            free.iter_mut().zip(&inside).for_each(|(free, inside)| *free &= !inside);
            if !inside.contains(&true) {
                break;
            }
            if surface.area >= MIN_SURFACE_AREA
                && surface.frame >= MIN_SURFACE_FRAME
                && surface.farther >= MIN_FARTHER
            {
                found.push(surface);
            }
        }
        found
    }

    /// The plane that holds most light of free nodes, fitted to them; `None` where it has less than half of `least`.
    fn largest_plane(&self, nodes: &[Option<NodeSurface>], free: &[bool], least: f32) -> Option<Plane> {
        let light: Vec<f64> = (0..nodes.len())
            .map(|i| if free[i] && nodes[i].is_some() { f64::from(self.areas[i]) } else { 0.0 })
            .collect();
        let voters: Vec<&NodeSurface> = sampled(&light, VOTERS).filter_map(|i| nodes[i].as_ref()).collect();
        let votes = |plane: &Plane| {
            let on =
                |voter: &&&NodeSurface| plane.before(voter).abs() < plane.thickness && plane.faces(voter);
            voters.iter().filter(on).count()
        };
        let of = |surface: &NodeSurface| {
            let normal = surface.normal?;
            let plane = Plane { point: surface.point, normal, thickness: 0.5 * MAX_THICKNESS };
            Some((votes(&plane), plane))
        };
        let mut best: Option<(usize, Plane)> = None;
        for (votes, plane) in sampled(&light, CANDIDATES).filter_map(|i| of(nodes[i].as_ref()?)) {
            if best.is_none_or(|(most, _)| votes > most) {
                best = Some((votes, plane));
            }
        }
        let (votes, first) = best?;
        let held = light.iter().sum::<f64>() * votes as f64 / voters.len() as f64;
        (held >= f64::from(0.5 * least)).then(|| self.fitted(nodes, free, first))
    }

    /// A plane fitted to the free nodes near it, pixels of all sizes alike, and as thick as they say.
    fn fitted(&self, nodes: &[Option<NodeSurface>], free: &[bool], first: Plane) -> Plane {
        let mut plane = Plane { thickness: MAX_THICKNESS, ..first };
        for _ in 0..FITS {
            let near = |i: usize| {
                let surface = nodes[i].as_ref().filter(|surface| free[i] && plane.faces(surface))?;
                let distance = plane.before(surface).abs();
                (distance < 2.0 * MAX_THICKNESS).then_some((distance, self.areas[i], surface))
            };
            let mut members: Vec<(f32, f32, &NodeSurface)> = (0..nodes.len()).filter_map(near).collect();
            members.retain(|(distance, ..)| *distance < plane.thickness);
            members.sort_by(|a, b| a.0.total_cmp(&b.0));
            let half = 0.5 * members.iter().map(|m| f64::from(m.1)).sum::<f64>();
            let mut sum = 0.0;
            let median = members.iter().find(|m| {
                sum += f64::from(m.1);
                sum >= half
            });
            let Some(median) = median.map(|m| m.0) else { return plane };
            let thickness = (THICKNESS_MEDIANS * median).clamp(MIN_THICKNESS, MAX_THICKNESS);
            members.retain(|(distance, ..)| *distance < thickness);
            // What is near the cameras says more exactly where it lies.
            let weight = |area: f32, side: f32| f64::from(area) / f64::from(side).powi(2);
            let weighted = members.iter().map(|&(_, area, s)| (weight(area, s.side), s.point.as_dvec3()));
            let (mut total, mut centre) = (0.0, DVec3::ZERO);
            weighted.clone().for_each(|(w, p)| (total, centre) = (total + w, centre + w * p));
            centre /= total;
            let mut spread = DMat3::ZERO;
            for (w, p) in weighted {
                let d = p - centre;
                spread += DMat3::from_cols(d * d.x, d * d.y, d * d.z) * (w / total);
            }
            let (axes, lengths) = svd::left(spread);
            let thinnest = (0..3).min_by(|&a, &b| lengths[a].total_cmp(&lengths[b])).unwrap_or(2);
            let normal = axes.col(thinnest).as_vec3();
            if !normal.is_finite() || !centre.is_finite() {
                return plane;
            }
            let normal = if normal.dot(plane.normal) < 0.0 { -normal } else { normal };
            plane = Plane { point: centre.as_vec3(), normal, thickness };
        }
        plane
    }

    /// The free nodes on a plane: those that face as it does, and those among them. Nodes that no view shows follow their neighbours.
    fn on_plane(&self, nodes: &[Option<NodeSurface>], free: &[bool], plane: &Plane) -> Vec<bool> {
        let within = |i: usize, before: f32, past: f32| match &nodes[i] {
            Some(surface) => {
                let (at, reach) = (plane.before(surface), plane.thickness);
                free[i] && at < before * reach && at > -past * REACH_PAST * reach
            }
            None => false,
        };
        let on: Vec<bool> = (0..nodes.len()).map(|i| within(i, 1.0, 1.0)).collect();
        let faces = |i: usize| nodes[i].as_ref().is_some_and(|surface| plane.faces(surface));
        let mut inside: Vec<bool> = on.iter().enumerate().map(|(i, &on)| on && faces(i)).collect();
        for _ in 0..FILL_ROUNDS {
            let mut shares = vec![[0.0f32; 2]; nodes.len()];
            for edge in &self.edges {
                for (from, to) in [(edge.a, edge.b), (edge.b, edge.a)] {
                    shares[from as usize][0] += f32::from(u8::from(inside[to as usize]));
                    shares[from as usize][1] += 1.0;
                }
            }
            inside = (0..nodes.len())
                .map(|i| {
                    let share = shares[i][0] / shares[i][1].max(1.0);
                    let unseen = nodes[i].is_none();
                    inside[i] && share >= SHARE_OF_MEMBERS
                        || on[i] && share > SHARE_ON_PLANE
                        || (unseen && free[i] || within(i, NEAR_BEFORE, NEAR_PAST))
                            && share > SHARE_NEAR_PLANE
                })
                .collect();
        }
        inside
    }

    /// What is known of a set of nodes, some of which face as their plane does. `all`: the light of the scene.
    fn described_surface(&self, inside: &[bool], faces: impl Fn(usize) -> bool, all: f32) -> SceneSurface {
        let leaves: Vec<u32> = (0..inside.len()).filter(|&i| inside[i]).map(|i| i as u32).collect();
        let facing = leaves.iter().copied().filter(|&leaf| faces(leaf as usize)).collect();
        let sum = |of: &[f32]| leaves.iter().map(|&i| f64::from(of[i as usize])).sum::<f64>();
        let (frame, void) = (sum(&self.frame), sum(&self.void));
        let (mut outline, mut occluding, mut farther) = (void + frame, 0.0, 0.0);
        for border in &self.borders {
            let (a, b) = (inside[border.a as usize], inside[border.b as usize]);
            if a != b {
                outline += f64::from(border.length);
                occluding += f64::from(border.occluding);
                farther += f64::from(if a { -border.nearer } else { border.nearer });
            }
        }
        let share = |of: f64, all: f64| if all > 0.0 { (of / all) as f32 } else { 0.0 };
        SceneSurface {
            area: share(sum(&self.areas), f64::from(all)),
            frame: share(frame, outline),
            farther: share(farther, occluding),
            leaves,
            facing,
        }
    }
}

/// Indices at equal steps of the sum of some weights, ascending; the heaviest may come several times. None where all are 0.
fn sampled(weights: &[f64], count: usize) -> impl Iterator<Item = usize> + '_ {
    let all: f64 = weights.iter().sum();
    let (mut at, mut sum) = (0, weights.first().copied().unwrap_or(0.0));
    let steps = if all > 0.0 { count } else { 0 };
    (0..steps).map(move |k| {
        let wanted = (k as f64 + 0.5) / count as f64 * all;
        while sum < wanted && at + 1 < weights.len() {
            at += 1;
            sum += weights[at];
        }
        at
    })
}
