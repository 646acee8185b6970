//! Exit codes: documented constants, so that scripts can tell what happened.

use segwild_farm::ErrorClass;
use segwild_flow::files::Obstacle;

/// All that was requested is done.
pub const OK: u8 = 0;
/// Something failed that should not have: a bug or a broken machine.
pub const FAILED: u8 = 1;
/// The command line or a settings file does not make sense.
pub const USAGE: u8 = 2;
/// The scene, photos or other input cannot be used.
pub const INPUT: u8 = 3;
/// A stage failed; what was computed before is kept, and the same command goes on from there.
pub const INCOMPLETE: u8 = 4;
/// The prompts select nothing: sky, empty space, or a photo that does not see the object.
pub const NOTHING: u8 = 5;
/// The run folder is in use by another process, is not writable, or is damaged.
pub const FOLDER: u8 = 6;
/// A comparison with `--fail` found something worse.
pub const WORSE: u8 = 7;
/// The system has no file descriptors, processes or threads left; the same command continues once it has.
pub const SHORTAGE: u8 = 8;
/// Stopped by the user; resumable.
pub const INTERRUPTED: u8 = 130;

/// What kind of failure an exit code of `segwild run` is; `None`: ended by a signal, as when memory runs out.
pub fn class(code: Option<i32>) -> ErrorClass {
    match code.and_then(|code| u8::try_from(code).ok()) {
        // The same command line and the same input fail in the same way again.
        Some(USAGE | INPUT | NOTHING) => ErrorClass::Fatal,
        Some(SHORTAGE) => ErrorClass::Shortage,
        // A stage that failed goes on from what was computed; a folder may be freed, a disk may be emptied.
        _ => ErrorClass::Retryable,
    }
}

/// The code for an error of the system: a disk or a folder that will not have a file is [`FOLDER`].
pub fn of_system(error: &std::io::Error) -> u8 {
    if Obstacle::of(error) == Obstacle::Other { FAILED } else { FOLDER }
}

/// Shown by `segwild --help`.
pub const HELP: &str = "Exit codes:
  0    done
  1    failed unexpectedly
  2    the command line or a settings file does not make sense
  3    the scene, the photos or another input cannot be used
  4    a stage failed, or scenes of a batch were given up; the same command continues
  5    the prompts select nothing
  6    the run folder is in use, not writable, or damaged
  7    `bench compare --fail` found something worse
  8    the system has no file descriptors or processes left; the same command continues
  130  stopped by you; the same command continues";
