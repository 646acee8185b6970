//! Protocols, the synthetic wild scene, metrics, tables and charts.

pub mod ablation;
pub mod flow;
pub mod metrics;
pub mod oracle;
pub mod perturb;
pub mod protocols;
pub mod record;
pub mod rivals;
pub mod synthetic;
pub mod table;
pub mod trial;
