//! Who did what when: spans, kept in bounded memory.
//!
//! ```
//! use segwild_flow::{SpanKind, Timeline};
//! use std::time::{Duration, Instant};
//! let timeline = Timeline::new(1000);
//! let start = Instant::now();
//! timeline.record("masks", 0, "photo.jpg", start, start + Duration::from_millis(20), SpanKind::Busy);
//! let json = timeline.snapshot().to_json();
//! assert!(json.contains("photo.jpg"), "{json}");
//! ```

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::clock::now;
use crate::lock;

/// What a span's time went to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SpanKind {
    /// Building the actor.
    Start,
    /// Work on a message.
    Busy,
    /// A named part of the work, inside a `Start` or `Busy` span.
    Step,
    /// Waiting for input.
    Wait,
    /// Waiting for space in a mailbox or for another's result, which the label names.
    Blocked,
    /// Waiting before another attempt.
    BackOff,
}

/// A stretch of one worker's time, in seconds since the timeline began.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TimelineSpan {
    /// The actor.
    pub actor: String,
    /// Which of its workers.
    pub worker: u32,
    /// What it was about.
    pub label: String,
    /// When it began.
    pub start: f64,
    /// When it ended.
    pub end: f64,
    /// What the time went to.
    pub kind: SpanKind,
}

/// A copy of a timeline.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TimelineRecord {
    /// When it began, in seconds since 1970.
    pub began: f64,
    /// Shorter spans were dropped to bound the memory, in seconds.
    pub shortest: f64,
    /// How many were dropped.
    pub dropped: u64,
    /// The spans, in order of their ends.
    pub spans: Vec<TimelineSpan>,
}

impl TimelineRecord {
    /// As JSON.
    pub fn to_json(&self) -> String {
        // Numbers and strings only: nothing here can fail to serialise.
        serde_json::to_string(self).unwrap_or_default()
    }
}

/// A span as it is held: there are dozens for each photo of a run, about few different things.
struct HeldSpan {
    /// Number of the actor's name.
    actor: u32,
    worker: u32,
    /// Number of the label.
    label: u32,
    start: f64,
    end: f64,
    kind: SpanKind,
}

impl HeldSpan {
    fn length(&self) -> f64 {
        self.end - self.start
    }
}

/// Names of actors and labels, each held once.
#[derive(Default)]
struct SpanNames {
    names: Vec<Arc<str>>,
    numbers: HashMap<Arc<str>, u32>,
}

impl SpanNames {
    fn number(&mut self, name: &str) -> u32 {
        if let Some(&number) = self.numbers.get(name) {
            return number;
        }
        // Never more names than two for each span.
        let (number, name) = (self.names.len() as u32, Arc::<str>::from(name));
        self.names.push(name.clone());
        self.numbers.insert(name, number);
        number
    }

    fn name(&self, number: u32) -> &str {
        &self.names[number as usize]
    }
}

#[derive(Default)]
struct Store {
    spans: Vec<HeldSpan>,
    names: SpanNames,
    shortest: f64,
    dropped: u64,
}

/// Records spans; clones record to the same timeline. When it is full, the shortest spans are dropped: the
/// diagram gets coarser, never cut off.
#[derive(Clone)]
pub struct Timeline {
    origin: Instant,
    began: f64,
    capacity: usize,
    store: Arc<Mutex<Store>>,
}

impl Timeline {
    /// Starts a timeline of at most so many spans (at least 16).
    pub fn new(capacity: usize) -> Self {
        Self { origin: Instant::now(), began: now(), capacity: capacity.max(16), store: Arc::default() }
    }

    /// Adds a span.
    pub fn record(
        &self,
        actor: &str,
        worker: u32,
        label: &str,
        start: Instant,
        end: Instant,
        kind: SpanKind,
    ) {
        let start = start.saturating_duration_since(self.origin).as_secs_f64();
        let end = end.saturating_duration_since(self.origin).as_secs_f64();
        let mut store = lock(&self.store);
        if end - start < store.shortest {
            store.dropped += 1;
            return;
        }
        let (actor, label) = (store.names.number(actor), store.names.number(label));
        store.spans.push(HeldSpan { actor, worker, label, start, end, kind });
        if store.spans.len() >= self.capacity {
            store.thin(self.capacity / 2);
        }
    }

    /// A copy of what was recorded so far.
    pub fn snapshot(&self) -> TimelineRecord {
        let store = lock(&self.store);
        let whole = |span: &HeldSpan| TimelineSpan {
            actor: store.names.name(span.actor).into(),
            worker: span.worker,
            label: store.names.name(span.label).into(),
            start: span.start,
            end: span.end,
            kind: span.kind,
        };
        TimelineRecord {
            began: self.began,
            shortest: store.shortest,
            dropped: store.dropped,
            spans: store.spans.iter().map(whole).collect(),
        }
    }
}

impl Store {
    /// Keeps the longest, and the names of those.
    fn thin(&mut self, keep: usize) {
        let mut lengths: Vec<f64> = self.spans.iter().map(HeldSpan::length).collect();
        let before = self.spans.len();
        lengths.sort_by(f64::total_cmp);
        let threshold = lengths[before - keep];
        // Spans of equal length must not keep the store full.
        let mut equal = lengths[before - keep..].iter().take_while(|&&l| l == threshold).count();
        self.spans.retain(|s| {
            let length = s.length();
            if length == threshold {
                let fits = equal > 0;
                equal = equal.saturating_sub(1);
                return fits;
            }
            length > threshold
        });
        self.shortest = threshold;
        self.dropped += (before - self.spans.len()) as u64;
        let names = std::mem::take(&mut self.names);
        for span in &mut self.spans {
            span.actor = self.names.number(names.name(span.actor));
            span.label = self.names.number(names.name(span.label));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn a_full_timeline_keeps_the_longest_spans() {
        let timeline = Timeline::new(64);
        let start = Instant::now();
        for i in 0..10_000u64 {
            let micros = if i % 1000 == 500 { 1_000_000 } else { 1 + i % 7 };
            let end = start + Duration::from_micros(micros);
            timeline.record("masks", 0, &format!("photo {i}"), start, end, SpanKind::Busy);
        }
        let names = lock(&timeline.store).names.names.len();
        assert!(names <= 65, "{names}: the names of dropped spans are dropped, too");
        let record = timeline.snapshot();
        assert!(record.spans.len() < 64);
        assert!(record.spans.iter().all(|s| s.actor == "masks"));
        let longest = record.spans.iter().filter(|s| s.end - s.start > 0.5).map(|s| s.label.clone());
        assert!(longest.eq((0..10).map(|k| format!("photo {}", 500 + 1000 * k))));
        assert_eq!(record.dropped + record.spans.len() as u64, 10_000);
        assert_eq!(
            serde_json::from_str::<TimelineRecord>(&record.to_json()).unwrap().dropped,
            record.dropped
        );
    }
}
