//! What the tests of the system share: views to work on, and an actor that does with them what a test says.
#![allow(dead_code, reason = "each test file uses a part of it")]

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use segwild_flow::*;

/// A view's work, as the scene's actors have it.
#[derive(Clone, Debug, PartialEq)]
pub struct TestView(pub u32);
impl Message for TestView {
    fn label(&self) -> String {
        format!("view {}", self.0)
    }
    fn again(&self) -> Option<Self> {
        Some(self.clone())
    }
}

pub type Handler = Arc<dyn Fn(&TestView, u32, &Context) -> Result<(), ActorFailure> + Send + Sync>;

/// What actors saw, in order.
#[derive(Clone, Default)]
pub struct Log(pub Arc<Mutex<Vec<String>>>);
impl Log {
    pub fn add(&self, line: impl Into<String>) {
        self.0.lock().unwrap().push(line.into());
    }
    pub fn lines(&self) -> Vec<String> {
        self.0.lock().unwrap().clone()
    }
}

/// Handles views by a function that also gets the instance it runs in.
pub struct Probe {
    instance: u32,
    handler: Handler,
    log: Log,
}

impl Actor for Probe {
    type Message = TestView;
    fn on_start(&mut self, _: &Context) -> Result<(), ActorFailure> {
        self.log.add(format!("start {}", self.instance));
        Ok(())
    }
    fn handle(&mut self, view: TestView, context: &Context) -> Result<(), ActorFailure> {
        (self.handler)(&view, self.instance, context)?;
        self.log.add(format!("view {}", view.0));
        Ok(())
    }
    fn on_quarantine(
        &mut self,
        view: Option<TestView>,
        what: &Quarantined,
        _: &Context,
    ) -> Result<(), ActorFailure> {
        assert_eq!(view.map(|v| v.label()), Some(what.label.clone()));
        self.log.add(format!("gave up {}", what.label));
        Ok(())
    }
    fn on_stop(&mut self, _: &Context) -> Result<(), ActorFailure> {
        self.log.add("stop");
        Ok(())
    }
}

pub fn quick() -> ActorOptions {
    let budget = RestartBudget {
        first_delay: Duration::from_millis(1),
        longest_delay: Duration::from_millis(4),
        ..RestartBudget::default()
    };
    ActorOptions { budget, ..ActorOptions::default() }
}

pub struct Setup {
    pub system: System,
    pub views: Sender<TestView>,
    pub log: Log,
    pub events: Subscription,
}

pub fn probe(
    options: ActorOptions,
    system: SystemOptions,
    handler: impl Fn(&TestView, u32, &Context) -> Result<(), ActorFailure> + Send + Sync + 'static,
) -> Setup {
    let events = system.events.subscribe();
    let system = System::new(system).unwrap();
    let (views, inbox) = mailbox("probe", Limits { count: 100, bytes: 1 << 20 });
    let log = Log::default();
    let (instances, handler): (_, Handler) = (AtomicU32::new(0), Arc::new(handler));
    let logged = log.clone();
    system
        .spawn(inbox, options, move || {
            let instance = instances.fetch_add(1, Ordering::Relaxed);
            Ok(Probe { instance, handler: handler.clone(), log: logged.clone() })
        })
        .unwrap();
    Setup { system, views, log, events }
}

pub fn send_all(setup: &Setup, views: impl IntoIterator<Item = u32>) {
    views.into_iter().for_each(|n| setup.views.blocking_send(TestView(n)).unwrap());
}

pub fn finish(setup: Setup) -> (Report, Vec<String>, Vec<Event>) {
    drop(setup.views);
    let report = setup.system.join();
    let events = std::iter::from_fn(|| setup.events.try_next()).map(|r| r.event).collect();
    (report, setup.log.lines(), events)
}

#[derive(Debug, thiserror::Error)]
#[error("the provider is busy")]
pub struct Busy;
