//! The timelines of the processes that worked on a run, as files: who did what when.

use super::folder::EARLIER;
use crate::{RunError, RunFolder};
use segwild_flow::{FileError, Report, SpanKind, TimelineSpan, files, trace};
use segwild_poses::PoseSpan;
use std::fs::File;
use std::io::{self, BufWriter, Write};
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
        // With a thousand photos each is some MiB of text.
        write_streamed(self.folder, FILES[0], |out| Ok(serde_json::to_writer(out, report)?))?;
        write_streamed(self.folder, FILES[1], |out| trace::chrome(report, &run, out))?;
        write_streamed(self.folder, FILES[2], |out| trace::otlp(report, &run, out))
    }
}

/// Writes a file of a run from what `fill` writes bit by bit.
fn write_streamed(
    folder: &RunFolder,
    name: &str,
    fill: impl FnOnce(&mut BufWriter<&mut File>) -> io::Result<()>,
) -> Result<(), RunError> {
    let path = folder.path().join(name);
    files::write_with(&path, |file| -> Result<(), FileError> {
        let mut out = BufWriter::new(file);
        fill(&mut out).and_then(|()| out.flush()).map_err(|e| FileError::new("write", &path, e))
    })?;
    Ok(())
}

/// Writes the timeline of a selection, for Perfetto.
pub(crate) fn of_selection(folder: &RunFolder, name: &str, report: &Report) -> Result<(), RunError> {
    let earlier = folder.path().join(EARLIER);
    std::fs::create_dir_all(&earlier).map_err(|e| FileError::new("create", &earlier, e))?;
    let file = format!("{EARLIER}/selection-{name}.trace.json");
    write_streamed(folder, &file, |out| trace::chrome(report, name, out))
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
