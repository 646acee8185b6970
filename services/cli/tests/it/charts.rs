//! `segwild bench chart`, `compare`, `stability` and `scale`: what they leave, and how they end.

use crate::common::*;
use std::path::Path;

/// A results file with one number of one setting, over four trainings.
fn results(file: &Path, number: &str, value: f64) {
    by("built-in", file, number, value);
}

/// The same on the masks of a provider.
fn by(provider: &str, file: &Path, number: &str, value: f64) {
    let records: Vec<serde_json::Value> = (1..=4)
        .map(|seed| {
            let swing = 0.001 * f64::from(seed % 2);
            serde_json::json!({
                "protocol": "synthetic", "scene": "seed 1", "setting": "full", "seed": seed, "provider": provider,
                "numbers": { number: value + swing },
            })
        })
        .collect();
    let whole = serde_json::json!({
        "made": { "command": "segwild bench", "version": "0", "machine": "none" }, "records": records,
    });
    std::fs::write(file, whole.to_string()).expect("a file");
}

#[test]
fn a_comparison_fails_by_its_code_only_when_wanted_and_only_of_what_got_worse() {
    let dir = folder();
    let file = |name: &str| dir.path().join(name);
    results(&file("old"), "iou", 0.8);
    results(&file("worse"), "iou", 0.75);
    results(&file("better"), "iou", 0.85);
    results(&file("other"), "psnr", 20.0);
    let compare = |new: &str, more: &[&str]| {
        let (old, new) = (show(&file("old")), show(&file(new)));
        let start = ["bench", "compare", old.as_str(), new.as_str()];
        start.iter().chain(more).map(|w| (*w).to_owned()).collect::<Vec<String>>()
    };
    let stderr = |args: Vec<String>| works(&args.iter().map(String::as_str).collect::<Vec<_>>());
    let stdout = stderr(compare("worse", &[]));
    assert!(stdout.contains("worse  synthetic full") && stdout.contains("4 trainings"), "{stdout}");
    assert!(stderr(compare("better", &["--fail"])).contains("1 better"));
    assert!(stderr(compare("old", &["--fail"])).contains("1 the same"));
    for new in ["worse", "other"] {
        let args = compare(new, &["--fail"]);
        refuses(
            &args.iter().map(String::as_str).collect::<Vec<_>>(),
            7,
            &["1 worse", "0 better"][..usize::from(new == "worse")],
        );
    }
    // What no user has is never set beside what a user gets.
    by("oracle", &file("oracle"), "iou", 0.9);
    let args = compare("oracle", &[]);
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    refuses(&args, 3, &["built-in", "oracle", "do not compare"]);
    let missing = compare("none", &[]);
    refuses(&missing.iter().map(String::as_str).collect::<Vec<_>>(), 3, &["none"]);
}

#[test]
fn a_chart_goes_on_where_it_stopped_and_refuses_another_default() {
    let dir = folder();
    let out = show(dir.path());
    let chart = |only: &str, more: &[&str]| {
        let small = ["--photo-count", "6", "--pixels", "64", "--refine-steps", "0", "--prompt-budget", "8"];
        let rest = ["--steps", "30", "--seeds", "1", "--only", only, "--out", out.as_str()];
        let start = ["bench", "chart"];
        start.iter().chain(&small).chain(&rest).chain(more).map(|w| (*w).to_owned()).collect::<Vec<String>>()
    };
    let stderr = |args: Vec<String>| works(&args.iter().map(String::as_str).collect::<Vec<_>>());
    let points = |stdout: &str| (stdout.matches("IoU 0.").count(), stdout.matches("(known)").count());
    let stdout = stderr(chart("channels=4,channels=16", &[]));
    assert_eq!(points(&stdout), (3, 0), "{stdout}");
    let stdout = stderr(chart("channels", &[]));
    assert_eq!(points(&stdout), (5, 3), "{stdout}");
    for name in ["index.html", "README.md", "chart.svg", "chart.png", "sweeps.png", "results.csv"] {
        assert!(dir.path().join(name).is_file(), "{name}");
    }
    let page = std::fs::read_to_string(dir.path().join("README.md")).expect("a page");
    assert!(page.contains("## channels") && page.contains("| the default |"), "{page}");
    assert!(page.lines().next().is_some_and(|title| title.ends_with("(built-in)")), "{page}");
    let photos = &["bench", "chart", "--scene", "none", "--providers", "oracle"];
    refuses(photos, 2, &["synthetic scenes only"]);
    // The folder holds what the built-in provider gave: the oracle's figures do not go in between.
    let oracle = chart("channels", &["--providers", "oracle"]);
    refuses(&oracle.iter().map(String::as_str).collect::<Vec<_>>(), 6, &["another default"]);
    let other = chart("channels", &["--tau", "0.4"]);
    refuses(&other.iter().map(String::as_str).collect::<Vec<_>>(), 6, &["another default"]);
    refuses(&["bench", "chart", "--only", "no-such-sweep", "--out", &out], 2, &["no-such-sweep", "density"]);
    refuses(
        &["bench", "stability", "--only", "no-such-row", "--out", &out],
        2,
        &["no-such-row", "occluders"],
    );
    // A fault of the oracle is no stress that another provider can be put under.
    let faults = ["bench", "stability", "--only", "missing masks", "--out", &out];
    refuses(&faults, 2, &["there is no row `missing masks`"]);
    refuses(&["bench", "scale", "--only", "no-such-axis", "--out", &out], 2, &["no-such-axis", "photos"]);
}
