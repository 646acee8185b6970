//! The system's promises: back-pressure, drain, stop, who is stuck, times.
#![allow(
    clippy::disallowed_methods,
    reason = "in these tests sleep stands for work, or lets others come first"
)]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use crate::common::*;
use segwild_flow::*;

/// Passes views on, taking its time.
struct Pass(Sender<TestView>, Duration);
impl Actor for Pass {
    type Message = TestView;
    fn handle(&mut self, view: TestView, _: &Context) -> Result<(), ActorFailure> {
        thread::sleep(self.1);
        self.0.blocking_send(view)?;
        Ok(())
    }
}

#[test]
fn a_slow_consumer_holds_the_chain_back_and_the_times_say_so() {
    let system = System::new(SystemOptions::default()).unwrap();
    let small = Limits { count: 1, bytes: 1 << 20 };
    let (fast, fast_inbox) = mailbox("fast", small);
    let (slow, slow_inbox) = mailbox("slow", small);
    let (out, sink) = mailbox("sink", Limits { count: 100, bytes: 1 << 20 });
    let send = move |_: &Context| {
        for n in 0..10 {
            fast.blocking_send(TestView(n))?;
        }
        Ok(())
    };
    system.source("source", quick(), send).unwrap();
    system.spawn(fast_inbox, quick(), move || Ok(Pass(slow.clone(), Duration::ZERO))).unwrap();
    system.spawn(slow_inbox, quick(), move || Ok(Pass(out.clone(), Duration::from_millis(20)))).unwrap();
    let order: Vec<_> = std::iter::from_fn(|| sink.blocking_recv()).map(|v| v.0).collect();
    assert_eq!(order, (0..10).collect::<Vec<_>>());
    let report = system.join();
    assert!(report.finished(), "{report}");
    let [source, fast, slow] = ["source", "fast", "slow"].map(|name| report.actor(name).unwrap());
    assert!(source.blocked_s > 0.08 && fast.blocked_s > 0.08, "{report}");
    assert!(slow.busy_s > 0.19 && slow.blocked_s < 0.05, "{report}");
    assert!(fast.busy_s < 0.05, "being held back is not work: {report}");
    assert!(slow.mailbox.as_ref().unwrap().back_pressure_s > 0.08);
    // The states add up to the life.
    for actor in &report.actors {
        let life = actor.starting_s + actor.busy_s + actor.waiting_s + actor.blocked_s + actor.back_off_s;
        assert!(life <= report.wall_s + 1e-3 && life > 0.1, "{report}");
    }
    let spans = &report.timeline.spans;
    let blocked = |s: &&TimelineSpan| s.actor == "fast" && s.kind == SpanKind::Blocked && s.label == "slow";
    assert!(spans.iter().filter(blocked).count() >= 5, "the timeline names who holds back whom");
}

#[test]
fn a_drain_finishes_what_is_under_way_in_order() {
    let system = System::new(SystemOptions::default()).unwrap();
    let (first, first_inbox) = mailbox("first", Limits { count: 8, bytes: 1 << 20 });
    let (second, second_inbox) = mailbox("second", Limits { count: 1, bytes: 1 << 20 });
    let (out, sink) = mailbox("sink", Limits { count: 100_000, bytes: 1 << 30 });
    let sent = Arc::new(AtomicU32::new(0));
    let (counted, kept) = (sent.clone(), first.clone());
    let endless = move |context: &Context| {
        while !context.stopping() {
            first.blocking_send(TestView(counted.load(Ordering::Relaxed)))?;
            counted.fetch_add(1, Ordering::Relaxed);
        }
        Ok(())
    };
    system.source("endless", quick(), endless).unwrap();
    system.spawn(first_inbox, quick(), move || Ok(Pass(second.clone(), Duration::ZERO))).unwrap();
    system.spawn(second_inbox, quick(), move || Ok(Pass(out.clone(), Duration::from_millis(1)))).unwrap();
    thread::sleep(Duration::from_millis(50));
    // `kept` still could send: the drain closes the mailbox, and does not wait for its last sender.
    let report = system.shutdown();
    assert!(kept.blocking_send(TestView(0)).is_err());
    let arrived: Vec<_> = std::iter::from_fn(|| sink.blocking_recv()).map(|v| v.0).collect();
    assert_eq!(arrived, (0..sent.load(Ordering::Relaxed)).collect::<Vec<_>>());
    assert!(arrived.len() > 5);
    assert_eq!(report.phase, Phase::Draining);
    assert_eq!(report.actor("endless").unwrap().exit, Exit::Stopped);
    assert_eq!(report.actor("second").unwrap().exit, Exit::Finished);
}

#[test]
fn a_stop_interrupts_work_that_checks_for_it_and_leaves_the_rest() {
    let setup = probe(quick(), SystemOptions::default(), |_, _, context| {
        loop {
            context.check()?;
            context.progress();
            thread::sleep(Duration::from_millis(1));
        }
    });
    send_all(&setup, 0..5);
    thread::sleep(Duration::from_millis(30));
    let stopper = setup.system.stopper();
    let start = Instant::now();
    stopper.stop();
    let (report, log, _) = finish(setup);
    assert!(start.elapsed() < Duration::from_secs(5));
    assert_eq!(log, ["start 0", "stop"], "on_stop can still write a checkpoint");
    let actor = report.actor("probe").unwrap();
    assert_eq!((&actor.exit, actor.messages, actor.quarantined.len()), (&Exit::Stopped, 0, 0));
}

#[test]
fn an_actor_that_ends_too_late_is_named_and_abandoned() {
    let release = Arc::new(AtomicBool::new(false));
    let (held, events) = (release.clone(), Events::new());
    let options = SystemOptions {
        events: events.clone(),
        drain: Duration::from_millis(60),
        grace: Duration::from_millis(60),
        name_late_every: Duration::from_millis(20),
        stuck_after: Duration::from_millis(40),
        ..SystemOptions::default()
    };
    let setup = probe(quick(), options, move |_, _, _| {
        while !held.load(Ordering::Relaxed) {
            thread::sleep(Duration::from_millis(1));
        }
        Ok(())
    });
    send_all(&setup, 0..2);
    setup.system.stopper().drain();
    let start = Instant::now();
    let (report, _, events) = finish(setup);
    assert!(start.elapsed() < Duration::from_secs(5));
    assert_eq!(report.late().collect::<Vec<_>>(), ["probe"]);
    assert_eq!(report.phase, Phase::Stopping, "the drain's deadline has passed");
    let waits = |e: &&Event| matches!(e, Event::ShutdownWaits { actors, .. } if actors == &["probe"]);
    assert!(events.iter().filter(waits).count() >= 2, "{events:?}");
    release.store(true, Ordering::Relaxed);
}

#[test]
fn a_stuck_actor_is_distinguished_from_a_busy_one() {
    let options = SystemOptions { stuck_after: Duration::from_millis(80), ..SystemOptions::default() };
    let setup = probe(quick(), options, |view, _, context| {
        let _loading = (view.0 == 1).then(|| context.busy_zone("loading model"));
        for _ in 0..30 {
            thread::sleep(Duration::from_millis(10));
            if view.0 == 0 {
                context.progress();
            }
        }
        Ok(())
    });
    // 0 shows progress, 1 is in a busy zone, 2 is silent.
    send_all(&setup, 0..3);
    let (report, _, events) = finish(setup);
    let stuck: Vec<_> = events
        .iter()
        .filter_map(|e| {
            if let Event::ActorStuck { label, seconds, .. } = e { Some((label, seconds)) } else { None }
        })
        .collect();
    assert_eq!(stuck.len(), 1, "{events:?}");
    assert!(stuck[0].0 == "view 2" && *stuck[0].1 >= 0.08);
    assert!(events.iter().any(|e| matches!(e, Event::ActorRecovered { .. })));
    let step = |s: &TimelineSpan| s.kind == SpanKind::Step && s.label == "loading model";
    assert!(report.timeline.spans.iter().any(step));
}

#[test]
fn idle_work_yields_to_messages_and_is_finished_in_a_drain() {
    /// A trainer: 200 steps, one at a time, clicks in between.
    struct TrainingActor(u32, Log);
    impl Actor for TrainingActor {
        type Message = TestView;
        fn handle(&mut self, view: TestView, _: &Context) -> Result<(), ActorFailure> {
            self.1.add(format!("click {} at step {}", view.0, self.0));
            Ok(())
        }
        fn on_idle(&mut self, _: &Context) -> Result<Idle, ActorFailure> {
            if self.0 == 200 {
                return Ok(Idle::Wait);
            }
            thread::sleep(Duration::from_micros(500));
            self.0 += 1;
            Ok(Idle::Again)
        }
        fn on_stop(&mut self, _: &Context) -> Result<(), ActorFailure> {
            self.1.add(format!("stop at step {}", self.0));
            Ok(())
        }
    }
    let system = System::new(SystemOptions::default()).unwrap();
    let (clicks, inbox) = mailbox("trainer", Limits::default());
    let log = Log::default();
    let logged = log.clone();
    system.spawn(inbox, quick(), move || Ok(TrainingActor(0, logged.clone()))).unwrap();
    thread::sleep(Duration::from_millis(20));
    clicks.blocking_send_urgent(TestView(7)).unwrap();
    let report = system.shutdown();
    let lines = log.lines();
    assert!(lines[0].starts_with("click 7 at step"), "{lines:?}");
    assert!(!lines[0].ends_with("step 200"), "the click did not wait for the training: {lines:?}");
    assert_eq!(lines[1], "stop at step 200");
    assert!(report.finished());
}

#[test]
fn a_consumer_that_has_gone_ends_the_producer_quietly() {
    let system = System::new(SystemOptions::default()).unwrap();
    let (views, inbox) = mailbox("pass", Limits::default());
    let (out, sink) = mailbox("sink", Limits::default());
    system.spawn(inbox, quick(), move || Ok(Pass(out.clone(), Duration::ZERO))).unwrap();
    drop(sink);
    views.blocking_send(TestView(0)).unwrap();
    let report = system.join();
    let actor = report.actor("pass").unwrap();
    assert_eq!((&actor.exit, actor.quarantined.len(), actor.restarts), (&Exit::DownstreamClosed, 0, 0));
    assert_eq!(report.phase, Phase::Running);
}

#[test]
fn a_dropped_system_stops_and_takes_nobody_in_after() {
    let ended = Stopper::new();
    let options = SystemOptions { stopper: ended.clone(), ..SystemOptions::default() };
    let setup = probe(quick(), options, |_, _, _| Ok(()));
    let watched = setup.log.clone();
    drop(setup.system);
    assert_eq!(ended.phase(), Phase::Stopping);
    let deadline = Instant::now() + Duration::from_secs(10);
    while watched.lines().last().is_none_or(|l| l != "stop") {
        assert!(Instant::now() < deadline, "the actor did not stop");
        thread::sleep(Duration::from_millis(1));
    }

    let system = System::new(SystemOptions::default()).unwrap();
    system.stopper().stop();
    thread::sleep(Duration::from_millis(20));
    let (_views, inbox) = mailbox::<TestView>("late", Limits::default());
    let (out, _sink) = mailbox("sink", Limits::default());
    match system.spawn(inbox, quick(), move || Ok(Pass(out.clone(), Duration::ZERO))) {
        Err(error) => assert_eq!(error.to_string(), "cannot start `late`: the system is stopping"),
        Ok(()) => panic!("an actor was taken in that nobody would stop"),
    }
    assert!(system.join().actors.is_empty());
}

#[test]
fn a_report_and_a_snapshot_are_json_and_a_table() {
    let setup = probe(quick(), SystemOptions::default(), |_, _, _| {
        thread::sleep(Duration::from_millis(30));
        Ok(())
    });
    send_all(&setup, 0..2);
    // The worker takes the first message whenever its thread gets a core.
    let mut live = setup.system.snapshot();
    for _ in 0..2000 {
        if live[0].workers[0].state == WorkerState::Busy {
            break;
        }
        thread::sleep(Duration::from_millis(1));
        live = setup.system.snapshot();
    }
    assert_eq!((live[0].workers[0].state, live[0].workers[0].label.as_str()), (WorkerState::Busy, "view 0"));
    assert_eq!((&live[0].exit, live[0].mailbox.as_ref().unwrap().depth), (&Exit::Running, 1));
    let (report, _, _) = finish(setup);
    let json: serde_json::Value = serde_json::to_value(&report).unwrap();
    assert_eq!(json["actors"][0]["exit"], "finished");
    assert_eq!(json["actors"][0]["messages"], 2);
    let table = report.to_string();
    assert!(table.lines().next().unwrap().contains("blocked s") && table.contains("finished"), "{table}");
}

#[test]
fn a_summary_says_how_many_workers_an_actors_time_is_of() {
    let system = System::new(SystemOptions::default()).unwrap();
    let limits = Limits { count: 8, bytes: 1 << 20 };
    let (out, sink) = mailbox("sink", limits);
    for (name, workers) in [("alone", 1), ("many", 3)] {
        let (tasks, inbox) = mailbox(name, limits);
        let out = out.clone();
        let options = ActorOptions { workers, ..quick() };
        system.spawn(inbox, options, move || Ok(Pass(out.clone(), Duration::ZERO))).unwrap();
        tasks.blocking_send(TestView(1)).unwrap();
    }
    drop(out);
    assert_eq!(std::iter::from_fn(|| sink.blocking_recv()).count(), 2);
    let summary = trace::summary(&system.join());
    let line = |name: &str| summary.lines().find(|line| line.starts_with(name)).unwrap().to_owned();
    assert!(line("many").contains(" in 3 workers") && !line("alone").contains("workers"), "{summary}");
}

#[test]
fn restarts_count_within_their_window_only() {
    let fails_six_times = |window: Duration| {
        let system = System::new(SystemOptions::default()).unwrap();
        let pause = Duration::from_millis(10);
        let budget = RestartBudget { restarts: 2, window, first_delay: pause, longest_delay: pause };
        let mut left = 6;
        let send = move |_: &Context| {
            if left == 0 {
                return Ok(());
            }
            left -= 1;
            Err(ActorFailure::restart("not yet"))
        };
        system.source("source", ActorOptions { budget, ..quick() }, send).unwrap();
        let report = system.join();
        (report.finished(), report.actor("source").unwrap().restarts)
    };
    assert_eq!(fails_six_times(Duration::from_secs(60)), (false, 2));
    // Each restart is forgotten before the next.
    assert_eq!(fails_six_times(Duration::from_millis(1)), (true, 6));
}
