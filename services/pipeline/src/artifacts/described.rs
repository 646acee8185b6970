//! Which photos masks and descriptors are made of, in scenes of more than pay (method, section 9).

use crate::DescribedPhotos;
use glam::Vec3;
use segwild_scene::view_selection::{CandidateView, ViewCoverage, cell, cells_in_frame, select_views};
use segwild_scene::{NEAR, Point, Scene, View};
use std::collections::BTreeSet;

/// Photos up to which all are described (method, section 9). By choice: more than any scene has on which masks or features were
/// measured.
pub(crate) const ALL_DESCRIBED: usize = 200;

/// Share of what a photo shows that must be new to the others, for it to be described beyond so many (method, section 9). By
/// choice: it is less from the sixth photo on that shows the same from the same directions. Not varied yet.
const MIN_NEW_SHARE: f64 = 1.0 / 16.0;

/// Points that photos are compared by, at most: those with tracks, and those that are looked for in each photo's frame.
const TRACKED_POINTS: usize = 1 << 16;
const UNTRACKED_POINTS: usize = 1 << 12;

/// Parts of a frame along each side, for scenes without tracks (method, section 9). By choice: so many points lie in a frame that
/// most parts of a surface near the camera have one. Not varied yet.
const FRAME_PARTS: usize = 16;

/// Depth of a point relative to the nearest one in its part of a frame, beyond which that one's surface occludes it (method,
/// section 9). By choice: a floor that reaches into the distance is less steep in most parts. Not varied yet.
const MAX_DEPTH_RATIO: f32 = 1.5;

/// The photos of which neither masks nor descriptors are made, of those that are `usable`: none of a scene of up to
/// `all` photos, or without points. Of another, so many are described in the order of what they add, and after those
/// each that adds enough of what it shows.
pub(crate) fn left_out(
    scene: &Scene,
    described: DescribedPhotos,
    all: usize,
    usable: &[usize],
) -> BTreeSet<usize> {
    if described == DescribedPhotos::All || usable.len() <= all || scene.points.is_empty() {
        return BTreeSet::new();
    }
    let (points, covered) = covered_cells(scene);
    let candidates: Vec<CandidateView> = usable
        .iter()
        .map(|&view| CandidateView { name: &scene.views[view].name, cells: &covered[view] })
        .collect();
    let none = ViewCoverage::none(points);
    let mut by_others = none.clone();
    let mut left_out: BTreeSet<usize> = usable.iter().copied().collect();
    for (rank, next) in select_views(&candidates, none.clone(), usable.len(), 0.0).iter().enumerate() {
        let view = usable[next.candidate];
        let cells = &covered[view];
        if rank < all || by_others.gain(cells) >= MIN_NEW_SHARE * none.gain(cells) {
            by_others.add(cells);
            left_out.remove(&view);
        }
    }
    // Photos that show no point add nothing by this measure: in even steps, they fill up.
    let missing = (all + left_out.len()).saturating_sub(usable.len());
    let rest: Vec<usize> = left_out.iter().copied().collect();
    (0..missing).for_each(|i| {
        left_out.remove(&rest[i * rest.len() / missing]);
    });
    left_out
}

/// The number of points that photos are compared by, and per view of the scene the cells that it covers: by the tracks of the
/// points, or where none has one by what lies in its frame.
fn covered_cells(scene: &Scene) -> (usize, Vec<Vec<u32>>) {
    let tracked: Vec<&Point> = scene.points.iter().filter(|point| !point.track.is_empty()).collect();
    if tracked.is_empty() {
        let sampled = evenly(scene.points.len(), UNTRACKED_POINTS);
        let points: Vec<Vec3> = sampled.map(|i| scene.points[i].position).collect();
        return (points.len(), scene.views.iter().map(|view| cells_shown(&points, view)).collect());
    }
    let mut covered = vec![Vec::new(); scene.views.len()];
    let points: Vec<&Point> = evenly(tracked.len(), TRACKED_POINTS).map(|i| tracked[i]).collect();
    for (i, point) in points.iter().enumerate() {
        for seen in &point.track {
            let view = seen.view as usize;
            covered[view].push(cell(i, scene.views[view].pose.centre() - point.position));
        }
    }
    (points.len(), covered)
}

/// The cells that a view covers, by its frame and by the points that stand before others: in a house, the points of other rooms
/// lie in a photo's frame as well.
fn cells_shown(points: &[Vec3], view: &View) -> Vec<u32> {
    let View { camera, pose, .. } = view;
    let part_and_depth = |point: Vec3| {
        let seen = pose.to_camera(point);
        let pixel = camera.pixel(seen);
        let along = |at: f32, size: u32| {
            let part = (at / size as f32 * FRAME_PARTS as f32) as usize;
            part.min(FRAME_PARTS - 1)
        };
        let in_frame = seen.z > NEAR && camera.contains(pixel);
        in_frame.then(|| (along(pixel.y, camera.height) * FRAME_PARTS + along(pixel.x, camera.width), seen.z))
    };
    let mut nearest = [f32::INFINITY; FRAME_PARTS * FRAME_PARTS];
    for (part, depth) in points.iter().filter_map(|&point| part_and_depth(point)) {
        nearest[part] = nearest[part].min(depth);
    }
    let shows = |point: usize| {
        part_and_depth(points[point]).is_some_and(|(part, depth)| depth <= MAX_DEPTH_RATIO * nearest[part])
    };
    cells_in_frame(points, camera, pose, shows)
}

/// At most `most` of so many indices, in even steps.
fn evenly(of: usize, most: usize) -> impl Iterator<Item = usize> {
    let count = of.min(most);
    (0..count).map(move |i| i * of / count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::{Camera, Observation, Photo, Pose};

    /// A photo from `eye`, with `target` in the middle.
    fn photo(path: String, eye: Vec3, target: Vec3) -> View {
        let camera = Camera { width: 200, height: 200, fx: 150.0, fy: 150.0, cx: 100.0, cy: 100.0 };
        let photo = Photo::new(&path);
        View { name: path, camera, pose: Pose::look_at(eye, target, Vec3::NEG_Y), photo, test: false }
    }

    /// So many halls beside one another, each with points on its floor and photos from all sides, of which all but `around` are of
    /// the front. Each photo shows the points of its hall.
    fn halls(halls: usize, photos: usize, around: usize, tracks: bool) -> Scene {
        let (mut views, mut points) = (Vec::new(), Vec::new());
        for hall in 0..halls {
            let middle = Vec3::new(hall as f32 * 100.0, 0.0, 0.0);
            for i in 0..photos {
                let turn = if i < around { i as f32 / around as f32 * std::f32::consts::TAU } else { 0.1 };
                let eye = middle + 3.0 * Vec3::new(turn.sin(), -0.4, -turn.cos());
                views.push(photo(format!("{hall}-{i:03}.png"), eye, middle));
            }
            for k in 0..30 {
                let (x, z) = ((k % 6) as f32 * 0.1 - 0.25, (k / 6) as f32 * 0.1 - 0.2);
                let position = middle + Vec3::new(x, 0.0, z);
                let of_hall = (0..photos).map(|i| (hall * photos + i) as u32).filter(|_| tracks);
                let track = of_hall.map(|view| Observation { view, pixel: [0.0; 2] }).collect();
                points.push(Point { position, colour: [0.5; 3], track });
            }
        }
        Scene::new(views, points)
    }

    fn left_out_of(scene: &Scene) -> BTreeSet<usize> {
        let usable: Vec<usize> = (0..scene.views.len()).collect();
        left_out(scene, DescribedPhotos::Auto, ALL_DESCRIBED, &usable)
    }

    #[test]
    fn of_many_photos_of_one_side_the_first_are_described_and_all_of_other_sides() {
        for tracks in [true, false] {
            let scene = halls(1, 700, 40, tracks);
            let left_out = left_out_of(&scene);
            assert_eq!(scene.views.len() - left_out.len(), ALL_DESCRIBED, "tracks: {tracks}");
            assert!(left_out.iter().all(|view| *view >= 40), "of 40 photos all around none is left out");
            assert_eq!(left_out_of(&scene), left_out);
        }
    }

    #[test]
    fn as_many_photos_are_described_as_a_large_scene_needs() {
        // Eight directions of each of sixty halls, with one photo each: all of them are new to the others.
        let scene = halls(60, 8, 8, true);
        assert!(left_out_of(&scene).is_empty());
        // Six times as many photos from the same directions are not.
        let many = halls(60, 48, 8, true);
        let described = many.views.len() - left_out_of(&many).len();
        assert!((480..1440).contains(&described), "{described} of {}", many.views.len());
    }

    #[test]
    fn photos_that_have_a_hall_beyond_a_wall_in_their_frames_do_not_stand_for_those_in_it() {
        let at = |x: f32, y: f32, z: f32| Point {
            position: Vec3::new(x, y, z),
            colour: [0.5; 3],
            track: Vec::new(),
        };
        // Wall and hall in the same directions from 300 photos before the wall, and from 20 between the two.
        let wall = (0..1681).map(|i| at((i % 41) as f32 * 0.1 - 2.0, (i / 41) as f32 * 0.1 - 2.0, -30.0));
        let hall = (0..30).map(|i| at((i % 6) as f32 * 0.1 - 0.25, (i / 6) as f32 * 0.1 - 0.2, 0.0));
        let from = |z: f32, i: usize| photo(format!("{i:03}.png"), Vec3::new(0.0, 0.0, z), Vec3::ZERO);
        let views = (0..320).map(|i| from(if i < 300 { -33.0 } else { -3.0 }, i)).collect();
        let left_out = left_out_of(&Scene::new(views, wall.chain(hall).collect()));
        assert_eq!(left_out.len(), 320 - ALL_DESCRIBED);
        assert!(left_out.iter().all(|view| *view < 300), "{left_out:?}");
    }

    #[test]
    fn small_scenes_scenes_without_points_and_whoever_wants_all_have_all_photos_described() {
        assert!(left_out_of(&halls(1, ALL_DESCRIBED, 10, true)).is_empty());
        let mut scene = halls(1, 300, 10, true);
        let usable: Vec<usize> = (0..300).collect();
        assert!(left_out(&scene, DescribedPhotos::All, ALL_DESCRIBED, &usable).is_empty());
        // Held-out photos do not count.
        assert!(left_out(&scene, DescribedPhotos::Auto, ALL_DESCRIBED, &usable[..ALL_DESCRIBED]).is_empty());
        // Photos that show no point fill up.
        scene.points.iter_mut().for_each(|point| point.track.retain(|seen| seen.view < 3));
        let left_out = left_out_of(&scene);
        assert_eq!(left_out.len(), 300 - ALL_DESCRIBED);
        assert!(left_out.iter().all(|view| *view >= 3));
        scene.points.clear();
        assert!(left_out_of(&scene).is_empty());
    }
}
