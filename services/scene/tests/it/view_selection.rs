//! The greedy selection of photos against one that computes everything, and on photos around an object.

use glam::Vec3;
use proptest::prelude::*;
use segwild_scene::view_selection::{
    CandidateView, DIRECTION_BINS, FramedView, SelectedView, ViewCoverage, cells_in_frame,
    select_rendered_views, select_views,
};
use segwild_scene::{Camera, Pose};

const POINTS: usize = 6;

/// Photos named by their numbers.
fn names(photos: usize) -> Vec<String> {
    (0..photos).map(|i| format!("{i:04}.jpg")).collect()
}

fn candidates<'a>(names: &'a [String], cells: &'a [Vec<u32>]) -> Vec<CandidateView<'a>> {
    names.iter().zip(cells).map(|(name, cells)| CandidateView { name, cells }).collect()
}

/// The greedy selection without a queue.
fn plainly(candidates: &[CandidateView], points: usize, most: usize, least: f64) -> Vec<(usize, f64)> {
    let mut covered = ViewCoverage::none(points);
    let mut left: Vec<usize> = (0..candidates.len()).collect();
    let mut selected = Vec::new();
    while selected.len() < most {
        let gain = |index: usize| covered.gain(candidates[index].cells);
        let better = |a: &&usize, b: &&usize| {
            gain(**a).total_cmp(&gain(**b)).then(candidates[**b].name.cmp(candidates[**a].name))
        };
        let Some(&next) = left.iter().max_by(better) else { break };
        let added = gain(next);
        if added == 0.0 || added < least {
            break;
        }
        covered.add(candidates[next].cells);
        left.retain(|index| *index != next);
        selected.push((next, added));
    }
    selected
}

fn pairs(selected: &[SelectedView]) -> Vec<(usize, f64)> {
    selected.iter().map(|s| (s.candidate, s.added)).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn the_queue_finds_the_greedy_order_whatever_the_order_of_the_photos(
        sets in proptest::collection::vec(
            proptest::collection::btree_set(0..(POINTS * DIRECTION_BINS) as u32, 0..40), 0..24),
        least in 0.0f64..0.3,
        most in 0usize..30,
    ) {
        let cells: Vec<Vec<u32>> = sets.into_iter().map(|set| set.into_iter().collect()).collect();
        let names = names(cells.len());
        let photos = candidates(&names, &cells);
        let none = ViewCoverage::none(POINTS);
        let selected = select_views(&photos, none.clone(), most, least);
        prop_assert_eq!(pairs(&selected), plainly(&photos, POINTS, most, least));
        prop_assert!(selected.len() <= most);
        // Diminishing returns: no photo adds more than the one before it.
        prop_assert!(selected.windows(2).all(|pair| pair[1].added <= pair[0].added));
        prop_assert!(selected.iter().all(|s| !cells[s.candidate].is_empty() && s.added >= least));
        // What a smaller selection holds comes first in a larger one.
        for fewer in 0..selected.len() {
            let smaller = select_views(&photos, none.clone(), fewer, least);
            prop_assert_eq!(pairs(&smaller), pairs(&selected[..fewer]));
        }
        // Where nothing occludes, rendering finds the same ones.
        let framed: Vec<FramedView> = photos
            .iter()
            .map(|photo| FramedView { name: photo.name, cells: photo.cells, distance: 1.0 })
            .collect();
        let render = |photo: usize| Ok::<_, ()>(cells[photo].clone());
        let rendered = select_rendered_views(&framed, none.clone(), most, least, framed.len(), render);
        prop_assert_eq!(rendered.as_ref(), Ok(&selected));
        let reversed: Vec<CandidateView> = photos.iter().rev().copied().collect();
        let again = select_views(&reversed, none, most, least);
        let named = |of: &[CandidateView], selected: &[SelectedView]| -> Vec<(String, f64)> {
            selected.iter().map(|s| (of[s.candidate].name.to_owned(), s.added)).collect()
        };
        prop_assert_eq!(named(&reversed, &again), named(&photos, &selected));
    }
}

#[test]
fn nothing_is_selected_of_no_photos_no_points_and_photos_that_see_nothing() {
    let (names, cells) = (names(3), vec![vec![], vec![3], vec![]]);
    let photos = candidates(&names, &cells);
    assert!(select_views(&[], ViewCoverage::none(1), 8, 0.0).is_empty());
    assert!(select_views(&photos, ViewCoverage::none(0), 8, 0.0).is_empty());
    assert_eq!(pairs(&select_views(&photos, ViewCoverage::none(1), 8, 0.0)), [(1, 1.0)]);
    // As often as a cell is counted, a photo that covers it again adds nothing.
    let mut full = ViewCoverage::none(1);
    (0..300).for_each(|_| full.add(&[3]));
    assert!(select_views(&photos, full, 8, 0.0).is_empty());
    assert_eq!(ViewCoverage::none(0).gain(&[0]), 0.0);
}

/// Points on a ball around the origin.
fn ball() -> Vec<Vec3> {
    let point = |i: usize| {
        let y = 1.0 - (i as f32 + 0.5) / 30.0;
        let (sin, cos) = (2.4 * i as f32).sin_cos();
        0.2 * Vec3::new((1.0 - y * y).sqrt() * cos, y, (1.0 - y * y).sqrt() * sin)
    };
    (0..60).map(point).collect()
}

#[test]
fn of_a_thousand_photos_most_of_them_of_one_side_a_few_of_all_sides_come_first() {
    let points = ball();
    let camera = Camera { width: 160, height: 120, fx: 130.0, fy: 130.0, cx: 80.0, cy: 60.0 };
    // Nine of ten photos are of the front, within 20 degrees.
    let angle = |i: usize| match i % 10 {
        0 => (i as f32 * 0.36).to_radians(),
        _ => (i % 40) as f32 / 57.3 - 0.35,
    };
    let cells: Vec<Vec<u32>> = (0..1000)
        .map(|i| {
            let (sin, cos) = angle(i).sin_cos();
            let eye = Vec3::new(1.5 * sin, -0.2, -1.5 * cos);
            let pose = Pose::look_at(eye, Vec3::ZERO, Vec3::NEG_Y);
            // A ball stands before its other side.
            cells_in_frame(&points, &camera, &pose, |k| points[k].dot(eye - points[k]) > 0.0)
        })
        .collect();
    let names = names(1000);
    let photos = candidates(&names, &cells);
    let selected = select_views(&photos, ViewCoverage::none(points.len()), 64, 1.0 / 64.0);
    let covered = |photos: &mut dyn Iterator<Item = usize>| -> f64 {
        let mut coverage = ViewCoverage::none(points.len());
        let gains = photos.map(|photo| {
            let added = coverage.gain(&cells[photo]);
            coverage.add(&cells[photo]);
            added
        });
        gains.sum()
    };
    for few in [4, 8, 16] {
        let best = covered(&mut selected.iter().take(few).map(|s| s.candidate));
        let by_name = covered(&mut (0..few));
        assert!(best > 1.3 * by_name, "{few} photos cover {best}, the first by name {by_name}");
    }
    let sides = |few: usize| {
        let quarter = |s: &SelectedView| (angle(s.candidate).to_degrees().rem_euclid(360.0) / 90.0) as usize;
        let mut sides: Vec<usize> = selected.iter().take(few).map(quarter).collect();
        sides.sort_unstable();
        sides.dedup();
        sides.len()
    };
    assert_eq!(sides(8), 4);
    assert!((16..=64).contains(&selected.len()), "{}", selected.len());
}

#[test]
fn a_photo_covers_points_in_its_frame_before_it_that_nothing_occludes() {
    let camera = Camera { width: 100, height: 100, fx: 100.0, fy: 100.0, cx: 50.0, cy: 50.0 };
    let pose = Pose::look_at(Vec3::ZERO, Vec3::Z, Vec3::NEG_Y);
    let points = [
        Vec3::new(0.0, 0.0, 2.0),
        Vec3::new(0.0, 0.0, -2.0),
        Vec3::new(9.0, 0.0, 2.0),
        Vec3::NAN,
        Vec3::new(0.1, 0.0, 2.0),
    ];
    let point = |cell: &u32| *cell as usize / DIRECTION_BINS;
    let all: Vec<usize> = cells_in_frame(&points, &camera, &pose, |_| true).iter().map(point).collect();
    assert_eq!(all, [0, 4]);
    let open: Vec<usize> = cells_in_frame(&points, &camera, &pose, |i| i > 0).iter().map(point).collect();
    assert_eq!(open, [4]);
}

#[test]
fn photos_that_a_wall_keeps_from_the_points_are_rendered_last_and_never_selected() {
    // 300 photos from the same direction with all points in their frames: 290 of them beyond a wall, first by name.
    let (walled, points) = (290, 10);
    let all: Vec<u32> = (0..points as u32).map(|point| point * DIRECTION_BINS as u32).collect();
    let names = names(walled + points);
    let photos: Vec<FramedView> = names
        .iter()
        .enumerate()
        .map(|(i, name)| {
            let distance = if i < walled { 5.0 + ((i * 37 + 50) % 100) as f32 } else { 4.0 };
            FramedView { name, cells: &all, distance }
        })
        .collect();
    let select = |renders: usize| {
        let mut rendered = Vec::new();
        let none = ViewCoverage::none(points);
        let selected = select_rendered_views(&photos, none, 64, 1.0 / 64.0, renders, |photo| {
            rendered.push(photo);
            Ok::<_, ()>(if photo < walled { Vec::new() } else { all.clone() })
        });
        (selected.unwrap().iter().map(|s| s.candidate).collect::<Vec<usize>>(), rendered.len())
    };
    let (selected, rendered) = select(128);
    // The seventh adds 1/64, the next ones less.
    assert_eq!(selected, (walled..walled + 7).collect::<Vec<_>>(), "of {rendered} rendered");
    assert!(rendered < 40, "{rendered}");
    assert_eq!(select(0), (vec![], 0));
}

#[test]
fn a_failure_of_rendering_ends_the_selection() {
    let photos = [FramedView { name: "a", cells: &[0], distance: 1.0 }];
    let failed = select_rendered_views(&photos, ViewCoverage::none(1), 1, 0.0, 1, |_| Err("no device"));
    assert_eq!(failed, Err("no device"));
}
