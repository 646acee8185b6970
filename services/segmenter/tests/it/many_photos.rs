//! A click on a scene of few photos visits all of them, and on one of many those that add something.

use crate::carried::{likelier, regions};
use crate::common::{TestRandom, TestWorld, engine, options, posed, request};
use glam::Vec3;
use segwild_scene::{Image, Mask};
use segwild_segmenter::{
    PosedView, PromptedView, Refiner, Request, SegmentSettings, Selection, ViewSplats, select, visible_mask,
};
use std::collections::BTreeSet;
use std::slice::from_ref;
use std::sync::Mutex;

/// Photos that a click visits at most where a scene has more.
const MOST: usize = 64;

/// The setting by itself, which is beyond that.
const SETTING: usize = 80;

/// Photos of each of two halls.
const OF_A_HALL: usize = 200;

/// A statue (thing 0) on a floor (1). One of five photos is of any side, the others are of the front.
struct ManyPhotos {
    world: TestWorld,
    views: Vec<PosedView>,
}

/// The direction from which a photo is taken, in degrees around the statue.
fn degrees(photo: usize) -> f32 {
    if photo % 5 == 1 { (photo as f32 * 7.0).rem_euclid(360.0) } else { (photo % 50) as f32 - 25.0 }
}

impl ManyPhotos {
    fn new(photos: usize) -> ManyPhotos {
        let mut world = TestWorld::default();
        let mut dice = TestRandom(5);
        world.ball(0, Vec3::new(0.0, -0.1, 0.0), Vec3::new(0.2, 0.3, 0.2), 900, [0.4, 0.6, 0.5], &mut dice);
        for i in 0..24 {
            for k in 0..24 {
                let at = |n: i32| (n as f32 - 11.5) * 0.1;
                world.disc(1, Vec3::new(at(i), 0.22, at(k)), Vec3::NEG_Y, 0.07, [0.5, 0.5, 0.45]);
            }
        }
        let view = |photo: usize| {
            let (sin, cos) = degrees(photo).to_radians().sin_cos();
            posed(&format!("{photo:04}.jpg"), Vec3::new(1.2 * sin, -0.35, -1.2 * cos), Vec3::ZERO)
        };
        ManyPhotos { world, views: (0..photos).map(view).collect() }
    }

    /// The same in a hall whose wall stands beyond the statue; the photos from the second one to the 201st are of the next hall, in
    /// whose frames the statue lies, and are nearer to the wall's other side than to it.
    fn two_halls() -> ManyPhotos {
        let mut scene = ManyPhotos::new(2 * OF_A_HALL);
        for x in 0..20 {
            for y in 0..20 {
                let at = |n: i32| (n as f32 - 9.5) * 0.1;
                // Wider than elsewhere: no light comes through.
                scene.world.disc(2, Vec3::new(at(x), at(y) - 0.35, 1.3), Vec3::Z, 0.12, [0.7, 0.7, 0.6]);
            }
        }
        for photo in 1..=OF_A_HALL {
            let (x, z) = ((photo * 29 % 200) as f32 / 200.0 - 0.5, (photo * 37 % 200) as f32 / 200.0);
            scene.views[photo] = posed(&format!("{photo:04}.jpg"), Vec3::new(x, -0.35, 2.2 + z), Vec3::ZERO);
        }
        scene
    }

    fn regions(&self, photo: usize) -> Vec<Mask> {
        regions(&self.world, from_ref(&self.views[photo]), &[0, 1]).remove(0)
    }

    /// The selection by the statue's mask in the first photo, and the photos that were refined: `most` of them at most.
    fn select(&self, most: usize, shown: Option<&ViewSplats>) -> (Selection, BTreeSet<usize>) {
        let (engine, regions) = (engine(), self.regions(0));
        let mask = &regions[0];
        let prompts = [PromptedView { view: 0, mask, open: None, points: &[], refused: false, boxes: &[] }];
        let settings = SegmentSettings { propagate: 1, propagate_views: most, ..SegmentSettings::default() };
        let request = request(&engine, &self.world.splats, &self.views, &prompts, &settings);
        let refiner = RegionRefiner { scene: self, refined: Mutex::default() };
        let selection = select(&Request { shown, ..request }, Some(&refiner)).unwrap();
        (selection, refiner.refined.into_inner().unwrap())
    }
}

/// Whether a photo cannot be refined.
fn is_barred(photo: usize) -> bool {
    photo % 9 == 4
}

/// Takes the regions of a photo that are likelier inside than not.
struct RegionRefiner<'a> {
    scene: &'a ManyPhotos,
    refined: Mutex<BTreeSet<usize>>,
}

impl Refiner for RegionRefiner<'_> {
    fn refine(&self, view: usize, certainty: &Image) -> Option<(Mask, f32)> {
        self.refined.lock().unwrap().insert(view);
        (!is_barred(view)).then(|| (likelier(&self.scene.regions(view), certainty, 0.5), 0.9))
    }

    fn answers(&self, view: usize) -> bool {
        !is_barred(view)
    }
}

#[test]
fn a_scene_of_few_photos_is_visited_whole() {
    let scene = ManyPhotos::new(MOST + 1);
    let (selection, refined) = scene.select(SETTING, None);
    assert!(refined.into_iter().eq(1..=MOST), "all of them, barred or not");
    assert_eq!(selection.visits.len(), MOST);
    assert!(ManyPhotos::new(MOST + 2).select(SETTING, None).1.len() <= MOST);
}

#[test]
fn of_many_photos_those_are_visited_that_add_something_and_the_object_is_whole() {
    let scene = ManyPhotos::new(300);
    let (selection, refined) = scene.select(SETTING, None);
    let visited: Vec<usize> = selection.visits.iter().map(|visit| visit.view).collect();
    assert!((12..=MOST).contains(&visited.len()), "{}", visited.len());
    assert!(!refined.iter().any(|photo| is_barred(*photo)) && !visited.contains(&0));
    let quarters: BTreeSet<usize> = visited.iter().map(|photo| (degrees(*photo) / 90.0) as usize).collect();
    assert!(quarters.is_superset(&BTreeSet::from([0, 1, 2, 3])), "{quarters:?}");
    // One of seven photos is that far from the front.
    let beside = visited.iter().filter(|photo| (45.0..315.0).contains(&degrees(**photo))).count();
    assert!(3 * beside >= visited.len(), "{beside} of {}", visited.len());
    let (engine, world) = (engine(), &scene.world);
    for photo in (1..300).step_by(35) {
        let view = &scene.views[photo];
        let (camera, pose) = (&view.camera, &view.pose);
        let mask = visible_mask(&engine, &world.splats, &selection.labels, &options(), camera, pose).unwrap();
        let iou = mask.iou(&scene.regions(photo)[0]);
        assert!(iou > 0.85, "photo {photo} at {} degrees: {iou}", degrees(photo));
    }
    // Nor does it matter what earlier clicks have computed, or how many threads there are.
    let shown = ViewSplats::new(world.len(), scene.views.len()).unwrap();
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        assert!(pool.install(|| scene.select(SETTING, Some(&shown))).0 == selection, "{threads} threads");
    }
}

#[test]
fn where_more_photos_add_something_than_may_be_visited_those_are_visited_that_add_most() {
    let scene = ManyPhotos::new(300);
    // Without the bound, a dozen and more are visited: see above.
    let visited: Vec<usize> = scene.select(6, None).0.visits.iter().map(|visit| visit.view).collect();
    assert_eq!(visited.len(), 6, "{visited:?}");
    // Four of five photos are within 25 degrees of the front.
    let beside = visited.iter().filter(|photo| (45.0..315.0).contains(&degrees(**photo))).count();
    assert!(beside >= 3, "{beside} of {visited:?}");
}

#[test]
fn photos_of_the_next_hall_do_not_take_the_turn_of_those_that_show_the_object() {
    let scene = ManyPhotos::two_halls();
    let (selection, _) = scene.select(SETTING, None);
    let visited: Vec<usize> = selection.visits.iter().map(|visit| visit.view).collect();
    assert!(visited.iter().all(|photo| *photo > OF_A_HALL), "{visited:?} are not all of the statue's hall");
    // From the wall's side there are 200 photos of the next hall, and six of this one.
    let from_the_wall: Vec<usize> =
        visited.iter().copied().filter(|photo| (150.0..210.0).contains(&degrees(*photo))).collect();
    assert!(from_the_wall.len() >= 2, "{from_the_wall:?} of {visited:?}");
    let view = &scene.views[from_the_wall[0]];
    let (engine, camera, pose) = (engine(), &view.camera, &view.pose);
    let splats = &scene.world.splats;
    let mask = visible_mask(&engine, splats, &selection.labels, &options(), camera, pose).unwrap();
    let iou = mask.iou(&scene.regions(from_the_wall[0])[0]);
    assert!(iou > 0.85, "{iou}");
}
