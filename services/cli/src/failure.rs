//! Errors at the edge: a sentence for the person, a code for the script.

use crate::exit;
use segwild_bench::flow::FlowError;
use segwild_bench::page::PageError;
use segwild_bench::point::PointError;
use segwild_eval::protocols::ProtocolError;
use segwild_eval::record::RecordError;
use segwild_eval::trial::TrialError;
use segwild_farm::{ArtefactError, BatchError, EngineError, FarmBatchError, FarmSweepError, WorkerError};
use segwild_flow::files::name::shown;
use segwild_flow::{LedgerError, SystemRefusal, shortage};
use segwild_gpu::GpuError;
use segwild_monitor::{ServeError, ViewError};
use segwild_pipeline::{RunError, SettingsError};
use segwild_poses::PosesError;
use segwild_scene::SceneError;
use segwild_segmenter::SegmentError;
use segwild_synthetic::SyntheticError;
use segwild_vision::{ServiceError, VisionError};
use std::io::Write;
use std::path::Path;

/// Why the program ends early.
#[derive(Debug)]
pub struct Failure {
    /// What is wrong, and where.
    pub message: String,
    /// One of [`exit`]'s constants.
    pub code: u8,
}

impl Failure {
    /// A mistake on the command line.
    pub fn usage(message: impl Into<String>) -> Failure {
        Failure { message: message.into(), code: exit::USAGE }
    }

    /// A file that the system will not have written.
    pub fn cannot_write(file: &Path, error: &std::io::Error) -> Failure {
        Failure { message: format!("cannot write {}: {error}", file.display()), code: exit::of_system(error) }
    }

    /// Tells the person, on standard error.
    pub fn tell(&self) {
        // Where nobody can read it, as in a log on a full disk, the exit code says it.
        let _ = writeln!(std::io::stderr(), "error: {}", plain(&self.message));
    }

    /// What a program reads.
    pub fn to_json(&self) -> serde_json::Value {
        serde_json::json!({ "error": plain(&self.message), "exit_code": self.code })
    }
}

/// A message as it is safe to show, for it may hold names that somebody else gave ([`shown`]), and without the numbers that the
/// system's errors end in: `(os error 2)` helps nobody.
pub fn plain(message: &str) -> String {
    let mut parts = message.split(" (os error ");
    let mut text = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let number = part.chars().take_while(char::is_ascii_digit).count();
        match part[number..].strip_prefix(')') {
            Some(rest) if number > 0 => text += rest,
            _ => text = text + " (os error " + part,
        }
    }
    shown(&text).into_owned()
}

impl From<RunError> for Failure {
    fn from(error: RunError) -> Failure {
        let code = match &error {
            RunError::Storage { refusal, .. } => refusal_code(*refusal),
            error if is_shortage(error) => exit::SHORTAGE,
            RunError::Vision(VisionError::Service(
                ServiceError::Address(_)
                | ServiceError::Token { .. }
                | ServiceError::Certificates(_)
                | ServiceError::NoTls { .. },
            )) => exit::USAGE,
            RunError::Vision(VisionError::Service(_)) => exit::INCOMPLETE,
            // The disk's fault, and not the scene's.
            RunError::Scene(SceneError::File(_)) => exit::FOLDER,
            // The next attempt leaves the photo out, if it cannot be used, and keeps what was computed.
            RunError::Scene(SceneError::Changed { .. }) => exit::INCOMPLETE,
            RunError::Scene(_) | RunError::Vision(_) | RunError::Input(_) | RunError::Engine(_) => {
                exit::INPUT
            }
            RunError::Poses(error) => poses_code(error),
            RunError::Settings(_) | RunError::Request(_) => exit::USAGE,
            RunError::Folder { .. }
            | RunError::File(_)
            | RunError::Cache(_)
            | RunError::Record { .. }
            | RunError::Ledger(_) => exit::FOLDER,
            // Another machine may have the program.
            RunError::Stage { .. } | RunError::NoProgram { .. } | RunError::Program(_) => exit::INCOMPLETE,
            RunError::Segment(error) => segment_code(error),
            RunError::Interrupted => exit::INTERRUPTED,
            RunError::Train(_) => exit::INPUT,
            RunError::Spawn(_) | RunError::Raster(_) | RunError::Features(_) => exit::FAILED,
        };
        Failure { message: error.to_string(), code }
    }
}

/// The code of a stage that the disk, the system or a service elsewhere stopped.
fn refusal_code(refusal: SystemRefusal) -> u8 {
    match refusal {
        SystemRefusal::Disk => exit::FOLDER,
        SystemRefusal::Shortage => exit::SHORTAGE,
        // The same command continues once the service answers.
        SystemRefusal::Unanswered => exit::INCOMPLETE,
    }
}

/// Whether the system had no file descriptor, process or thread left.
fn is_shortage(error: &RunError) -> bool {
    let of_threads = matches!(error, RunError::Spawn(e) if shortage::is_shortage_of_processes(&e.source));
    of_threads || SystemRefusal::of(error) == Some(SystemRefusal::Shortage)
}

fn poses_code(error: &PosesError) -> u8 {
    match error {
        PosesError::Scene(SceneError::File(_))
        | PosesError::File(_)
        | PosesError::GonePhotos { .. }
        | PosesError::Database { .. }
        | PosesError::Record { .. } => exit::FOLDER,
        PosesError::TooFew { .. }
        | PosesError::NoModel { .. }
        | PosesError::Video { .. }
        | PosesError::Scene(_) => exit::INPUT,
        // Another machine may have the program.
        PosesError::NoColmap { .. }
        | PosesError::NoGlomap { .. }
        | PosesError::NoFfmpeg { .. }
        | PosesError::Program(_) => exit::INCOMPLETE,
        PosesError::Stopped => exit::INTERRUPTED,
    }
}

fn segment_code(error: &SegmentError) -> u8 {
    match error {
        SegmentError::EmptySpace { .. }
        | SegmentError::Background { .. }
        | SegmentError::EmptyMask { .. }
        | SegmentError::NoFeatures
        | SegmentError::NothingSelected { .. } => exit::NOTHING,
        SegmentError::Cancelled => exit::INTERRUPTED,
        SegmentError::Provider { .. } => exit::INPUT,
        SegmentError::Shape(_) | SegmentError::Raster { .. } => exit::FAILED,
        SegmentError::NoPrompt
        | SegmentError::NoAlternative { .. }
        | SegmentError::NoView { .. }
        | SegmentError::OutsideFrame { .. }
        | SegmentError::Setting { .. } => exit::USAGE,
    }
}

impl From<SettingsError> for Failure {
    fn from(error: SettingsError) -> Failure {
        Failure { message: error.to_string(), code: exit::USAGE }
    }
}

impl From<LedgerError> for Failure {
    fn from(error: LedgerError) -> Failure {
        RunError::from(error).into()
    }
}

impl From<BatchError> for Failure {
    fn from(error: BatchError) -> Failure {
        let code = match &error {
            BatchError::Manifest(_) => exit::USAGE,
            BatchError::Engine(_) | BatchError::File { .. } | BatchError::Busy { .. } => exit::FOLDER,
        };
        Failure { message: error.to_string(), code }
    }
}

impl From<EngineError> for Failure {
    fn from(error: EngineError) -> Failure {
        // A farm that does not answer is as a stage that failed: the same command continues.
        let server = matches!(error, EngineError::Server { .. });
        Failure { message: error.to_string(), code: if server { exit::INCOMPLETE } else { exit::FOLDER } }
    }
}

impl From<FarmSweepError> for Failure {
    fn from(error: FarmSweepError) -> Failure {
        match error {
            FarmSweepError::Engine(error) => error.into(),
            FarmSweepError::Artefact(error) => error.into(),
            FarmSweepError::Empty { .. } | FarmSweepError::OtherKey { .. } => {
                Failure::usage(error.to_string())
            }
            FarmSweepError::Job { .. } => Failure { message: error.to_string(), code: exit::INPUT },
        }
    }
}

impl From<ArtefactError> for Failure {
    fn from(error: ArtefactError) -> Failure {
        let code = match &error {
            ArtefactError::Address { .. } | ArtefactError::OtherStore { .. } => exit::USAGE,
            ArtefactError::Unfit { .. } | ArtefactError::Manifest { .. } => exit::INPUT,
            ArtefactError::Missing { .. } | ArtefactError::Damaged { .. } | ArtefactError::Store { .. } => {
                exit::INCOMPLETE
            }
            _ => exit::FOLDER,
        };
        Failure { message: error.to_string(), code }
    }
}

impl From<FarmBatchError> for Failure {
    fn from(error: FarmBatchError) -> Failure {
        let message = error.to_string();
        match error {
            FarmBatchError::Manifest(_) | FarmBatchError::Name(_) | FarmBatchError::Scene { .. } => {
                Failure { message, code: exit::USAGE }
            }
            FarmBatchError::Engine(error) => error.into(),
            FarmBatchError::Photos { source, .. } | FarmBatchError::Result { source, .. } => {
                Failure { message, ..Failure::from(source) }
            }
        }
    }
}

impl From<WorkerError> for Failure {
    fn from(error: WorkerError) -> Failure {
        match error {
            WorkerError::Engine(error) => error.into(),
            other => Failure { message: other.to_string(), code: exit::FOLDER },
        }
    }
}

impl From<ViewError> for Failure {
    fn from(error: ViewError) -> Failure {
        Failure { message: error.to_string(), code: exit::FOLDER }
    }
}

impl From<ServeError> for Failure {
    fn from(error: ServeError) -> Failure {
        Failure { message: error.to_string(), code: exit::USAGE }
    }
}

impl From<SyntheticError> for Failure {
    fn from(error: SyntheticError) -> Failure {
        match error {
            SyntheticError::Scene(error) => RunError::from(error).into(),
            SyntheticError::Stopped { .. } => Failure { message: error.to_string(), code: exit::INTERRUPTED },
            other => Failure { message: other.to_string(), code: exit::FAILED },
        }
    }
}

impl From<FlowError> for Failure {
    fn from(error: FlowError) -> Failure {
        match error {
            FlowError::Synthetic(e) => e.into(),
            FlowError::Run(e) => e.into(),
            FlowError::Settings(e) => e.into(),
            FlowError::Unknown(_) => Failure::usage(error.to_string()),
            FlowError::Io { ref source, .. } => {
                Failure { message: error.to_string(), code: exit::of_system(source) }
            }
            FlowError::Child(_) => Failure { message: error.to_string(), code: exit::FAILED },
        }
    }
}

impl From<TrialError> for Failure {
    fn from(error: TrialError) -> Failure {
        match error {
            TrialError::Synthetic(e) => e.into(),
            TrialError::Run(e) => e.into(),
            TrialError::Vision(e) => RunError::from(e).into(),
            TrialError::Scene(e) => RunError::from(e).into(),
            TrialError::Row { .. } => Failure::usage(error.to_string()),
            TrialError::Metric { .. } => Failure { message: error.to_string(), code: exit::FAILED },
        }
    }
}

impl From<ProtocolError> for Failure {
    fn from(error: ProtocolError) -> Failure {
        match error {
            ProtocolError::Trial(e) => e.into(),
            ProtocolError::Run(e) => e.into(),
            ProtocolError::Settings(e) => e.into(),
            ProtocolError::Scene(e) => RunError::from(e).into(),
            ProtocolError::Missing(_) | ProtocolError::File { .. } => {
                Failure { message: error.to_string(), code: exit::INPUT }
            }
            ProtocolError::Record(RecordError::Write(error)) => RunError::from(error).into(),
            ProtocolError::Record(_) | ProtocolError::Perturb(_) | ProtocolError::Metric { .. } => {
                Failure { message: error.to_string(), code: exit::FAILED }
            }
        }
    }
}

impl From<PointError> for Failure {
    fn from(error: PointError) -> Failure {
        match error {
            PointError::Trial(e) => e.into(),
            PointError::Truth(e) => (*e).into(),
            PointError::NoTruth(_) => Failure { message: error.to_string(), code: exit::INPUT },
            PointError::Child(_) => Failure { message: error.to_string(), code: exit::FAILED },
        }
    }
}

impl From<PageError> for Failure {
    fn from(error: PageError) -> Failure {
        match error {
            PageError::Settings(e) => e.into(),
            PageError::Point(e) => e.into(),
            PageError::Protocol(e) => e.into(),
            PageError::Unknown { .. } | PageError::Gpu(GpuError::NoAdapter(_)) => {
                Failure::usage(error.to_string())
            }
            PageError::Other(_) | PageError::Record(_) => {
                Failure { message: error.to_string(), code: exit::FOLDER }
            }
            PageError::Io { ref source, .. } => {
                Failure { message: error.to_string(), code: exit::of_system(source) }
            }
            PageError::Plot(_) | PageError::Raster(_) | PageError::Gpu(_) => {
                Failure { message: error.to_string(), code: exit::FAILED }
            }
        }
    }
}

impl From<std::io::Error> for Failure {
    fn from(error: std::io::Error) -> Failure {
        Failure { message: error.to_string(), code: exit::of_system(&error) }
    }
}

#[cfg(test)]
mod tests {
    use super::{Failure, plain};
    use crate::exit;
    use segwild_flow::{FileError, SystemRefusal};
    use segwild_pipeline::RunError;
    use std::io::Error;
    use std::path::Path;

    #[cfg(unix)]
    #[test]
    fn want_of_file_descriptors_has_an_exit_code_of_its_own_wherever_it_is_met() {
        let code = |error: RunError| Failure::from(error).code;
        for number in [23, 24] {
            let system = || Error::from_raw_os_error(number);
            let reason = format!("not one of 3 photos could be done; the first: {}", system());
            assert_eq!(code(FileError::new("read", Path::new("a"), system()).into()), exit::SHORTAGE);
            assert_eq!(code(RunError::Stage { stage: "masks", reason }), exit::SHORTAGE);
        }
        let other = FileError::new("read", Path::new("a"), Error::from_raw_os_error(5));
        assert_eq!(code(other.into()), exit::FOLDER);
        let named = "a (os error 24).jpg is no image".to_owned();
        assert_eq!(code(RunError::Input(named)), exit::INPUT);
    }

    #[test]
    fn what_stopped_a_stage_has_its_code_whatever_the_words_are() {
        let code = |refusal| {
            let reason = "no vision service has answered for 1 s: (os error 24)".to_owned();
            Failure::from(RunError::Storage { stage: "masks", reason, refusal }).code
        };
        assert_eq!(code(SystemRefusal::Disk), exit::FOLDER);
        assert_eq!(code(SystemRefusal::Shortage), exit::SHORTAGE);
        assert_eq!(code(SystemRefusal::Unanswered), exit::INCOMPLETE);
    }

    #[test]
    fn a_photo_that_changed_under_a_run_does_not_end_its_scene_for_good() {
        let changed = segwild_scene::SceneError::Changed { name: "a.jpg".into(), path: "a.jpg".into() };
        let code = Failure::from(RunError::Scene(changed)).code;
        assert_eq!(exit::class(Some(code.into())), segwild_farm::ErrorClass::Retryable);
    }

    #[test]
    fn a_photos_name_sends_nothing_to_the_terminal() {
        let message =
            plain("photo \u{1b}]0;owned\u{7}\u{1b}[2J\u{9b}31mx\u{202e}gpj.png\r: cannot be read\n  twice");
        assert!(
            !message.chars().any(|c| c.is_control() && c != '\n') && !message.contains('\u{202e}'),
            "{message:?}"
        );
        assert!(message.contains("\\u{1b}[2J") && message.contains(": cannot be read\n  twice"), "{message}");
    }

    #[test]
    fn the_numbers_of_the_system_are_left_out() {
        let message = "a.jpg: No such file or directory (os error 2); b.jpg: Permission denied (os error 13)";
        assert_eq!(plain(message), "a.jpg: No such file or directory; b.jpg: Permission denied");
        for message in ["nothing of the kind", "cut short (os error ", "photo (os error x).jpg", ""] {
            assert_eq!(plain(message), message);
        }
    }
}
