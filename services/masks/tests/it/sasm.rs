//! SASM against what the method promises of it.

use glam::Vec3;
use proptest::prelude::*;
use segwild_masks::{MaskSettings, sasm};
use segwild_scene::{Camera, Image, Mask, Pose};

const CAMERA: Camera = Camera { width: 96, height: 64, fx: 80.0, fy: 80.0, cx: 48.0, cy: 32.0 };

fn pose() -> Pose {
    Pose::look_at(Vec3::new(0.0, 0.0, -1.0), Vec3::ZERO, Vec3::NEG_Y)
}

/// A plane whose right end is `slope` farther than its left, `n` x `n` points that fill the frame.
fn slanted(n: usize, near: f32, slope: f32) -> Vec<[f32; 3]> {
    let mut points = Vec::new();
    for j in 0..n {
        for i in 0..n {
            // Off the borders between pixels, where rounding would say which of the two sees a point.
            let (u, v) = ((i as f32 + 0.6) / n as f32 * 96.0, (j as f32 + 0.6) / n as f32 * 64.0);
            let z = near + slope * u / 96.0;
            let world = pose().rotation.transpose() * (CAMERA.ray((u, v).into()) * z - pose().translation);
            points.push(world.to_array());
        }
    }
    points
}

#[test]
fn segs_has_the_ends_and_roundings_of_the_paper() {
    assert_eq!([0.0, 0.124, 0.125, 0.5, 0.874, 0.875, 1.0].map(sasm::segs), [4, 4, 5, 6, 7, 8, 8]);
    assert_eq!([-3.0, 7.0].map(sasm::segs), [4, 8]);
    assert_eq!(sasm::segs(f64::NAN), 4, "a poisoned depth is still a grid");
}

#[test]
fn farther_cameras_and_shorter_lenses_get_finer_grids() {
    let points: Vec<Vec3> = (0..200).map(|i| Vec3::new(0.0, 0.0, 0.001 * i as f32)).collect();
    let depth = |distance: f32, focal: f32| {
        let pose = Pose::look_at(Vec3::new(0.0, 0.0, -distance), Vec3::ZERO, Vec3::NEG_Y);
        sasm::view_depth(&Camera { fx: focal, fy: focal, ..CAMERA }, &pose, points.iter().copied())
    };
    let depths: Vec<_> = (0..20).map(|i| depth(0.2 + 0.1 * i as f32, 80.0)).collect();
    let spread = sasm::SceneDepths::spread(depths.iter().flatten().copied().collect());
    let grids: Vec<u32> = depths.iter().map(|&d| sasm::segs(spread.relative(d))).collect();
    assert!(grids.is_sorted(), "{grids:?}");
    assert_eq!((grids[0], grids[19]), (4, 8));
    assert!(depth(1.0, 160.0) < depth(1.0, 80.0), "zooming in brings the scene nearer");
    // A portrait photo of the same lens stands as far away.
    let upright = Camera { width: 64, height: 96, cx: 32.0, cy: 48.0, ..CAMERA };
    let (a, b) = (sasm::focal_35mm(&CAMERA), sasm::focal_35mm(&upright));
    assert!((a - b).abs() < 1e-9, "{a} {b}");
    // 80 px over a diagonal of 115.4 px is 30 mm over 43.27 mm.
    assert!((a - 80.0 / 115.378_5 * 43.266_6).abs() < 1e-3, "{a}");
}

#[test]
fn alike_or_unknown_depths_are_in_the_middle() {
    let same = sasm::SceneDepths::spread(vec![0.7; 9]);
    assert_eq!(same.relative(Some(0.7)), 0.5);
    assert_eq!(sasm::SceneDepths::spread(vec![]).relative(Some(1.0)), 0.5);
    assert_eq!(sasm::SceneDepths::spread(vec![1.0, f64::NAN, 2.0]).relative(None), 0.5);
    assert_eq!(sasm::view_depth(&CAMERA, &pose(), [Vec3::new(0.0, 0.0, -5.0)]), None, "behind");
    assert_eq!(sasm::view_depth(&CAMERA, &pose(), [Vec3::NAN]), None);
}

#[test]
fn one_outlier_does_not_set_the_scale() {
    let mut depths: Vec<f64> = (0..200).map(|i| 1.0 + f64::from(i) * 0.005).collect();
    depths.push(1e6);
    let spread = sasm::SceneDepths::spread(depths);
    assert!((spread.relative(Some(1.5)) - 0.5).abs() < 0.02, "{spread:?}");
}

#[test]
fn the_depth_map_keeps_the_true_minimum_in_any_order() {
    let mut points = slanted(64, 1.0, 1.0);
    points.extend(slanted(64, 3.0, 1.0));
    let forward = sasm::depth_map(&points, &CAMERA, &pose(), None);
    points.reverse();
    assert_eq!(forward, sasm::depth_map(&points, &CAMERA, &pose(), None));
    // The plane behind is hidden: the range is that of the front one.
    assert_eq!(forward, sasm::depth_map(&slanted(64, 1.0, 1.0), &CAMERA, &pose(), None));
    let values = forward.plane(0);
    assert!(values.iter().all(|v| (0.0..=1.0).contains(v)));
    let filled: Vec<f32> = values[10 * 96..11 * 96].iter().copied().filter(|&v| v > 0.0).collect();
    assert!(filled.len() > 50 && filled.is_sorted(), "grows to the right: {filled:?}");
}

#[test]
fn poisoned_centres_are_not_seen() {
    let mut points = slanted(64, 1.0, 1.0);
    let clean = sasm::depth_map(&points, &CAMERA, &pose(), None);
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 3e38] {
        points.extend([[bad, 0.0, 0.0], [0.0, bad, 0.0], [0.0, 0.0, bad], [bad; 3]]);
    }
    points.push(pose().centre().to_array());
    assert_eq!(clean, sasm::depth_map(&points, &CAMERA, &pose(), None));
    let nothing = sasm::depth_map(&[], &CAMERA, &pose(), None);
    assert!(nothing.data.iter().all(|&v| v == 0.0));
}

#[test]
fn sky_and_bare_cells_get_one_prompt() {
    let points = slanted(128, 1.0, 1.0);
    let settings = MaskSettings::default();
    let sky = Mask::from_fn(96, 64, |_, y| y < 16);
    let with = sasm::plan(&points, &CAMERA, &pose(), 0.0, Some(&sky), &settings).unwrap().map.unwrap();
    assert_eq!(with.segs, 4);
    assert!(with.counts[..4].iter().all(|&n| n == 1), "{:?}", with.counts);
    assert!(with.counts[12..].iter().any(|&n| n > 1), "{:?}", with.counts);
    let blind = MaskSettings { sky_prompts: false, ..settings.clone() };
    let without = sasm::plan(&points, &CAMERA, &pose(), 0.0, Some(&sky), &blind).unwrap().map.unwrap();
    assert!(without.counts[..4].iter().any(|&n| n > 1), "{:?}", without.counts);
    // The sky's mask may have another size than the photo.
    let large = sky.resized(192, 128);
    assert_eq!(
        sasm::plan(&points, &CAMERA, &pose(), 0.0, Some(&large), &settings).unwrap().map.unwrap(),
        with
    );
    // Bare: the same plane without its right half.
    let half: Vec<_> = points.iter().copied().filter(|p| p[0] * pose().rotation.x_axis.x < 0.0).collect();
    let map = sasm::plan(&half, &CAMERA, &pose(), 0.0, None, &settings).unwrap().map.unwrap();
    let bare: Vec<u32> = (0..4).flat_map(|r| map.counts[r * 4 + 2..r * 4 + 4].to_vec()).collect();
    assert!(bare.iter().all(|&n| n == 1), "{:?}", map.counts);
}

#[test]
fn a_flat_wall_still_spends_the_budget_where_it_is() {
    let wall = slanted(128, 1.0, 0.0);
    let depth = sasm::depth_map(&wall, &CAMERA, &pose(), Some(&Mask::from_fn(96, 64, |x, _| x < 48)));
    let map = sasm::prompt_map(&depth, 4, 256, 20);
    for row in 0..4 {
        assert_eq!(map.counts[row * 4..row * 4 + 2], [1, 1], "{:?}", map.counts);
        assert!(map.counts[row * 4 + 2] >= 4, "{:?}", map.counts);
    }
}

#[test]
fn prompts_lie_evenly_inside_their_cells() {
    // 4 cells over 10 pixels: edges at 0, 3 (2.5 rounds up), 5, 8, 10.
    let depth = Image::filled(10, 10, 1, 0.0);
    let map = sasm::prompt_map(&depth, 4, 16, 20);
    let points = map.prompts();
    assert_eq!(points.len(), 16);
    assert_eq!(points[..4].iter().map(|p| p[0]).collect::<Vec<_>>(), [1.5, 4.0, 6.5, 9.0]);
    let map = sasm::PromptMap { counts: vec![2; 16], ..map };
    assert_eq!(map.prompts()[..4], [[0.75, 0.75], [2.25, 0.75], [0.75, 2.25], [2.25, 2.25]]);
    // A photo narrower than the grid has cells without pixels; they get no point.
    let thin = sasm::prompt_map(&Image::filled(2, 9, 1, 0.5), 8, 64, 20);
    assert!(thin.prompts().iter().all(|p| p[0] > 0.0 && p[0] < 2.0 && p[1] > 0.0 && p[1] < 9.0));
    assert_eq!(sasm::uniform_prompts(100, 50, 256).len(), 256);
    assert_eq!(sasm::uniform_prompts(100, 50, 0), [[50.0, 25.0]]);
}

#[test]
fn no_pixels_are_refused_in_words() {
    let none = Camera { width: 0, ..CAMERA };
    let error = sasm::plan(&[], &none, &pose(), 0.5, None, &MaskSettings::default()).unwrap_err();
    assert!(error.to_string().contains("0x64"), "{error}");
}

proptest! {
    #[test]
    fn the_budget_is_kept_and_used(
        cells in proptest::collection::vec(prop_oneof![Just(0.0f32), 0.01f32..1.0], 64),
        budget in 0u32..3000,
    ) {
        let depth = Image { width: 8, height: 8, channels: 1, data: cells.clone() };
        let map = sasm::prompt_map(&depth, 8, budget, 20);
        let total: u32 = map.counts.iter().map(|n| n * n).sum();
        prop_assert!(total <= budget.max(64), "{} > {}", total, budget);
        prop_assert_eq!(map.prompts().len(), total as usize);
        prop_assert!(map.counts.iter().all(|n| (1..=20).contains(n)));
        // Farther never gets fewer.
        for (i, a) in cells.iter().enumerate() {
            for (j, b) in cells.iter().enumerate() {
                prop_assert!(a > b || map.counts[i] <= map.counts[j]);
            }
        }
        // Used: with distinct depths, one more step of the steepest cells would break it.
        let mut next: Vec<u32> = map.counts.clone();
        if let Some(far) = (0..64).filter(|&i| map.counts[i] < 20 && cells[i] > 0.0)
            .min_by(|&a, &b| {
                let ready = |i: usize| f64::from(map.counts[i] + 1) / f64::from(cells[i]);
                ready(a).total_cmp(&ready(b))
            })
        {
            let ready = |i: usize| f64::from(map.counts[i] + 1) / f64::from(cells[i]);
            let step = ready(far);
            for i in 0..64 {
                if cells[i] > 0.0 && next[i] < 20 && ready(i) <= step * (1.0 + 1e-12) {
                    next[i] += 1;
                }
            }
            let more: u32 = next.iter().map(|n| n * n).sum();
            prop_assert!(more > budget, "{} could be {} of {}", total, more, budget);
        }
    }

    #[test]
    fn the_scene_scale_does_not_matter(scale in prop_oneof![Just(1000.0f32), 0.1f32..1000.0], slope in 0.1f32..2.0) {
        // Points and cameras in units `scale` times larger, then normalised again as a loaded scene is.
        let unit = |points: &[[f32; 3]]| -> Vec<[f32; 3]> {
            points.iter().map(|p| p.map(|x| (f64::from(x * scale) / f64::from(scale)) as f32)).collect()
        };
        let points = slanted(48, 1.0, slope);
        let settings = MaskSettings::default();
        let a = sasm::plan(&points, &CAMERA, &pose(), 0.3, None, &settings).unwrap().map.unwrap();
        let b = sasm::plan(&unit(&points), &CAMERA, &pose(), 0.3, None, &settings).unwrap().map.unwrap();
        prop_assert_eq!(a.counts, b.counts);
        // And depths themselves may have any unit.
        let depths: Vec<f64> = (0..30).map(|i| 1.0 + f64::from(i) * f64::from(slope)).collect();
        let larger: Vec<f64> = depths.iter().map(|d| d * f64::from(scale)).collect();
        let (s, l) = (sasm::SceneDepths::spread(depths.clone()), sasm::SceneDepths::spread(larger.clone()));
        for (d, e) in depths.iter().zip(&larger) {
            prop_assert_eq!(sasm::segs(s.relative(Some(*d))), sasm::segs(l.relative(Some(*e))));
        }
    }
}
