//! The synthetic set against itself: its images, depths, labels and points must agree.

use glam::{DVec3, Vec2, Vec3};
use segwild_scene::{Image, Mask, Scene, SceneSettings};
use segwild_synthetic::{
    CLICKS, LightVariation, ObjectKind, SyntheticError, SyntheticOptions, SyntheticPlan, SyntheticScene,
    generate,
};
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

fn options() -> SyntheticOptions {
    SyntheticOptions {
        seed: 11,
        train: 22,
        test: 4,
        long_side: 120,
        occlusion: 0.25,
        points: 600,
        ..Default::default()
    }
}

fn scene() -> &'static SyntheticScene {
    static SCENE: OnceLock<SyntheticScene> = OnceLock::new();
    SCENE.get_or_init(|| generate(&options()).unwrap())
}

#[test]
fn the_same_seed_gives_the_same_bytes_on_any_number_of_threads() {
    let options =
        SyntheticOptions { train: 3, test: 1, long_side: 64, points: 120, ..SyntheticOptions::default() };
    let with = |threads: usize, options: &SyntheticOptions| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| generate(options).unwrap())
    };
    let (one, three) = (with(1, &options), with(3, &options));
    assert_eq!(one.points, three.points);
    for (a, b) in one.photos.iter().zip(&three.photos) {
        assert_eq!((&a.photo, &a.clean, &a.depth, &a.parts), (&b.photo, &b.clean, &b.depth, &b.parts));
        assert_eq!((&a.transients, &a.pose, &a.photo_light), (&b.transients, &b.pose, &b.photo_light));
    }
    let other = with(2, &SyntheticOptions { seed: 2, ..options });
    assert_ne!(one.photos[0].clean, other.photos[0].clean);
}

/// The bytes of all files below a folder.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut found, mut open) = (BTreeMap::new(), vec![folder.to_owned()]);
    while let Some(next) = open.pop() {
        for entry in std::fs::read_dir(&next).unwrap().flatten() {
            let path = entry.path();
            if path.is_dir() {
                open.push(path);
            } else {
                found.insert(path.strip_prefix(folder).unwrap().to_owned(), std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

/// Few photos, for tests that write them.
fn few() -> SyntheticOptions {
    SyntheticOptions { train: 4, test: 1, long_side: 64, points: 100, ..options() }
}

#[test]
fn photos_taken_one_by_one_are_those_of_the_whole_set() {
    let (scene, plan) = (generate(&few()).unwrap(), SyntheticPlan::new(&few()).unwrap());
    assert_eq!((plan.points(), plan.photo_count()), (&scene.points[..], 5));
    // In any order, and again.
    for index in [3, 0, 4, 3] {
        let (a, b) = (plan.photo(index), &scene.photos[index]);
        assert_eq!((&a.photo, &a.clean, &a.depth, &a.parts), (&b.photo, &b.clean, &b.depth, &b.parts));
        assert_eq!((&a.instances, &a.transients, a.test), (&b.instances, &b.transients, b.test));
        assert_eq!((&a.name, a.pose, &a.photo_light), (&b.name, b.pose, &b.photo_light));
    }
    let (whole, streamed) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mut counts = Vec::new();
    let report = |count: usize| {
        counts.push(count);
        ControlFlow::Continue(())
    };
    let manifest = plan.write(streamed.path(), report).unwrap();
    assert_eq!(counts, [1, 2, 3, 4, 5]);
    assert_eq!(manifest, scene.write(whole.path()).unwrap());
    assert_eq!(manifest, scene.manifest());
    let (whole, streamed) = (files(whole.path()), files(streamed.path()));
    assert!(whole.len() > 5 * (7 + scene.objects().len()), "{}", whole.len());
    assert!(whole.keys().eq(streamed.keys()));
    assert!(whole.iter().all(|(name, bytes)| streamed[name] == *bytes));
}

#[test]
fn a_set_that_is_stopped_leaves_no_scene_of_another_one() {
    let dir = tempfile::tempdir().unwrap();
    generate(&few()).unwrap().write(dir.path()).unwrap();
    let other = SyntheticOptions { occlusion: 0.1, ..few() };
    let plan = SyntheticPlan::new(&other).unwrap();
    let stop = |count: usize| if count == 2 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
    let stopped = plan.write(dir.path(), stop);
    assert!(matches!(stopped, Err(SyntheticError::Stopped { written: 2, photos: 5 })), "{stopped:?}");
    assert!(!dir.path().join("truth.json").exists() && !dir.path().join("sparse/0/images.bin").exists());
    let mut counts = Vec::new();
    let report = |count: usize| {
        counts.push(count);
        ControlFlow::Continue(())
    };
    plan.write(dir.path(), report).unwrap();
    assert_eq!(counts, [3, 4, 5], "photos that were written are not taken again");
    let whole = tempfile::tempdir().unwrap();
    generate(&other).unwrap().write(whole.path()).unwrap();
    assert!(files(dir.path()) == files(whole.path()));
}

#[test]
fn a_set_that_was_stopped_and_is_another_or_lost_a_photo_is_written_from_the_start() {
    let dir = tempfile::tempdir().unwrap();
    let (stopped, other) = (SyntheticOptions { train: 6, ..few() }, few());
    let stop = |count: usize| if count == 6 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
    let written = |options: &SyntheticOptions| SyntheticPlan::new(options).unwrap().write(dir.path(), stop);
    let starts_over = |options: &SyntheticOptions| {
        let mut counts = Vec::new();
        let report = |count: usize| {
            counts.push(count);
            ControlFlow::Continue(())
        };
        SyntheticPlan::new(options).unwrap().write(dir.path(), report).unwrap();
        let whole = tempfile::tempdir().unwrap();
        generate(options).unwrap().write(whole.path()).unwrap();
        assert!(files(dir.path()) == files(whole.path()));
        counts[0] == 1
    };
    assert!(written(&stopped).is_err());
    // What was being written of the photo after the last.
    std::fs::write(dir.path().join("truth/clean/photo_006.png"), "half of a file").unwrap();
    assert!(starts_over(&other));
    assert!(written(&stopped).is_err());
    std::fs::remove_file(dir.path().join("images/photo_002.png")).unwrap();
    assert!(starts_over(&stopped));
    assert!(written(&stopped).is_err());
    assert!(!starts_over(&stopped));
    assert!(written(&stopped).is_err());
    std::fs::remove_file(dir.path().join("truth/depth/photo_001.pfm")).unwrap();
    assert!(starts_over(&stopped));
    // What cannot be believed is refused, and nothing is removed.
    assert!(written(&stopped).is_err());
    let path = dir.path().join("truth/unfinished.json");
    let text = std::fs::read_to_string(&path).unwrap();
    let mut forged: serde_json::Value = serde_json::from_str(&text).unwrap();
    forged["truth"]["rankings"].as_array_mut().unwrap().pop();
    for (text, reason) in [("[]", "does not name the set"), (&*forged.to_string(), "do not fit together")] {
        std::fs::write(&path, text).unwrap();
        let before = files(dir.path());
        let refused = written(&other).unwrap_err().to_string();
        assert!(refused.contains("unfinished.json") && refused.contains(reason), "{refused}");
        assert!(files(dir.path()) == before);
    }
    // Another version may take other photos.
    std::fs::write(&path, text.replacen("\"version\":\"", "\"version\":\"0.", 1)).unwrap();
    assert!(starts_over(&stopped));
}

#[test]
fn a_smaller_set_leaves_no_photo_of_a_larger_one() {
    let dir = tempfile::tempdir().unwrap();
    let set = |train| SyntheticOptions { train, test: 0, long_side: 32, ..few() };
    generate(&set(6)).unwrap().write(dir.path()).unwrap();
    std::fs::write(dir.path().join("images/own.png"), "a file of somebody else").unwrap();
    generate(&set(4)).unwrap().write(dir.path()).unwrap();
    let whole = tempfile::tempdir().unwrap();
    generate(&set(4)).unwrap().write(whole.path()).unwrap();
    std::fs::write(whole.path().join("images/own.png"), "a file of somebody else").unwrap();
    assert!(files(dir.path()) == files(whole.path()));
}

#[test]
fn a_manifest_that_cannot_be_read_or_leads_elsewhere_is_refused_and_nothing_is_removed() {
    let dir = tempfile::tempdir().unwrap();
    let set = SyntheticOptions { train: 2, test: 0, long_side: 32, points: 0, ..few() };
    let mut forged = generate(&set).unwrap().write(dir.path()).unwrap();
    let truth = dir.path().join("truth.json");
    let other = generate(&SyntheticOptions { occlusion: 0.1, ..set }).unwrap();
    let refused = |text: &[u8]| {
        std::fs::write(&truth, text).unwrap();
        let before = files(dir.path());
        let message = other.write(dir.path()).unwrap_err().to_string();
        assert!(files(dir.path()) == before, "{message}");
        assert!(message.contains("truth.json"), "{message}");
        message
    };
    assert!(refused(b"no manifest").contains("does not name the set"));
    for name in ["../split.tsv", "..", "/etc/hostname", "a\\b", ""] {
        forged.photos[0].name = name.into();
        assert!(refused(&serde_json::to_vec(&forged).unwrap()).contains("is no file name"), "{name}");
    }
    forged.photos = vec![forged.photos[1].clone(); 4001];
    assert!(refused(&serde_json::to_vec(&forged).unwrap()).contains("at most 4000 photos"));
    std::fs::remove_file(&truth).unwrap();
    std::fs::create_dir(&truth).unwrap();
    assert!(other.write(dir.path()).unwrap_err().to_string().contains("it is a folder"));
}

#[test]
fn points_have_the_colours_that_their_photos_show() {
    let exact = SyntheticOptions { pixel_noise: 0.0, outliers: 0.0, ..few() };
    let scene = generate(&exact).unwrap();
    assert!(scene.points.len() > 50, "{}", scene.points.len());
    for point in &scene.points {
        let mut sum = Vec3::ZERO;
        for seen in &point.track {
            let (photo, [x, y]) = (&scene.photos[seen.view as usize], seen.pixel);
            assert!(!photo.transients.at(x, y), "{x}, {y} of {}", photo.name);
            let at = |channel| photo.photo.at(channel, x as usize, y as usize);
            sum += Vec3::new(at(0), at(1), at(2));
        }
        assert_eq!(point.colour, (sum / point.track.len() as f32).to_array());
    }
}

#[test]
fn clicks_lie_in_the_photos_that_show_an_object_best() {
    let scene = scene();
    for object in 1..scene.instances.len() as u16 {
        let mut ranks = Vec::new();
        for photo in scene.photos.iter().filter(|p| !p.test) {
            let whole = photo.mask(object);
            let visible = whole.minus(&photo.transients).count();
            let Some([x, y]) = photo.click(object).filter(|_| visible * 250 >= photo.depth.len()) else {
                continue;
            };
            let (w, h) = (whole.width() - 1, whole.height() - 1);
            let inside = whole.pixels().all(|(x, y)| x > 0 && y > 0 && x < w && y < h);
            let well = inside && visible as f32 >= 0.9 * whole.count() as f32;
            ranks.push((!well, std::cmp::Reverse(visible), photo.name.clone(), [x, y]));
        }
        ranks.sort_by(|a, b| (a.0, a.1, &a.2).cmp(&(b.0, b.1, &b.2)));
        ranks.truncate(CLICKS);
        let clicks = scene.clicks(object).into_iter().map(|c| (c.photo, [c.x, c.y]));
        let best: Vec<_> = ranks.into_iter().map(|(_, _, photo, at)| (photo, at)).collect();
        assert_eq!(clicks.collect::<Vec<_>>(), best, "{}", scene.instances[usize::from(object)].name);
    }
}

#[test]
fn depth_carried_to_other_photos_meets_the_same_instance() {
    let scene = scene();
    let (mut met, mut agree, mut labelled, mut near) = (0, 0, 0, 0);
    for a in &scene.photos {
        for i in (0..a.depth.len()).step_by(37) {
            if a.depth[i] == 0.0 {
                assert_eq!((a.instances[i], a.parts[i]), (0, 0));
                continue;
            }
            let pixel = Vec2::new((i % a.photo.width) as f32 + 0.5, (i / a.photo.width) as f32 + 0.5);
            let p = a.pose.rotation.transpose() * (a.camera.ray(pixel) * a.depth[i] - a.pose.translation);
            labelled += 1;
            let (instance, distance) = scene.nearest_instance(p.as_dvec3());
            near += usize::from(instance == a.instances[i] && distance < 0.02 + 2e-3 * f64::from(a.depth[i]));
            for b in &scene.photos {
                let q = b.pose.to_camera(p);
                let at = b.camera.pixel(q);
                if q.z <= 0.0 || !b.camera.contains(at) {
                    continue;
                }
                let j = at.y as usize * b.photo.width + at.x as usize;
                if (b.depth[j] - q.z).abs() < 0.01 * q.z {
                    met += 1;
                    agree += usize::from(b.instances[j] == a.instances[i]);
                }
            }
        }
    }
    assert!(met > 10_000, "{met}");
    // What disagrees lies on outlines, where a pixel's centre and the point fall on two things.
    assert!(agree as f64 > 0.985 * met as f64, "{agree} of {met}");
    assert!(near as f64 > 0.99 * labelled as f64, "{near} of {labelled}");
}

#[test]
fn transients_cover_the_requested_share_and_only_training_photos() {
    for share in [0.0, 0.10, 0.25, 0.40] {
        let options =
            SyntheticOptions { occlusion: share, train: 12, test: 3, long_side: 64, points: 0, ..options() };
        let scene = generate(&options).unwrap();
        let mut sum = 0.0;
        for photo in &scene.photos {
            let covered = photo.transients.count() as f32 / photo.depth.len() as f32;
            if photo.test {
                assert_eq!(covered, 0.0);
                continue;
            }
            sum += covered;
            assert!((covered - share).abs() <= 0.35 * share, "{}: {covered} of {share}", photo.name);
        }
        let mean = sum / 12.0;
        // A touched pixel counts whole, which is worth some pixels along the outlines at this size.
        assert!(mean >= 0.9 * share && mean <= 1.22 * share, "{mean} of {share}");
    }
}

#[test]
fn transients_and_light_leave_the_clean_image_unchanged() {
    let bare = SyntheticOptions {
        train: 4,
        test: 1,
        long_side: 64,
        occlusion: 0.0,
        photo_light: LightVariation::None,
        points: 0,
        ..options()
    };
    let plain = generate(&bare).unwrap();
    for photo in &plain.photos {
        assert_eq!(photo.photo, photo.clean);
    }
    for photo_light in
        [LightVariation::Affine, LightVariation::Sun, LightVariation::Camera, LightVariation::Mixed]
    {
        let other = generate(&SyntheticOptions { photo_light, occlusion: 0.25, ..bare.clone() }).unwrap();
        let mut changed = 0;
        for (a, b) in plain.photos.iter().zip(&other.photos) {
            assert_eq!((&a.clean, &a.parts), (&b.clean, &b.parts));
            changed += usize::from(a.photo != b.photo);
        }
        assert_eq!(changed, 5, "{photo_light}");
    }
}

#[test]
fn points_lie_where_their_photos_see_them() {
    let scene = scene();
    assert!(scene.points.len() > 500, "{}", scene.points.len());
    let (mut squares, mut count, mut wrong, mut on_surface) = (0.0, 0, 0, 0);
    let mut good = 0;
    for point in &scene.points {
        assert!(point.track.len() >= 2 && point.colour.iter().all(|c| (0.0..=1.0).contains(c)));
        if point.outlier {
            wrong += 1;
            continue;
        }
        good += 1;
        on_surface += usize::from(scene.nearest_instance(point.position).1 < 0.15);
        for seen in &point.track {
            let photo = &scene.photos[seen.view as usize];
            assert!(!photo.test);
            let p = photo.pose.to_camera(point.position.as_vec3());
            let distance = (photo.camera.pixel(p) - Vec2::from(seen.pixel)).length();
            assert!(p.z > 0.0 && distance < 12.0, "{distance} px in {}", photo.name);
            squares += f64::from(distance * distance);
            count += 1;
        }
    }
    // Noise of 0.5 px per axis on the pixel, and the point's own error on top.
    let rms = (squares / f64::from(count)).sqrt();
    assert!((0.5..1.5).contains(&rms), "{rms}");
    assert!(wrong > 0 && wrong < 40, "{wrong}");
    assert!(on_surface as f64 > 0.95 * f64::from(good), "{on_surface} of {good}");
}

#[test]
fn units_change_nothing_but_the_units() {
    let small = SyntheticOptions { train: 4, test: 1, long_side: 64, points: 100, ..options() };
    let large = SyntheticOptions { units: 1000.0, ..small.clone() };
    let (a, b) = (generate(&small).unwrap(), generate(&large).unwrap());
    for (p, q) in a.photos.iter().zip(&b.photos) {
        assert_eq!(
            (&p.photo, &p.parts, &p.camera, &p.transients),
            (&q.photo, &q.parts, &q.camera, &q.transients)
        );
        assert!(p.depth.iter().zip(&q.depth).all(|(x, y)| (x * 1000.0 - y).abs() <= 1e-4 * y));
    }
    assert_eq!(a.points.len(), b.points.len());
    for (p, q) in a.points.iter().zip(&b.points) {
        assert_eq!((&p.track, p.colour, p.outlier), (&q.track, q.colour, q.outlier));
        assert!((p.position * 1000.0 - q.position).length() < 1e-3 * (1.0 + q.position.length()));
    }
    let probe = DVec3::new(0.3, -0.4, 1.9);
    assert_eq!(a.nearest_part(probe).0, b.nearest_part(probe * 1000.0).0);

    let (x, y) = (opened(&a), opened(&b));
    assert!((y.frame.scale / x.frame.scale - 1000.0).abs() < 1e-2);
    for (v, w) in x.views.iter().zip(&y.views) {
        assert!((v.pose.translation - w.pose.translation).length() < 1e-5);
    }
    let centres: Vec<[f32; 3]> = x.points.iter().map(|p| p.position.to_array()).collect();
    assert_eq!(a.label(&x.frame, &centres), b.label(&y.frame, &centres));
}

fn opened(scene: &SyntheticScene) -> Scene {
    let dir = tempfile::tempdir().unwrap();
    scene.write(dir.path()).unwrap();
    Scene::open(dir.path(), &SceneSettings::default()).unwrap()
}

#[test]
fn only_cameras_at_the_back_see_the_occluded_wall() {
    for seed in 0..6 {
        let options = SyntheticOptions {
            seed,
            train: 40,
            test: 8,
            long_side: 40,
            occlusion: 0.0,
            points: 0,
            ..options()
        };
        let scene = generate(&options).unwrap();
        let wall = scene.instance_named("occluded_wall").unwrap();
        let seen = |front: bool| -> usize {
            scene.photos.iter().filter(|p| p.front == front).map(|p| p.mask(wall).count()).sum()
        };
        assert_eq!(seen(true), 0, "seed {seed}");
        assert!(seen(false) > 60, "seed {seed}: {}", seen(false));
    }
}

#[test]
fn cameras_are_as_the_method_asks() {
    let scene =
        generate(&SyntheticOptions { long_side: 40, points: 0, occlusion: 0.0, ..Default::default() })
            .unwrap();
    assert_eq!(scene.photos.iter().filter(|p| p.test).count(), 12);
    assert_eq!(scene.photos.len(), 72);
    let focal = |p: &segwild_synthetic::SyntheticPhoto| p.camera.fx / (0.95 * 40.0);
    assert!(scene.photos.iter().all(|p| (0.699..=1.601).contains(&focal(p))));
    let tall = scene.photos.iter().filter(|p| p.camera.height > p.camera.width).count();
    assert!((12..=40).contains(&tall), "{tall}");
    let front = scene.photos.iter().filter(|p| p.front).count();
    assert!((40..=60).contains(&front), "{front}");
    let far: Vec<f32> =
        scene.photos.iter().map(|p| (p.pose.rotation.transpose() * p.pose.translation).length()).collect();
    let (near, wide) = far.iter().fold((f32::MAX, 0.0f32), |(a, b), &d| (a.min(d), b.max(d)));
    assert!(wide > 2.0 * near, "{near} to {wide}");
    for object in scene.objects() {
        assert_eq!(scene.instances[usize::from(object)].kind, ObjectKind::Object);
        let seen = scene.photos.iter().filter(|p| p.mask(object).count() > 4).count();
        assert!(seen >= 8, "{} is in {seen} photos", scene.instances[usize::from(object)].name);
    }
}

#[test]
fn a_written_set_opens_and_its_truth_reads_back() {
    let scene = scene();
    let dir = tempfile::tempdir().unwrap();
    let manifest = scene.write(dir.path()).unwrap();
    let read: segwild_synthetic::Manifest =
        serde_json::from_str(&std::fs::read_to_string(dir.path().join("truth.json")).unwrap()).unwrap();
    assert_eq!(read, manifest);

    let opened = Scene::open(dir.path(), &SceneSettings::default()).unwrap();
    assert_eq!((opened.views.len(), opened.skipped.len()), (26, 0));
    assert_eq!(opened.points.len(), scene.points.len());
    for (view, photo) in opened.views.iter().zip(&scene.photos) {
        assert_eq!((&view.name, view.test, view.camera), (&photo.name, photo.test, photo.camera));
        assert_eq!(view.load(4096).unwrap().image, photo.photo, "{}", view.name);
        // The normalised pose says where the camera stood.
        let centre = |p: &segwild_scene::Pose| -(p.rotation.transpose() * p.translation);
        let file = centre(&view.pose).as_dvec3() * opened.frame.scale + opened.frame.origin;
        assert!((file - centre(&photo.pose).as_dvec3()).length() < 1e-3);
    }

    let dome = scene.instance_named("dome").unwrap();
    let photo = scene.photos.iter().find(|p| p.mask(dome).count() > 50).unwrap();
    let truth = |kind: &str| dir.path().join("truth").join(kind).join(&photo.name);
    assert_eq!(Mask::read_png(&truth("dome")).unwrap(), photo.mask(dome));
    assert_eq!(Mask::read_png(&truth("transient")).unwrap(), photo.transients);
    assert_eq!(Image::read(&truth("clean")).unwrap(), photo.clean);
    let pfm = std::fs::read(truth("depth").with_extension("pfm")).unwrap();
    assert_eq!(pfm[pfm.len() - 4..], photo.depth[photo.photo.width - 1].to_le_bytes());

    for object in &manifest.objects {
        for click in &object.clicks {
            let photo = scene.photos.iter().find(|p| p.name == click.photo).unwrap();
            assert!(photo.mask(object.id).at(click.x, click.y) && !photo.transients.at(click.x, click.y));
        }
        if object.kind == ObjectKind::Object {
            assert!(!object.clicks.is_empty(), "{} cannot be clicked", object.name);
        }
    }
}

#[test]
fn options_out_of_range_are_refused_in_words() {
    let base = SyntheticOptions::default;
    let nan = f32::NAN;
    for (bad, word) in [
        (SyntheticOptions { train: 0, ..base() }, "training"),
        (SyntheticOptions { long_side: 0, ..base() }, "pixels"),
        (SyntheticOptions { occlusion: nan, ..base() }, "transients"),
        (SyntheticOptions { occlusion: 0.9, ..base() }, "transients"),
        (SyntheticOptions { appearance_strength: -1.0, ..base() }, "appearances"),
        (SyntheticOptions { units: 0.0, ..base() }, "units"),
        (SyntheticOptions { pixel_noise: f32::INFINITY, ..base() }, "noise"),
    ] {
        let message = generate(&bad).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }
}

#[test]
fn labels_name_the_surface_that_is_nearest() {
    let scene = scene();
    let named = |p: [f32; 3]| {
        let (id, _) = scene.nearest_instance(Vec3::from(p).as_dvec3());
        scene.instances[usize::from(id)].name.clone()
    };
    assert_eq!(named([0.0, -7.0, 0.01]), "ground");
    assert_eq!(named([0.0, -0.9, 0.03]), "facade", "the steps");
    assert!((45.0..55.0).contains(&scene.nearest_instance(DVec3::new(0.0, 4.0, 60.0)).1));
    assert_eq!(named([20.0, 20.0, -0.3]), "ground");
}
