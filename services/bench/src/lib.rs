//! Protocols, the synthetic wild scene, metrics, tables and charts.

pub mod ablation;
pub mod baselines;
pub mod chart;
pub mod compare;
pub mod engine;
pub mod flow;
pub mod metrics;
pub mod oracle;
pub mod page;
pub mod perturb;
pub mod plot;
pub mod point;
pub mod protocols;
pub mod random_clicks;
pub mod reconstruction;
pub mod record;
pub mod scale;
pub mod slice;
pub mod stability;
pub mod stamp;
pub mod synthetic;
pub mod table;
pub mod trial;
