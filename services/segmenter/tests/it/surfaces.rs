//! Surfaces that run on under and past what stands on them (method, section 13).

use crate::common::{TestRandom, TestWorld, engine, options, posed};
use glam::{Vec2, Vec3};
use segwild_flow::{ActorOptions, Limits, Stopper, System, SystemOptions, mailbox};
use segwild_raster::{Channels, Rasterizer};
use segwild_scene::{Image, Mask, Prompts, ReaderError};
use segwild_segmenter::scene_tree::{LeafClick, SceneTree, TreeBuilder};
use segwild_segmenter::{
    Alternative, PosedView, SceneGraph, SegmentActor, SegmentReply, SegmentSettings, SegmentTask, Segmented,
};
use segwild_vision::{Builtin, PromptSegmenter};
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;

pub const WALL: usize = 0;
pub const BLOCK: usize = 1;

/// A wall, half of whose side is given, with a block before it.
pub fn world(half: f32) -> TestWorld {
    let (mut world, mut dice) = (TestWorld::default(), TestRandom(11));
    let side = (26.0 * half) as usize;
    world.wall(WALL, Vec3::new(0.0, 0.0, 4.0), half, side, [0.3, 0.4, 0.5], &mut dice);
    world.wall(BLOCK, Vec3::new(-0.4, 0.0, 3.2), 0.45, 24, [0.8, 0.6, 0.2], &mut dice);
    world
}

fn scaled(world: &TestWorld, scale: f32) -> TestWorld {
    let mut world = world.clone();
    world.splats.means.iter_mut().flatten().for_each(|x| *x *= scale);
    world.splats.log_scales.iter_mut().flatten().for_each(|x| *x += scale.ln());
    world
}

pub fn views(scale: f32) -> Vec<PosedView> {
    let at = |i: usize| Vec3::new(0.3 * (i as f32 - 4.0), 0.1 * ((i % 3) as f32 - 1.0), 0.0);
    (0..9).map(|i| posed(&format!("{i}.jpg"), at(i) * scale, Vec3::new(0.0, 0.0, 4.0) * scale)).collect()
}

/// What a view shows of a world.
fn photo(world: &TestWorld, view: &PosedView) -> Image {
    let engine = engine();
    let projected = engine.project(&world.splats, &view.camera, &view.pose, &options()).unwrap();
    projected.blend(&Channels { count: 3, values: &projected.shade() }).unwrap().image
}

fn tree(world: &TestWorld, views: &[PosedView]) -> SceneTree {
    let mut builder = TreeBuilder::new(&world.splats, options());
    for view in views {
        let boundaries = Builtin::new().boundary_strengths(&photo(world, view)).unwrap().unwrap();
        let seen = builder.see(view, boundaries.width, boundaries.height).unwrap();
        builder.add(seen, &boundaries);
    }
    builder.grow()
}

/// Shares of the wall and of the block that a surface holds, of their splats that are in the tree.
fn held(tree: &SceneTree, world: &TestWorld, surface: usize) -> [f32; 2] {
    let leaves = tree.leaves_on(&tree.surfaces[surface]);
    let (labels, all) = (tree.splats_of(&leaves), tree.splats_of(&vec![true; leaves.len()]));
    [WALL, BLOCK].map(|thing| world.share(thing, &labels) / world.share(thing, &all))
}

#[test]
fn a_wall_that_the_frames_cut_off_is_a_surface_without_what_stands_before_it() {
    let world = world(2.6);
    let tree = tree(&world, &views(1.0));
    assert_eq!(tree.surfaces.len(), 1, "{:?}", tree.surfaces);
    let [wall, block] = held(&tree, &world, 0);
    assert!(wall > 0.95 && block < 0.02, "{wall} {block}");
}

#[test]
fn a_wall_that_the_photos_show_whole_is_a_thing_and_no_surface() {
    let tree = tree(&world(1.1), &views(1.0));
    assert!(tree.surfaces.is_empty(), "{:?}", tree.surfaces);
}

#[test]
fn a_surface_is_the_same_in_other_units() {
    let world = world(2.6);
    let (one, thousand) = (tree(&world, &views(1.0)), tree(&scaled(&world, 1000.0), &views(1000.0)));
    assert_eq!(one.surfaces.len(), thousand.surfaces.len());
    let (a, b) = (held(&one, &world, 0), held(&thousand, &world, 0));
    assert!((a[0] - b[0]).abs() < 0.01 && (a[1] - b[1]).abs() < 0.01, "{a:?} {b:?}");
}

/// The answer to clicks in the middle photo.
pub fn answer(world: &TestWorld, prompts: Prompts) -> Segmented {
    let views = views(1.0);
    let tree = Arc::new(tree(world, &views));
    let photos: Vec<Image> = views.iter().map(|view| photo(world, view)).collect();
    let (splats, views) = (Arc::new(world.splats.clone()), Arc::new(views));
    let system = System::new(SystemOptions::default()).unwrap();
    let (tasks, inbox) = mailbox::<SegmentTask>("segmenter", Limits::default());
    let (reply, replies) = mailbox::<SegmentReply>("replies", Limits::default());
    let photos = Arc::new(photos);
    let make = move || {
        let photos = photos.clone();
        Ok(SegmentActor {
            engine: Arc::new(engine()),
            options: options(),
            splats: splats.clone(),
            views: views.clone(),
            barred: Arc::new(vec![false; 9]),
            features: None,
            photos: Arc::new(move |view: usize| Ok::<Image, ReaderError>(photos[view].clone())),
            skies: Arc::new(|_: usize| None::<Mask>),
            transients: Arc::new(|_: usize| None::<Mask>),
            segmenter: Arc::new(Builtin::new()),
            tree: Some(tree.clone()),
            seen_once: None,
            graph: SceneGraph::default(),
            shown: None,
            ahead: 0..0,
            bytes: Arc::new(AtomicUsize::new(0)),
        })
    };
    system.spawn(inbox, ActorOptions::default(), make).unwrap();
    let prompts = vec![(4, prompts)];
    let settings = SegmentSettings::default();
    let task = SegmentTask { prompts, group: None, settings, cancel: Stopper::default(), reply };
    tasks.blocking_send(task).unwrap();
    let done = loop {
        match replies.blocking_recv().expect("an answer") {
            SegmentReply::Done(done) => break done,
            SegmentReply::Step(..) | SegmentReply::Selected(..) => {}
        }
    };
    drop(tasks);
    system.shutdown();
    *done.unwrap()
}

fn click(at: Vec3) -> Prompts {
    let view = &views(1.0)[4];
    let Vec2 { x, y } = view.camera.pixel(view.pose.to_camera(at));
    Prompts::click(x, y)
}

const ON_WALL: Vec3 = Vec3::new(0.9, 0.3, 4.0);

#[test]
fn a_second_click_leaves_the_numbers_of_the_alternatives_as_they_are() {
    let world = world(2.6);
    let types = |prompts: Prompts| -> Vec<_> {
        answer(&world, prompts).alternatives.iter().map(std::mem::discriminant).collect()
    };
    let mut two = click(ON_WALL);
    two.points.extend(click(Vec3::new(0.9, -0.5, 4.0)).points);
    assert_eq!(types(click(ON_WALL)), types(two.clone()));
    two.points[1].inside = false;
    assert_eq!(types(click(ON_WALL)), types(two));
}

#[test]
fn what_came_along_of_a_surface_goes_with_one_click() {
    let world = world(2.6);
    let tree = tree(&world, &views(1.0));
    let wall = tree.leaves_on(&tree.surfaces[0]);
    let of_block = |leaf: usize| {
        let splats = tree.leaf.iter().zip(&world.thing).filter(|(l, _)| **l as usize == leaf);
        splats.clone().any(|(_, thing)| *thing == BLOCK)
    };
    // The block, with every thirtieth leaf of the wall.
    let selected: Vec<bool> =
        (0..wall.len()).map(|leaf| of_block(leaf) || wall[leaf] && leaf % 30 == 0).collect();
    let leaf = (0..wall.len()).find(|&leaf| selected[leaf] && wall[leaf]).expect("one came along") as u32;
    let negative = LeafClick { leaf, surface: Some(0), inside: false, shown: None };
    let kept = tree.corrected(selected.clone(), None, std::slice::from_ref(&negative)).selected;
    assert!((0..wall.len()).all(|leaf| kept[leaf] == (selected[leaf] && !wall[leaf])));
    // One that hits no surface takes its part alone.
    let alone = LeafClick { surface: None, ..negative };
    let kept = tree.corrected(selected, None, &[alone]).selected;
    assert!(kept.iter().zip(&wall).any(|(kept, wall)| *kept && *wall));
}

#[test]
fn a_click_on_the_wall_selects_it_without_the_block_and_one_on_the_block_does_not_take_the_wall() {
    let world = world(2.6);
    let wall = answer(&world, click(ON_WALL));
    assert!(matches!(wall.alternatives[0], Alternative::Surface(_)), "{:?}", wall.alternatives);
    let share = |of: &Segmented, thing| world.share(thing, &of.selection.labels);
    assert!(share(&wall, WALL) > 0.9 && share(&wall, BLOCK) < 0.05);
    let block = answer(&world, click(Vec3::new(-0.4, 0.05, 3.2)));
    assert!(
        block.alternatives.iter().all(|a| !matches!(a, Alternative::Surface(_))),
        "{:?}",
        block.alternatives
    );
    assert!(share(&block, BLOCK) > 0.9 && share(&block, WALL) < 0.05);
}
