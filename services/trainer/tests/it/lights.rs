//! Appearance as a tool: a trained scene in any photo's light, between lights, in two at once, and baked into splats.

use glam::Vec3;
use segwild_objective::{
    AffineAppearance, AnyAppearance, EmbedAppearance, GswAppearance, GswWidth, NoAppearance,
};
use segwild_raster::CpuEngine;
use segwild_scene::{Camera, Image, Pose, Random, Splats};
use segwild_trainer::{Background, Model, SceneLighting, Stats, render_lit, render_view};
use std::sync::Arc;

const SPLATS: usize = 300;
const PHOTOS: usize = 3;

fn eye() -> (Camera, Pose) {
    let camera = Camera { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 };
    (camera, Pose::look_at(Vec3::new(0.3, -0.2, -2.5), Vec3::ZERO, Vec3::NEG_Y))
}

/// A matrix near the identity, offset and all.
fn matrix(random: &mut Random) -> [f32; 12] {
    std::array::from_fn(|i| f32::from(u8::from(i % 5 == 0)) * 0.9 + 0.1 * random.uniform())
}

/// Splats of moderate colours, which stay brighter than black in the appearance of each of the three photos.
fn model(appearance_model: &str, sh_degree: u32) -> Model {
    let mut random = Random::new(7);
    let mut splats = Splats { sh_degree, ..Splats::default() };
    for _ in 0..SPLATS {
        splats.means.push(std::array::from_fn(|_| 1.6 * random.uniform() - 0.8));
        splats.log_scales.push(std::array::from_fn(|_| -2.5 + 0.5 * random.uniform()));
        splats.rotations.push(std::array::from_fn(|_| random.normal()));
        splats.opacities.push(2.0 * random.normal());
        let spread = |k: usize| if k < 3 { 0.5 } else { 0.12 };
        splats.sh.extend((0..splats.sh_stride()).map(|k| spread(k) * (2.0 * random.uniform() - 1.0)));
    }
    let appearance = match appearance_model {
        "none" => AnyAppearance::None(NoAppearance),
        "affine" => {
            let mut appearance = AffineAppearance::new(PHOTOS + 1);
            (0..=PHOTOS).for_each(|view| appearance.set_matrix(view, matrix(&mut random)));
            AnyAppearance::Affine(appearance)
        }
        "gsw" => {
            let mut appearance = GswAppearance::new(PHOTOS + 1, 5, GswWidth::Cpu);
            (0..=PHOTOS).for_each(|view| appearance.below.set_matrix(view, matrix(&mut random)));
            let layer: Vec<f32> = appearance.layer().iter().map(|_| 0.1 * random.normal()).collect();
            appearance.set_layer(&layer);
            for view in 0..PHOTOS {
                let (camera, pose) = eye();
                let colours: Vec<f32> = (0..3 * 64 * 48).map(|_| random.uniform()).collect();
                let colour = |i: usize| Some([colours[3 * i], colours[3 * i + 1], colours[3 * i + 2]]);
                let image_conditioning = appearance.image_conditioning((64, 48), &camera, &pose, colour);
                appearance.set_image_conditioning(view, image_conditioning);
            }
            AnyAppearance::Gsw(Box::new(appearance))
        }
        _ => {
            let mut appearance = EmbedAppearance::new(PHOTOS + 1, 5);
            (0..=PHOTOS).for_each(|view| appearance.set_matrix(view, matrix(&mut random)));
            AnyAppearance::Embed(appearance)
        }
    };
    let splat_embeddings =
        (0..appearance.as_appearance().embedding_size() * SPLATS).map(|_| 0.06 * random.normal()).collect();
    let background = |_| Some(Background::constant(std::array::from_fn(|_| random.uniform())));
    Model {
        splats: Arc::new(splats),
        splat_embeddings,
        appearance,
        backgrounds: (0..PHOTOS).map(background).collect(),
        names: (0..PHOTOS).map(|i| format!("{i}.jpg")).collect(),
        trained_on: (0..PHOTOS as u32).collect(),
        transient_shares: vec![0.35; PHOTOS],
        transient_evidence: vec![None; PHOTOS],
        refined_poses: vec![None; PHOTOS],
        antialias: true,
        stats: Stats { step: 1, psnr: None },
    }
}

fn render(model: &Model, lighting: &SceneLighting) -> Image {
    let (camera, pose) = eye();
    render_lit(model, &CpuEngine::new(), &camera, &pose, lighting).expect("a render")
}

/// Largest difference between two images.
fn apart(a: &Image, b: &Image) -> f32 {
    a.data.iter().zip(&b.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn a_photos_light_renders_as_the_appearance_trained_for_it() {
    let (camera, pose) = eye();
    for appearance_model in ["none", "affine", "embed", "gsw"] {
        let model = model(appearance_model, 2);
        for view in [None, Some(0), Some(2)] {
            let trained = render_view(&model, &CpuEngine::new(), &camera, &pose, view).unwrap();
            let off = apart(&render(&model, &model.light(view).into()), &trained);
            assert!(off < 2e-3, "{appearance_model}, {view:?}: {off}"); // the trained one undoes the appearance on the background
        }
    }
}

#[test]
fn baked_splats_without_an_appearance_model_are_the_scene_in_that_appearance() {
    for appearance_model in ["none", "affine", "embed"] {
        for degree in 0..=3 {
            let model = model(appearance_model, degree);
            let light = model.light(Some(1));
            let lit = render(&model, &light.clone().into());
            let plain = Model {
                splats: Arc::new(model.baked(&light.clone().into())),
                splat_embeddings: Vec::new(),
                appearance: AnyAppearance::None(NoAppearance),
                ..model.clone()
            };
            // Over the same background, which a file of splats does not hold.
            let rendered = render(&plain, &plain.light(Some(1)).into());
            let off = apart(&lit, &rendered);
            assert!(off < 2e-6 * (1.0 + 3.0 * degree as f32), "{appearance_model}, degree {degree}: {off}");
            let raw = Model { splats: model.splats.clone(), ..plain };
            let unbaked = apart(&lit, &render(&raw, &raw.light(Some(1)).into()));
            assert!(
                appearance_model == "none" || unbaked > 0.05,
                "{appearance_model}, degree {degree}: {unbaked}"
            );
        }
    }
}

#[test]
fn an_affine_appearance_acts_on_the_higher_harmonics_by_its_matrix() {
    let model = model("affine", 3);
    let AnyAppearance::Affine(appearance) = &model.appearance else { unreachable!("the model is affine") };
    let m = appearance.matrix(1);
    let baked = model.baked(&model.light(Some(1)).into());
    for (i, (before, after)) in model.splats.sh.chunks(3).zip(baked.sh.chunks(3)).enumerate() {
        let base = i % 16 == 0;
        for c in 0..3 {
            let turned: f32 = (0..3).map(|k| m[4 * c + k] * before[k]).sum();
            // The constant one carries the offset, and the 0.5 that colours are counted from.
            let shift = (0..3).map(|k| 0.5 * m[4 * c + k]).sum::<f32>() + m[4 * c + 3] - 0.5;
            let wanted = if base { turned + shift / 0.282_094_79 } else { turned };
            assert!((after[c] - wanted).abs() < 2e-5, "coefficient {i}, channel {c}: {} {wanted}", after[c]);
        }
    }
}

#[test]
fn an_interpolation_of_two_lights_starts_and_ends_in_them() {
    for appearance_model in ["none", "affine", "embed"] {
        let model = model(appearance_model, 1);
        let (a, b) = (model.light(Some(0)), model.light(Some(2)));
        assert_eq!((a.towards(&b, 0.0), a.towards(&b, 1.0)), (a.clone(), b.clone()));
        let [first, half, last] = [0.0, 0.5, 1.0].map(|t| render(&model, &a.towards(&b, t).into()));
        let mean = |i: usize| 0.5 * (first.data[i] + last.data[i]);
        let off = (0..half.data.len()).map(|i| (half.data[i] - mean(i)).abs()).fold(0.0, f32::max);
        assert!(
            off < 1e-5,
            "{appearance_model}: light adds up, so that half way is the mean of both ({off})"
        );
    }
}

#[test]
fn strength_0_is_the_scenes_mean_appearance_and_2_is_twice_as_far() {
    let model = model("embed", 1);
    let (own, photo) = (model.light(None), model.light(Some(1)));
    assert_eq!(model.strengthened(&photo, 0.0), own);
    assert_eq!(model.strengthened(&photo, 1.0), photo);
    let twice = model.strengthened(&photo, 2.0);
    assert!(apart(&render(&model, &own.towards(&twice, 0.5).into()), &render(&model, &photo.into())) < 1e-5);
}

#[test]
fn an_object_has_its_own_light_and_the_rest_keeps_the_scenes() {
    let model = model("embed", 2);
    let (day, night) = (model.light(Some(0)), model.light(Some(1)));
    // Everything, nothing, half of the splats.
    let with = |whose: Vec<bool>| SceneLighting { scene: day.clone(), objects: vec![(whose, night.clone())] };
    let all_day = render(&model, &day.clone().into());
    assert_eq!(render(&model, &with(vec![false; SPLATS])), all_day);
    let left: Vec<bool> = model.splats.means.iter().map(|m| m[0] < -0.35).collect();
    let lighting = with(left.clone());
    let both = render(&model, &lighting);
    // What shows none of the object is as it was; what shows nothing else is as the object's light makes it.
    let only = |wanted: bool| {
        let mut part = model.clone();
        let keep: Vec<usize> = (0..SPLATS).filter(|&i| left[i] == wanted).collect();
        part.select(&keep);
        part
    };
    let (camera, pose) = eye();
    let cover = |part: &Model| {
        let white = Model {
            appearance: AnyAppearance::None(NoAppearance),
            splat_embeddings: Vec::new(),
            splats: Arc::new(Splats { sh: vec![0.0; part.splats.sh.len()], ..(*part.splats).clone() }),
            backgrounds: vec![Some(Background::constant([0.0; 3])); PHOTOS],
            ..part.clone()
        };
        render_view(&white, &CpuEngine::new(), &camera, &pose, Some(0)).unwrap()
    };
    let (object, rest) = (cover(&only(true)), cover(&only(false)));
    let dark = render(&model, &SceneLighting { scene: night.clone(), objects: Vec::new() });
    let (mut same, mut changed) = (0, 0);
    for i in 0..object.pixels() {
        let off = |other: &Image| (0..3).any(|c| (both.plane(c)[i] - other.plane(c)[i]).abs() > 1e-5);
        if object.data[i] == 0.0 {
            assert!(!off(&all_day), "pixel {i}");
            same += 1;
        }
        if rest.data[i] == 0.0 && object.data[i] > 0.49 {
            assert!(!off(&dark), "pixel {i}");
        }
        changed += usize::from(object.data[i] > 0.2 && off(&all_day));
    }
    assert!(same > 100 && changed > 100, "{same} as they were, {changed} under the other light");
    // The same two lights, written into the splats.
    let plain = Model {
        splats: Arc::new(model.baked(&lighting)),
        splat_embeddings: Vec::new(),
        appearance: AnyAppearance::None(NoAppearance),
        ..model.clone()
    };
    assert!(apart(&render(&plain, &plain.light(Some(0)).into()), &both) < 1e-5);
}
