//! What the server answers to.

use crate::messages::{FrameRequest, HoverRequest, PickRequest, RunEntry, StateMessage, StudioAction};
use crate::runs::{Found, ServedRuns};
use crate::{Studio, StudioError, page};
use axum::body::Bytes;
use axum::extract::{Path, Query, Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, get, post};
use axum::{Json, Router};
use futures_util::stream;
use segwild_farm::{EmbeddedEngine, EngineError, JobEngine, JobState};
use segwild_flow::Stopper;
use segwild_monitor::{MonitorTarget, MonitorView};
use segwild_pipeline::RunError;
use segwild_scene::SplatFormat;
use serde::Deserialize;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

type Runs = Arc<ServedRuns>;

/// All routes, without their guard.
pub(crate) fn routes(runs: Runs) -> Router {
    Router::new()
        .route("/", get(async || page::file("index.html")))
        .route("/page/{name}", get(async |Path(name): Path<String>| page::file(&name)))
        .route("/api/v1/runs", get(list))
        .route("/api/v1/status", get(status))
        .route("/api/v1/scenes/{scene}/retry", post(retry))
        .route("/api/v1/runs/{run}", get(describe))
        .route("/api/v1/runs/{run}/state", get(state))
        .route("/api/v1/runs/{run}/events", get(events))
        .route("/api/v1/runs/{run}/act", post(act))
        .route("/api/v1/runs/{run}/train", post(train))
        .route("/api/v1/runs/{run}/training", get(training))
        .route("/api/v1/runs/{run}/training/photos/{photo}", get(early_photo))
        .route("/api/v1/runs/{run}/hover", post(hover))
        .route("/api/v1/runs/{run}/pick", post(pick))
        .route("/api/v1/runs/{run}/frame", post(frame))
        .route("/api/v1/runs/{run}/splats", get(splats))
        .route("/api/v1/runs/{run}/changes", get(changes))
        .route("/api/v1/runs/{run}/labels", get(splat_labels))
        .route("/api/v1/runs/{run}/sheet", get(sheet))
        .route("/api/v1/runs/{run}/photos/{photo}", get(photo))
        .route("/api/v1/runs/{run}/photos/{photo}/labels", get(labels))
        .route("/api/v1/runs/{run}/objects/{object}/photos", get(photos_of))
        .route("/api/v1/runs/{run}/photos/{photo}/transients", get(transients))
        .route("/api/v1/runs/{run}/objects/{object}/ply", object_file(SplatFormat::Ply))
        .route("/api/v1/runs/{run}/objects/{object}/spz", object_file(SplatFormat::Spz))
        .route("/api/v1/runs/{run}/objects/{object}/glb", object_file(SplatFormat::Glb))
        .route("/api/v1/runs/{run}/objects/{object}/save", post(save))
        .route("/api/v1/runs/{run}/export/labels.ply", get(labelled_ply))
        .route("/api/v1/runs/{run}/export/coco.json", get(coco))
        .fallback(async || StatusCode::NOT_FOUND)
        .with_state(runs)
}

/// A refusal in words.
enum Refusal {
    /// The request cannot be answered.
    Because(StatusCode, String),
    /// The session is not open yet: no failure, the same request is answered later.
    Waiting(RunEntry),
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        match self {
            Refusal::Because(code, why) => (code, Json(serde_json::json!({ "error": why }))).into_response(),
            Refusal::Waiting(entry) => (StatusCode::ACCEPTED, Json(entry)).into_response(),
        }
    }
}

/// A refusal, or an answer.
type Answered<T = Response> = Result<T, Refusal>;

/// The answer could not be made: a bug.
fn broken() -> Refusal {
    Refusal::Because(StatusCode::INTERNAL_SERVER_ERROR, "the answer could not be made".into())
}

impl From<StudioError> for Refusal {
    fn from(error: StudioError) -> Refusal {
        let code = match &error {
            StudioError::Run(RunError::Request(_) | RunError::Segment(_)) | StudioError::Request(_) => {
                StatusCode::BAD_REQUEST
            }
            StudioError::Document(_) => StatusCode::CONFLICT,
            StudioError::Journal(_) | StudioError::File(_) | StudioError::Scene(_) | StudioError::Run(_) => {
                StatusCode::INTERNAL_SERVER_ERROR
            }
        };
        Refusal::Because(code, error.to_string())
    }
}

/// The session of a run, or why there is none.
fn session(runs: &Runs, run: &str) -> Answered<Arc<Studio>> {
    match runs.find(run) {
        Found::Open(studio) => Ok(studio),
        Found::Waiting(entry) => Err(Refusal::Waiting(entry)),
        Found::None => Err(Refusal::Because(StatusCode::NOT_FOUND, "there is no such run".into())),
    }
}

/// Answers off the server's own thread.
async fn answered<T: Send + 'static>(
    runs: &Runs,
    run: &str,
    work: impl FnOnce(Arc<Studio>) -> Result<T, StudioError> + Send + 'static,
) -> Answered<T> {
    let studio = session(runs, run)?;
    let done = tokio::task::spawn_blocking(move || work(studio)).await.map_err(|_| broken())?;
    Ok(done?)
}

/// Reads a request's JSON.
fn read<T: for<'de> Deserialize<'de>>(bytes: &Bytes) -> Answered<T> {
    serde_json::from_slice(bytes)
        .map_err(|e| Refusal::Because(StatusCode::BAD_REQUEST, format!("this is no such request: {e}")))
}

async fn list(State(runs): State<Runs>) -> Response {
    Json(runs.list()).into_response()
}

/// The view of operators, as `segwild status --json` prints it.
async fn status(State(runs): State<Runs>) -> Response {
    let view = move || MonitorTarget::at(runs.root()).and_then(|target| target.view());
    match tokio::task::spawn_blocking(view).await {
        Ok(Ok(view)) => Json::<MonitorView>(view).into_response(),
        Ok(Err(error)) => {
            Refusal::Because(StatusCode::SERVICE_UNAVAILABLE, error.to_string()).into_response()
        }
        Err(_) => broken().into_response(),
    }
}

/// Gives a scene of a batch that was given up another chance.
async fn retry(State(runs): State<Runs>, Path(scene): Path<String>) -> Answered {
    let revive = move || -> Answered<()> {
        let refused = |code, why: String| Refusal::Because(code, why);
        let failed = |e: EngineError| refused(StatusCode::INTERNAL_SERVER_ERROR, e.to_string());
        let Ok(MonitorTarget::Batch(folder)) = MonitorTarget::at(runs.root()) else {
            return Err(refused(StatusCode::NOT_FOUND, "this is no batch".into()));
        };
        let engine = EmbeddedEngine::open(folder.engine_file()).map_err(failed)?;
        let jobs = engine.jobs().map_err(failed)?;
        let dead = jobs.iter().find(|j| j.job.id == scene && j.state == JobState::Dead);
        let dead =
            dead.ok_or_else(|| refused(StatusCode::CONFLICT, "no scene of this name was given up".into()))?;
        engine.revive(&dead.job.id).map_err(failed)
    };
    tokio::task::spawn_blocking(revive).await.map_err(|_| broken())??;
    Ok(Json(serde_json::json!({ "retried": true })).into_response())
}

async fn describe(State(runs): State<Runs>, Path(run): Path<String>) -> Answered {
    let description = answered(&runs, &run, |studio| Ok(studio.describe())).await?;
    Ok(Json(description).into_response())
}

async fn state(State(runs): State<Runs>, Path(run): Path<String>) -> Answered<Json<StateMessage>> {
    answered(&runs, &run, |studio| Ok(studio.message())).await.map(Json)
}

/// The state at every change, as server-sent events.
async fn events(State(runs): State<Runs>, Path(run): Path<String>) -> Answered {
    let studio = session(&runs, &run)?;
    let mut changes = studio.changes();
    changes.mark_changed();
    // A session is not held by its viewers: it can be put away while they are there.
    let studio = Arc::downgrade(&studio);
    let next = move |(studio, mut changes): (std::sync::Weak<Studio>, tokio::sync::watch::Receiver<u64>)| async move {
        changes.changed().await.ok()?;
        changes.borrow_and_update();
        let open = studio.upgrade()?;
        let message = tokio::task::spawn_blocking(move || open.message()).await.ok()?;
        let event = Event::default().event("state").json_data(message).ok()?;
        Some((Ok::<_, Infallible>(event), (studio, changes)))
    };
    let events = stream::unfold((studio, changes), next);
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(Duration::from_secs(15))).into_response())
}

async fn act(State(runs): State<Runs>, Path(run): Path<String>, body: Bytes) -> Answered {
    let action: StudioAction = read(&body)?;
    let message = answered(&runs, &run, |studio| {
        studio.act(action)?;
        Ok(studio.message())
    });
    Ok(Json(message.await?).into_response())
}

async fn train(State(runs): State<Runs>, Path(run): Path<String>) -> Answered {
    let done = tokio::task::spawn_blocking(move || runs.train_again(&run)).await.map_err(|_| broken())?;
    done?;
    Ok(Json(serde_json::json!({ "training": true })).into_response())
}

/// The photos and the curves of a run, before it has a scene.
async fn training(State(runs): State<Runs>, Path(run): Path<String>) -> Answered {
    let found = tokio::task::spawn_blocking(move || runs.training(&run)).await.map_err(|_| broken())?;
    let none = || Refusal::Because(StatusCode::NOT_FOUND, "there is no such run".into());
    Ok(Json(found.ok_or_else(none)?).into_response())
}

async fn early_photo(
    State(runs): State<Runs>,
    Path((run, photo)): Path<(String, String)>,
    Query(PhotoSize { size }): Query<PhotoSize>,
) -> Answered {
    let photo = number(&photo)?;
    let read = move || runs.early_photo(&run, photo, size);
    Ok(kept_jpeg(tokio::task::spawn_blocking(read).await.map_err(|_| broken())??))
}

async fn hover(State(runs): State<Runs>, Path(run): Path<String>, body: Bytes) -> Answered {
    let request: HoverRequest = read(&body)?;
    Ok(Json(answered(&runs, &run, move |studio| studio.hover(&request)).await?).into_response())
}

async fn pick(State(runs): State<Runs>, Path(run): Path<String>, body: Bytes) -> Answered {
    let request: PickRequest = read(&body)?;
    Ok(Json(answered(&runs, &run, move |studio| studio.pick(&request)).await?).into_response())
}

async fn frame(State(runs): State<Runs>, Path(run): Path<String>, body: Bytes) -> Answered {
    let request: FrameRequest = read(&body)?;
    let jpeg = answered(&runs, &run, move |studio| studio.frame(&request)).await?;
    Ok(([(header::CONTENT_TYPE, "image/jpeg")], jpeg).into_response())
}

/// A number in a path.
fn number<T: std::str::FromStr>(text: &str) -> Answered<T> {
    text.parse().map_err(|_| Refusal::Because(StatusCode::NOT_FOUND, format!("`{text}` is no number")))
}

/// The size of a photo.
#[derive(Deserialize)]
struct PhotoSize {
    #[serde(default = "shown_size")]
    size: u32,
}

fn shown_size() -> u32 {
    1024
}

/// A photo: it does not change while a session is open.
fn kept_jpeg(jpeg: Vec<u8>) -> Response {
    let kept = [(header::CONTENT_TYPE, "image/jpeg"), (header::CACHE_CONTROL, "private, max-age=3600")];
    (kept, jpeg).into_response()
}

async fn photo(
    State(runs): State<Runs>,
    Path((run, photo)): Path<(String, String)>,
    Query(PhotoSize { size }): Query<PhotoSize>,
) -> Answered {
    let photo = number(&photo)?;
    let jpeg = answered(&runs, &run, move |studio| studio.photo(photo, size)).await?;
    Ok(kept_jpeg(jpeg))
}

async fn labels(State(runs): State<Runs>, Path((run, photo)): Path<(String, String)>) -> Answered {
    let photo = number(&photo)?;
    Ok(Json(answered(&runs, &run, move |studio| studio.labels(photo)).await?).into_response())
}

async fn splats(State(runs): State<Runs>, Path(run): Path<String>, request: Request) -> Answered {
    let appearance = request.uri().query().and_then(|query| query.strip_prefix("appearance="));
    let appearance = appearance.map(number::<usize>).transpose()?;
    let bytes = answered(&runs, &run, move |studio| studio.packed(appearance)).await?;
    Ok(([(header::CONTENT_TYPE, "application/octet-stream")], bytes).into_response())
}

/// Stops the work for a request whose client does not wait for it any more.
struct StopsWithRequest(Stopper);

impl Drop for StopsWithRequest {
    fn drop(&mut self) {
        self.0.stop();
    }
}

async fn changes(State(runs): State<Runs>, Path(run): Path<String>) -> Answered {
    let request = StopsWithRequest(Stopper::new());
    let stopper = request.0.clone();
    let (bytes, version) = answered(&runs, &run, move |studio| studio.packed_changes(&stopper)).await?;
    let mut response = ([(header::CONTENT_TYPE, "application/octet-stream")], bytes).into_response();
    response.headers_mut().insert("segwild-version", HeaderValue::from_str(&version).map_err(|_| broken())?);
    Ok(response)
}

async fn splat_labels(State(runs): State<Runs>, Path(run): Path<String>) -> Answered {
    let (labels, revision) = answered(&runs, &run, |studio| Ok(studio.splat_labels())).await?;
    let mut response = ([(header::CONTENT_TYPE, "application/octet-stream")], labels).into_response();
    response.headers_mut().insert("segwild-revision", HeaderValue::from(revision));
    Ok(response)
}

async fn sheet(State(runs): State<Runs>, Path(run): Path<String>) -> Answered {
    let png = answered(&runs, &run, |studio| studio.sheet()).await?;
    Ok(([(header::CONTENT_TYPE, "image/png")], png).into_response())
}

async fn photos_of(State(runs): State<Runs>, Path((run, object)): Path<(String, String)>) -> Answered {
    let object = number(&object)?;
    Ok(Json(answered(&runs, &run, move |studio| studio.photos_of(object)).await?).into_response())
}

async fn transients(State(runs): State<Runs>, Path((run, photo)): Path<(String, String)>) -> Answered {
    let photo = number(&photo)?;
    Ok(Json(answered(&runs, &run, move |studio| studio.transients(photo)).await?).into_response())
}

async fn save(State(runs): State<Runs>, Path((run, object)): Path<(String, String)>) -> Answered {
    let object = number(&object)?;
    let name = answered(&runs, &run, move |studio| studio.save(object)).await?;
    Ok(Json(serde_json::json!({ "selection": name })).into_response())
}

/// A file to be saved.
fn attached(file: &str, bytes: Vec<u8>) -> Response {
    let disposition = format!("attachment; filename=\"{file}\"");
    let headers = [
        (header::CONTENT_TYPE, "application/octet-stream".into()),
        (header::CONTENT_DISPOSITION, disposition),
    ];
    (headers, bytes).into_response()
}

async fn labelled_ply(State(runs): State<Runs>, Path(run): Path<String>) -> Answered {
    Ok(attached("labels.ply", answered(&runs, &run, |studio| studio.labelled_ply()).await?))
}

async fn coco(State(runs): State<Runs>, Path(run): Path<String>) -> Answered {
    Ok(attached("coco.json", answered(&runs, &run, |studio| studio.coco()).await?))
}

/// Answers with an object as a file of a format.
fn object_file(format: SplatFormat) -> MethodRouter<Runs> {
    get(async move |State(runs): State<Runs>, Path((run, object)): Path<(String, String)>| -> Answered {
        let object = number(&object)?;
        let (name, bytes) = answered(&runs, &run, move |studio| studio.object_file(object, format)).await?;
        Ok(attached(&name, bytes))
    })
}
