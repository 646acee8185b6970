//! What listeners receive.
#![allow(
    clippy::disallowed_methods,
    reason = "in these tests sleep stands for work, or lets others come first"
)]

use std::io::{self, Write};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use segwild_flow::{Event, EventLevel, EventRecord, Events};

#[derive(Clone, Default)]
struct SharedBuffer(Arc<Mutex<Vec<u8>>>);
impl Write for SharedBuffer {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// One event of each kind.
fn one_of_each() -> Vec<Event> {
    let (stage, actor) = ("masks".to_string(), "masks".to_string());
    vec![
        Event::StageStarted { stage: stage.clone(), total: Some(3) },
        Event::StageProgress {
            stage: stage.clone(),
            part: None,
            done: 1,
            total: None,
            rate: 0.5,
            eta_s: None,
        },
        Event::StageFinished {
            stage: stage.clone(),
            done: 3,
            failed: 1,
            cached: 1,
            wall_s: 2.0,
            cpu_s: Some(1.5),
        },
        Event::StageSkipped { stage: stage.clone(), key: "masks:00".into() },
        Event::StageFailed { stage: stage.clone(), error: "disk full".into() },
        Event::ViewFailed { stage: stage.clone(), view: "a.jpg".into(), error: "dark".into(), attempts: 3 },
        Event::ActorRestarted {
            actor: actor.clone(),
            worker: 0,
            cause: "panic".into(),
            restarts: 1,
            delay_s: 0.1,
        },
        Event::ActorFailed { actor: actor.clone(), error: "no model".into() },
        Event::ActorStuck { actor: actor.clone(), worker: 1, label: "a.jpg".into(), seconds: 60.5 },
        Event::ActorRecovered { actor: actor.clone(), worker: 1 },
        Event::ShutdownWaits { actors: vec![actor], left_s: 4.0 },
        Event::Warning { stage: None, message: "\"quoted\"\nand broken".into() },
        Event::Metric { stage: Some(stage), name: "psnr_db".into(), value: 23.5, step: Some(500) },
        Event::Message { level: EventLevel::Info, stage: None, message: "hello".into() },
    ]
}

#[test]
fn every_event_is_one_line_of_json_and_comes_back() {
    let (events, out) = (Events::new(), SharedBuffer::default());
    let sink = events.json_lines(out.clone()).unwrap();
    one_of_each().into_iter().for_each(|event| events.tell(event));
    drop(sink);
    let text = String::from_utf8(out.0.lock().unwrap().clone()).unwrap();
    let records: Vec<EventRecord> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(records.iter().map(|r| r.event.clone()).collect::<Vec<_>>(), one_of_each());
    assert!(
        text.lines().next().unwrap().contains(r#""event":"stage_started","stage":"masks","total":3"#),
        "{text}"
    );
    assert!(records.iter().all(|r| r.time > 1.7e9));
}

#[test]
fn a_listener_that_sleeps_blocks_nobody_and_misses_only_what_passes() {
    let events = Events::new();
    let listener = events.subscribe();
    let start = Instant::now();
    for n in 0..200_000u64 {
        events.metric("training", "loss", 1.0, Some(n));
        if n % 10_000 == 0 {
            events.warn(None, format!("warning {n}"));
        }
    }
    assert!(start.elapsed() < Duration::from_secs(5));
    let received: Vec<_> = std::iter::from_fn(|| listener.try_next()).map(|r| r.event).collect();
    let warnings = received.iter().filter(|e| e.level() == EventLevel::Warning).count();
    assert_eq!(warnings, 20);
    assert!(received.len() < 2000);
    assert_eq!(listener.dropped() + received.len() as u64, 200_020);
}

#[test]
fn a_reader_that_has_gone_is_no_error() {
    struct Gone(Arc<Mutex<u32>>);
    impl Write for Gone {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            *self.0.lock().unwrap() += 1;
            Err(io::ErrorKind::BrokenPipe.into())
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }
    let (events, writes) = (Events::new(), Arc::new(Mutex::new(0)));
    let sink = events.json_lines(Gone(writes.clone())).unwrap();
    (0..5).for_each(|_| events.info(None, "message"));
    drop(sink);
    assert_eq!(*writes.lock().unwrap(), 1);
}

#[test]
fn listening_ends_with_the_last_teller() {
    let events = Events::new();
    let listener = events.subscribe();
    let teller = events.clone();
    let telling = thread::spawn(move || {
        thread::sleep(Duration::from_millis(20));
        teller.info(None, "last words");
    });
    drop(events);
    assert!(matches!(listener.next().unwrap().event, Event::Message { .. }));
    assert_eq!(listener.next(), None);
    telling.join().unwrap();
}

#[test]
fn rate_and_time_left_follow_the_work_and_not_the_cache() {
    let events = Events::new();
    let listener = events.subscribe();
    let mut stage = events.stage("masks", Some(1000));
    stage.cached(900);
    for _ in 0..20 {
        thread::sleep(Duration::from_millis(10));
        stage.advance(1);
    }
    // At most 100 a second: every step slept at least 10 ms.
    assert!(stage.rate() > 5.0 && stage.rate() <= 101.0, "{}", stage.rate());
    let eta = stage.eta().unwrap();
    assert!((eta - 80.0 / stage.rate()).abs() < 1e-9, "{eta}");
    stage.failed(80);
    stage.finish();
    let received: Vec<_> = std::iter::from_fn(|| listener.try_next()).map(|r| r.event).collect();
    let progress = received.iter().filter(|e| matches!(e, Event::StageProgress { .. })).count();
    assert!((2..=12).contains(&progress), "reported at most ten times a second, and at the end: {progress}");
    assert!(matches!(received[received.len() - 2], Event::StageProgress { done: 1000, .. }));
    assert!(matches!(
        received.last(),
        Some(Event::StageFinished { done: 1000, failed: 80, cached: 900, .. })
    ));
}
