//! What requests do and why they are refused, whether they come as JSON or as gRPC.

use crate::document::ObjectId;
use crate::farm::{FarmRetryError, SeenFarm};
use crate::messages::{RunEntry, StateMessage, StudioAction, TrainingMessage};
use crate::runs::{Found, ServedRuns};
use crate::studio::{BUSY, MaskArchive, PhotoSearch, REPLACED};
use crate::{Studio, StudioError};
use futures_util::StreamExt;
use futures_util::stream::{self, BoxStream};
use segwild_farm::{EmbeddedEngine, EngineError, JobEngine, JobState};
use segwild_flow::Stopper;
use segwild_monitor::{MonitorTarget, MonitorView};
use segwild_pipeline::{PackedSplats, RunError};
use std::path::Path;
use std::sync::{Arc, Weak};
use tokio::sync::{OwnedMutexGuard, watch};

/// The runs of a server, as requests share them.
pub(crate) type Runs = Arc<ServedRuns>;

/// Long side in pixels of a photo where none is requested.
pub(crate) const SHOWN_SIZE: u32 = 1024;

/// Media type of photos and renders.
pub(crate) const JPEG: &str = "image/jpeg";

/// Media type of the thumbnails.
pub(crate) const PNG: &str = "image/png";

/// Media type of archives.
pub(crate) const ZIP: &str = "application/zip";

/// Media type of packed numbers and of files to be saved.
pub(crate) const OCTETS: &str = "application/octet-stream";

/// What kind of refusal it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RefusalKind {
    /// The request makes no sense.
    Request,
    /// There is no such run, scene or photo.
    Missing,
    /// It does not fit the present objects.
    Conflict,
    /// The view of operators cannot be read, or a run cannot be opened.
    Unavailable,
    /// The answer could not be made.
    Broken,
}

/// A refusal in words.
pub(crate) enum Refusal {
    /// The request cannot be answered.
    Because(RefusalKind, String),
    /// The session is not open yet: no failure, the same request is answered later.
    Waiting(RunEntry),
}

/// A refusal, or an answer.
pub(crate) type Answered<T> = Result<T, Refusal>;

impl Refusal {
    /// There is no such run.
    pub fn no_run() -> Refusal {
        Refusal::Because(RefusalKind::Missing, "there is no such run".into())
    }

    /// The answer could not be made: a bug.
    pub fn broken() -> Refusal {
        Refusal::Because(RefusalKind::Broken, "the answer could not be made".into())
    }
}

impl From<StudioError> for Refusal {
    fn from(error: StudioError) -> Refusal {
        let kind = match &error {
            StudioError::Run(RunError::Request(_) | RunError::Segment(_)) | StudioError::Request(_) => {
                RefusalKind::Request
            }
            StudioError::Document(_) | StudioError::Conflict(_) => RefusalKind::Conflict,
            StudioError::Journal(_) | StudioError::File(_) | StudioError::Scene(_) | StudioError::Run(_) => {
                RefusalKind::Broken
            }
        };
        Refusal::Because(kind, error.to_string())
    }
}

/// Works off the server's own thread.
async fn apart<T: Send + 'static>(work: impl FnOnce() -> Answered<T> + Send + 'static) -> Answered<T> {
    tokio::task::spawn_blocking(work).await.map_err(|_| Refusal::broken())?
}

/// The session of a run, or why there is none.
fn session(runs: &Runs, run: &str) -> Answered<Arc<Studio>> {
    match runs.find(run) {
        Found::Open(studio) => Ok(studio),
        Found::Waiting(entry) => Err(Refusal::Waiting(entry)),
        Found::Failed(why) => {
            let why = format!("the run `{run}` cannot be opened: {why}");
            Err(Refusal::Because(RefusalKind::Unavailable, why))
        }
        Found::None => Err(Refusal::no_run()),
    }
}

/// Answers by a run's session, off the server's own thread.
pub(crate) async fn answered<T: Send + 'static>(
    runs: &Runs,
    run: &str,
    work: impl FnOnce(Arc<Studio>) -> Result<T, StudioError> + Send + 'static,
) -> Answered<T> {
    let studio = session(runs, run)?;
    apart(move || Ok(work(studio)?)).await
}

/// Writes an object as a selection of the run; returns its name. It waits for its turn without a thread.
pub(crate) async fn save(runs: &Runs, run: &str, object: ObjectId) -> Answered<String> {
    let written = session(runs, run)?.save_in_turn(object)?;
    Ok(written.await.map_err(|_| Refusal::broken())??)
}

/// The view of operators, as `segwild status --json` prints it: of a run, or of the folder, or of the farm where there is no
/// folder.
pub(crate) async fn status(runs: Runs, run: Option<String>) -> Answered<MonitorView> {
    let folder = match run {
        Some(run) => Some(runs.folder(&run).ok_or_else(Refusal::no_run)?),
        None => runs.root().map(Path::to_owned),
    };
    let Some(folder) = folder else {
        let farm = farm(&runs).await?.ok_or_else(no_farm)?;
        return Ok(MonitorView::Batch(Box::new(farm.view.clone())));
    };
    let view = move || MonitorTarget::at(&folder).and_then(|target| target.view());
    apart(move || view().map_err(|e| Refusal::Because(RefusalKind::Unavailable, e.to_string()))).await
}

/// The view of the farm; `None` where the server shows none.
pub(crate) async fn farm(runs: &Runs) -> Answered<Option<Arc<SeenFarm>>> {
    let Some(farm) = runs.farm() else { return Ok(None) };
    let seen = farm.view().await;
    seen.map(Some).map_err(|why| Refusal::Because(RefusalKind::Unavailable, why.to_string()))
}

/// Gives a scene of the farm that was given up another chance.
pub(crate) async fn retry_on_farm(runs: Runs, scene: String) -> Answered<()> {
    apart(move || {
        runs.farm().ok_or_else(no_farm)?.retry(&scene).map_err(|error| match error {
            FarmRetryError::Engine(EngineError::Unknown(_)) => not_given_up(),
            error => Refusal::Because(RefusalKind::Unavailable, error.to_string()),
        })
    })
    .await
}

fn no_farm() -> Refusal {
    let why = "this server shows no farm; `segwild serve --farm nats://HOST:PORT/NAME` shows one";
    Refusal::Because(RefusalKind::Missing, why.into())
}

fn not_given_up() -> Refusal {
    Refusal::Because(RefusalKind::Conflict, "no scene of this name was given up".into())
}

/// Gives a scene of a batch that was given up another chance.
pub(crate) async fn retry(runs: Runs, scene: String) -> Answered<()> {
    if runs.root().is_none() {
        return retry_on_farm(runs, scene).await;
    }
    apart(move || {
        let refused = |kind, why: String| Refusal::Because(kind, why);
        let failed = |e: EngineError| refused(RefusalKind::Broken, e.to_string());
        let Some(Ok(MonitorTarget::Batch(folder))) = runs.root().map(MonitorTarget::at) else {
            return Err(refused(RefusalKind::Missing, "this is no batch".into()));
        };
        let engine = EmbeddedEngine::open(folder.engine_file()).map_err(failed)?;
        let jobs = engine.jobs().map_err(failed)?;
        let dead = jobs.iter().find(|j| j.job.id == scene && j.state == JobState::Dead);
        engine.revive(&dead.ok_or_else(not_given_up)?.job.id).map_err(failed)
    })
    .await
}

/// The state of a run now and at every change. It ends with the session.
pub(crate) fn states(runs: &Runs, run: &str) -> Answered<BoxStream<'static, StateMessage>> {
    let studio = session(runs, run)?;
    let mut changes = studio.changes();
    changes.mark_changed();
    // A session is not held by its viewers: it can be put away while they are there.
    let studio = Arc::downgrade(&studio);
    let next = |(studio, mut changes): (Weak<Studio>, watch::Receiver<u64>)| async move {
        changes.changed().await.ok()?;
        changes.borrow_and_update();
        let open = studio.upgrade()?;
        let message = tokio::task::spawn_blocking(move || open.message()).await.ok()?;
        Some((message, (studio, changes)))
    };
    Ok(stream::unfold((studio, changes), next).boxed())
}

/// Does what a person wants, and answers with the state.
pub(crate) async fn act(runs: &Runs, run: &str, action: StudioAction) -> Answered<StateMessage> {
    answered(runs, run, |studio| {
        studio.act(action)?;
        Ok(studio.message())
    })
    .await
}

/// Pixels of each photo that show an object. Which splats the photos show is found out once for a run, photo by photo: one request at
/// a time does it, so that threads stay free for others, and a request whose client is gone ends at the next photo. What is known by
/// then stays known.
pub(crate) async fn photos_of(runs: &Runs, run: &str, object: ObjectId) -> Answered<Vec<usize>> {
    let studio = session(runs, run)?;
    let (turn, weak) = (studio.photos_turn(), Arc::downgrade(&studio));
    let selected = apart(move || Ok(studio.shown_by_photos(object)?)).await?;
    // A session is not held by who waits: it can be put away meanwhile.
    let open = || weak.upgrade().ok_or_else(closed);
    let own = turn.lock_owned().await;
    loop {
        let studio = open()?;
        match apart(move || Ok(studio.find_next_splats()?)).await? {
            PhotoSearch::Over => break,
            PhotoSearch::GoesOn => {}
            PhotoSearch::Waits => tokio::time::sleep(BUSY).await,
        }
    }
    drop(own);
    let studio = open()?;
    apart(move || Ok(studio.pixels_of(&selected)?)).await
}

fn closed() -> Refusal {
    REPLACED.into()
}

/// Continues the training without corrected transients.
pub(crate) async fn train(runs: Runs, run: String) -> Answered<()> {
    apart(move || Ok(runs.train_again(&run)?)).await
}

/// The photos and the curves of a run, before it has a scene.
pub(crate) async fn training(runs: Runs, run: String) -> Answered<TrainingMessage> {
    apart(move || runs.training(&run).ok_or_else(Refusal::no_run)).await
}

/// A photo of a run that may have no scene yet, as JPEG.
pub(crate) async fn training_photo(runs: Runs, run: String, photo: usize, size: u32) -> Answered<Vec<u8>> {
    apart(move || Ok(runs.early_photo(&run, photo, size)?)).await
}

/// Stops the work for a request whose client does not wait for it any more.
struct StopsWithRequest(Stopper);

impl Drop for StopsWithRequest {
    fn drop(&mut self) {
        self.0.stop();
    }
}

/// All splats, packed, in parts as the client takes them.
pub(crate) async fn splats(
    runs: &Runs,
    run: &str,
    appearance: Option<usize>,
) -> Answered<BoxStream<'static, Vec<u8>>> {
    let packed = answered(runs, run, move |studio| studio.packed(appearance)).await?;
    let next = |mut packed: PackedSplats| async move {
        let part = tokio::task::spawn_blocking(move || packed.next().map(|part| (part, packed)));
        part.await.ok()?
    };
    Ok(stream::unfold(packed, next).boxed())
}

/// What objects change of the splats, packed, and its version.
pub(crate) async fn changes(runs: &Runs, run: &str) -> Answered<(Vec<u8>, String)> {
    let request = StopsWithRequest(Stopper::new());
    let stopper = request.0.clone();
    answered(runs, run, move |studio| studio.packed_changes(&stopper)).await
}

/// Masks of an object, or of all, as a COCO file, and the file's name.
pub(crate) async fn coco(runs: &Runs, run: &str, object: Option<ObjectId>) -> Answered<(String, Vec<u8>)> {
    let request = StopsWithRequest(Stopper::new());
    let stopper = request.0.clone();
    answered(runs, run, move |studio| studio.coco(object, &stopper)).await
}

/// Parts of a file that is made while it is sent.
pub(crate) type MadeParts = BoxStream<'static, Result<Vec<u8>, StudioError>>;

/// Masks of an object, or of all, as an archive in parts as the client takes them, and the file's name. One archive of a session is
/// made at a time: the first part of another one waits, without a thread.
pub(crate) async fn masks(runs: &Runs, run: &str, object: Option<ObjectId>) -> Answered<(String, MadeParts)> {
    let request = StopsWithRequest(Stopper::new());
    let stopper = request.0.clone();
    let (name, archive, turn) = answered(runs, run, move |studio| {
        let (name, archive) = studio.mask_archive(object, stopper)?;
        Ok((name, archive, studio.archive_turn()))
    })
    .await?;
    let next = |state: Option<WantedArchive>| async move {
        let WantedArchive { mut archive, request, turn, own } = state?;
        let own = match own {
            Some(own) => own,
            None => turn.clone().lock_owned().await,
        };
        let made = tokio::task::spawn_blocking(move || {
            let part = archive.next_part();
            (part, archive)
        });
        match made.await {
            Ok((part, archive)) => {
                let rest = WantedArchive { archive, request, turn, own: Some(own) };
                Some((part.transpose()?, Some(rest)))
            }
            // An archive without its end would pass for a whole one.
            Err(_) => Some((Err(StudioError::Request("the masks could not be made")), None)),
        }
    };
    let wanted = WantedArchive { archive, request, turn, own: None };
    Ok((name, stream::unfold(Some(wanted), next).boxed()))
}

/// An archive that a client takes.
struct WantedArchive {
    archive: MaskArchive,
    request: StopsWithRequest,
    /// The turn to make one.
    turn: Arc<tokio::sync::Mutex<()>>,
    /// The turn, once it is this one's.
    own: Option<OwnedMutexGuard<()>>,
}
