//! The selected object as splats of its own and as masks on any photo (method, section 10).

use crate::SpikeCut;
use segwild_raster::{Channels, ProjectOptions, RasterError, Rasterizer};
use segwild_scene::{Camera, Image, Mask, Pose, Splats, box_mean};

/// Share of a pixel that the object must make up to own it, relative to its mean share around there (method, section 6.7);
/// absolute where it is rendered alone. From docs/experiments/2026-11-24-pixels-of-an-object.md, as are the next two. IoU by
/// half, half more: -.002, +.007 on `sacre_coeur`; +.004, -.030 on the demo.
const OWNED_SHARE: f32 = 0.5;
/// The least share of a pixel that it must make up (method, section 6.7): less is stray haze. IoU by half, half more: -.048,
/// +.022 on `sacre_coeur`; -.010, -.036 on the demo.
const MIN_OWNED_SHARE: f32 = 0.3;
/// The window around a pixel has as half width the frame's long side divided by this (method, section 6.7). IoU by half, half
/// more: +.004, -.001 on `sacre_coeur`; +.003, +.001 on the demo.
const WINDOWS_PER_SIDE: usize = 50;
/// Long side in pixels at which the windows are evaluated: their result is smooth.
const WINDOW_SIZE: usize = 400;

/// An object taken out of its scene.
#[derive(Clone, Debug, PartialEq)]
pub struct SelectedObject {
    /// Its splats, cut.
    pub splats: Splats,
    /// Index of each of them in the scene.
    pub indices: Vec<u32>,
}

impl SelectedObject {
    /// The selected splats of a scene after a cut; the scene itself is untouched.
    pub fn new(splats: &Splats, labels: &[bool], cut: &SpikeCut) -> SelectedObject {
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
        SelectedObject { splats: object, indices: keep.into_iter().map(|i| i as u32).collect() }
    }
}

/// The scene with the cut applied, and the labels without the dropped splats: what masks are rendered from.
pub fn cut_scene(splats: &Splats, labels: &[bool], cut: &SpikeCut) -> (Splats, Vec<bool>) {
    let (mut splats, mut labels) = (splats.clone(), labels.to_vec());
    cut.apply(&mut splats);
    cut.trim(&mut labels);
    (splats, labels)
}

/// Which pixels a mask of an object holds (method, section 10).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MaskMode {
    /// Its visible pixels, with the whole scene occluding.
    Visible,
    /// All that it would cover if nothing occluded it: its splats are rendered alone.
    Amodal,
}

/// The pixels that an object owns, at `size` (width, height). `share` is one plane: the share of each pixel that it makes up,
/// in [0, 1].
pub fn owned(share: &Image, mode: MaskMode, size: (u32, u32)) -> Mask {
    let margin = margin(share, mode).resized(size.0 as usize, size.1 as usize);
    Mask::over(size.0, size.1, margin.plane(0), 0.0)
}

/// The object's share of each pixel, less the share that it needs to own the pixel.
///
/// Where the object is solid and nothing stands before it, it needs half of a pixel (method, section 10). Haze takes a share
/// of everything in its background, and a thin object shows its background: then half of the object's mean share around there
/// is enough. Pixels weigh by the square of the share, so that the inside of the object decides, and not its rim. Rendered
/// alone, the object has no haze before it, and a part with little of a pixel was rightly occluded: then it needs half.
fn margin(share: &Image, mode: MaskMode) -> Image {
    if mode == MaskMode::Amodal {
        let mut margin = share.clone();
        margin.data.iter_mut().for_each(|s| *s -= OWNED_SHARE);
        return margin;
    }
    let (w, h) = (share.width, share.height);
    let shrink = WINDOW_SIZE as f32 / w.max(h).max(1) as f32;
    let side = |n: usize| if shrink < 1.0 { ((n as f32 * shrink).round() as usize).max(1) } else { n };
    let small = share.resized(side(w), side(h));
    let r = (small.width.max(small.height) / WINDOWS_PER_SIDE).max(1);
    let around = |power: i32| {
        let powers: Vec<f32> = small.plane(0).iter().map(|s| s.powi(power)).collect();
        box_mean(&powers, small.width, small.height, r)
    };
    let (cubes, squares) = (around(3), around(2));
    let owning = cubes.iter().zip(&squares).map(|(cubes, squares)| {
        let inside = if *squares > 0.0 { cubes / squares } else { 0.0 };
        (OWNED_SHARE * inside).max(MIN_OWNED_SHARE)
    });
    let owning = Image { width: small.width, height: small.height, channels: 1, data: owning.collect() };
    let mut margin = owning.resized(w, h);
    margin.data.iter_mut().zip(share.plane(0)).for_each(|(m, s)| *m = s - *m);
    margin
}

/// The pixels that show the object, with the whole scene occluding.
pub fn visible_mask(
    engine: &dyn Rasterizer,
    splats: &Splats,
    labels: &[bool],
    options: &ProjectOptions,
    camera: &Camera,
    pose: &Pose,
) -> Result<Mask, RasterError> {
    checked(splats, labels)?;
    let indicator: Vec<f32> = labels.iter().map(|&l| f32::from(u8::from(l))).collect();
    let frame =
        engine.project(splats, camera, pose, options)?.blend(&Channels { count: 1, values: &indicator })?;
    Ok(owned(&frame.image, MaskMode::Visible, (camera.width, camera.height)))
}

/// The pixels that the object would cover if nothing occluded it.
pub fn amodal_mask(
    engine: &dyn Rasterizer,
    splats: &Splats,
    labels: &[bool],
    options: &ProjectOptions,
    camera: &Camera,
    pose: &Pose,
) -> Result<Mask, RasterError> {
    checked(splats, labels)?;
    let keep: Vec<usize> = (0..splats.len()).filter(|&i| labels[i]).collect();
    if keep.is_empty() {
        return Ok(Mask::empty(camera.width, camera.height));
    }
    let alone = splats.select(&keep);
    let whole = vec![1.0; keep.len()];
    let frame =
        engine.project(&alone, camera, pose, options)?.blend(&Channels { count: 1, values: &whole })?;
    Ok(owned(&frame.image, MaskMode::Amodal, (camera.width, camera.height)))
}

fn checked(splats: &Splats, labels: &[bool]) -> Result<(), RasterError> {
    if labels.len() == splats.len() {
        return Ok(());
    }
    Err(RasterError::Shape(format!("{} labels for {} splats", labels.len(), splats.len())))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (200, 100);

    /// A block whose rim is a ramp of 3 pixels: `inside` of a pixel where it is whole, and `around` elsewhere.
    fn block(inside: f32, around: f32) -> Image {
        let data = (0..SIZE.0 * SIZE.1).map(|i| {
            let (x, y) = (i % SIZE.0, i / SIZE.0);
            let ramp = |at: usize, from: f32, to: f32| {
                let at = at as f32 + 0.5;
                ((at - from) / 3.0 + 0.5).min((to - at) / 3.0 + 0.5).clamp(0.0, 1.0)
            };
            around + (inside - around) * ramp(x, 60.0, 140.0).min(ramp(y, 30.0, 70.0))
        });
        Image { width: SIZE.0, height: SIZE.1, channels: 1, data: data.collect() }
    }

    fn visible(share: &Image) -> Mask {
        owned(share, MaskMode::Visible, (SIZE.0 as u32, SIZE.1 as u32))
    }

    fn outline() -> Mask {
        Mask::from_fn(SIZE.0 as u32, SIZE.1 as u32, |x, y| (60..140).contains(&x) && (30..70).contains(&y))
    }

    /// The haze that transients leave before buildings cost a strip of every rim, and all of what it made up more than half of.
    #[test]
    fn haze_before_an_object_leaves_its_outline_where_it_is() {
        for inside in [1.0, 0.9, 0.8, 0.7] {
            let iou = visible(&block(inside, 0.0)).iou(&outline());
            assert!(iou > 0.96, "{inside}: {iou}");
            let by_half = Mask::over(SIZE.0 as u32, SIZE.1 as u32, block(inside, 0.0).plane(0), OWNED_SHARE);
            assert!(iou >= by_half.iou(&outline()), "{inside}");
        }
        let thick = block(0.45, 0.0);
        assert!(visible(&thick).iou(&outline()) > 0.85);
        assert!(Mask::over(SIZE.0 as u32, SIZE.1 as u32, thick.plane(0), OWNED_SHARE).is_empty());
    }

    #[test]
    fn stray_haze_owns_nothing() {
        assert!(visible(&block(0.29, 0.29)).is_empty());
        // Nor where a solid object is near.
        assert!(visible(&block(1.0, 0.25)).iou(&outline()) > 0.9);
    }

    #[test]
    fn what_is_no_number_owns_nothing_and_takes_nothing_from_the_rest_of_the_photo() {
        let mut share = block(1.0, 0.0);
        let clean = visible(&share);
        share.data[5 * SIZE.0 + 5] = f32::NAN;
        assert_eq!(visible(&share), clean);
    }
}
