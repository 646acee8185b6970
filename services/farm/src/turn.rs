//! Whose turn it is.

use crate::job::{Job, Needs};

/// How a waiting job stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct JobTurn<'a> {
    /// What is free for it.
    pub free: Needs,
    /// Whether that is enough.
    pub fits: bool,
    /// The more urgent job that something else is kept free for.
    pub kept_for: Option<&'a str>,
}

/// The turns of jobs that could start now, the most urgent first.
///
/// A job that finds no capacity yet keeps free what it will need: less urgent ones, however small, do not overtake it for
/// ever. Equally urgent ones do start before it where there is capacity, and so does everybody before a job that this
/// worker could not take with all it has (`whole`).
///
/// ```
/// use segwild_farm::{Job, Needs, turns};
/// let job = |id: &str, priority, accelerators| {
///     let needs = Needs { cores: 1, memory_bytes: 0, accelerators };
///     Job { priority, ..Job::new(id, "", needs) }
/// };
/// let (urgent, next, last) = (job("urgent", 9, 2), job("next", 5, 1), job("last", 1, 0));
/// let whole = Needs { cores: 4, memory_bytes: 0, accelerators: 2 };
/// let free = Needs { cores: 3, accelerators: 1, ..whole };
/// let turns = turns(&[&urgent, &next, &last], &free, &whole);
/// assert_eq!(turns.iter().map(|t| t.fits).collect::<Vec<_>>(), [false, false, true]);
/// assert_eq!(turns[1].kept_for, Some("urgent"));
/// ```
pub fn turns<'a>(waiting: &[&'a Job], free: &Needs, whole: &Needs) -> Vec<JobTurn<'a>> {
    let mut queue = TurnQueue::new(free);
    let turn = |job: &&'a Job| {
        let turn = queue.turn(job.priority, &job.needs);
        if !turn.fits && job.needs.fit(whole) {
            queue.keep(&job.id, &job.needs);
        }
        turn
    };
    waiting.iter().map(turn).collect()
}

/// The state of [`turns`] on its way through the queue.
pub(crate) struct TurnQueue<'a> {
    /// For jobs of the present priority, and for those after it.
    here: JobTurn<'a>,
    below: JobTurn<'a>,
    priority: i32,
}

impl<'a> TurnQueue<'a> {
    pub fn new(free: &Needs) -> Self {
        let here = JobTurn { free: *free, fits: false, kept_for: None };
        Self { here, below: here, priority: i32::MAX }
    }

    /// The turn of the next job.
    pub fn turn(&mut self, priority: i32, needs: &Needs) -> JobTurn<'a> {
        if priority < self.priority {
            (self.here, self.priority) = (self.below, priority);
        }
        JobTurn { fits: needs.fit(&self.here.free), ..self.here }
    }

    /// Keeps what a job needs free of less urgent ones.
    pub fn keep(&mut self, id: &'a str, needs: &Needs) {
        self.below.free = needs.taken_from(&self.below.free);
        self.below.kept_for = self.below.kept_for.or(Some(id));
    }
}
