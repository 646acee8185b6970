//! The page on which a person clicks: a run's session, shared by viewers, and every operation on its objects.
//!
//! - [`Studio`]: a run's session with its objects. Prompts are queries, answers grow, several viewers share one state.
//! - [`document`]: the objects and the operations that made them; `studio/session.jsonl` of a run, undo and redo.
//! - [`messages`]: what the page and the server say to each other.
//! - [`serve`]: the page and its messages by HTTP, on the loopback address and with a token.
//!
//! It is no trainer and no segmenter: what a click means is decided by [`segwild_pipeline::Session`].
//!
//! ```no_run
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use segwild_studio::{ServeOptions, serve};
//! let server = serve("runs/trevi".as_ref(), ServeOptions::default())?;
//! println!("{}", server.address());
//! # Ok(())
//! # }
//! ```
//!
//! Start reading at [`Studio::act`].

pub mod document;
mod fronts;
mod guard;
pub mod messages;
mod page;
mod regions;
mod routes;
mod runs;
mod server;
mod store;
mod studio;

pub use regions::{Combination, MOST_POINTS, Region, RegionRule};
pub use runs::has_runs;
pub use server::{ServeOptions, StudioServer, serve};
pub use store::SelectionStore;
pub use studio::{ANSWER_COLOUR, COLOURS, Studio, StudioError};
