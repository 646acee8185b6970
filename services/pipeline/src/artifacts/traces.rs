//! The timelines of the processes that worked on a run, as files: who did what when.

use super::folder::EARLIER;
use crate::{RunError, RunFolder};
use segwild_flow::{FileError, Report, SpanKind, TimelineSpan, trace};
use segwild_poses::PoseSpan;
use std::path::Path;
use std::time::Instant;

/// Files of the last process.
const FILES: [&str; 3] = ["timeline.json", "trace.json", "trace.otlp.json"];
/// How many earlier timelines are kept.
const KEPT: usize = 30;

/// A process's timeline while it grows.
pub(crate) struct Traces<'a> {
    folder: &'a RunFolder,
    /// Start of the timeline: of the poses, where this process computed them, else of the actors.
    began: Instant,
    /// Start of the actors.
    actors: Instant,
}

impl<'a> Traces<'a> {
    /// Starts a timeline and moves that of the process before aside: a second run has little to show, and an operator
    /// may still want the first one a week later.
    pub fn start(folder: &'a RunFolder, poses: &[PoseSpan]) -> Result<Traces<'a>, RunError> {
        let earlier = folder.path().join(EARLIER);
        std::fs::create_dir_all(&earlier).map_err(|e| FileError::new("create", &earlier, e))?;
        if let Some(when) = modified(&folder.path().join(FILES[0])) {
            for name in FILES {
                // One that is not there was never written.
                let _ = std::fs::rename(folder.path().join(name), earlier.join(format!("{when}.{name}")));
            }
        }
        forget_oldest(&earlier);
        let actors = Instant::now();
        let began = poses.first().map_or(actors, |span| span.start);
        Ok(Traces { folder, began, actors })
    }

    /// Adds the computation of poses, which was before the actors, to their timeline.
    pub fn add_poses(&self, report: &mut Report, poses: &[PoseSpan]) {
        let earlier = self.actors.duration_since(self.began).as_secs_f64();
        let timeline = &mut report.timeline;
        timeline.began -= earlier;
        for span in &mut timeline.spans {
            span.start += earlier;
            span.end += earlier;
        }
        let at = |when: Instant| when.duration_since(self.began).as_secs_f64();
        let of = |span: &PoseSpan| TimelineSpan {
            actor: "poses".into(),
            worker: 0,
            label: span.step.name().into(),
            start: at(span.start),
            end: at(span.end),
            kind: SpanKind::Busy,
        };
        timeline.spans.splice(0..0, poses.iter().map(of));
    }

    /// Does some work after the actors have ended, and adds it to the timeline.
    pub fn step<T>(&self, report: &mut Report, label: &str, work: impl FnOnce() -> T) -> T {
        let start = self.began.elapsed().as_secs_f64();
        let done = work();
        let end = self.began.elapsed().as_secs_f64();
        let (actor, label) = ("coordinator".into(), label.into());
        report.timeline.spans.push(TimelineSpan {
            actor,
            worker: 0,
            label,
            start,
            end,
            kind: SpanKind::Busy,
        });
        done
    }

    /// Writes the timeline as it is now.
    pub fn write(&self, report: &Report) -> Result<(), RunError> {
        let run = self.folder.path().file_name().map_or("run".into(), |n| n.to_string_lossy());
        // One after another: with a thousand photos each is some MiB of text.
        self.folder.write(FILES[0], &serde_json::to_vec(report).unwrap_or_default())?;
        self.folder.write(FILES[1], trace::chrome(report, &run).as_bytes())?;
        self.folder.write(FILES[2], trace::otlp(report, &run).as_bytes())
    }
}

/// Writes the timeline of a selection, for Perfetto.
pub(crate) fn of_selection(folder: &RunFolder, name: &str, report: &Report) -> Result<(), RunError> {
    let earlier = folder.path().join(EARLIER);
    std::fs::create_dir_all(&earlier).map_err(|e| FileError::new("create", &earlier, e))?;
    folder.write(&format!("{EARLIER}/selection-{name}.trace.json"), trace::chrome(report, name).as_bytes())
}

/// When a file was last changed, in milliseconds since 1970: so names sort by age.
fn modified(file: &Path) -> Option<u128> {
    let time = std::fs::metadata(file).ok()?.modified().ok()?;
    Some(time.duration_since(std::time::UNIX_EPOCH).ok()?.as_millis())
}

fn forget_oldest(folder: &Path) {
    let files = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path());
    let mut aged: Vec<_> = files.map(|file| (modified(&file), file)).collect();
    aged.sort();
    for (_, file) in aged.iter().rev().skip(KEPT * FILES.len()) {
        // It stays a little longer.
        let _ = std::fs::remove_file(file);
    }
}
