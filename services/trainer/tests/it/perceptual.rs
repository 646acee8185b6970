//! LPIPS in the loss and in the scores, with random weights: the trained ones are a file that the user has.

use crate::wall::*;
use segwild_trainer::{Lpips, LpipsNet, Protocol, TrainError, TrainSettings, Trainer, evaluate};
use std::sync::Arc;

fn lpips() -> Arc<Lpips> {
    Arc::new(Lpips::parse(&LpipsNet::Alex.untrained()).unwrap())
}

/// A training with this weight of LPIPS, stopped after some steps and continued.
fn trained(weight: f32, lpips: &Arc<Lpips>, stop: u32) -> Vec<u8> {
    let scene = scene(5);
    let photos = photos(&scene, false, |_, _| ());
    let settings = TrainSettings { lambda_lpips: weight, coarse: 0.0, ..settings(40) };
    let mut trainer = Trainer::new(engine(), &scene, photos.clone(), settings).unwrap();
    trainer.set_lpips(Some(lpips.clone()));
    while trainer.steps_done() < stop {
        trainer.step().unwrap();
    }
    let mut trainer = Trainer::resume(engine(), &scene, photos, trainer.checkpoint().unwrap()).unwrap();
    trainer.set_lpips(Some(lpips.clone()));
    while !trainer.is_done() {
        trainer.step().unwrap();
    }
    bytes(&trainer.checkpoint().unwrap())
}

#[test]
fn a_loss_with_lpips_trains_other_splats_and_goes_on_from_a_checkpoint_in_the_same_bytes() {
    let lpips = lpips();
    let straight = trained(0.2, &lpips, 0);
    assert!(straight == trained(0.2, &lpips, 17), "stopping matters");
    assert!(straight != trained(0.0, &lpips, 0), "the term has no effect");
}

#[test]
fn a_loss_with_lpips_and_no_weights_is_refused_in_words() {
    let scene = scene(4);
    let settings = TrainSettings { lambda_lpips: 0.005, ..settings(10) };
    let mut trainer = Trainer::new(engine(), &scene, photos(&scene, false, |_, _| ()), settings).unwrap();
    let refused = trainer.step().unwrap_err();
    assert!(matches!(refused, TrainError::Setting(_)), "{refused}");
    assert!(refused.to_string().contains("lambda_lpips"), "{refused}");
}

#[test]
fn held_out_photos_are_scored_by_lpips_where_its_weights_are_given() {
    let (scene, lpips) = (scene(6), lpips());
    let photos = photos(&scene, false, |_, _| ());
    let (rough, good) =
        (train(&scene, photos.clone(), settings(4)), train(&scene, photos.clone(), settings(300)));
    let score = |model, protocol, lpips| {
        evaluate(model, &*engine(), &scene, photos.clone(), &[5], protocol, lpips).unwrap()
    };
    assert_eq!(score(&good, Protocol::Plain, None).lpips, None, "absent, not 0");
    let of = |model, protocol| {
        let scores = score(model, protocol, Some(&*lpips));
        assert_eq!(scores.lpips, scores.views[0].lpips);
        scores.lpips.unwrap()
    };
    let (before, after) = (of(&rough, Protocol::Plain), of(&good, Protocol::Plain));
    assert!(0.0 < after && after < before, "{before}, then {after}");
    let half = of(&good, Protocol::Halves);
    assert!(half > 0.0 && half != after, "the right half alone is scored: {half}");
}
