//! The real scenes open, load and come back.

use crate::common::{open, shared};
use segwild_scene::{Scene, SceneSettings, ply};

#[test]
fn all_four_scenes_open_and_their_points_project_onto_their_observations() {
    for (name, photos, points) in
        [("liberty", 40, 5329), ("sacre_coeur", 10, 1467), ("fern", 20, 3098), ("desk", 29, 7562)]
    {
        let Some(path) = shared("all_four_scenes_open", name) else { return };
        let scene = open(&path).unwrap();
        assert_eq!(
            (scene.views.len(), scene.points.len(), scene.skipped.len()),
            (photos, points, 0),
            "{name}"
        );
        assert!(scene.views.is_sorted_by(|a, b| a.name < b.name));

        let centres: Vec<_> = scene.views.iter().map(|v| v.pose.centre()).collect();
        let mean = centres.iter().sum::<glam::Vec3>() / photos as f32;
        let far = centres.iter().map(|c| c.length()).fold(0.0, f32::max);
        assert!(
            mean.length() < 1e-5 && (far * 1.1 - 1.0).abs() < 1e-5,
            "{name}: mean {mean}, farthest {far}"
        );

        let mut errors: Vec<f32> = Vec::new();
        // Some of `desk` were seen only just outside the frame its photos were cropped to.
        let seen = scene.points.iter().filter(|p| !p.track.is_empty()).count();
        assert!(seen * 100 >= scene.points.len() * 99, "{name}: {seen} points with a track");
        for point in &scene.points {
            for o in &point.track {
                let view = &scene.views[o.view as usize];
                let p = view.pose.to_camera(point.position);
                assert!(p.z > 0.0, "{name}: a point behind a camera that saw it");
                errors.push(view.camera.pixel(p).distance(o.pixel.into()));
            }
        }
        errors.sort_by(f32::total_cmp);
        let median = errors[errors.len() / 2];
        assert!(median < 1.5, "{name}: median reprojection error {median} px");
    }
}

#[test]
fn photos_load_at_the_requested_size() {
    let Some(path) = shared("photos_load", "sacre_coeur") else { return };
    let scene = open(&path).unwrap();
    for view in &scene.views {
        let photo = view.load(320).unwrap();
        assert_eq!(photo.image.width.max(photo.image.height), 320);
        assert_eq!(
            (photo.camera.width as usize, photo.camera.height as usize),
            (photo.image.width, photo.image.height)
        );
        assert!(photo.valid.is_none());
        assert!(photo.image.data.iter().all(|v| (0.0..=1.0).contains(v)));
        let whole = view.load(10_000).unwrap();
        assert_eq!((whole.camera.width, whole.camera.height), (view.camera.width, view.camera.height));
        // Scaling keeps the mean colour.
        let mean = |i: &segwild_scene::Image| i.data.iter().sum::<f32>() / i.data.len() as f32;
        assert!((mean(&photo.image) - mean(&whole.image)).abs() < 2e-3);
        assert_eq!(view.digest().unwrap().len(), 64);
    }
}

#[test]
fn a_photo_tourism_split_divides_the_photos() {
    let (Some(path), Some(split)) = (shared("split", "sacre_coeur"), shared("split", "splits/sacre.tsv"))
    else {
        return;
    };
    let settings = SceneSettings { split: split.display().to_string(), ..SceneSettings::default() };
    let scene = Scene::open(&path, &settings).unwrap();
    let text = std::fs::read_to_string(&split).unwrap();
    for view in &scene.views {
        let row = text.lines().find(|l| l.starts_with(&view.name)).unwrap();
        assert_eq!(view.test, row.split('\t').nth(2) == Some("test"));
    }
    // The photos of the sample that the split leaves out, and the rows of the split that the sample lacks.
    let rows = text.lines().count() - 1;
    assert_eq!(scene.views.len() + scene.skipped.len(), rows);
}

#[test]
fn ply_of_another_program_comes_back_byte_for_byte() {
    let Some(path) = shared("ply", "ply/point_cloud_7000.ply") else { return };
    let splats = ply::read(&path).unwrap();
    assert_eq!((splats.len(), splats.sh_degree), (9080, 3));
    let dir = tempfile::tempdir().unwrap();
    let copy = dir.path().join("copy.ply");
    ply::write(&copy, &splats).unwrap();
    assert!(std::fs::read(&path).unwrap() == std::fs::read(&copy).unwrap(), "the bytes differ");
}

#[test]
fn splat_of_another_program_opens() {
    let Some(path) = shared("splat", "ply/model.splat") else { return };
    let splats = ply::read(&path).unwrap();
    assert_eq!((splats.len(), splats.sh_degree), (22_764, 0));
    assert!(splats.means.iter().chain(&splats.log_scales).flatten().all(|v| v.is_finite()));
    assert!((0..splats.len()).all(|i| splats.opacity(i) > 0.0 && splats.opacity(i) < 1.0));
}

#[test]
fn tourist_photos_with_poses_of_their_turned_pixels_are_turned_and_others_are_not() {
    let Some(from) = shared("tourist_photos_with_poses", "sacre_coeur") else { return };
    let dir = tempfile::tempdir().unwrap();
    let path = |part: &str| dir.path().join(part);
    std::fs::create_dir_all(path("sparse/0")).unwrap();
    std::fs::create_dir_all(path("images")).unwrap();
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::copy(from.join("sparse/0").join(file), path("sparse/0").join(file)).unwrap();
    }
    let upright = open(&from).unwrap();
    for (i, view) in upright.views.iter().enumerate() {
        let mut photo = image::open(&view.photo.path).unwrap();
        let exif = 2 + i % 3;
        // Every second photo is stored so that it is as its pose sees it once it is turned.
        if i % 2 == 0 {
            photo.apply_orientation(image::metadata::Orientation::from_exif(exif as u8).unwrap());
        }
        let file = std::fs::File::create(path("images").join(&view.name)).unwrap();
        let mut encoder = image::codecs::png::PngEncoder::new(file);
        let mut data = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x01\0\0\0\0\0\0\0".to_vec();
        data[18] = exif as u8;
        image::ImageEncoder::set_exif_metadata(&mut encoder, data).unwrap();
        photo.write_with_encoder(encoder).unwrap();
    }
    let scene = open(dir.path()).unwrap();
    for (i, (view, original)) in scene.views.iter().zip(&upright.views).enumerate() {
        assert_eq!(view.photo.reading.turned, i % 2 == 0, "{}: {:?}", view.name, scene.notes);
        let (a, b) = (view.load(160).unwrap().image, original.load(160).unwrap().image);
        let off = a.data.iter().zip(&b.data).map(|(a, b)| (a - b).abs()).sum::<f32>() / a.data.len() as f32;
        assert!(off < 0.01, "{}: {off}", view.name);
    }
}
