//! Stereo initialisation: points between those of the reconstruction, by multi-view stereo. Splats grow where there are some
//! already, and a lawn, a pavement or a plain wall has few keypoints to start any.

use crate::photos::TrainPhotoCache;
use crate::splat_budget::SplatBudget;
use crate::{TrainError, TrainSettings};
use segwild_mvs::{LONGEST_SIDE, StereoImage};
use segwild_scene::{Mask, Point, Scene};

/// Bytes per pixel of the photos that are compared at once, at the size they are compared at: colours, brightness, depths.
const PER_PIXEL: usize = 24;
/// Photos that are compared at most, evenly over the names: with more, time and memory would grow with them.
const PHOTOS: usize = 100;
/// Long side up to which photos are halved for it, in pixels: the error of a point is some half of a pixel.
const LONG_SIDE: usize = 320;
/// The pixels of such a photo, at most.
pub(crate) const COMPARED_PIXELS: usize = LONG_SIDE * LONG_SIDE;
/// Less than this is too small to compare anything in it.
const LEAST_SIDE: usize = 64;

/// Bytes that stereo initialisation takes at most, before the training takes any.
pub fn stereo_bytes(settings: &TrainSettings, photos: usize, pixels: usize) -> usize {
    compared_photos(settings, photos) * pixels.min(COMPARED_PIXELS) * PER_PIXEL
}

/// Photos that are compared, of so many.
pub(crate) fn compared_photos(settings: &TrainSettings, photos: usize) -> usize {
    if settings.stereo > 0.0 { photos.min(PHOTOS) } else { 0 }
}

/// Points that photos agree on, as many as are to start splats beside the reconstruction's; `initial_transients` are left out.
/// `follow` receives the photos compared and their number, and returns whether to stop.
pub(crate) fn points(
    scene: &Scene,
    photos: &mut TrainPhotoCache,
    settings: &TrainSettings,
    initial_transients: &[Option<Mask>],
    follow: &dyn Fn(usize, usize) -> bool,
) -> Result<Vec<Point>, TrainError> {
    if settings.stereo <= 0.0 {
        return Ok(Vec::new());
    }
    let train: Vec<usize> = (0..scene.views.len()).filter(|&v| !scene.views[v].test).collect();
    let every = train.len().div_ceil(PHOTOS).max(1);
    let (mut views, mut images) = (Vec::new(), Vec::new());
    let (mut pixels, mut ground) = (0, Vec::new());
    for &view in train.iter().step_by(every) {
        // A photo may have to wait for its sky.
        if follow(0, train.len().div_ceil(every)) {
            return Err(TrainError::Stopped);
        }
        let Some(stored) = photos.usable(view)? else { continue };
        pixels = pixels.max(stored.levels[0].pixels());
        ground.push(stored.levels[0].ground());
        let small = stored.levels.iter().find(|l| l.width.max(l.height) <= LONG_SIDE);
        let photo = small.unwrap_or_else(|| stored.levels.last().expect("there is a first level"));
        // A photo of few rows is not halved: it may be longer than stereo can take.
        if !(LEAST_SIDE..=LONGEST_SIDE).contains(&photo.width.max(photo.height)) {
            continue;
        }
        let shows = |i: usize| {
            photo.counts(i) && !initial_transients[view].as_ref().is_some_and(|m| photo.lies_in(i, m))
        };
        let usable = Mask::from_fn(photo.width as u32, photo.height as u32, |x, y| {
            shows(y as usize * photo.width + x as usize)
        });
        images.push(StereoImage { image: photo.image(), usable: Some(usable) });
        views.push(view);
    }
    let mut budget = SplatBudget::new(settings, scene.points.len(), train.len(), pixels);
    ground.iter().for_each(|&share| budget.add_photo(share));
    let most = ((settings.stereo * budget.splats() as f32) as usize).saturating_sub(scene.points.len());
    if most == 0 {
        return Ok(Vec::new());
    }
    segwild_mvs::points(scene, &views, images, most, settings.seed, follow).ok_or(TrainError::Stopped)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TrainPhoto;
    use glam::Vec3;
    use segwild_scene::{Camera, Image, Photo, Pose, View};
    use std::convert::Infallible;
    use std::sync::Arc;

    #[test]
    fn a_strip_of_5000_by_20_pixels_takes_no_part_in_stereo_and_stops_no_training() {
        let (width, height) = (5000, 20);
        let view = |i: usize| View {
            name: format!("{i}.jpg"),
            camera: Camera { width, height, fx: 4000.0, fy: 4000.0, cx: 2500.0, cy: 10.0 },
            pose: Pose::look_at(Vec3::new(0.1 * i as f32, 0.0, -2.0), Vec3::ZERO, Vec3::NEG_Y),
            photo: Photo::new("none"),
            test: false,
        };
        let point = Point { position: Vec3::ZERO, colour: [0.5; 3], track: vec![] };
        let scene = Scene::new((0..2).map(view).collect(), vec![point]);
        let strip = move |_: usize| {
            let image = Image::filled(width as usize, height as usize, 3, 0.5);
            Ok::<_, Infallible>(TrainPhoto { image, valid: None, sky: None, transients: None })
        };
        let names = vec!["0.jpg".to_owned(), "1.jpg".to_owned()];
        let mut photos = TrainPhotoCache::new(Arc::new(strip), names, 1 << 20);
        let settings = TrainSettings { stereo: 1.0, ..TrainSettings::default() };
        let found = points(&scene, &mut photos, &settings, &[None, None], &|_, _| false);
        assert_eq!(found.expect("the photos can be read"), vec![]);
    }
}
