//! What protocols have in common: rows, settings, and how results are kept.

use super::error::ProtocolError;
use crate::ablation::{VARIANTS, Variant};
use crate::baselines::{BASELINES, row};
use crate::record::{Record, Results};
use crate::trial::TrialError;
use segwild_pipeline::{Settings, SettingsError};
use std::path::Path;

/// Which rows a table has when none is named.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Table {
    /// One part of the method changed at a time (the paper's Table 2).
    Ablation,
    /// Other methods (the paper's Table 1).
    Baselines,
}

impl Table {
    /// Its rows, or those of either table that are named.
    ///
    /// # Errors
    /// When there is no row of a name.
    pub fn rows(self, only: &[String]) -> Result<Vec<&'static Variant>, ProtocolError> {
        if only.is_empty() {
            let all = if self == Table::Baselines { BASELINES } else { VARIANTS };
            return Ok(all.iter().collect());
        }
        let known = || VARIANTS.iter().chain(BASELINES).map(|row| row.name);
        let named = |name: &String| row(name).ok_or_else(|| TrialError::no_row(name, known()).into());
        only.iter().map(named).collect()
    }
}

/// What all rows have in common.
#[derive(Clone, Debug, Default)]
pub struct ProtocolBase {
    /// The settings that rows start from.
    pub settings: Settings,
    /// Settings that hold whatever a row says, by name: to tune a baseline.
    pub changes: Vec<(String, String)>,
}

impl ProtocolBase {
    /// A row's settings.
    ///
    /// # Errors
    /// When there is no setting of a name, or a value is out of its range.
    pub fn row(&self, row: &Variant) -> Result<Settings, ProtocolError> {
        let mut settings = row.settings(&self.settings)?;
        for (name, value) in &self.changes {
            settings.set(name, value).map_err(SettingsError::from)?;
        }
        Ok(settings)
    }
}

/// Receives every measurement as it is made.
pub type OnRecord<'a> = &'a mut dyn FnMut(&Record);

/// Adds a measurement and keeps the results as they are by now, so that what was measured before an error is not lost.
pub(super) fn keep(
    results: &mut Results,
    record: Record,
    out: &Path,
    report: OnRecord,
) -> Result<(), ProtocolError> {
    report(&record);
    results.put(record);
    Ok(results.write(&out.join("results.json"))?)
}
