//! Protocols, the synthetic wild scene, metrics, tables and charts.

pub mod chart;
pub mod engine;
pub mod flow;
pub mod page;
pub mod plot;
pub mod point;
pub mod random_clicks;
pub mod reconstruction;
pub mod scale;
pub mod slice;
pub mod stability;
