//! The mailbox's promises.
#![allow(
    clippy::disallowed_methods,
    reason = "in these tests sleep stands for work, or lets others come first"
)]

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use segwild_flow::{Limits, Message, RecvError, TrySendError, mailbox};

struct Heavy(u32, usize);
impl Message for Heavy {
    fn bytes(&self) -> usize {
        self.1
    }
}

const MIB: usize = 1 << 20;

/// Waits until something holds; a promise that is not kept fails here, not in a hang.
fn until(what: &str, done: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(10);
    while !done() {
        assert!(Instant::now() < deadline, "{what}");
        thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn a_full_mailbox_holds_the_sender_back_and_counts_it() {
    let (sender, receiver) = mailbox("slow", Limits { count: 2, bytes: MIB });
    let sending = thread::spawn(move || {
        for n in 0..6u64 {
            sender.blocking_send(n).unwrap();
        }
        sender.stats()
    });
    until("the sender waits", || receiver.stats().waiting_senders == 1);
    thread::sleep(Duration::from_millis(50));
    assert_eq!(receiver.stats().depth, 2);
    let received: Vec<_> = std::iter::from_fn(|| receiver.blocking_recv()).collect();
    assert_eq!(received, [0, 1, 2, 3, 4, 5]);
    let stats = sending.join().unwrap();
    assert!(stats.back_pressure_s >= 0.05, "{stats:?}");
    assert!(stats.held_back >= 1 && stats.high_water == 2, "{stats:?}");
    let end = receiver.stats();
    assert_eq!((end.sent, end.received, end.depth, end.bytes, end.waiting_senders), (6, 6, 0, 0, 0));
}

#[test]
fn bytes_bound_as_count_does() {
    let (sender, receiver) = mailbox("bytes", Limits { count: 100, bytes: 1000 });
    sender.try_send(Heavy(0, 600)).unwrap();
    assert!(matches!(sender.try_send(Heavy(1, 500)), Err(TrySendError::Full(Heavy(1, _)))));
    sender.try_send(Heavy(2, 400)).unwrap();
    assert!(matches!(sender.try_send(Heavy(3, 1)), Err(TrySendError::Full(_))));
    assert_eq!(receiver.stats().bytes, 1000);
    assert_eq!(receiver.blocking_recv().unwrap().0, 0);
    sender.try_send(Heavy(4, 600)).unwrap();
    assert_eq!(receiver.stats().high_water_bytes, 1000);
}

#[test]
fn a_message_larger_than_the_limit_travels_alone() {
    for limit in [1, 1000, 6 << 30] {
        let (sender, receiver) = mailbox("large", Limits { count: 10, bytes: limit });
        let sending = thread::spawn(move || {
            for n in 0..5 {
                sender.blocking_send(Heavy(n, limit * 2 + 1)).unwrap();
            }
        });
        for n in 0..5 {
            until("it is sent", || receiver.stats().depth == 1);
            assert!(receiver.stats().depth <= 1);
            assert_eq!(receiver.recv_timeout(Duration::from_secs(10)).unwrap().0, n);
        }
        sending.join().unwrap();
    }
}

#[test]
fn an_urgent_message_waits_neither_for_work_nor_for_senders() {
    let (sender, receiver) = mailbox::<String>("clicks", Limits { count: 2, bytes: MIB });
    for n in 0..2 {
        sender.blocking_send(format!("work {n}")).unwrap();
    }
    let held = sender.clone();
    let sending = thread::spawn(move || held.blocking_send("work 2".into()));
    until("a sender is held back", || receiver.stats().waiting_senders == 1);
    let start = Instant::now();
    sender.blocking_send_urgent("click".into()).unwrap();
    assert!(start.elapsed() < Duration::from_secs(1));
    assert_eq!(receiver.blocking_recv().unwrap(), "click");
    assert_eq!(receiver.blocking_recv().unwrap(), "work 0");
    sending.join().unwrap().unwrap();
    drop(sender);
    let rest: Vec<_> = std::iter::from_fn(|| receiver.blocking_recv()).collect();
    assert_eq!(rest, ["work 1", "work 2"]);
}

#[test]
fn closing_refuses_senders_and_keeps_what_is_queued() {
    let (sender, receiver) = mailbox("closing", Limits { count: 1, bytes: MIB });
    sender.blocking_send(1u32).unwrap();
    let held = sender.clone();
    let sending = thread::spawn(move || held.blocking_send(2));
    until("a sender is held back", || receiver.stats().waiting_senders == 1);
    receiver.close();
    assert_eq!(sending.join().unwrap().unwrap_err().to_string(), "the mailbox of `closing` is closed");
    assert!(matches!(sender.try_send(3), Err(TrySendError::Closed(3))));
    assert!(sender.blocking_send_urgent(4).is_err());
    assert_eq!(receiver.blocking_recv(), Some(1));
    assert_eq!(receiver.blocking_recv(), None);
    assert_eq!(receiver.try_recv(), Err(RecvError::Closed));
}

#[test]
fn the_last_receiver_frees_who_waits_and_what_is_queued() {
    // A queued message that holds the only sender of a reply: dropping the receiver must drop it.
    struct Ask(#[allow(dead_code)] segwild_flow::Sender<u32>);
    impl Message for Ask {}
    let (sender, receiver) = mailbox("queried", Limits { count: 1, bytes: MIB });
    let (reply, answer) = mailbox("reply", Limits::default());
    sender.blocking_send(Ask(reply)).unwrap();
    let held = sender.clone();
    let sending = thread::spawn(move || held.blocking_send(Ask(mailbox("unused", Limits::default()).0)));
    until("a sender is held back", || receiver.stats().waiting_senders == 1);
    drop(receiver);
    assert!(sending.join().unwrap().is_err());
    assert_eq!(answer.blocking_recv(), None, "nobody will answer");
}

#[test]
fn a_timeout_takes_no_message() {
    let (sender, receiver) = mailbox("timeout", Limits::default());
    assert_eq!(receiver.recv_timeout(Duration::from_millis(20)), Err(RecvError::Empty));
    sender.try_send(5u32).unwrap();
    assert_eq!(receiver.recv_timeout(Duration::from_millis(20)), Ok(5));
    assert_eq!(receiver.try_recv(), Err(RecvError::Empty));
}

#[test]
fn async_tasks_and_threads_share_a_mailbox() {
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_time().build().unwrap();
    let (sender, receiver) = mailbox("both", Limits { count: 3, bytes: MIB });
    let threads: Vec<_> = (0..2)
        .map(|_| {
            let receiver = receiver.clone();
            thread::spawn(move || std::iter::from_fn(|| receiver.blocking_recv()).sum::<u64>())
        })
        .collect();
    let tasks: Vec<_> = (0..4u64)
        .map(|task| {
            let sender = sender.clone();
            runtime.spawn(async move {
                for n in 0..250 {
                    sender.send(task * 250 + n).await.unwrap();
                }
            })
        })
        .collect();
    let reader = runtime.spawn(async move {
        let mut sum = 0;
        while let Some(n) = receiver.recv().await {
            sum += n;
        }
        sum
    });
    runtime.block_on(async {
        for task in tasks {
            task.await.unwrap();
        }
    });
    drop(sender);
    let total =
        threads.into_iter().map(|t| t.join().unwrap()).sum::<u64>() + runtime.block_on(reader).unwrap();
    assert_eq!(total, (0..1000).sum::<u64>());
}

#[test]
fn an_abandoned_send_gives_its_slot_back() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
    let (sender, receiver) = mailbox("abandoned", Limits { count: 1, bytes: MIB });
    runtime.block_on(async {
        sender.send(1u32).await.unwrap();
        assert!(tokio::time::timeout(Duration::from_millis(20), sender.send(2)).await.is_err());
        assert_eq!(receiver.recv().await, Some(1));
        sender.send(3).await.unwrap();
        assert_eq!(receiver.recv().await, Some(3));
    });
    assert_eq!(receiver.stats().waiting_senders, 0);
}

/// The narrow place: a sender that has its place and is about to queue the message when the mailbox closes.
#[test]
fn a_closing_mailbox_waits_for_a_sender_on_the_threshold() {
    /// When its size is read a second time, it is on the threshold, and lingers there.
    struct Lingering(AtomicU64, std::sync::mpsc::Sender<()>);
    impl Message for Lingering {
        fn bytes(&self) -> usize {
            if self.0.fetch_add(1, Ordering::Relaxed) == 1 {
                self.1.send(()).unwrap();
                thread::sleep(Duration::from_millis(50));
            }
            1
        }
    }
    let (sender, receiver) = mailbox("threshold", Limits::default());
    let (there, on_threshold) = std::sync::mpsc::channel();
    let sending = thread::spawn(move || sender.try_send(Lingering(AtomicU64::new(0), there)).is_ok());
    on_threshold.recv().unwrap();
    receiver.close();
    let received = receiver.blocking_recv().is_some();
    assert!(sending.join().unwrap(), "the send was accepted");
    assert!(received, "and so it must arrive");
}

/// Many senders and receivers while the mailbox is closed under them: what was accepted is received, once.
#[test]
fn nothing_accepted_is_lost_when_it_closes_under_load() {
    for round in 0..200u64 {
        let (sender, receiver) = mailbox("race", Limits { count: 4, bytes: 256 });
        let (accepted, received) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
        thread::scope(|scope| {
            for urgent in [false, true, false] {
                let (sender, accepted) = (sender.clone(), accepted.clone());
                scope.spawn(move || {
                    for n in 1..u64::MAX {
                        let sent =
                            if urgent { sender.blocking_send_urgent(n) } else { sender.blocking_send(n) };
                        if sent.is_err() {
                            return;
                        }
                        accepted.fetch_add(n, Ordering::Relaxed);
                    }
                });
            }
            for _ in 0..2 {
                let (receiver, received) = (receiver.clone(), received.clone());
                scope.spawn(move || {
                    while let Some(n) = receiver.blocking_recv() {
                        received.fetch_add(n, Ordering::Relaxed);
                    }
                });
            }
            thread::sleep(Duration::from_micros(50 + 10 * (round % 40)));
            receiver.close();
        });
        assert_eq!(accepted.load(Ordering::Relaxed), received.load(Ordering::Relaxed), "round {round}");
        let stats = receiver.stats();
        assert_eq!((stats.depth, stats.bytes, stats.sent), (0, 0, stats.received));
    }
}
