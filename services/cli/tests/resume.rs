//! What an operator counts on: killed, torn, full, read-only, in use: a sentence and an exit code, nothing lost, and in
//! the end the same bytes.

mod common;

use common::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

/// The command line of the finished run, into another folder.
fn again(out: &Path, more: &[&str]) -> Vec<String> {
    let (scene, out) = (show(&place().scene), show(out));
    let mut args = vec!["run".to_owned(), scene, "--out".into(), out];
    for flag in QUICK.chunks(2).filter(|flag| !more.contains(&flag[0])) {
        args.extend(flag.iter().map(|s| (*s).to_owned()));
    }
    args.extend(more.iter().map(|s| (*s).to_owned()));
    args
}

fn output(args: &[String]) -> Output {
    segwild(&args.iter().map(String::as_str).collect::<Vec<_>>())
}

fn completes(args: &[String]) -> (String, String) {
    let output = output(args);
    let (out, error) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(0), "{args:?} said: {error}");
    (out, error)
}

fn start(args: &[String]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_segwild"))
        .args(args)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts")
}

/// The hash of everything a run made: model, features, scores, and every artefact in the cache.
fn results(run: &Path) -> BTreeMap<PathBuf, blake3::Hash> {
    let mut found = BTreeMap::new();
    let mut folders = vec![run.join("cache"), run.join("selections")];
    let mut files: Vec<PathBuf> =
        ["model.bin", "features.bin", "scene.ply", "evaluation.json", "history.jsonl"]
            .map(|f| run.join(f))
            .into();
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            let name = entry.file_name();
            if entry.path().is_dir() && name != "tmp" && name != "corrupt" {
                folders.push(entry.path());
            // The summary of a selection says how long it took.
            } else if entry.path().is_file()
                && name != "summary.json"
                && !name.to_string_lossy().starts_with('.')
            {
                files.push(entry.path());
            }
        }
    }
    for file in files {
        let bytes = std::fs::read(&file).expect("it is there");
        found.insert(file.strip_prefix(run).expect("inside").to_owned(), blake3::hash(&bytes));
    }
    found
}

/// Compares with the run that nothing happened to.
fn same_as_untouched(run: &Path) {
    let (ours, theirs) = (results(run), results(&place().run));
    for (file, hash) in &theirs {
        assert_eq!(ours.get(file), Some(hash), "{} differs or is missing", file.display());
    }
    assert_eq!(ours.len(), theirs.len(), "something was made that an untouched run does not make");
}

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
        let output = output(&again(&run, &["--fault", fault]));
        let said = text(&output.stderr);
        assert!(output.status.code().is_none() && said.contains("fault: killed"), "{fault}: {said}");
        completes(&again(&run, &[]));
        same_as_untouched(&run);
    }

    // A selection that is killed while it is written, and made again.
    let click = &place().manifest.objects.iter().flat_map(|o| &o.clicks).next().expect("a click");
    let at = format!("{},{}", click.x, click.y);
    let run = dir.path().join("kill@trainer.handle");
    let select = |run: &Path, fault: &[&str]| {
        let run = show(run);
        segwild(&[&["segment", &run, "--photo", &click.photo, "--in", &at, "--name", "it"], fault].concat())
    };
    assert_eq!(select(&run, &["--fault", "kill@file.rename:3"]).status.code(), None);
    assert_eq!(select(&run, &[]).status.code(), Some(0));
    let kept = folder();
    let other = copied_run(&kept);
    assert_eq!(select(&other, &[]).status.code(), Some(0));
    assert_eq!(results(&run), results(&other));
}

#[test]
fn until_a_step_and_on_from_there_is_the_same_as_straight() {
    let dir = folder();
    let run = dir.path().join("run");
    let (said, _) = completes(&again(&run, &["--until", "20"]));
    assert!(said.contains("stopped at step 20"), "{said}");
    assert!(!run.join("model.bin").exists());
    let status = works(&["status", &show(&run), "--json"]);
    assert!(status.contains("\"pending\"") && !status.contains("\"running\":true"), "{status}");
    let (_, told) = completes(&again(&run, &["--until", "40"]));
    assert!(told.contains("goes on from step 20"), "{told}");
    // Asked for what was reached already, it has nothing to do.
    let (said, _) = completes(&again(&run, &["--until", "30"]));
    assert!(said.contains("stopped at step 40"), "{said}");
    completes(&again(&run, &[]));
    same_as_untouched(&run);

    // Past the settings' own steps: from the end of this run, and straight from nothing.
    let straight = dir.path().join("straight");
    completes(&again(&straight, &["--until", "80"]));
    let (_, told) = completes(&again(&run, &["--until", "80"]));
    assert!(told.contains("goes on from step 60"), "{told}");
    let model = |run: &Path| std::fs::read(run.join("model.bin")).expect("a model");
    assert!(model(&run) == model(&straight));
    assert!(model(&run) != model(&place().run), "twenty more steps change something");
    refuses(&["run", "x", "--until", "geometri"], 2, &["geometri", "geometry", "training steps"]);
}

#[test]
fn a_torn_checkpoint_is_passed_over_for_the_one_before_and_named() {
    for damage in ["torn", "flipped", "gone"] {
        let dir = folder();
        let run = dir.path().join("run");
        for step in ["20", "40"] {
            completes(&again(&run, &["--until", step]));
        }
        let checkpoints = || std::fs::read_dir(run.join("checkpoints")).expect("a folder").flatten();
        let newest = checkpoints().map(|e| e.path()).max().expect("a checkpoint");
        let mut bytes = std::fs::read(&newest).expect("a checkpoint");
        match damage {
            "torn" => bytes.truncate(bytes.len() / 2),
            _ => bytes[1000] ^= 1,
        }
        std::fs::write(&newest, bytes).expect("it is written");
        if damage == "gone" {
            std::fs::remove_file(&newest).expect("it goes");
        }
        let (_, told) = completes(&again(&run, &[]));
        assert!(told.contains("-00000040.bin is passed over"), "{told}");
        assert!(told.contains("goes on from step 20"), "{told}");
        same_as_untouched(&run);
        let kept = checkpoints().count();
        assert!(kept <= 2, "{kept} checkpoints are kept, not 2");
    }
}

#[test]
fn a_damaged_artefact_is_made_again() {
    let dir = folder();
    let run = copied_run(&dir);
    let (said, _) = completes(&again(&run, &["--fault", "corrupt@cache.read:5", "--json"]));
    let summary = said.lines().last().expect("a summary");
    assert!(summary.contains("\"made\":1,"), "{summary}");
    same_as_untouched(&run);
}

#[test]
fn a_panic_and_a_passing_error_cost_an_attempt_and_nothing_else() {
    let dir = folder();
    let run = dir.path().join("run");
    let faults = ["--fault", "panic@masks.handle:2", "--fault", "fail@features.handle:3"];
    let (_, told) = completes(&again(&run, &faults));
    assert!(told.contains("masks was restarted: panic: a fault on purpose"), "{told}");
    same_as_untouched(&run);
}

#[test]
fn a_trainer_that_panics_ends_the_run_in_words_instead_of_a_wait_for_ever() {
    let dir = folder();
    let run = dir.path().join("run");
    let output = output(&again(&run, &["--fault", "panic@trainer.handle"]));
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(4), "{said}");
    assert!(said.contains("stage `geometry` failed: panic: a fault on purpose"), "{said}");
    completes(&again(&run, &[]));
    same_as_untouched(&run);
}

#[test]
fn an_actor_that_fails_at_everything_is_no_stop_by_the_user() {
    let dir = folder();
    let run = dir.path().join("run");
    let output = output(&again(&run, &["--fault", "fail@masks.handle:1+"]));
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(4), "{said}");
    assert!(said.contains("stage `masks` failed") && said.contains("in a row"), "{said}");
}

#[test]
fn a_memory_budget_that_cannot_be_kept_is_refused_with_the_number() {
    let dir = folder();
    let args = again(&dir.path().join("run"), &["--memory-budget", "40"]);
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    refuses(&args, 2, &["needs about", "MiB", "allows 40", "--splats"]);
    let run = dir.path().join("small");
    completes(&again(&run, &["--memory-budget", "160"]));
    same_as_untouched(&run);
}

#[test]
fn the_timeline_is_told_drawn_and_written_for_other_tools() {
    let run = &place().run;
    let json = |name: &str| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(run.join(name)).expect("a file")).expect("JSON")
    };
    let events = json("trace.json")["traceEvents"].as_array().expect("events").clone();
    let threads: Vec<&str> = events.iter().filter_map(|e| e["args"]["name"].as_str()).collect();
    for actor in ["trainer", "masks", "features", "ingest", "visibility"] {
        assert!(threads.contains(&actor), "{threads:?}");
    }
    assert!(
        events.iter().any(|e| e["ph"] == "X" && e["name"] == "60 steps" && e["dur"].as_f64() > Some(1000.0))
    );
    let trace = json("trace.otlp.json");
    let spans = trace["resourceSpans"][0]["scopeSpans"][0]["spans"].as_array().expect("spans").clone();
    let ids: std::collections::BTreeSet<&str> = spans.iter().filter_map(|s| s["spanId"].as_str()).collect();
    assert_eq!(ids.len(), spans.len(), "every span has an identifier of its own");
    for span in &spans {
        let nanos =
            |name: &str| span[name].as_str().and_then(|t| t.parse::<u64>().ok()).expect("a time as text");
        assert!(nanos("startTimeUnixNano") <= nanos("endTimeUnixNano"), "{span}");
        assert_eq!(span["traceId"].as_str().map(str::len), Some(32));
        let parent = span["parentSpanId"].as_str().expect("text");
        assert!(parent.is_empty() || ids.contains(parent), "{span}");
    }
    let report = std::fs::read_to_string(run.join("report.html")).expect("a report");
    assert!(report.contains("Who did what when") && report.contains("<title>60 steps"));
    let dir = folder();
    let (said, _) = completes(&again(&dir.path().join("run"), &[]));
    assert!(
        said.contains("trainer") && said.contains("busy") && said.contains("waited longest for"),
        "{said}"
    );
}

/// Asserts that an object has the named fields only, those before the `|` always.
fn has_fields(value: &serde_json::Value, fields: &str) {
    let object = value.as_object().unwrap_or_else(|| panic!("no object: {value}"));
    let (needed, allowed) = fields.split_once('|').unwrap_or((fields, ""));
    for field in needed.split_whitespace() {
        assert!(object.contains_key(field), "`{field}` is missing: {value}");
    }
    for field in object.keys() {
        let known = needed.split_whitespace().chain(allowed.split_whitespace()).any(|f| f == field);
        assert!(known, "`{field}` is no field of the format: {value}");
    }
}

#[test]
fn the_traces_have_the_fields_of_their_formats_and_no_others() {
    let run = &place().run;
    let json = |name: &str| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(run.join(name)).expect("a file")).expect("JSON")
    };
    let list = |value: &serde_json::Value| value.as_array().expect("a list").clone();
    let attributes = |value: &serde_json::Value| {
        for pair in list(value) {
            has_fields(&pair, "key value");
            has_fields(&pair["value"], "stringValue");
            assert!(pair["key"].is_string() && pair["value"]["stringValue"].is_string(), "{pair}");
        }
    };
    // ExportTraceServiceRequest in the JSON mapping of OTLP: camelCase names, identifiers as hex, 64-bit numbers as
    // text, enumerations as numbers.
    let hex = |value: &serde_json::Value, digits: usize| {
        let id = value.as_str().expect("text");
        assert!(id.len() == digits && id.bytes().all(|b| b.is_ascii_hexdigit()), "{id}");
        assert!(id.bytes().any(|b| b != b'0'), "an identifier is never zero");
    };
    let otlp = json("trace.otlp.json");
    has_fields(&otlp, "resourceSpans");
    let mut count = 0;
    for resource in list(&otlp["resourceSpans"]) {
        has_fields(&resource, "resource scopeSpans | schemaUrl");
        has_fields(&resource["resource"], "attributes | droppedAttributesCount");
        attributes(&resource["resource"]["attributes"]);
        for scope in list(&resource["scopeSpans"]) {
            has_fields(&scope, "scope spans | schemaUrl");
            has_fields(&scope["scope"], "name version | attributes droppedAttributesCount");
            for span in list(&scope["spans"]) {
                has_fields(
                    &span,
                    "traceId spanId name kind startTimeUnixNano endTimeUnixNano | parentSpanId traceState flags attributes \
                     droppedAttributesCount events droppedEventsCount links droppedLinksCount status",
                );
                hex(&span["traceId"], 32);
                hex(&span["spanId"], 16);
                let parent = &span["parentSpanId"];
                if parent != "" {
                    hex(parent, 16);
                }
                assert!(span["kind"].as_u64().is_some_and(|kind| kind <= 5), "{span}");
                for time in ["startTimeUnixNano", "endTimeUnixNano"] {
                    assert!(span[time].as_str().is_some_and(|t| t.parse::<u64>().is_ok()), "{span}");
                }
                attributes(&span["attributes"]);
                has_fields(&span["status"], "| code message");
                count += 1;
            }
        }
    }
    assert!(count > 20, "{count} spans");

    // Chrome's trace events, in the form of an object.
    let chrome = json("trace.json");
    has_fields(&chrome, "traceEvents | displayTimeUnit");
    assert!(["ms", "ns"].iter().any(|unit| chrome["displayTimeUnit"] == *unit));
    let mut named = std::collections::BTreeSet::new();
    for event in list(&chrome["traceEvents"]) {
        assert!(event["pid"].is_u64() && event["tid"].is_u64() && event["name"].is_string(), "{event}");
        if event["ph"] == "M" {
            has_fields(&event, "ph name pid tid args");
            assert!(event["name"] == "process_name" || event["name"] == "thread_name", "{event}");
            assert!(event["args"]["name"].is_string(), "{event}");
            named.insert(event["tid"].as_u64());
        } else {
            has_fields(&event, "ph name cat pid tid ts dur");
            assert_eq!(event["ph"], "X", "{event}");
            for number in ["ts", "dur"] {
                assert!(event[number].as_f64().is_some_and(|n| n >= 0.0), "{event}");
            }
            assert!(named.contains(&event["tid"].as_u64()), "a row without a name: {event}");
        }
    }
}

#[test]
fn one_kept_checkpoint_is_the_newest_and_a_damaged_one_costs_the_training_and_no_more() {
    let dir = folder();
    let run = dir.path().join("run");
    let one = ["--keep-checkpoints", "1"];
    let checkpoints = || {
        let names = std::fs::read_dir(run.join("checkpoints")).expect("a folder").flatten();
        let mut names: Vec<String> = names.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    };
    for step in ["20", "40"] {
        completes(&again(&run, &[&one[..], &["--until", step]].concat()));
        let kept = checkpoints();
        let ending = format!("-{step:0>8}.bin");
        assert!(kept.len() == 1 && kept[0].ends_with(&ending), "after step {step}: {kept:?}");
    }
    let newest = run.join("checkpoints").join(&checkpoints()[0]);
    let mut bytes = std::fs::read(&newest).expect("a checkpoint");
    bytes.truncate(bytes.len() / 2);
    std::fs::write(&newest, bytes).expect("it is written");
    let (_, told) = completes(&again(&run, &one));
    assert!(told.contains("-00000040.bin is passed over"), "{told}");
    assert!(!told.contains("goes on from step"), "there is none to go on from: {told}");
    assert!(checkpoints().len() <= 1, "{:?}", checkpoints());
    same_as_untouched(&run);
}

#[test]
fn explain_names_what_would_be_done_again_and_why() {
    let dir = folder();
    let run = copied_run(&dir);
    let plan = |scene: &Path, more: &[&str]| -> BTreeMap<String, (String, String)> {
        let (scene, out) = (show(scene), show(&run));
        let args = [&["run", &scene, "--out", &out, "--explain", "--json"], more].concat();
        let plans: serde_json::Value = serde_json::from_str(&works(&args)).expect("JSON");
        let text = |v: &serde_json::Value| v.as_str().unwrap_or_default().to_owned();
        let plans = plans.as_array().expect("a list").iter();
        plans.map(|p| (text(&p["stage"]), (text(&p["verdict"]), p["why"].to_string()))).collect()
    };
    let scene = place().scene.clone();
    let done_again = |plan: &BTreeMap<String, (String, String)>| -> Vec<String> {
        plan.iter().filter(|(_, (verdict, _))| verdict != "reused").map(|(stage, _)| stage.clone()).collect()
    };
    let before = results(&run);
    assert_eq!(done_again(&plan(&scene, &[])), ["report"]);
    let channels = plan(&scene, &["--channels", "16"]);
    assert_eq!(done_again(&channels), ["features", "report"]);
    assert!(channels["features"].1.contains("channels: 64 -> 16"), "{channels:?}");
    let steps = plan(&scene, &["--steps", "61", "--channels", "16", "--tau", "0.4"]);
    assert_eq!(done_again(&steps), ["evaluate", "features", "geometry", "masks", "report"]);
    assert_eq!(steps["geometry"].1, "[\"steps: 60 -> 61\"]");
    assert!(steps["features"].1.contains("channels") && steps["features"].1.contains("steps"), "{steps:?}");
    // Memory changes nothing that is made.
    assert_eq!(done_again(&plan(&scene, &["--photo-cache-mib", "7", "--feature-memory", "7"])), ["report"]);
    let more = plan(&scene, &["--until", "80"]);
    assert_eq!(more["geometry"].0, "goes_on", "{more:?}");
    assert!(results(&run) == before, "nothing was done");

    // Another photo under the same name; a run that does not exist.
    let other = dir.path().join("scene");
    copy_folder(&scene, &other);
    let names: Vec<_> = place().manifest.photos.iter().filter(|p| !p.test).map(|p| p.name.clone()).collect();
    let photo = other.join("images").join(&names[0]);
    let mut picture = segwild_scene::Image::read(&photo).expect("a picture");
    picture.data[0] = 1.0 - picture.data[0];
    picture.write_png(&photo).expect("it is written");
    let changed = plan(&other, &[]);
    assert_eq!(changed["sky"].0, "partly", "{changed:?}");
    assert!(changed["sky"].1.contains(&format!("{} has changed", names[0])), "{changed:?}");
    let nowhere = show(&dir.path().join("new"));
    let said = works(&["run", &show(&scene), "--out", &nowhere, "--explain"]);
    assert!(said.contains("geometry  made") && said.contains("the run is new"), "{said}");
    assert!(!Path::new(&nowhere).exists(), "explaining makes nothing");
}

#[test]
fn the_cache_is_listed_verified_and_swept() {
    let dir = folder();
    let path = copied_run(&dir);
    let run = show(&path);
    completes(&again(&path, &["--prompt-budget", "30"]));
    let list = works(&["cache", "ls", &run]);
    assert!(list.contains("masks") && list.contains("8 (") && list.contains("of other settings"), "{list}");
    assert!(works(&["cache", "verify", &run]).contains("0 damaged"));
    let dry = works(&["cache", "gc", &run, "--dry-run"]);
    let done = works(&["cache", "gc", &run]);
    assert_eq!(dry.split(',').next(), done.split(',').next());
    assert!(!works(&["cache", "ls", &run]).contains("other settings"));
    // What is used stays: nothing is made again.
    let (said, _) = completes(&again(&path, &["--prompt-budget", "30", "--json"]));
    assert!(said.lines().last().is_some_and(|l| l.contains("\"made\":0,")), "{said}");

    let shelves = std::fs::read_dir(path.join("cache/masks.d")).expect("masks").flatten();
    let mut files = shelves.flat_map(|shelf| std::fs::read_dir(shelf.path()).expect("a shelf").flatten());
    let file = files.next().expect("a file").path();
    let mut bytes = std::fs::read(&file).expect("bytes");
    *bytes.last_mut().expect("a byte") ^= 1;
    std::fs::write(&file, bytes).expect("it is written");
    refuses(&["cache", "verify", &run], 6, &["1 of", "damaged", "makes them anew"]);
    let (said, _) = completes(&again(&path, &["--prompt-budget", "30", "--json"]));
    assert!(said.lines().last().is_some_and(|l| l.contains("\"made\":1,")), "{said}");
    // A run may sweep behind itself.
    completes(&again(&path, &["--prompt-budget", "31"]));
    let (_, told) = completes(&again(&path, &["--prompt-budget", "31", "--cache-limit", "1"]));
    let bytes: u64 = works(&["cache", "ls", &run, "--json"])
        .split("\"bytes\":")
        .skip(1)
        .filter_map(|t| t.split(',').next()?.parse::<u64>().ok())
        .sum();
    assert!(bytes <= 1 << 20 || told.contains("left the cache"), "{bytes} {told}");
}

/// Waits until a condition holds while a child lives.
fn wait_for(child: &mut Child, what: &str, done: impl Fn() -> bool) {
    while !done() {
        assert!(child.try_wait().expect("a child").is_none(), "it ended before: {what}");
        std::thread::yield_now();
    }
}

#[test]
fn a_second_process_is_refused_and_may_look() {
    let dir = folder();
    let run = dir.path().join("run");
    let mut first = start(&again(&run, &["--fault", "stall@masks.handle:3"]));
    wait_for(&mut first, "it holds the run", || run.join("scene.json").is_file());
    let pid = first.id().to_string();
    let args = again(&run, &[]);
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    refuses(&args, 6, &["in use by process", &pid]);
    refuses(&["cache", "gc", &show(&run)], 6, &["in use by process", &pid]);
    assert!(works(&["status", &show(&run)]).contains(&pid));
    works(&["cache", "ls", &show(&run)]);
    works(&[&args[..], &["--explain"]].concat());
    first.kill().expect("it can be killed");
    first.wait().expect("it ends");
    completes(&again(&run, &[]));
    same_as_untouched(&run);
}

#[cfg(unix)]
fn signal(child: &Child, signal: &str) {
    let sent = Command::new("kill").args([signal, &child.id().to_string()]).status();
    assert!(sent.expect("`kill` is there").success());
}

#[cfg(unix)]
#[test]
fn ctrl_c_once_stops_in_order_and_twice_at_once_and_both_go_on() {
    let dir = folder();
    let run = dir.path().join("run");
    // An actor that has stopped answering cannot stop in order; the second signal does not wait for it.
    for (presses, fault) in [(1, "fail@masks.handle:999"), (2, "stall@masks.handle:3")] {
        let mut child = start(&again(&run, &["--steps", "4000", "--fault", fault]));
        let pid = child.id().to_string();
        wait_for(&mut child, "it holds the run", || {
            std::fs::read_to_string(run.join("run.lock")).is_ok_and(|owner| owner.trim() == pid)
        });
        if presses == 1 {
            wait_for(&mut child, "it trains", || {
                std::fs::read_to_string(run.join("history.jsonl")).is_ok_and(|lines| !lines.is_empty())
            });
        }
        for _ in 0..presses {
            signal(&child, "-INT");
            // Two signals within an instant are one.
            std::thread::park_timeout(std::time::Duration::from_millis(300));
        }
        let output = child.wait_with_output().expect("it ends");
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(130), "{said}");
        assert!(said.contains("stopping where the run can continue"), "{said}");
    }
    completes(&again(&run, &["--steps", "60"]));
    same_as_untouched_but_for(&run, 4000);
}

/// As [`same_as_untouched`], where other step counts were tried before in the same folder.
fn same_as_untouched_but_for(run: &Path, _steps: u32) {
    let (ours, theirs) = (results(run), results(&place().run));
    for (file, hash) in &theirs {
        assert_eq!(ours.get(file), Some(hash), "{} differs or is missing", file.display());
    }
}

#[test]
fn a_full_disk_is_said_and_loses_nothing() {
    let dir = folder();
    let run = dir.path().join("run");
    for point in
        ["full@file.write:8+", "full@ledger.commit:30+", "full@checkpoint.save", "full@file.write:5+"]
    {
        let output = output(&again(&run, &["--fault", point]));
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(6), "{point}: {said}");
        assert!(said.contains("error:") && said.contains("the disk is full"), "{point}: {said}");
        assert!(!said.contains("panicked"), "{said}");
    }
    completes(&again(&run, &[]));
    same_as_untouched(&run);
}

/// A file system of our own, unmounted when dropped; `None` where mounting is not allowed.
struct Mounted(PathBuf);
impl Mounted {
    fn new(at: PathBuf, options: &str) -> Option<Mounted> {
        std::fs::create_dir_all(&at).expect("a folder");
        let mount = Command::new("mount").args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(&at).output();
        mount.is_ok_and(|o| o.status.success()).then_some(Mounted(at))
    }
}
impl Drop for Mounted {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

#[test]
fn a_really_full_and_a_really_read_only_disk_are_said() {
    let dir = folder();
    let Some(disk) = Mounted::new(dir.path().join("disk"), "size=400k") else {
        eprintln!(
            "skipped: a_really_full_and_a_really_read_only_disk_are_said: mounting is not allowed here"
        );
        return;
    };
    let args = again(&disk.0.join("run"), &[]);
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    refuses(&args, 6, &["error:", "disk is full"]);
    let remount = |options: &str| {
        let done = Command::new("mount").args(["-o", options]).arg(&disk.0).status();
        assert!(done.expect("`mount` is there").success());
    };
    remount("remount,ro");
    refuses(&args, 6, &["error:", "read"]);
    works(&["status", &show(&disk.0.join("run"))]);
    remount("remount,rw,size=100m");
    works(&args);
    same_as_untouched(&disk.0.join("run"));
}

#[test]
fn a_read_only_folder_is_said() {
    let dir = folder();
    let run = dir.path().join("run");
    for point in ["read-only@file.write", "read-only@ledger.commit:12+"] {
        let args = again(&run, &["--fault", point]);
        refuses(&args.iter().map(String::as_str).collect::<Vec<_>>(), 6, &["read-only file system"]);
    }
    let occupied = dir.path().join("occupied");
    std::fs::write(&occupied, "a file").expect("it is written");
    let args = again(&occupied, &[]);
    refuses(&args.iter().map(String::as_str).collect::<Vec<_>>(), 6, &["occupied"]);
}

#[test]
fn a_clock_that_jumps_changes_nothing() {
    let dir = folder();
    let run = dir.path().join("run");
    completes(&again(&run, &["--fault", "jump@clock:30+"]));
    same_as_untouched(&run);
    let status = works(&["status", &show(&run)]);
    assert!(!status.contains("-8") && status.contains("geometry  done"), "{status}");
}
