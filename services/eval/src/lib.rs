//! How well the program works: scenes with true masks are put through it, and what comes out is scored.
//!
//! Protocols find scenes and queries, rows ([`ablation`], [`baselines`]) are settings of the program, [`metrics`] score
//! masks and renders, and [`record`] keeps results with what made them. The [`oracle`] is a provider of masks that knows
//! the truth of a synthetic scene. How long something takes, and charts of it, are not here: `segwild-bench` has them.
//!
//! Start reading at `protocols/mod.rs` for real photos, at `trial.rs` for synthetic scenes.
//!
//! ```
//! use segwild_eval::metrics::score;
//! use segwild_eval::record::{Record, Results};
//! use segwild_scene::Mask;
//!
//! let truth = Mask::from_fn(40, 40, |x, _| x < 20);
//! let found = Mask::from_fn(40, 40, |x, _| x < 15);
//! let fit = score(&found, &truth, None).unwrap();
//! assert_eq!(fit.iou, 0.75);
//!
//! let mut results = Results::default();
//! let numbers = [("iou".to_owned(), fit.iou)].into();
//! results.put(Record { setting: "full".into(), numbers, ..Record::default() });
//! assert_eq!(results.spread("iou", |r| r.setting == "full").unwrap().mean, 0.75);
//! ```

pub mod ablation;
pub mod baselines;
pub mod compare;
pub mod metrics;
pub mod oracle;
pub mod perturb;
pub mod protocols;
pub mod record;
pub mod stamp;
pub mod table;
pub mod trial;
