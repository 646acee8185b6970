//! The engine's passes one by one, on numbers of the host: what a self-test compares with the host's, and what a
//! benchmark submits repeatedly. No run uses them.
//!
//! Values that hold passes ([`DevicePasses`]) have the device to themselves until they are dropped: whoever wants it
//! meanwhile waits, the same thread included.

mod clock;
mod device_passes;
mod field;
mod losses;
mod networks;
mod rates;
mod sums;
mod training;
mod view;

pub use clock::{start_clock, stop_clock, wait};
pub use device_passes::DevicePasses;
pub use field::{FieldGradients, FieldPasses, RowSteps, SimilarityPasses};
pub use losses::{ComparedOnDevice, LossPasses};
pub use networks::{
    LightingPasses, LightingResults, NetworkRun, UploadedNetworks, networks_floor, run_network,
};
pub use rates::RatePasses;
pub use sums::{running_sums, sorted};
pub use training::{AdamPasses, TrainedStep, training_step};
pub use view::{PassCounts, ViewLists, ViewPasses, view_lists};
