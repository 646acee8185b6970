//! Warnings about a scene before anything is computed: a run on a doubtful scene ends like any other, and only its
//! result would show the fault.

use crate::SeenOnceShare;
use segwild_scene::statistics::upper_median;
use segwild_scene::{Scene, first_named};

/// A scene needs this many photos: on a synthetic scene, 12 photos segment objects a quarter worse than 40.
const FEW: usize = 15;
/// Poses do not fit when half of the observations are farther from their points than this share of a photo's long side:
/// 5 px of 640. Good reconstructions stay under 1 px.
const MISFIT: f32 = 0.008;
/// A point is misplaced when half of its observations are off by more than this share of the long side. The run warns
/// when more than the second share of the points is misplaced.
const ASTRAY: f32 = 0.02;
const MANY_ASTRAY: f32 = 0.15;
/// Cameras that are closer together than this share of the median depth show no parallax.
const TOGETHER: f32 = 0.01;
/// PSNR in dB on the training photos under which a scene is poor: scenes of tourist photos reach 22 dB and more.
const UNLIKE: f32 = 19.0;
/// Difference in dB between training and held-out photos from which a scene is overfitted. It is 4 dB on good scenes
/// (`liberty`), and 7 dB on 20 photos of a synthetic scene.
const OVERFITTED: f32 = 8.0;
/// Share of a photo's pixels from which it is named among those that alone show something. By choice.
const SHOWN_ALONE: f32 = 0.01;

/// Warnings about the scene, a sentence each, with what to do.
pub(crate) fn diagnose(scene: &Scene) -> Vec<String> {
    let trained = scene.views.iter().filter(|v| !v.test).count();
    let mut words = Vec::new();
    if trained < FEW {
        words.push(format!(
            "too few photos: what {trained} of them do not show from two sides is guessed; {FEW} or more show a scene's shape"
        ));
    }
    words.extend(misfit(scene));
    words.extend(together(scene));
    words
}

/// The warning about photos that are copies of an earlier one. `digests` has a hash per view, `None` where the photo
/// cannot be read.
pub(crate) fn copies(scene: &Scene, digests: &[Option<&str>]) -> Option<String> {
    let mut seen = std::collections::BTreeMap::new();
    let mut copies = Vec::new();
    for (view, digest) in scene.views.iter().zip(digests) {
        let Some(digest) = digest else { continue };
        match seen.get(digest) {
            Some(first) => copies.push(format!("{} is {first}", view.name)),
            None => {
                seen.insert(*digest, view.name.as_str());
            }
        }
    }
    (!copies.is_empty()).then(|| {
        format!(
            "{} photos are copies of others and show nothing new ({}): leave them out",
            copies.len(),
            first_named(&copies)
        )
    })
}

/// Warnings when camera poses and points do not fit together.
fn misfit(scene: &Scene) -> Vec<String> {
    let mut of_view: Vec<Vec<f32>> = vec![Vec::new(); scene.views.len()];
    let (mut astray, mut tracked) = (0usize, 0usize);
    for point in scene.points.iter().filter(|p| !p.track.is_empty()) {
        let mut off: Vec<f32> = Vec::with_capacity(point.track.len());
        for seen in &point.track {
            let distance = scene.astray(point, seen);
            off.push(distance);
            of_view[seen.view as usize].push(distance);
        }
        tracked += 1;
        astray += usize::from(upper_median(off).is_some_and(|off| off > ASTRAY));
    }
    let Some(whole) = upper_median(of_view.iter().flatten().copied().collect()) else { return Vec::new() };
    let mut words = Vec::new();
    if whole > MISFIT {
        words.push(format!(
            "camera poses do not fit the points: half of the observations are more than {:.1} % of the photo off (under 0.2 % \
             is usual); reconstruct again, or give the points that belong to these poses",
            100.0 * whole
        ));
    } else {
        let view_off = |(view, off): (&segwild_scene::View, Vec<f32>)| {
            let astray = off.len() >= 8 && upper_median(off).is_some_and(|off| off > ASTRAY);
            astray.then(|| view.name.clone())
        };
        let odd: Vec<String> = scene.views.iter().zip(of_view).filter_map(view_off).collect();
        if !odd.is_empty() {
            words.push(format!(
                "the camera pose of {} photos does not fit the points ({}): leave them out",
                odd.len(),
                first_named(&odd)
            ));
        }
        let share = astray as f32 / tracked.max(1) as f32;
        if share > MANY_ASTRAY {
            words.push(format!(
                "{:.0} % of the points do not lie where the photos saw them: the reconstruction holds many false matches",
                100.0 * share
            ));
        }
    }
    words
}

/// The warning when all cameras stand at one position.
fn together(scene: &Scene) -> Option<String> {
    let cameras: Vec<_> = scene.views.iter().filter(|v| !v.test).collect();
    let first = cameras.first()?.pose.centre();
    let apart = cameras.iter().map(|v| (v.pose.centre() - first).length()).fold(0.0, f32::max);
    let seen = scene.points.iter().flat_map(|p| p.track.first().map(|o| (p, o)));
    let depths = seen
        .map(|(p, o)| scene.views[o.view as usize].pose.to_camera(p.position).z)
        .filter(|z| *z > 0.0)
        .collect();
    let far = upper_median(depths).filter(|_| cameras.len() >= 2)?;
    (apart < TOGETHER * far).then(|| {
        format!(
            "all photos are taken from one spot ({:.1} % of the distance to what they show lies between them): they tell no \
             depth; add photos from other sides",
            100.0 * apart / far
        )
    })
}

/// The warning when a trained scene reproduces its own photos badly. `train` is the PSNR on them in dB.
pub(crate) fn unlike(train: f32) -> Option<String> {
    (train < UNLIKE).then(|| {
        format!(
            "the trained scene shows its own photos at only {train:.1} dB (good ones 22 and more): transients in most photos, \
             poses that do not fit, or light beyond what the appearance model fits"
        )
    })
}

/// The warning when a scene fits its training photos much better than held-out ones. Both are PSNR in dB over every pixel but
/// the sky: the pixels that a training leaves out would make any scene with transients look overfitted.
pub(crate) fn overfitted(train: f32, held_out: f32) -> Option<String> {
    (train - held_out > OVERFITTED).then(|| {
        format!(
            "photos held out are {:.1} dB below those trained on: the scene is overfitted; too few photos for so many \
             steps, transients in too many of them, or poses that do not fit",
            train - held_out
        )
    })
}

/// What is reported of splats that one photo alone shows; `None` where there are none.
pub(crate) fn seen_once(share: &SeenOnceShare) -> Option<String> {
    let mut photos: Vec<(&String, f32)> = share.photos.iter().map(|(name, share)| (name, *share)).collect();
    photos.retain(|(_, share)| *share >= SHOWN_ALONE);
    photos.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(b.0)));
    let named: Vec<String> =
        photos.iter().map(|(name, share)| format!("{name} {:.1} %", 100.0 * *share)).collect();
    let most = if named.is_empty() {
        String::new()
    } else {
        format!("; most of them are in {}, as shares of the pixels", first_named(&named))
    };
    (share.splats > 0.0).then(|| {
        format!(
            "{:.1} % of the splats are seen once, by one photo alone, and stay out of objects that others show{most}",
            100.0 * share.splats
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use segwild_scene::{Camera, Observation, Photo, Point, Pose, View};

    /// Sixteen cameras on an arc, and points that they see exactly.
    fn arc(radius: f32) -> Scene {
        let camera = Camera { width: 200, height: 100, fx: 150.0, fy: 150.0, cx: 100.0, cy: 50.0 };
        let views: Vec<View> = (0..16)
            .map(|i| {
                let eye = Vec3::new(radius * (i as f32 / 15.0 - 0.5), 0.0, -4.0);
                let pose = Pose::look_at(eye, Vec3::ZERO, Vec3::NEG_Y);
                let name = format!("{i}.png");
                View { photo: Photo::new(&name), name, camera, pose, test: false }
            })
            .collect();
        let points = (0..40)
            .map(|k| {
                let position = Vec3::new((k % 8) as f32 * 0.1 - 0.4, (k / 8) as f32 * 0.1 - 0.2, 0.3);
                let track = (0..views.len())
                    .map(|v| {
                        let pixel = camera.pixel(views[v].pose.to_camera(position)).into();
                        Observation { view: v as u32, pixel }
                    })
                    .collect();
                Point { position, colour: [0.5; 3], track }
            })
            .collect();
        Scene::new(views, points)
    }

    #[test]
    fn a_good_reconstruction_raises_no_warning() {
        assert!(diagnose(&arc(2.0)).is_empty(), "{:?}", diagnose(&arc(2.0)));
    }

    #[test]
    fn poses_that_do_not_fit_are_named() {
        let mut all = arc(2.0);
        all.views.iter_mut().for_each(|v| v.pose.translation += Vec3::new(0.1, 0.0, 0.0));
        assert!(diagnose(&all)[0].starts_with("camera poses do not fit the points"), "{:?}", diagnose(&all));
        let mut one = arc(2.0);
        one.views[3].pose.translation += Vec3::new(0.2, 0.0, 0.0);
        let warnings = diagnose(&one);
        assert!(warnings.len() == 1 && warnings[0].contains("(3.png)"), "{warnings:?}");
    }

    #[test]
    fn points_astray_few_photos_and_one_spot_are_named() {
        let mut astray = arc(2.0);
        astray.points.iter_mut().step_by(4).for_each(|p| p.position.y += 0.4);
        let warnings = diagnose(&astray);
        assert!(warnings.len() == 1 && warnings[0].starts_with("25 % of the points"), "{warnings:?}");
        let mut few = arc(2.0);
        few.points.clear();
        few.views.truncate(3);
        assert!(diagnose(&few)[0].starts_with("too few photos: what 3"), "{:?}", diagnose(&few));
        let warnings = diagnose(&arc(0.01));
        assert!(
            warnings.len() == 1 && warnings[0].starts_with("all photos are taken from one spot"),
            "{warnings:?}"
        );
    }

    #[test]
    fn a_scene_unlike_its_photos_is_named() {
        assert_eq!(unlike(22.3), None);
        assert!(unlike(17.4).unwrap().contains("17.4 dB"));
    }

    #[test]
    fn an_overfitted_scene_is_named() {
        assert_eq!(overfitted(25.0, 21.0), None);
        assert!(overfitted(26.3, 16.6).unwrap().contains("9.7 dB"));
    }

    #[test]
    fn photos_that_alone_show_much_are_named() {
        let photos = [("a.jpg", 0.002f32), ("b.jpg", 0.031), ("c.jpg", 0.2)];
        let photos = photos.map(|(name, share)| (name.to_owned(), share)).into();
        let words = seen_once(&SeenOnceShare { splats: 0.0412, photos }).expect("there are some");
        assert!(words.starts_with("4.1 % of the splats are seen once"), "{words}");
        assert!(words.ends_with("in c.jpg 20.0 %, b.jpg 3.1 %, as shares of the pixels"), "{words}");
        assert_eq!(seen_once(&SeenOnceShare { splats: 0.0, photos: Default::default() }), None);
    }

    #[test]
    fn copies_are_named() {
        let scene = arc(2.0);
        let mut digests: Vec<Option<&str>> = vec![Some("a"), Some("b"), Some("a"), None, None];
        assert!(copies(&scene, &digests).unwrap().contains("(2.png is 0.png)"));
        digests[2] = Some("c");
        assert_eq!(copies(&scene, &digests), None);
    }
}
