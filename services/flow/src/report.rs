//! How a system's actors fared.

use std::fmt;

use serde::{Serialize, Serializer};

use crate::actor::{ActorFailure, FailureKind, Quarantined};
use crate::control::Phase;
use crate::mailbox::MailboxStats;
use crate::meter::WorkerState;
use crate::refusal::SystemRefusal;
use crate::timeline::TimelineRecord;

/// How an actor ended. Of several workers, the worst counts.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case", tag = "exit", content = "error")]
pub enum Exit {
    /// It has not.
    Running,
    /// All its work is done.
    Finished,
    /// A stop was requested, and it left the rest undone.
    Stopped,
    /// The consumer of its results has gone.
    DownstreamClosed,
    /// It gave up, or its restarts are used up.
    Failed(String),
    /// The disk or the system refused it something.
    Storage(StorageFailure),
    /// It was still running when the deadline for stopping had passed.
    Late,
}

/// How the disk or the system ended an actor. It is written as its error alone.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct StorageFailure {
    /// The error's words.
    pub error: String,
    /// What was refused.
    pub refusal: SystemRefusal,
}

impl Serialize for StorageFailure {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.error.serialize(serializer)
    }
}

/// One worker at one moment.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct WorkerStatus {
    /// What it does.
    pub state: WorkerState,
    /// On what: the message, or the mailbox it waits for.
    pub label: String,
    /// For how long, in seconds.
    pub since_s: f64,
}

/// An actor's times and counts, summed over its workers; while it runs or at its end. Times are wall-clock
/// seconds and add up to the workers' lives.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ActorReport {
    /// Its name.
    pub name: String,
    /// How it ended.
    #[serde(flatten)]
    pub exit: Exit,
    /// Its workers.
    pub workers: Vec<WorkerStatus>,
    /// Building it.
    pub starting_s: f64,
    /// Working.
    pub busy_s: f64,
    /// Waiting for input.
    pub waiting_s: f64,
    /// Waiting for space in other mailboxes.
    pub blocked_s: f64,
    /// Waiting before restarts and attempts.
    pub back_off_s: f64,
    /// Processor time of its own threads (not of pools that it hands work to).
    pub cpu_s: f64,
    /// Messages handled.
    pub messages: u64,
    /// Further attempts at a message.
    pub retries: u64,
    /// How often it was restarted.
    pub restarts: u64,
    /// What was given up.
    pub quarantined: Vec<Quarantined>,
    /// Its mailbox; a source has none.
    pub mailbox: Option<MailboxStats>,
}

impl ActorReport {
    /// The share of its life spent working, 0 to 1.
    pub fn utilization(&self) -> f64 {
        let life = self.starting_s + self.busy_s + self.waiting_s + self.blocked_s + self.back_off_s;
        if life > 0.0 { self.busy_s / life } else { 0.0 }
    }
}

/// How a system's actors fared. Its `Display` is a table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// The actors, in the order in which they were spawned.
    pub actors: Vec<ActorReport>,
    /// How far its shutdown was requested.
    pub phase: Phase,
    /// From the system's start to its end, in seconds.
    pub wall_s: f64,
    /// Who did what when.
    pub timeline: TimelineRecord,
}

impl Report {
    /// An actor's report.
    pub fn actor(&self, name: &str) -> Option<&ActorReport> {
        self.actors.iter().find(|a| a.name == name)
    }

    /// Whether every actor finished its work.
    pub fn finished(&self) -> bool {
        self.actors.iter().all(|a| a.exit == Exit::Finished)
    }

    /// The actors that failed, with their errors.
    pub fn failures(&self) -> impl Iterator<Item = (&str, &str)> {
        self.actors.iter().filter_map(|a| match &a.exit {
            Exit::Failed(error) | Exit::Storage(StorageFailure { error, .. }) => {
                Some((a.name.as_str(), error.as_str()))
            }
            _ => None,
        })
    }

    /// What ended the system, with the actor's name: the first of the [`Report::failures`] that the disk or the system is
    /// at fault for, or else the first.
    pub fn failure(&self) -> Option<(&str, ActorFailure)> {
        let refused = self.actors.iter().find_map(|a| match &a.exit {
            Exit::Storage(StorageFailure { error, refusal }) => {
                let failure = ActorFailure { kind: FailureKind::Storage(*refusal), message: error.clone() };
                Some((a.name.as_str(), failure))
            }
            _ => None,
        });
        refused.or_else(|| self.failures().next().map(|(actor, error)| (actor, ActorFailure::fatal(error))))
    }

    /// The actors that did not end in time.
    pub fn late(&self) -> impl Iterator<Item = &str> {
        self.actors.iter().filter(|a| a.exit == Exit::Late).map(|a| a.name.as_str())
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let width = self.actors.iter().map(|a| a.name.len()).max().unwrap_or(0).max(5);
        writeln!(
            f,
            "{:width$} {:>9} {:>9} {:>9} {:>9} {:>8} {:>7} {:>8} {:>6}  exit",
            "actor",
            "busy s",
            "waiting s",
            "blocked s",
            "cpu s",
            "messages",
            "retries",
            "restarts",
            "given up"
        )?;
        for a in &self.actors {
            let exit = match &a.exit {
                Exit::Running => "running".into(),
                Exit::Finished => "finished".into(),
                Exit::Stopped => "stopped".into(),
                Exit::DownstreamClosed => "its consumer has gone".into(),
                Exit::Failed(error) | Exit::Storage(StorageFailure { error, .. }) => {
                    format!("failed: {error}")
                }
                Exit::Late => "still running".into(),
            };
            writeln!(
                f,
                "{:width$} {:>9.2} {:>9.2} {:>9.2} {:>9.2} {:>8} {:>7} {:>8} {:>8}  {exit}",
                a.name,
                a.busy_s,
                a.waiting_s,
                a.blocked_s,
                a.cpu_s,
                a.messages,
                a.retries,
                a.restarts,
                a.quarantined.len()
            )?;
        }
        write!(f, "{:width$} {:>9.2} s", "wall", self.wall_s)
    }
}
