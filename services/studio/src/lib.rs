//! The page on which a person clicks: a run's session, shared by viewers, and every operation on its objects.
//!
//! - [`Studio`]: a run's session with its objects. Prompts are queries, answers grow, several viewers share one state.
//! - [`document`]: the objects and the operations that made them; `studio/session.jsonl` of a run, undo and redo.
//! - [`messages`]: what the page and the server say to each other.
//! - [`serve`], [`serve_farm`]: the page and its messages by HTTP, on the loopback address and with a token. The same port answers
//!   the calls of `proto/segwild/v1/session.proto`.
//!
//! It is no trainer and no segmenter: what a click means is decided by [`segwild_pipeline::Session`].
//!
//! ```
//! use segwild_studio::document::{Document, JournalEntry, Operation, StoredSelection};
//!
//! // A person marks 1200 splats with a tool, and takes it back.
//! let mut document = Document::default();
//! let selection = StoredSelection { hash: "5e1f".into(), splats: 1200 };
//! let paint = Operation::Paint { id: document.objects().next_id(), name: "statue".into(), selection };
//! document.enter(&JournalEntry::Apply(paint))?;
//! assert_eq!(document.objects().get(1)?.name, "statue");
//! document.enter(&JournalEntry::Undo)?;
//! assert!(document.objects().all.is_empty());
//! assert_eq!(document.redo_label(), Some("select by a tool"));
//! # Ok::<(), segwild_studio::document::DocumentError>(())
//! ```
//!
//! The page itself needs a run:
//!
//! ```no_run
//! use segwild_studio::{ServeOptions, serve};
//!
//! let server = serve("runs/trevi".as_ref(), ServeOptions::default())?;
//! println!("{}", server.address());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Start reading at [`Studio::act`] in `studio/act.rs`, then `document/mod.rs`; `routes.rs` lists the requests of the page, of which
//! [`openapi()`] writes the reference.

mod calls;
pub mod document;
mod early;
mod farm;
mod fronts;
mod grpc;
mod guard;
pub mod messages;
mod openapi;
mod page;
mod photo_splats;
mod rates;
mod regions;
mod routes;
mod runs;
mod server;
mod store;
mod studio;
mod zip;

pub use farm::FarmSource;
pub use openapi::openapi;
pub use regions::{Combination, MOST_POINTS, Region, RegionRule};
pub use runs::has_runs;
pub use server::{ServeOptions, StudioServer, serve, serve_farm};
pub use store::SelectionStore;
pub use studio::{ANSWER_COLOUR, COLOURS, Studio, StudioError};
