//! The selected object as splats of its own and as masks on any photo (method, section 10).

use crate::Cut;
use segwild_raster::{Channels, Engine, ProjectOptions, RasterError};
use segwild_scene::{Camera, Mask, Pose, Splats};

/// Share of a pixel that the object must make up to own it.
const HALF: f32 = 0.5;

/// An object taken out of its scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// Its splats, cut.
    pub splats: Splats,
    /// Where each of them stands in the scene.
    pub indices: Vec<u32>,
}

impl Object {
    /// The selected splats of a scene after a cut; the scene itself is untouched.
    pub fn new(splats: &Splats, labels: &[bool], cut: &Cut) -> Object {
        let mut labels = labels.to_vec();
        cut.trim(&mut labels);
        let keep: Vec<usize> = (0..splats.len()).filter(|&i| labels[i]).collect();
        let mut object = splats.select(&keep);
        for (i, _, after) in &cut.changed {
            if let Ok(at) = keep.binary_search(&(*i as usize)) {
                object.means[at] = after.mean;
                object.log_scales[at] = after.log_scales;
                object.rotations[at] = after.rotation;
            }
        }
        Object { splats: object, indices: keep.into_iter().map(|i| i as u32).collect() }
    }
}

/// The scene with the cut applied, and the labels without the dropped splats: what masks are rendered from.
pub fn cut_scene(splats: &Splats, labels: &[bool], cut: &Cut) -> (Splats, Vec<bool>) {
    let (mut splats, mut labels) = (splats.clone(), labels.to_vec());
    cut.apply(&mut splats);
    cut.trim(&mut labels);
    (splats, labels)
}

/// The pixels that show the object: its share of the pixel is over one half, with the whole scene occluding.
pub fn visible_mask(
    engine: &dyn Engine,
    splats: &Splats,
    labels: &[bool],
    options: &ProjectOptions,
    camera: &Camera,
    pose: &Pose,
) -> Result<Mask, RasterError> {
    if labels.len() != splats.len() {
        return Err(RasterError::Shape(format!("{} labels for {} splats", labels.len(), splats.len())));
    }
    let indicator: Vec<f32> = labels.iter().map(|&l| f32::from(u8::from(l))).collect();
    let frame =
        engine.project(splats, camera, pose, options)?.blend(&Channels { count: 1, values: &indicator })?;
    Ok(Mask::over(camera.width, camera.height, frame.image.plane(0), HALF))
}

/// The pixels that the object would cover if nothing stood before it.
pub fn amodal_mask(
    engine: &dyn Engine,
    splats: &Splats,
    labels: &[bool],
    options: &ProjectOptions,
    camera: &Camera,
    pose: &Pose,
) -> Result<Mask, RasterError> {
    if labels.len() != splats.len() {
        return Err(RasterError::Shape(format!("{} labels for {} splats", labels.len(), splats.len())));
    }
    let keep: Vec<usize> = (0..splats.len()).filter(|&i| labels[i]).collect();
    if keep.is_empty() {
        return Ok(Mask::empty(camera.width, camera.height));
    }
    // Alone, nothing hides it.
    visible_mask(engine, &splats.select(&keep), &vec![true; keep.len()], options, camera, pose)
}
