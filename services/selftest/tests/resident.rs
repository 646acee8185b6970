//! Data that stays on the device from view to view: splats, and channels.

mod common;

use common::{engine, image, many, rules, splats, step_with, view};
use segwild_gpu::{AdapterChoice, GpuEngine, training_bytes};
use segwild_objective::field::{
    AreaAverage, FeatureTarget, FieldRefinement, FieldWeights, LearnedDecoder, Lifting, Membership,
    SampledPixels,
};
use segwild_objective::{
    Appearance, FallbackEngine, FieldBackend, GswAppearance, GswWidth, NetworksStep, SplatEmbeddings,
    TrainingBackend, TrainingSplats,
};
use segwild_raster::{Channels, CpuEngine, Frame, ProjectOptions, Rasterizer, ResidentChannels};
use segwild_scene::{Image, Mask, MaskSet, Random, ScoredMask, Splats};
use segwild_selftest::{Tolerance, some_appearance, training_splats};

const SPLATS: usize = 5000;

fn values(count: usize) -> Vec<f32> {
    many(&mut Random::new(82), SPLATS * count, -1.0, 1.0)
}

fn scene() -> Splats {
    splats(81, SPLATS, (0.01, 0.1))
}

/// The frames of some views.
fn draw(engine: &dyn Rasterizer, splats: &Splats, channels: &ResidentChannels) -> Vec<Frame> {
    let frame = |(width, height)| {
        let (camera, pose) = view(width, height);
        let projected = engine.project(splats, &camera, &pose, &ProjectOptions::default());
        projected.and_then(|projected| projected.blend_resident(channels)).expect("it is blended")
    };
    [(64, 48), (50, 70), (33, 20)].map(frame).to_vec()
}

fn reopened(engine: &GpuEngine) -> GpuEngine {
    GpuEngine::new(&AdapterChoice::Named(engine.adapter().name.clone())).expect("it opens again")
}

/// An engine to which no other test of this process uploads.
fn engine_alone(test: &str) -> Option<GpuEngine> {
    engine(test).map(reopened)
}

#[test]
fn resident_channels_are_uploaded_once_for_all_views() {
    let alone = engine_alone("resident_channels_are_uploaded_once_for_all_views");
    let Some(gpu) = &alone else { return };
    let scene = scene();
    let resident = gpu.upload_splats(&scene).expect("it is uploaded").expect("it fits");
    // One vec4 at once; four, of which some stay empty; several times four.
    for count in [1, 3, 20, 64] {
        let values = values(count);
        let (once, mut channels) =
            (ResidentChannels::new(count, &values), ResidentChannels::new(count, &values));
        let before = gpu.work_counts().uploaded_bytes;
        channels.upload(&*resident).expect("it is uploaded");
        let crossed = gpu.work_counts().uploaded_bytes - before;
        let least = (4 * values.len()) as u64;
        assert!(crossed >= least && crossed <= 4 * least, "{count} channels: {crossed} bytes to upload them");
        let before = gpu.work_counts().uploaded_bytes;
        let frames = draw(&*resident, &scene, &channels);
        let crossed = gpu.work_counts().uploaded_bytes - before;
        // Cameras.
        assert!(crossed < 1000, "{count} channels: {crossed} bytes for views of what is there");
        let before = gpu.work_counts().uploaded_bytes;
        assert!(frames == draw(&*resident, &scene, &once), "{count} channels");
        let crossed = gpu.work_counts().uploaded_bytes - before;
        assert!(crossed >= 3 * least, "{count} channels: {crossed} bytes where each view uploads all");
    }
}

#[test]
fn alpha_alone_needs_no_channels() {
    let alone = engine_alone("alpha_alone_needs_no_channels");
    let Some(gpu) = &alone else { return };
    let scene = scene();
    let resident = gpu.upload_splats(&scene).expect("it is uploaded").expect("it fits");
    let before = gpu.work_counts().uploaded_bytes;
    let nothing = draw(&*resident, &scene, &ResidentChannels::new(0, &[][..]));
    let crossed = gpu.work_counts().uploaded_bytes - before;
    assert!(crossed < 1000, "{crossed} bytes");
    let cpu = CpuEngine::new();
    for engine in [&*resident, &cpu as &dyn Rasterizer] {
        let zeros = draw(engine, &scene, &ResidentChannels::new(1, vec![0.0; SPLATS]));
        let nothing = draw(engine, &scene, &ResidentChannels::new(0, &[][..]));
        assert!(zeros.iter().zip(&nothing).all(|(a, b)| a.alpha == b.alpha), "{}", engine.name());
    }
    assert!(nothing[0].alpha.data.iter().any(|&a| a > 0.5) && nothing[0].image.data.is_empty());
}

#[test]
fn channels_of_another_engine_are_blended_from_the_hosts() {
    let Some(gpu) = engine("channels_of_another_engine_are_blended_from_the_hosts") else { return };
    let (scene, other, values) = (scene(), reopened(gpu), values(3));
    let mut channels = ResidentChannels::new(3, &values);
    channels.upload(&other).expect("it is uploaded");
    let wanted = draw(gpu, &scene, &ResidentChannels::new(3, &values));
    assert!(draw(gpu, &scene, &channels) == wanted && draw(&other, &scene, &channels) == wanted);
    let cpu = CpuEngine::new();
    assert!(draw(&cpu, &scene, &channels) == draw(&cpu, &scene, &ResidentChannels::new(3, &values)));
    // A fallback engine keeps them on the first engine's device.
    let unused =
        FallbackEngine::new(Box::new(other), Box::new(CpuEngine::new()), |why: &str| panic!("{why}"));
    channels.upload(&unused).expect("it is uploaded");
    assert!(channels.on_device().is_some() && draw(&unused, &scene, &channels) == wanted);
}

#[test]
fn channels_that_would_take_too_much_memory_are_not_uploaded_and_still_blended() {
    let test = "channels_that_would_take_too_much_memory_are_not_uploaded_and_still_blended";
    let Some(gpu) = engine(test) else { return };
    let (scene, values) = (scene(), values(64));
    let tight = reopened(gpu);
    // Enough for a view, and less than four times the channels.
    tight.keep_within((3 * 4 * values.len()) as u64);
    let mut channels = ResidentChannels::new(64, &values);
    channels.upload(&tight).expect("it is no failure");
    assert!(channels.on_device().is_none());
    assert!(draw(&tight, &scene, &channels) == draw(gpu, &scene, &channels));
    assert!(
        tight.allocated_bytes() <= tight.budget(),
        "{} of {} bytes",
        tight.allocated_bytes(),
        tight.budget()
    );
    tight.keep_within(0);
    channels.upload(&tight).expect("it is uploaded");
    assert!(channels.on_device().is_some());
    // Dropped channels free their memory.
    let taken = tight.allocated_bytes();
    drop(channels);
    let channels = Channels { count: 64, values: &values };
    let again = tight.upload_channels(&channels).expect("it is uploaded");
    assert!(
        again.is_some() && tight.allocated_bytes() == taken,
        "{} bytes, not {taken}",
        tight.allocated_bytes()
    );
}

/// A feature target for a view of this size, and the masks of its pixels.
fn feature_target(seed: u64, width: u32, height: u32, planes: usize) -> (Image, AreaAverage, Membership) {
    let grid = (width as usize / 3, height as usize / 4);
    let masks = [0, 7, 20].map(|first| {
        let mask = Mask::from_fn(width, height, |x, _| x >= first && x < first + 10);
        ScoredMask { mask, predicted_iou: 1.0, stability: 1.0 }
    });
    let masks = MaskSet { width, height, masks: masks.to_vec() };
    let (wide, high) = (width as usize, height as usize);
    let average = AreaAverage::new((wide, high), grid);
    (image(seed, grid.0, grid.1, planes), average, Membership::new(&masks, wide, high))
}

#[test]
fn a_step_of_the_feature_field_uploads_the_sampled_pixels_and_nothing_of_splats_and_photos() {
    let test = "a_step_of_the_feature_field_uploads_the_sampled_pixels_and_nothing_of_splats_and_photos";
    let alone = engine_alone(test);
    let Some(gpu) = &alone else { return };
    let scene = scene();
    let resident = gpu.upload_splats(&scene).expect("it is uploaded").expect("it fits");
    let (count, decoded) = (24, 40);
    let weights = FieldWeights { embedding: 0.7, compact: 0.3, rate: 0.01 };
    let refine = |field: &mut FieldRefinement, learned: bool| {
        let mut crossed = 0;
        for (step, (width, height)) in [(64, 48), (50, 70), (33, 20)].into_iter().enumerate() {
            let (camera, pose) = view(width, height);
            let projected =
                resident.project(&scene, &camera, &pose, &ProjectOptions::default()).expect("it is seen");
            let planes = if learned { decoded } else { count };
            let (target, average, membership) = feature_target(83 + step as u64, width, height, planes);
            let validity = vec![0.8; target.pixels()];
            let mut feature_target = FeatureTarget {
                target: &target,
                scale: 0.5,
                validity: &validity,
                average: &average,
                on_device: None,
            };
            let on_device = gpu.upload_target(&feature_target).expect("it is uploaded");
            feature_target.on_device = on_device.as_deref();
            let pixels: Vec<u32> = (0..width * height).step_by(3).collect();
            let sampled = SampledPixels { pixels: &pixels, membership: &membership };
            let before = gpu.work_counts().uploaded_bytes;
            field.step(&*projected, &feature_target, &sampled).expect("it is learnt");
            crossed += gpu.work_counts().uploaded_bytes - before;
        }
        (crossed, field.losses().expect("they are downloaded"))
    };
    for learned in [false, true] {
        let decoder = learned.then(|| {
            let numbers = many(&mut Random::new(85), (count + 1) * decoded, -0.2, 0.2);
            LearnedDecoder::new(&numbers[..count * decoded], &numbers[count * decoded..], 0.01)
        });
        let mut here = FieldRefinement::new(count, values(count), decoder.clone(), weights);
        let mut there = FieldRefinement::new(count, values(count), decoder, weights);
        there.upload(gpu).expect("it is uploaded");
        assert!(there.is_on_device());
        let ((_, wanted), (crossed, losses)) = (refine(&mut here, learned), refine(&mut there, learned));
        // Positions and masks of the pixels, and the tables of the networks that compare them.
        let pixels = 4 * (64 * 48 + 50 * 70 + 33 * 20) / 3;
        assert!(crossed < 2 * pixels + 3000, "{crossed} bytes for sampled pixels of {pixels}");
        let [got, wanted] = [losses, wanted].map(|losses| [losses.embedding, losses.compact]);
        Tolerance::BLENDED.compare("losses", &got, &wanted).expect("the same losses");
        let (here, there) = (here.finish().expect("they are here"), there.finish().expect("they come back"));
        Tolerance::GRADIENTS.compare("features", &there.values, &here.values).expect("the same is learnt");
        let [there, here] = [there, here].map(|refined| refined.decoder.unwrap_or_default());
        Tolerance::GRADIENTS.compare("decoder", &there, &here).expect("the same is learnt");
        assert_eq!(here.is_empty(), !learned);
    }
}

#[test]
fn sums_over_views_stay_where_they_are() {
    let alone = engine_alone("sums_over_views_stay_where_they_are");
    let Some(gpu) = &alone else { return };
    let (scene, count) = (scene(), 24);
    let resident = gpu.upload_splats(&scene).expect("it is uploaded").expect("it fits");
    let mut sums = Lifting::new(SPLATS, count);
    sums.allocate_on_device(gpu).expect("there is memory");
    let before = gpu.work_counts().uploaded_bytes;
    let (camera, pose) = view(64, 48);
    let projected = resident.project(&scene, &camera, &pose, &ProjectOptions::default()).expect("it is seen");
    sums.add(&*projected, &image(90, 64, 48, count + 1)).expect("it is added");
    // Eight numbers at once, filled up.
    let (crossed, images) = (gpu.work_counts().uploaded_bytes - before, 4 * (count + 8) * 64 * 48);
    assert!(crossed < images as u64 + 1000, "{crossed} bytes where an image is {images}");
    let (sums, weights) = sums.finish().expect("they come back");
    assert!(sums.len() == SPLATS * count && weights.iter().any(|&weight| weight > 0.0));
}

#[test]
fn a_field_that_leaves_too_little_memory_for_its_steps_is_refined_on_the_host() {
    let test = "a_field_that_leaves_too_little_memory_for_its_steps_is_refined_on_the_host";
    let Some(gpu) = engine(test) else { return };
    let (scene, count) = (scene(), 24);
    let weights = FieldWeights { embedding: 1.0, compact: 0.0, rate: 0.01 };
    let (target, average, membership) = feature_target(95, 64, 48, count);
    let validity = vec![1.0; target.pixels()];
    let feature_target = FeatureTarget {
        target: &target,
        scale: 1.0,
        validity: &validity,
        average: &average,
        on_device: None,
    };
    let sampled = SampledPixels { pixels: &[], membership: &membership };
    // Budgets from one where nothing is uploaded to one where all does: no step runs out of memory.
    let mut uploaded = Vec::new();
    for megabytes in [3, 4, 5, 6, 8, 24] {
        let small = reopened(gpu);
        small.keep_within(megabytes << 20);
        let mut field = FieldRefinement::new(count, values(count), None, weights);
        let mut sums = Lifting::new(SPLATS, count);
        field.upload(&small).expect("want of memory is no failure");
        let (camera, pose) = view(64, 48);
        let projected = small.project(&scene, &camera, &pose, &ProjectOptions::default());
        let projected = projected.unwrap_or_else(|error| panic!("{megabytes} MiB: {error}"));
        field
            .step(&*projected, &feature_target, &sampled)
            .unwrap_or_else(|error| panic!("{megabytes} MiB: {error}"));
        uploaded.push(field.is_on_device());
        drop(field);
        sums.allocate_on_device(&small).expect("want of memory is no failure");
        sums.add(&*projected, &image(96, 64, 48, count + 1))
            .unwrap_or_else(|error| panic!("{megabytes} MiB: {error}"));
    }
    assert!(!uploaded[0] && uploaded[5] && uploaded.is_sorted(), "{uploaded:?}");
}

#[test]
fn a_step_launches_what_it_needs_in_one_submission_for_the_splats_and_one_for_the_losses() {
    let test = "a_step_launches_what_it_needs_in_one_submission_for_the_splats_and_one_for_the_losses";
    let alone = engine_alone(test);
    let Some(gpu) = &alone else { return };
    let gpu = reopened(gpu);
    let (camera, pose) = view(96, 64);
    let state = training_splats(scene());
    let mut on_device = gpu.upload_training(&mut || state.clone()).expect("it is uploaded").expect("it fits");
    let mut learn = || {
        let before = gpu.work_counts();
        step_with(&mut *on_device, (&camera, &pose), None, None, &rules(0.001), 92, 0.1)
            .expect("it is learnt");
        gpu.work_counts() - before
    };
    // The first step on a photo uploads it and waits for the number of its pairs.
    learn();
    let counts = learn();
    println!("{counts:?}");
    // Three for each of the seven digits of a depth and the two of a tile, and 38 others.
    assert!(counts.launches <= 65, "{counts:?}");
    assert!(counts.passes <= 7, "those in a row share a pass: {counts:?}");
    assert_eq!((counts.submissions, counts.waits), (2, 1), "{counts:?}");
}

#[test]
fn a_step_of_networks_uploads_its_photo_and_nothing_of_the_splats() {
    let alone = engine_alone("a_step_of_networks_uploads_its_photo_and_nothing_of_the_splats");
    let Some(gpu) = &alone else { return };
    let gpu = reopened(gpu);
    let view = view(96, 64);
    let (appearance, draw) = some_appearance(&view.0, &view.1);
    let splats = scene();
    let splat_embeddings = SplatEmbeddings {
        values: appearance.first_embeddings(&splats.means),
        first: vec![0.0; SPLATS * GswAppearance::EMBEDDING_SIZE],
        second: vec![0.0; SPLATS * GswAppearance::EMBEDDING_SIZE],
    };
    let state = TrainingSplats {
        splat_embeddings,
        networks: Some(appearance.training_networks()),
        ..training_splats(splats)
    };
    let mut on_device = gpu.upload_training(&mut || state.clone()).expect("it is uploaded").expect("it fits");
    let light = appearance.below.photo(0);
    let rule = rules(0.001);
    let mut learn = |key: u64| {
        let unet_input = appearance.unet_input(0, draw).expect("there is light");
        let photo = 4 * (unet_input.image.data.len() + unet_input.beside.data.len());
        let step = NetworksStep {
            unet_input: Some(unet_input),
            draw,
            decides: true,
            rules: [rule.splat_embeddings; 2],
        };
        let before = gpu.work_counts().uploaded_bytes;
        let results =
            step_with(&mut *on_device, (&view.0, &view.1), Some(&light), Some(step), &rule, key, 0.1);
        results.expect("it is learnt");
        (gpu.work_counts().uploaded_bytes - before, photo as u64)
    };
    // The first step on a photo uploads it.
    learn(91);
    let (crossed, photo) = learn(91);
    println!("{crossed} bytes, {photo} of them the photo for its network");
    assert!(crossed >= photo && crossed < photo + (64 << 10), "{crossed} bytes, {photo} the photo's");
    let (taken, estimate) = (
        gpu.allocated_bytes(),
        training_bytes(SPLATS, 96 * 64, 1, GswAppearance::EMBEDDING_SIZE, Some(GswWidth::Cpu)),
    );
    println!("{taken} bytes taken, {estimate} estimated");
    assert!(taken <= estimate && estimate <= 6 * taken, "{taken} bytes taken, {estimate} estimated");
    let after = on_device.download().expect("they are downloaded");
    let moved = after.networks.expect("and so do the networks").weights;
    assert!(moved != appearance.training_networks().weights && moved.iter().all(|weight| weight.is_finite()));
}
