//! Files: the one way to write them, what can go wrong, and where a path may lead.
//!
//! - [`write_atomic`], [`write_folder`]: a file or a folder that is there whole or not at all; [`append_line`] for records
//!   that grow. Nothing else in the workspace writes files (`tests/tests/writers.rs` looks).
//! - [`read_plain`], [`open_plain`]: reading of what somebody else may have put there; a pipe or a device is refused at once.
//! - [`fault`]: points where a test injects a failure: a kill, a full disk, a torn file.
//! - [`FileError`]: which file, what was tried, why it failed, what to do.
//! - [`name`]: what may be a file's name, and names of files that cannot collide.
//! - [`stays_inside`]: whether everything in a folder stays in it, for folders that somebody else made.

mod error;
pub mod fault;
mod inside;
pub mod name;
mod read;
mod write;

pub use error::{FileError, Obstacle};
pub use inside::{Stray, stays_inside};
pub use read::{open_plain, read_plain, read_within};
pub use write::{
    append_line, open_to_append, remove_litter, sync_folder, unique_name, write_aside, write_atomic,
    write_folder, write_plain, write_private,
};
