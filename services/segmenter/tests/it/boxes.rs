//! Boxes that the scene tree answers (method, section 13).

use crate::surfaces::{BLOCK, WALL, answer, views, world};
use glam::Vec3;
use segwild_scene::{BoxPrompt, PointPrompt, Prompts};
use segwild_segmenter::{Alternative, Segmented};

/// A box around a part of what lies at the depth of the block, from one corner to another.
fn around(from: [f32; 2], to: [f32; 2]) -> BoxPrompt {
    let view = &views(1.0)[4];
    let [a, b] = [from, to].map(|[x, y]| view.camera.pixel(view.pose.to_camera(Vec3::new(x, y, 3.2))));
    BoxPrompt { x0: a.x, y0: a.y, x1: b.x, y1: b.y }
}

fn prompts(boxes: Vec<BoxPrompt>, points: Vec<PointPrompt>) -> Prompts {
    Prompts { boxes, points, ..Prompts::default() }
}

fn order(answer: &Segmented) -> Vec<std::mem::Discriminant<Alternative>> {
    answer.alternatives.iter().map(std::mem::discriminant).collect()
}

#[test]
fn a_box_around_a_block_selects_it_and_a_click_beside_the_box_keeps_the_numbers_of_the_alternatives() {
    let world = world(2.6);
    let block = around([-0.87, -0.47], [0.07, 0.47]);
    let alone = answer(&world, prompts(vec![block], Vec::new()));
    assert!(matches!(alone.alternatives[0], Alternative::Group(_)), "{:?}", alone.alternatives);
    assert!(matches!(alone.alternatives[1], Alternative::Photo), "{:?}", alone.alternatives);
    let share = |of: &Segmented, thing| world.share(thing, &of.selection.labels);
    assert!(share(&alone, BLOCK) > 0.9 && share(&alone, WALL) < 0.05);
    // On the wall, right of the block.
    let beside = around([0.4, 0.0], [0.4, 0.0]);
    let negative = PointPrompt { x: beside.x0, y: beside.y0, inside: false };
    let corrected = answer(&world, prompts(vec![block], vec![negative]));
    assert_eq!(order(&alone), order(&corrected));
    assert!(share(&corrected, BLOCK) > 0.9 && share(&corrected, WALL) < 0.05);
}

#[test]
fn several_boxes_in_one_photo_are_answered_by_its_own_mask() {
    let world = world(2.6);
    let halves = vec![around([-0.87, -0.47], [-0.4, 0.47]), around([-0.4, -0.47], [0.07, 0.47])];
    let both = answer(&world, prompts(halves, Vec::new()));
    assert!(both.alternatives.is_empty() && both.expected_iou.is_none());
    assert!(world.share(BLOCK, &both.selection.labels) > 0.5);
}
