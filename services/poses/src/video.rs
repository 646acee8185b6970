//! The step `frames`: photos out of a video, by ffmpeg. The sharpest frames, spread evenly over the motion.

use crate::PosesError;
use segwild_flow::{ProgramError, ProgramRunner, StageProgress, find_program, program_output};
use std::path::{Path, PathBuf};

/// Width in pixels at which frames are compared.
const COMPARED: u32 = 960;
/// At most one frame of so many is taken: neighbours show the same.
const APART: usize = 3;
/// Least motion that a frame counts for, as a share of the mean: a camera that stands still gives few photos, and some.
const STILL: f64 = 0.1;
/// Most motion that a frame counts for, in means: a cut or a flash is no long way.
const CUT: f64 = 5.0;
/// Containers that are opened. Lists of other files (HLS, concat) would let a video name files and addresses of its own.
const CONTAINERS: &str = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg";

/// An ffmpeg that was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ffmpeg {
    program: PathBuf,
    /// As it names itself: `ffmpeg version 5.1.9`.
    pub version: String,
}

/// What is measured of a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct FrameMeasure {
    /// Mean difference of the brightness from the frame before, 0 to 255.
    motion: f64,
    /// Blur of its edges in pixels; infinite where it has none.
    blur: f64,
}

impl Ffmpeg {
    /// The ffmpeg on the `PATH`; `None` where there is none that answers.
    pub fn find() -> Option<Ffmpeg> {
        let program = find_program("ffmpeg")?;
        let text = program_output(&program, &["-version"]).ok()?;
        let version: Vec<&str> = text.lines().next()?.split_whitespace().take(3).collect();
        let version = version.join(" ");
        version.starts_with("ffmpeg").then_some(Ffmpeg { program, version })
    }

    /// Its file.
    pub fn program(&self) -> &Path {
        &self.program
    }

    /// Takes at most `most` photos out of a video into an empty folder.
    pub(crate) fn take_frames(
        &self,
        video: &Path,
        folder: &Path,
        most: usize,
        programs: &ProgramRunner<'_>,
        progress: &mut StageProgress,
    ) -> Result<(), PosesError> {
        let refused = |reason: String| PosesError::Video { path: video.to_owned(), reason };
        let mut frames: Vec<FrameMeasure> = Vec::new();
        let filters = format!("scale={COMPARED}:-2,signalstats,blurdetect,metadata=mode=print:file=-");
        let measured =
            programs.run(&self.program, &arguments(video, &filters, &["-f", "null", "-"]), |line| {
                if line.starts_with("frame:") {
                    frames.push(FrameMeasure { motion: 0.0, blur: f64::INFINITY });
                    progress.advance(1);
                } else if let Some(frame) = frames.last_mut() {
                    let value = |key: &str| line.strip_prefix(key).and_then(|text| text.parse::<f64>().ok());
                    frame.motion =
                        value("lavfi.signalstats.YDIF=").filter(|v| v.is_finite()).unwrap_or(frame.motion);
                    frame.blur = value("lavfi.blur=").filter(|v| *v >= 0.0).unwrap_or(frame.blur);
                }
            });
        match measured {
            Err(ProgramError::Failed { last, .. }) if frames.is_empty() => return Err(refused(last)),
            other => other?,
        }
        let chosen = choose(&frames, most);
        if chosen.is_empty() {
            return Err(refused("it has no frames".into()));
        }
        progress.next_part("frames", None);
        let select = format!("select='{}'", numbers(&chosen));
        let pattern = folder.join("frame-%05d.jpg").display().to_string();
        programs.run(&self.program, &arguments(video, &select, &["-q:v", "2", &pattern]), |_| {})?;
        Ok(())
    }
}

/// Arguments of ffmpeg for a video through filters.
fn arguments(video: &Path, filters: &str, out: &[&str]) -> Vec<String> {
    let input = format!("file:{}", video.display());
    let head =
        ["-hide_banner", "-nostdin", "-nostats", "-loglevel", "warning", "-protocol_whitelist", "file"];
    let rest = ["-format_whitelist", CONTAINERS, "-i", &input, "-map", "0:v:0", "-vf", filters];
    let end = ["-fps_mode", "passthrough"];
    [&head[..], &rest, &end, out].concat().into_iter().map(str::to_owned).collect()
}

/// The frames to take: of each stretch with the same motion the sharpest.
fn choose(frames: &[FrameMeasure], most: usize) -> Vec<usize> {
    let count = most.min(frames.len().div_ceil(APART));
    let mean = frames.iter().map(|f| f.motion).sum::<f64>() / frames.len().max(1) as f64;
    // Without any motion, all count the same.
    let counts = |f: &FrameMeasure| if mean > 0.0 { (f.motion / mean).clamp(STILL, CUT) } else { 1.0 };
    let total: f64 = frames.iter().map(counts).sum();
    let (mut chosen, mut way): (Vec<Option<usize>>, f64) = (vec![None; count], 0.0);
    for (i, frame) in frames.iter().enumerate() {
        let stretch = ((way + 0.5 * counts(frame)) / total * count as f64) as usize;
        way += counts(frame);
        let best = &mut chosen[stretch.min(count - 1)];
        if best.is_none_or(|other| frame.blur < frames[other].blur) {
            *best = Some(i);
        }
    }
    chosen.into_iter().flatten().collect()
}

/// An expression of ffmpeg that is true for these frames. It is a tree, since ffmpeg refuses a sum of a thousand terms.
fn numbers(frames: &[usize]) -> String {
    match frames {
        [] => "0".into(),
        [one] => format!("eq(n,{one})"),
        _ => {
            let (a, b) = frames.split_at(frames.len() / 2);
            format!("({}+{})", numbers(a), numbers(b))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(of: impl Fn(usize) -> (f64, f64), count: usize) -> Vec<FrameMeasure> {
        (0..count).map(|i| FrameMeasure { motion: of(i).0, blur: of(i).1 }).collect()
    }

    #[test]
    fn of_each_stretch_the_sharpest_frame_is_taken() {
        let even = frames(|i| (2.0, if i % 10 == 7 { 1.0 } else { 5.0 }), 100);
        let chosen = choose(&even, 10);
        assert_eq!(chosen, (0..10).map(|k| 10 * k + 7).collect::<Vec<_>>());
    }

    #[test]
    fn a_camera_that_stands_still_gives_few_photos() {
        let half = frames(|i| (if i < 300 { 0.0 } else { 3.0 }, 1.0), 600);
        let chosen = choose(&half, 44);
        let still = chosen.iter().filter(|&&i| i < 300).count();
        assert!(chosen.len() == 44 && (2..=4).contains(&still), "{still} of {}", chosen.len());
    }

    #[test]
    fn short_still_and_edgeless_videos_give_what_they_have() {
        assert_eq!(choose(&[], 10), [0; 0]);
        assert_eq!(choose(&frames(|_| (0.0, f64::INFINITY), 1), 10), [0]);
        assert_eq!(choose(&frames(|_| (0.0, f64::INFINITY), 30), 150).len(), 10);
        let flash = frames(|i| (if i == 50 { 255.0 } else { 1.0 }, 1.0), 100);
        let largest = choose(&flash, 20).windows(2).map(|two| two[1] - two[0]).max();
        assert!(largest < Some(12), "{largest:?}");
    }

    #[test]
    fn the_expression_of_many_frames_is_no_deep_sum() {
        let text = numbers(&(0..2000).collect::<Vec<_>>());
        let (mut depth, mut deepest) = (0, 0);
        for c in text.replace("eq(", "").chars() {
            match c {
                '(' => depth += 1,
                ')' => depth -= 1,
                _ => {}
            }
            deepest = deepest.max(depth);
        }
        assert!(deepest < 15 && text.matches("eq(").count() == 2000, "{deepest}");
        assert_eq!(numbers(&[3, 8]), "(eq(n,3)+eq(n,8))");
    }
}
