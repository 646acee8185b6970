//! Videos of rendered frames, by ffmpeg.

use super::splat_files::absolute;
use crate::RunError;
use segwild_flow::{ProgramRunner, Stopper};
use segwild_poses::Ffmpeg;
use std::path::Path;

/// Frames in a second, unless a request says otherwise.
pub const FRAMES_PER_SECOND: u32 = 30;

/// Even sizes, which the encoder needs, and the matrix that players of videos of this size expect.
const FILTERS: &str = "crop=trunc(iw/2)*2:trunc(ih/2)*2,scale=out_color_matrix=bt709:out_range=tv";

/// Whether a path is that of a video.
pub(crate) fn is_video(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("mp4"))
}

/// Endings of images and of videos that are not written: a folder of such a name would be a surprise.
const OTHERS: [&str; 13] =
    ["avi", "avif", "bmp", "gif", "jpeg", "jpg", "m4v", "mkv", "mov", "png", "tiff", "webm", "webp"];

/// Whether a path is that of an image, or of a video that is not written.
pub(crate) fn is_other(path: &Path) -> bool {
    let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase());
    ending.is_some_and(|ending| OTHERS.contains(&ending.as_str()))
}

/// The ffmpeg that encodes.
///
/// # Errors
/// When there is none.
pub(crate) fn encoder() -> Result<Ffmpeg, RunError> {
    Ffmpeg::find().ok_or_else(|| RunError::NoProgram {
        purpose: "videos are written by ffmpeg".into(),
        program: "ffmpeg",
        install: "apt-get install ffmpeg",
    })
}

/// Encodes the frames `FRAMES/path-0000.png` and on as a video.
///
/// # Errors
/// When ffmpeg fails, or `stopper` stops it.
pub(crate) fn encode(
    ffmpeg: &Ffmpeg,
    frames: &Path,
    rate: u32,
    out: &Path,
    stopper: &Stopper,
) -> Result<(), RunError> {
    // A percent sign in the folder's name is no number's.
    let pattern = format!("{}/path-%04d.png", absolute(frames).replace('%', "%%"));
    let (rate, out) = (rate.to_string(), absolute(out));
    let head = ["-hide_banner", "-nostdin", "-nostats", "-loglevel", "error", "-framerate", &rate];
    let input = ["-f", "image2", "-i", &pattern, "-vf", FILTERS, "-pix_fmt", "yuv420p"];
    let colours = ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"];
    // The index at the start: a browser shows the video while it loads.
    let arguments = [&head[..], &input, &colours, &["-movflags", "+faststart", &out]].concat();
    let arguments: Vec<String> = arguments.into_iter().map(str::to_owned).collect();
    Ok(ProgramRunner { log: None, stopper }.run(ffmpeg.program(), &arguments, |_| {})?)
}
