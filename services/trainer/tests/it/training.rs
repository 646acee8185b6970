//! Training on the wall.

use crate::wall::*;
use segwild_raster::Channels;
use segwild_scene::{Image, Mask, Observation, Scene, TASK_PIXELS, View};
use segwild_trainer::{
    AppearanceModel, Checkpoint, DensityKind, Model, Photos, Protocol, TrainError, TrainPhoto, TrainSettings,
    Trainer, choose_appearance, choose_budget, evaluate, render_view,
};
use std::convert::Infallible;
use std::sync::Arc;

#[test]
fn every_strategy_learns_a_view_it_never_saw_within_its_cap() {
    let scene = scene(8);
    let photos = photos(&scene, false, |_, _| ());
    for density in [DensityKind::Budget, DensityKind::Gradient, DensityKind::Mcmc] {
        let model = train(&scene, photos.clone(), TrainSettings { density, splats: 600, ..settings(400) });
        assert_sane(&model, 600);
        assert!(model.splats.len() > 350, "{density} never grew: {}", model.splats.len());
        let score =
            evaluate(&model, &*engine(), &scene, photos.clone(), &[7], Protocol::Plain, None).unwrap();
        assert!(score.psnr > 24.0 && score.ssim > 0.75, "{density}: {} dB, SSIM {}", score.psnr, score.ssim);
    }
}

/// The last checkpoint of a training by so many threads, which is stopped and resumed after these steps.
fn trained_bytes(
    scene: &Scene,
    photos: &Arc<dyn Photos>,
    settings: &TrainSettings,
    threads: usize,
    stops: &[u32],
) -> Vec<u8> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| {
        let mut trainer = Trainer::new(engine(), scene, photos.clone(), settings.clone()).unwrap();
        for &stop in stops {
            while trainer.steps_done() < stop {
                trainer.step().unwrap();
            }
            let held = wincode::deserialize(&bytes(&trainer.checkpoint().unwrap())).unwrap();
            trainer = Trainer::resume(engine(), scene, photos.clone(), held).unwrap();
        }
        while !trainer.is_done() {
            trainer.step().unwrap();
        }
        bytes(&trainer.checkpoint().unwrap())
    })
}

#[test]
fn resuming_gives_the_bytes_of_not_stopping_and_threads_do_not_matter() {
    let scene = scene(6);
    let appearance = |i: usize, image: &mut Image| {
        image.data.iter_mut().for_each(|v| *v = *v * (0.7 + 0.05 * i as f32) + 0.05)
    };
    let photos = photos(&scene, true, appearance);
    let all = [DensityKind::Budget, DensityKind::Gradient, DensityKind::Mcmc];
    let appearances = [AppearanceModel::Affine, AppearanceModel::Embed, AppearanceModel::Gsw];
    for (density, appearance) in all.into_iter().zip(appearances) {
        let s = TrainSettings { density, appearance_model: appearance, robust: true, ..settings(120) };
        let run = |threads, stops: &[u32]| trained_bytes(&scene, &photos, &s, threads, stops);
        let straight = run(1, &[]);
        assert!(straight == run(4, &[]), "{density}: threads matter");
        assert!(straight == run(2, &[1, 37, 100]), "{density}: stopping matters");
    }
}

#[test]
fn threads_do_not_matter_where_photos_are_shared_out_among_them() {
    let scene = scene(5);
    let large = |i: usize| {
        let (image, sky) = photo_of(&scene.views[i]);
        let (width, height) = (7 * W, 7 * H);
        assert!((width * height) as usize > TASK_PIXELS, "one thread does it all");
        let image = image.resized(width as usize, height as usize);
        TrainPhoto { image, valid: None, sky: Some(sky.resized(width, height)), transients: None }
    };
    let all: Vec<TrainPhoto> = (0..scene.views.len()).map(large).collect();
    let photos: Arc<dyn Photos> = Arc::new(move |i: usize| Ok::<_, Infallible>(all[i].clone()));
    for appearance_model in [AppearanceModel::Affine, AppearanceModel::Gsw] {
        let s = TrainSettings { appearance_model, robust: true, ..settings(24) };
        let run = |threads, stops: &[u32]| trained_bytes(&scene, &photos, &s, threads, stops);
        let straight = run(1, &[]);
        assert!(straight == run(3, &[]), "{appearance_model}: threads matter");
        assert!(straight == run(2, &[15]), "{appearance_model}: stopping matters");
    }
}

#[test]
fn a_checkpoint_of_another_scene_or_a_damaged_one_is_refused() {
    let six = scene(6);
    let photos = photos(&six, false, |_, _| ());
    // The appearance model with most parts has most to damage, and few positions are enough.
    for (appearance, every) in [(AppearanceModel::None, 997), (AppearanceModel::Gsw, 40_009)] {
        let settings = TrainSettings { appearance_model: appearance, ..settings(10) };
        let mut trainer = Trainer::new(engine(), &six, photos.clone(), settings).unwrap();
        let other = Trainer::resume(engine(), &scene(5), photos.clone(), trainer.checkpoint().unwrap());
        let refused = other.err().unwrap();
        assert!(matches!(refused, TrainError::Checkpoint(_)), "{refused}");
        trainer.step().unwrap();
        let mut whole = bytes(&trainer.checkpoint().unwrap());
        assert!(wincode::deserialize::<Checkpoint>(&whole[..whole.len() / 2]).is_err());
        // Flipped bits are refused by someone, or give a checkpoint that still works: never a panic.
        for at in (0..whole.len()).step_by(every) {
            whole[at] ^= 0x55;
            if let Ok(damaged) = wincode::deserialize::<Checkpoint>(&whole)
                && let Ok(mut trainer) = Trainer::resume(engine(), &six, photos.clone(), damaged)
            {
                drop(trainer.step());
            }
            whole[at] ^= 0x55;
        }
    }
}

#[test]
fn poor_scenes_train_sanely() {
    // One photo; two identical photos from one position; no points.
    let mut alone = scene(1);
    let mut twins = scene(2);
    twins.views[1] = View { name: "01.jpg".into(), ..twins.views[0].clone() };
    let mut bare = scene(5);
    bare.points.clear();
    for (scene, wanted) in [(&mut alone, 24.0), (&mut twins, 24.0), (&mut bare, 14.0)] {
        let photos = photos(scene, false, |_, _| ());
        let model = train(
            scene,
            photos.clone(),
            TrainSettings { robust: true, appearance_model: AppearanceModel::Affine, ..settings(200) },
        );
        assert_sane(&model, 1500);
        let score = evaluate(&model, &*engine(), scene, photos, &[0], Protocol::Plain, None).unwrap();
        assert!(
            score.psnr > wanted,
            "{} points, {} views: {} dB",
            scene.points.len(),
            scene.views.len(),
            score.psnr
        );
    }
}

#[test]
fn a_photo_that_is_not_a_number_is_left_out_by_name_and_the_rest_goes_on() {
    let scene = scene(5);
    let broken = photos(&scene, false, |i, image| {
        if i == 1 {
            image.data[100] = f32::NAN;
        }
    });
    let mut trainer = Trainer::new(engine(), &scene, broken, settings(30)).unwrap();
    for _ in 0..30 {
        assert_ne!(trainer.step().unwrap().view, 1);
    }
    let skipped = trainer.skipped();
    assert!(skipped.len() == 1 && skipped[0].name == "01.jpg", "{skipped:?}");
    assert_sane(&trainer.snapshot().unwrap(), 1500);

    let none = photos(&scene, false, |_, image| image.data[0] = f32::INFINITY);
    let error = Trainer::new(engine(), &scene, none, settings(30)).err().unwrap().to_string();
    assert!(error.contains("00.jpg") && error.contains("(0, 0)"), "{error}");
    let missing: Arc<dyn Photos> = Arc::new(|_: usize| Err("the file is gone".to_owned()));
    let error = Trainer::new(engine(), &scene, missing, settings(30)).err().unwrap().to_string();
    assert!(error.contains("gone"), "{error}");
    let wrong = TrainSettings { lr_mean: -1.0, ..settings(30) };
    let error =
        Trainer::new(engine(), &scene, photos(&scene, false, |_, _| ()), wrong).err().unwrap().to_string();
    assert!(error.contains("lr_mean"), "{error}");
}

#[test]
fn the_sky_stays_empty_of_splats_and_is_in_the_background() {
    let scene = scene(6);
    let photos = photos(&scene, true, |_, _| ());
    let model = train(&scene, photos.clone(), settings(300));
    let view = &scene.views[2];
    let (photo, sky) = photo_of(view);
    let engine = engine();
    let projected = engine.project(&model.splats, &view.camera, &view.pose, &model.options()).unwrap();
    let alpha =
        projected.blend(&Channels { count: 1, values: &vec![1.0; model.splats.len()] }).unwrap().alpha;
    drop(projected);
    let inner = sky.eroded(3.0);
    assert!(inner.count() > 300);
    let mean =
        inner.pixels().map(|(x, y)| alpha.at(0, x as usize, y as usize)).sum::<f32>() / inner.count() as f32;
    assert!(mean < 0.05, "the sky is {mean} opaque");
    let render = render_view(&model, &*engine, &view.camera, &view.pose, Some(2)).unwrap();
    assert!(segwild_objective::psnr(&render, &photo, None) > 24.0);
}

#[test]
fn light_that_varies_over_the_scene_is_learnt_by_embed_and_gsw_and_not_by_affine() {
    let scene = scene(12);
    // A beam from another side in each photo.
    let light = |i: usize, at: [f32; 3]| {
        let side = 2.0 * noise(i, 3) - 1.0;
        0.45 + 0.55 * (-((at[0] - side) / 0.5).powi(2)).exp()
    };
    let lit: Vec<Image> =
        scene.views.iter().enumerate().map(|(i, v)| photo_lit(v, |at| light(i, at)).0).collect();
    let photos = photos(&scene, false, |i, image| *image = lit[i].clone());
    let score = |appearance: AppearanceModel| {
        let model =
            train(&scene, photos.clone(), TrainSettings { appearance_model: appearance, ..settings(300) });
        evaluate(&model, &*engine(), &scene, photos.clone(), &[11], Protocol::Halves, None).unwrap().psnr
    };
    let (affine, embed, gsw) =
        (score(AppearanceModel::Affine), score(AppearanceModel::Embed), score(AppearanceModel::Gsw));
    assert!(embed > affine + 2.0, "embed {embed} dB, affine {affine} dB");
    assert!(gsw > affine + 2.0, "gsw {gsw} dB, affine {affine} dB");
}

#[test]
fn splat_embeddings_learn_nothing_before_their_share_of_the_steps() {
    let scene = scene(6);
    let photos =
        photos(&scene, true, |i, image| image.data.iter_mut().for_each(|v| *v *= 0.7 + 0.05 * i as f32));
    for appearance in [AppearanceModel::Embed, AppearanceModel::Gsw] {
        let splat_embeddings = |lr_splat_embedding: f32, steps: u32| {
            let s = TrainSettings {
                appearance_model: appearance,
                lr_splat_embedding,
                splat_embedding_from: 0.25,
                ..settings(80)
            };
            let mut trainer = Trainer::new(engine(), &scene, photos.clone(), s).unwrap();
            (0..steps).for_each(|_| drop(trainer.step().unwrap()));
            trainer.snapshot().unwrap().splat_embeddings
        };
        assert_eq!(splat_embeddings(0.01, 20), splat_embeddings(0.05, 20), "{appearance}: learnt too early");
        assert_ne!(splat_embeddings(0.01, 24), splat_embeddings(0.05, 24), "{appearance}: never learnt");
    }
}

#[test]
fn appearances_are_learnt_and_the_left_half_gives_that_of_the_right() {
    let scene = scene(8);
    // Day, dusk, night, each photo its own.
    let tint = |i: usize, c: usize, v: f32| {
        v * [1.0, 0.6, 0.35, 0.8][i % 4] * [1.0, 0.9, 0.7][(c + i) % 3] + 0.03 * (i % 3) as f32
    };
    let tinted = photos(&scene, false, |i, image| {
        for c in 0..3 {
            image.plane_mut(c).iter_mut().for_each(|v| *v = tint(i, c, *v));
        }
    });
    let of = |appearance: AppearanceModel| {
        train(&scene, tinted.clone(), TrainSettings { appearance_model: appearance, ..settings(400) })
    };
    let score = |model: &Model, protocol| {
        evaluate(model, &*engine(), &scene, tinted.clone(), &[7], protocol, None).unwrap()
    };
    let affine = of(AppearanceModel::Affine);
    let (halves, plain) = (score(&affine, Protocol::Halves), score(&affine, Protocol::Plain));
    assert!(halves.psnr > 24.0, "{}", halves.psnr);
    assert!(halves.psnr > plain.psnr + 3.0, "fitted {}, not fitted {}", halves.psnr, plain.psnr);
    // A photo trained on comes back in its own light, which one appearance for all cannot do.
    let view = &scene.views[2];
    let mut photo = photo_of(view).0;
    for c in 0..3 {
        photo.plane_mut(c).iter_mut().for_each(|v| *v = tint(2, c, *v));
    }
    let own = |model: &Model| {
        let render = render_view(model, &*engine(), &view.camera, &view.pose, Some(2)).unwrap();
        segwild_objective::psnr(&render, &photo, None)
    };
    let (with, without) = (own(&affine), own(&of(AppearanceModel::None)));
    assert!(with > 24.0 && with > without + 1.0, "its own appearance {with} dB, one for all {without} dB");
}

#[test]
fn auto_chooses_no_appearance_model_where_photos_share_a_light_and_one_where_they_differ() {
    let mut scene = scene(14);
    let views = scene.views.clone();
    for point in &mut scene.points {
        let sees = |(i, view): (usize, &View)| {
            let at = view.camera.pixel(view.pose.to_camera(point.position));
            view.camera.contains(at).then(|| Observation { view: i as u32, pixel: at.to_array() })
        };
        point.track = views.iter().enumerate().filter_map(sees).collect();
    }
    let tint = |i: usize, c: usize, v: f32| {
        v * [1.0, 0.6, 0.35, 0.8][i % 4] * [1.0, 0.9, 0.7][(c + i) % 3] + 0.03 * (i % 3) as f32
    };
    let choose = |photos: Arc<dyn Photos>| {
        let settings = TrainSettings { appearance_model: AppearanceModel::Auto, ..settings(400) };
        choose_appearance(engine(), &scene, photos, &settings, true, &|| false).unwrap()
    };
    let same = choose(photos(&scene, true, |_, _| ()));
    assert_eq!(same.appearance, AppearanceModel::None, "{}", same.why);
    assert!(same.agrees(), "{}", same.why);
    assert!(same.why.starts_with("none: ") && same.fits.len() == 1 && same.held_out >= 2, "{}", same.why);
    // A matrix explains what an automatic exposure varies, and the photos are of one light all the same.
    let exposed = choose(photos(&scene, true, |i, image| {
        image.data.iter_mut().for_each(|v| *v *= [1.0, 1.08, 0.93, 1.04][i % 4]);
    }));
    assert!(exposed.tracks.unwrap().explained() > 0.3, "{} {:?}", exposed.why, exposed.tracks);
    assert_eq!((exposed.appearance, exposed.fits.len()), (AppearanceModel::None, 1), "{}", exposed.why);
    let fixed = settings(400);
    let alone =
        choose_appearance(engine(), &scene, photos(&scene, true, |_, _| ()), &fixed, false, &|| false)
            .unwrap();
    assert!(
        alone.fits.is_empty() && alone.appearance == AppearanceModel::None,
        "no fit is needed: {}",
        alone.why
    );
    let tinted = |i: usize, image: &mut Image| {
        for c in 0..3 {
            image.plane_mut(c).iter_mut().for_each(|v| *v = tint(i, c, *v));
        }
    };
    let differs = choose(photos(&scene, true, tinted));
    assert!(differs.appearance != AppearanceModel::None, "{}", differs.why);
    assert_eq!(choose(photos(&scene, true, tinted)), differs, "the same again");
    // An undecided `auto` is refused.
    let open = TrainSettings { appearance_model: AppearanceModel::Auto, ..settings(10) };
    let refused = Trainer::new(engine(), &scene, photos(&scene, false, |_, _| ()), open).err().unwrap();
    assert!(refused.to_string().contains("auto"), "{refused}");
    let stopped =
        choose_appearance(engine(), &scene, photos(&scene, false, |_, _| ()), &settings(400), true, &|| true);
    assert!(matches!(stopped, Err(TrainError::Stopped)), "{stopped:?}");
}

#[test]
fn a_budget_spends_little_where_more_gains_little_and_all_where_every_doubling_pays() {
    let scene = scene(14);
    // Grain that no splat explains: what can be learnt is soon learnt.
    let grain = |i: usize, image: &mut Image| {
        image.data.iter_mut().enumerate().for_each(|(k, v)| *v += 0.2 * (noise(i, k) - 0.5));
    };
    let choose = |steps: u32| {
        let settings = TrainSettings { appearance_model: AppearanceModel::None, ..settings(steps) };
        choose_budget(engine(), &scene, photos(&scene, false, grain), &settings, false, &|| false).unwrap()
    };
    let ample = choose(4000);
    assert!(ample.steps <= 1000, "{}", ample.why);
    assert!(ample.why.contains("held out") && ample.fits.len() >= 2, "{}", ample.why);
    assert_eq!(choose(4000), ample, "the same again");
    let scarce = choose(200);
    assert_eq!(scarce.steps, 200, "{}", scarce.why);
    // Where nothing can be held out nothing can be known.
    let few = self::scene(5);
    let settings = TrainSettings { appearance_model: AppearanceModel::None, ..settings(4000) };
    let of_few =
        choose_budget(engine(), &few, photos(&few, false, |_, _| ()), &settings, false, &|| false).unwrap();
    assert_eq!((of_few.steps, of_few.fits.len()), (4000, 0), "{}", of_few.why);
    assert!(of_few.why.contains("too few"), "{}", of_few.why);
    let stopped =
        choose_budget(engine(), &scene, photos(&scene, false, |_, _| ()), &settings, false, &|| true);
    assert!(matches!(stopped, Err(TrainError::Stopped)), "{stopped:?}");
}

#[test]
fn a_budget_goes_beyond_the_scenes_own_steps_where_photos_agree() {
    let scene = scene(14);
    let choose = |effort: f32, beyond: bool| {
        let settings = TrainSettings { appearance_model: AppearanceModel::None, effort, ..settings(0) };
        let clean = photos(&scene, false, |_, _| ());
        choose_budget(engine(), &scene, clean, &settings, beyond, &|| false).unwrap()
    };
    let own = 270; // three tenths of 250 for the square root of 13: eight times as many are few more than trials pay from
    let differ = choose(0.3, false);
    assert_eq!((differ.steps, differ.fits.len()), (own, 0), "{}", differ.why);
    let agreed = choose(0.3, true);
    assert!(agreed.steps > own && agreed.steps <= 8 * own && !agreed.fits.is_empty(), "{}", agreed.why);
    // Where trials would take longer than the training nothing speaks for more.
    let hasty = choose(0.1, true);
    assert_eq!((hasty.steps, hasty.fits.len()), (90, 0), "{}", hasty.why);
}

/// A photo whose mask of the sky was empty was given a sky of its own all the same, learnt from whatever no splat covered:
/// held out, a sky fitted to its left half cost up to 11 dB on the right one.
#[test]
fn where_nothing_is_sky_photos_train_as_if_none_had_been_looked_for() {
    let scene = scene(6);
    let plain = photos(&scene, false, |_, _| {});
    let with = |sky: Option<Mask>| {
        let plain = plain.clone();
        let given =
            move |view: usize| plain.photo(view).map(|photo| TrainPhoto { sky: sky.clone(), ..photo });
        train(&scene, Arc::new(given), settings(60))
    };
    assert!(with(Some(Mask::empty(W, H))) == with(None));
}
