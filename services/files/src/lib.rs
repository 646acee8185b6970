//! Files: the one way to write them, what can go wrong, and where a path may lead.
//!
//! - [`write_atomic`], [`write_folder`]: a file or a folder that is there whole or not at all; [`append_line`] for records
//!   that grow; [`write_with`] for what arrives bit by bit; [`write_by_folder`] for what another program writes. Nothing else in the workspace writes files (`tests/tests/writers.rs` looks).
//! - [`read_plain`], [`open_plain`]: reading of what somebody else may have put there; a pipe or a device is refused at once.
//! - [`fault`]: points where a test injects a failure: a kill, a full disk, a torn file.
//! - [`FileError`]: which file, what was tried, why it failed, what to do.
//! - [`name`]: what may be a file's name, and names of files that cannot collide.
//! - [`stays_inside`]: whether everything in a folder stays in it, for folders that somebody else made.
//! - [`lock`]: mutexes that serve on after a panic. They are no files; they lie here because it is the lowest floor.
//!
//! It knows no format and no folder of a run: what is written, and where, is its caller's.
//!
//! ```
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let folder = std::env::temp_dir().join(format!("segwild-files-{}", std::process::id()));
//! std::fs::create_dir_all(&folder)?;
//! let path = folder.join("note.txt");
//! segwild_files::write_atomic(&path, b"whole or not at all")?;
//! assert_eq!(segwild_files::read_plain(&path)?, b"whole or not at all");
//! # std::fs::remove_dir_all(folder)?;
//! # Ok(())
//! # }
//! ```
//!
//! Start reading at `write.rs`.

mod error;
pub mod fault;
mod inside;
mod mutex;
pub mod name;
mod read;
mod write;

pub use error::{FileError, Obstacle};
pub use inside::{Stray, stays_inside};
pub use mutex::lock;
pub use read::{open_plain, open_within, read_plain, read_within};
pub use write::{
    append_line, open_to_append, remove_litter, sync_folder, unique_name, write_aside, write_aside_with,
    write_atomic, write_by_folder, write_folder, write_plain, write_private, write_with,
};
