//! Photos of a lens that bends: what goes in and what comes out are pixels of the photo as taken.

use crate::common::{QUICK, clearest, copy_folder, folder, scene, show, works};
use segwild_scene::colmap::{self, CameraModel};
use segwild_scene::lens::Lens;
use segwild_scene::{Image, Mask};
use std::path::Path;

/// The lens that the pinhole's photos are bent by.
fn bending(params: &[f64], width: u64, height: u64) -> (Lens, Vec<f64>) {
    let mut params = params.to_vec();
    if params.len() == 3 {
        params.insert(1, params[0]);
    }
    params.extend([-0.25, 0.05, 0.0, 0.0]);
    (Lens::new(CameraModel::OpenCv, width, height, &params).expect("a lens"), params)
}

/// An image of the pinhole as the lens takes it: black where the pinhole shows nothing.
fn bent(image: &Image, lens: &Lens) -> Image {
    let mut out = Image::zeros(image.width, image.height, image.channels);
    for i in 0..image.pixels() {
        let (x, y) = (i % image.width, i / image.width);
        let Some([u, v]) = lens.undistort([x as f64 + 0.5, y as f64 + 0.5]) else { continue };
        if u < 0.0 || v < 0.0 || u >= image.width as f64 || v >= image.height as f64 {
            continue;
        }
        for c in 0..image.channels {
            out.plane_mut(c)[i] = image.at(c, u as usize, v as usize);
        }
    }
    out
}

fn bent_mask(mask: &Mask, lens: &Lens) -> Mask {
    Mask::from_fn(mask.width(), mask.height(), |x, y| {
        let from = lens.undistort([f64::from(x) + 0.5, f64::from(y) + 0.5]);
        from.is_some_and(|[u, v]| mask.at(u as f32, v as f32))
    })
}

/// Writes the common scene to `to` as a lens that bends takes it; the lens of its photos, which is one.
fn bend_scene(to: &Path) -> Lens {
    copy_folder(scene(), to);
    let sparse = to.join("sparse/0");
    let mut model = colmap::read(&sparse).expect("a model");
    let mut lens = None;
    for camera in &mut model.cameras {
        let (bend, params) = bending(&camera.params, camera.width, camera.height);
        (camera.model, camera.params) = (CameraModel::OpenCv, params);
        lens = Some(bend);
    }
    let lens = lens.expect("a camera");
    for image in &mut model.images {
        for keypoint in &mut image.keypoints {
            keypoint.pixel = lens.distort(keypoint.pixel).unwrap_or(keypoint.pixel);
        }
        let file = to.join("images").join(&image.name);
        bent(&Image::read(&file).expect("a photo"), &lens).write_png(&file).expect("it is written");
    }
    colmap::write(&sparse, &model).expect("it is written");
    lens
}

#[test]
fn clicks_masks_and_transient_masks_are_of_the_photo_as_taken() {
    let dir = folder();
    let (shared_run, run) = (dir.path().join("scene"), dir.path().join("run"));
    let lens = bend_scene(&shared_run);
    works(&[&["run", &show(&shared_run), "--out", &show(&run)][..], &QUICK].concat());
    let (object, click) = clearest();
    let [x, y] = lens.distort([f64::from(click.x), f64::from(click.y)]).expect("the lens shows it");
    let at = format!("{x},{y}");
    works(&["segment", &show(&run), "--photo", &click.photo, "--positive", &at, "--name", "it"]);
    let png = Path::new(&click.photo).with_extension("png");
    let straight = Mask::read_png(&scene().join("truth").join(object).join(&png)).expect("the truth");
    let truth = bent_mask(&straight, &lens);
    for kind in ["prompted", "masks"] {
        let mask = Mask::read_png(&run.join("selections/it").join(kind).join(&png)).expect("a mask");
        assert_eq!((mask.width(), mask.height()), (truth.width(), truth.height()));
        assert!(
            mask.iou(&truth) > mask.iou(&straight),
            "{kind}: {:.3} as taken, {:.3} undistorted",
            mask.iou(&truth),
            mask.iou(&straight)
        );
    }
    // A transient mask that a person painted is of the photo as taken, too: it comes back as it is.
    let painted = Mask::from_fn(truth.width(), truth.height(), |x, _| x < truth.width() / 3);
    let given = dir.path().join("given");
    std::fs::create_dir(&given).expect("a folder");
    painted.write_png(&given.join(&png)).expect("it is written");
    let stdout = works(
        &[&["run", &show(&shared_run), "--out", &show(&run), "--transient-masks", &show(&given)][..], &QUICK]
            .concat(),
    );
    let written = Mask::read_png(&run.join("transients").join(&png)).expect("an image");
    let painted = painted.resized(written.width(), written.height());
    assert!(written.iou(&painted) > 0.75, "{:.3}: {stdout}", written.iou(&painted));
}
