//! Files of a run that are text or databases, and those of benchmarks.

use crate::seeds::{run, run_for};
use crate::yard::{folder, put, take};
use crate::{FuzzTarget, seal};
use segwild_eval::{protocols, record};
use segwild_monitor::metrics;
use segwild_pipeline::{Replay, RunFolder, Settings};
use std::path::PathBuf;
use std::sync::OnceLock;

const JSON: &[&str] = &["null", "{}", "[]", "[", "{\"", "\":", "1e999", "-0", "\\ud800", "true", "\"\""];

pub(super) const SETTINGS: FuzzTarget = FuzzTarget {
    name: "settings_toml",
    seeds: || vec![take(&run().join("segwild.toml"))],
    words: &[
        "[scene]\n",
        "[[run]]\n",
        "size = ",
        "steps = -1\n",
        "= nan",
        "= inf",
        "\u{feff}",
        "\"\"\"",
        "'''",
        "\\u0000",
        "= []",
    ],
    seal: seal::nothing,
    read: |bytes| {
        let file = folder("settings_toml").join("segwild.toml");
        put(&file, bytes);
        if let Ok(settings) = Settings::layered(Some(&file), &[]) {
            put(&file, settings.to_toml().as_bytes());
            let again = Settings::layered(Some(&file), &[]).map(|again| again.to_toml());
            assert_eq!(again.ok(), Some(settings.to_toml()), "what is read is not what was written");
        }
    },
};

pub(super) const PROMPTS: FuzzTarget = FuzzTarget {
    name: "prompts_json",
    seeds: || {
        let texts = [
            r#"[{"photo": "photo0.png", "points": [{"x": 3.5, "y": 4, "inside": true}], "boxes": [], "granularity": null}]"#,
            r#"{"prompts": [{"photo": "photo1.png", "points": [], "boxes": [{"min": [1, 2], "max": [9, 9]}]}], "settings": null}"#,
        ];
        texts.map(|text| text.as_bytes().to_vec()).to_vec()
    },
    words: JSON,
    seal: seal::nothing,
    read: |bytes| {
        let file = folder("prompts_json").join("prompts.json");
        put(&file, bytes);
        let _ = Replay::read(&file);
    },
};

/// A run folder of a target's own.
fn own(target: &'static str, cell: &'static OnceLock<PathBuf>) -> &'static PathBuf {
    cell.get_or_init(|| run_for(target))
}

pub(super) const SCENE_JSON: FuzzTarget = FuzzTarget {
    name: "scene_json",
    seeds: || vec![take(&run().join("scene.json"))],
    words: JSON,
    seal: seal::nothing,
    read: |bytes| {
        static RUN: OnceLock<PathBuf> = OnceLock::new();
        let run = own("scene_json", &RUN);
        put(&run.join("scene.json"), bytes);
        let folder = RunFolder::at(run);
        let _ = (folder.mask_files(), folder.load());
    },
};

pub(super) const HISTORY: FuzzTarget = FuzzTarget {
    name: "history_and_timeline",
    seeds: || vec![take(&run().join("history.jsonl")), take(&run().join("timeline.json"))],
    words: JSON,
    seal: seal::nothing,
    read: |bytes| {
        static RUN: OnceLock<PathBuf> = OnceLock::new();
        let run = own("history_and_timeline", &RUN);
        put(&run.join("history.jsonl"), bytes);
        put(&run.join("timeline.json"), bytes);
        let _ = segwild_pipeline::write_report(&RunFolder::at(run));
    },
};

/// What `status`, `top` and the server make of a folder.
pub(super) fn open_all(folder: &std::path::Path) {
    let view = segwild_monitor::MonitorTarget::at(folder).and_then(|target| target.view());
    let _ = segwild_monitor::ready(view.as_ref());
    let view = view.ok();
    let _ = metrics::render(view.as_ref(), true);
    let _ = view.map(|view| serde_json::to_string(&view));
}

pub(super) const LEDGER: FuzzTarget = FuzzTarget {
    name: "ledger_sqlite",
    seeds: || vec![take(&run().join("run.sqlite"))],
    words: &["SQLite format 3\0", "CREATE TABLE ", "done", "geometry", "\0\0\0\0"],
    seal: seal::nothing,
    read: |bytes| {
        let folder = folder("ledger_sqlite");
        put(&folder.join("run.sqlite"), bytes);
        open_all(&folder);
    },
};

pub(super) const RESULTS: FuzzTarget = FuzzTarget {
    name: "results_json",
    seeds: || vec![include_bytes!("../../../../services/bench/slice.json").to_vec()],
    words: JSON,
    seal: seal::nothing,
    read: |bytes| {
        let file = folder("results_json").join("results.json");
        put(&file, bytes);
        let _ = record::Results::read(&file);
    },
};

pub(super) const PARTS: FuzzTarget = FuzzTarget {
    name: "parts_json",
    seeds: || vec![br#"{"IMG_01": [240, 12], "IMG_02": []}"#.to_vec()],
    words: JSON,
    seal: seal::nothing,
    read: |bytes| {
        let file = folder("parts_json").join("parts.json");
        put(&file, bytes);
        let _ = protocols::folder::read_parts(&file);
    },
};
