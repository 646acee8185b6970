//! Whether the disk of a worker has space for a further scene.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use segwild_flow::files::Obstacle;
use segwild_flow::shortage::free_disk_bytes;

/// On a disk with less than this even the words of an error may be missing.
const NOTHING_LEFT: u64 = 1 << 20;
/// What was free after a scene has filled the disk is not enough. So much more may be.
const LEAST_MORE: u64 = 64 << 20;
/// A worker whose disk was filled tries a further scene after so long: at first, and at most.
const RESTS: [Duration; 2] = [Duration::from_secs(300), Duration::from_secs(3600)];

/// Decides whether a worker takes a further scene, by its disk: not where less than a bound is free, and, after a scene has
/// filled the disk, not before there is more space than that scene left, or a rest is over.
pub(crate) struct DiskGate {
    folder: PathBuf,
    /// The folder as processes may name it that follow links.
    resolved: Option<PathBuf>,
    least_bytes: u64,
    filled: Option<FilledDisk>,
    /// How often the disk was filled since a scene was done.
    times: u32,
}

/// Why a worker takes no scene for now.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct DiskPause {
    /// Whether a scene has filled the disk; otherwise less is free than is to be.
    is_filled: bool,
    /// The reason, with what to do.
    pub words: String,
}

impl DiskPause {
    /// Whether another one has the same reason. How much is free changes all the time, and is none.
    pub fn has_reason_of(&self, other: &DiskPause) -> bool {
        self.is_filled == other.is_filled && (!self.is_filled || self.words == other.words)
    }
}

/// A disk that a scene has filled.
struct FilledDisk {
    at: Instant,
    rest: Duration,
    enough_bytes: u64,
}

impl DiskGate {
    /// For the disk of a folder, of which so much is to be free.
    pub fn new(folder: PathBuf, least_bytes: u64) -> Self {
        let resolved = std::fs::canonicalize(&folder).ok();
        Self { folder, resolved, least_bytes, filled: None, times: 0 }
    }

    /// Whether the disk is at fault for a failure, by its words. A process on a full disk may not have been able to write any.
    pub fn refused(&self, words: &str) -> bool {
        self.is_named_by(words) || self.free().is_some_and(|free| free < NOTHING_LEFT)
    }

    /// The words of such a failure, for who reads them on another machine.
    pub fn words(&self, worker: &str, words: &str) -> String {
        match self.is_named_by(words) {
            true => format!("on {worker}: {words}"),
            false => {
                let folder = self.folder.display();
                format!("on {worker}: the disk of {folder} is full; free some space there ({words})")
            }
        }
    }

    /// A scene has filled the disk, and what it left is removed.
    pub fn fill(&mut self) {
        self.fill_at(self.free(), Instant::now());
    }

    fn fill_at(&mut self, free: Option<u64>, now: Instant) {
        let enough_bytes = free.map_or(u64::MAX, |free| free.saturating_add(LEAST_MORE.max(free / 4)));
        if let Some(filled) = &mut self.filled {
            // The scenes of a machine end one after the other on the same full disk.
            filled.enough_bytes = enough_bytes;
            return;
        }
        let rest = (RESTS[0] * 2u32.pow(self.times.min(8))).min(RESTS[1]);
        self.times = self.times.saturating_add(1);
        self.filled = Some(FilledDisk { at: now, rest, enough_bytes });
    }

    /// A scene is done: the next one that fills the disk is the first again.
    pub fn done(&mut self) {
        self.times = 0;
    }

    /// Why no scene is taken now; `None` where there is space.
    pub fn closed(&mut self) -> Option<DiskPause> {
        self.closed_at(self.free(), Instant::now())
    }

    fn closed_at(&mut self, free: Option<u64>, now: Instant) -> Option<DiskPause> {
        let folder = self.folder.display();
        let mend = "free some space there, or give --work a folder on another disk";
        if let Some(free) = free.filter(|free| *free < self.least_bytes) {
            let (free, least) = (size(free), size(self.least_bytes));
            let words = format!("the disk of {folder} has {free} free, less than {least}: {mend}");
            return Some(DiskPause { is_filled: false, words });
        }
        let filled = self.filled.as_ref()?;
        let is_enough = free.is_some_and(|free| free >= filled.enough_bytes);
        if is_enough || now.duration_since(filled.at) >= filled.rest {
            self.filled = None;
            return None;
        }
        let minutes = filled.rest.as_secs() / 60;
        let until = match filled.enough_bytes {
            u64::MAX => format!("{minutes} min later"),
            enough => format!("once {} are free, or {minutes} min later", size(enough)),
        };
        let words = format!("a scene filled the disk of {folder}: {mend}; the next is tried {until}");
        Some(DiskPause { is_filled: true, words })
    }

    fn free(&self) -> Option<u64> {
        free_disk_bytes(&self.folder)
    }

    /// Whether an error is about a file in the folder that its disk does not take. Other disks may be full as well, such as that
    /// of the system's folder for temporary files: that is not mended by space here.
    fn is_named_by(&self, words: &str) -> bool {
        let sentences = [Obstacle::FULL, Obstacle::READ_ONLY];
        let end = sentences.iter().filter_map(|sentence| words.find(sentence)).max();
        let folders = || [Some(&self.folder), self.resolved.as_ref()].into_iter().flatten();
        end.is_some_and(|end| folders().any(|folder| names_file_in(&words[..end], folder)))
    }
}

/// Whether words have the path of something in a folder.
fn names_file_in(words: &str, folder: &Path) -> bool {
    let start = format!("{}/", folder.display().to_string().trim_end_matches('/'));
    let starts_path =
        |before: &str| before.chars().next_back().is_none_or(|c| !c.is_alphanumeric() && c != '/');
    words.match_indices(&start).any(|(at, _)| starts_path(&words[..at]))
}

fn size(bytes: u64) -> String {
    let mib = bytes as f64 / f64::from(1 << 20);
    if mib < 1000.0 { format!("{mib:.0} MiB") } else { format!("{:.1} GiB", mib / 1024.0) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_flow::{FileError, LedgerError};
    use std::io::ErrorKind;

    const MIB: u64 = 1 << 20;

    #[test]
    fn less_than_the_bound_is_no_space_and_more_is() {
        let mut gate = DiskGate::new("/work".into(), 1000 * MIB);
        let now = Instant::now();
        let pause = gate.closed_at(Some(10 * MIB), now).expect("it is too little");
        let reason = &pause.words;
        assert!(reason.contains("/work has 10 MiB free") && reason.contains("--work"), "{reason}");
        // A log with a line for each MiB would be long.
        assert!(gate.closed_at(Some(9 * MIB), now).is_some_and(|other| other.has_reason_of(&pause)));
        gate.fill_at(Some(2000 * MIB), now);
        let filled = gate.closed_at(Some(2000 * MIB), now).expect("a scene has filled it");
        assert!(!filled.has_reason_of(&pause) && filled.has_reason_of(&filled.clone()), "{filled:?}");
        gate.filled = None;
        assert_eq!(gate.closed_at(Some(1000 * MIB), now), None);
        assert_eq!(gate.closed_at(None, now), None, "where the system does not report it");
    }

    #[test]
    fn a_disk_that_was_filled_is_tried_with_more_space_or_after_a_rest_that_grows() {
        let mut gate = DiskGate::new("/work".into(), 0);
        let began = Instant::now();
        let after = |seconds: u64| began + Duration::from_secs(seconds);
        gate.fill_at(Some(400 * MIB), began);
        let reason = gate.closed_at(Some(400 * MIB), after(1)).expect("that was not enough").words;
        assert!(reason.contains("/work") && reason.contains("500 MiB"), "{reason}");
        assert!(gate.closed_at(Some(499 * MIB), after(1)).is_some());
        // Another scene ends on the same full disk: no second rest, and what is free is more now.
        gate.fill_at(Some(800 * MIB), after(2));
        assert_eq!(gate.times, 1);
        assert!(gate.closed_at(Some(999 * MIB), after(3)).is_some());
        assert_eq!(gate.closed_at(Some(1000 * MIB), after(3)), None);
        assert_eq!(gate.closed_at(Some(0), after(1)), None, "it has forgotten");
        // Again, and again: 10 minutes, 20, at most an hour.
        for (times, rest) in [(2, 600), (3, 1200), (4, 2400), (5, 3600), (90, 3600)] {
            gate.times = times - 1;
            gate.fill_at(Some(0), began);
            assert!(gate.closed_at(Some(63 * MIB), after(rest - 1)).is_some(), "{times}");
            assert_eq!(gate.closed_at(Some(63 * MIB), after(rest)), None, "{times}");
        }
        gate.done();
        gate.fill_at(None, began);
        assert!(gate.closed_at(None, after(299)).is_some());
        assert_eq!(gate.closed_at(None, after(300)), None);
    }

    #[test]
    fn errors_of_a_full_and_of_a_read_only_disk_are_known_by_their_sentences() {
        let gate = DiskGate::new("/work".into(), 0);
        for kind in [ErrorKind::StorageFull, ErrorKind::QuotaExceeded, ErrorKind::ReadOnlyFilesystem] {
            let error = FileError::new("write", Path::new("/work/a"), kind.into()).to_string();
            assert!(gate.is_named_by(&error), "{error}");
            assert_eq!(gate.words("w", &error), format!("on w: {error}"));
        }
        let error = LedgerError::DiskFull { path: "/work/run.sqlite".into() }.to_string();
        assert!(gate.is_named_by(&error), "{error}");
        let other = FileError::new("read", Path::new("/work/a"), ErrorKind::NotFound.into()).to_string();
        assert!(!gate.is_named_by(&other), "{other}");
        // What is full there is another disk.
        for path in ["/tmp/.segwild-manifest.1.2", "/workshop/a", "/mnt/work/a", "/work"] {
            let error = FileError::new("write", Path::new(path), ErrorKind::StorageFull.into()).to_string();
            assert!(!gate.is_named_by(&error), "{error}");
        }
        let words = gate.words("w", "exit code 6");
        assert!(words.starts_with("on w: the disk of ") && words.ends_with("(exit code 6)"), "{words}");
    }
}
