//! Distorted camera models, as COLMAP and nerfstudio name them.
//!
//! A lens maps a direction `(u, v) = (x / z, y / z)` of the camera frame to a pixel of the photo as it was taken.
//! Photos are undistorted on load to the pinhole of the same focal length, principal point and size
//! ([`Lens::pinhole`]): the middle of the photo keeps its scale, what bends out of the frame is cropped and
//! what was never photographed is marked invalid.

use crate::Camera;

/// COLMAP's camera models.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)] // their names are COLMAP's
pub enum CameraModel {
    SimplePinhole,
    Pinhole,
    SimpleRadial,
    Radial,
    OpenCv,
    OpenCvFisheye,
    FullOpenCv,
    Fov,
    SimpleRadialFisheye,
    RadialFisheye,
    ThinPrismFisheye,
    RadTanThinPrismFisheye,
    SimpleDivision,
    Division,
    SimpleFisheye,
    Fisheye,
}

/// Model, COLMAP's number for it, its name, and how many parameters it has.
const MODELS: [(CameraModel, i32, &str, usize); 16] = [
    (CameraModel::SimplePinhole, 0, "SIMPLE_PINHOLE", 3),
    (CameraModel::Pinhole, 1, "PINHOLE", 4),
    (CameraModel::SimpleRadial, 2, "SIMPLE_RADIAL", 4),
    (CameraModel::Radial, 3, "RADIAL", 5),
    (CameraModel::OpenCv, 4, "OPENCV", 8),
    (CameraModel::OpenCvFisheye, 5, "OPENCV_FISHEYE", 8),
    (CameraModel::FullOpenCv, 6, "FULL_OPENCV", 12),
    (CameraModel::Fov, 7, "FOV", 5),
    (CameraModel::SimpleRadialFisheye, 8, "SIMPLE_RADIAL_FISHEYE", 4),
    (CameraModel::RadialFisheye, 9, "RADIAL_FISHEYE", 5),
    (CameraModel::ThinPrismFisheye, 10, "THIN_PRISM_FISHEYE", 12),
    (CameraModel::RadTanThinPrismFisheye, 11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    (CameraModel::SimpleDivision, 12, "SIMPLE_DIVISION", 4),
    (CameraModel::Division, 13, "DIVISION", 5),
    (CameraModel::SimpleFisheye, 14, "SIMPLE_FISHEYE", 3),
    (CameraModel::Fisheye, 15, "FISHEYE", 4),
];

impl CameraModel {
    /// The model with COLMAP's number `id`.
    pub fn from_id(id: i32) -> Option<CameraModel> {
        MODELS.iter().find(|m| m.1 == id).map(|m| m.0)
    }

    /// The model with COLMAP's name.
    pub fn from_name(name: &str) -> Option<CameraModel> {
        MODELS.iter().find(|m| m.2 == name).map(|m| m.0)
    }

    /// COLMAP's number.
    pub fn id(self) -> i32 {
        self.row().1
    }

    /// COLMAP's name.
    pub fn name(self) -> &'static str {
        self.row().2
    }

    /// Number of parameters.
    pub fn param_count(self) -> usize {
        self.row().3
    }

    fn row(self) -> &'static (CameraModel, i32, &'static str, usize) {
        &MODELS[self as usize]
    }

    fn has_one_focal(self) -> bool {
        matches!(
            self,
            CameraModel::SimplePinhole
                | CameraModel::SimpleRadial
                | CameraModel::Radial
                | CameraModel::SimpleRadialFisheye
                | CameraModel::RadialFisheye
                | CameraModel::SimpleDivision
                | CameraModel::SimpleFisheye
        )
    }
}

/// Why parameters are those of no lens.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LensError {
    /// The model cannot be undistorted here.
    #[error(
        "this program does not undistort camera model {model}: undistort the photos with COLMAP's image_undistorter first, which does"
    )]
    Unsupported {
        /// COLMAP's name of the model.
        model: &'static str,
    },
    /// The model has another number of parameters.
    #[error("{model} has {wanted} parameters, not {given}")]
    ParamCount {
        /// COLMAP's name of the model.
        model: &'static str,
        /// How many it has.
        wanted: usize,
        /// How many were given.
        given: usize,
    },
    /// No photo has this size.
    #[error("its camera says that the photo has {width} x {height} pixels")]
    Size {
        /// Width in pixels.
        width: u64,
        /// Height in pixels.
        height: u64,
    },
    /// A parameter is not finite.
    #[error("its camera has the parameter {0}")]
    NotFinite(f64),
    /// A focal length is 0 or less, in pixels.
    #[error("its camera has the focal length {0}")]
    NoFocal(f64),
    /// A focal length is that of no lens for a photo of this size.
    #[error(
        "its camera has a focal length of {focal} pixels for a photo of {width} x {height}: the reconstruction went wrong there"
    )]
    Focal {
        /// The focal length in pixels.
        focal: f64,
        /// Width of the photo in pixels.
        width: f64,
        /// Height of the photo.
        height: f64,
    },
    /// The focal lengths differ too much.
    #[error("its camera's focal lengths, {} and {} pixels, cannot be of one lens", .0[0], .0[1])]
    UnevenFocals([f64; 2]),
    /// The principal point lies too far outside of the photo.
    #[error(
        "its camera's principal point, ({}, {}), lies far outside of a photo of {width} x {height}", centre[0], centre[1]
    )]
    Centre {
        /// The principal point in pixels.
        centre: [f64; 2],
        /// Width of the photo in pixels.
        width: f64,
        /// Height of the photo.
        height: f64,
    },
}

/// How the radius in the image grows with the angle, before the polynomials.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Projection {
    /// tan(angle).
    Perspective,
    /// The angle itself.
    Fisheye,
    /// FOV model of Devernay and Faugeras, with its omega.
    Fov(f64),
    /// Division model: undistorted = distorted / (1 + k distorted^2), with its k.
    Division(f64),
}

/// A lens as the reconstruction saw it: intrinsics in pixels and distortion.
#[derive(Clone, Debug, PartialEq)]
pub struct Lens {
    model: CameraModel,
    width: u32,
    height: u32,
    focal: [f64; 2],
    centre: [f64; 2],
    projection: Projection,
    /// Polynomial of the squared radius: k1.. of the numerator.
    radial: [f64; 4],
    /// The same for the denominator (FULL_OPENCV's k4..k6).
    rational: [f64; 3],
    /// p1, p2.
    tangential: [f64; 2],
    /// sx1, sy1.
    prism: [f64; 2],
    /// Undistorted radius up to which the distortion can be undone.
    limit: f64,
}

/// Sides over this are not photos; they are damaged files.
const LARGEST_SIDE: u64 = 100_000;
/// Widest angle off the axis that a pinhole image may hold, in degrees.
const WIDEST: f64 = 89.0;

/// Focal lengths in long sides of the photo: from a view of 173 degrees to one of a quarter of a degree, as of a telescope.
const FOCAL: std::ops::RangeInclusive<f64> = 0.03..=200.0;
/// How many times the focal length may differ across and down.
const UNEVEN: f64 = 10.0;
/// How many of the photo's sizes the principal point may lie outside of it.
const OUTSIDE: f64 = 2.0;

/// Refuses a camera that no photo was taken with: rays of it are all but parallel, or all but perpendicular, and what is computed
/// from it is no number.
fn believable([width, height]: [f64; 2], focal: [f64; 2], centre: [f64; 2]) -> Result<(), LensError> {
    let long = width.max(height);
    if let Some(&focal) = focal.iter().find(|&&f| !FOCAL.contains(&(f / long))) {
        return Err(LensError::Focal { focal, width, height });
    }
    if focal[0].max(focal[1]) > UNEVEN * focal[0].min(focal[1]) {
        return Err(LensError::UnevenFocals(focal));
    }
    let far = |c: f64, size: f64| c < -OUTSIDE * size || c > (1.0 + OUTSIDE) * size;
    if far(centre[0], width) || far(centre[1], height) {
        return Err(LensError::Centre { centre, width, height });
    }
    Ok(())
}

impl Lens {
    /// A lens from COLMAP's parameters.
    ///
    /// # Errors
    /// The model cannot be undistorted, or its parameters are those of no lens.
    pub fn new(model: CameraModel, width: u64, height: u64, params: &[f64]) -> Result<Lens, LensError> {
        let name = model.name();
        if model == CameraModel::RadTanThinPrismFisheye {
            return Err(LensError::Unsupported { model: name });
        }
        if params.len() != model.param_count() {
            let (wanted, given) = (model.param_count(), params.len());
            return Err(LensError::ParamCount { model: name, wanted, given });
        }
        if width == 0 || height == 0 || width > LARGEST_SIDE || height > LARGEST_SIDE {
            return Err(LensError::Size { width, height });
        }
        if let Some(&bad) = params.iter().find(|p| !p.is_finite()) {
            return Err(LensError::NotFinite(bad));
        }
        let (focal, rest) = if model.has_one_focal() {
            ([params[0]; 2], &params[1..])
        } else {
            ([params[0], params[1]], &params[2..])
        };
        if focal.iter().any(|&f| f <= 0.0) {
            return Err(LensError::NoFocal(focal[0].min(focal[1])));
        }
        let (centre, k) = ([rest[0], rest[1]], &rest[2..]);
        believable([width as f64, height as f64], focal, centre)?;
        let mut lens = Lens {
            model,
            width: width as u32,
            height: height as u32,
            focal,
            centre,
            projection: Projection::Perspective,
            radial: [0.0; 4],
            rational: [0.0; 3],
            tangential: [0.0; 2],
            prism: [0.0; 2],
            limit: 0.0,
        };
        match model {
            CameraModel::SimplePinhole | CameraModel::Pinhole => {}
            CameraModel::SimpleRadial | CameraModel::Radial => lens.radial[..k.len()].copy_from_slice(k),
            CameraModel::OpenCv => {
                lens.radial[..2].copy_from_slice(&k[..2]);
                lens.tangential = [k[2], k[3]];
            }
            CameraModel::FullOpenCv => {
                lens.radial = [k[0], k[1], k[4], 0.0];
                lens.tangential = [k[2], k[3]];
                lens.rational = [k[5], k[6], k[7]];
            }
            CameraModel::Fov => lens.projection = Projection::Fov(k[0]),
            CameraModel::SimpleDivision | CameraModel::Division => {
                lens.projection = Projection::Division(k[0])
            }
            CameraModel::SimpleFisheye
            | CameraModel::Fisheye
            | CameraModel::SimpleRadialFisheye
            | CameraModel::RadialFisheye
            | CameraModel::OpenCvFisheye => {
                lens.projection = Projection::Fisheye;
                lens.radial[..k.len()].copy_from_slice(k);
            }
            CameraModel::ThinPrismFisheye => {
                lens.projection = Projection::Fisheye;
                lens.radial = [k[0], k[1], k[4], k[5]];
                lens.tangential = [k[2], k[3]];
                lens.prism = [k[6], k[7]];
            }
            CameraModel::RadTanThinPrismFisheye => unreachable!("refused above"),
        }
        lens.limit = lens.find_limit();
        Ok(lens)
    }

    /// nerfstudio's perspective lens: OPENCV with radial terms up to the eighth power.
    pub(crate) fn with_radial(mut self, k3: f64, k4: f64) -> Lens {
        self.radial[2] = k3;
        self.radial[3] = k4;
        self.limit = self.find_limit();
        self
    }

    /// The model.
    pub fn model(&self) -> CameraModel {
        self.model
    }

    /// Width in pixels that the parameters are for.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height in pixels that the parameters are for.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Whether the photo differs from that of a pinhole.
    pub fn is_distorted(&self) -> bool {
        let plain = match self.projection {
            Projection::Perspective => true,
            Projection::Division(k) => k == 0.0,
            Projection::Fisheye | Projection::Fov(_) => false,
        };
        let terms = self.radial.iter().chain(&self.rational).chain(&self.tangential).chain(&self.prism);
        !plain || terms.into_iter().any(|&k| k != 0.0)
    }

    /// The pinhole that photos of this lens are undistorted to.
    pub fn pinhole(&self) -> Camera {
        Camera {
            width: self.width,
            height: self.height,
            fx: self.focal[0] as f32,
            fy: self.focal[1] as f32,
            cx: self.centre[0] as f32,
            cy: self.centre[1] as f32,
        }
    }

    /// Share of the pinhole's image that the photo can fill, in [0, 1]. The rest lies where the lens, by its parameters, folds the
    /// photo over, or where it does not reach.
    pub fn filled(&self) -> f64 {
        const STEPS: u32 = 24;
        let (w, h) = (f64::from(self.width), f64::from(self.height));
        let at = |k: u32, size: f64| (f64::from(k) + 0.5) / f64::from(STEPS) * size;
        let shows = |p: [f64; 2]| (0.0..=w).contains(&p[0]) && (0.0..=h).contains(&p[1]);
        let cells = (0..STEPS).flat_map(|y| (0..STEPS).map(move |x| [at(x, w), at(y, h)]));
        let filled = cells.filter(|&cell| self.distort(cell).is_some_and(shows)).count();
        filled as f64 / f64::from(STEPS * STEPS)
    }

    /// The same lens for a photo resized to `width` x `height`.
    pub fn resized(&self, width: u32, height: u32) -> Lens {
        let scale = [f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height)];
        let times = |a: [f64; 2]| [a[0] * scale[0], a[1] * scale[1]];
        Lens { width, height, focal: times(self.focal), centre: times(self.centre), ..self.clone() }
    }

    /// Pixel of the photo as taken that shows what the pinhole shows at `pixel`; `None` where no such pixel exists.
    pub fn distort(&self, pixel: [f64; 2]) -> Option<[f64; 2]> {
        let u = self.normalised(pixel);
        if u[0].hypot(u[1]) > self.limit {
            return None;
        }
        let d = self.bend(u);
        let p = [d[0] * self.focal[0] + self.centre[0], d[1] * self.focal[1] + self.centre[1]];
        (p[0].is_finite() && p[1].is_finite()).then_some(p)
    }

    /// Pixel of the pinhole that shows what the photo as taken shows at `pixel`: the inverse of
    /// [`Lens::distort`]; `None` where the lens cannot be undone.
    pub fn undistort(&self, pixel: [f64; 2]) -> Option<[f64; 2]> {
        let d = self.normalised(pixel);
        let wanted = d[0].hypot(d[1]);
        // The radial part alone by bisection: it grows up to the limit, so this cannot go astray.
        let (mut low, mut high) = (0.0, self.limit);
        for _ in 0..64 {
            let middle = 0.5 * (low + high);
            if self.grow(middle) < wanted { low = middle } else { high = middle }
        }
        let mut u = if wanted > 0.0 { [d[0] / wanted * low, d[1] / wanted * low] } else { [0.0; 2] };
        // Then Newton for the tangential and prism terms.
        for _ in 0..20 {
            let b = self.bend(u);
            let error = [b[0] - d[0], b[1] - d[1]];
            if error[0].hypot(error[1]) < 1e-13 {
                break;
            }
            let h = 1e-6 * (1.0 + u[0].hypot(u[1]));
            let along = |e: [f64; 2]| {
                let (a, b) = (self.bend([u[0] + e[0], u[1] + e[1]]), self.bend([u[0] - e[0], u[1] - e[1]]));
                [(a[0] - b[0]) / (2.0 * h), (a[1] - b[1]) / (2.0 * h)]
            };
            let (jx, jy) = (along([h, 0.0]), along([0.0, h]));
            let det = jx[0] * jy[1] - jy[0] * jx[1];
            if det.is_nan() || det.abs() < 1e-12 {
                break;
            }
            u[0] -= (jy[1] * error[0] - jy[0] * error[1]) / det;
            u[1] -= (jx[0] * error[1] - jx[1] * error[0]) / det;
        }
        let b = self.bend(u);
        let close = (b[0] - d[0]).hypot(b[1] - d[1]) < 1e-8;
        (close && u[0].hypot(u[1]) <= self.limit)
            .then(|| [u[0] * self.focal[0] + self.centre[0], u[1] * self.focal[1] + self.centre[1]])
    }

    fn normalised(&self, pixel: [f64; 2]) -> [f64; 2] {
        [(pixel[0] - self.centre[0]) / self.focal[0], (pixel[1] - self.centre[1]) / self.focal[1]]
    }

    /// Factor of the radial polynomials at a squared radius.
    fn polynomial(&self, r2: f64) -> f64 {
        let [k1, k2, k3, k4] = self.radial;
        let [d1, d2, d3] = self.rational;
        (1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))) / (1.0 + r2 * (d1 + r2 * (d2 + r2 * d3)))
    }

    /// Radius after the projection, before the polynomials.
    fn project(&self, r: f64) -> f64 {
        match self.projection {
            Projection::Perspective => r,
            Projection::Fisheye => r.atan(),
            // As omega goes to 0 the model becomes the pinhole.
            Projection::Fov(omega) if omega.abs() < 1e-6 => r,
            Projection::Fov(omega) => (2.0 * r * (0.5 * omega).tan()).atan() / omega,
            Projection::Division(k) => 2.0 * r / (1.0 + (1.0 - 4.0 * k * r * r).sqrt()),
        }
    }

    /// Distorted radius of an undistorted one, without the tangential and prism terms.
    fn grow(&self, r: f64) -> f64 {
        let q = self.project(r);
        q * self.polynomial(q * q)
    }

    /// Undistorted to distorted, both in units of the focal length (COLMAP's camera models).
    fn bend(&self, u: [f64; 2]) -> [f64; 2] {
        let r = u[0].hypot(u[1]);
        let factor = if r > 1e-9 { self.project(r) / r } else { 1.0 };
        let [x, y] = [u[0] * factor, u[1] * factor];
        let r2 = x * x + y * y;
        let k = self.polynomial(r2);
        let [p1, p2] = self.tangential;
        [
            x * k + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + self.prism[0] * r2,
            y * k + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y) + self.prism[1] * r2,
        ]
    }

    /// The radius where the distorted radius stops growing: beyond it the polynomials fold the image over.
    fn find_limit(&self) -> f64 {
        let radius = |step: u32| (f64::from(step) * 0.1).to_radians().tan();
        let steps = (WIDEST * 10.0) as u32;
        let mut before = 0.0;
        for step in 1..=steps {
            let now = self.grow(radius(step));
            if now.is_nan() || now <= before {
                return radius(step - 1);
            }
            before = now;
        }
        radius(steps)
    }
}
