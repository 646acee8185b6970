//! Views of splats that come without photos: rendered from cameras around them, and written as a scene that a run opens like any
//! other.

mod hull;

use crate::{RunError, RunFolder, Settings, choose_engine, log_loss};
use glam::{DMat4, DVec3, Mat3, Vec3};
use hull::SplatExtent;
use segwild_flow::files::{self, FileError};
use segwild_raster::{Channels, ProjectOptions, Rasterizer};
use segwild_scene::ply::SH0;
use segwild_scene::{
    Alpha, HoldOut, Pose, RENDERED_VIEWS, ReadSplats, RenderedViews, SceneError, SceneFrame, SplatFile,
    Splats, UpAxis, write_rgba,
};
use segwild_trainer::AppearanceModel;
use serde_json::json;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// The folder of the views in the run folder.
const VIEWS: &str = "views";
/// Raised when the same splats are rendered in another way.
const RULE: u32 = 2;
/// Height of a view as a share of its width.
const ASPECT: f32 = 0.75;
/// Splats that are written as points, at most.
const POINTS: usize = 20_000;
/// Opacity from which a splat is written as a point.
const OPAQUE: f32 = 0.5;

/// Renders views of splats into the run folder, and sets what follows for the run: no photo is held out, all have one appearance
/// and no transients. Returns the scene's folder; views that are there already stay.
///
/// # Errors
/// When the splats cannot be read or rendered, or the disk fails.
pub fn render_views(
    file: &SplatFile,
    folder: &RunFolder,
    settings: &mut Settings,
) -> Result<PathBuf, RunError> {
    settings.scene.hold_out = HoldOut::None;
    settings.scene.alpha = Alpha::Empty;
    settings.train.appearance_model = AppearanceModel::None;
    settings.train.robust = false;
    let views = folder.path().join(VIEWS);
    // What they were rendered from.
    let record_file = format!("{VIEWS}/{RENDERED_VIEWS}");
    let record = RenderedViews { rule: RULE, splats: file.digest()?, size: settings.scene.size };
    if folder.read_json::<RenderedViews>(&record_file).is_ok_and(|before| before == record) {
        return Ok(views);
    }
    let ReadSplats { splats, .. } = file.read()?;
    let up = Vec3::from(file.writer.up.unwrap_or(UpAxis::MinusY).direction());
    let own = SplatExtent::of(&splats);
    let frame = SceneFrame { origin: own.centre.as_dvec3(), scale: f64::from(own.outer) };
    let placed = splats.from_file_frame(&frame);
    let engine = choose_engine(&settings.run, log_loss)?.engine;
    let poses = hull::poses(&*engine, &placed, &SplatExtent::of(&placed), up)?;
    let images = views.join("images");
    std::fs::create_dir_all(&images).map_err(|e| FileError::new("create", &images, e))?;
    let camera = hull::camera(settings.scene.size, (ASPECT * settings.scene.size as f32).round() as u32);
    let options =
        ProjectOptions { antialias: file.writer.antialias.unwrap_or(false), ..ProjectOptions::default() };
    let resident = engine.upload_splats(&placed).map_err(hull::raster)?;
    let renderer: &dyn Rasterizer = resident.as_deref().unwrap_or(&*engine);
    let mut frames = Vec::new();
    for (i, pose) in poses.iter().enumerate() {
        let projected = renderer.project(&placed, &camera, pose, &options).map_err(hull::raster)?;
        let colours = projected.shade();
        let render = projected.blend(&Channels { count: 3, values: &colours }).map_err(hull::raster)?;
        let name = format!("images/{i:03}.png");
        write_rgba(&views.join(&name), &render.image, &render.alpha)?;
        frames.push(json!({ "file_path": name, "transform_matrix": camera_to_world(pose, &frame) }));
    }
    write_points(&views.join("points.ply"), &splats)?;
    let transforms = json!({
        "camera_model": "PINHOLE",
        "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "w": camera.width, "h": camera.height,
        "ply_file_path": "points.ply",
        "frames": frames,
    });
    files::write_atomic(&views.join("transforms.json"), transforms.to_string().as_bytes())?;
    folder.write_json(&record_file, &record)?;
    Ok(views)
}

/// A pose in the axes of `transforms.json`: the camera's y up and z back.
fn camera_to_world(pose: &Pose, frame: &SceneFrame) -> [[f64; 4]; 4] {
    let axes = pose.rotation.transpose() * Mat3::from_diagonal(Vec3::new(1.0, -1.0, -1.0));
    let centre: DVec3 = pose.centre().as_dvec3() * frame.scale + frame.origin;
    let columns = [axes.x_axis, axes.y_axis, axes.z_axis].map(|axis| axis.as_dvec3().extend(0.0));
    DMat4::from_cols(columns[0], columns[1], columns[2], centre.extend(1.0)).transpose().to_cols_array_2d()
}

/// Writes opaque splats as coloured points.
fn write_points(path: &Path, splats: &Splats) -> Result<(), SceneError> {
    let opaque: Vec<usize> = (0..splats.len()).filter(|&i| splats.opacity(i) > OPAQUE).collect();
    let every = opaque.len().div_ceil(POINTS).max(1);
    let chosen: Vec<usize> = opaque.into_iter().step_by(every).collect();
    let properties = "property float x\nproperty float y\nproperty float z\n\
                      property uchar red\nproperty uchar green\nproperty uchar blue";
    let count = chosen.len();
    let mut text = format!("ply\nformat ascii 1.0\nelement vertex {count}\n{properties}\nend_header\n");
    let stride = splats.sh_stride();
    for i in chosen {
        let [x, y, z] = splats.means[i];
        let [r, g, b] = [0, 1, 2]
            .map(|c| (255.0 * (splats.sh[i * stride + c] * SH0 + 0.5)).round().clamp(0.0, 255.0) as u8);
        let _ = writeln!(text, "{x} {y} {z} {r} {g} {b}");
    }
    Ok(files::write_atomic(path, text.as_bytes())?)
}
