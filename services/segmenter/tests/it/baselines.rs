//! The ways of selecting that other methods use, as settings of ours.

use crate::common::{TestRandom, TestWorld, engine, features, posed, request, walls};
use glam::Vec3;
use segwild_scene::{Mask, PointPrompt};
use segwild_segmenter::{
    ComponentRule, PosedView, PromptedView, Request, SegmentError, SegmentSettings, SimilarityUse,
    SplatFeatures, Undecided, Vote, select,
};

const MIDDLE: [PointPrompt; 1] = [PointPrompt { x: 80.0, y: 60.0, inside: true }];

/// Labels from a mask per view; the first view is clicked in the middle.
fn labels(
    world: &TestWorld,
    views: &[PosedView],
    masks: &[Mask],
    features: Option<&SplatFeatures>,
    settings: SegmentSettings,
) -> Result<Vec<bool>, SegmentError> {
    let engine = engine();
    let prompts: Vec<PromptedView> = masks
        .iter()
        .enumerate()
        .map(|(view, mask)| PromptedView {
            view,
            mask,
            open: None,
            points: if view == 0 { &MIDDLE } else { &[] },
            boxes: &[],
            refused: false,
        })
        .collect();
    let request = request(&engine, &world.splats, views, &prompts, &settings);
    Ok(select(&Request { features, ..request }, None)?.labels)
}

#[test]
fn resemblance_alone_takes_what_is_alike_wherever_masks_are() {
    let (world, view) = walls();
    let views = [view];
    // The mask holds a corner of the wall only.
    let corner = [Mask::from_fn(160, 120, |x, y| x < 90 && y < 70)];
    let settings = |components| SegmentSettings {
        similarity_use: SimilarityUse::Alone,
        components,
        ..SegmentSettings::default()
    };
    let field = features(&world, 8);
    let found = labels(&world, &views, &corner, Some(&field), settings(ComponentRule::All)).unwrap();
    assert_eq!((world.share(0, &found), world.share(1, &found), world.share(3, &found)), (1.0, 0.0, 0.0));
    // Where an occluded wall has the same features it is selected as well, unless only what is connected to the click stays.
    let same = world.thing.iter().map(|&t| if t == 3 { -1.0 } else { 1.0 }).collect();
    let alike = SplatFeatures::new(1, same).unwrap();
    let occluded_share = |components| {
        let found = labels(&world, &views, &corner, Some(&alike), settings(components)).unwrap();
        world.share(1, &found)
    };
    assert_eq!((occluded_share(ComponentRule::All), occluded_share(ComponentRule::Clicked)), (1.0, 0.0));
}

#[test]
fn resemblance_alone_without_features_is_refused_in_words() {
    let (world, view) = walls();
    let settings = SegmentSettings { similarity_use: SimilarityUse::Alone, ..SegmentSettings::default() };
    let refused = labels(&world, &[view], &[Mask::full(160, 120)], None, settings).unwrap_err();
    assert!(refused.to_string().contains("no feature field"), "{refused}");
}

#[test]
fn what_no_mask_decides_can_be_left_out() {
    let mut world = TestWorld::default();
    let mut dice = TestRandom(4);
    world.ball(0, Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.4), 1200, [0.7, 0.4, 0.2], &mut dice);
    let views = [posed("front.jpg", Vec3::ZERO, Vec3::Z)];
    let share = |undecided| {
        // What a photo sees less than a fifth of it does not decide: .2^1.5 of a view.
        let settings = SegmentSettings { undecided, least_evidence: 0.09, ..SegmentSettings::default() };
        let found = labels(&world, &views, &[Mask::full(160, 120)], None, settings).unwrap();
        world.share(0, &found)
    };
    // A camera sees less than half of a ball; its neighbours know the rest.
    let (follow, out) = (share(Undecided::Neighbours), share(Undecided::Out));
    assert!(follow > 0.8 && (0.2..0.6).contains(&out), "{follow} {out}");
}

#[test]
fn a_close_photo_outweighs_a_distant_one_by_its_light_and_not_by_views() {
    let mut world = TestWorld::default();
    world.wall(0, Vec3::new(0.0, 0.0, 2.0), 0.5, 20, [0.8, 0.3, 0.2], &mut TestRandom(1));
    // From four times as far the same wall fills a sixteenth of the pixels.
    let mut views = vec![posed("near.jpg", Vec3::ZERO, Vec3::Z)];
    views.extend((1..8).map(|i| posed(&format!("far{i}.jpg"), Vec3::new(0.0, 0.0, -6.0), Vec3::Z)));
    // The close photo says that the wall is the object; seven distant ones that it is not.
    let mut masks = vec![Mask::from_fn(160, 120, |x, _| x < 2); 8];
    masks[0] = Mask::full(160, 120);
    let share = |vote| {
        let settings = SegmentSettings {
            vote,
            undecided: Undecided::Out,
            components: ComponentRule::All,
            ..SegmentSettings::default()
        };
        let found = labels(&world, &views, &masks, None, settings);
        found.map_or(0.0, |labels| world.share(0, &labels))
    };
    let (light, view) = (share(Vote::Light), share(Vote::View));
    assert!(light > 0.9 && view < 0.5, "{light} {view}");
}
