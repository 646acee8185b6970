//! What supervision promises: attempts, quarantine, restarts within a budget.
#![allow(
    clippy::disallowed_methods,
    reason = "in these tests sleep stands for work, or lets others come first"
)]

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use crate::common::*;
use segwild_flow::*;

#[test]
fn a_failure_is_tried_again_in_the_same_instance() {
    let tries = AtomicU32::new(0);
    let setup = probe(quick(), SystemOptions::default(), move |view, _, _| {
        if view.0 == 1 && tries.fetch_add(1, Ordering::Relaxed) < 2 { Err(Busy.into()) } else { Ok(()) }
    });
    send_all(&setup, 0..3);
    let (report, log, _) = finish(setup);
    assert_eq!(log, ["start 0", "view 0", "view 1", "view 2", "stop"]);
    let actor = report.actor("probe").unwrap();
    assert_eq!((actor.messages, actor.retries, actor.restarts, actor.quarantined.len()), (3, 2, 0, 0));
    assert!(report.finished());
}

#[test]
fn a_view_that_fails_for_good_is_named_and_the_rest_goes_on() {
    let setup = probe(quick(), SystemOptions::default(), |view, _, _| match view.0 {
        1 => Err(Busy.into()),
        3 => Err(ActorFailure::reject("no pixels")),
        _ => Ok(()),
    });
    send_all(&setup, 0..5);
    let (report, log, events) = finish(setup);
    assert_eq!(log, ["start 0", "view 0", "gave up view 1", "view 2", "gave up view 3", "view 4", "stop"]);
    let actor = report.actor("probe").unwrap();
    let given_up = [
        Quarantined { label: "view 1".into(), error: "the provider is busy".into(), attempts: 3 },
        Quarantined { label: "view 3".into(), error: "no pixels".into(), attempts: 1 },
    ];
    assert_eq!(actor.quarantined, given_up);
    assert_eq!((actor.messages, actor.retries), (3, 2));
    let given_up = events.iter().filter(|e| matches!(e, Event::GivenUp { .. })).count();
    assert_eq!(given_up, 2);
    assert!(report.finished(), "quarantine is no failure of the actor");
}

#[test]
fn a_panic_costs_the_instance_but_not_the_mailbox_nor_the_message() {
    let setup = probe(quick(), SystemOptions::default(), |view, instance, _| {
        assert!(view.0 != 1 || instance >= 2, "index {} out of range", view.0);
        Ok(())
    });
    send_all(&setup, 0..4);
    let (report, log, events) = finish(setup);
    assert_eq!(log, ["start 0", "view 0", "start 1", "start 2", "view 1", "view 2", "view 3", "stop"]);
    let actor = report.actor("probe").unwrap();
    assert_eq!((actor.messages, actor.retries, actor.restarts), (4, 2, 2));
    let Some(Event::ActorRestarted { cause, .. }) =
        events.iter().find(|e| matches!(e, Event::ActorRestarted { .. }))
    else {
        panic!("no restart was reported: {events:?}");
    };
    assert_eq!(cause, "panic: index 1 out of range");
}

#[test]
fn poison_views_do_not_use_up_the_restarts() {
    let options = ActorOptions { attempts: 2, ..quick() };
    let setup = probe(options, SystemOptions::default(), |view, _, _| {
        assert!(view.0 % 2 == 0, "poison");
        Ok(())
    });
    // 15 poison views, 2 attempts each: far more restarts than the budget has.
    send_all(&setup, 0..30);
    let (report, log, _) = finish(setup);
    let actor = report.actor("probe").unwrap();
    assert_eq!((actor.messages, actor.quarantined.len(), actor.restarts), (15, 15, 30));
    assert_eq!(log.iter().filter(|l| l.starts_with("gave up")).count(), 15);
    assert!(report.finished(), "{report}");
}

#[test]
fn an_actor_that_fails_everything_fails() {
    let options = ActorOptions { given_up_in_a_row: 4, attempts: 1, ..quick() };
    let setup = probe(options, SystemOptions::default(), |_, _, _| Err(Busy.into()));
    send_all(&setup, 0..30);
    let (report, _, events) = finish(setup);
    let error = report.failures().next().unwrap();
    assert_eq!(error, ("probe", "4 messages in a row were given up, the last one: the provider is busy"));
    assert!(events.iter().any(|e| matches!(e, Event::ActorFailed { .. })));
    assert_eq!(report.phase, Phase::Stopping, "a vital actor takes the system with it");
}

#[test]
fn restarts_are_budgeted_and_backed_off() {
    struct Broken;
    impl Actor for Broken {
        type Message = TestView;
        fn on_start(&mut self, _: &Context) -> Result<(), ActorFailure> {
            Err(ActorFailure::retry("no model file"))
        }
        fn handle(&mut self, _: TestView, _: &Context) -> Result<(), ActorFailure> {
            Ok(())
        }
    }
    let system_options = SystemOptions::default();
    let events = system_options.events.subscribe();
    let system = System::new(system_options).unwrap();
    let (views, inbox) = mailbox("broken", Limits { count: 1, bytes: 1 << 20 });
    let budget = RestartBudget {
        restarts: 4,
        first_delay: Duration::from_millis(5),
        longest_delay: Duration::from_millis(20),
        ..RestartBudget::default()
    };
    system.spawn(inbox, ActorOptions { budget, ..ActorOptions::default() }, || Ok(Broken)).unwrap();
    // Who is held back by the dead actor is freed.
    let sent = (0..3).map(|n| views.blocking_send(TestView(n))).collect::<Vec<_>>();
    assert!(sent[2].is_err());
    let report = system.join();
    assert_eq!(report.failures().next().unwrap().1, "no model file (after 4 restarts within 60 s)");
    let delays: Vec<_> = std::iter::from_fn(|| events.try_next())
        .filter_map(
            |r| if let Event::ActorRestarted { delay_s, .. } = r.event { Some(delay_s) } else { None },
        )
        .collect();
    assert_eq!(delays, [0.005, 0.01, 0.02, 0.02]);
    assert!(report.actors[0].back_off_s >= 0.055);
}

#[test]
fn workers_share_the_mailbox() {
    let seen = Arc::new(Mutex::new(std::collections::BTreeSet::new()));
    let workers = seen.clone();
    let options = ActorOptions { workers: 3, ..quick() };
    let setup = probe(options, SystemOptions::default(), move |_, _, context| {
        workers.lock().unwrap().insert(context.worker());
        thread::sleep(Duration::from_millis(10));
        Ok(())
    });
    send_all(&setup, 0..12);
    let (report, log, _) = finish(setup);
    assert_eq!(seen.lock().unwrap().len(), 3);
    assert_eq!(report.actor("probe").unwrap().messages, 12);
    assert_eq!(log.iter().filter(|l| *l == "stop").count(), 3);
}

#[test]
fn a_disk_that_refuses_ends_the_actor_and_gives_no_message_up() {
    let folder = tempfile::tempdir().unwrap();
    // A file where the cache wants a folder.
    std::fs::write(folder.path().join("areas.d"), "").unwrap();
    let cache = Cache::open(folder.path()).unwrap();
    let setup = probe(quick(), SystemOptions::default(), move |view, _, _| {
        let key = Key::of("areas").value("view", view.0).finish();
        if view.0 == 1 {
            cache.get_or_make(&key, "areas/1", || Ok::<_, Busy>(vec![1.0f32]))?;
        }
        Ok(())
    });
    send_all(&setup, 0..2);
    let (report, log, events) = finish(setup);
    assert_eq!(log, ["start 0", "view 0"], "nothing is given up, nothing is stopped in order");
    let actor = report.actor("probe").unwrap();
    assert_eq!((actor.messages, actor.retries, actor.quarantined.len()), (1, 2, 0));
    assert!(matches!(&actor.exit, Exit::Storage(of) if of.error.contains("areas.d")), "{:?}", actor.exit);
    let (name, failure) = report.failure().unwrap();
    assert_eq!((name, failure.refusal()), ("probe", Some(SystemRefusal::Disk)));
    assert!(!events.iter().any(|event| matches!(event, Event::ViewFailed { .. })));
}

#[test]
fn a_service_that_does_not_answer_is_named_in_the_report_and_the_words_are_written_alone() {
    let setup = probe(quick(), SystemOptions::default(), |_, _, _| {
        Err(std::io::Error::from(std::io::ErrorKind::NotConnected).into())
    });
    send_all(&setup, 0..1);
    let (report, _, _) = finish(setup);
    let (name, failure) = report.failure().unwrap();
    assert_eq!((name, failure.refusal()), ("probe", Some(SystemRefusal::Unanswered)));
    let written = serde_json::to_value(&report.actor("probe").unwrap().exit).unwrap();
    assert_eq!(written, serde_json::json!({ "exit": "storage", "error": failure.to_string() }));
}

#[test]
fn a_disk_that_refuses_once_costs_an_attempt() {
    let tries = AtomicU32::new(0);
    let setup = probe(quick(), SystemOptions::default(), move |_, _, _| {
        match tries.fetch_add(1, Ordering::Relaxed) {
            0 => Err(std::io::Error::from(std::io::ErrorKind::StorageFull).into()),
            _ => Ok(()),
        }
    });
    send_all(&setup, 0..1);
    let (report, log, _) = finish(setup);
    assert_eq!(log, ["start 0", "view 0", "stop"]);
    assert!(report.finished());
}
