//! The metrics' names, their page, and their values for a batch.

use crate::common::*;
use segwild_monitor::metrics::{Metric, MetricKind, render};
use std::collections::BTreeSet;
use std::io::Write;
use std::path::Path;

#[test]
fn metric_names_follow_the_rules() {
    let mut names = BTreeSet::new();
    for &metric in Metric::ALL {
        let name = metric.name();
        assert!(names.insert(name), "{name} is there twice");
        assert!(
            name.starts_with("segwild_") && name.chars().all(|c| c.is_ascii_lowercase() || c == '_'),
            "{name}"
        );
        assert_eq!(name.ends_with("_total"), metric.kind() == MetricKind::Counter, "{name}");
        assert!(metric.help().ends_with('.'), "{name}");
    }
}

#[test]
fn the_operators_page_explains_every_metric() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/guide/operate.md");
    let page = std::fs::read_to_string(page).expect("the page");
    for &metric in Metric::ALL {
        let row = page.lines().find(|l| {
            let rest = l.strip_prefix("| `").and_then(|l| l.strip_prefix(metric.name()));
            rest.is_some_and(|rest| rest.starts_with(['`', '{']))
        });
        let row = row.unwrap_or_else(|| panic!("{} is not on the page", metric.name()));
        assert!(metric == Metric::BuildInfo || row.contains(metric.help()), "{row}");
    }
}

#[test]
fn the_metrics_text_holds_the_view() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (path, _ledger, _lock) = batch_in(dir.path());
    let text = render(Some(&view(&path)), false);
    for line in [
        "segwild_scenes{state=\"running\"} 1",
        "segwild_dead_letters 1",
        "segwild_scene_retries_total 1",
        "segwild_stage_views_total{stage=\"sky\",outcome=\"failed\"} 1",
        "segwild_stage_task_duration_seconds_bucket{stage=\"sky\",le=\"0.3\"} 1",
        "segwild_stage_task_duration_seconds_count{stage=\"sky\"} 1",
        "segwild_mailbox_depth{actor=\"masks\"} 18",
        "segwild_backpressure_seconds_total{actor=\"masks\"} 7.5",
        "segwild_actor_stuck{actor=\"masks\"} 1",
        "segwild_actor_stuck{actor=\"trainer\"} 0",
        "segwild_cache_requests_total{result=\"corrupt\"} 1",
        "segwild_cache_requests_total{result=\"miss\"} 3",
        "segwild_stage_queue_depth{stage=\"geometry\"} 500",
        "segwild_budget_cores{part=\"declared\"} 2",
    ] {
        assert!(text.lines().any(|l| l == line), "`{line}` is missing:\n{text}");
    }
    assert!(!text.contains("liberty"), "no scene is a label");
    assert!(render(Some(&view(&path)), true).contains("{scene=\"liberty\",actor=\"masks\"}"));
    promtool_agrees(&text);
    assert!(render(None, false).contains("segwild_build_info"));
}

/// `promtool check metrics` has nothing to say about names, units and help texts.
fn promtool_agrees(text: &str) {
    let promtool = std::process::Command::new("promtool")
        .args(["check", "metrics"])
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn();
    let Ok(mut promtool) = promtool else {
        println!("skipped: promtool check metrics: promtool is not installed (apt-get install prometheus)");
        return;
    };
    promtool.stdin.take().expect("a pipe").write_all(text.as_bytes()).expect("it reads");
    let output = promtool.wait_with_output().expect("it ends");
    let printed = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && printed.trim().is_empty(), "{printed}");
}
