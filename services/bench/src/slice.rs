//! A small slice of the benchmark, for every change: quality and counted work on fixed seeds, in seconds. Compared with
//! what is kept beside the code ([`segwild_eval::compare`], strictly), it fails when either gets worse.

use crate::harm::Harm;
use crate::point::{PhotoSource, PointError, PointJob, Prompting, measure};
use segwild_eval::oracle::OracleOptions;
use segwild_eval::record::{Provenance, Results};
use segwild_eval::trial::ProviderKind;
use segwild_synthetic::SyntheticOptions;
use std::path::Path;

/// What is guarded. Time and memory are not: they depend on who else uses the machine.
const GUARDED: [&str; 9] =
    ["iou", "boundary_iou", "label_iou", "occluded_leak", "psnr", "splats", "steps", "calls", "pairs"];

/// Two sources, one seen by the oracle and one by the built-in provider, under the quickest preset and `changes`.
/// Scenes and runs are made in `dir`, which is emptied.
pub fn slice(dir: &Path, changes: &[(String, String)], command: String) -> Result<Results, PointError> {
    let mut results = Results { made: Provenance::here(command), ..Results::default() };
    let eyes = [("oracle", 11, ProviderKind::Oracle), ("built-in", 12, ProviderKind::Builtin)];
    for (setting, seed, providers) in eyes {
        let scene = SyntheticOptions {
            seed,
            train: 14,
            test: 3,
            long_side: 112,
            points: 2000,
            ..SyntheticOptions::default()
        };
        let mut settings = vec![("preset".to_owned(), "draft".to_owned())];
        settings.extend_from_slice(changes);
        let job = PointJob {
            protocol: "slice".into(),
            setting: setting.into(),
            at: None,
            source: PhotoSource::Synthetic(scene),
            providers,
            faults: OracleOptions::default(),
            settings,
            harm: Harm::default(),
            prompting: Prompting::Best,
            count: true,
            seed,
            dir: dir.join(setting),
        };
        let _ = std::fs::remove_dir_all(&job.dir);
        for mut record in measure(&job)? {
            record.numbers.retain(|name, _| GUARDED.contains(&name.as_str()));
            if providers == ProviderKind::Builtin {
                // Whether the weak provider selects the occluded wall or not hangs on a hair.
                record.numbers.remove("occluded_leak");
            }
            // Digits beyond these differ from one mathematics library to the next.
            record.numbers.values_mut().for_each(|v| *v = (*v * 1e4).round() / 1e4);
            record.notes.clear();
            results.put(record);
        }
        let _ = std::fs::remove_dir_all(&job.dir);
    }
    Ok(results)
}
