//! What operators see: one view of runs and batches, made from their ledgers, and its forms.
//!
//! - [`MonitorView`]: a run or a batch, as other processes see it while it is written and after it ended. `segwild status`,
//!   `--json`, `segwild top`, `/metrics` and `/api/v1/status` all show this and nothing else.
//! - [`metrics`]: the view as Prometheus text; every name in one enum.
//! - [`serve`]: `/metrics`, `/livez`, `/readyz`, `/api/v1/status` by HTTP; [`connections`]: how many, and for how long.
//! - [`top`]: the view in a terminal.
//!
//! It changes nothing: everything is read from ledgers that others write.
//!
//! ```no_run
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use segwild_monitor::MonitorTarget;
//! let view = MonitorTarget::at("runs/trevi".as_ref())?.view()?;
//! println!("running: {}", view.is_running());
//! # Ok(())
//! # }
//! ```
//!
//! Start reading at `view/mod.rs`.

pub mod connections;
mod disk;
mod http;
pub mod metrics;
mod ready;
pub mod top;
pub mod view;
pub mod words;

pub use http::{MonitorSource, ServeError, Server, serve, start};
pub use ready::{ReadyCheck, ready};
pub use view::{MonitorTarget, MonitorView, ViewError};
