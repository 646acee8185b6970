//! Protocols, oracle provider, baselines, metrics and results.

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
