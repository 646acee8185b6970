//! Whether the disk of a worker has space for a further scene.

use std::path::PathBuf;
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
    least_bytes: u64,
    filled: Option<FilledDisk>,
    /// How often the disk was filled since a scene was done.
    times: u32,
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
        Self { folder, least_bytes, filled: None, times: 0 }
    }

    /// Whether the disk is at fault for a failure, by its words. A process on a full disk may not have been able to write any.
    pub fn refused(&self, words: &str) -> bool {
        names_disk(words) || self.free().is_some_and(|free| free < NOTHING_LEFT)
    }

    /// The words of such a failure, for who reads them on another machine.
    pub fn words(&self, worker: &str, words: &str) -> String {
        match names_disk(words) {
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
    pub fn closed(&mut self) -> Option<String> {
        self.closed_at(self.free(), Instant::now())
    }

    fn closed_at(&mut self, free: Option<u64>, now: Instant) -> Option<String> {
        let folder = self.folder.display();
        let mend = "free some space there, or give --work a folder on another disk";
        if let Some(free) = free.filter(|free| *free < self.least_bytes) {
            let (free, least) = (size(free), size(self.least_bytes));
            return Some(format!("the disk of {folder} has {free} free, less than {least}: {mend}"));
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
        Some(format!("a scene filled the disk of {folder}: {mend}; the next is tried {until}"))
    }

    fn free(&self) -> Option<u64> {
        free_disk_bytes(&self.folder)
    }
}

/// Whether an error is about a disk that takes no file.
fn names_disk(words: &str) -> bool {
    [Obstacle::FULL, Obstacle::READ_ONLY].iter().any(|sentence| words.contains(sentence))
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
    use std::path::Path;

    const MIB: u64 = 1 << 20;

    #[test]
    fn less_than_the_bound_is_no_space_and_more_is() {
        let mut gate = DiskGate::new("/work".into(), 1000 * MIB);
        let now = Instant::now();
        let reason = gate.closed_at(Some(10 * MIB), now).expect("it is too little");
        assert!(reason.contains("/work has 10 MiB free") && reason.contains("--work"), "{reason}");
        assert_eq!(gate.closed_at(Some(1000 * MIB), now), None);
        assert_eq!(gate.closed_at(None, now), None, "where the system does not report it");
    }

    #[test]
    fn a_disk_that_was_filled_is_tried_with_more_space_or_after_a_rest_that_grows() {
        let mut gate = DiskGate::new("/work".into(), 0);
        let began = Instant::now();
        let after = |seconds: u64| began + Duration::from_secs(seconds);
        gate.fill_at(Some(400 * MIB), began);
        let reason = gate.closed_at(Some(400 * MIB), after(1)).expect("that was not enough");
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
        let gate = DiskGate::new(std::env::temp_dir(), 0);
        for kind in [ErrorKind::StorageFull, ErrorKind::QuotaExceeded, ErrorKind::ReadOnlyFilesystem] {
            let error = FileError::new("write", Path::new("/work/a"), kind.into()).to_string();
            assert!(names_disk(&error), "{error}");
            assert_eq!(gate.words("w", &error), format!("on w: {error}"));
        }
        let error = LedgerError::DiskFull { path: "/work/run.sqlite".into() }.to_string();
        assert!(names_disk(&error), "{error}");
        let other = FileError::new("read", Path::new("/work/a"), ErrorKind::NotFound.into()).to_string();
        assert!(!names_disk(&other), "{other}");
        let words = gate.words("w", "exit code 6");
        assert!(words.starts_with("on w: the disk of ") && words.ends_with("(exit code 6)"), "{words}");
    }
}
