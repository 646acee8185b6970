//! A scene without an object: what photos saw of what the object covers stays, and what no photo saw is marked.
//!
//! Three things lie where an object was. Splats that some photo shows beside the object: they stay. Splats that only show once the
//! object is gone, such as its dark inside: no photo tells what is there, and they go. And holes. A hole through which the sky is seen
//! is right where some photo saw sky in that direction, above the horizon; any other is a part of the scene that no photo saw.

use crate::output::camera_path::{PathCamera, scene_up};
use crate::output::cover::cover;
use crate::{RunError, RunFolder, transients};
use glam::{Vec2, Vec3};
use segwild_raster::{Frame, ProjectOptions, Rasterizer, ResidentChannels};
use segwild_scene::{Camera, Image, Mask, Pose, Scene, Splats};

/// Light of a splat in a photo, in pixels, from which on the photo shows it.
const SHOWN: f32 = 0.25;
/// Pixels around an object's mask that may show it.
const MARGIN: f32 = 2.0;
/// Cover of a pixel over which it shows splats.
const COVERED: f32 = 0.5;
/// Cover of a pixel under which it shows the background alone: between fine splats on a surface there is always some.
const EMPTY: f32 = 0.1;
/// Pixels by which marks of what no photo saw are smoothed: specks on a rough surface are none.
const SPECK: f32 = 1.5;

/// What is known of a scene without an object.
pub(crate) struct SceneWithout {
    /// The splats that stay, by their index.
    pub keep: Vec<usize>,
    /// The scene with the object, 1 for its splats.
    whole: Splats,
    indicator: ResidentChannels<'static>,
    options: ProjectOptions,
    sky: SeenSky,
}

impl SceneWithout {
    /// Finds what a run's photos saw beside an object and where it is in other photos. `labels` marks its splats among `splats`.
    /// Photos are rendered with a long side of `size` pixels.
    ///
    /// # Errors
    /// When the engine fails.
    pub fn of_run(
        engine: &dyn Rasterizer,
        folder: &RunFolder,
        scene: &Scene,
        splats: (&Splats, ProjectOptions),
        labels: &[bool],
        size: u32,
    ) -> Result<SceneWithout, RunError> {
        let views = scene.views.iter().enumerate().filter(|(_, view)| !view.test);
        let photos: Vec<(usize, PathCamera)> = views
            .map(|(i, view)| (i, PathCamera { camera: view.camera.scaled_to(size), pose: view.pose }))
            .collect();
        SceneWithout::of(engine, &photos, &transients::of_run(folder, scene), splats, labels)
    }

    /// The same for these photos, by their index; `transients` gives a photo's transients, in pixels of any size, where it has some.
    fn of(
        engine: &dyn Rasterizer,
        photos: &[(usize, PathCamera)],
        transients: &dyn Fn(usize) -> Option<Mask>,
        (splats, options): (&Splats, ProjectOptions),
        labels: &[bool],
    ) -> Result<SceneWithout, RunError> {
        let others: Vec<usize> = (0..labels.len()).filter(|&i| !labels[i]).collect();
        let indicator = labels.iter().map(|&label| f32::from(u8::from(label))).collect::<Vec<_>>();
        let mut without = SceneWithout {
            keep: Vec::new(),
            whole: splats.clone(),
            indicator: ResidentChannels::new(1, indicator),
            options,
            sky: SeenSky::new(scene_up(photos.iter().map(|(_, photo)| &photo.pose))),
        };
        let rest = splats.select(&others);
        let resident = engine.upload_splats(&rest)?;
        let rest_engine = resident.as_deref().unwrap_or(engine);
        let mut knowledge = vec![SplatKnowledge::default(); others.len()];
        for (index, PathCamera { camera, pose }) in photos {
            let whole = without.object(engine, camera, pose)?;
            let mut unclear = over(&whole.image).dilated(MARGIN);
            if let Some(transients) = transients(*index) {
                unclear = unclear.or(&transients.resized(camera.width, camera.height));
            }
            without.sky.add(&whole.alpha, &unclear, camera, pose);
            let mut pixels = Image::zeros(camera.width as usize, camera.height as usize, 2);
            for i in 0..pixels.pixels() {
                pixels.plane_mut(usize::from(unclear.index(i)))[i] = 1.0;
            }
            let light = rest_engine.project(&rest, camera, pose, &options)?.gather(&pixels)?;
            knowledge.iter_mut().zip(light.chunks_exact(2)).for_each(|(splat, light)| splat.add(light));
        }
        let stays = |splat: &SplatKnowledge| splat.shown || !splat.uncovered;
        let known = others.iter().zip(&knowledge).filter(|(_, splat)| stays(splat));
        without.keep = known.map(|(&i, _)| i).collect();
        Ok(without)
    }

    /// The share of the object in each pixel while it is there, and what all splats cover.
    fn object(&self, engine: &dyn Rasterizer, camera: &Camera, pose: &Pose) -> Result<Frame, RunError> {
        let projected = engine.project(&self.whole, camera, pose, &self.options)?;
        Ok(projected.blend_resident(&self.indicator)?)
    }

    /// The pixels that show what no photo saw. `rest`: the cover of the splats that stay.
    ///
    /// # Errors
    /// When the engine fails.
    pub fn unseen(
        &self,
        engine: &dyn Rasterizer,
        camera: &Camera,
        pose: &Pose,
        rest: &Image,
    ) -> Result<Mask, RunError> {
        let covered = over(&self.object(engine, camera, pose)?.image);
        let unseen = Mask::from_fn(camera.width, camera.height, |x, y| {
            covered.get(x, y)
                && rest.at(0, x as usize, y as usize) < COVERED
                && !self.sky.holds(direction(camera, pose, x, y))
        });
        Ok(unseen.eroded(SPECK).dilated(SPECK))
    }

    /// The share of what the object covers in the photos that no photo saw, 0 to 1.
    ///
    /// # Errors
    /// When the engine fails.
    pub fn unseen_share(&self, engine: &dyn Rasterizer, scene: &Scene, size: u32) -> Result<f32, RunError> {
        let rest = self.whole.select(&self.keep);
        let (mut covered, mut unseen) = (0, 0);
        for view in &scene.views {
            let camera = view.camera.scaled_to(size);
            let alpha = cover(&*engine.project(&rest, &camera, &view.pose, &self.options)?)?;
            covered += over(&self.object(engine, &camera, &view.pose)?.image).count();
            unseen += self.unseen(engine, &camera, &view.pose, &alpha)?.count();
        }
        Ok(unseen as f32 / covered.max(1) as f32)
    }
}

/// The pixels over half of which something covers.
fn over(share: &Image) -> Mask {
    Mask::over(share.width as u32, share.height as u32, &share.data, COVERED)
}

/// What photos tell of a splat that is not the object's.
#[derive(Clone, Copy, Debug, Default)]
struct SplatKnowledge {
    /// Some photo shows it: most of its light there lies beside the object.
    shown: bool,
    /// It would be seen in some photo if the object were gone.
    uncovered: bool,
}

impl SplatKnowledge {
    /// Adds its light in a photo without the object, in pixels: beside the object, and where the object is.
    fn add(&mut self, light: &[f32]) {
        let (beside, within) = (light[0], light[1]);
        self.shown |= beside >= SHOWN && beside >= within;
        self.uncovered |= within > 0.0;
    }
}

/// The direction of a pixel in the world.
fn direction(camera: &Camera, pose: &Pose, x: u32, y: u32) -> Vec3 {
    pose.rotation.transpose() * camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)).normalize_or(Vec3::Z)
}

/// Directions in which some photo saw the background, in cells of about two thirds of a degree.
struct SeenSky {
    cells: Mask,
    up: Vec3,
}

/// Cells around, and from pole to pole.
const CELLS: (u32, u32) = (512, 256);
/// Sine of the elevation over which there may be sky: cameras are not held quite level. What is empty below is a part of the scene that
/// has no splats.
const HORIZON: f32 = -0.05;

impl SeenSky {
    fn new(up: Vec3) -> SeenSky {
        SeenSky { cells: Mask::empty(CELLS.0, CELLS.1), up }
    }

    /// Adds what a photo saw: its cover, and the pixels that do not count.
    fn add(&mut self, cover: &Image, unclear: &Mask, camera: &Camera, pose: &Pose) {
        for y in 0..camera.height {
            for x in 0..camera.width {
                let direction = direction(camera, pose, x, y);
                let is_empty = cover.at(0, x as usize, y as usize) < EMPTY;
                if is_empty && !unclear.get(x, y) && direction.dot(self.up) > HORIZON {
                    let (column, row) = cell(direction);
                    self.cells.set(column, row, true);
                }
            }
        }
    }

    fn holds(&self, direction: Vec3) -> bool {
        let (column, row) = cell(direction);
        self.cells.get(column, row)
    }
}

fn cell(direction: Vec3) -> (u32, u32) {
    let around = direction.x.atan2(direction.z) / std::f32::consts::TAU + 0.5;
    let down = direction.y.clamp(-1.0, 1.0).acos() / std::f32::consts::PI;
    let within = |share: f32, cells: u32| ((share * cells as f32) as u32).min(cells - 1);
    (within(around, CELLS.0), within(down, CELLS.1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_raster::CpuEngine;

    const CAMERA: Camera = Camera { width: 96, height: 96, fx: 80.0, fy: 80.0, cx: 48.0, cy: 48.0 };
    /// The splat within the object.
    const DARK: usize = 441 + 25;

    /// A wall of 21 x 21 splats, an object of 5 x 5 before it, and a dark splat in the object's back.
    fn wall_and_object() -> (Splats, Vec<bool>) {
        let grid = |n: i32, apart: f32, z: f32| {
            (-n..=n).flat_map(move |y| (-n..=n).map(move |x| [x as f32 * apart, y as f32 * apart, z]))
        };
        let means: Vec<[f32; 3]> =
            grid(10, 0.4, 6.0).chain(grid(2, 0.3, 4.0)).chain([[0.0, 0.0, 4.3]]).collect();
        let n = means.len();
        let splats = Splats {
            means,
            log_scales: vec![[-1.6, -1.6, -3.0]; n],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacities: vec![5.0; n],
            sh: vec![0.5; 3 * n],
            sh_degree: 0,
        };
        (splats, (0..n).map(|i| (441..DARK).contains(&i)).collect())
    }

    fn photo(x: f32) -> PathCamera {
        let eye = Vec3::new(x, 0.0, 0.0);
        PathCamera { camera: CAMERA, pose: Pose::look_at(eye, Vec3::new(0.0, 0.0, 5.0), Vec3::NEG_Y) }
    }

    fn without(photos: &[f32]) -> SceneWithout {
        let (splats, labels) = wall_and_object();
        let photos: Vec<_> = photos.iter().map(|&x| photo(x)).enumerate().collect();
        let options = ProjectOptions::default();
        SceneWithout::of(&CpuEngine::default(), &photos, &|_| None, (&splats, options), &labels).unwrap()
    }

    /// The share of the object's pixels, from the front, that no photo saw.
    fn unseen(without: &SceneWithout) -> f32 {
        let PathCamera { camera, pose } = photo(0.0);
        let engine = CpuEngine::default();
        let rest = without.whole.select(&without.keep);
        let rest = cover(&*engine.project(&rest, &camera, &pose, &without.options).unwrap()).unwrap();
        let object = over(&without.object(&engine, &camera, &pose).unwrap().image);
        let unseen = without.unseen(&engine, &camera, &pose, &rest).unwrap();
        assert_eq!(unseen.minus(&object).count(), 0);
        unseen.count() as f32 / object.count() as f32
    }

    #[test]
    fn a_wall_that_photos_saw_past_an_object_is_whole_and_the_objects_inside_is_gone() {
        let without = without(&[-4.0, 0.0, 4.0]);
        assert!((0..441).all(|i| without.keep.contains(&i)), "{} stay", without.keep.len());
        assert!(!without.keep.contains(&DARK) && without.keep.len() == 441);
        assert_eq!(unseen(&without), 0.0);
    }

    #[test]
    fn a_wall_that_an_object_covers_in_every_photo_is_a_hole_that_no_photo_saw() {
        let without = without(&[0.0, 0.02]);
        let lost = 441 - without.keep.len();
        assert!((4..50).contains(&lost) && !without.keep.contains(&220), "{lost} are not known");
        assert!(unseen(&without) > 0.5, "{}", unseen(&without));
    }

    #[test]
    fn the_sky_that_an_object_covers_is_seen_where_another_photo_saw_it() {
        // Nothing stands behind the object; photos from the side see what is behind it.
        let (splats, labels) = wall_and_object();
        let keep: Vec<usize> = (441..DARK).collect();
        let (splats, labels) = (splats.select(&keep), vec![true; labels.iter().filter(|&&l| l).count()]);
        let seen = |photos: &[PathCamera]| {
            let photos: Vec<_> = photos.iter().copied().enumerate().collect();
            let options = ProjectOptions::default();
            let of = SceneWithout::of(&CpuEngine::default(), &photos, &|_| None, (&splats, options), &labels);
            unseen(&of.unwrap())
        };
        let ahead = |x: f32| PathCamera {
            camera: CAMERA,
            pose: Pose::look_at(Vec3::new(x, 0.0, 0.0), Vec3::new(x, 0.0, 5.0), Vec3::NEG_Y),
        };
        // The lower half lies under the horizon, where no sky is.
        let from_aside = seen(&[ahead(0.0), ahead(3.0)]);
        assert!((0.3..0.55).contains(&from_aside), "{from_aside}");
        assert!(seen(&[ahead(0.0)]) > 0.9);
    }

    #[test]
    fn a_transient_shows_nothing_of_the_scene() {
        let (splats, labels) = wall_and_object();
        let photos: Vec<_> = [-4.0, 0.0, 4.0].map(photo).into_iter().enumerate().collect();
        let all = |photo: usize| (photo != 1).then(|| Mask::full(8, 8));
        let engine = CpuEngine::default();
        let options = ProjectOptions::default();
        let covered = SceneWithout::of(&engine, &photos, &all, (&splats, options), &labels).unwrap();
        assert!(unseen(&covered) > 0.5, "only the front photo counts: {}", unseen(&covered));
    }
}
