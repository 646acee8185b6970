//! Mapping between the photo as taken, which people and other programs see, and the undistorted one, on which all is computed.
//!
//! Clicks, boxes, true masks, masks of what to ignore or keep and transient masks are pixels of the photo as taken, turned
//! or not by its EXIF orientation, as its pose requires. They are mapped here, and nowhere else, on their way in; masks are mapped back on
//! their way out. Both have the same size. For a photo without distortion the two are one.

use crate::lens::Lens;
use crate::{BoxPrompt, Mask, PointPrompt, Prompts, View};

/// Step in pixels of the grid on which a lens is inverted exactly; positions in between are interpolated.
const STEP: u32 = 16;
/// Farthest that an interpolated position may be off, in pixels.
const OFF: f64 = 0.1;
/// Points along each side of a box that are mapped.
const ALONG: u32 = 16;

impl View {
    /// Where the undistorted photo shows what the photo as taken shows at a pixel position, both at full size; `None` where it does
    /// not show it.
    pub fn from_taken(&self, pixel: [f32; 2]) -> Option<[f32; 2]> {
        let Some(lens) = &self.photo.lens else { return Some(pixel) };
        let [x, y] = lens.undistort(pixel.map(f64::from))?;
        let mapped = [x as f32, y as f32];
        self.camera.contains(mapped.into()).then_some(mapped)
    }

    /// The inverse of [`View::from_taken`].
    pub fn to_taken(&self, pixel: [f32; 2]) -> Option<[f32; 2]> {
        let Some(lens) = &self.photo.lens else { return Some(pixel) };
        lens.distort(pixel.map(f64::from)).map(|[x, y]| [x as f32, y as f32])
    }

    /// Prompts on the photo as taken, on the undistorted one. A box becomes the box around what is left of it.
    ///
    /// # Errors
    /// The position of a click, or of a box's corner, that the undistorted photo does not show.
    pub fn prompts_from_taken(&self, prompts: &Prompts) -> Result<Prompts, [f32; 2]> {
        if self.photo.lens.is_none() {
            return Ok(prompts.clone());
        }
        let point = |p: &PointPrompt| {
            let mapped = self.from_taken([p.x, p.y]).map(|[x, y]| PointPrompt { x, y, ..*p });
            mapped.ok_or([p.x, p.y])
        };
        let points = prompts.points.iter().map(point).collect::<Result<_, _>>()?;
        let around = |b: &BoxPrompt| self.box_from_taken(b).ok_or([b.x0, b.y0]);
        let boxes = prompts.boxes.iter().map(around).collect::<Result<_, _>>()?;
        Ok(Prompts { points, boxes, granularity: prompts.granularity })
    }

    fn box_from_taken(&self, b: &BoxPrompt) -> Option<BoxPrompt> {
        let side = |k: u32| {
            let t = k as f32 / ALONG as f32;
            let (x, y) = (b.x0 + t * (b.x1 - b.x0), b.y0 + t * (b.y1 - b.y0));
            [[x, b.y0], [x, b.y1], [b.x0, y], [b.x1, y]]
        };
        let mapped = (0..=ALONG).flat_map(side).filter_map(|p| self.from_taken(p));
        mapped.fold(None, |found: Option<BoxPrompt>, [x, y]| {
            let f = found.unwrap_or(BoxPrompt { x0: x, y0: y, x1: x, y1: y });
            Some(BoxPrompt { x0: f.x0.min(x), y0: f.y0.min(y), x1: f.x1.max(x), y1: f.y1.max(y) })
        })
    }

    /// A mask of the photo as taken, at any size, as a mask of the undistorted one at the same size.
    pub fn mask_from_taken(&self, mask: Mask) -> Mask {
        let Some(lens) = &self.photo.lens else { return mask };
        let lens = lens.resized(mask.width(), mask.height());
        Mask::from_fn(mask.width(), mask.height(), |x, y| {
            let p = lens.distort([f64::from(x) + 0.5, f64::from(y) + 0.5]);
            p.is_some_and(|p| mask.at(p[0] as f32, p[1] as f32))
        })
    }

    /// A mask of the undistorted photo, at any size, as a mask of the photo as taken at the same size. What the undistorted photo
    /// does not show is outside.
    pub fn mask_to_taken(&self, mask: Mask) -> Mask {
        let Some(lens) = &self.photo.lens else { return mask };
        let undo = Undo::new(lens.resized(mask.width(), mask.height()));
        Mask::from_fn(mask.width(), mask.height(), |x, y| {
            undo.at(x, y).is_some_and(|p| mask.at(p[0] as f32, p[1] as f32))
        })
    }
}

/// The inverse of a lens at the centres of all pixels.
struct Undo {
    lens: Lens,
    columns: u32,
    /// The positions at the corners of each square of pixels; `None` where interpolation within it is not exact enough.
    squares: Vec<Option<[[f64; 2]; 4]>>,
}

impl Undo {
    fn new(lens: Lens) -> Undo {
        let (columns, rows) = (lens.width().div_ceil(STEP), lens.height().div_ceil(STEP));
        let undo = |x: f64, y: f64| lens.undistort([x * f64::from(STEP), y * f64::from(STEP)]);
        let corners: Vec<Option<[f64; 2]>> = (0..=rows)
            .flat_map(|y| (0..=columns).map(move |x| (f64::from(x), f64::from(y))))
            .map(|(x, y)| undo(x, y))
            .collect();
        let square = |i: u32| {
            let (x, y) = (i % columns, i / columns);
            let corner = |dx: u32, dy: u32| corners[((y + dy) * (columns + 1) + x + dx) as usize];
            let square = [corner(0, 0)?, corner(1, 0)?, corner(0, 1)?, corner(1, 1)?];
            let middle = undo(f64::from(x) + 0.5, f64::from(y) + 0.5)?;
            let [u, v] = interpolated(&square, 0.5, 0.5);
            ((u - middle[0]).hypot(v - middle[1]) < OFF).then_some(square)
        };
        let squares = (0..columns * rows).map(square).collect();
        Undo { lens, columns, squares }
    }

    fn at(&self, x: u32, y: u32) -> Option<[f64; 2]> {
        let (column, row) = (x / STEP, y / STEP);
        let (u, v) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
        match &self.squares[(row * self.columns + column) as usize] {
            Some(square) => {
                let part = |at: f64, cell: u32| at / f64::from(STEP) - f64::from(cell);
                Some(interpolated(square, part(u, column), part(v, row)))
            }
            None => self.lens.undistort([u, v]),
        }
    }
}

fn interpolated(square: &[[f64; 2]; 4], s: f64, t: f64) -> [f64; 2] {
    let [a, b, c, d] = square;
    [0, 1].map(|k| (1.0 - t) * ((1.0 - s) * a[k] + s * b[k]) + t * ((1.0 - s) * c[k] + s * d[k]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::colmap::CameraModel;
    use crate::{Photo, Pose};
    use glam::Vec3;

    fn view(lens: Lens) -> View {
        let photo = Photo { lens: Some(lens.clone()), ..Photo::new("a.jpg") };
        let pose = Pose::look_at(Vec3::ZERO, Vec3::Z, Vec3::NEG_Y);
        View { name: "a.jpg".into(), camera: lens.pinhole(), pose, photo, test: false }
    }

    fn lenses() -> [Lens; 3] {
        let lens = |model, params: &[f64]| Lens::new(model, 320, 240, params).unwrap();
        [
            lens(CameraModel::OpenCv, &[280.0, 285.0, 158.0, 122.0, -0.18, 0.05, 1e-3, -2e-3]),
            lens(CameraModel::OpenCv, &[280.0, 285.0, 158.0, 122.0, 0.15, 0.0, 0.0, 0.0]),
            lens(CameraModel::OpenCvFisheye, &[190.0, 190.0, 160.0, 120.0, 0.02, -0.01, 0.003, -0.001]),
        ]
    }

    #[test]
    fn a_click_on_a_distorted_photo_goes_there_and_back() {
        for lens in lenses() {
            let view = view(lens);
            let mut mapped = 0;
            for (x, y) in (0..320).step_by(7).flat_map(|x| (0..240).step_by(7).map(move |y| (x, y))) {
                let taken = [x as f32 + 0.5, y as f32 + 0.5];
                let Some(p) = view.from_taken(taken) else { continue };
                let back = view.to_taken(p).expect("it came from there");
                assert!((back[0] - taken[0]).hypot(back[1] - taken[1]) < 0.01, "{taken:?} {back:?}");
                mapped += 1;
            }
            assert!(mapped > 900, "{mapped} of 1,610 clicks are shown");
            // The lens matters: what is far from the middle moves.
            let p = view.from_taken([40.0, 40.0]).expect("shown");
            assert!((p[0] - 40.0).hypot(p[1] - 40.0) > 2.0, "{p:?}");
        }
    }

    #[test]
    fn a_mask_of_a_distorted_photo_goes_there_and_back_within_a_pixel() {
        for lens in lenses() {
            let view = view(lens);
            let disc = |x: u32, y: u32| (x as f32 - 110.0).hypot(y as f32 - 90.0) < 50.0;
            let taken = Mask::from_fn(320, 240, disc);
            let inner = view.mask_from_taken(taken.clone());
            assert!(inner.iou(&taken) < 0.97, "the lens moves it");
            let back = view.mask_to_taken(inner.clone());
            let (grown, shrunk) = (taken.dilated(1.5), taken.eroded(1.5));
            assert!(
                back.minus(&grown).is_empty() && shrunk.minus(&back).is_empty(),
                "iou {}",
                back.iou(&taken)
            );
            // At another size it is the same.
            let small = view.mask_to_taken(inner.resized(160, 120));
            assert!(small.resized(320, 240).iou(&taken) > 0.95);
        }
    }

    #[test]
    fn a_box_on_a_distorted_photo_becomes_the_box_around_it() {
        let [_, _, fisheye] = lenses();
        let view = view(fisheye);
        let prompts = Prompts {
            points: vec![PointPrompt { x: 160.0, y: 120.0, inside: true }],
            boxes: vec![BoxPrompt { x0: 100.0, y0: 80.0, x1: 220.0, y1: 160.0 }],
            granularity: None,
        };
        let mapped = view.prompts_from_taken(&prompts).unwrap();
        let b = mapped.boxes[0];
        assert!(b.x0 < 100.0 && b.y0 < 80.0 && b.x1 > 220.0 && b.y1 > 160.0, "{b:?}");
        assert!((mapped.points[0].x - 160.0).abs() < 0.01);
        // The corner of a fisheye is not in the pinhole's image.
        assert_eq!(view.prompts_from_taken(&Prompts::click(1.0, 1.0)), Err([1.0, 1.0]));
    }
}
