//! A run kept in memory for clicks: answers grow in steps, can be cancelled, and are those of the command line.

use segwild_eval::oracle::OracleOptions;
use segwild_eval::trial::{ProviderKind, Trial};
use segwild_flow::Stopper;
use segwild_pipeline::{
    AnswerStep, PhotoPrompts, Preset, RunError, Session, SessionOptions, Settings, segment,
};
use segwild_scene::Prompts;
use segwild_segmenter::SegmentSettings;
use segwild_synthetic::{ObjectKind, SyntheticOptions};

#[test]
fn one_session_answers_many_clicks_in_steps_and_saves_what_one_command_saves() {
    let dir = tempfile::tempdir().unwrap();
    let scene = SyntheticOptions {
        seed: 5,
        train: 14,
        test: 2,
        long_side: 128,
        points: 1200,
        occlusion: 0.0,
        ..SyntheticOptions::default()
    };
    let trial = Trial::new(dir.path(), &scene, ProviderKind::Builtin, &OracleOptions::default()).unwrap();
    let mut settings = Settings::preset(Preset::Draft);
    settings.train.steps = 300;
    settings.masks.prompt_budget = 16;
    trial.train(&settings).unwrap();
    let clicks = trial.manifest().objects.iter().filter(|o| o.kind == ObjectKind::Object);
    let clicks: Vec<PhotoPrompts> = clicks
        .filter_map(|object| object.clicks.first())
        .map(|click| PhotoPrompts { photo: click.photo.clone(), prompts: Prompts::click(click.x, click.y) })
        .collect();
    let session = Session::open(trial.folder(), SessionOptions::default()).unwrap();
    assert!(session.tree().is_some());
    // Two querys at once, and one that nobody waits for.
    let ask = |click: &PhotoPrompts, cancel: &Stopper| {
        session.ask(&std::slice::from_ref(click).into(), &settings.segment, cancel).unwrap()
    };
    let (stays, leaves) = (Stopper::new(), Stopper::new());
    leaves.stop();
    let (first, second, gone) = (ask(&clicks[0], &stays), ask(&clicks[1], &stays), ask(&clicks[0], &leaves));
    assert!(matches!(gone.wait(|_, _| ()), Err(RunError::Interrupted)));
    let (mut steps, mut last) = (Vec::new(), None);
    let first = first
        .wait(|step, selected| {
            assert_eq!(selected.labels.len(), session.model().splats.len());
            steps.push((step, selected.labels.iter().filter(|l| **l).count()));
            last = Some(selected);
        })
        .unwrap();
    println!("{steps:?}, then {} splats", first.segmented.selection.labels.iter().filter(|l| **l).count());
    let names: Vec<AnswerStep> = steps.iter().map(|(step, _)| *step).collect();
    assert!(names.is_sorted() && names.contains(&AnswerStep::Prompted), "{names:?}");
    assert!(names.contains(&AnswerStep::Photos(8)), "{names:?}");
    assert!(steps.iter().all(|(_, splats)| *splats > 0), "{steps:?}");
    // The object of the last answer is there before it is known how sure it is.
    assert!(
        names.last() == Some(&AnswerStep::Selected) && last == Some(Session::selected(&first)),
        "{names:?}"
    );
    session.save("first", &first).unwrap();
    session.save("second", &second.wait(|_, _| ()).unwrap()).unwrap();
    // One command at a time gives the same.
    let object = |name: &str| std::fs::read(trial.folder().selection(name).join("object.ply")).unwrap();
    for (name, click) in ["first", "second"].iter().zip(&clicks) {
        let alone = format!("{name}-alone");
        let (query, settings) = (std::slice::from_ref(click).into(), &settings.segment);
        segment(trial.folder(), &alone, &query, settings, None, &Stopper::new()).unwrap();
        assert!(object(name) == object(&alone), "{name}");
    }
    // Prompts that are refused leave the session as it was.
    let nowhere = PhotoPrompts { photo: "nowhere.jpg".into(), prompts: Prompts::click(3.0, 3.0) };
    assert!(session.ask(&[nowhere][..].into(), &settings.segment, &stays).is_err());
    let again = ask(&clicks[0], &stays).wait(|_, _| ()).unwrap();
    assert!(again.segmented.selection == first.segmented.selection);
    // A setting of the neighbour graph holds for the click that names it, and for no later one.
    let few = SegmentSettings { neighbours: 3, ..settings.segment.clone() };
    let selection = |session: &Session, settings: &SegmentSettings| {
        let pending = session.ask(&std::slice::from_ref(&clicks[0]).into(), settings, &stays).unwrap();
        pending.wait(|_, _| ()).unwrap().segmented.selection
    };
    let fresh = Session::open(trial.folder(), SessionOptions::default()).unwrap();
    let with_few = selection(&session, &few);
    assert!(with_few == selection(&fresh, &few) && with_few != first.segmented.selection);
    assert!(selection(&session, &settings.segment) == first.segmented.selection);
}
