//! Finds the kernel that a device computes wrongly: compares each step of a frame with the CPU engine or a known
//! result, in the order in which the steps depend on one another. The first that diverges has the fault.
//!
//! `segwild doctor --kernels` runs it. The engine's passes come from [`segwild_gpu::probe`]; here are test cases, the
//! host's results and tolerances. How fast kernels are is not here: `segwild-bench` times them.
//!
//! Start reading at `stages.rs`, then `view.rs`.
//!
//! ```
//! use segwild_gpu::{AdapterChoice, GpuEngine, adapters};
//! use segwild_selftest::{Tolerance, check_sums};
//!
//! assert!(Tolerance::BLENDED.compare("colours", &[0.5, 0.25], &[0.5, 0.75]).is_err());
//!
//! // On a machine with an accelerator, software included:
//! if let Some(adapter) = adapters().first() {
//!     let engine = GpuEngine::new(&AdapterChoice::Named(adapter.name.clone())).unwrap();
//!     assert!(check_sums(&engine).unwrap().iter().all(|step| step.off.is_none()));
//! }
//! ```

mod compare;
mod feature_case;
mod field;
mod frame;
mod kernel_check;
mod mismatch;
mod networks;
mod stages;
mod sums;
mod tolerance;
mod training;
mod view;

pub use compare::{TestCase, compared, test_cases};
pub use feature_case::{FeatureCase, FeatureCaseData};
pub use kernel_check::KernelCheck;
pub use mismatch::{ListMismatch, Mismatch};
pub use networks::some_appearance;
pub use stages::{STAGES, Stage, check, check_comparison, check_field, check_networks, check_splats};
pub use sums::check_sums;
pub use tolerance::Tolerance;
pub use training::{training as check_training, training_splats, training_splats_with_embeddings};
pub use view::{check_view, gradients, projected};
