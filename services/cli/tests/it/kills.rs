//! Killed in any stage, at any point, a run ends in the same bytes.

use crate::common::*;
use std::path::Path;

#[test]
fn killed_in_every_stage_it_ends_in_the_same_bytes() {
    let dir = folder();
    // In the sky, the embeddings, the training, the masks, the field, while a
    // file is renamed, while a commit is under way, while a checkpoint is saved.
    for fault in [
        "kill@masks.handle:3",
        "kill@features.handle:4",
        "kill@trainer.handle",
        "kill@file.rename:9",
        "kill@ledger.commit:30",
        "kill@masks.handle:14",
        "kill@checkpoint.save",
        "kill@features.handle:9",
        "kill@file.write:12",
        "kill@ledger.commit:48",
    ] {
        let run = dir.path().join(fault);
        killed_at(&run, fault);
        completes(&again(&run, &[]));
        same_as_untouched(&run);
    }
}

/// Runs to a kill at a point, and says whether it came.
fn killed_at(run: &Path, fault: &str) {
    let output = output(&again(run, &["--fault", fault]));
    let stdout = text(&output.stderr);
    assert!(output.status.code().is_none() && stdout.contains("fault: killed"), "{fault}: {stdout}");
}

#[test]
fn killed_within_the_evaluation_or_the_report_it_ends_in_the_same_bytes() {
    let dir = folder();
    // All before the evaluation is done: these start where it is.
    for (fault, doing) in [
        ("kill@visibility.photo:4", "geometry"),
        ("kill@features.step:3", "features"),
        ("kill@features.step:10", "features"),
        ("kill@evaluate.photo:1", "evaluate"),
        ("kill@evaluate.photo:2", "evaluate"),
        ("kill@report.image:1", "report"),
        ("kill@report.image:5", "report"),
    ] {
        let run = dir.path().join(fault);
        killed_at(&run, fault);
        let status = works(&["status", &show(&run)]);
        let line = status.lines().find(|line| line.trim_start().starts_with(doing)).unwrap_or_default();
        assert!(
            line.contains("interrupted") || !line.contains("done") || doing == "geometry",
            "{fault}: {status}"
        );
        completes(&again(&run, &[]));
        same_as_untouched(&run);
        assert!(run.join("report.html").is_file());
    }
}

#[test]
fn a_selection_killed_half_written_is_not_there_and_the_next_is_whole() {
    let dir = folder();
    let (run, other) = (dir.path().join("run"), dir.path().join("other"));
    for folder in [&run, &other] {
        copy_folder(&shared_run().run, folder);
    }
    assert_eq!(select(&other, &[]).status.code(), Some(0));
    let expected = results(&other);
    for fault in ["kill@segmenter.handle", "kill@file.rename", "kill@selection.file", "kill@selection.file:7"]
    {
        assert_eq!(select(&run, &["--fault", fault]).status.code(), None, "{fault}");
        assert!(!run.join("selections/it").exists(), "{fault}: half a selection is there");
        assert!(!works(&["status", &show(&run)]).contains("selections:"), "{fault}");
    }
    assert_eq!(select(&run, &[]).status.code(), Some(0));
    assert_eq!(results(&run), expected);
    // One that is killed while it replaces another leaves the other as it was.
    assert_eq!(select(&run, &["--fault", "kill@selection.file:9"]).status.code(), None);
    assert_eq!(select(&run, &["--fault", "kill@report.image:2"]).status.code(), None);
    assert_eq!(select(&run, &[]).status.code(), Some(0));
    assert_eq!(results(&run), expected);
    let left = std::fs::read_dir(run.join("selections")).expect("a folder").count();
    assert_eq!(left, 1, "what was killed has left something behind");
}
