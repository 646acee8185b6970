//! A job: what is to be done, what it needs, how often it is tried.

use serde::{Deserialize, Serialize};

/// What a job needs, or what is free, or a whole budget.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Needs {
    /// Processor cores.
    pub cores: u32,
    /// Memory in bytes.
    pub memory_bytes: u64,
    /// Accelerators.
    pub accelerators: u32,
}

impl Needs {
    /// Whether these needs are met by what is free.
    ///
    /// ```
    /// use segwild_farm::Needs;
    /// let free = Needs { cores: 2, memory_bytes: 1 << 30, accelerators: 0 };
    /// assert!(Needs { cores: 2, ..Needs::default() }.fit(&free));
    /// assert!(!Needs { accelerators: 1, ..Needs::default() }.fit(&free));
    /// ```
    pub fn fit(&self, free: &Needs) -> bool {
        self.cores <= free.cores
            && self.memory_bytes <= free.memory_bytes
            && self.accelerators <= free.accelerators
    }

    /// These and others together.
    pub fn with(&self, others: &Needs) -> Needs {
        Needs {
            cores: self.cores.saturating_add(others.cores),
            memory_bytes: self.memory_bytes.saturating_add(others.memory_bytes),
            accelerators: self.accelerators.saturating_add(others.accelerators),
        }
    }

    /// What is left of a budget when these are taken out of it.
    pub fn taken_from(&self, budget: &Needs) -> Needs {
        Needs {
            cores: budget.cores.saturating_sub(self.cores),
            memory_bytes: budget.memory_bytes.saturating_sub(self.memory_bytes),
            accelerators: budget.accelerators.saturating_sub(self.accelerators),
        }
    }
}

/// How often a job is tried, and how long it rests in between.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Retry {
    /// Attempts that may fail before the job is a dead letter; at least 1.
    pub attempts: u32,
    /// Rest after the first failure, in seconds; doubled for each further one.
    pub first_delay_s: f64,
    /// The longest rest, in seconds.
    pub longest_delay_s: f64,
}

impl Default for Retry {
    /// Three attempts, 5 s to 5 minutes apart.
    fn default() -> Self {
        Self { attempts: 3, first_delay_s: 5.0, longest_delay_s: 300.0 }
    }
}

impl Retry {
    /// The rest after so many failures, in seconds.
    ///
    /// ```
    /// let retry = segwild_farm::Retry { attempts: 9, first_delay_s: 5.0, longest_delay_s: 30.0 };
    /// assert_eq!([1, 2, 3, 4].map(|n| retry.delay_s(n)), [5.0, 10.0, 20.0, 30.0]);
    /// ```
    pub fn delay_s(&self, failures: u32) -> f64 {
        let doubled = self.first_delay_s * 2f64.powi(failures.saturating_sub(1).min(60) as i32);
        doubled.min(self.longest_delay_s)
    }
}

/// Work for somebody.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Job {
    /// Its name; the same name is the same job.
    pub id: String,
    /// What is to be done: whatever the worker understands. The work must be resumable and end in the same
    /// result however often it is started: jobs are delivered at least once.
    pub payload: String,
    /// Higher goes first; equal ones in the order in which they were published.
    pub priority: i32,
    /// What it needs.
    pub needs: Needs,
    /// How often it is tried.
    pub retry: Retry,
    /// The accelerator that a worker must have, by the name that workers give theirs; `None`: any, or none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub accelerator: Option<String>,
}

impl Job {
    /// A job of usual urgency, tried as often as is usual, for a worker with any accelerator.
    pub fn new(id: impl Into<String>, payload: impl Into<String>, needs: Needs) -> Self {
        let (priority, retry, accelerator) = (0, Retry::default(), None);
        Self { id: id.into(), payload: payload.into(), priority, needs, retry, accelerator }
    }
}

/// Needs in words: `2 cores, 1.0 GiB`.
pub(crate) fn words(needs: &Needs) -> String {
    let plural = |n: u32, what: &str| format!("{n} {what}{}", if n == 1 { "" } else { "s" });
    let mut text = plural(needs.cores, "core");
    text += &format!(", {:.1} GiB", needs.memory_bytes as f64 / (1u64 << 30) as f64);
    if needs.accelerators > 0 {
        text += &format!(", {}", plural(needs.accelerators, "accelerator"));
    }
    text
}
