//! What operators see: one view of runs and batches, made from their ledgers, and its forms.
//!
//! - [`MonitorView`]: a run or a batch, as other processes see it while it is written and after it ended. `segwild status`,
//!   `--json`, `segwild top`, `/metrics` and `/api/v1/status` all show this and nothing else.
//! - [`metrics`]: the view as Prometheus text; every name in one enum.
//! - [`serve`]: `/metrics`, `/livez`, `/readyz`, `/api/v1/status` by HTTP; [`connections`]: how many, and for how long.
//! - [`top`]: the view in a terminal.
//!
//! It changes nothing: everything is read from ledgers that others write. It starts no run, and needs none of its processes: a
//! run that was killed is shown as it was left.
//!
//! ```
//! use segwild_flow::Ledger;
//! use segwild_monitor::{MonitorTarget, metrics};
//!
//! # let run = tempfile::tempdir()?;
//! # let run = run.path();
//! // Who holds the ledger works on the run.
//! let ledger = Ledger::open(run.join("run.sqlite"))?;
//! let target = MonitorTarget::at(run)?;
//! let view = target.view()?;
//! assert!(view.is_running());
//! assert!(metrics::render(Some(&view), false).contains("segwild_scenes{state=\"running\"} 1\n"));
//! // Its process ends, and work is left.
//! drop(ledger);
//! assert!(!target.view()?.is_running());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Start reading at `view/mod.rs`, then `why.rs` (what each stage and actor waits for).

pub mod connections;
mod disk;
mod http;
pub mod metrics;
mod ready;
mod slow;
pub mod top;
pub mod view;
pub mod words;

pub use http::{MonitorSource, ServeError, Server, serve, start};
pub use ready::{ReadyCheck, ready};
pub use view::{MonitorTarget, MonitorView, ViewError};
