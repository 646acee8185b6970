//! The render of a view in the appearance of its photo.

use crate::TrainError;
use crate::appearances;
use crate::params::Params;
use segwild_objective::background::{Background, add_background};
use segwild_objective::{AnyAppearance, AppearanceMaps};
use segwild_raster::{Channels, Frame, Projected};
use segwild_scene::{Camera, Image, Pose};

/// A view rendered from splats in the appearance of its photo.
pub(crate) struct RenderedView {
    /// The appearance maps of the photo.
    pub light: Option<AppearanceMaps>,
    /// Colour per splat, its own and in the photo's light.
    pub colours: Vec<f32>,
    pub channels: Vec<f32>,
    pub frame: Frame,
}

/// A view's appearance and background.
#[derive(Clone, Copy)]
pub(crate) struct Painter<'a> {
    pub view: usize,
    pub appearance: &'a AnyAppearance,
    pub background: &'a Background,
}

impl Painter<'_> {
    /// Renders the view; `draw` as for [`AnyAppearance::appearance_maps`].
    pub fn render(
        &self,
        params: &Params,
        projected: &dyn Projected,
        pose: &Pose,
        draw: Option<u64>,
    ) -> Result<RenderedView, TrainError> {
        let colours = projected.shade();
        let light = self.appearance.appearance_maps(self.view, draw);
        let sight = params.sight(projected, pose);
        let channels = self.appearance.colour(self.view, light.as_ref(), &sight, colours.clone());
        let frame = projected.blend(&Channels { count: 3, values: &channels })?;
        Ok(RenderedView { light, colours, channels, frame })
    }

    /// A frame over the background, in the view's appearance: the photo's colours.
    pub fn show(&self, frame: &Frame, camera: &Camera, pose: &Pose) -> Image {
        let matrix = appearances::matrix(self.appearance, self.view);
        let background_image = appearances::background_before(self.background, &matrix).paint(camera, pose);
        let mut scene = frame.image.clone();
        add_background(&mut scene, &frame.alpha, &background_image);
        self.appearance.as_appearance().apply(self.view, &scene)
    }
}
