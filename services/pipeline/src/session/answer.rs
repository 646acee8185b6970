//! The answer to prompts: while it is made, and the last one.

use crate::artifacts::selected::Selected;
use crate::{Replay, RunError, TextRanking};
use segwild_flow::{Observer, Phase, Receiver, Stopper};
use segwild_scene::{Mask, Scene};
use segwild_segmenter::{Alternative, AnswerStep, PhotoVisit, SegmentError, SegmentReply, Segmented};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// An answer that is being made.
pub struct PendingAnswer {
    pub(super) replay: Replay,
    /// What the text of the query may mean, if it has one.
    pub(super) ranking: Option<TextRanking>,
    pub(super) scene: Arc<Scene>,
    pub(super) size: u32,
    pub(super) began: Instant,
    pub(super) observer: Observer,
    pub(super) stoppers: [Stopper; 2],
    pub(super) answers: Receiver<SegmentReply>,
}

/// The last answer to prompts.
pub struct Answer {
    /// The request, with the settings of the selection.
    pub replay: Replay,
    /// What the text of the query may mean, if it has one.
    pub ranking: Option<TextRanking>,
    /// What it selects.
    pub segmented: Box<Segmented>,
    /// Seconds from the prompts to the answer.
    pub select_s: f64,
}

/// Bytes of a splat in a selection: label, score, similarity, evidence, whether it is frozen.
const SPLAT_BYTES: usize = 22;

impl Answer {
    /// About how many bytes it takes in memory.
    pub fn bytes(&self) -> usize {
        let Segmented { selection, cut, masks, .. } = &*self.segmented;
        let of_mask = |mask: &Mask| mask.width() as usize * mask.height() as usize / 8;
        let of_visit = |visit: &PhotoVisit| visit.visibility.len() + visit.own_mask().map_or(0, of_mask);
        SPLAT_BYTES * selection.labels.len()
            + selection.visits.iter().map(of_visit).sum::<usize>()
            + masks.iter().map(|(_, mask)| of_mask(&mask.mask)).sum::<usize>()
            + std::mem::size_of_val(cut.changed.as_slice())
    }
}

/// How long the supervisor may take to note why an actor gave no answer.
const NOTED: Duration = Duration::from_secs(1);

impl PendingAnswer {
    /// Waits for the last answer. `step` receives the earlier ones; that of [`AnswerStep::Selected`] is as the last one, whose
    /// confidence is still unknown.
    ///
    /// # Errors
    /// When nothing is selected, the segmenter fails, or the query or the session was cancelled ([`RunError::Interrupted`]).
    pub fn wait(self, mut step: impl FnMut(AnswerStep, Selected)) -> Result<Answer, RunError> {
        loop {
            match self.answers.blocking_recv() {
                Some(SegmentReply::Step(at, labels)) => step(at, Selected::of_labels(labels)),
                Some(SegmentReply::Selected(labels, cut)) => {
                    step(AnswerStep::Selected, Selected::new(&labels, &cut));
                }
                Some(SegmentReply::Done(Ok(mut segmented))) => {
                    let select_s = self.began.elapsed().as_secs_f64();
                    if let Some(ranking) = &self.ranking {
                        let groups = ranking.matches.iter().map(|found| Alternative::Group(found.light));
                        segmented.alternatives = groups.collect();
                    }
                    return Ok(Answer { replay: self.replay, ranking: self.ranking, segmented, select_s });
                }
                Some(SegmentReply::Done(Err(error))) => {
                    return Err(in_photo_pixels(error, &self.scene, self.size));
                }
                None => return Err(self.no_answer()),
            }
        }
    }

    /// Why there is no answer.
    fn no_answer(&self) -> RunError {
        if self.stoppers.iter().any(|stopper| stopper.phase() != Phase::Running) {
            return RunError::Interrupted;
        }
        let began = Instant::now();
        let mut why = Vec::new();
        while why.is_empty() && began.elapsed() < NOTED {
            for actor in self.observer.snapshot() {
                why.extend(actor.quarantined.last().map(|given_up| given_up.error.clone()));
            }
            std::thread::park_timeout(NOTED / 100);
        }
        failed(if why.is_empty() { "the segmenter gave no answer".into() } else { why.join("; ") })
    }
}

/// The error of a query that got no answer.
pub(super) fn failed(reason: String) -> RunError {
    RunError::Stage { stage: "segment", reason }
}

/// The error with its position in the prompts' coordinates: pixels of the photo as taken, at full size.
fn in_photo_pixels(error: SegmentError, scene: &Scene, size: u32) -> RunError {
    let full = |photo: &str, x: f32, y: f32| {
        let Some(view) = scene.views.iter().find(|v| v.name == photo) else { return (x, y) };
        let (camera, small) = (view.camera, view.camera.scaled_to(size));
        let round = |v: f32| (v * 10.0).round() / 10.0;
        let inner =
            [x * camera.width as f32 / small.width as f32, y * camera.height as f32 / small.height as f32];
        let [x, y] = view.to_taken(inner).unwrap_or(inner);
        (round(x), round(y))
    };
    let error = match error {
        SegmentError::Cancelled => return RunError::Interrupted,
        SegmentError::EmptySpace { photo, x, y, alpha } => {
            let (x, y) = full(&photo, x, y);
            SegmentError::EmptySpace { photo, x, y, alpha: alpha.abs() }
        }
        SegmentError::Background { photo, x, y } => {
            let (x, y) = full(&photo, x, y);
            SegmentError::Background { photo, x, y }
        }
        other => other,
    };
    error.into()
}
