//! How fast the program is and how it grows, where it fails, and the pages and charts that show it.
//!
//! Whole runs are measured point by point ([`point`]), the accelerator engine pass by pass ([`engine`]), the dataflow by
//! what it promises ([`flow`]). Scores, protocols and results are not here: `segwild-eval` has them, and everything here
//! leaves its [`segwild_eval::record::Results`].
//!
//! Start reading at `point.rs`, then `chart/mod.rs`.
//!
//! ```
//! use segwild_bench::scale::Fit;
//!
//! // Seconds at three sizes: they grow with the square of the size.
//! let fit = Fit::of(&[(1.0, 3.0), (10.0, 300.0), (100.0, 30_000.0)]).unwrap();
//! assert!((fit.slope - 2.0).abs() < 1e-9);
//! ```

pub mod chart;
mod contact_sheet;
mod counted;
pub mod engine;
pub mod farm;
pub mod flow;
pub mod harm;
pub mod page;
pub mod plot;
pub mod point;
pub mod random_clicks;
pub mod reconstruction;
pub mod scale;
pub mod slice;
pub mod stability;
pub mod studio;
