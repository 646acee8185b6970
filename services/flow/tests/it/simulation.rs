//! Deterministic simulation: the real mailbox under seeded schedules, polled by hand on one thread, and the real
//! supervisor under generated behaviour, each compared step by step with a model of what was promised.
//!
//! A schedule decides at every point where a task waits: who is polled next, who gives up, when it closes. Only tasks
//! that were woken are polled, so a wake-up that is lost shows as a task that waits for ever. What happens between
//! two threads inside one call is not simulated; `mailbox.rs` has the races.

use std::collections::VecDeque;
use std::future::Future;
use std::pin::Pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context as Task, Poll, Waker};
use std::time::Duration;

use proptest::prelude::*;
use segwild_flow::*;

use crate::simulated::{SimulatedDice, Woken};

/// A parcel: its number and its weight.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Parcel(u32, usize);
impl Message for Parcel {
    fn bytes(&self) -> usize {
        self.1
    }
}

type Sending = Pin<Box<dyn Future<Output = Result<(), Closed>>>>;
type Receiving = Pin<Box<dyn Future<Output = Option<Parcel>>>>;

enum WaitingTask {
    Send(Sending, Parcel, bool),
    Receive(Receiving),
}

/// What the mailbox has promised to hold.
#[derive(Default)]
struct MailboxModel {
    urgent: VecDeque<Parcel>,
    work: VecDeque<Parcel>,
    closed: bool,
    accepted: u64,
    delivered: u64,
}

impl MailboxModel {
    fn accept(&mut self, parcel: Parcel, urgent: bool) {
        assert!(!self.closed, "a closed mailbox accepted {parcel:?}");
        if urgent { &mut self.urgent } else { &mut self.work }.push_back(parcel);
        self.accepted += 1;
    }

    fn deliver(&mut self, parcel: Option<Parcel>) {
        let expected = self.urgent.pop_front().or_else(|| self.work.pop_front());
        assert_eq!(parcel, expected, "urgent first, then in order, nothing lost, nothing twice");
        self.delivered += u64::from(parcel.is_some());
        assert!(parcel.is_some() || self.closed, "an open mailbox ended");
    }
}

struct MailboxSimulation {
    dice: SimulatedDice,
    limits: Limits,
    sender: Sender<Parcel>,
    receiver: Receiver<Parcel>,
    model: MailboxModel,
    waiting: Vec<(Arc<Woken>, WaitingTask)>,
    next: u32,
}

impl MailboxSimulation {
    fn new(seed: u64) -> Self {
        let mut dice = SimulatedDice(seed);
        let limits = Limits { count: 1 + dice.below(3), bytes: 1 + dice.below(20) };
        let (sender, receiver) = mailbox("simulated", limits);
        Self { dice, limits, sender, receiver, model: MailboxModel::default(), waiting: Vec::new(), next: 0 }
    }

    fn parcel(&mut self) -> (Parcel, bool) {
        self.next += 1;
        (Parcel(self.next, self.dice.below(25)), self.dice.below(4) == 0)
    }

    fn poll(&mut self, i: usize) {
        let (woken, task) = &mut self.waiting[i];
        woken.0.store(false, Ordering::SeqCst);
        let waker = Waker::from(woken.clone());
        let mut context = Task::from_waker(&waker);
        let done = match task {
            WaitingTask::Send(sending, parcel, urgent) => match sending.as_mut().poll(&mut context) {
                Poll::Pending => false,
                Poll::Ready(Ok(())) => {
                    self.model.accept(*parcel, *urgent);
                    true
                }
                Poll::Ready(Err(_)) => {
                    assert!(self.model.closed, "an open mailbox refused");
                    true
                }
            },
            WaitingTask::Receive(receiving) => match receiving.as_mut().poll(&mut context) {
                Poll::Pending => false,
                Poll::Ready(parcel) => {
                    self.model.deliver(parcel);
                    true
                }
            },
        };
        if done {
            self.waiting.swap_remove(i);
        }
    }

    fn start(&mut self, task: WaitingTask) {
        self.waiting.push((Arc::default(), task));
        self.poll(self.waiting.len() - 1);
    }

    fn step(&mut self) {
        match self.dice.below(100) {
            0..25 => {
                let (parcel, urgent) = self.parcel();
                let sender = self.sender.clone();
                let sending: Sending = if urgent {
                    Box::pin(async move { sender.send_urgent(parcel).await })
                } else {
                    Box::pin(async move { sender.send(parcel).await })
                };
                self.start(WaitingTask::Send(sending, parcel, urgent));
            }
            25..45 => {
                let receiver = self.receiver.clone();
                self.start(WaitingTask::Receive(Box::pin(async move { receiver.recv().await })));
            }
            45..60 => {
                let (parcel, urgent) = self.parcel();
                let sent =
                    if urgent { self.sender.try_send_urgent(parcel) } else { self.sender.try_send(parcel) };
                match sent {
                    Ok(()) => self.model.accept(parcel, urgent),
                    Err(TrySendError::Full(back) | TrySendError::Closed(back)) => assert_eq!(back, parcel),
                }
            }
            60..72 => match self.receiver.try_recv() {
                Ok(parcel) => self.model.deliver(Some(parcel)),
                Err(RecvError::Closed) => self.model.deliver(None),
                // Somebody who was woken before may have the right to what is there.
                Err(RecvError::Empty) => assert!(!self.model.closed),
            },
            72..92 => {
                let ready: Vec<usize> = self.woken();
                if !ready.is_empty() {
                    let i = self.dice.below(ready.len());
                    self.poll(ready[i]);
                }
            }
            // Gives up waiting: must neither take a message along nor a slot.
            92..99 if !self.waiting.is_empty() => {
                let i = self.dice.below(self.waiting.len());
                self.waiting.swap_remove(i);
            }
            99 if self.dice.below(3) == 0 => {
                self.receiver.close();
                self.model.closed = true;
            }
            _ => {}
        }
        self.check();
    }

    fn woken(&self) -> Vec<usize> {
        (0..self.waiting.len()).filter(|&i| self.waiting[i].0.0.load(Ordering::SeqCst)).collect()
    }

    fn check(&self) {
        let stats = self.receiver.stats();
        let lanes = [&self.model.urgent, &self.model.work];
        assert_eq!(stats.depth, lanes.iter().map(|l| l.len()).sum::<usize>());
        assert_eq!(stats.bytes, lanes.iter().flat_map(|l| l.iter()).map(|p| p.1).sum::<usize>());
        assert_eq!((stats.sent, stats.received), (self.model.accepted, self.model.delivered));
        for lane in lanes {
            assert!(lane.len() <= self.limits.count, "more messages than the limit");
            // A parcel over the limit counts as the limit: it travels with weightless ones only.
            let bytes: usize = lane.iter().map(|p| p.1.min(self.limits.bytes)).sum();
            assert!(bytes <= self.limits.bytes, "more bytes than the limit");
        }
    }

    /// Polls all who were woken until nobody is: who still waits then must have a reason.
    fn settle(&mut self) {
        while let Some(&i) = self.woken().first() {
            self.poll(i);
            self.check();
        }
        let empty = self.model.urgent.is_empty() && self.model.work.is_empty();
        let sending = self.waiting.iter().filter(|(_, t)| matches!(t, WaitingTask::Send(..))).count();
        let receiving = self.waiting.len() - sending;
        assert!(!self.model.closed || self.waiting.is_empty(), "somebody outwaits the end");
        assert!(!empty || sending == 0, "a sender waits at an empty mailbox: a wake-up was lost");
        assert!(empty || receiving == 0, "a receiver waits at a full mailbox: a wake-up was lost");
        assert_eq!(self.receiver.stats().waiting_senders, sending);
    }

    /// Takes out everything and lets everybody finish.
    fn drain(&mut self) {
        loop {
            self.settle();
            match self.receiver.try_recv() {
                Ok(parcel) => self.model.deliver(Some(parcel)),
                Err(_) => break,
            }
        }
        assert_eq!(self.model.accepted, self.model.delivered, "all that was accepted is delivered");
    }
}

#[test]
fn the_mailbox_keeps_its_promises_under_every_schedule() {
    let (mut accepted, mut closed) = (0, 0);
    for seed in 0..4000 {
        let run = std::panic::catch_unwind(|| {
            let mut simulation = MailboxSimulation::new(seed);
            for step in 0..150 {
                simulation.step();
                if step % 50 == 49 {
                    simulation.settle();
                }
            }
            simulation.drain();
            (simulation.model.accepted, u32::from(simulation.model.closed))
        });
        match run {
            Ok((a, c)) => (accepted, closed) = (accepted + a, closed + c),
            Err(_) => panic!("schedule {seed} breaks a promise; run Simulation::new({seed})"),
        }
    }
    assert!(accepted > 50_000 && closed > 500, "the schedules do too little: {accepted} {closed}");
}

/// What an attempt at a message does.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Act {
    Succeed,
    Retry,
    Reject,
    Restart,
    Panic,
    Fatal,
}

#[derive(Clone, Debug)]
struct Script {
    /// Per message, its attempts; those after the last succeed.
    messages: Vec<Vec<Act>>,
    /// Whether each further build of an instance works; those after the last do.
    builds: Vec<bool>,
    attempts: u32,
    in_a_row: u32,
    restarts: u32,
}

fn script() -> impl Strategy<Value = Script> {
    let act = prop_oneof![
        4 => Just(Act::Succeed),
        4 => Just(Act::Retry),
        2 => Just(Act::Reject),
        2 => Just(Act::Restart),
        2 => Just(Act::Panic),
        1 => Just(Act::Fatal),
    ];
    let messages = prop::collection::vec(prop::collection::vec(act, 0..4), 0..12);
    let builds = prop::collection::vec(prop::bool::weighted(0.7), 0..6);
    (messages, builds, 1u32..4, 1u32..5, 0u32..4).prop_map(
        |(messages, builds, attempts, in_a_row, restarts)| Script {
            messages,
            builds,
            attempts,
            in_a_row,
            restarts,
        },
    )
}

#[derive(Debug, Default, PartialEq)]
struct ScriptFate {
    log: Vec<String>,
    handled: u64,
    retries: u64,
    restarts: u64,
    quarantined: Vec<(String, u32)>,
    failed: bool,
}

/// What supervision promises for a script, written as plainly as possible.
fn promised(script: &Script) -> ScriptFate {
    let mut fate = ScriptFate::default();
    let mut builds = script.builds.iter().copied();
    let mut budget_used = 0;
    // Builds until one works, or the budget is used up.
    let mut build = |fate: &mut ScriptFate| {
        while !builds.next().unwrap_or(true) {
            fate.log.push("build fails".into());
            if budget_used >= script.restarts {
                fate.failed = true;
                return false;
            }
            budget_used += 1;
            fate.restarts += 1;
        }
        fate.log.push("built".into());
        true
    };
    if !build(&mut fate) {
        return fate;
    }
    let mut in_a_row = 0;
    for (n, acts) in script.messages.iter().enumerate() {
        for attempt in 1.. {
            let act = acts.get(attempt as usize - 1).copied().unwrap_or(Act::Succeed);
            let broken = matches!(act, Act::Restart | Act::Panic);
            if act == Act::Succeed {
                fate.log.push(format!("done {n}"));
                fate.handled += 1;
                in_a_row = 0;
                break;
            }
            let again = matches!(act, Act::Retry | Act::Restart | Act::Panic) && attempt < script.attempts;
            if again {
                fate.retries += 1;
            } else {
                fate.quarantined.push((n.to_string(), attempt));
                in_a_row += u32::from(act != Act::Reject);
                if act == Act::Fatal || act != Act::Reject && in_a_row >= script.in_a_row {
                    fate.failed = true;
                    return fate;
                }
            }
            if broken {
                fate.restarts += 1;
                if !build(&mut fate) {
                    return fate;
                }
            }
            if !again {
                fate.log.push(format!("gave up {n}"));
                break;
            }
        }
    }
    fate.log.push("stopped".into());
    fate
}

/// An actor that does what its script says.
struct Player {
    script: Arc<Script>,
    attempts: Arc<Mutex<Vec<usize>>>,
    log: Arc<Mutex<Vec<String>>>,
}

impl Player {
    fn say(&self, line: String) {
        self.log.lock().unwrap().push(line);
    }
}

impl Actor for Player {
    type Message = u32;
    fn handle(&mut self, n: u32, _: &Context) -> Result<(), ActorFailure> {
        let n = n as usize;
        let attempt = {
            let mut attempts = self.attempts.lock().unwrap();
            attempts[n] += 1;
            attempts[n] - 1
        };
        match self.script.messages[n].get(attempt).copied().unwrap_or(Act::Succeed) {
            Act::Succeed => self.say(format!("done {n}")),
            Act::Retry => return Err(ActorFailure::retry("again")),
            Act::Reject => return Err(ActorFailure::reject("bad")),
            Act::Restart => return Err(ActorFailure::restart("again")),
            Act::Fatal => return Err(ActorFailure::fatal("over")),
            // Without the hook: thousands of these would be printed.
            Act::Panic => std::panic::resume_unwind(Box::new("bug")),
        }
        Ok(())
    }
    fn on_quarantine(&mut self, n: Option<u32>, _: &Quarantined, _: &Context) -> Result<(), ActorFailure> {
        self.say(format!("gave up {}", n.expect("numbers can be copied")));
        Ok(())
    }
    fn on_stop(&mut self, _: &Context) -> Result<(), ActorFailure> {
        self.say("stopped".into());
        Ok(())
    }
}

fn played(script: &Script) -> ScriptFate {
    let none = Duration::ZERO;
    let budget = RestartBudget { restarts: script.restarts, first_delay: none, ..RestartBudget::default() };
    let options = ActorOptions {
        attempts: script.attempts,
        given_up_in_a_row: script.in_a_row,
        budget,
        ..ActorOptions::default()
    };
    let (numbers, inbox) = mailbox("player", Limits { count: 100, bytes: 1 << 20 });
    for n in 0..script.messages.len() as u32 {
        numbers.blocking_send(n).unwrap();
    }
    drop(numbers);
    let log = Arc::new(Mutex::new(Vec::new()));
    let (script, attempts) = (Arc::new(script.clone()), Arc::new(Mutex::new(vec![0; script.messages.len()])));
    let (logged, builds) = (log.clone(), AtomicUsize::new(0));
    let system = System::new(SystemOptions::default()).unwrap();
    system
        .spawn(inbox, options, move || {
            let works = script.builds.get(builds.fetch_add(1, Ordering::Relaxed)).copied().unwrap_or(true);
            logged.lock().unwrap().push(if works { "built" } else { "build fails" }.to_owned());
            if !works {
                return Err(ActorFailure::retry("no model file"));
            }
            Ok(Player { script: script.clone(), attempts: attempts.clone(), log: logged.clone() })
        })
        .unwrap();
    let report = system.join();
    let actor = report.actor("player").unwrap();
    assert!(matches!(actor.exit, Exit::Finished | Exit::Failed(_)), "{report}");
    let log = log.lock().unwrap().clone();
    ScriptFate {
        log,
        handled: actor.messages,
        retries: actor.retries,
        restarts: actor.restarts,
        quarantined: actor.quarantined.iter().map(|q| (q.label.clone(), q.attempts)).collect(),
        failed: actor.exit != Exit::Finished,
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 600, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn the_supervisor_does_what_it_promises_whatever_actors_do(script in script()) {
        prop_assert_eq!(played(&script), promised(&script));
    }
}
