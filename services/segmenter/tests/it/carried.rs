//! Selections that are carried from the prompted photo to the others.

use crate::common::{TestRandom, TestWorld, engine, features, options, posed, request};
use glam::Vec3;
use segwild_objective::Engine;
use segwild_scene::{BoxPrompt, Image, Mask, PointPrompt, Splats};
use segwild_segmenter::{
    AnswerStep, AnswerSteps, MaskReader, PosedView, PromptedView, Refiner, Request, SegmentError,
    SegmentSettings, Selection, SplatFeatures, cut, select, visible_mask,
};
use std::collections::BTreeSet;
use std::sync::Mutex;

fn click(x: f32, y: f32) -> PointPrompt {
    PointPrompt { x, y, inside: true }
}

/// The mask of the prompts on the first photo, without clicks.
fn prompted(mask: &Mask) -> PromptedView<'_> {
    PromptedView { view: 0, mask, open: None, points: &[], refused: false, boxes: &[] }
}

/// The regions of a photo that are inside with a mean certainty over `least`.
pub(super) fn likelier(regions: &[Mask], certainty: &Image, least: f32) -> Mask {
    let inside = |region: &&Mask| {
        let sum: f32 = region.pixels().map(|(x, y)| certainty.at(0, x as usize, y as usize)).sum();
        sum > least * region.count() as f32
    };
    regions.iter().filter(inside).fold(Mask::empty(160, 120), |mask, region| mask.or(region))
}

/// A statue on a plinth (thing 0), a tree beside it (1), ground (2) and a sky shell (3); photos all around.
fn square() -> (TestWorld, Vec<PosedView>) {
    let mut world = TestWorld::default();
    let mut dice = TestRandom(8);
    world.ball(0, Vec3::new(0.0, -0.3, 0.0), Vec3::new(0.14, 0.3, 0.14), 1500, [0.4, 0.6, 0.5], &mut dice);
    world.ball(0, Vec3::new(0.0, 0.1, 0.0), Vec3::new(0.22, 0.16, 0.22), 1200, [0.7, 0.6, 0.5], &mut dice);
    world.ball(1, Vec3::new(0.45, 0.0, 0.25), Vec3::new(0.15, 0.25, 0.15), 900, [0.2, 0.5, 0.2], &mut dice);
    for i in 0..50 {
        for k in 0..50 {
            let at = |n: i32, d: &mut TestRandom| (n as f32 - 24.5 + 0.2 * d.next()) * 0.06;
            let p = Vec3::new(at(i, &mut dice), 0.25, at(k, &mut dice));
            world.disc(2, p, Vec3::NEG_Y, 0.04, [0.5, 0.5, 0.45]);
        }
    }
    world.ball(3, Vec3::ZERO, Vec3::splat(20.0), 800, [0.5, 0.7, 1.0], &mut dice);
    let views = (0..20)
        .map(|i| {
            let turn = i as f32 * std::f32::consts::TAU / 20.0;
            let (r, h) = (1.2 + 0.3 * dice.next(), 0.1 + 0.4 * dice.next());
            posed(
                &format!("{i:02}.jpg"),
                Vec3::new(r * turn.sin(), -h, -r * turn.cos()),
                Vec3::new(0.0, -0.15, 0.0),
            )
        })
        .collect();
    (world, views)
}

struct SquareScene {
    world: TestWorld,
    views: Vec<PosedView>,
    /// Per view and thing: the true pixels.
    truth: Vec<Vec<Mask>>,
}

impl SquareScene {
    fn new() -> SquareScene {
        let (world, views) = square();
        let truth = regions(&world, &views, &[0, 1, 2, 3]);
        SquareScene { world, views, truth }
    }

    fn select(
        &self,
        first: usize,
        engine: &dyn Engine,
        splats: &Splats,
        frozen: &[bool],
        settings: &SegmentSettings,
        refine: bool,
    ) -> Selection {
        let prompts = [PromptedView {
            view: first,
            mask: &self.truth[first][0],
            open: None,
            points: &[],
            refused: false,
            boxes: &[],
        }];
        let request = request(engine, splats, &self.views, &prompts, settings);
        let request = Request { frozen: Some(frozen), ..request };
        // A 2D segmenter that knows the photo's regions but not which is meant: it takes those that are more
        // likely inside than not. In every fifth photo it is wrong, and sure of it.
        let snap = |view: usize, certainty: &Image| {
            let mut mask = likelier(&self.truth[view], certainty, 0.5);
            if view % 5 == 3 {
                mask = self.truth[view][2].clone();
            }
            Some((mask, 0.9_f32))
        };
        select(&request, refine.then_some(&snap as &dyn Refiner)).unwrap()
    }

    /// A request from photo `first` whose prompts mean these things.
    fn with<T>(
        &self,
        prompts: &[PromptedView],
        settings: &SegmentSettings,
        work: impl FnOnce(&Request) -> T,
    ) -> T {
        let (engine, sky) = (engine(), self.world.is(3));
        let request = request(&engine, &self.world.splats, &self.views, prompts, settings);
        work(&Request { frozen: Some(&sky), ..request })
    }

    fn mean_iou(&self, splats: &Splats, labels: &[bool], first: usize) -> f64 {
        let engine = engine();
        let others = (0..self.views.len()).filter(|v| *v != first);
        let ious: Vec<f64> = others
            .map(|v| {
                let (camera, pose) = (&self.views[v].camera, &self.views[v].pose);
                visible_mask(&engine, splats, labels, &options(), camera, pose)
                    .unwrap()
                    .iou(&self.truth[v][0])
            })
            .collect();
        ious.iter().sum::<f64>() / ious.len() as f64
    }
}

#[test]
fn one_photo_selects_the_statue_for_the_whole_circle() {
    let square = SquareScene::new();
    let (engine, splats, sky) = (engine(), &square.world.splats, square.world.is(3));
    let settings = SegmentSettings::default();
    for first in [0, 7] {
        let selection = square.select(first, &engine, splats, &sky, &settings, true);
        let iou = square.mean_iou(splats, &selection.labels, first);
        let alone = square.select(first, &engine, splats, &sky, &settings, false);
        let base = square.mean_iou(splats, &alone.labels, first);
        eprintln!("from photo {first}: IoU on the others {iou:.3}, without propagation {base:.3}");
        assert!(iou > 0.95 && base < iou, "{iou} {base}");
        let accepted =
            |v: &&segwild_segmenter::PhotoVisit| v.verdict == segwild_segmenter::PhotoVerdict::Accepted;
        assert!(selection.visits.iter().filter(accepted).count() >= 12);
        assert!(selection.visits.iter().filter(|v| v.view % 5 == 3).all(|v| v.mask.is_none()));
        assert_eq!(square.world.share(3, &selection.labels), 0.0);
    }
}

/// Knows which regions a photo has, and records which photos were prepared before their turn, and which were refined.
struct RecordingRefiner<'a> {
    square: &'a SquareScene,
    prepared: Mutex<BTreeSet<usize>>,
    refined: Mutex<BTreeSet<usize>>,
}

impl Refiner for RecordingRefiner<'_> {
    fn refine(&self, view: usize, certainty: &Image) -> Option<(Mask, f32)> {
        self.refined.lock().unwrap().insert(view);
        Some((likelier(&self.square.truth[view], certainty, 0.5), 0.9))
    }

    fn prepare(&self, view: usize) {
        assert!(self.prepared.lock().unwrap().insert(view), "photo {view} is prepared once");
    }
}

#[test]
fn however_many_threads_there_are_the_selection_is_the_same() {
    let square = SquareScene::new();
    let prompts = [prompted(&square.truth[0][0])];
    let settings = SegmentSettings::default();
    let select = |threads: usize| {
        let refiner =
            RecordingRefiner { square: &square, prepared: Mutex::default(), refined: Mutex::default() };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let selection = square
            .with(&prompts, &settings, |request| pool.install(|| select(request, Some(&refiner)).unwrap()));
        (selection, refiner.prepared.into_inner().unwrap(), refiner.refined.into_inner().unwrap())
    };
    let (alone, none, _) = select(1);
    assert!(none.is_empty(), "a single thread prepares no photos");
    for threads in [2, 5] {
        let (selection, prepared, refined) = select(threads);
        assert!(selection == alone, "{threads} threads");
        assert!(prepared.len() > 4 && prepared.is_subset(&refined), "{prepared:?} of {refined:?}");
    }
}

/// Collects the steps of an answer, and waits for it no longer than until one of them.
struct StepList {
    seen: Mutex<Vec<(AnswerStep, Vec<bool>)>>,
    until: Option<AnswerStep>,
}

impl AnswerSteps for StepList {
    fn publish(&self, step: AnswerStep, labels: Vec<bool>) {
        self.seen.lock().unwrap().push((step, labels));
    }

    fn cancelled(&self) -> bool {
        let seen = self.seen.lock().unwrap();
        self.until.is_some() && seen.last().map(|(step, _)| *step) == self.until
    }
}

#[test]
fn an_answer_grows_in_steps_and_a_cancelled_one_asks_no_further_photo() {
    let square = SquareScene::new();
    let prompts = [prompted(&square.truth[0][0])];
    let settings = SegmentSettings::default();
    let select_until = |until| {
        let steps = StepList { seen: Mutex::default(), until };
        let refiner =
            RecordingRefiner { square: &square, prepared: Mutex::default(), refined: Mutex::default() };
        let selected = square
            .with(&prompts, &settings, |r| select(&Request { steps: Some(&steps), ..*r }, Some(&refiner)));
        (selected, steps.seen.into_inner().unwrap(), refiner.refined.into_inner().unwrap().len())
    };
    let others = square.views.len() - 1;
    let (selection, seen, refined) = select_until(None);
    let selection = selection.unwrap();
    let names: Vec<AnswerStep> = seen.iter().map(|(step, _)| *step).collect();
    assert_eq!(names, [AnswerStep::Prompted, AnswerStep::Photos(8), AnswerStep::Photos(others)]);
    assert_eq!(refined, others);
    let ious: Vec<f64> =
        seen.iter().map(|(_, labels)| square.mean_iou(&square.world.splats, labels, 0)).collect();
    println!("IoU of the steps: {ious:.3?}");
    assert!(ious[2] > ious[0] && ious[2] > 0.95, "{ious:?}");
    let unwatched = square.with(&prompts, &settings, |request| {
        let refine =
            |view: usize, certainty: &Image| Some((likelier(&square.truth[view], certainty, 0.5), 0.9_f32));
        select(request, Some(&refine)).unwrap()
    });
    assert!(selection == unwatched, "being watched changes nothing");
    for (until, most) in
        [(AnswerStep::Prompted, 0), (AnswerStep::Photos(8), 8), (AnswerStep::Photos(others), others)]
    {
        let (selection, seen, refined) = select_until(Some(until));
        assert!(matches!(selection, Err(SegmentError::Cancelled)), "{until:?}");
        assert_eq!((seen.last().unwrap().0, refined), (until, most));
    }
}

#[test]
fn photos_that_take_the_selection_elsewhere_are_not_followed() {
    let square = SquareScene::new();
    let prompts = [prompted(&square.truth[0][0])];
    // A hundredth of the prompted photo's evidence is to count.
    let (propagate_gate, prompt_weight, least_evidence) = (0.0, 0.01, 0.0);
    let settings =
        SegmentSettings { propagate_gate, prompt_weight, least_evidence, ..SegmentSettings::default() };
    // All photos give the tree's mask.
    let tree = |view: usize, _: &segwild_scene::Image| Some((square.truth[view][1].clone(), 1.0_f32));
    let selection = square.with(&prompts, &settings, |request| {
        let selection = select(request, Some(&tree)).unwrap();
        cut(request, &selection).unwrap();
        selection
    });
    assert!(selection.alone && selection.agreement > 0.7, "{}", selection.agreement);
    assert!(square.world.share(0, &selection.labels) > 0.3);
    assert_eq!(square.world.share(1, &selection.labels), 0.0);
    assert!(selection.visits.iter().all(|v| v.mask.is_none()), "their masks cut nothing");
}

#[test]
fn a_click_on_another_photo_can_say_what_is_not_meant() {
    let square = SquareScene::new();
    // Statue and tree in the first photo, as if the tree had leaked in; the tree clicked away in another.
    let both = square.truth[0][0].or(&square.truth[0][1]);
    let leaked = prompted(&both);
    let settings = SegmentSettings::default();
    let share = |prompts: &[PromptedView]| {
        let labels = square.with(prompts, &settings, |request| select(request, None).unwrap().labels);
        (square.world.share(0, &labels), square.world.share(1, &labels))
    };
    let before = share(&[leaked]);
    let (x, y) = square.truth[4][1].pixels().nth(square.truth[4][1].count() / 2).unwrap();
    let points = [PointPrompt { x: x as f32 + 0.5, y: y as f32 + 0.5, inside: false }];
    let refusal = PromptedView {
        view: 4,
        mask: &square.truth[4][1],
        open: None,
        points: &points,
        refused: true,
        boxes: &[],
    };
    let after = share(&[leaked, refusal]);
    assert!(before.1 > 0.3 && after.1 < 0.5 * before.1, "{before:?} {after:?}");
    assert!(after.0 > 0.95 * before.0, "{before:?} {after:?}");
    let alone = square.with(&[refusal], &settings, |request| select(request, None).unwrap_err());
    assert!(matches!(alone, SegmentError::NoPrompt));
}

#[test]
fn ground_that_every_other_photo_holds_stays_out_of_a_box_that_ends_at_the_foot() {
    let square = SquareScene::new();
    let mask = &square.truth[0][0];
    let bounds = mask.pixels().fold([f32::MAX, f32::MAX, 0.0f32, 0.0f32], |b, (x, y)| {
        let (x, y) = (x as f32, y as f32);
        [b[0].min(x), b[1].min(y), b[2].max(x + 1.0), b[3].max(y + 1.0)]
    });
    let frame = [BoxPrompt { x0: bounds[2], y0: bounds[1], x1: bounds[0], y1: bounds[3] }];
    // The other photos take the ground for a part of the statue.
    let leaking = |view: usize, _: &Image| Some((square.truth[view][0].or(&square.truth[view][2]), 1.0_f32));
    let settings = SegmentSettings { propagate_gate: 0.0, ..SegmentSettings::default() };
    // Selected pixels of the prompted photo that lie well outside of the box.
    let outside = |boxes: &[BoxPrompt], points: &[PointPrompt]| {
        let prompts = [PromptedView { view: 0, mask, open: None, points, refused: false, boxes }];
        let labels =
            square.with(&prompts, &settings, |request| select(request, Some(&leaking)).unwrap().labels);
        let view = &square.views[0];
        let shown =
            visible_mask(&engine(), &square.world.splats, &labels, &options(), &view.camera, &view.pose)
                .unwrap();
        let far = |(x, y): &(u32, u32)| {
            let (x, y) = (*x as f32, *y as f32);
            x < bounds[0] - 8.0 || x > bounds[2] + 8.0 || y < bounds[1] - 8.0 || y > bounds[3] + 8.0
        };
        shown.pixels().filter(far).count()
    };
    let (loose, boxed) = (outside(&[], &[]), outside(&frame, &[]));
    assert!(loose > 500, "without a box the ground comes along: {loose}");
    assert!(boxed * 20 < loose, "{boxed} of {loose}");
    // A click outside of the box says that the box is no bound.
    let (x, y) = square.truth[0][2].pixels().last().unwrap();
    let clicked = outside(&frame, &[click(x as f32 + 0.5, y as f32 + 0.5)]);
    assert!(clicked > 500, "{clicked}");
}

#[test]
fn a_box_within_a_photo_leaves_out_what_lies_beyond_the_frame_and_a_box_at_the_frame_does_not() {
    let square = SquareScene::new();
    let view = &square.views[0];
    let mask = &square.truth[0][0];
    // The other photos take the whole ground for a part of the statue.
    let leaking = |view: usize, _: &Image| Some((square.truth[view][0].or(&square.truth[view][2]), 1.0_f32));
    let settings = SegmentSettings { propagate_gate: 0.0, ..SegmentSettings::default() };
    let beyond: Vec<usize> = (0..square.world.len())
        .filter(|&i| {
            let at = view.pose.to_camera(square.world.splats.mean(i));
            square.world.thing[i] == 2 && (at.z <= 0.0 || !view.camera.contains(view.camera.pixel(at)))
        })
        .collect();
    assert!(beyond.len() > 200, "{}", beyond.len());
    let selected = |boxes: &[BoxPrompt]| {
        let prompts = [PromptedView { view: 0, mask, open: None, points: &[], refused: false, boxes }];
        let labels =
            square.with(&prompts, &settings, |request| select(request, Some(&leaking)).unwrap().labels);
        beyond.iter().filter(|&&i| labels[i]).count()
    };
    let within = BoxPrompt { x0: 20.0, y0: 10.0, x1: 140.0, y1: 110.0 };
    // Those that reach into the photo are decided by its pixels.
    assert!(selected(&[within]) < 5, "{}", selected(&[within]));
    let at_the_frame = BoxPrompt { x0: 0.0, y0: 0.0, x1: 160.0, y1: 120.0 };
    assert!(selected(&[at_the_frame]) > 100, "the object may go on beyond the frame");
}

/// What each photo shows of some things.
pub(super) fn regions(world: &TestWorld, views: &[PosedView], things: &[usize]) -> Vec<Vec<Mask>> {
    let engine = engine();
    let region = |v: &PosedView, t: usize| {
        visible_mask(&engine, &world.splats, &world.is(t), &options(), &v.camera, &v.pose).unwrap()
    };
    views.iter().map(|v| things.iter().map(|t| region(v, *t)).collect()).collect()
}

/// The labels that a click in the middle of the first photo's first region gives, carried to photos that take every region
/// whose mean certainty is over `least`; `open`: what the first photo leaves open; `transients`: what is known to stand before
/// the scene.
fn carried(
    world: &TestWorld,
    views: &[PosedView],
    truth: &[Vec<Mask>],
    field: &SplatFeatures,
    open: Option<&Image>,
    transients: Option<&MaskReader>,
    least: f32,
) -> Vec<bool> {
    let engine = engine();
    let mask = &truth[0][0];
    let (x, y) = mask.pixels().nth(mask.count() / 2).unwrap();
    let points = [click(x as f32 + 0.5, y as f32 + 0.5)];
    let prompts = [PromptedView { view: 0, mask, open, points: &points, refused: false, boxes: &[] }];
    let (settings, sky) = (SegmentSettings::default(), world.is(3));
    let request = request(&engine, &world.splats, views, &prompts, &settings);
    let request = Request { features: Some(field), frozen: Some(&sky), transients, ..request };
    let snap = |view: usize, certainty: &Image| Some((likelier(&truth[view], certainty, least), 0.9_f32));
    select(&request, Some(&snap)).unwrap().labels
}

/// A statue (thing 0) on a pedestal (1) that resembles it, and ten photos around them.
fn statue_and_pedestal() -> (TestWorld, Vec<PosedView>, SplatFeatures) {
    let mut world = TestWorld::default();
    let mut dice = TestRandom(4);
    world.ball(0, Vec3::new(0.0, -0.25, 0.0), Vec3::new(0.16, 0.3, 0.16), 2500, [0.4, 0.6, 0.5], &mut dice);
    world.ball(1, Vec3::new(0.0, 0.2, 0.0), Vec3::new(0.2, 0.18, 0.2), 2500, [0.7, 0.7, 0.6], &mut dice);
    world.ball(3, Vec3::ZERO, Vec3::splat(20.0), 800, [0.5, 0.7, 1.0], &mut dice);
    let views = (0..10)
        .map(|i| {
            let (sin, cos) = (i as f32 * std::f32::consts::TAU / 10.0).sin_cos();
            posed(&format!("{i:02}.jpg"), Vec3::new(1.2 * sin, -0.1, -1.2 * cos), Vec3::ZERO)
        })
        .collect();
    let thing = world.thing.iter().map(|t| if *t == 1 { 0 } else { *t }).collect();
    let field = features(&TestWorld { thing, ..TestWorld::default() }, 4);
    (world, views, field)
}

#[test]
fn a_part_that_the_click_left_open_is_not_held_against_it() {
    let (world, views, field) = statue_and_pedestal();
    // The first photo's mask holds the statue alone.
    let truth = regions(&world, &views, &[0, 1]);
    let share = |open: Option<&Image>| {
        let labels = carried(&world, &views, &truth, &field, open, None, 0.35);
        (world.share(0, &labels), world.share(1, &labels))
    };
    let mut open = Image::zeros(160, 120, 1);
    let pedestal = &truth[0][1];
    (0..160 * 120).filter(|&i| pedestal.index(i)).for_each(|i| open.data[i] = 0.45);
    let (sure, uncertain) = (share(None), share(Some(&open)));
    assert!(sure.0 > 0.9 && sure.1 < 0.05, "a mask that leaves nothing open: {sure:?}");
    assert!(uncertain.0 > 0.9 && uncertain.1 > 0.9, "{uncertain:?}");
    open.data.fill(f32::NAN);
    assert_eq!(share(Some(&open)), sure, "what is no number opens nothing");
}

#[test]
fn a_pedestal_whose_foot_transients_hide_in_all_other_photos_comes_along_whole() {
    let (world, views, field) = statue_and_pedestal();
    let shown = regions(&world, &views, &[0, 1]);
    // In all photos but the first somebody stands before the lower half of the pedestal, and masks end there.
    let foot = |pedestal: &Mask| {
        let (_, middle) = pedestal.pixels().nth(pedestal.count() / 2).unwrap();
        Mask::from_fn(160, 120, |x, y| y >= middle && pedestal.get(x, y))
    };
    let feet: Vec<Mask> = shown.iter().map(|regions| foot(&regions[1])).collect();
    let seen = |view: usize| {
        let whole = shown[view][0].or(&shown[view][1]);
        if view == 0 { whole } else { whole.minus(&feet[view]) }
    };
    let truth: Vec<Vec<Mask>> = (0..views.len()).map(|view| vec![seen(view)]).collect();
    let transients = move |view: usize| (view > 0).then(|| feet[view].clone());
    let share = |transients: Option<&MaskReader>| {
        let labels = carried(&world, &views, &truth, &field, None, transients, 0.35);
        (world.share(0, &labels), world.share(1, &labels))
    };
    let (unknown, known) = (share(None), share(Some(&transients)));
    assert!(unknown.0 > 0.9 && known.0 > 0.9 && known.1 > unknown.1 + 0.15, "{unknown:?} {known:?}");
}

#[test]
fn a_shield_beside_its_bearer_stays_where_all_photos_show_it() {
    let mut world = TestWorld::default();
    let mut dice = TestRandom(6);
    world.ball(0, Vec3::new(0.0, 0.0, 0.0), Vec3::new(0.16, 0.4, 0.16), 2500, [0.4, 0.6, 0.5], &mut dice);
    world.ball(1, Vec3::new(0.0, -0.75, 0.0), Vec3::splat(0.08), 30, [0.7, 0.7, 0.6], &mut dice);
    world.ball(3, Vec3::ZERO, Vec3::splat(20.0), 800, [0.5, 0.7, 1.0], &mut dice);
    let views: Vec<PosedView> = (0..10)
        .map(|i| {
            let (sin, cos) = (i as f32 * std::f32::consts::TAU / 10.0).sin_cos();
            posed(&format!("{i:02}.jpg"), Vec3::new(1.6 * sin, -0.3, -1.6 * cos), Vec3::new(0.0, -0.2, 0.0))
        })
        .collect();
    let shown = regions(&world, &views, &[0, 1]);
    let whole = |view: usize| vec![shown[view][0].or(&shown[view][1])];
    let all: Vec<Vec<Mask>> = (0..10).map(whole).collect();
    // Or one photo's mask takes it along, and no other does.
    let one: Vec<Vec<Mask>> =
        (0..10).map(|view| if view == 0 { whole(0) } else { vec![shown[view][0].clone()] }).collect();
    let share = |truth: &[Vec<Mask>]| {
        let labels = carried(&world, &views, truth, &features(&world, 4), None, None, 0.35);
        (world.share(0, &labels), world.share(1, &labels))
    };
    let (all, one) = (share(&all), share(&one));
    assert!(all.0 > 0.9 && all.1 > 0.9 && one.0 > 0.9 && one.1 < 0.1, "{all:?} {one:?}");
}

#[test]
fn a_twin_that_the_prompted_photo_does_not_see_is_not_selected() {
    let (mut world, views) = square();
    let mut dice = TestRandom(5);
    // The same statue once more, right behind the first as the first photo sees it.
    let offset = Vec3::new(0.0, 0.0, 0.8);
    let mut ball =
        |at: Vec3, radii, count, colour| world.ball(4, at + offset, radii, count, colour, &mut dice);
    ball(Vec3::new(0.0, -0.3, 0.0), Vec3::new(0.12, 0.28, 0.12), 1500, [0.4, 0.6, 0.5]);
    ball(Vec3::new(0.0, 0.1, 0.0), Vec3::new(0.2, 0.15, 0.2), 1200, [0.7, 0.6, 0.5]);
    // Embeddings cannot tell them apart.
    let alike = TestWorld { thing: world.thing.iter().map(|t| t % 4).collect(), ..TestWorld::default() };
    let field = features(&alike, 4);
    let truth = regions(&world, &views, &[0, 1, 2, 4]);
    let labels = carried(&world, &views, &truth, &field, None, None, 0.6);
    assert!(world.share(0, &labels) > 0.9, "{}", world.share(0, &labels));
    assert!(world.share(4, &labels) < 0.05, "{}", world.share(4, &labels));
}

#[test]
fn ground_that_only_photos_from_above_show_is_not_let_in_by_the_first_of_them() {
    let mut world = TestWorld::default();
    let mut dice = TestRandom(3);
    world.ball(0, Vec3::new(0.0, -0.2, 0.0), Vec3::new(0.14, 0.4, 0.14), 2500, [0.4, 0.6, 0.5], &mut dice);
    world.ball(1, Vec3::new(0.0, 0.2, 0.0), Vec3::new(0.5, 0.08, 0.5), 2500, [0.7, 0.7, 0.7], &mut dice);
    world.ball(3, Vec3::ZERO, Vec3::splat(20.0), 800, [0.5, 0.7, 1.0], &mut dice);
    // Nine photos look up at the statue, three look down on what it stands on.
    let views: Vec<PosedView> = (0..12)
        .map(|i| {
            let (sin, cos) = (i as f32 * std::f32::consts::TAU / 12.0).sin_cos();
            let (height, target) = if i % 4 == 3 { (0.9, 0.0) } else { (0.0, -0.75) };
            posed(&format!("{i:02}.jpg"), Vec3::new(sin, -height, -cos), Vec3::new(0.0, target, 0.0))
        })
        .collect();
    let truth = regions(&world, &views, &[0, 1]);
    assert!(truth[0][1].is_empty() && !truth[3][1].is_empty());
    let labels = carried(&world, &views, &truth, &features(&world, 4), None, None, 0.5);
    assert!(world.share(0, &labels) > 0.9, "{}", world.share(0, &labels));
    assert!(world.share(1, &labels) < 0.05, "{}", world.share(1, &labels));
}

#[test]
fn threads_units_and_order_of_splats_change_nothing() {
    let square = SquareScene::new();
    let (world, sky) = (&square.world, square.world.is(3));
    let settings =
        SegmentSettings { graph_cut: true, propagate: 1, propagate_views: 5, ..SegmentSettings::default() };
    let plain = square.select(0, &engine(), &world.splats, &sky, &settings, true);
    // Threads.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
    let threaded = pool.install(|| square.select(0, &engine(), &world.splats, &sky, &settings, true));
    assert_eq!(plain, threaded);
    // Order of the splats.
    let n = world.len();
    let order: Vec<usize> = (0..n).map(|i| (i * 1009 + 17) % n).collect();
    let turned: Vec<bool> = order.iter().map(|&i| sky[i]).collect();
    let shuffled = square.select(0, &engine(), &world.splats.select(&order), &turned, &settings, true);
    let differ = order.iter().enumerate().filter(|(k, i)| shuffled.labels[*k] != plain.labels[**i]).count();
    assert!(differ <= n / 1000, "{differ} of {n}");
    // Units.
    let mut large = world.splats.clone();
    large.means.iter_mut().flatten().for_each(|x| *x *= 1000.0);
    large.log_scales.iter_mut().flatten().for_each(|x| *x += 1000f32.ln());
    let mut far =
        SquareScene { world: world.clone(), views: square.views.clone(), truth: square.truth.clone() };
    far.views.iter_mut().for_each(|v| v.pose.translation *= 1000.0);
    let scaled = far.select(0, &engine(), &large, &sky, &settings, true);
    let differ = scaled.labels.iter().zip(&plain.labels).filter(|(a, b)| a != b).count();
    assert!(differ <= n / 1000, "{differ} of {n}");
}
