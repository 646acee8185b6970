//! A timeline in the formats that other tools open: Chrome's trace events (Perfetto, `chrome://tracing`) and
//! OpenTelemetry spans as OTLP/JSON.
//!
//! ```
//! use segwild_flow::*;
//! let system = System::new(SystemOptions::default()).unwrap();
//! system.source("numbers", ActorOptions::default(), |context| {
//!     let _step = context.span("count");
//!     Ok(())
//! }).unwrap();
//! let report = system.join();
//! let (mut chrome, mut otlp) = (Vec::new(), Vec::new());
//! trace::chrome(&report, "demo", &mut chrome).unwrap();
//! let chrome: serde_json::Value = serde_json::from_slice(&chrome).unwrap();
//! assert!(chrome["traceEvents"].as_array().unwrap().iter().any(|e| e["args"]["name"] == "numbers"));
//! trace::otlp(&report, "demo", &mut otlp).unwrap();
//! let otlp: serde_json::Value = serde_json::from_slice(&otlp).unwrap();
//! assert_eq!(otlp["resourceSpans"][0]["scopeSpans"][0]["spans"][0]["name"], "demo");
//! ```

use std::collections::BTreeMap;
use std::io::{self, Write};

use serde_json::{Value, json};

use crate::report::Report;
use crate::timeline::{SpanKind, TimelineSpan};

/// What a span's time went to, in a word.
fn word(kind: SpanKind) -> &'static str {
    match kind {
        SpanKind::Start => "start",
        SpanKind::Busy => "busy",
        SpanKind::Step => "step",
        SpanKind::Wait => "waiting for input",
        SpanKind::Blocked => "held back",
        SpanKind::BackOff => "back-off",
    }
}

/// A span's name: what it was about, or what the time went to.
fn name(span: &TimelineSpan) -> String {
    match (span.kind, span.label.is_empty()) {
        (SpanKind::Blocked, false) => format!("waits for {}", span.label),
        (_, false) => span.label.clone(),
        (kind, true) => word(kind).to_owned(),
    }
}

/// A row per worker, in the order in which they first appear.
fn rows(report: &Report) -> BTreeMap<(&str, u32), usize> {
    let mut rows = BTreeMap::new();
    for actor in &report.actors {
        for worker in 0..actor.workers.len().max(1) as u32 {
            let next = rows.len() + 1;
            rows.entry((actor.name.as_str(), worker)).or_insert(next);
        }
    }
    for span in &report.timeline.spans {
        let next = rows.len() + 1;
        rows.entry((span.actor.as_str(), span.worker)).or_insert(next);
    }
    rows
}

fn worker_name(actor: &str, worker: u32) -> String {
    if worker == 0 { actor.to_owned() } else { format!("{actor} {worker}") }
}

/// The inside of a JSON list, written value by value: the text of all spans would be the largest thing in memory.
struct List<W> {
    out: W,
    is_empty: bool,
}

impl<W: Write> List<W> {
    fn new(out: W) -> List<W> {
        List { out, is_empty: true }
    }

    fn push(&mut self, value: &Value) -> io::Result<()> {
        let comma = if self.is_empty { "" } else { ",\n" };
        self.is_empty = false;
        write!(self.out, "{comma}{value}")
    }
}

/// Writes Chrome's trace events: one process named after the run, one thread per worker, times in microseconds.
///
/// # Errors
/// Those of `out`.
pub fn chrome(report: &Report, run: &str, mut out: impl Write) -> io::Result<()> {
    let rows = rows(report);
    write!(out, "{{\"displayTimeUnit\":\"ms\",\"traceEvents\":[")?;
    let mut events = List::new(&mut out);
    events.push(&json!({"ph": "M", "name": "process_name", "pid": 1, "tid": 0, "args": {"name": run}}))?;
    for ((actor, worker), row) in &rows {
        let args = json!({"name": worker_name(actor, *worker)});
        events.push(&json!({"ph": "M", "name": "thread_name", "pid": 1, "tid": row, "args": args}))?;
    }
    for span in &report.timeline.spans {
        events.push(&json!({
            "ph": "X",
            "name": name(span),
            "cat": word(span.kind),
            "pid": 1,
            "tid": rows[&(span.actor.as_str(), span.worker)],
            "ts": (span.start * 1e6).round(),
            "dur": ((span.end - span.start) * 1e6).round(),
        }))?;
    }
    writeln!(out, "]}}")
}

/// Writes one OTLP/JSON export request: a trace of the run, a span per worker below it, their spans below those.
///
/// # Errors
/// Those of `out`.
pub fn otlp(report: &Report, run: &str, mut out: impl Write) -> io::Result<()> {
    let began = report.timeline.began;
    let id = blake3::hash(format!("{run} {began} {}", std::process::id()).as_bytes()).to_hex().to_string();
    let trace = &id[..32];
    // Identifiers of spans are never zero.
    let span_id = |n: usize| format!("{:016x}", n + 1);
    let nanos = |seconds: f64| format!("{}", ((began + seconds).max(0.0) * 1e9) as u64);
    let text = |key: &str, value: &str| json!({"key": key, "value": {"stringValue": value}});
    let resource = json!({"attributes": [text("service.name", "segwild")]});
    let scope = json!({"name": env!("CARGO_PKG_NAME"), "version": env!("CARGO_PKG_VERSION")});
    write!(
        out,
        "{{\"resourceSpans\":[{{\"resource\":{resource},\"scopeSpans\":[{{\"scope\":{scope},\"spans\":["
    )?;
    let mut spans = List::new(&mut out);
    let mut span = |n: usize, parent: Option<usize>, name: &str, start: f64, end: f64, attributes: Value| {
        spans.push(&json!({
            "traceId": trace,
            "spanId": span_id(n),
            "parentSpanId": parent.map(span_id).unwrap_or_default(),
            "name": name,
            "kind": 1, // internal
            "startTimeUnixNano": nanos(start),
            "endTimeUnixNano": nanos(end),
            "attributes": attributes,
            "status": {},
        }))
    };
    span(0, None, run, 0.0, report.wall_s, json!([]))?;
    let rows = rows(report);
    for ((actor, worker), row) in &rows {
        let mine = report.timeline.spans.iter().filter(|s| s.actor == *actor && s.worker == *worker);
        let (start, end) = mine.fold((report.wall_s, 0.0f64), |(a, b), s| (s.start.min(a), s.end.max(b)));
        let attributes = json!([text("segwild.actor", actor)]);
        span(*row, Some(0), &worker_name(actor, *worker), start.min(end), end, attributes)?;
    }
    for (n, s) in report.timeline.spans.iter().enumerate() {
        let row = rows[&(s.actor.as_str(), s.worker)];
        let attributes = json!([text("segwild.actor", &s.actor), text("segwild.state", word(s.kind))]);
        span(rows.len() + 1 + n, Some(row), &name(s), s.start, s.end, attributes)?;
    }
    writeln!(out, "]}}]}}]}}")
}

/// A few lines for a person: where each actor's time went, the busiest first, and what it waited for longest.
pub fn summary(report: &Report) -> String {
    let mut actors: Vec<_> = report.actors.iter().collect();
    actors.sort_by(|a, b| b.busy_s.total_cmp(&a.busy_s));
    let width = actors.iter().map(|a| a.name.len()).max().unwrap_or(0);
    let mut text = String::new();
    for a in actors {
        let mut waits: BTreeMap<String, f64> = BTreeMap::new();
        for s in report.timeline.spans.iter().filter(|s| s.actor == a.name) {
            let reason = match s.kind {
                SpanKind::Wait => "input".to_owned(),
                // `sky of IMG_01.jpg`, `sky of IMG_02.jpg`, ..: all of them are waiting for the sky.
                SpanKind::Blocked => s.label.split(" of ").next().unwrap_or_default().to_owned(),
                SpanKind::BackOff => "another attempt".to_owned(),
                SpanKind::Start | SpanKind::Busy | SpanKind::Step => continue,
            };
            *waits.entry(reason).or_default() += s.end - s.start;
        }
        let longest = waits.into_iter().filter(|w| w.1 >= 0.05).max_by(|x, y| x.1.total_cmp(&y.1));
        let longest =
            longest.map_or(String::new(), |(what, s)| format!(", waited longest for {what} ({s:.1} s)"));
        let waited = a.waiting_s + a.blocked_s + a.back_off_s;
        let together = match a.workers.len() {
            0 | 1 => String::new(),
            many => format!(" in {many} workers"),
        };
        text += &format!(
            "{:width$}  busy {:>6.1} s, waiting {waited:>6.1} s{together}{longest}\n",
            a.name, a.busy_s
        );
    }
    text
}
