//! Fault injection: named points in the program where a test, or the `--fault` flag (left out of `--help`), makes something
//! fail that would otherwise take a broken disk or a kill at the right moment.
//!
//! A fault is written `ACTION@POINT`, or `ACTION@POINT:N` to strike the Nth time the point is passed (the first
//! without N), or `ACTION@POINT:N+` to strike every time from the Nth on. A process has one list of faults. It is armed once,
//! at the start. Where no fault is armed, a point costs one read of an atomic.
//!
//! ```
//! use segwild_files::fault;
//! fault::arm(&["full@test.doc:2"]).unwrap();
//! assert!(fault::point("test.doc").is_ok());
//! assert_eq!(fault::point("test.doc").unwrap_err().kind(), std::io::ErrorKind::StorageFull);
//! assert!(fault::point("test.doc").is_ok());
//! assert!(fault::arm(&["full@nowhere"]).unwrap_err().to_string().contains("checkpoint.save"));
//! ```

use crate::lock;
use std::borrow::Cow;
use std::io;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// The points, and what has happened when each is passed. An actor's own points are `NAME.handle`; names that start with
/// `test.` are free for tests.
pub const POINTS: [(&str, &str); 19] = [
    ("trainer.handle", "the trainer takes an order"),
    ("coordinator.handle", "the coordinator takes a message of an actor"),
    ("masks.handle", "the masks actor takes a photo"),
    ("features.handle", "the features actor takes a photo, or the field"),
    ("segmenter.handle", "the segmenter takes the prompts of a selection"),
    ("trainer.step", "the trainer has done a step"),
    ("features.step", "the field has taken a photo in, or done a step of its refinement"),
    ("masks.make", "the masks of a photo are about to be made"),
    ("visibility.photo", "a photo has been compared with the trained scene"),
    ("evaluate.photo", "a held-out photo has been scored"),
    ("report.image", "an image of the report has been rendered"),
    ("selection.file", "a file of a selection has been written"),
    ("file.write", "a file of the run is about to be written aside"),
    ("file.append", "a line is about to be added to a file"),
    ("file.rename", "a file is whole aside, and not yet in its place"),
    ("cache.read", "an artefact has been read and is not yet verified"),
    ("ledger.commit", "a change of the ledger is about to be committed"),
    ("checkpoint.save", "a checkpoint of the training is about to be saved"),
    ("clock", "the wall clock is read"),
];

/// What goes wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Action {
    /// The process is killed at once, by SIGKILL where there are signals; nothing is unwound, flushed or dropped.
    Kill,
    /// The disk is full.
    Full,
    /// The file system is read-only.
    ReadOnly,
    /// An error that may pass.
    Fail,
    /// A byte of what is read or written changes.
    Corrupt,
    /// Half of what is read or written is missing.
    Torn,
    /// A bug: the point panics.
    Panic,
    /// The thread sleeps for a long time.
    Stall,
    /// The wall clock stands a day back.
    Jump,
    /// The wall clock stands a day ahead.
    Leap,
}

const ACTIONS: [(&str, Action); 10] = [
    ("kill", Action::Kill),
    ("full", Action::Full),
    ("read-only", Action::ReadOnly),
    ("fail", Action::Fail),
    ("corrupt", Action::Corrupt),
    ("torn", Action::Torn),
    ("panic", Action::Panic),
    ("stall", Action::Stall),
    ("jump", Action::Jump),
    ("leap", Action::Leap),
];

/// How long a stall lasts: longer than any watchdog waits, but finite, so that no process stays for ever.
const STALL: Duration = Duration::from_secs(600);
/// How far the clock jumps, in seconds.
const JUMP_S: f64 = 86_400.0;

/// The text of a fault cannot be parsed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is no fault: {reason}")]
pub struct FaultError {
    /// What was given.
    pub text: String,
    /// What is wrong with it.
    pub reason: String,
}

struct ArmedFault {
    action: Action,
    point: String,
    from: u64,
    for_ever: bool,
    passed: AtomicU64,
}

static ARMED: AtomicBool = AtomicBool::new(false);
static FAULTS: Mutex<Vec<Arc<ArmedFault>>> = Mutex::new(Vec::new());

fn parse(text: &str) -> Result<ArmedFault, FaultError> {
    let wrong = |reason: String| FaultError { text: text.into(), reason };
    let (action, rest) =
        text.split_once('@').ok_or_else(|| wrong("write ACTION@POINT or ACTION@POINT:N".into()))?;
    let (_, action) = ACTIONS
        .iter()
        .find(|(name, _)| *name == action)
        .ok_or_else(|| wrong(format!("the actions are {}", ACTIONS.map(|(name, _)| name).join(", "))))?;
    let (point, count) = rest.split_once(':').unwrap_or((rest, "1"));
    if !point.starts_with("test.") && !POINTS.iter().any(|(name, _)| *name == point) {
        return Err(wrong(format!("the points are {}", POINTS.map(|(name, _)| name).join(", "))));
    }
    let number = count.strip_suffix('+').unwrap_or(count);
    let from =
        number.parse().ok().filter(|&n| n > 0).ok_or_else(|| wrong(format!("`{count}` is no count")))?;
    Ok(ArmedFault {
        action: *action,
        point: point.into(),
        from,
        for_ever: number != count,
        passed: AtomicU64::new(0),
    })
}

/// Arms faults, beside those already armed.
///
/// # Errors
/// When one is misspelt; then none of these is armed.
pub fn arm<S: AsRef<str>>(faults: &[S]) -> Result<(), FaultError> {
    let faults: Vec<_> = faults.iter().map(|f| parse(f.as_ref()).map(Arc::new)).collect::<Result<_, _>>()?;
    if !faults.is_empty() {
        lock(&FAULTS).extend(faults);
        ARMED.store(true, Ordering::Release);
    }
    Ok(())
}

/// The faults that strike now at a point.
fn strike(point: &str) -> Vec<Action> {
    if !ARMED.load(Ordering::Acquire) {
        return Vec::new();
    }
    let faults: Vec<_> = lock(&FAULTS).iter().filter(|f| f.point == point).cloned().collect();
    faults
        .iter()
        .filter(|f| {
            let n = f.passed.fetch_add(1, Ordering::Relaxed) + 1;
            n == f.from || f.for_ever && n > f.from
        })
        .map(|f| f.action)
        .collect()
}

fn act(action: Action, point: &str) -> io::Result<()> {
    match action {
        Action::Kill => {
            eprintln!("fault: killed at {point}");
            #[cfg(unix)]
            // A system that refuses leaves the abort below.
            let _ = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::KILL);
            std::process::abort()
        }
        Action::Full => Err(io::ErrorKind::StorageFull.into()),
        Action::ReadOnly => Err(io::ErrorKind::ReadOnlyFilesystem.into()),
        Action::Fail => Err(io::Error::other(format!("a fault on purpose at {point}"))),
        Action::Panic => panic!("a fault on purpose at {point}"),
        Action::Stall => {
            std::thread::park_timeout(STALL);
            Ok(())
        }
        Action::Corrupt | Action::Torn | Action::Jump | Action::Leap => Ok(()),
    }
}

/// Passes a point: nothing, or the fault that was armed for this time.
///
/// # Errors
/// When the armed fault is an error of the disk.
///
/// # Panics
/// When the armed fault is a panic.
pub fn point(name: &str) -> io::Result<()> {
    strike(name).into_iter().try_for_each(|action| act(action, name))
}

/// Whether any fault is armed: who would have to build a point's name looks first.
pub fn armed() -> bool {
    ARMED.load(Ordering::Acquire)
}

/// Passes a point with bytes, which the fault may damage.
///
/// # Errors
/// When the armed fault is an error of the disk.
pub fn bytes<'a>(name: &str, bytes: Cow<'a, [u8]>) -> io::Result<Cow<'a, [u8]>> {
    let mut bytes = bytes;
    for action in strike(name) {
        match action {
            Action::Corrupt => {
                let bytes = bytes.to_mut();
                let middle = bytes.len() / 2;
                if let Some(byte) = bytes.get_mut(middle) {
                    *byte ^= 0x10;
                }
            }
            Action::Torn => {
                let half = bytes.len() / 2;
                bytes.to_mut().truncate(half);
            }
            other => act(other, name)?,
        }
    }
    Ok(bytes)
}

/// How far the wall clock is off, in seconds.
pub fn clock_jump() -> f64 {
    let jump = |action| match action {
        Action::Jump => -JUMP_S,
        Action::Leap => JUMP_S,
        _ => 0.0,
    };
    strike("clock").into_iter().map(jump).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_strikes_at_the_pass_it_was_armed_for() {
        arm(&["fail@test.once", "full@test.third:3", "read-only@test.on:2+"]).unwrap();
        let kinds = |name: &str| -> Vec<bool> { (0..4).map(|_| point(name).is_err()).collect() };
        assert_eq!(kinds("test.once"), [true, false, false, false]);
        assert_eq!(kinds("test.third"), [false, false, true, false]);
        assert_eq!(kinds("test.on"), [false, true, true, true]);
        assert_eq!(kinds("test.unarmed"), [false; 4]);
    }

    #[test]
    fn bytes_are_damaged_and_nothing_else() {
        arm(&["corrupt@test.flip", "torn@test.cut"]).unwrap();
        let whole = [7u8; 8];
        let flipped = bytes("test.flip", Cow::Borrowed(&whole)).unwrap();
        assert_eq!(flipped.iter().filter(|&&b| b != 7).count(), 1);
        assert_eq!(bytes("test.cut", Cow::Borrowed(&whole)).unwrap().len(), 4);
        assert_eq!(&*bytes("test.cut", Cow::Borrowed(&whole)).unwrap(), &whole);
    }

    #[test]
    fn a_misspelt_fault_is_named() {
        for (text, words) in [
            ("kill", "ACTION@POINT"),
            ("boom@clock", "kill, full"),
            ("kill@somewhere", "checkpoint.save"),
            ("kill@clock:0", "no count"),
            ("kill@clock:x", "no count"),
        ] {
            let message = arm(&[text]).unwrap_err().to_string();
            assert!(message.contains(words) && message.contains(text), "{message}");
        }
    }
}
