//! The scene tree on scenes of which every boundary is known (method, section 13).

use crate::common::{TestRandom, TestWorld, engine, leaf, options, posed};
use glam::Vec3;
use segwild_raster::{NO_SPLAT, Rasterizer};
use segwild_scene::Image;
use segwild_segmenter::scene_tree::{
    LeafClick, NONE, PartMap, SceneParts, SceneTree, ShownLeaves, TreeBuilder,
};
use segwild_segmenter::{PosedView, TreeBoundaries};

const GREY: [f32; 3] = [0.5, 0.5, 0.5];

/// A wall (thing 0) with a smaller block (1) before it, all of one colour, and a part of the wall (2) that only a print sets apart.
fn wall_scene() -> TestWorld {
    let (mut world, mut dice) = (TestWorld::default(), TestRandom(7));
    world.wall(0, Vec3::new(0.0, 0.0, 4.0), 2.6, 60, GREY, &mut dice);
    world.wall(1, Vec3::new(-0.5, 0.0, 2.5), 0.4, 24, GREY, &mut dice);
    for (thing, mean) in world.thing.iter_mut().zip(&world.splats.means) {
        if *thing == 0 && (0.5..1.3).contains(&mean[0]) && mean[1].abs() < 0.4 {
            *thing = 2;
        }
    }
    world
}

fn cameras(scale: f32) -> Vec<PosedView> {
    let at = |i: usize| Vec3::new(0.3 * (i as f32 - 4.0), 0.1 * ((i % 3) as f32 - 1.0), 0.0);
    (0..9).map(|i| posed(&format!("{i}.jpg"), at(i) * scale, Vec3::new(0.0, 0.0, 4.0) * scale)).collect()
}

/// The print's outline as each photo shows it; `missing` photos show none.
fn boundaries(world: &TestWorld, view: &PosedView, missing: bool) -> Image {
    let front = engine().front(&world.splats, &view.camera, &view.pose, &options()).unwrap();
    let (w, h) = (front.width, front.height);
    let printed = |i: usize| front.splats[i] != NO_SPLAT && world.thing[front.splats[i] as usize] == 2;
    let mut map = Image::zeros(w, h, 1);
    for i in (0..w * h).filter(|i| !missing && i % w + 1 < w && i + w < w * h) {
        if printed(i) != printed(i + 1) || printed(i) != printed(i + w) {
            map.data[i] = 0.8;
        }
    }
    map
}

fn tree(world: &TestWorld, views: &[PosedView], missing: usize) -> SceneTree {
    let mut builder = TreeBuilder::new(&world.splats, options());
    for (i, view) in views.iter().enumerate() {
        let boundaries = boundaries(world, view, i < missing);
        let seen = builder.see(view, boundaries.width, boundaries.height).unwrap();
        assert!(builder.needs(&seen), "few views are all needed");
        builder.add(seen, &boundaries);
    }
    builder.grow()
}

/// IoU of a thing with the most alike group that holds a leaf, over the splats that are in the tree.
fn best(tree: &SceneTree, world: &TestWorld, leaf: u32, things: &[usize]) -> f32 {
    let seen: Vec<bool> = tree.leaf.iter().map(|&l| l != NONE).collect();
    let mut best = 0.0f32;
    for grown in &tree.trees {
        for node in grown.merges.ancestors(leaf) {
            let inside = grown.merges.parts_of(node);
            let (mut both, mut either) = (0, 0);
            for i in (0..world.len()).filter(|&i| seen[i]) {
                let (a, b) = (inside[tree.leaf[i] as usize], things.contains(&world.thing[i]));
                both += usize::from(a && b);
                either += usize::from(a || b);
            }
            best = best.max(both as f32 / either as f32);
        }
    }
    best
}

const BLOCK: Vec3 = Vec3::new(-0.4, 0.1, 2.5);
const WALL: Vec3 = Vec3::new(0.2, -0.7, 4.0);
const PRINT: Vec3 = Vec3::new(0.9, 0.1, 4.0);

#[test]
fn a_block_before_a_wall_of_its_colour_is_a_group_and_the_wall_is_one() {
    let (world, views) = (wall_scene(), cameras(1.0));
    let tree = tree(&world, &views, views.len());
    let leaf = |at| leaf(&tree, &world, &views[4], at);
    assert!(best(&tree, &world, leaf(BLOCK), &[1]) > 0.9);
    assert!(best(&tree, &world, leaf(WALL), &[0, 2]) > 0.9);
}

#[test]
fn a_print_on_a_wall_is_a_part_of_it() {
    let (world, views) = (wall_scene(), cameras(1.0));
    let tree = tree(&world, &views, 0);
    let leaf = |at| leaf(&tree, &world, &views[4], at);
    assert!(best(&tree, &world, leaf(PRINT), &[2]) > 0.85);
    assert!(best(&tree, &world, leaf(PRINT), &[0, 2]) > 0.9, "the wall with its print");
}

#[test]
fn a_boundary_that_some_photos_lack_stays_and_one_that_few_have_goes() {
    let (world, views) = (wall_scene(), cameras(1.0));
    let most = tree(&world, &views, 2);
    assert!(best(&most, &world, leaf(&most, &world, &views[4], PRINT), &[2]) > 0.85);
    let apart = |tree: &SceneTree| {
        let (a, b) =
            (leaf(tree, &world, &views[4], PRINT), leaf(tree, &world, &views[4], Vec3::new(0.2, 0.2, 4.0)));
        // By average linkage: its heights are distances.
        tree.trees[3].merges.height[tree.trees[3].merges.meet(a, b) as usize]
    };
    let few = tree(&world, &views, 7);
    assert!(apart(&few) < 0.3 * apart(&most), "{} {}", apart(&few), apart(&most));
}

#[test]
fn a_click_chooses_the_block() {
    let (world, views) = (wall_scene(), cameras(1.0));
    let tree = tree(&world, &views, 0);
    let found = tree.candidates(leaf(&tree, &world, &views[4], BLOCK), TreeBoundaries::All);
    assert!((1..=2).contains(&found.len()));
    let first = tree.labels(&found[0]);
    assert!(world.share(1, &first) > 0.85 && world.share(0, &first) < 0.05 && world.share(2, &first) < 0.05);
}

#[test]
fn boundaries_that_are_switched_off_answer_no_click() {
    let (world, views) = (wall_scene(), cameras(1.0));
    let tree = tree(&world, &views, 0);
    let leaf = leaf(&tree, &world, &views[4], PRINT);
    let answered_by = |boundaries: TreeBoundaries| -> Vec<usize> {
        let of_sizes = [0.0, 0.5, 1.0].map(|g| tree.candidates_of_size(leaf, g, boundaries));
        let found = of_sizes.into_iter().flatten().chain(tree.candidates(leaf, boundaries));
        found.flat_map(|group| group.nodes).map(|(tree, _)| tree).collect()
    };
    let (photo, geometry) = (answered_by(TreeBoundaries::Photo), answered_by(TreeBoundaries::Geometry));
    assert!(photo.len() >= 4 && photo.iter().all(|tree| *tree == 1), "{photo:?}");
    assert!(geometry.len() >= 4 && geometry.iter().all(|tree| [2, 4].contains(tree)), "{geometry:?}");
}

/// A click on a point of the world, in the middle photo.
fn click(tree: &SceneTree, world: &TestWorld, view: &PosedView, at: Vec3, inside: bool) -> LeafClick {
    let pixel = view.camera.pixel(view.pose.to_camera(at));
    let options = options();
    let shown = ShownLeaves::of(&engine(), tree, &world.splats, &options, view, pixel).unwrap();
    LeafClick { leaf: leaf(tree, world, view, at), surface: None, inside, shown: Some(shown) }
}

#[test]
fn a_further_click_adds_or_takes_out_its_part_and_leaves_the_rest() {
    let (world, views) = (wall_scene(), cameras(1.0));
    let tree = tree(&world, &views, 0);
    let click = |at: Vec3, inside: bool| click(&tree, &world, &views[4], at, inside);
    let all = vec![true; tree.trees[0].merges.leaves];
    // Too much: the block goes, the wall with its print stays.
    let without = tree.corrected(all.clone(), None, &[click(BLOCK, false)]);
    let labels = tree.splats_of(&without.selected);
    assert!(world.share(1, &labels) < 0.2, "{}", world.share(1, &labels));
    assert!(world.share(0, &labels) > 0.9 && world.share(2, &labels) > 0.9);
    // Too little: the print comes to the wall.
    let missing = tree.corrected(all, None, &[click(PRINT, false)]);
    let added = tree.corrected(missing.selected.clone(), None, &[click(PRINT, true)]);
    let [before, after] = [&missing, &added].map(|c| world.share(2, &tree.splats_of(&c.selected)));
    assert!(before < 0.5 && after > before + 0.3, "{before}, then {after}");
    assert!(added.decided.iter().any(|decided| *decided) && !added.decided.iter().all(|decided| *decided));
}

#[test]
fn no_click_contradicts_another_one() {
    let (world, views) = (wall_scene(), cameras(1.0));
    let tree = tree(&world, &views, 0);
    let click = |at: Vec3, inside: bool| click(&tree, &world, &views[4], at, inside);
    let clicks = [click(BLOCK, true), click(WALL, false), click(PRINT, true)];
    let nothing = vec![false; tree.trees[0].merges.leaves];
    for order in [[0, 1, 2], [2, 1, 0], [1, 0, 2]] {
        let clicks = order.map(|at| clicks[at].clone());
        let corrected = tree.corrected(nothing.clone(), None, &clicks);
        for click in &clicks {
            assert_eq!(corrected.selected[click.leaf as usize], click.inside, "{order:?}");
        }
    }
}

#[test]
fn a_negative_click_leaves_the_part_of_the_first_click() {
    let (world, views) = (wall_scene(), cameras(1.0));
    let tree = tree(&world, &views, 0);
    let click = |at: Vec3, inside: bool| click(&tree, &world, &views[4], at, inside);
    let (first, negative) = (click(PRINT, true), click(WALL, false));
    let all = vec![true; tree.trees[0].merges.leaves];
    let corrected = tree.corrected(all, Some(&first), std::slice::from_ref(&negative));
    assert!(corrected.selected[first.leaf as usize] && !corrected.decided[first.leaf as usize]);
    assert!(!corrected.selected[negative.leaf as usize]);
}

#[test]
fn granularity_goes_from_the_print_to_the_wall_and_beyond() {
    let (world, views) = (wall_scene(), cameras(1.0));
    let tree = tree(&world, &views, 0);
    let leaf = leaf(&tree, &world, &views[4], PRINT);
    let of_size = |g: f32| {
        let found = tree.candidates_of_size(leaf, g, TreeBoundaries::All);
        found.first().expect("a group holds the click").area
    };
    let areas: Vec<f32> = [0.0, 0.25, 0.5, 0.75, 1.0].map(of_size).to_vec();
    assert!(areas.is_sorted(), "{areas:?}");
    assert!(areas[0] < 0.5 * areas[4], "{areas:?}");
}

#[test]
fn units_and_threads_change_nothing() {
    let world = wall_scene();
    let small = tree(&world, &cameras(1.0), 0);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| tree(&world, &cameras(1.0), 0))
    };
    assert_eq!(on(1), on(3));
    assert_eq!(on(1), small);
    // A power of two, so that no number is rounded otherwise.
    let mut large = world.clone();
    large.splats.means.iter_mut().flatten().for_each(|x| *x *= 1024.0);
    large.splats.log_scales.iter_mut().flatten().for_each(|x| *x += 1024f32.ln());
    let scaled = tree(&large, &cameras(1024.0), 0);
    let views = (cameras(1.0), cameras(1024.0));
    let at = |tree: &SceneTree, world: &TestWorld, view: &PosedView, at: Vec3| leaf(tree, world, view, at);
    let (a, b) = (at(&small, &world, &views.0[4], BLOCK), at(&scaled, &large, &views.1[4], BLOCK * 1024.0));
    let (a, b) = (best(&small, &world, a, &[1]), best(&scaled, &large, b, &[1]));
    assert!((a - b).abs() < 0.01, "{a} {b}");
}

#[test]
fn no_view_and_no_splat_make_a_tree_without_groups() {
    let world = wall_scene();
    let none = TreeBuilder::new(&world.splats, options()).grow();
    assert!(none.fits(world.len()) && none.leaf.iter().all(|&leaf| leaf == NONE));
    let nothing = TestWorld::default();
    let mut builder = TreeBuilder::new(&nothing.splats, options());
    let seen = builder.see(&cameras(1.0)[0], 160, 120).unwrap();
    builder.add(seen, &Image::zeros(160, 120, 1));
    assert!(builder.grow().fits(0));
}

#[test]
fn a_front_layer_names_the_nearest_opaque_splat_of_each_pixel() {
    let (world, view) = (wall_scene(), &cameras(1.0)[4]);
    let engine = engine();
    let front = engine.front(&world.splats, &view.camera, &view.pose, &options()).unwrap();
    let frame = engine.project(&world.splats, &view.camera, &view.pose, &options()).unwrap();
    let sums = frame.gather(&Image::filled(front.width, front.height, 1, 1.0)).unwrap();
    for (i, &pixel) in front.pixels.iter().enumerate() {
        assert_eq!(pixel == NO_SPLAT, front.shares[i] == 0.0);
        assert!(front.shares[i] <= sums[i] + 1e-6, "no pixel has more of a splat than all pixels");
    }
    // Each pixel by blending one splat at a time.
    for pixel in [60 * 160 + 50, 60 * 160 + 100, 20 * 160 + 80] {
        let mut image = Image::zeros(front.width, front.height, 1);
        image.data[pixel] = 1.0;
        let shares = frame.gather(&image).unwrap();
        let most = (0..shares.len()).max_by(|&a, &b| shares[a].total_cmp(&shares[b])).unwrap();
        assert_eq!(front.splats[pixel] as usize, most);
        let sum: f32 = shares.iter().sum();
        assert!((front.alpha.data[pixel] - sum).abs() < 1e-4);
    }
}

#[test]
fn what_hangs_before_one_camera_is_seen_once_and_the_wall_and_the_block_are_not() {
    let (mut world, views) = (wall_scene(), cameras(1.0));
    // So near to the first camera that no other has it in its frame.
    let eye = views[0].pose.centre();
    let towards = (Vec3::new(0.0, 0.0, 4.0) - eye).normalize();
    world.disc(3, eye + 0.3 * towards, -towards, 0.02, GREY);
    let tree = tree(&world, &views, views.len());
    assert!(tree.fits(world.len()));
    let seen_once = tree.seen_once();
    assert_eq!(tree.shown_by[world.len() - 1], 1);
    assert!(seen_once[world.len() - 1] && world.share(1, &seen_once) == 0.0);
    assert!(world.share(0, &seen_once) < 0.05, "{}", world.share(0, &seen_once));
    // Some pixels of the first photo show it more than anything else, and those of other photos show what several do.
    let parts = SceneParts { labels: vec![0; world.len()], seen_once: world.is(3), ..SceneParts::default() };
    let engine = engine();
    let pixels = |view: &PosedView| {
        PartMap::render(&engine, &world.splats, &options(), view, &parts).unwrap().seen_once
    };
    assert!(pixels(&views[0]) > 20 && pixels(&views[4]) == 0, "{} {}", pixels(&views[0]), pixels(&views[4]));
}

#[test]
fn views_that_are_not_needed_are_counted() {
    let (mut world, mut dice) = (TestWorld::default(), TestRandom(7));
    world.wall(0, Vec3::new(0.0, 0.0, 4.0), 2.6, 24, GREY, &mut dice);
    let view = posed("photo.jpg", Vec3::ZERO, Vec3::new(0.0, 0.0, 4.0));
    let mut builder = TreeBuilder::new(&world.splats, options());
    let seen = builder.see(&view, 80, 60).unwrap();
    builder.count(&seen);
    builder.add(seen, &Image::zeros(80, 60, 1));
    let tree = builder.grow();
    assert!(tree.shown_by.contains(&2) && tree.shown_by.iter().all(|&photos| photos == 0 || photos == 2));
}

#[test]
fn many_photos_of_one_wall_are_not_all_needed_and_one_of_another_wall_is() {
    let (mut world, mut dice) = (TestWorld::default(), TestRandom(7));
    for (thing, z) in [(0, 4.0), (1, -4.0)] {
        world.wall(thing, Vec3::new(0.0, 0.0, z), 2.6, 24, GREY, &mut dice);
    }
    let views = [4.0, -4.0].map(|z| posed("photo.jpg", Vec3::ZERO, Vec3::new(0.0, 0.0, z)));
    let mut builder = TreeBuilder::new(&world.splats, options());
    let mut added = 0;
    for _ in 0..100 {
        let seen = builder.see(&views[0], 80, 60).unwrap();
        if builder.needs(&seen) {
            builder.add(seen, &Image::zeros(80, 60, 1));
            added += 1;
        }
    }
    assert_eq!(added, 64);
    assert!(builder.needs(&builder.see(&views[1], 80, 60).unwrap()));
}
