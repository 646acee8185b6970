//! Selections on scenes of known objects.

use crate::common::{TestRandom, TestWorld, engine, features, options, posed, request, walls};
use glam::{Vec2, Vec3};
use segwild_objective::Engine;
use segwild_raster::Rasterizer;
use segwild_scene::{Mask, PointPrompt, Splats};
use segwild_segmenter::coverage::{coverage, unoccluded};
use segwild_segmenter::{
    ComponentRule, Evidence, EvidenceMode, NeighbourGraph, PhotoVerdict, PhotoVisit, PosedView, PromptedView,
    Request, SceneAffinities, SegmentError, SegmentSettings, Selection, SimilarityUse, SpikeCut,
    SplatFeatures, Vote, amodal_mask, cut, hit, select, visible_mask,
};

fn click(x: f32, y: f32) -> PointPrompt {
    PointPrompt { x, y, inside: true }
}

struct SelectionCase<'a> {
    engine: &'a dyn Engine,
    splats: &'a Splats,
    view: &'a PosedView,
    mask: &'a Mask,
    points: &'a [PointPrompt],
    features: Option<&'a SplatFeatures>,
    frozen: Option<&'a [bool]>,
    settings: SegmentSettings,
}

impl SelectionCase<'_> {
    fn run(&self) -> Result<Selection, SegmentError> {
        let prompts = [PromptedView {
            view: 0,
            mask: self.mask,
            open: None,
            points: self.points,
            refused: false,
            boxes: &[],
        }];
        let views = std::slice::from_ref(self.view);
        let request = request(self.engine, self.splats, views, &prompts, &self.settings);
        select(&Request { features: self.features, frozen: self.frozen, ..request }, None)
    }
}

fn front_mask(world: &TestWorld, view: &PosedView) -> Mask {
    visible_mask(&engine(), &world.splats, &world.is(0), &options(), &view.camera, &view.pose).unwrap()
}

#[test]
fn a_mask_that_includes_background_does_not_select_the_background() {
    let (mut world, mut dice) = (TestWorld::default(), TestRandom(5));
    world.wall(0, Vec3::new(0.0, 0.0, 2.0), 0.2, 20, [0.6, 0.6, 0.5], &mut dice);
    world.wall(1, Vec3::new(0.0, 0.0, 5.0), 2.0, 40, [0.6, 0.6, 0.5], &mut dice);
    let view = posed("front.jpg", Vec3::ZERO, Vec3::Z);
    // A third of the mask is wall of the same colour as the object before it.
    let front = front_mask(&world, &view);
    let piece = Mask::from_fn(160, 120, |x, y| (93..108).contains(&x) && (47..73).contains(&y));
    let mask = front.or(&piece);
    let engine = engine();
    let select = |points: &[PointPrompt]| {
        let case = SelectionCase {
            engine: &engine,
            splats: &world.splats,
            view: &view,
            mask: &mask,
            points,
            features: None,
            frozen: None,
            settings: SegmentSettings::default(),
        };
        case.run().unwrap().labels
    };
    let labels = select(&[click(80.0, 60.0)]);
    assert!(world.share(0, &labels) > 0.95, "{}", world.share(0, &labels));
    assert_eq!(world.share(1, &labels), 0.0);
    // Clicks on both select both.
    assert!(world.share(1, &select(&[click(80.0, 60.0), click(100.0, 60.0)])) > 0.02);
}

#[test]
fn an_occluded_wall_is_left_out_by_coverage_and_selected_by_centre() {
    let (world, view) = walls();
    let (engine, mask) = (engine(), front_mask(&world, &view));
    assert!(mask.count() > 3000);
    let same = SplatFeatures::new(1, vec![1.0; world.len()]).unwrap();
    let with = |mode, features| {
        let settings = SegmentSettings { evidence_mode: mode, ..SegmentSettings::default() };
        let points = [click(80.0, 60.0)];
        let case = SelectionCase {
            engine: &engine,
            splats: &world.splats,
            view: &view,
            mask: &mask,
            points: &points,
            features,
            frozen: None,
            settings,
        };
        case.run().unwrap().labels
    };
    // Even features that cannot distinguish the walls must not select the occluded one.
    for features in [None, Some(&same)] {
        let labels = with(EvidenceMode::Coverage, features);
        assert_eq!((world.share(1, &labels), world.share(3, &labels)), (0.0, 0.0));
        assert!(world.share(0, &labels) > 0.97, "{}", world.share(0, &labels));
    }
    let labels = with(EvidenceMode::Centre, None);
    assert!(world.share(1, &labels) > 0.9 && world.share(0, &labels) > 0.9);
}

#[test]
fn a_click_reads_what_the_full_render_shows_and_opacity_does_not_matter() {
    let (world, view) = walls();
    let (engine, field) = (engine(), features(&world, 8));
    let at = Vec2::new(70.3, 52.8);
    let read = |splats: &Splats| {
        let hit = hit(&engine, splats, &options(), &view.camera, &view.pose, at, 0).unwrap();
        (hit.feature(&field).unwrap(), hit.alpha)
    };
    let (feature, alpha) = read(&world.splats);
    let projected = engine.project(&world.splats, &view.camera, &view.pose, &options()).unwrap();
    let frame = projected.blend(&segwild_raster::Channels { count: 8, values: &field.values() }).unwrap();
    let a = frame.alpha.at(0, 70, 52);
    assert!((a - alpha).abs() < 1e-4);
    for c in 0..8 {
        assert!((frame.image.at(c, 70, 52) / a - feature[c]).abs() < 1e-3);
    }
    // Against one thing's features alone the cosine stays as everything becomes more transparent.
    let near: Vec<usize> = (0..world.len()).filter(|&i| world.thing[i] == 0).collect();
    let alone = world.splats.select(&near);
    let one = SplatFeatures::new(3, [0.6, -0.3, 0.2].repeat(near.len())).unwrap();
    let mut transparent = alone.clone();
    for (i, o) in transparent.opacities.iter_mut().enumerate() {
        let scaled = 0.3 * alone.opacity(i);
        *o = (scaled / (1.0 - scaled)).ln();
    }
    let cosine = |splats: &Splats| {
        let hit = hit(&engine, splats, &options(), &view.camera, &view.pose, at, 1).unwrap();
        (one.similarity(&engine, &[hit.feature(&one).unwrap()], 0.1).unwrap()[0], hit.alpha)
    };
    let ((full, thick), (thin, weak)) = (cosine(&alone), cosine(&transparent));
    assert!((full - thin).abs() < 1e-6 && weak < 0.8 * thick, "{full} {thin} {thick} {weak}");
}

#[test]
fn a_click_far_from_the_centre_of_a_deep_splat_hits_what_the_photo_shows() {
    let (mut world, view) = walls();
    let engine = engine();
    // It reaches far to the side and away from the camera, so that its footprint depends on where it is projected.
    let mut one = world.splats.select(&[0]);
    let camera = &view.camera;
    let to_world = |at: Vec3| view.pose.rotation.transpose() * (at - view.pose.translation);
    one.means[0] = to_world(Vec3::new(-0.9, 0.0, 4.0)).to_array();
    one.log_scales[0] = [1.2f32.ln(), 0.3f32.ln(), 1.2f32.ln()];
    one.opacities[0] = 2.0;
    world.splats = one;
    let projected = engine.project(&world.splats, camera, &view.pose, &options()).unwrap();
    let colours = segwild_raster::Channels { count: 1, values: &[1.0] };
    let alpha = projected.blend(&colours).unwrap().alpha;
    let middle = camera.pixel(Vec3::new(-0.9, 0.0, 4.0));
    let mut far = 0;
    for x in (2..camera.width - 2).step_by(7) {
        let at = Vec2::new(x as f32 + 0.5, middle.y.floor() + 0.5);
        let shown = alpha.at(0, x as usize, at.y as usize);
        let hit = hit(&engine, &world.splats, &options(), camera, &view.pose, at, 0).unwrap();
        assert!((shown - hit.alpha).abs() < 1e-4, "{at}: {shown}, hit {}", hit.alpha);
        far += u32::from(shown > 0.02 && (at.x - middle.x).abs() > 30.0);
    }
    assert!(far > 2, "{far} pixels show it far from its centre");
}

#[test]
fn clicks_that_cannot_be_served_are_refused_in_words() {
    let (world, view) = walls();
    let (engine, mask) = (engine(), front_mask(&world, &view));
    let sky = world.is(3);
    let lone = world.splats.select(&(0..900).collect::<Vec<_>>());
    let settings = SegmentSettings::default();
    let run = |splats: &Splats, mask: &Mask, points: &[PointPrompt], frozen: Option<&[bool]>| {
        let case = SelectionCase {
            engine: &engine,
            splats,
            view: &view,
            mask,
            points,
            features: None,
            frozen,
            settings: settings.clone(),
        };
        case.run()
    };
    let all = &world.splats;
    let cases = [
        (run(all, &mask, &[click(3.0, 3.0)], Some(&sky)), "on the sky"),
        (run(&lone, &mask, &[click(3.0, 3.0)], None), "nothing at the click (3, 3)"),
        (run(all, &mask, &[click(160.0, 3.0)], None), "outside its 160 x 120 pixels"),
        (run(all, &mask, &[click(f32::NAN, 3.0)], None), "outside its 160 x 120 pixels"),
        (run(all, &Mask::empty(160, 120), &[click(80.0, 60.0)], None), "mask of the prompts is empty"),
        (run(&Splats::default(), &mask, &[], None), "no splat belongs"),
        (run(all, &mask, &[], Some(&vec![true; world.len()])), "no splat belongs"),
        (run(all, &mask, &[], Some(&[true])), "1 frozen flags for 2700 splats"),
    ];
    for (result, words) in cases {
        let text = result.expect_err(words).to_string();
        assert!(text.contains(words), "{text}");
    }
    // A mask alone is a prompt as well.
    assert!(world.share(0, &run(all, &mask, &[], Some(&sky)).unwrap().labels) > 0.97);
}

#[test]
fn features_that_are_no_numbers_change_nothing_but_themselves() {
    let (world, view) = walls();
    let (engine, mask, field) = (engine(), front_mask(&world, &view), features(&world, 8));
    let mut values = field.values();
    for i in (0..world.len()).step_by(9) {
        values[i * 8 + 3] = f32::NAN;
    }
    let broken = SplatFeatures::new(8, values).unwrap();
    let mut splats = world.splats.clone();
    splats.means[5] = [f32::NAN; 3];
    let points = [click(80.0, 60.0)];
    let case = SelectionCase {
        engine: &engine,
        splats: &splats,
        view: &view,
        mask: &mask,
        points: &points,
        features: Some(&broken),
        frozen: None,
        settings: SegmentSettings::default(),
    };
    let selection = case.run().unwrap();
    assert!(world.share(0, &selection.labels) > 0.97 && world.share(1, &selection.labels) == 0.0);
    assert!(!selection.labels[5] && selection.score.iter().all(|s| (0.0..=1.0).contains(s)));
    let none = SplatFeatures::new(8, vec![f32::NAN; 8 * world.len()]).unwrap();
    assert!(world.share(0, &SelectionCase { features: Some(&none), ..case }.run().unwrap().labels) > 0.97);
}

#[test]
fn affinities_of_an_earlier_selection_change_nothing() {
    let (world, view) = walls();
    let (engine, mask, field) = (engine(), front_mask(&world, &view), features(&world, 8));
    let (settings, points) = (SegmentSettings::default(), [click(80.0, 60.0)]);
    let prompts =
        [PromptedView { view: 0, mask: &mask, open: None, points: &points, refused: false, boxes: &[] }];
    let views = std::slice::from_ref(&view);
    let graph = NeighbourGraph::new(&world.splats, settings.neighbours);
    let known = SceneAffinities::default();
    let request = request(&engine, &world.splats, views, &prompts, &settings);
    for features in [Some(&field), None, Some(&field)] {
        let request = Request { features, graph: Some(&graph), ..request };
        let alone = select(&request, None).unwrap();
        let with = select(&Request { affinities: Some(&known), ..request }, None).unwrap();
        assert_eq!((with.labels, with.score), (alone.labels, alone.score));
    }
}

#[test]
fn a_negative_click_takes_its_thing_out() {
    // Two balls side by side; the mask wrongly covers both, features and the negative click tell them apart.
    let mut world = TestWorld::default();
    let mut dice = TestRandom(4);
    world.ball(0, Vec3::new(-0.3, 0.0, 2.0), Vec3::splat(0.3), 900, [0.7, 0.4, 0.2], &mut dice);
    world.ball(1, Vec3::new(0.3, 0.0, 2.0), Vec3::splat(0.3), 900, [0.7, 0.4, 0.2], &mut dice);
    let view = posed("both.jpg", Vec3::ZERO, Vec3::Z);
    let engine = engine();
    let mask =
        visible_mask(&engine, &world.splats, &vec![true; world.len()], &options(), &view.camera, &view.pose)
            .unwrap();
    let centre = |i: f32| view.camera.pixel(view.pose.to_camera(Vec3::new(i * 0.3, 0.0, 1.7)));
    let (yes, no) = (centre(-1.0), centre(1.0));
    // The features resemble each other: tau alone lets both pass.
    let values = world.thing.iter().flat_map(|&t| if t == 0 { [1.0, 0.4] } else { [1.0, -0.1] }).collect();
    let field = SplatFeatures::new(2, values).unwrap();
    let settings = SegmentSettings { similarity_use: SimilarityUse::Gate, ..SegmentSettings::default() };
    let run = |points: &[PointPrompt]| {
        let case = SelectionCase {
            engine: &engine,
            splats: &world.splats,
            view: &view,
            mask: &mask,
            points,
            features: Some(&field),
            frozen: None,
            settings: settings.clone(),
        };
        case.run().unwrap().labels
    };
    let labels = run(&[click(yes.x, yes.y)]);
    assert!(world.share(1, &labels) > 0.3);
    let labels = run(&[click(yes.x, yes.y), PointPrompt { x: no.x, y: no.y, inside: false }]);
    assert!(world.share(0, &labels) > 0.4 && world.share(1, &labels) == 0.0);
}

#[test]
fn the_cut_makes_the_object_fit_its_mask_better() {
    // The front wall with spikes that stick out of it to the right.
    let (mut world, view) = walls();
    let mut dice = TestRandom(31);
    for _ in 0..60 {
        let p = Vec3::new(0.47, dice.next() - 0.5, 1.99);
        world.disc(0, p, Vec3::NEG_Z, 0.01, [0.8, 0.3, 0.2]);
        world.splats.log_scales.last_mut().unwrap()[0] = 0.08f32.ln();
        *world.splats.rotations.last_mut().unwrap() = [1.0, 0.0, 0.0, 0.0];
    }
    let engine = engine();
    // What the photo shows: the wall without spikes.
    let mask = front_mask(&walls().0, &view);
    let points = [click(80.0, 60.0)];
    let prompts =
        [PromptedView { view: 0, mask: &mask, open: None, points: &points, refused: false, boxes: &[] }];
    let settings = SegmentSettings { components: ComponentRule::All, ..SegmentSettings::default() };
    let request = request(&engine, &world.splats, std::slice::from_ref(&view), &prompts, &settings);
    let selection = select(&request, None).unwrap();
    let cut = cut(&request, &selection).unwrap();
    assert!(cut.changed.len() > 20);
    let (scene, labels) = segwild_segmenter::cut_scene(&world.splats, &selection.labels, &cut);
    let fit = |splats: &Splats, labels: &[bool]| {
        amodal_mask(&engine, splats, labels, &options(), &view.camera, &view.pose).unwrap().iou(&mask)
    };
    let (before, after) = (fit(&world.splats, &selection.labels), fit(&scene, &labels));
    eprintln!("IoU before the cut {before:.4}, after {after:.4}");
    assert!(after > before + 0.02 && after > 0.97, "{before} {after}");
    let object = segwild_segmenter::SelectedObject::new(&world.splats, &selection.labels, &cut);
    assert_eq!(object.splats, scene.select(&object.indices.iter().map(|&i| i as usize).collect::<Vec<_>>()));
    assert_eq!(
        SpikeCut::default(),
        SpikeCut::new(&world.splats, &vec![false; world.len()], &[], settings.spikes, 0.01)
    );
}

#[test]
fn what_one_photo_alone_shows_is_left_out_unless_the_object_is_seen_once() {
    let (world, view) = walls();
    let (engine, mask) = (engine(), front_mask(&world, &view));
    let points = [click(80.0, 60.0)];
    let prompts =
        [PromptedView { view: 0, mask: &mask, open: None, points: &points, refused: false, boxes: &[] }];
    let settings = SegmentSettings::default();
    let request = request(&engine, &world.splats, std::slice::from_ref(&view), &prompts, &settings);
    let with = |seen_once: &[bool]| select(&Request { seen_once: Some(seen_once), ..request }, None);
    let whole = select(&request, None).unwrap();
    let tenth: Vec<bool> = (0..world.len()).map(|i| i % 10 == 0).collect();
    let without = with(&tenth).unwrap();
    let left: Vec<bool> = whole.labels.iter().zip(&tenth).map(|(label, once)| *label && !once).collect();
    assert_eq!(without.labels, left);
    let count = |labels: &[bool]| labels.iter().filter(|label| **label).count();
    assert_eq!(without.seen_once, count(&whole.labels) - count(&left));
    assert!(without.seen_once > 50 && without.agreement == whole.agreement);
    // No piece of them joins either.
    assert_eq!(without.frozen, Some(tenth.clone()));
    // Of one photo all is seen once: the object stays whole.
    let all = with(&vec![true; world.len()]).unwrap();
    assert!(all == whole && all.seen_once == 0);
    assert!(matches!(with(&tenth[1..]), Err(SegmentError::Shape(_))));
}

#[test]
fn a_splat_far_from_the_object_gives_it_no_piece_though_masks_hold_half_of_it() {
    // Two needles across the wall's right edge: one lies on the wall, the other five times as far from the camera.
    let (mut world, view) = walls();
    for z in [1.99, 10.0] {
        world.disc(2, Vec3::new(0.25 * z, 0.0, z), Vec3::NEG_Z, 0.01, [0.8, 0.3, 0.2]);
        world.splats.log_scales.last_mut().unwrap()[0] = (0.04 * z).ln();
        *world.splats.rotations.last_mut().unwrap() = [1.0, 0.0, 0.0, 0.0];
    }
    let n = world.len();
    let [near, far] = [n - 2, n - 1];
    let engine = engine();
    let mask = front_mask(&walls().0, &view);
    let prompts =
        [PromptedView { view: 0, mask: &mask, open: None, points: &[], refused: false, boxes: &[] }];
    let settings = SegmentSettings::default();
    let request = request(&engine, &world.splats, std::slice::from_ref(&view), &prompts, &settings);
    let mut evidence = Evidence::none(n);
    for needle in [near, far] {
        (evidence.inside[needle], evidence.outside[needle], evidence.known[needle]) = (0.4, 0.6, 1.0);
    }
    let visit = PhotoVisit {
        view: 0,
        verdict: PhotoVerdict::Accepted,
        agreement: 1.0,
        mask: Some(mask.clone()),
        refused: None,
        visibility: vec![255; n],
    };
    let selection = Selection {
        labels: world.is(0),
        score: vec![0.0; n],
        similarity: None,
        evidence,
        visits: vec![visit],
        frozen: None,
        parts_removed: 0,
        seen_once: 0,
        agreement: 1.0,
        alone: false,
    };
    let cut = cut(&request, &selection).unwrap();
    assert_eq!(cut.joined, [near as u32], "and not the far needle, {far}");
}

/// A tenth of a splat that shows beside something else decides its side like any other tenth, but adds little to what is known of
/// it.
#[test]
fn a_small_visible_share_of_a_splat_decides_its_side_and_leaves_it_unknown() {
    let view = posed("front.jpg", Vec3::ZERO, Vec3::Z);
    let (engine, size) = (engine(), (view.camera.width, view.camera.height));
    // Of the disc's mask a half is inside, whatever stands before it.
    let upper: Vec<f32> =
        (0..size.0 * size.1).map(|i| f32::from(u8::from(i / size.0 < size.1 / 2))).collect();
    let evidence = |before: bool| {
        let mut world = TestWorld::default();
        world.disc(0, Vec3::new(0.0, 0.0, 2.0), Vec3::NEG_Z, 0.2, [0.5; 3]);
        if before {
            world.disc(1, Vec3::new(0.0, 0.0, 1.0), Vec3::NEG_Z, 0.2, [0.5; 3]);
        }
        let whole = unoccluded(&world.splats, &view.camera, &view.pose, &options());
        let projected = engine.project(&world.splats, &view.camera, &view.pose, &options()).unwrap();
        let ones = vec![1.0; upper.len()];
        let of = |vote| coverage(&*projected, &whole, &upper, &ones, size, vote).unwrap();
        (of(Vote::View), of(Vote::Light))
    };
    let ((free, _), (occluded, light)) = (evidence(false), evidence(true));
    let share = occluded.seen(0) / free.seen(0);
    assert!(share > 0.02 && share < 0.3, "{share}");
    assert!((occluded.rho(0).unwrap() - 0.5).abs() < 0.01 && (free.rho(0).unwrap() - 0.5).abs() < 0.01);
    assert!(occluded.known[0] < 0.6 * share * free.known[0], "{} {}", occluded.known[0], free.known[0]);
    let (for_it, against) = occluded.sides(0);
    assert!((for_it + against - occluded.known[0]).abs() < 1e-6);
    // By light it is known by all that is seen of it.
    assert_eq!(light.known[0], light.seen(0));
    // Small shares add up, and without any nothing is known.
    let mut ten = Evidence::none(2);
    (0..10).for_each(|_| ten.add(&occluded, 1.0));
    assert!((ten.known[0] - 10.0 * occluded.known[0]).abs() < 1e-5);
    assert_eq!(Evidence::none(2).sides(0), (0.0, 0.0));
}
