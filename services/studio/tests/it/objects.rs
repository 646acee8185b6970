//! What a person does on the page, without the page: clicks, objects, undo, tools, a restart.

use crate::common::{answered, click, keep, open, run, trained, until};
use segwild_flow::Stopper;
use segwild_pipeline::{PhotoPrompts, RunError, ShownParts, ShownScene, segment};
use segwild_scene::{Prompts, SplatFormat};
use segwild_studio::messages::{
    ANSWER_LABEL, ANSWER_OBJECT, FrameRequest, HIDDEN_LABEL, HoverRequest, PickRequest, ShownPrompts,
    StudioAction, ViewMessage,
};
use segwild_studio::{Combination, Region, RegionRule, Studio, StudioError};
use std::sync::Arc;

/// A photo that objects get the appearance of.
const OTHER_PHOTO: usize = 3;

fn ply(studio: &Studio, id: u32) -> Vec<u8> {
    studio.object_file(id, SplatFormat::Ply).unwrap().1
}

/// Writes an object as a selection; returns its name.
fn save(studio: &Arc<Studio>, id: u32) -> Result<String, StudioError> {
    studio.save_in_turn(id)?.blocking_recv().unwrap()
}

/// Gives an object, or the scene, the appearance of a photo.
fn set_appearance(id: Option<u32>, photo: Option<usize>) -> StudioAction {
    StudioAction::Appearance { id, photo, towards: None, share: 0.0 }
}

/// The view of a photo.
fn view(studio: &Studio, photo: usize) -> ViewMessage {
    let description = studio.describe();
    let photo = &description.photos[photo];
    ViewMessage { camera: photo.camera, rotation: photo.rotation, translation: photo.translation }
}

#[test]
fn an_object_of_the_page_is_that_of_the_command_line_byte_for_byte() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    let (photo, [x, y]) = trained().clicks[0].clone();
    // What is prepared under the pointer changes no answer.
    let at = studio.session().scene().view_named(&photo).unwrap();
    assert!(studio.hover(&HoverRequest { photo: at, x, y, ..HoverRequest::default() }).unwrap().is_some());
    keep(&studio, 0, "first").unwrap();
    let prompts = [PhotoPrompts { photo, prompts: Prompts::click(x, y) }];
    let settings = folder.settings().unwrap().segment;
    segment(&folder, "first", &prompts.as_slice().into(), &settings, None, &Stopper::new()).unwrap();
    let of_command = std::fs::read(folder.selection("first").join("object.ply")).unwrap();
    assert!(ply(&studio, 1) == of_command);
}

#[test]
fn a_session_that_is_killed_goes_on_with_the_same_objects_to_the_byte() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    keep(&studio, 0, "left").unwrap();
    keep(&studio, 1, "right").unwrap();
    studio.act(StudioAction::Grow { id: 2, steps: 1 }).unwrap();
    studio.act(StudioAction::Rename { id: 1, name: "the left one".into() }).unwrap();
    studio.act(click(&studio, 2)).unwrap();
    let before = answered(&studio);
    let files = [ply(&studio, 1), ply(&studio, 2)];
    let answer = studio.splat_labels().0;
    drop(studio);
    // A kill in the middle of the next line.
    let journal = folder.path().join("studio/session.jsonl");
    let text = std::fs::read_to_string(&journal).unwrap();
    std::fs::write(&journal, text + "{\"apply\":{\"do\":\"ren").unwrap();
    let studio = open(&folder);
    let after = answered(&studio);
    let json = |value: &dyn erased::Json| value.json();
    assert_eq!(json(&before.objects), json(&after.objects));
    assert_eq!(json(&before.draft), json(&after.draft));
    assert_eq!((before.undo, after.notes), (after.undo, Vec::<String>::new()));
    assert!(files == [ply(&studio, 1), ply(&studio, 2)]);
    assert!(answer == studio.splat_labels().0, "the draft's answer is requested again");
    // Undo goes back beyond the restart.
    for _ in 0..2 {
        studio.act(StudioAction::Undo).unwrap();
    }
    assert_eq!(studio.message().objects[0].name, "left");
}

/// Values as JSON, to be compared.
mod erased {
    pub trait Json {
        fn json(&self) -> String;
    }

    impl<T: serde::Serialize> Json for T {
        fn json(&self) -> String {
            serde_json::to_string(self).unwrap()
        }
    }
}

#[test]
fn splats_that_are_lost_are_selected_again() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    keep(&studio, 0, "statue").unwrap();
    let before = ply(&studio, 1);
    drop(studio);
    std::fs::remove_dir_all(folder.path().join("studio/selections")).unwrap();
    let studio = open(&folder);
    until(&studio, |message| {
        message.undo == Some("keep object") && studio.object_file(1, SplatFormat::Spz).is_ok()
    });
    assert!(before == ply(&studio, 1));
    assert_eq!(studio.message().objects.len(), 1);
}

#[test]
fn objects_of_an_earlier_training_are_selected_again_by_their_prompts() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    keep(&studio, 0, "statue").unwrap();
    let splats = studio.message().objects[0].splats;
    drop(studio);
    let journal = folder.path().join("studio/session.jsonl");
    let text = std::fs::read_to_string(&journal).unwrap();
    let scene = text.split("\"scene\":\"").nth(1).unwrap().split('"').next().unwrap();
    std::fs::write(&journal, text.replace(scene, "of-another-training")).unwrap();
    let studio = open(&folder);
    let after = until(&studio, |message| !message.objects.is_empty());
    assert_eq!((after.objects[0].name.as_str(), after.objects[0].splats), ("statue", splats));
    assert!(after.notes.iter().any(|note| note.contains("trained again")), "{:?}", after.notes);
}

#[test]
fn a_newer_click_ends_the_answer_before_and_an_empty_draft_all_of_them() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    studio.act(click(&studio, 0)).unwrap();
    studio.act(click(&studio, 1)).unwrap();
    let message = answered(&studio);
    // The third answer: before it were that to the empty draft and that to the first click.
    assert_eq!((message.answer.number, message.answer.state), (3, "done"), "{message:?}");
    let wanted = keep_and_count(&studio);
    studio.act(StudioAction::Undo).unwrap();
    studio.act(StudioAction::Prompt { prompts: Vec::new(), alternative: 0 }).unwrap();
    let message = studio.message();
    assert_eq!((message.answer.state, message.answer.splats), ("none", 0));
    assert!(studio.splat_labels().0.iter().all(|label| *label == 0));
    // The same click has the same answer.
    studio.act(click(&studio, 1)).unwrap();
    answered(&studio);
    assert_eq!(keep_and_count(&studio), wanted);
}

fn keep_and_count(studio: &Arc<Studio>) -> usize {
    studio.act(StudioAction::Keep { name: None }).unwrap();
    studio.message().objects.last().unwrap().splats
}

#[test]
fn a_listed_part_is_kept_and_refined_under_the_same_number() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    let listed = studio.describe().listed;
    assert!(!listed.is_empty());
    studio.act(StudioAction::Listed { number: 1 }).unwrap();
    assert_eq!(answered(&studio).draft.listed, Some(1));
    studio.act(StudioAction::Keep { name: None }).unwrap();
    studio.act(StudioAction::Refine { id: 1 }).unwrap();
    let message = answered(&studio);
    assert_eq!(message.draft.of, Some(1));
    studio.act(StudioAction::Keep { name: None }).unwrap();
    let message = studio.message();
    assert_eq!((message.objects.len(), message.objects[0].id, message.draft.of), (1, 1, None));
    assert!(studio.sheet().unwrap().starts_with(b"\x89PNG"));
    assert!(studio.act(StudioAction::Listed { number: 99 }).is_err());
    // Without a model of texts, a text is answered with what is missing.
    assert!(!studio.describe().texts);
    studio.act(StudioAction::Text { text: " the  dome".into(), alternative: 0 }).unwrap();
    let message = answered(&studio);
    assert_eq!(message.draft.text.as_deref(), Some("the dome"));
    assert!(message.answer.error.as_ref().is_some_and(|e| e.contains("no model of texts")), "{message:?}");
    assert!(studio.act(StudioAction::Text { text: "x".repeat(301), alternative: 0 }).is_err());
}

#[test]
fn tools_add_subtract_and_intersect_what_their_region_holds() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    let view = || view(&studio, 0);
    let camera = view().camera;
    let (w, h) = (camera.width as f32, camera.height as f32);
    let rectangle = |x0: f32, x1: f32| Region::Polygon {
        points: [[x0, 0.0], [x1, 0.0], [x1, 1.0], [x0, 1.0]].map(|[x, y]| [x * w, y * h]).to_vec(),
    };
    let region =
        |id, region, how, rule| studio.act(StudioAction::Region { id, view: view(), region, how, rule });
    let splats = |id: u32| studio.message().objects.iter().find(|o| o.id == id).unwrap().splats;
    region(None, rectangle(0.0, 0.5), Combination::Add, RegionRule::Centre).unwrap();
    region(None, rectangle(0.0, 1.0), Combination::Add, RegionRule::Centre).unwrap();
    let (half, whole) = (splats(1), splats(2));
    assert!(0 < half && half < whole);
    region(Some(2), rectangle(0.0, 0.5), Combination::Subtract, RegionRule::Centre).unwrap();
    assert_eq!(splats(2), whole - half);
    region(Some(1), rectangle(0.5, 1.0), Combination::Add, RegionRule::Centre).unwrap();
    region(Some(1), rectangle(0.0, 0.5), Combination::Intersect, RegionRule::Centre).unwrap();
    assert_eq!(splats(1), half);
    // What shows is less than what lies there.
    region(None, rectangle(0.0, 1.0), Combination::Add, RegionRule::Visible).unwrap();
    region(None, rectangle(0.0, 1.0), Combination::Add, RegionRule::Footprint).unwrap();
    assert!(splats(3) <= whole && splats(3) <= splats(4) && splats(4) > 0);
    let refused = region(Some(1), rectangle(0.5, 1.0), Combination::Intersect, RegionRule::Centre);
    assert!(matches!(refused, Err(StudioError::Request(_))), "nothing would be left");
    // Shrinking what has grown gives no more than before; a union holds both.
    studio.act(StudioAction::Grow { id: 1, steps: 2 }).unwrap();
    assert!(splats(1) > half);
    studio.act(StudioAction::Combine { id: 1, with: 2, how: Combination::Add }).unwrap();
    assert!(splats(1) >= whole - half);
    let ball = Region::Sphere { at: [w / 2.0, h / 2.0], radius: 0.1 * w };
    region(None, ball, Combination::Add, RegionRule::Centre).unwrap();
    assert!(splats(5) > 0 && splats(5) < whole);
}

#[test]
fn hovering_shows_what_a_click_would_ask_for_and_a_level_changes_its_size() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    let (photo, [x, y]) = trained().clicks[0].clone();
    let photo = studio.session().scene().view_named(&photo).unwrap();
    let covered = |granularity| {
        let map = studio.hover(&HoverRequest { photo, x, y, granularity, view: None }).unwrap().unwrap();
        let runs = map.runs.chunks_exact(2);
        assert_eq!(runs.clone().map(|run| run[1] as usize).sum::<usize>(), map.width * map.height);
        runs.filter(|run| run[0] == u32::from(ANSWER_LABEL)).map(|run| run[1]).sum::<u32>()
    };
    assert!(covered(None) > 0);
    assert!(covered(Some(0.0)) <= covered(Some(1.0)));
    for (x, y) in [(-1.0, 5.0), (1e9, 5.0), (f32::NAN, 5.0)] {
        assert_eq!(studio.hover(&HoverRequest { photo, x, y, ..HoverRequest::default() }).unwrap(), None);
    }
    assert!(studio.hover(&HoverRequest { photo: 999, x, y, ..HoverRequest::default() }).is_err());
    // In the view of the photo's own camera it is the same, whichever photo is named.
    let in_view = |view: ViewMessage, x: f32| {
        studio.hover(&HoverRequest { photo: 999, x, y, granularity: None, view: Some(view) })
    };
    let in_photo = studio.hover(&HoverRequest { photo, x, y, ..HoverRequest::default() }).unwrap();
    assert_eq!(in_view(view(&studio, photo), x).unwrap(), in_photo);
    assert_eq!(in_view(view(&studio, photo), f32::NAN).unwrap(), None);
    let mut odd = view(&studio, photo);
    odd.rotation = [1.0; 9];
    assert!(in_view(odd, x).is_err());
}

#[test]
fn a_pixel_of_the_3d_view_leads_to_the_photo_that_shows_it() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    keep(&studio, 0, "statue").unwrap();
    let (name, at) = trained().clicks[0].clone();
    let own = studio.session().scene().view_named(&name).unwrap();
    let picked = studio.pick(&PickRequest { view: view(&studio, own), at }).unwrap().unwrap();
    // Whichever photo it is, the object is there.
    let map = studio.labels(picked.photo).unwrap();
    let camera = studio.describe().photos[picked.photo].camera;
    let column = (picked.x / camera.width as f32 * map.width as f32) as usize;
    let row = (picked.y / camera.height as f32 * map.height as f32) as usize;
    let mut at = row * map.width + column;
    let run = map.runs.chunks_exact(2).find(|run| {
        let here = at < run[1] as usize;
        at = at.saturating_sub(run[1] as usize);
        here
    });
    assert_eq!(run.unwrap()[0], 1, "{picked:?}");
    assert_eq!(studio.pick(&PickRequest { view: view(&studio, own), at: [-5.0, 0.0] }).unwrap(), None);
}

#[test]
fn hidden_and_isolated_objects_show_in_frames_and_labels() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    keep(&studio, 0, "statue").unwrap();
    let request = |marks| FrameRequest { view: view(&studio, 0), marks, background: false, appearance: None };
    let frame = |marks| studio.frame(&request(marks)).unwrap();
    let (plain, marked) = (frame(false), frame(true));
    assert!(plain.starts_with(&[0xff, 0xd8]) && plain != marked);
    let labels = studio.splat_labels().0;
    let inside = labels.iter().filter(|label| **label == 1).count();
    assert_eq!(inside, studio.message().objects[0].splats);
    studio.act(StudioAction::Show { id: 1, visible: false }).unwrap();
    assert_eq!(studio.splat_labels().0.iter().filter(|label| **label == HIDDEN_LABEL).count(), inside);
    assert!(frame(false) != plain);
    studio.act(StudioAction::Show { id: 1, visible: true }).unwrap();
    assert!(frame(false) == plain && frame(true) == marked);
    // What does not change is taken over from the revision before.
    studio.act(StudioAction::Rename { id: 1, name: "renamed".into() }).unwrap();
    assert!(frame(true) == marked && frame(false) == plain);
    studio.act(StudioAction::Colour { id: 1, colour: 3 }).unwrap();
    assert!(frame(true) != marked && frame(false) == plain);
    studio.act(StudioAction::Isolate { id: Some(1) }).unwrap();
    assert_eq!(
        studio.splat_labels().0.iter().filter(|label| **label == HIDDEN_LABEL).count(),
        labels.len() - inside
    );
    assert!(frame(false) != plain);
    let pixels_of = |id| studio.shown_by_photos(id).and_then(|shown| studio.pixels_of(&shown));
    let counts = pixels_of(1).unwrap();
    assert_eq!(counts.len(), studio.describe().photos.len());
    // Photos this small are counted as they are.
    let map = studio.labels(0).unwrap();
    let shown = map.runs.chunks_exact(2).filter(|run| run[0] == 1).map(|run| run[1] as usize);
    assert_eq!(counts[0], shown.sum::<usize>());
    assert!(counts.iter().sum::<usize>() > 0);
    // The answer's photos are those of the object that it becomes.
    let error = pixels_of(ANSWER_OBJECT).unwrap_err().to_string();
    assert_eq!(error, "there is no answer yet");
    studio.act(click(&studio, 0)).unwrap();
    answered(&studio);
    assert_eq!(pixels_of(ANSWER_OBJECT).unwrap(), counts);
}

#[test]
fn other_highlights_of_a_shown_scene_render_as_if_it_were_made_with_them() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    let session = studio.session();
    let (camera, pose) = view(&studio, 0).view().unwrap();
    let n = session.model().splats.len();
    let some = |divisor: usize| (0..n).map(|i| i % divisor == 0).collect::<Vec<bool>>();
    let (red, green) = (some(2), some(5));
    let highlights = [(red.as_slice(), [1.0, 0.0, 0.0]), (green.as_slice(), [0.0, 1.0, 0.0])];
    for hidden in [Vec::new(), some(3)] {
        let parts = ShownParts { hidden, ..ShownParts::default() };
        let plain = session.show(&parts).unwrap();
        let parts = ShownParts { highlights: highlights.to_vec(), ..parts };
        let made = session.show(&parts).unwrap();
        let render = |scene: &ShownScene| session.render(scene, &camera, &pose).unwrap();
        assert!(render(&plain.highlighted(&highlights)) == render(&made));
        assert!(render(&made.highlighted(&[])) == render(&plain) && render(&plain) != render(&made));
    }
}

#[test]
fn an_appearance_changes_the_object_alone_or_the_whole_scene() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    keep(&studio, 0, "statue").unwrap();
    let own = ply(&studio, 1);
    studio.act(set_appearance(Some(1), Some(OTHER_PHOTO))).unwrap();
    let of_photo = ply(&studio, 1);
    assert!(of_photo != own && of_photo.len() == own.len());
    studio.act(set_appearance(Some(1), None)).unwrap();
    studio.act(set_appearance(None, Some(OTHER_PHOTO))).unwrap();
    assert!(ply(&studio, 1) == of_photo, "the export has the scene's appearance");
    // All the way to another photo is that photo.
    let towards =
        |share| StudioAction::Appearance { id: None, photo: None, towards: Some(OTHER_PHOTO), share };
    studio.act(towards(1.0)).unwrap();
    assert!(ply(&studio, 1) == of_photo);
    studio.act(towards(0.5)).unwrap();
    assert!(ply(&studio, 1) != of_photo && ply(&studio, 1) != own);
    studio.act(towards(0.0)).unwrap();
    assert!(ply(&studio, 1) == own);
    assert!(studio.act(towards(1.5)).is_err());
    let held_out = studio.describe().photos.iter().position(|photo| photo.held_out).unwrap();
    assert!(studio.act(set_appearance(None, Some(held_out))).is_err());
}

#[test]
fn requests_that_make_no_sense_are_refused_and_nothing_is_written() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    let journal = || std::fs::read(folder.path().join("studio/session.jsonl")).unwrap();
    let before = journal();
    let prompt = |photo, x, y| {
        let prompts = ShownPrompts { photo, prompts: Prompts::click(x, y) };
        StudioAction::Prompt { prompts: vec![prompts], alternative: 0 }
    };
    let mut odd = view(&studio, 0);
    odd.rotation = [1.0; 9];
    let mut large = view(&studio, 0);
    large.camera.width = 1 << 20;
    let square = || Region::Polygon { points: vec![[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]] };
    let region = |view, region| StudioAction::Region {
        id: None,
        view,
        region,
        how: Combination::Add,
        rule: RegionRule::Centre,
    };
    let refused = [
        prompt(999, 1.0, 1.0),
        StudioAction::Keep { name: None },
        StudioAction::Refine { id: 4 },
        StudioAction::Undo,
        region(odd, square()),
        region(large, square()),
        region(view(&studio, 0), Region::Polygon { points: vec![] }),
        set_appearance(None, Some(999)),
        StudioAction::Combine { id: 1, with: 2, how: Combination::Add },
    ];
    for action in refused {
        let words = format!("{action:?}");
        assert!(studio.act(action).is_err(), "{words}");
    }
    assert!(journal() == before);
    // A click where nothing is has an answer in words.
    studio.act(prompt(0, -50.0, -50.0)).unwrap();
    let message = answered(&studio);
    assert_eq!(message.answer.state, "failed");
    assert!(message.answer.error.unwrap().contains("outside"));
}

#[test]
fn transients_are_painted_into_the_runs_own_mask_and_undone_to_the_pixel() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    let photo = studio.describe().photos.iter().position(|photo| !photo.held_out).unwrap();
    let camera = studio.describe().photos[photo].camera;
    let covered = || {
        let map = studio.transients(photo).unwrap();
        map.runs
            .chunks_exact(2)
            .filter(|run| run[0] == u32::from(ANSWER_LABEL))
            .map(|run| run[1])
            .sum::<u32>()
    };
    let square = |x0: f32, x1: f32| Region::Polygon {
        points: [[x0, 0.2], [x1, 0.2], [x1, 0.8], [x0, 0.8]]
            .map(|[x, y]| [x * camera.width as f32, y * camera.height as f32])
            .to_vec(),
    };
    let own = studio.session().transient_mask(photo);
    let before = covered();
    let paint = |region, how| studio.act(StudioAction::Transients { photo, region, how });
    paint(square(0.0, 1.0), Combination::Subtract).unwrap();
    paint(square(0.2, 0.6), Combination::Add).unwrap();
    let small = studio.session().working_camera(photo);
    let wanted = 0.4 * 0.6 * (small.width * small.height) as f32;
    assert!((covered() as f32 - wanted).abs() < 0.1 * wanted + before as f32, "{} and {wanted}", covered());
    assert_eq!(studio.message().corrected, [photo]);
    // The next run sees a person's correction.
    let (count, damaged) = folder.verify_transient_masks().unwrap();
    assert!(count > 0 && damaged.is_empty());
    studio.act(StudioAction::Undo).unwrap();
    studio.act(StudioAction::Undo).unwrap();
    assert_eq!((covered(), studio.message().corrected.len()), (before, 0));
    if let Some(own) = own {
        assert_eq!(studio.session().transient_mask(photo), Some(own));
    }
    let held_out = studio.describe().photos.iter().position(|photo| photo.held_out).unwrap();
    let action =
        StudioAction::Transients { photo: held_out, region: square(0.0, 1.0), how: Combination::Add };
    assert!(studio.act(action).is_err());
}

#[test]
fn all_objects_are_exported_as_labels_masks_and_selections_of_the_run() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    keep(&studio, 0, "the first").unwrap();
    keep(&studio, 1, "second").unwrap();
    let labels = studio.labelled_ply().unwrap();
    assert!(String::from_utf8_lossy(&labels[..2000]).contains("property uchar object"));
    let masks_of = |id| -> serde_json::Value {
        let (_, file) = studio.coco(id, &Stopper::new()).unwrap();
        serde_json::from_slice(&file).unwrap()
    };
    let coco = masks_of(None);
    let names: Vec<_> = coco["categories"].as_array().unwrap().iter().map(|c| c["name"].clone()).collect();
    assert_eq!(names, ["the first", "second"]);
    assert!(coco["annotations"].as_array().unwrap().len() > 4);
    let made_by = &coco["info"]["provenance"];
    assert_eq!(made_by["training"].as_str(), studio.session().training());
    assert!(made_by["provider"] == "built-in" && made_by["settings"]["train"]["steps"] == 250);
    let photo = &made_by["objects"][1]["replay"]["prompts"][0]["photo"];
    assert_eq!(photo.as_str(), Some(trained().clicks[1].0.as_str()));
    // One of them alone.
    let second = masks_of(Some(2));
    assert_eq!(second["categories"].as_array().unwrap().len(), 1);
    let masks = second["annotations"].as_array().unwrap();
    assert!(masks.len() > 2 && masks.iter().all(|mask| mask["category_id"] == 1), "{masks:?}");
    assert!(studio.coco(Some(9), &Stopper::new()).is_err());
    let stopped = Stopper::new();
    stopped.stop();
    assert!(studio.coco(None, &stopped).is_err());
    let head = String::from_utf8_lossy(&ply(&studio, 1)[..400]).into_owned();
    let scene = made_by["scene"].as_str().unwrap();
    let line = format!("comment segwild version={} scene={scene}\n", env!("CARGO_PKG_VERSION"));
    assert!(head.contains(&line), "{head}");
    assert_eq!(save(&studio, 1).unwrap(), "the_first");
    let saved = std::fs::read(folder.selection("the_first").join("object.ply")).unwrap();
    assert!(saved == ply(&studio, 1));
    assert!(folder.selection("the_first").join("masks").is_dir());
    let written_prompts = std::fs::read(folder.selection("the_first").join("prompts.json")).unwrap();
    assert_eq!(studio.prompts_file(1).unwrap(), ("the_first.prompts.json".into(), written_prompts));
    // That was the answer that was kept. A second one, after a restart, writes the same to the byte.
    let written = || {
        let read = |file| std::fs::read(folder.selection("the_first").join(file)).unwrap();
        ["object.ply", "selection.bin", "prompts.json"].map(read)
    };
    let of_kept = written();
    std::fs::remove_dir_all(folder.selection("the_first")).unwrap();
    drop(studio);
    let studio = open(&folder);
    // Clicks do not wait for it: they end it, and it starts again.
    let saving = std::thread::spawn({
        let studio = studio.clone();
        move || save(&studio, 1).unwrap()
    });
    for object in [2, 0] {
        studio.act(click(&studio, object)).unwrap();
        assert_eq!(answered(&studio).answer.state, "done");
    }
    assert_eq!(saving.join().unwrap(), "the_first");
    assert!(written() == of_kept);
    studio.act(StudioAction::Prompt { prompts: Vec::new(), alternative: 0 }).unwrap();
    studio.act(StudioAction::Grow { id: 2, steps: 1 }).unwrap();
    assert!(save(&studio, 2).is_err(), "no prompts make what a tool changed");
    assert!(studio.prompts_file(2).is_err() && studio.prompts_file(9).is_err());
}

#[test]
fn a_save_counts_its_photos_and_leaves_nothing_where_it_is_stopped() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    let session = studio.session();
    let (photo, [x, y]) = trained().clicks[0].clone();
    let prompts = [PhotoPrompts { photo, prompts: Prompts::click(x, y) }];
    let settings = folder.settings().unwrap().segment;
    let pending = session.ask(&prompts.as_slice().into(), &settings, &Stopper::new()).unwrap();
    let answer = pending.wait(|_, _| ()).unwrap();
    let (stopper, last) = (Stopper::new(), std::cell::Cell::new((0, 0)));
    let watch = |done, photos| {
        last.set((done, photos));
        stopper.stop();
    };
    assert!(matches!(session.save_watched("one", &answer, &stopper, &watch), Err(RunError::Interrupted)));
    let photos = session.scene().views.len();
    assert!(0 < last.get().0 && last.get().0 < photos && last.get().1 == photos, "{last:?}");
    assert!(!folder.selection("one").exists());
    let watch = |done, photos| last.set((done, photos));
    session.save_watched("one", &answer, &Stopper::new(), &watch).unwrap();
    assert_eq!(last.get(), (photos, photos));
    let made_by = std::fs::read(folder.selection("one").join("provenance.json")).unwrap();
    let made_by: serde_json::Value = serde_json::from_slice(&made_by).unwrap();
    assert_eq!(made_by["objects"][0]["name"], "one");
    // What is not being written is not stopped, and what is over shows no more.
    assert!(studio.act(StudioAction::StopSave { id: 1 }).is_err() && studio.message().saving.is_empty());
}

#[test]
fn writes_that_wait_are_shown_and_stopped_like_the_present_one() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    for (object, name) in [(0, "one"), (1, "two")] {
        keep(&studio, object, name).unwrap();
    }
    let objects = studio.message().objects.len();
    // After a restart no answer is in memory: the first write has to wait for its own.
    drop(studio);
    let studio = open(&folder);
    let writes = [1, 2].map(|id| studio.save_in_turn(id).unwrap());
    let message = studio.message();
    assert_eq!(message.saving.iter().map(|save| save.object).collect::<Vec<_>>(), [1, 2]);
    assert!(message.saving.iter().all(|save| save.photos == studio.session().scene().views.len()));
    assert!(matches!(studio.save_in_turn(2), Err(StudioError::Conflict(_))), "no object is written twice");
    studio.act(StudioAction::StopSave { id: 2 }).unwrap();
    let saving = studio.message().saving;
    assert_eq!(saving.iter().map(|save| save.object).collect::<Vec<_>>(), [1], "it leaves the queue at once");
    studio.act(StudioAction::StopSave { id: 1 }).unwrap();
    for write in writes {
        let error = write.blocking_recv().unwrap().unwrap_err().to_string();
        assert_eq!(error, "the writing of this object was stopped");
    }
    let message = studio.message();
    assert!(message.saving.is_empty() && message.objects.len() == objects);
    assert!(!folder.selection("one").exists() && !folder.selection("two").exists());
    assert_eq!(save(&studio, 2).unwrap(), "two", "it can be written again");
}
