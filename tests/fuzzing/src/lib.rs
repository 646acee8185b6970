//! Every reader of files and requests as a function of bytes.
//!
//! - [`TARGETS`]: the readers. Whatever the bytes, a reader returns: no panic, no hang, bounded memory.
//! - [`mutate`]: changes of good inputs, the same ones each time.
//! - [`seal`]: checksums of changed inputs, so that they are not refused before a field is read.
//!
//! `cargo run -p segwild-fuzzing` mutates for a bounded time on a stable toolchain, as CI does. `tests/fuzz` is the same
//! for `cargo fuzz`, guided by coverage, for those who have a nightly one.

pub mod mutate;
pub mod seal;
pub mod seeds;
mod targets;
mod yard;

pub use targets::TARGETS;
pub use yard::keep_files_in;

/// A reader, and what it is fed with.
pub struct FuzzTarget {
    /// Its name, and that of its folder in `tests/fuzz/corpus`.
    pub name: &'static str,
    /// Inputs that it accepts.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Words of its format.
    pub words: &'static [&'static str],
    /// Puts the checksums of a changed input right.
    pub seal: fn(&mut [u8]),
    /// The reader; panics only where it is wrong.
    pub read: fn(&[u8]),
}

/// The target of a name.
pub fn target(name: &str) -> Option<&'static FuzzTarget> {
    TARGETS.iter().find(|target| target.name == name)
}

/// Feeds a target, as a fuzzer does.
///
/// # Panics
/// Where the reader is wrong, or there is no target of that name.
pub fn feed(name: &str, bytes: &[u8]) {
    let target = target(name).unwrap_or_else(|| panic!("there is no target `{name}`"));
    let mut bytes = bytes.to_vec();
    (target.seal)(&mut bytes);
    (target.read)(&bytes);
}
