//! What the records of this benchmark are called.

use segwild_eval::record::Record;
use std::collections::BTreeMap;

/// Name of the benchmark in its records.
pub const PROTOCOL: &str = "engine";
/// Before the name of a kernel whose milliseconds a record has.
pub(super) const KERNEL: &str = "kernel ";

/// A record of a pass over a target.
pub(super) fn record(pass: &str, target: &str, numbers: BTreeMap<String, f64>) -> Record {
    Record {
        protocol: PROTOCOL.into(),
        setting: pass.into(),
        target: target.into(),
        numbers,
        ..Record::default()
    }
}
