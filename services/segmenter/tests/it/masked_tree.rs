//! The scene tree from the outlines of automatic masks (method, section 13).

use crate::common::{TestRandom, TestWorld, engine, leaf, options, posed};
use glam::Vec3;
use segwild_raster::NO_SPLAT;
use segwild_scene::{Image, Mask, MaskSet, ScoredMask};
use segwild_segmenter::PosedView;
use segwild_segmenter::scene_tree::{NONE, SceneTree, TreeBuilder, mask_outlines};

const GREY: [f32; 3] = [0.5, 0.5, 0.5];
/// Points of the two blocks.
const NARROW: Vec3 = Vec3::new(-0.45, 0.1, 2.5);
const WIDE: Vec3 = Vec3::new(0.2, 0.1, 2.5);

/// A wall (thing 0) and two blocks before it that touch, of one colour and one depth: a narrow one (1) and a wide one (2).
fn two_blocks() -> TestWorld {
    let (mut world, mut dice) = (TestWorld::default(), TestRandom(11));
    world.wall(0, Vec3::new(0.0, 0.0, 4.0), 2.6, 60, GREY, &mut dice);
    world.wall(1, Vec3::new(0.0, 0.0, 2.5), 0.6, 36, GREY, &mut dice);
    for (thing, mean) in world.thing.iter_mut().zip(&world.splats.means) {
        if *thing == 1 && mean[0] > -0.2 {
            *thing = 2;
        }
    }
    world
}

fn cameras() -> Vec<PosedView> {
    let at = |i: usize| Vec3::new(0.3 * (i as f32 - 3.0), 0.1 * ((i % 3) as f32 - 1.0), 0.0);
    (0..7).map(|i| posed(&format!("{i}.jpg"), at(i), Vec3::new(0.0, 0.0, 4.0))).collect()
}

/// Masks of a view as SAM nests them: each thing, and both blocks together.
fn masks(world: &TestWorld, view: &PosedView) -> MaskSet {
    let front = engine().front(&world.splats, &view.camera, &view.pose, &options()).unwrap();
    let (width, height) = (front.width as u32, front.height as u32);
    let mask_of = |things: &[usize]| {
        let holds = |x: u32, y: u32| {
            let splat = front.splats[(y * width + x) as usize];
            splat != NO_SPLAT && things.contains(&world.thing[splat as usize])
        };
        ScoredMask { mask: Mask::from_fn(width, height, holds), predicted_iou: 0.95, stability: 0.97 }
    };
    let masks = [&[0][..], &[1], &[2], &[1, 2]].map(mask_of).into();
    MaskSet { width, height, masks }
}

/// The tree, from photos of which the first so many have masks.
fn grown(world: &TestWorld, views: &[PosedView], masked: usize) -> SceneTree {
    let mut builder = TreeBuilder::new(&world.splats, options());
    for (i, view) in views.iter().enumerate() {
        let outlines = match i < masked {
            true => mask_outlines(&masks(world, view)),
            false => Image::zeros(view.camera.width as usize, view.camera.height as usize, 1),
        };
        let seen = builder.see(view, outlines.width, outlines.height).unwrap();
        builder.add(seen, &outlines);
    }
    builder.grow()
}

/// IoU of things with the most alike group that holds a leaf, over the splats that are in the tree.
fn best(tree: &SceneTree, world: &TestWorld, leaf: u32, things: &[usize]) -> f32 {
    let mut best = 0.0f32;
    for grown in &tree.trees {
        for node in grown.merges.ancestors(leaf) {
            let inside = grown.merges.parts_of(node);
            let (mut both, mut either) = (0, 0);
            for (leaf, thing) in tree.leaf.iter().zip(&world.thing).filter(|(leaf, _)| **leaf != NONE) {
                let (a, b) = (inside[*leaf as usize], things.contains(thing));
                both += usize::from(a && b);
                either += usize::from(a || b);
            }
            best = best.max(both as f32 / either as f32);
        }
    }
    best
}

#[test]
fn blocks_of_one_depth_and_one_colour_are_two_groups_and_one_above_them() {
    let (world, views) = (two_blocks(), cameras());
    let tree = grown(&world, &views, views.len());
    let of = |at: Vec3, things: &[usize]| best(&tree, &world, leaf(&tree, &world, &views[3], at), things);
    let found = [of(NARROW, &[1]), of(WIDE, &[2]), of(NARROW, &[1, 2]), of(WIDE, &[1, 2])];
    assert!(found.iter().all(|iou| *iou > 0.8), "{found:?}");
}

#[test]
fn without_masks_the_geometry_alone_sets_nothing_of_one_depth_apart() {
    let (world, views) = (two_blocks(), cameras());
    let apart = |masked: usize| {
        let tree = grown(&world, &views, masked);
        let [a, b] = [NARROW, WIDE].map(|at| leaf(&tree, &world, &views[3], at));
        // By average linkage: its heights are distances.
        tree.trees[3].merges.height[tree.trees[3].merges.meet(a, b) as usize]
    };
    let (all, most, none) = (apart(views.len()), apart(views.len() - 1), apart(0));
    assert!(none < 0.5 * all, "{none} {all}");
    // A photo whose masks were given up does not take from what the others agree on.
    assert!(most > 0.8 * all, "{most} {all}");
}
