//! The interface of a rasteriser.

use segwild_scene::{Camera, Image, Pose, Splats};
use std::any::Any;
use std::borrow::Cow;

/// Why a rasteriser refused.
#[derive(Debug, thiserror::Error)]
pub enum RasterError {
    /// Arrays of the splats differ in length, or the frame has no pixel.
    #[error("{0}")]
    Shape(String),
    /// The device that renders refused or failed.
    #[error("{0}; what was computed is kept: run again, or with --engine cpu")]
    Device(String),
}

/// Largest width or height of a frame: tiles are counted in 16 bits.
const MAX_SIDE: u32 = 1 << 19;

/// Refuses splats and cameras that no engine can render.
pub fn check(splats: &Splats, camera: &Camera) -> Result<(), RasterError> {
    let n = splats.len();
    let lengths = [
        ("log_scales", splats.log_scales.len(), n),
        ("rotations", splats.rotations.len(), n),
        ("opacities", splats.opacities.len(), n),
        ("sh", splats.sh.len(), n * splats.sh_stride()),
    ];
    for (name, len, wanted) in lengths {
        if len != wanted {
            let text = format!("splats: {name} has {len} items where {n} splats need {wanted}");
            return Err(RasterError::Shape(text));
        }
    }
    if splats.sh_degree > 3 {
        return Err(RasterError::Shape(format!("splats: SH degree {} is above 3", splats.sh_degree)));
    }
    if n > u32::MAX as usize {
        return Err(RasterError::Shape(format!("splats: {n} are more than can be numbered")));
    }
    let Camera { width, height, fx, fy, cx, cy } = *camera;
    if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
        return Err(RasterError::Shape(format!(
            "camera: a frame of {width} x {height} pixels cannot be rendered"
        )));
    }
    let focal = |f: f32| f.is_finite() && f > 0.0;
    if !focal(fx) || !focal(fy) || !cx.is_finite() || !cy.is_finite() {
        let text = format!("camera: focal lengths {fx}, {fy} and principal point {cx}, {cy} make no image");
        return Err(RasterError::Shape(text));
    }
    Ok(())
}

/// How splats are projected.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProjectOptions {
    /// Variance in px² added to the diagonal of the projected covariance (0.3 is the paper's low-pass).
    pub low_pass: f32,
    /// Lower the opacity by what the low-pass widened, so that thin splats do not grow brighter.
    pub antialias: bool,
    /// Splats nearer than this are culled; in scene units.
    pub near: f32,
    /// Range of x/z (first two) and of y/z in which the Jacobian follows the perspective; `None` for that of the camera
    /// ([`jacobian_limits`](crate::jacobian_limits)). In a cut-out of a photo splats look as in the photo by the photo's limits.
    pub jacobian_limits: Option<[f32; 4]>,
}

impl Default for ProjectOptions {
    fn default() -> Self {
        ProjectOptions { low_pass: 0.3, antialias: false, near: segwild_scene::NEAR, jacobian_limits: None }
    }
}

/// Values to blend: `count` numbers per splat.
#[derive(Clone, Copy, Debug)]
pub struct Channels<'a> {
    /// Numbers per splat: 3 for colours, 16/32/64/128 for features, 1 for depth or an indicator; any count.
    pub count: usize,
    /// `[splat][channel]`, flat; length `splats * count`.
    pub values: &'a [f32],
}

/// Output of a forward pass.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Sum over splats of `alpha T value`; one plane per channel. No background is added.
    pub image: Image,
    /// Accumulated alpha `A = sum of alpha T`, one plane.
    pub alpha: Image,
}

/// Loss gradients that enter a backward pass.
#[derive(Clone, Copy, Debug)]
pub struct FrameGrad<'a> {
    /// With respect to [`Frame::image`].
    pub image: &'a Image,
    /// With respect to [`Frame::alpha`].
    pub alpha: Option<&'a Image>,
}

/// Loss gradients that leave a backward pass, per splat.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SplatGrads {
    /// Centres.
    pub means: Vec<[f32; 3]>,
    /// Log scales.
    pub log_scales: Vec<[f32; 3]>,
    /// Rotations, of the unnormalised quaternion.
    pub rotations: Vec<[f32; 4]>,
    /// Opacity logits.
    pub opacities: Vec<f32>,
    /// Blended values, `[splat][channel]`.
    pub values: Vec<f32>,
    /// Norm of the gradient of the 2D centre, in units of half the frame (what density control thresholds).
    pub screen: Vec<f32>,
    /// The same with the absolute values summed over pixels (the absolute-gradient variant).
    pub screen_abs: Vec<f32>,
}

/// A splat rasteriser. Implementations bear one name with their kernels' twins.
pub trait Rasterizer: Send + Sync {
    /// Name for logs and cache keys.
    fn name(&self) -> &'static str;

    /// Whether it computes on the host alone. Several threads may then work on a view each, which is quicker than all on one
    /// view; threads that wait for a device would only wait for each other.
    fn is_on_host(&self) -> bool {
        false
    }

    /// Bytes of memory on the host that it keeps from view to view. Those of views that are in use do not count.
    fn kept_bytes(&self) -> usize {
        0
    }

    /// Projects, culls, bins and sorts the splats for one view.
    fn project<'a>(
        &'a self,
        splats: &'a Splats,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
    ) -> Result<Box<dyn Projected + 'a>, RasterError>;

    /// Uploads splats once, for many views of them. Returns a rasteriser of the same device, which projects these splats
    /// without another upload; `None` where this one computes on the host, or where they do not fit.
    fn upload_splats<'a>(
        &'a self,
        _splats: &'a Splats,
    ) -> Result<Option<Box<dyn Rasterizer + 'a>>, RasterError> {
        Ok(None)
    }

    /// Whether [`Rasterizer::upload_channels`] is expected to keep `count` channels of so many splats: they may first have to be
    /// brought into the form that it takes.
    fn keeps_channels(&self, _splats: usize, _count: usize) -> bool {
        false
    }

    /// Uploads channels, for [`ResidentChannels::upload`]. Returns a handle, opaque to others, that keeps them on the
    /// device until it is dropped; `None` where this rasteriser computes on the host, or where they would take too much memory.
    fn upload_channels(
        &self,
        _channels: &Channels,
    ) -> Result<Option<Box<dyn Any + Send + Sync>>, RasterError> {
        Ok(None)
    }
}

/// Channels that stay on the device of an engine once they are uploaded, to be blended in view after view by
/// [`Projected::blend_resident`]. The numbers on the host cannot change meanwhile, so the device's copy cannot be out of
/// date. An engine without a copy of its own uses the host's numbers.
pub struct ResidentChannels<'a> {
    count: usize,
    values: Cow<'a, [f32]>,
    on_device: Option<Box<dyn Any + Send + Sync>>,
}

impl<'a> ResidentChannels<'a> {
    /// `count` numbers per splat, as in [`Channels`], not uploaded yet.
    pub fn new(count: usize, values: impl Into<Cow<'a, [f32]>>) -> ResidentChannels<'a> {
        ResidentChannels { count, values: values.into(), on_device: None }
    }

    /// Uploads them to the device of an engine, if it has one.
    pub fn upload(&mut self, engine: &dyn Rasterizer) -> Result<(), RasterError> {
        self.on_device = engine.upload_channels(&self.on_host())?;
        Ok(())
    }

    /// The numbers on the host.
    pub fn on_host(&self) -> Channels<'_> {
        Channels { count: self.count, values: &self.values }
    }

    /// Handle that [`Rasterizer::upload_channels`] returned.
    pub fn on_device(&self) -> Option<&(dyn Any + Send + Sync)> {
        self.on_device.as_deref()
    }
}

/// Splats as one view sees them, ready to blend any channel set. What a device computes fails where the device does;
/// images and channels of another size than the view's are a caller's mistake and panic.
pub trait Projected: Send + Sync {
    /// Depth along the optical axis per splat, in scene units; also of culled splats.
    fn depths(&self) -> &[f32];

    /// Radius in pixels within which a splat can reach alpha 1/255; 0 for a culled splat.
    fn radii(&self) -> &[f32];

    /// Pixel position of each centre; meaningless for splats behind the camera.
    fn centres(&self) -> &[[f32; 2]];

    /// Colour per splat towards this camera from its spherical harmonics, `[splat][r, g, b]`, clamped at 0;
    /// 0 for culled splats.
    fn shade(&self) -> Vec<f32>;

    /// Blends front to back.
    fn blend(&self, channels: &Channels) -> Result<Frame, RasterError>;

    /// The same with channels that may be on the device.
    fn blend_resident(&self, channels: &ResidentChannels) -> Result<Frame, RasterError> {
        self.blend(&channels.on_host())
    }

    /// The transpose of [`Projected::blend`]: `sum over pixels of alpha T image[c]`, as `[splat][channel]`.
    /// Lifting, coverage and contribution are this sum over images of targets, masks and ones.
    fn gather(&self, image: &Image) -> Result<Vec<f32>, RasterError>;

    /// The view on its device, opaque to others: a device knows its own. `None` where it is on the host.
    fn on_device(&self) -> Option<&(dyn Any + Send + Sync)> {
        None
    }

    /// Gradients of every parameter for a frame that [`Projected::blend`] made from the same channels.
    fn backward(
        &self,
        channels: &Channels,
        frame: &Frame,
        grad: &FrameGrad,
    ) -> Result<SplatGrads, RasterError>;

    /// Carries the gradient of [`Projected::shade`]'s colours back to the SH coefficients (returned, laid out
    /// as [`Splats::sh`]) and, through the view direction, to `grads.means`.
    fn shade_backward(&self, colours: &[f32], grads: &mut SplatGrads) -> Vec<f32>;
}
