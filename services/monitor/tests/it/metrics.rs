//! The metrics' names, their page, and their values for a batch.

use crate::common::*;
use segwild_farm::{EmbeddedEngine, ErrorClass, Job, JobEngine, Needs, WorkerOffer};
use segwild_monitor::MonitorTarget;
use segwild_monitor::metrics::{Metric, MetricKind, render};
use segwild_monitor::view::FarmTarget;
use std::collections::BTreeSet;
use std::io::Write;
use std::path::Path;
use std::sync::Arc;

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
fn the_dashboards_show_metrics_that_are_there() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/grafana/dashboards");
    let known: BTreeSet<&str> = Metric::ALL.iter().map(|metric| metric.name()).collect();
    let mut shown = BTreeSet::new();
    for dashboard in ["segwild.json", "farm.json"] {
        let text = std::fs::read_to_string(folder.join(dashboard)).expect("a dashboard");
        let page: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        let panels = page["panels"].as_array().expect("panels");
        for target in panels.iter().flat_map(|panel| panel["targets"].as_array().expect("targets")) {
            let expression = target["expr"].as_str().expect("an expression");
            let words = expression.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
            for name in words.filter(|word| word.starts_with("segwild_")) {
                let name = name.strip_suffix("_bucket").unwrap_or(name);
                assert!(known.contains(name), "{dashboard}: {name}");
                shown.insert(name.to_owned());
            }
        }
    }
    // Every metric of a farm has a panel.
    let missing = known.iter().filter(|name| name.starts_with("segwild_farm_") && !shown.contains(**name));
    assert_eq!(missing.count(), 0, "{shown:?}");
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

#[test]
fn a_farm_shows_its_queue_and_what_each_worker_did() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let engine = Arc::new(EmbeddedEngine::open(dir.path().join("jobs.sqlite")).expect("an engine"));
    let target = MonitorTarget::Farm(FarmTarget::new("farm", engine.clone()));
    let shown = || render(Some(&target.view().expect("a view")), false);
    let text = shown();
    assert!(
        text.contains("segwild_farm_queue_depth{accelerator=\"any\"} 0\n"),
        "it is there when it is 0: {text}"
    );
    assert!(!text.contains("worker="), "{text}");
    for name in ["a", "b", "c", "d"] {
        engine.publish(&Job::new(name, "{}", Needs::default())).expect("it is published");
    }
    let wanted = Job { accelerator: Some("h100".into()), ..Job::new("e", "{}", Needs::default()) };
    engine.publish(&wanted).expect("it is published");
    let claim = |worker: &str| {
        engine.claim(&WorkerOffer::all(worker, Needs::default(), 60.0)).expect("it works").expect("a lease")
    };
    engine.complete(&claim("first"), "done").expect("it is held");
    engine.fail(&claim("first"), ErrorClass::Fatal, "bad input").expect("it is held");
    engine.fail(&claim("second"), ErrorClass::Stopped, "stopped").expect("it is held");
    claim("second");
    engine.note_pause("first", Some("its disk is full")).expect("it works");
    let text = shown();
    for line in [
        "segwild_farm_queue_depth{accelerator=\"any\"} 1",
        "segwild_farm_queue_depth{accelerator=\"h100\"} 1",
        "segwild_farm_worker_scenes{worker=\"first\"} 0",
        "segwild_farm_worker_scenes{worker=\"second\"} 1",
        "segwild_farm_worker_paused{worker=\"first\"} 1",
        "segwild_farm_worker_paused{worker=\"second\"} 0",
        "segwild_farm_worker_attempts_total{worker=\"first\",outcome=\"done\"} 1",
        "segwild_farm_worker_attempts_total{worker=\"first\",outcome=\"failed\"} 1",
        "segwild_farm_worker_attempts_total{worker=\"second\",outcome=\"returned\"} 1",
        "segwild_farm_worker_attempts_total{worker=\"second\",outcome=\"done\"} 0",
        "segwild_dead_letters 1",
    ] {
        assert!(text.lines().any(|l| l == line), "`{line}` is missing:\n{text}");
    }
    let age = |worker: &str| {
        let start = format!("segwild_farm_heartbeat_age_seconds{{worker=\"{worker}\"}} ");
        text.lines().find_map(|line| line.strip_prefix(&*start)?.parse::<f64>().ok())
    };
    assert_eq!(age("first"), None, "who holds nothing gives no sign");
    assert!(age("second").is_some_and(|age| (0.0..60.0).contains(&age)), "{text}");
    promtool_agrees(&text);
    // A log that has forgotten what its workers did, and not what they hold.
    let again = EmbeddedEngine::open(dir.path().join("jobs.sqlite")).expect("the same jobs");
    let target = MonitorTarget::Farm(FarmTarget::new("farm", Arc::new(again)));
    let text = render(Some(&target.view().expect("a view")), false);
    let shown = |line: &str| text.lines().any(|l| l.starts_with(line));
    assert!(shown("segwild_farm_worker_scenes{worker=\"second\"} 1"), "{text}");
    assert!(shown("segwild_farm_heartbeat_age_seconds{worker=\"second\"} "), "{text}");
    assert!(!shown("segwild_farm_worker_scenes{worker=\"first\"}"), "{text}");
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
