//! How the world of imported splats lies in that of the camera poses.
//!
//! Most programs keep the reconstruction's world. Some move it before they train (nerfstudio, gsplat), some files are turned
//! by hand or by a viewer's convention. What a file says of itself is not enough: candidates are compared with the points of the
//! reconstruction, the nearest are registered to them, and what shows the photos best is taken.

use super::registration::Registration;
use crate::TrainError;
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use segwild_nn::eigen;
use segwild_scene::knn::NearestPoint;
use segwild_scene::statistics::median;
use segwild_scene::{ImportedSplats, Scene, Similarity, Splats};
use serde::Deserialize;
use std::path::Path;

/// Points and splats that are compared, at most.
const POINTS: usize = 600;
const CENTRES: usize = 100_000;
/// Fewer points than these are not compared.
const LEAST_POINTS: usize = 50;
/// Opacity from which a splat counts as a surface.
const OPAQUE: f32 = 0.3;
/// Candidates that are compared with photos.
const COMPARED: usize = 6;
/// Sizes of splats that were moved in any way, as multiples of that by which their median distance is that of the points.
const SIZES: [f64; 3] = [0.7, 1.0, 1.4];
/// Share of the photos' variance that splats explain in a frame that is taken without others being tried, and the least share
/// in a world that is exactly a program's. In the true frame trained splats explain .90 to .99 of captured scenes, in such worlds
/// that are not theirs .25 at most (docs/experiments/2026-11-29-imported-splats.md).
const PLAIN: f64 = 0.75;
const LEAST: f64 = 0.4;
/// First steps of the search around a registered frame: radians, share of the scene's extent, logarithm of the scale. They are
/// halved so many times.
const STEPS: [f64; 3] = [0.04, 0.03, 0.04];
const HALVINGS: i32 = 6;
/// Rounds of the search at most, each of a trial in both directions of seven unknowns.
const ROUNDS: usize = 20;

/// A way in which the splats' world may lie.
#[derive(Clone, Debug)]
struct FrameCandidate {
    /// From the splats' world to the poses', in units of the reconstruction.
    to: Similarity,
    /// Whose convention it is, in words.
    what: String,
    /// Whether it was fitted to points or photos, which may end in a wrong frame: then the splats must explain [`PLAIN`].
    fitted: bool,
}

impl FrameCandidate {
    fn of(to: Similarity, what: impl Into<String>) -> FrameCandidate {
        FrameCandidate { to, what: what.into(), fitted: false }
    }
}

/// The frame that was found.
#[derive(Clone, Debug)]
pub(super) struct FoundFrame {
    /// From the splats' world to the poses', in units of the reconstruction.
    pub to: Similarity,
    /// What was found, in words.
    pub note: String,
}

/// Finds the frame. `explained` returns the share of the photos' variance that
/// the splats explain in a frame.
pub(super) fn find(
    scene: &Scene,
    splats: &Splats,
    imported: &ImportedSplats,
    explained: &mut dyn FnMut(&Similarity) -> Result<f64, TrainError>,
) -> Result<FoundFrame, TrainError> {
    if imported.frame != "auto" {
        let to = match &*imported.frame {
            "poses" => Similarity::IDENTITY,
            file => read_transform(Path::new(file))?,
        };
        let note = format!("the splats lie as --imported-frame says: {}", words(&to, explained(&to)?));
        return Ok(FoundFrame { to, note });
    }
    if imported.rendered {
        let to = Similarity::IDENTITY;
        let note = format!("the photos are views of the splats: {}", words(&to, explained(&to)?));
        return Ok(FoundFrame { to, note });
    }
    let own = FrameCandidate::of(Similarity::IDENTITY, "the poses' world");
    let mut tried = vec![(explained(&own.to)?, own)];
    if tried[0].0 < PLAIN {
        for candidate in nearest(scene, splats, candidates(scene, imported)) {
            tried.push((explained(&candidate.to)?, candidate));
        }
        tried.sort_by(|a, b| b.0.total_cmp(&a.0));
    }
    let taken = |share: f64, fitted: bool| share >= if fitted { PLAIN } else { LEAST };
    let (share, best) = &tried[0];
    if !taken(*share, best.fitted) {
        let (share, to) = searched(scene, *share, best.to, explained)?;
        let what = best.what.clone();
        tried.insert(0, (share, FrameCandidate { to, what, fitted: true }));
    }
    let most = tried[0].0;
    let Some((share, FrameCandidate { to, what, .. })) =
        tried.into_iter().find(|(share, candidate)| taken(*share, candidate.fitted))
    else {
        return Err(TrainError::Frame(format!(
            "the splats show at most {:.0} % of what the photos show, in every way their world may lie: they are of another \
             scene, or were moved by hand; --imported-frame FILE gives the transform in the form of nerfstudio's dataparser_transforms.json",
            100.0 * most.max(0.0)
        )));
    };
    Ok(FoundFrame { to, note: format!("the splats lie in {what}: {}", words(&to, share)) })
}

/// A frame near `to` in which the splats explain more, by trials in both directions of each of its seven unknowns.
fn searched(
    scene: &Scene,
    share: f64,
    to: Similarity,
    explained: &mut dyn FnMut(&Similarity) -> Result<f64, TrainError>,
) -> Result<(f64, Similarity), TrainError> {
    let (extent, centre) = (scene.frame.scale, scene.frame.origin);
    let mut best = (share, to);
    let mut size = 1.0;
    for _ in 0..ROUNDS {
        let before = best.0;
        for unknown in 0..7 {
            for sign in [size, -size] {
                let change = changed(unknown, sign, extent, centre);
                let to = change.after(&best.1);
                let share = explained(&to)?;
                if share > best.0 {
                    best = (share, to);
                    break;
                }
            }
        }
        if best.0 <= before {
            size *= 0.5;
        }
        if size < 0.5f64.powi(HALVINGS) {
            break;
        }
    }
    Ok(best)
}

/// The change of one unknown by so many of its first steps: three rotations about the middle of the cameras, three
/// translations, the scale.
fn changed(unknown: usize, steps: f64, extent: f64, centre: DVec3) -> Similarity {
    let axis = [DVec3::X, DVec3::Y, DVec3::Z][unknown % 3];
    let [turn, shift, growth] = STEPS.map(|step| step * steps);
    let around = |rotation: DMat3, scale: f64| Similarity {
        rotation,
        scale,
        translation: centre - rotation * centre * scale,
    };
    match unknown / 3 {
        0 => around(DMat3::from_axis_angle(axis, turn), 1.0),
        1 => Similarity { translation: axis * shift * extent, ..Similarity::IDENTITY },
        _ => around(DMat3::IDENTITY, growth.exp()),
    }
}

fn words(to: &Similarity, share: f64) -> String {
    format!("{}; they explain {:.0} % of the photos' variance", to.in_words(), 100.0 * share)
}

/// The candidates that lie nearest to the points of the reconstruction, registered to them; all where there are too few points.
fn nearest(scene: &Scene, splats: &Splats, mut candidates: Vec<FrameCandidate>) -> Vec<FrameCandidate> {
    let opaque: Vec<usize> = (0..splats.len()).filter(|&i| splats.opacity(i) > OPAQUE).collect();
    let every = |count: usize, most: usize| count.div_ceil(most).max(1);
    let step = every(opaque.len(), CENTRES);
    let centres: Vec<[f32; 3]> = opaque.iter().step_by(step).map(|&i| splats.means[i]).collect();
    let points: Vec<DVec3> = scene
        .points
        .iter()
        .step_by(every(scene.points.len(), POINTS))
        .map(|point| point.position.as_dvec3() * scene.frame.scale + scene.frame.origin)
        .collect();
    if points.len() < LEAST_POINTS || centres.len() < LEAST_POINTS {
        return candidates;
    }
    candidates.extend(by_axes(&centres, &points));
    let registration = Registration { centres: &centres, tree: NearestPoint::of(&centres), points };
    let measured = |candidate: FrameCandidate| (registration.residual(&candidate.to), candidate);
    let mut all: Vec<(f64, FrameCandidate)> = candidates
        .into_par_iter()
        .flat_map_iter(|candidate| {
            let to = registration.refined(&candidate.to);
            let what = format!("{}, registered to the points", candidate.what);
            [measured(candidate), measured(FrameCandidate { to, what, fitted: true })]
        })
        .collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut kept: Vec<FrameCandidate> = Vec::new();
    for (_, candidate) in all {
        let again = |other: &FrameCandidate| {
            let extent = scene.frame.scale;
            let corners =
                [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z].map(|p| p * extent + scene.frame.origin);
            let moved = |p: DVec3| (candidate.to.apply(other.to.inverse().apply(p)) - p).length();
            corners.into_iter().all(|p| moved(p) < 1e-3 * extent)
        };
        if !kept.iter().any(again) {
            kept.push(candidate);
        }
        if kept.len() == COMPARED {
            break;
        }
    }
    kept
}

/// The conventions of programs, from the poses and the points.
fn candidates(scene: &Scene, imported: &ImportedSplats) -> Vec<FrameCandidate> {
    let mut all = Vec::new();
    for path in imported.transform_files() {
        if let Ok(to) = read_transform(&path) {
            all.push(FrameCandidate::of(to, format!("the world of {}", path.display())));
        }
    }
    let rig = Rig::of(scene);
    all.extend(nerfstudio(&rig));
    all.extend(gsplat(&rig));
    let turned = axis_turns()
        .into_iter()
        .map(|turn| FrameCandidate::of(Similarity::turn(turn), "the poses' world, its axes exchanged"));
    all.extend(turned.filter(|candidate| candidate.to != Similarity::IDENTITY));
    all
}

/// The 24 rotations that lead axes to axes.
fn axis_turns() -> Vec<DMat3> {
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    let signed = |k: usize| [axes[k], -axes[k]];
    (0..3)
        .flat_map(|i| (0..3).filter(move |&j| j != i).map(move |j| (i, j)))
        .flat_map(|(i, j)| signed(i).into_iter().flat_map(move |a| signed(j).map(|b| (a, b))))
        .map(|(a, b)| DMat3::from_cols(a, b, a.cross(b)))
        .collect()
}

/// The cameras and points of a scene, in units of the reconstruction.
struct Rig {
    /// Per photo its centre, and the directions of its right, down and ahead.
    cameras: Vec<(DVec3, DMat3)>,
    points: Vec<DVec3>,
}

impl Rig {
    fn of(scene: &Scene) -> Rig {
        let to_file = |p: glam::Vec3| p.as_dvec3() * scene.frame.scale + scene.frame.origin;
        let cameras = scene.views.iter().map(|view| {
            let axes = view.pose.rotation.transpose().as_dmat3();
            (to_file(view.pose.centre()), axes)
        });
        Rig {
            cameras: cameras.collect(),
            points: scene.points.iter().map(|point| to_file(point.position)).collect(),
        }
    }

    fn mean_up(&self) -> DVec3 {
        self.cameras.iter().map(|(_, axes)| -axes.y_axis).sum::<DVec3>().normalize_or(DVec3::NEG_Y)
    }
}

/// nerfstudio's world: up is z, the mean of the cameras the origin, and the farthest coordinate of a camera 1
/// (`auto_orient_and_center_poses`, `auto_scale_poses`).
fn nerfstudio(rig: &Rig) -> Vec<FrameCandidate> {
    // What `ns-process-data` and the parsers do to COLMAP's axes first: since 2024, before, and not at all.
    let applied = [
        DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y),
        DMat3::from_cols(DVec3::Y, DVec3::X, DVec3::NEG_Z),
        DMat3::IDENTITY,
    ];
    let count = rig.cameras.len().max(1) as f64;
    let candidate = |applied: DMat3| {
        let up = applied * rig.mean_up();
        let turn = DMat3::from_quat(glam::DQuat::from_rotation_arc(up, DVec3::Z)) * applied;
        let centre = rig.cameras.iter().map(|(centre, _)| turn * *centre).sum::<DVec3>() / count;
        let largest = rig.cameras.iter().map(|(own, _)| (turn * *own - centre).abs().max_element());
        let scale = 1.0 / largest.fold(0.0, f64::max);
        let from_poses = Similarity { rotation: turn, scale, translation: -centre * scale };
        FrameCandidate::of(from_poses.inverse(), "nerfstudio's world")
    };
    applied.into_iter().map(candidate).filter(|candidate| candidate.to.scale.is_finite()).collect()
}

/// gsplat's world (`normalize_world_space`): cameras upright around what they see, then the principal axes of the points. The
/// signs of the axes are arbitrary.
fn gsplat(rig: &Rig) -> Vec<FrameCandidate> {
    let turn = DMat3::from_quat(glam::DQuat::from_rotation_arc(rig.mean_up(), DVec3::NEG_Y));
    let cameras = rig.cameras.iter().map(|(centre, axes)| (turn * *centre, turn * axes.z_axis));
    let nearest: Vec<DVec3> = cameras.clone().map(|(t, f)| t + f * f.dot(-t)).collect();
    let focus = median_point(&nearest);
    let scale = 1.0 / middle(cameras.map(|(t, _)| (t - focus).length()));
    let upright = Similarity { rotation: turn, scale, translation: -focus * scale };
    let points: Vec<DVec3> = rig.points.iter().map(|p| upright.apply(*p)).collect();
    if points.len() < LEAST_POINTS || !scale.is_finite() {
        return Vec::new();
    }
    let centre = median_point(&points);
    let axes = principal_axes(&points);
    let mut all = vec![FrameCandidate::of(upright.inverse(), "gsplat's world")];
    for signs in [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]] {
        let [a, b] = signs;
        let rotation = DMat3::from_diagonal(DVec3::new(a, b, a * b)) * axes.transpose();
        let aligned = Similarity { rotation, scale: 1.0, translation: -(rotation * centre) };
        all.push(FrameCandidate::of(aligned.after(&upright).inverse(), "gsplat's world"));
    }
    all
}

/// The worlds in which the principal axes and the sizes of splats and points are the same: for splats that were moved in any way.
fn by_axes(centres: &[[f32; 3]], points: &[DVec3]) -> Vec<FrameCandidate> {
    let centres: Vec<DVec3> = centres.iter().map(|p| DVec3::from(p.map(f64::from))).collect();
    let [(from, own, own_size), (to, axes, size)] = [&centres[..], points].map(|cloud| {
        let centre = median_point(cloud);
        // What lies far off has no part in the axes.
        let size = middle(cloud.iter().map(|p| (*p - centre).length()));
        let near: Vec<DVec3> =
            cloud.iter().copied().filter(|p| (*p - centre).length() <= 2.0 * size).collect();
        (centre, principal_axes(&near), size)
    });
    let candidate = |turn: DMat3, factor: f64| {
        let (rotation, scale) = (axes * turn * own.transpose(), factor * size / own_size);
        let to = Similarity { rotation, scale, translation: to - rotation * from * scale };
        FrameCandidate { to, what: "a world of its own".to_owned(), fitted: true }
    };
    let all = axis_turns().into_iter().flat_map(|turn| SIZES.map(|factor| candidate(turn, factor)));
    all.filter(|candidate| candidate.to.scale.is_finite() && candidate.to.scale > 0.0).collect()
}

/// The principal axes of points as columns, the longest first, a right-handed system.
fn principal_axes(points: &[DVec3]) -> DMat3 {
    let centre = points.iter().sum::<DVec3>() / points.len().max(1) as f64;
    let mut sums = vec![0.0; 9];
    for p in points {
        let d = *p - centre;
        for i in 0..3 {
            for j in 0..3 {
                sums[3 * i + j] += d[i] * d[j];
            }
        }
    }
    let (_, rows) = eigen::symmetric(sums, 3);
    let axis = |k: usize| DVec3::new(rows[3 * k], rows[3 * k + 1], rows[3 * k + 2]);
    DMat3::from_cols(axis(0), axis(1), axis(0).cross(axis(1)))
}

/// The median of each coordinate.
fn median_point(points: &[DVec3]) -> DVec3 {
    DVec3::from_array([0, 1, 2].map(|k| middle(points.iter().map(|p| p[k]))))
}

/// The median, NaN of nothing, as NumPy has it.
fn middle(values: impl Iterator<Item = f64>) -> f64 {
    median(values.collect()).unwrap_or(f64::NAN)
}

/// nerfstudio's file: `p_splats = scale * transform * p_poses`.
#[derive(Deserialize)]
struct DataparserTransforms {
    transform: [[f64; 4]; 3],
    scale: f64,
}

/// The way from the splats' world to the poses' that such a file gives.
fn read_transform(path: &Path) -> Result<Similarity, TrainError> {
    let refuse = |reason: String| TrainError::Frame(format!("{}: {reason}", path.display()));
    let bytes = segwild_flow::files::read_plain(path).map_err(|e| refuse(e.to_string()))?;
    let DataparserTransforms { transform, scale } = serde_json::from_slice(&bytes)
        .map_err(|e| refuse(format!("it gives no `transform` and `scale`: {e}")))?;
    let rows = transform.map(|[a, b, c, _]| DVec3::new(a, b, c));
    let matrix = DMat3::from_cols(rows[0], rows[1], rows[2]).transpose();
    // A reader may have scaled the poses before, so that the matrix is no rotation alone.
    let own = matrix.determinant().cbrt();
    let rotation = matrix * (1.0 / own);
    let orthogonal = (rotation * rotation.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-3);
    let translation = DVec3::from_array(transform.map(|row| row[3]));
    if !(own > 0.0 && scale > 0.0 && scale.is_finite() && orthogonal && translation.is_finite()) {
        return Err(refuse("its transform is no rotation with a translation and a scale".into()));
    }
    Ok(Similarity { rotation, scale: own * scale, translation: translation * scale }.inverse())
}
