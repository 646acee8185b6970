//! Loading pixels.

use crate::common::{SIZE, line, open, test_image, write};
use image::metadata::Orientation;
use image::{DynamicImage, ImageEncoder, RgbImage};
use segwild_scene::colmap::{self, CameraModel, CameraRecord, Keypoint, PointRecord, Reconstruction};
use segwild_scene::lens::Lens;
use segwild_scene::{Image, Mask, Scene, SceneError, SceneSettings, Seal, View};
use std::path::Path;

fn difference(a: &Image, b: &Image) -> f32 {
    assert_eq!((a.width, a.height, a.channels), (b.width, b.height, b.channels));
    a.data.iter().zip(&b.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

/// A scene of one photo, whose file the test then replaces.
fn one(dir: &Path) -> View {
    write(dir, &line(1));
    let mut view = open(dir).unwrap().views.remove(0);
    view.photo.seal = Seal::default();
    view
}

fn encode(path: &Path, bytes: &[u8], size: (usize, usize), colour: image::ExtendedColorType) {
    let file = std::fs::File::create(path).unwrap();
    image::codecs::png::PngEncoder::new(file)
        .write_image(bytes, size.0 as u32, size.1 as u32, colour)
        .unwrap();
}

#[test]
fn every_depth_and_channel_layout_decodes_to_the_same_image() {
    let dir = tempfile::tempdir().unwrap();
    let view = one(dir.path());
    let grey: Vec<u8> = (0..SIZE.0 * SIZE.1).map(|i| (i * 7 % 256) as u8).collect();
    let n = grey.len();
    let wanted: Vec<f32> = (0..3 * n).map(|i| f32::from(grey[i % n]) / 255.0).collect();
    let deep = |bytes: Vec<u8>| bytes.iter().flat_map(|&b| [b, b]).collect::<Vec<u8>>();
    let spread = |k: usize, alpha: bool| {
        let pixel = move |&b: &u8| (0..k).map(move |c| if alpha && c + 1 == k { 255 } else { b });
        grey.iter().flat_map(pixel).collect::<Vec<u8>>()
    };
    use image::ExtendedColorType::*;
    for (colour, bytes) in [
        (L8, grey.clone()),
        (La8, spread(2, true)),
        (Rgb8, spread(3, false)),
        (Rgba8, spread(4, true)),
        (L16, deep(grey.clone())),
        (Rgb16, deep(spread(3, false))),
        (Rgba16, deep(spread(4, true))),
    ] {
        encode(&view.photo.path, &bytes, SIZE, colour);
        let photo = view.load(1000).unwrap();
        assert!(photo.image.data.iter().zip(&wanted).all(|(a, b)| (a - b).abs() < 1e-6), "{colour:?}");
        assert!(photo.valid.is_none_or(|v| v.count() == n), "{colour:?}");
        assert_eq!(view.load(20).unwrap().image.width, 20);
    }
    // Transparent pixels are not to be trusted.
    let mut clear = spread(4, true);
    clear[3] = 0;
    encode(&view.photo.path, &clear, SIZE, Rgba8);
    let valid = view.load(1000).unwrap().valid.unwrap();
    assert!(!valid.get(0, 0) && valid.count() == n - 1);
}

#[test]
fn sizes_decide_whether_exif_turns_a_photo() {
    let dir = tempfile::tempdir().unwrap();
    let view = one(dir.path());
    let upright = test_image(SIZE.0, SIZE.1);
    // The same image as a camera held sideways stores it: turned 90 degrees back.
    let byte = |v: f32| (v * 255.0).round() as u8;
    let stored = |turned: bool| {
        let (w, h) = if turned { (SIZE.1, SIZE.0) } else { SIZE };
        let pixel = |x: usize, y: usize| if turned { (SIZE.0 - 1 - y, x) } else { (x, y) };
        let at = |i: usize| pixel(i % w, i / w);
        let bytes: Vec<u8> = (0..w * h)
            .flat_map(|i| (0..3).map(move |c| (c, at(i))))
            .map(|(c, (x, y))| byte(upright.at(c, x, y)))
            .collect();
        (bytes, w as u32, h as u32)
    };
    // TIFF, little endian, one entry: orientation 6 (turn 90 degrees clockwise to view).
    let exif = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0".to_vec();
    for turned in [false, true] {
        let (bytes, w, h) = stored(turned);
        let mut encoder =
            image::codecs::png::PngEncoder::new(std::fs::File::create(&view.photo.path).unwrap());
        encoder.set_exif_metadata(exif.clone()).unwrap();
        encoder.write_image(&bytes, w, h, image::ExtendedColorType::Rgb8).unwrap();
        let photo = view.load(1000).unwrap();
        assert!(difference(&photo.image, &upright) < 0.51 / 255.0, "stored turned: {turned}");
        assert_eq!(open(dir.path()).unwrap().views[0].camera, view.camera);
    }
}

/// Two photos of these points each, `side` x `side` of them in a grid, coloured as the photo is. Both show `test_image`, and the poses
/// are of it.
fn coloured(size: (usize, usize), side: usize) -> Reconstruction {
    let (upright, mut r) = (test_image(size.0, size.1), line(2));
    let (w, h) = (size.0 as f64, size.1 as f64);
    let camera = &mut r.cameras[0];
    (camera.width, camera.height) = (size.0 as u64, size.1 as u64);
    camera.params = vec![50.0, 50.0, w / 2.0, h / 2.0];
    r.points.clear();
    for image in &mut r.images {
        image.keypoints.clear();
        for k in 0..side * side {
            let at = |k: usize, size: f64| (k as f64 + 0.5) / side as f64 * size;
            let ([x, y], z) = ([at(k % side, w), at(k / side, h)], 5.0 + (k % 3) as f64);
            let id = r.points.len() as u64 + 1;
            image.keypoints.push(Keypoint { pixel: [x, y], point: Some(id) });
            r.points.push(PointRecord {
                id,
                position: [(x - w / 2.0) / 50.0 * z - image.translation[0], (y - h / 2.0) / 50.0 * z, z],
                colour: [0, 1, 2].map(|c| (upright.at(c, x as usize, y as usize) * 255.0) as u8),
                error: 0.5,
                track: vec![(image.id, k as u32)],
            });
        }
    }
    r
}

/// Writes the scene. `photo01.png` has the EXIF orientation; it shows `test_image` as stored, or once it is turned so.
fn write_oriented(dir: &Path, reconstruction: &Reconstruction, exif: u8, turned: bool) {
    colmap::write(&dir.join("sparse/0"), reconstruction).unwrap();
    let camera = &reconstruction.cameras[0];
    let upright = test_image(camera.width as usize, camera.height as usize);
    std::fs::create_dir_all(dir.join("images")).unwrap();
    upright.write_png(&dir.join("images/photo00.png")).unwrap();
    let byte = |c: usize, x: u32, y: u32| (upright.at(c, x as usize, y as usize) * 255.0).round() as u8;
    let pixel = |x: u32, y: u32| image::Rgb([0, 1, 2].map(|c| byte(c, x, y)));
    let mut stored =
        DynamicImage::from(RgbImage::from_fn(upright.width as u32, upright.height as u32, pixel));
    // All but 6 and 8 are their own inverses.
    let back = if let 6 | 8 = exif { 14 - exif } else { exif };
    if turned {
        stored.apply_orientation(Orientation::from_exif(back).unwrap());
    }
    let file = std::fs::File::create(dir.join("images/photo01.png")).unwrap();
    let mut encoder = image::codecs::png::PngEncoder::new(file);
    let mut data = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x01\0\0\0\0\0\0\0".to_vec();
    data[18] = exif;
    encoder.set_exif_metadata(data).unwrap();
    stored.write_with_encoder(encoder).unwrap();
}

/// The notes about EXIF orientations.
fn about_orientation(scene: &Scene) -> Vec<&str> {
    scene.notes.iter().map(String::as_str).filter(|note| note.contains("EXIF")).collect()
}

/// Checks that the photo loads as the same photo without EXIF data does, and that the one note about it has these words.
fn reads_as_posed(reconstruction: &Reconstruction, exif: u8, turned: bool, words: &str) {
    let (dir, plain) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    write_oriented(dir.path(), reconstruction, exif, turned);
    write_oriented(plain.path(), reconstruction, 1, false);
    let (scene, plain) = (open(dir.path()).unwrap(), open(plain.path()).unwrap());
    let notes = about_orientation(&scene);
    assert!(
        notes.len() == 1 && notes[0].contains("photo photo01.png is") && notes[0].contains(words),
        "{exif}, turned {turned}: {notes:?}"
    );
    for size in [1000, 20] {
        let [loaded, wanted] = [&scene, &plain].map(|scene| scene.views[1].load(size).unwrap());
        assert_eq!((&loaded.camera, &loaded.valid), (&wanted.camera, &wanted.valid));
        let off = difference(&loaded.image, &wanted.image);
        // Shrinking a turned photo rounds otherwise.
        assert!(off < 1.01 / 255.0, "{exif}, turned {turned}, at {size}: {off}");
    }
    assert_eq!(scene.views[1].examine(640).unwrap(), None);
    assert!(!scene.views[0].photo.reading.turned);
}

#[test]
fn a_photo_upside_down_whose_poses_are_of_the_stored_pixels_is_not_turned() {
    reads_as_posed(&coloured(SIZE, 8), 3, false, "read as stored, without its EXIF orientation 3");
}

#[test]
fn a_photo_upside_down_whose_poses_are_of_the_turned_pixels_is_turned() {
    reads_as_posed(&coloured(SIZE, 8), 3, true, "turned by its EXIF orientation 3");
}

#[test]
fn a_mirrored_photo_is_read_as_its_poses_see_it() {
    for exif in [2, 4] {
        reads_as_posed(&coloured(SIZE, 8), exif, true, &format!("turned by its EXIF orientation {exif}"));
        reads_as_posed(&coloured(SIZE, 8), exif, false, "read as stored");
    }
}

#[test]
fn a_square_photo_held_sideways_is_read_as_its_poses_see_it() {
    for exif in 5..=8 {
        reads_as_posed(&coloured((36, 36), 8), exif, true, &format!("turned by its EXIF orientation {exif}"));
        reads_as_posed(&coloured((36, 36), 8), exif, false, "read as stored");
    }
}

#[test]
fn a_distorted_photo_upside_down_is_turned_before_it_is_undistorted() {
    let mut r = coloured(SIZE, 8);
    r.cameras[0].model = CameraModel::SimpleRadial;
    r.cameras[0].params = vec![50.0, 21.0, 14.0, -0.1];
    reads_as_posed(&r, 3, true, "turned by its EXIF orientation 3");
}

#[test]
fn points_that_name_no_photo_tell_which_way_it_lies() {
    let mut r = coloured(SIZE, 12);
    r.points.iter_mut().for_each(|point| point.track.clear());
    // Their photo is the one that hides the other's points behind its own.
    r.points.drain(..144);
    r.images.iter_mut().for_each(|image| image.keypoints.clear());
    reads_as_posed(&r, 3, true, "turned by its EXIF orientation 3");
    reads_as_posed(&r, 3, false, "read as stored");
}

#[test]
fn masks_lie_on_a_turned_photo_as_its_poses_see_it() {
    let dir = tempfile::tempdir().unwrap();
    write_oriented(dir.path(), &coloured(SIZE, 8), 3, true);
    let speck = Mask::from_fn(40, 30, |x, y| (x, y) == (11, 7));
    std::fs::create_dir(dir.path().join("ignore")).unwrap();
    speck.write_png(&dir.path().join("ignore/photo01.png")).unwrap();
    let settings = SceneSettings { ignore: "ignore".into(), ..SceneSettings::default() };
    let view = Scene::open(dir.path(), &settings).unwrap().views.remove(1);
    assert!(view.photo.reading.turned);
    assert_eq!(view.load(40).unwrap().valid.unwrap().not(), speck);
}

#[test]
fn a_photo_that_too_few_points_see_is_read_as_stored_and_a_note_names_it() {
    let unchecked = "its EXIF orientation 3 could not be checked against the points";
    let is_noted = |reconstruction: &Reconstruction, why: &str| {
        let dir = tempfile::tempdir().unwrap();
        write_oriented(dir.path(), reconstruction, 3, true);
        let scene = open(dir.path()).unwrap();
        let notes = about_orientation(&scene);
        assert!(
            notes.len() == 1 && [unchecked, why, "photo01.png"].iter().all(|words| notes[0].contains(words)),
            "{notes:?}"
        );
        assert!(!scene.views[1].photo.reading.turned);
    };
    is_noted(&coloured(SIZE, 6), "too few points");
    let mut r = coloured(SIZE, 8);
    r.points.iter_mut().for_each(|point| point.colour = [0; 3]);
    is_noted(&r, "too few points with colours");
    // Colours of something else.
    let mut r = coloured(SIZE, 8);
    let colours: Vec<[u8; 3]> = r.points.iter().map(|point| point.colour).collect();
    for (k, point) in r.points.iter_mut().enumerate() {
        point.colour = colours[k * 37 % 64];
    }
    is_noted(&r, "both ways alike");
}

#[test]
fn photos_without_an_orientation_are_read_as_ever() {
    let dir = tempfile::tempdir().unwrap();
    write_oriented(dir.path(), &coloured(SIZE, 8), 1, false);
    let scene = open(dir.path()).unwrap();
    assert!(about_orientation(&scene).is_empty(), "{:?}", scene.notes);
    assert!(scene.views.iter().all(|view| !view.photo.reading.turned));
    assert_eq!(scene.views[0].load(40).unwrap().image, scene.views[1].load(40).unwrap().image);
}

#[test]
fn a_file_of_another_size_scales_the_camera_and_another_shape_is_an_error() {
    let dir = tempfile::tempdir().unwrap();
    let view = one(dir.path());
    test_image(20, 15).write_png(&view.photo.path).unwrap();
    let half = open(dir.path()).unwrap();
    let camera = half.views[0].camera;
    assert_eq!((camera.width, camera.height, camera.fx, camera.cx), (20, 15, 25.0, 10.0));
    for point in &half.points {
        let p = camera.pixel(half.views[0].pose.to_camera(point.position));
        assert!(p.distance(point.track[0].pixel.into()) < 1e-4);
    }
    test_image(20, 20).write_png(&view.photo.path).unwrap();
    let error = view.load(100).unwrap_err().to_string();
    assert!(
        error.contains("photo00.png") && error.contains("20 x 20") && error.contains("40 x 30"),
        "{error}"
    );
}

#[test]
fn photos_that_do_not_decode_are_errors_that_name_them() {
    let dir = tempfile::tempdir().unwrap();
    let view = one(dir.path());
    let whole = std::fs::read(&view.photo.path).unwrap();
    std::fs::write(&view.photo.path, &whole[..whole.len() / 2]).unwrap();
    for _ in 0..2 {
        let error = view.load(640).unwrap_err();
        assert!(matches!(&error, SceneError::Photo { name, .. } if name == "photo00.png"), "{error}");
        std::fs::remove_file(&view.photo.path).ok();
    }
    assert!(matches!(view.digest(), Err(SceneError::Photo { .. })));
    // A header that promises more pixels than memory: refused, not allocated.
    let mut huge = whole.clone();
    huge[16..24].copy_from_slice(&[0, 1, 0x6a, 0, 0, 1, 0x0f, 0x80]);
    std::fs::write(&view.photo.path, &huge).unwrap();
    assert!(view.load(640).is_err());
}

/// A smooth colour for each pinhole pixel of a 200 x 150 photo.
fn scene_colour(c: usize, p: [f64; 2]) -> f32 {
    let (u, v) = (p[0] / 200.0, p[1] / 150.0);
    (0.5 + 0.35 * (7.0 * u + (c as f64 + 1.0) * 4.0 * v).sin()) as f32
}

#[test]
fn a_distorted_photo_loads_as_the_pinhole_would_have_taken_it() {
    for (model, params) in [
        (CameraModel::SimpleRadial, vec![150.0, 99.0, 76.0, -0.12]),
        (CameraModel::OpenCv, vec![150.0, 155.0, 99.0, 76.0, -0.1, 0.03, 2e-3, -3e-3]),
        (CameraModel::OpenCv, vec![150.0, 155.0, 99.0, 76.0, 0.12, 0.0, 0.0, 0.0]),
        (CameraModel::OpenCvFisheye, vec![140.0, 140.0, 100.0, 75.0, 0.02, -0.01, 0.0, 0.0]),
        (
            CameraModel::ThinPrismFisheye,
            vec![140.0, 140.0, 100.0, 75.0, 0.02, 0.0, 1e-3, 1e-3, 0.0, 0.0, 1e-3, -1e-3],
        ),
        (CameraModel::Fov, vec![150.0, 150.0, 100.0, 75.0, 0.6]),
        (CameraModel::Division, vec![150.0, 150.0, 100.0, 75.0, -0.1]),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let lens = Lens::new(model, 200, 150, &params).unwrap();
        let mut r = line(1);
        r.cameras = vec![CameraRecord { id: 7, model, width: 200, height: 150, params }];
        // Keypoints lie where the lens puts them.
        let pinhole = lens.pinhole();
        r.images[0].keypoints = r
            .points
            .iter()
            .map(|p| {
                let [x, y, z] = p.position;
                let at = pinhole.pixel(glam::DVec3::new(x, y, z).as_vec3());
                Keypoint {
                    pixel: lens.distort([f64::from(at.x), f64::from(at.y)]).unwrap(),
                    point: Some(p.id),
                }
            })
            .collect();
        colmap::write(&dir.path().join("sparse/0"), &r).unwrap();
        let mut photo = Image::zeros(200, 150, 3);
        for i in 0..photo.data.len() {
            let (c, y, x) = (i / 30_000, i / 200 % 150, i % 200);
            let seen = lens.undistort([x as f64 + 0.5, y as f64 + 0.5]);
            photo.data[i] = seen.map_or(0.5, |p| scene_colour(c, p));
        }
        std::fs::create_dir_all(dir.path().join("images")).unwrap();
        photo.write_png(&dir.path().join("images/photo00.png")).unwrap();

        let scene = open(dir.path()).unwrap();
        let view = &scene.views[0];
        for point in &scene.points {
            let p = view.camera.pixel(view.pose.to_camera(point.position));
            assert!(p.distance(point.track[0].pixel.into()) < 1e-3, "{model:?}");
        }
        let loaded = view.load(200).unwrap();
        let valid = loaded.valid.unwrap();
        assert!(valid.count() > 20_000, "{model:?}: {} pixels are valid", valid.count());
        for (x, y) in
            valid.pixels().filter(|&(x, y)| lens.distort([f64::from(x) + 0.5, f64::from(y) + 0.5]).is_some())
        {
            for c in 0..3 {
                let wanted = scene_colour(c, [f64::from(x) + 0.5, f64::from(y) + 0.5]);
                let got = loaded.image.at(c, x as usize, y as usize);
                assert!((got - wanted).abs() < 0.012, "{model:?} at {x}, {y}: {got}, not {wanted}");
            }
        }
        // Pincushion leaves corners that were never photographed; they are marked.
        let all_there = [(0.0, 0.0), (200.0, 0.0), (0.0, 150.0), (200.0, 150.0)].iter().all(|&(x, y)| {
            lens.distort([x, y]).is_some_and(|p| p[0] >= 0.0 && p[1] >= 0.0 && p[0] <= 200.0 && p[1] <= 150.0)
        });
        assert_eq!(all_there, valid.count() == 30_000, "{model:?}");
        let small = view.load(100).unwrap();
        assert!(difference(&small.image, &loaded.image.resized(100, 75)) < 0.03 || !all_there, "{model:?}");
    }
}

#[test]
fn masks_of_things_to_ignore_follow_the_photo() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &line(3));
    let masks = dir.path().join("ignore");
    std::fs::create_dir(&masks).unwrap();
    let settings = SceneSettings { ignore: "ignore".into(), ..SceneSettings::default() };
    let error = Scene::open(dir.path(), &settings).unwrap_err().to_string();
    assert!(error.contains("ignore") && error.contains("photo00.png"), "{error}");
    // Stem + .png, and file name + .png; the second at twice the size.
    let speck = Mask::from_fn(40, 30, |x, y| (x, y) == (11, 7));
    speck.write_png(&masks.join("photo00.png")).unwrap();
    Mask::from_fn(80, 60, |x, _| x < 20).write_png(&masks.join("photo01.png.png")).unwrap();
    let scene = Scene::open(dir.path(), &settings).unwrap();
    let valid = |i: usize, size| scene.views[i].load(size).unwrap().valid;
    assert_eq!(valid(0, 40).unwrap().not(), speck);
    // However small the photo gets, what a person marked stays marked.
    assert_eq!(valid(0, 20).unwrap().not(), Mask::from_fn(20, 15, |x, y| (x, y) == (5, 3)));
    assert_eq!(valid(1, 40).unwrap(), Mask::from_fn(40, 30, |x, _| x >= 10));
    assert_eq!(valid(2, 40), None);
    Mask::full(30, 30).write_png(&masks.join("photo00.png")).unwrap();
    let error = scene.views[0].load(40).unwrap_err().to_string();
    assert!(error.contains("photo00.png") && error.contains("was changed or taken away"), "{error}");
    let scene = Scene::open(dir.path(), &settings).unwrap();
    let error = scene.views[0].load(40).unwrap_err().to_string();
    assert!(error.contains("photo00.png") && error.contains("30 x 30"), "{error}");
}

#[test]
fn a_mask_of_more_megapixels_than_allowed_is_not_decoded() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &line(3));
    let masks = dir.path().join("ignore");
    std::fs::create_dir(&masks).unwrap();
    let mask = masks.join("photo00.png");
    Mask::from_fn(1_200, 900, |x, _| x < 300).write_png(&mask).unwrap();
    let allowed = |megapixels| {
        let settings =
            SceneSettings { ignore: "ignore".into(), max_megapixels: megapixels, ..SceneSettings::default() };
        Scene::open(dir.path(), &settings).unwrap()
    };
    assert_eq!(allowed(2).skipped, []);
    let scene = allowed(1);
    let [skipped] = &scene.skipped[..] else { panic!("{:?}", scene.skipped) };
    let says = |words: &str| {
        assert!(words.contains("photo00.png") && words.contains("--max-megapixels allows 1"), "{words}");
    };
    assert_eq!(skipped.name, "photo00.png");
    assert!(skipped.reason.starts_with("its mask"), "{}", skipped.reason);
    says(&skipped.reason);
    // The bound holds for what is decoded later, too.
    let mut view = scene.views[0].clone();
    view.photo.ignore = Some(mask);
    says(&view.load(40).unwrap_err().to_string());
}

#[test]
fn a_truncated_jpeg_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let view = one(dir.path());
    let rgb: Vec<u8> = (0..SIZE.0 * SIZE.1 * 3).map(|i| (i * i % 251) as u8).collect();
    let mut jpeg = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 95);
    encoder.write_image(&rgb, SIZE.0 as u32, SIZE.1 as u32, image::ExtendedColorType::Rgb8).unwrap();
    std::fs::write(&view.photo.path, &jpeg).unwrap();
    view.load(640).unwrap();
    std::fs::write(&view.photo.path, &jpeg[..jpeg.len() * 2 / 3]).unwrap();
    let refused = view.load(640).map(|_| ()).unwrap_err().to_string();
    assert!(refused.contains("photo00.png") && refused.contains("cut short"), "{refused}");
    // Bytes behind the end, as phones append them, do no harm; the end of a thumbnail is not the end of the photo.
    std::fs::write(&view.photo.path, [&jpeg[..], b"and a trailer"].concat()).unwrap();
    view.load(640).unwrap();
    let thumbnail = [&jpeg[..2], b"\xff\xe1\x00\x06ab\xff\xd9", &jpeg[2..jpeg.len() - 2]].concat();
    std::fs::write(&view.photo.path, &thumbnail).unwrap();
    let odd = open(dir.path()).unwrap().views[0].examine(640).unwrap().unwrap();
    assert!(odd.contains("no end marker") && odd.contains("all of its image is there"), "{odd}");
    std::fs::write(&view.photo.path, &thumbnail[..thumbnail.len() - 40]).unwrap();
    assert!(open(dir.path()).unwrap_err().to_string().contains("cut short"));
}

/// PSNR in dB.
fn likeness(a: &Image, b: &Image) -> f64 {
    let squares = a.data.iter().zip(&b.data).map(|(a, b)| f64::from(a - b).powi(2));
    let mean = squares.sum::<f64>() / a.data.len() as f64;
    -10.0 * mean.max(1e-12).log10()
}

#[test]
fn a_large_photo_that_shrinks_while_it_is_decoded_is_as_one_that_shrinks_afterwards() {
    let Some(folder) = crate::common::shared("a_large_photo_that_shrinks", "fern/images") else { return };
    let file = std::fs::read_dir(folder).unwrap().flatten().map(|e| e.path()).min().unwrap();
    let small = image::open(file).unwrap().to_rgb8();
    // Over the bound under which photos are decoded whole.
    let (w, h) = (2_700, 2_700 * small.height() / small.width());
    let large = image::imageops::resize(&small, w, h, image::imageops::FilterType::CatmullRom);
    let dir = tempfile::tempdir().unwrap();
    let mut reconstruction = line(1);
    let camera = &mut reconstruction.cameras[0];
    (camera.width, camera.height) = (w.into(), h.into());
    camera.params = vec![2_500.0, 2_500.0, f64::from(w) / 2.0, f64::from(h) / 2.0];
    write(dir.path(), &reconstruction);
    let path = dir.path().join("images/photo00.png");
    let rgb = image::DynamicImage::from(large);
    let with_alpha = |x: u32| image::Rgba([9, 9, 9, if x < w / 2 { 0 } else { 255 }]);
    let kinds: [(&str, image::DynamicImage, image::ImageFormat); 5] = [
        ("JPEG", rgb.clone(), image::ImageFormat::Jpeg),
        ("grey JPEG", rgb.to_luma8().into(), image::ImageFormat::Jpeg),
        ("PNG", rgb.clone(), image::ImageFormat::Png),
        ("PNG of 16 bits", rgb.to_rgb16().into(), image::ImageFormat::Png),
        (
            "PNG with alpha",
            image::RgbaImage::from_fn(w, h, |x, _| with_alpha(x)).into(),
            image::ImageFormat::Png,
        ),
    ];
    for (kind, test_image, format) in kinds {
        test_image.save_with_format(&path, format).unwrap();
        let whole = image::open(&path)
            .unwrap_or_else(|_| image::load_from_memory(&std::fs::read(&path).unwrap()).expect("it decodes"));
        let view = open(dir.path()).unwrap().views.remove(0);
        for size in [160, 320, 640] {
            let photo = view.load(size).unwrap();
            let (width, height) = (photo.camera.width, photo.camera.height);
            let wanted = whole.resize_exact(width, height, image::imageops::FilterType::Lanczos3).to_rgb8();
            let n = (width * height) as usize;
            let mut expected = Image::zeros(width as usize, height as usize, 3);
            for (i, pixel) in wanted.pixels().enumerate() {
                (0..3).for_each(|c| expected.data[c * n + i] = f32::from(pixel.0[c]) / 255.0);
            }
            let psnr = likeness(&photo.image, &expected);
            assert!(psnr > 40.0, "{kind} at {size}: {psnr:.1} dB");
            let opaque = photo.valid.as_ref().map(Mask::count);
            assert_eq!(opaque, whole.color().has_alpha().then_some(n / 2), "{kind} at {size}");
        }
    }
}

#[test]
fn masks_that_leave_nothing_at_the_size_of_training_leave_the_photo_out() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &line(2));
    let masks = dir.path().join("ignore");
    std::fs::create_dir(&masks).unwrap();
    Mask::from_fn(40, 30, |x, y| (x + y) % 2 == 0).write_png(&masks.join("photo00.png")).unwrap();
    let settings = SceneSettings { ignore: "ignore".into(), ..SceneSettings::default() };
    let view = &Scene::open(dir.path(), &settings).unwrap().views[0];
    assert_eq!(view.examine(40).unwrap(), None);
    let error = view.examine(10).unwrap_err().to_string();
    assert!(error.contains("photo00.png") && error.contains("leave nothing"), "{error}");
}

#[test]
fn a_photo_that_becomes_a_pipe_is_named_at_once() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &line(2));
    let scene = open(dir.path()).unwrap();
    let path = &scene.views[0].photo.path;
    std::fs::remove_file(path).unwrap();
    assert!(std::process::Command::new("mkfifo").arg(path).status().unwrap().success());
    let began = std::time::Instant::now();
    let refused = [
        scene.views[0].load(40).map(drop),
        scene.views[0].digest().map(drop),
        scene.views[0].examine(640).map(drop),
    ];
    for refused in refused {
        assert!(refused.unwrap_err().to_string().contains("photo00.png"));
    }
    // So is every other file that a scene is read from.
    for file in ["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"] {
        let file = dir.path().join(file);
        let aside = std::fs::read(&file).unwrap();
        std::fs::remove_file(&file).unwrap();
        std::process::Command::new("mkfifo").arg(&file).status().unwrap();
        // A reconstruction can do without points.
        assert!(file.ends_with("points3D.bin") || open(dir.path()).is_err(), "{}", file.display());
        let _ = open(dir.path());
        std::fs::remove_file(&file).unwrap();
        std::fs::write(&file, aside).unwrap();
    }
    assert!(began.elapsed().as_secs() < 20);
}

#[test]
fn photos_of_other_cameras_are_whole() {
    let Some(_) = crate::common::shared("photos_of_other_cameras", "liberty") else { return };
    for name in ["liberty", "sacre_coeur", "fern", "desk", "kitchen"] {
        let Some(folder) = crate::common::shared("photos_of_other_cameras", name) else { continue };
        let Ok(scene) = open(&folder) else { continue };
        for view in &scene.views {
            assert_eq!(view.examine(640).unwrap(), None, "{name}/{}", view.name);
        }
    }
}

#[test]
fn a_cut_out_has_no_dark_edge_of_what_lies_under_its_transparent_part() {
    let dir = tempfile::tempdir().unwrap();
    let mut view = one(dir.path());
    let pixel = |i: usize| if i % SIZE.0 < 19 { [0, 0, 0, 0] } else { [200, 200, 200, 255] };
    let bytes: Vec<u8> = (0..SIZE.0 * SIZE.1).flat_map(pixel).collect();
    encode(&view.photo.path, &bytes, SIZE, image::ExtendedColorType::Rgba8);
    let least = |view: &View| view.load(20).unwrap().image.data.iter().copied().fold(1.0, f32::min);
    assert!(least(&view) < 0.01, "left out, it is as it was");
    view.photo.reading.empty = true;
    assert!(least(&view) > 0.45, "{}", least(&view));
    let loaded = view.load(20).unwrap();
    assert_eq!(loaded.empty, loaded.valid.map(|valid| valid.not()));
}
