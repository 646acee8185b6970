//! The lease under seeded schedules, polled by hand on one thread and compared with a model; and in a system.

use std::collections::VecDeque;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::task::{Context as Task, Poll, Waker};
use std::time::Duration;

use segwild_flow::*;

use crate::simulated::{SimulatedDice, Woken};

/// Many who want one thing. Only those who were woken are polled, so a wake-up that is lost shows as one who waits for
/// a thing that is free.
struct LeaseSimulation {
    dice: SimulatedDice,
    lease: Lease,
    waiting: Vec<(u32, Arc<Woken>, LeaseTurn)>,
    /// What was promised: who waits, in which order.
    urgent: VecDeque<u32>,
    others: VecDeque<u32>,
    held: Option<(u32, LeaseGuard)>,
    next: u32,
    taken: u64,
}

impl LeaseSimulation {
    fn new(seed: u64) -> Self {
        LeaseSimulation {
            dice: SimulatedDice(seed),
            lease: Lease::new("simulated"),
            waiting: Vec::new(),
            urgent: VecDeque::new(),
            others: VecDeque::new(),
            held: None,
            next: 0,
            taken: 0,
        }
    }

    fn poll(&mut self, i: usize) {
        let (who, woken, turn) = &mut self.waiting[i];
        woken.0.store(false, Ordering::SeqCst);
        let waker = Waker::from(woken.clone());
        let polled = Pin::new(turn).poll(&mut Task::from_waker(&waker));
        let (who, first) = (*who, self.urgent.front().or(self.others.front()).copied());
        match polled {
            Poll::Ready(guard) => {
                assert!(self.held.is_none(), "two have it");
                assert_eq!(Some(who), first, "out of turn");
                if self.urgent.front() == Some(&who) { &mut self.urgent } else { &mut self.others }
                    .pop_front();
                self.held = Some((who, guard));
                self.taken += 1;
                drop(self.waiting.swap_remove(i));
            }
            Poll::Pending => {
                assert!(self.held.is_some() || first != Some(who), "its turn, and it is not given")
            }
        }
    }

    fn step(&mut self) {
        match self.dice.below(100) {
            0..35 => {
                let (who, urgent) = (self.next, self.dice.below(4) == 0);
                self.next += 1;
                let name = who.to_string();
                let turn = if urgent { self.lease.urgent_turn(&name) } else { self.lease.turn(&name) };
                if urgent { &mut self.urgent } else { &mut self.others }.push_back(who);
                self.waiting.push((who, Arc::default(), turn));
                self.poll(self.waiting.len() - 1);
            }
            35..60 => {
                let woken = self.woken();
                if !woken.is_empty() {
                    let i = self.dice.below(woken.len());
                    self.poll(woken[i]);
                }
            }
            60..85 => drop(self.held.take()),
            // Gives up waiting, also when it was woken just before: its turn goes on to the next.
            85..95 if !self.waiting.is_empty() => {
                let i = self.dice.below(self.waiting.len());
                let (gone, _, turn) = self.waiting.swap_remove(i);
                drop(turn);
                self.urgent.retain(|who| *who != gone);
                self.others.retain(|who| *who != gone);
            }
            _ => {
                let got = self.lease.try_acquire("jumper");
                assert_eq!(got.is_some(), self.held.is_none() && self.waiting.is_empty());
                self.taken += u64::from(got.is_some());
            }
        }
        let stats = self.lease.stats();
        assert_eq!(stats.waiting, self.waiting.len());
        assert_eq!(stats.taken, self.taken);
        assert_eq!(stats.holder, self.held.as_ref().map(|(who, _)| who.to_string()));
    }

    fn woken(&self) -> Vec<usize> {
        (0..self.waiting.len()).filter(|&i| self.waiting[i].1.0.load(Ordering::SeqCst)).collect()
    }

    /// Polls all who were woken; who still waits then must wait for somebody.
    fn settle(&mut self) {
        while let Some(&i) = self.woken().first() {
            self.poll(i);
        }
        assert!(self.held.is_some() || self.waiting.is_empty(), "it is free and nobody was woken");
    }
}

#[test]
fn the_lease_is_handed_on_in_turn_under_every_schedule() {
    let mut taken = 0;
    for seed in 0..3000 {
        let run = std::panic::catch_unwind(|| {
            let mut simulation = LeaseSimulation::new(seed);
            for step in 0..150 {
                simulation.step();
                if step % 30 == 29 {
                    simulation.settle();
                }
            }
            while !simulation.waiting.is_empty() {
                drop(simulation.held.take());
                simulation.settle();
            }
            simulation.taken
        });
        taken +=
            run.unwrap_or_else(|_| panic!("schedule {seed} breaks a promise; run Simulation::new({seed})"));
    }
    assert!(taken > 50_000, "the schedules do too little: {taken}");
}

/// Holds the accelerator at every message; panics at the first if so configured.
struct User {
    accelerator: Lease,
    tries: Arc<AtomicU32>,
    dies: bool,
}
impl Actor for User {
    type Message = u32;
    fn handle(&mut self, _: u32, context: &Context) -> Result<(), ActorFailure> {
        let _held = self.accelerator.acquire(context.name());
        if self.dies && self.tries.fetch_add(1, Ordering::Relaxed) == 0 {
            // Without the hook, which would print it.
            std::panic::resume_unwind(Box::new("bug"));
        }
        context.sleep(Duration::from_millis(15));
        Ok(())
    }
}

#[test]
fn an_actor_that_dies_gives_the_accelerator_back_and_waits_for_it_are_in_the_timeline() {
    let accelerator = Lease::new("accelerator 0");
    let system = System::new(SystemOptions::default()).unwrap();
    for (name, dies) in [("masks", true), ("features", false)] {
        let (tasks, inbox) = mailbox::<u32>(name, Limits::default());
        (0..6).for_each(|n| tasks.blocking_send(n).unwrap());
        let (accelerator, tries) = (accelerator.clone(), Arc::new(AtomicU32::new(0)));
        let budget = RestartBudget { first_delay: Duration::from_millis(1), ..RestartBudget::default() };
        let options = ActorOptions { budget, ..ActorOptions::default() };
        let user = move || Ok(User { accelerator: accelerator.clone(), tries: tries.clone(), dies });
        system.spawn(inbox, options, user).unwrap();
    }
    let report = system.join();
    assert!(report.finished(), "{report}");
    assert_eq!(report.actor("masks").unwrap().restarts, 1);
    let stats = accelerator.stats();
    assert_eq!((stats.taken, stats.waiting, stats.holder), (13, 0, None));
    let waits = |s: &&TimelineSpan| s.kind == SpanKind::Blocked && s.label == "accelerator 0";
    let waited: f64 = report.timeline.spans.iter().filter(waits).map(|s| s.end - s.start).sum();
    assert!(waited > 0.03, "waits of {waited} s are in the timeline");
    assert!((stats.waited_s - waited).abs() < 0.5 * stats.waited_s, "{} {waited}", stats.waited_s);
}
