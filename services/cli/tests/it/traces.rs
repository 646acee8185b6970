//! The timeline of a run: printed, plotted, and written for other tools.

use crate::common::*;

#[test]
fn the_timeline_is_printed_plotted_and_written_for_other_tools() {
    let run = &shared_run().run;
    let json = |name: &str| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(run.join(name)).expect("a file")).expect("JSON")
    };
    let events = json("trace.json")["traceEvents"].as_array().expect("events").clone();
    let threads: Vec<&str> = events.iter().filter_map(|e| e["args"]["name"].as_str()).collect();
    for actor in ["coordinator", "trainer", "masks", "features", "ingest", "visibility"] {
        assert!(threads.contains(&actor), "{threads:?}");
    }
    for work in ["keeps the snapshot", "keeps the scene", "evaluate", "objects", "report"] {
        assert!(events.iter().any(|e| e["ph"] == "X" && e["name"] == work), "{work} is not in the trace");
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
    let (stdout, _) = completes(&again(&dir.path().join("run"), &[]));
    assert!(
        stdout.contains("trainer") && stdout.contains("busy") && stdout.contains("waited longest for"),
        "{stdout}"
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
    let run = &shared_run().run;
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
fn a_second_run_and_a_selection_leave_the_first_runs_timeline() {
    let dir = folder();
    let run = dir.path().join("run");
    copy_folder(&shared_run().run, &run);
    let first = std::fs::read(run.join("trace.json")).expect("a trace");
    completes(&again(&run, &[]));
    assert!(select(&run, &[]).status.success());
    let kept: Vec<_> = std::fs::read_dir(run.join("traces")).expect("a folder").flatten().collect();
    let find = |of_selection: bool| {
        let fits =
            |name: &str| name.ends_with(".trace.json") && name.starts_with("selection") == of_selection;
        let found = kept.iter().find(|e| fits(&e.file_name().to_string_lossy()));
        std::fs::read(found.expect("it is kept").path()).expect("it reads")
    };
    let earlier = find(false);
    assert!(earlier == first, "it is as it was");
    assert_ne!(std::fs::read(run.join("trace.json")).expect("a trace"), first);
    assert!(text(&find(true)).contains("segmenter"));
}
