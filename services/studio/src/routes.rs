//! What the server answers to by HTTP: one table of requests, of which the router and the OpenAPI page are made.

use crate::calls::{
    self, Answered, JPEG, MadeParts, OCTETS, PNG, Refusal, RefusalKind, Runs, SHOWN_SIZE, ZIP, answered,
};
use crate::messages::{FrameRequest, HoverRequest, PickRequest, StateMessage, StudioAction};
use crate::page;
use crate::rates::{AdmittedClient, RequestCost};
use axum::body::{Body, Bytes, to_bytes};
use axum::extract::{Path, Query, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::{Next, from_fn};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodFilter, MethodRouter, get, on};
use axum::{Extension, Json, Router};
use futures_util::StreamExt;
use segwild_scene::SplatFormat;
use serde::Deserialize;
use std::convert::Infallible;
use std::time::Duration;

/// Bytes of the words that a refusal of the router has, at most.
const MOST_WORDS: usize = 1 << 12;

/// What the paths of the API start with.
pub(crate) const ROOT: &str = "/api/v1";

/// How a request is made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ApiMethod {
    /// It changes nothing.
    Get,
    /// It has a body, or changes something.
    Post,
}

/// What a request is answered with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ApiAnswer {
    /// The message of the call, as JSON.
    Message,
    /// One field of that message alone, as JSON.
    Field(&'static str),
    /// The messages of the call, as server-sent events.
    Events,
    /// A file of this media type.
    File(&'static str),
}

/// A request of the API.
pub(crate) struct ApiRoute {
    pub method: ApiMethod,
    /// Its path below [`ROOT`].
    pub path: &'static str,
    /// Fields of the call's request that stand in the query.
    pub query: &'static [&'static str],
    /// The call of `session.proto` that does the same.
    pub call: &'static str,
    pub answer: ApiAnswer,
    handler: fn(MethodFilter) -> MethodRouter<Runs>,
}

const fn row(
    method: ApiMethod,
    path: &'static str,
    query: &'static [&'static str],
    call: &'static str,
    answer: ApiAnswer,
    handler: fn(MethodFilter) -> MethodRouter<Runs>,
) -> ApiRoute {
    ApiRoute { method, path, query, call, answer, handler }
}

use ApiAnswer::{Events, Field, File, Message};
use ApiMethod::{Get, Post};

/// All requests of the API.
#[rustfmt::skip]
pub(crate) const API: &[ApiRoute] = &[
    row(Get, "/runs", &[], "List", Field("runs"), |m| on(m, list)),
    row(Get, "/status", &["run"], "Status", Message, |m| on(m, status)),
    row(Post, "/scenes/{scene}/retry", &[], "Retry", Message, |m| on(m, retry)),
    row(Get, "/farm", &[], "Farm", Field("farm"), |m| on(m, farm)),
    row(Post, "/farm/scenes/{scene}/retry", &[], "RetryOnFarm", Message, |m| on(m, retry_on_farm)),
    row(Get, "/runs/{run}", &[], "Describe", Message, |m| on(m, describe)),
    row(Get, "/runs/{run}/state", &[], "State", Message, |m| on(m, state)),
    row(Get, "/runs/{run}/events", &[], "Events", Events, |m| on(m, events)),
    row(Post, "/runs/{run}/act", &[], "Act", Message, |m| on(m, act)),
    row(Post, "/runs/{run}/train", &[], "Train", Message, |m| on(m, train)),
    row(Get, "/runs/{run}/training", &[], "Training", Message, |m| on(m, training)),
    row(Get, "/runs/{run}/training/photos/{photo}", &["size"], "TrainingPhoto", File(JPEG), |m| on(m, early_photo)),
    row(Post, "/runs/{run}/hover", &[], "Hover", Field("candidate"), |m| on(m, hover)),
    row(Post, "/runs/{run}/pick", &[], "Pick", Field("pixel"), |m| on(m, pick)),
    row(Post, "/runs/{run}/frame", &[], "Frame", File(JPEG), |m| on(m, frame)),
    row(Get, "/runs/{run}/splats", &["appearance"], "Splats", File(OCTETS), |m| on(m, splats)),
    row(Get, "/runs/{run}/changes", &[], "Changes", File(OCTETS), |m| on(m, changes)),
    row(Get, "/runs/{run}/labels", &[], "SplatLabels", File(OCTETS), |m| on(m, splat_labels)),
    row(Get, "/runs/{run}/sheet", &[], "Sheet", File(PNG), |m| on(m, sheet)),
    row(Get, "/runs/{run}/photos/{photo}", &["size"], "Photo", File(JPEG), |m| on(m, photo)),
    row(Get, "/runs/{run}/photos/{photo}/labels", &[], "PhotoLabels", Message, |m| on(m, labels)),
    row(Get, "/runs/{run}/photos/{photo}/transients", &[], "PhotoTransients", Message, |m| on(m, transients)),
    row(Get, "/runs/{run}/objects/{object}/photos", &[], "ObjectPhotos", Field("pixels"), |m| on(m, photos_of)),
    row(Get, "/runs/{run}/objects/{object}/ply", &[], "ObjectFile", File(OCTETS), |m| object_file(m, SplatFormat::Ply)),
    row(Get, "/runs/{run}/objects/{object}/spz", &[], "ObjectFile", File(OCTETS), |m| object_file(m, SplatFormat::Spz)),
    row(Get, "/runs/{run}/objects/{object}/glb", &[], "ObjectFile", File(OCTETS), |m| object_file(m, SplatFormat::Glb)),
    row(Get, "/runs/{run}/objects/{object}/prompts", &[], "ObjectPrompts", File(OCTETS), |m| on(m, prompts)),
    row(Post, "/runs/{run}/objects/{object}/save", &[], "Save", Message, |m| on(m, save)),
    row(Get, "/runs/{run}/export/labels.ply", &[], "LabelledPly", File(OCTETS), |m| on(m, labelled_ply)),
    row(Get, "/runs/{run}/objects/{object}/coco.json", &[], "ObjectCoco", File(OCTETS), |m| on(m, object_coco)),
    row(Get, "/runs/{run}/objects/{object}/masks.zip", &[], "ObjectMasks", File(ZIP), |m| on(m, object_masks)),
    row(Get, "/runs/{run}/export/coco.json", &[], "Coco", File(OCTETS), |m| on(m, coco)),
    row(Get, "/runs/{run}/export/masks.zip", &[], "Masks", File(ZIP), |m| on(m, masks)),
];

impl ApiMethod {
    fn filter(self) -> MethodFilter {
        match self {
            ApiMethod::Get => MethodFilter::GET,
            ApiMethod::Post => MethodFilter::POST,
        }
    }
}

/// The call of `session.proto` that a request of this path makes; `None` for files of the page and for what is not
/// there.
pub(crate) fn call_of(path: &str) -> Option<&'static str> {
    let path = path.strip_prefix(ROOT)?;
    let fits = |route: &&ApiRoute| {
        let (wanted, present) = (route.path.split('/'), path.split('/'));
        wanted.clone().count() == present.clone().count()
            && wanted
                .zip(present)
                .all(|(wanted, present)| wanted.starts_with('{') && !present.is_empty() || wanted == present)
    };
    API.iter().find(fits).map(|route| route.call)
}

/// All routes, without their guard.
pub(crate) fn routes(runs: Runs) -> Router {
    let mut router =
        Router::new().route("/", get(async |headers: HeaderMap| page::file("index.html", &headers))).route(
            "/page/{name}",
            get(async |Path(name): Path<String>, headers: HeaderMap| page::file(&name, &headers)),
        );
    for route in API {
        router = router.route(&format!("{ROOT}{}", route.path), (route.handler)(route.method.filter()));
    }
    router.fallback(async || StatusCode::NOT_FOUND).layer(from_fn(in_words)).with_state(runs)
}

/// Gives a refusal that is the router's own a sentence in the form of all others: of an address that is not there, of a method, a
/// query or a body that does not fit.
async fn in_words(request: Request, next: Next) -> Response {
    let response = next.run(request).await;
    let code = response.status();
    let is_json = response.headers().get(header::CONTENT_TYPE).is_some_and(|kind| kind == "application/json");
    if is_json || !(code.is_client_error() || code.is_server_error()) {
        return response;
    }
    let own = to_bytes(response.into_body(), MOST_WORDS).await.unwrap_or_default();
    let why: String = match code {
        StatusCode::NOT_FOUND => "there is nothing at this address".into(),
        StatusCode::METHOD_NOT_ALLOWED => "this address takes no request of this method".into(),
        _ if own.is_empty() => "the request cannot be answered".into(),
        _ => String::from_utf8_lossy(&own).into_owned(),
    };
    (code, Json(serde_json::json!({ "error": why }))).into_response()
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        match self {
            Refusal::Because(kind, why) => {
                let code = match kind {
                    RefusalKind::Request => StatusCode::BAD_REQUEST,
                    RefusalKind::Missing => StatusCode::NOT_FOUND,
                    RefusalKind::Conflict => StatusCode::CONFLICT,
                    RefusalKind::Unavailable => StatusCode::SERVICE_UNAVAILABLE,
                    RefusalKind::Broken => StatusCode::INTERNAL_SERVER_ERROR,
                };
                (code, Json(serde_json::json!({ "error": why }))).into_response()
            }
            Refusal::Waiting(entry) => (StatusCode::ACCEPTED, Json(entry)).into_response(),
        }
    }
}

/// Reads a request's JSON.
fn read<T: for<'de> Deserialize<'de>>(bytes: &Bytes) -> Answered<T> {
    serde_json::from_slice(bytes)
        .map_err(|e| Refusal::Because(RefusalKind::Request, format!("this is no such request: {e}")))
}

async fn list(State(runs): State<Runs>) -> Response {
    Json(runs.list()).into_response()
}

/// Whose progress is requested.
#[derive(Deserialize)]
struct StatusOf {
    run: Option<String>,
}

async fn status(State(runs): State<Runs>, Query(StatusOf { run }): Query<StatusOf>) -> Answered<Response> {
    Ok(Json(calls::status(runs, run).await?).into_response())
}

async fn retry(State(runs): State<Runs>, Path(scene): Path<String>) -> Answered<Response> {
    calls::retry(runs, scene).await?;
    Ok(Json(serde_json::json!({ "retried": true })).into_response())
}

async fn farm(State(runs): State<Runs>) -> Answered<Response> {
    Ok(match calls::farm(&runs).await? {
        Some(farm) => ([(header::CONTENT_TYPE, "application/json")], farm.json.clone()).into_response(),
        None => Json(serde_json::Value::Null).into_response(),
    })
}

async fn retry_on_farm(State(runs): State<Runs>, Path(scene): Path<String>) -> Answered<Response> {
    calls::retry_on_farm(runs, scene).await?;
    Ok(Json(serde_json::json!({ "retried": true })).into_response())
}

async fn describe(State(runs): State<Runs>, Path(run): Path<String>) -> Answered<Response> {
    let description = answered(&runs, &run, |studio| Ok(studio.describe())).await?;
    Ok(Json(description).into_response())
}

async fn state(State(runs): State<Runs>, Path(run): Path<String>) -> Answered<Json<StateMessage>> {
    answered(&runs, &run, |studio| Ok(studio.message())).await.map(Json)
}

/// The state at every change, as server-sent events.
async fn events(State(runs): State<Runs>, Path(run): Path<String>) -> Answered<Response> {
    let events =
        calls::states(&runs, &run)?.map(|message| Event::default().event("state").json_data(message));
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(Duration::from_secs(15))).into_response())
}

async fn act(State(runs): State<Runs>, Path(run): Path<String>, body: Bytes) -> Answered<Response> {
    let action: StudioAction = read(&body)?;
    Ok(Json(calls::act(&runs, &run, action).await?).into_response())
}

async fn train(State(runs): State<Runs>, Path(run): Path<String>) -> Answered<Response> {
    calls::train(runs, run).await?;
    Ok(Json(serde_json::json!({ "training": true })).into_response())
}

async fn training(State(runs): State<Runs>, Path(run): Path<String>) -> Answered<Response> {
    Ok(Json(calls::training(runs, run).await?).into_response())
}

async fn early_photo(
    State(runs): State<Runs>,
    Path((run, photo)): Path<(String, String)>,
    Query(PhotoSize { size }): Query<PhotoSize>,
) -> Answered<Response> {
    let photo = number(&photo)?;
    Ok(kept_jpeg(calls::training_photo(runs, run, photo, size).await?))
}

async fn hover(
    State(runs): State<Runs>,
    Path(run): Path<String>,
    Extension(client): Extension<AdmittedClient>,
    body: Bytes,
) -> Answered<Response> {
    let request: HoverRequest = read(&body)?;
    if request.view.is_some() {
        client.charge(RequestCost::OF_VIEW);
    }
    Ok(Json(answered(&runs, &run, move |studio| studio.hover(&request)).await?).into_response())
}

async fn pick(State(runs): State<Runs>, Path(run): Path<String>, body: Bytes) -> Answered<Response> {
    let request: PickRequest = read(&body)?;
    Ok(Json(answered(&runs, &run, move |studio| studio.pick(&request)).await?).into_response())
}

async fn frame(State(runs): State<Runs>, Path(run): Path<String>, body: Bytes) -> Answered<Response> {
    let request: FrameRequest = read(&body)?;
    let jpeg = answered(&runs, &run, move |studio| studio.frame(&request)).await?;
    Ok(([(header::CONTENT_TYPE, JPEG)], jpeg).into_response())
}

/// A number in a path.
fn number<T: std::str::FromStr>(text: &str) -> Answered<T> {
    text.parse().map_err(|_| Refusal::Because(RefusalKind::Missing, format!("`{text}` is no number")))
}

/// The size of a photo.
#[derive(Deserialize)]
struct PhotoSize {
    #[serde(default = "shown_size")]
    size: u32,
}

fn shown_size() -> u32 {
    SHOWN_SIZE
}

/// A photo: it does not change while a session is open.
fn kept_jpeg(jpeg: Vec<u8>) -> Response {
    let kept = [(header::CONTENT_TYPE, JPEG), (header::CACHE_CONTROL, "private, max-age=3600")];
    (kept, jpeg).into_response()
}

async fn photo(
    State(runs): State<Runs>,
    Path((run, photo)): Path<(String, String)>,
    Query(PhotoSize { size }): Query<PhotoSize>,
) -> Answered<Response> {
    let photo = number(&photo)?;
    let jpeg = answered(&runs, &run, move |studio| studio.photo(photo, size)).await?;
    Ok(kept_jpeg(jpeg))
}

async fn labels(State(runs): State<Runs>, Path((run, photo)): Path<(String, String)>) -> Answered<Response> {
    let photo = number(&photo)?;
    Ok(Json(answered(&runs, &run, move |studio| studio.labels(photo)).await?).into_response())
}

async fn splats(State(runs): State<Runs>, Path(run): Path<String>, request: Request) -> Answered<Response> {
    let appearance = request.uri().query().and_then(|query| query.strip_prefix("appearance="));
    let appearance = appearance.map(number::<usize>).transpose()?;
    let parts = calls::splats(&runs, &run, appearance).await?;
    let body = Body::from_stream(parts.map(Ok::<_, Infallible>));
    Ok(([(header::CONTENT_TYPE, OCTETS)], body).into_response())
}

async fn changes(State(runs): State<Runs>, Path(run): Path<String>) -> Answered<Response> {
    let (bytes, version) = calls::changes(&runs, &run).await?;
    let mut response = ([(header::CONTENT_TYPE, OCTETS)], bytes).into_response();
    response
        .headers_mut()
        .insert("segwild-version", HeaderValue::from_str(&version).map_err(|_| Refusal::broken())?);
    Ok(response)
}

async fn splat_labels(State(runs): State<Runs>, Path(run): Path<String>) -> Answered<Response> {
    let (labels, revision) = answered(&runs, &run, |studio| Ok(studio.splat_labels())).await?;
    let mut response = ([(header::CONTENT_TYPE, OCTETS)], labels).into_response();
    response.headers_mut().insert("segwild-revision", HeaderValue::from(revision));
    Ok(response)
}

async fn sheet(State(runs): State<Runs>, Path(run): Path<String>) -> Answered<Response> {
    let png = answered(&runs, &run, |studio| studio.sheet()).await?;
    Ok(([(header::CONTENT_TYPE, PNG)], png).into_response())
}

async fn photos_of(
    State(runs): State<Runs>,
    Path((run, object)): Path<(String, String)>,
) -> Answered<Response> {
    let object = number(&object)?;
    Ok(Json(calls::photos_of(&runs, &run, object).await?).into_response())
}

async fn transients(
    State(runs): State<Runs>,
    Path((run, photo)): Path<(String, String)>,
) -> Answered<Response> {
    let photo = number(&photo)?;
    Ok(Json(answered(&runs, &run, move |studio| studio.transients(photo)).await?).into_response())
}

async fn save(State(runs): State<Runs>, Path((run, object)): Path<(String, String)>) -> Answered<Response> {
    let object = number(&object)?;
    let name = calls::save(&runs, &run, object).await?;
    Ok(Json(serde_json::json!({ "selection": name })).into_response())
}

async fn prompts(
    State(runs): State<Runs>,
    Path((run, object)): Path<(String, String)>,
) -> Answered<Response> {
    let object = number(&object)?;
    let (name, text) = answered(&runs, &run, move |studio| studio.prompts_file(object)).await?;
    Ok(attached(&name, text))
}

/// A file to be saved.
fn attached(file: &str, bytes: Vec<u8>) -> Response {
    let disposition = format!("attachment; filename=\"{file}\"");
    let headers = [(header::CONTENT_TYPE, OCTETS.into()), (header::CONTENT_DISPOSITION, disposition)];
    (headers, bytes).into_response()
}

async fn labelled_ply(State(runs): State<Runs>, Path(run): Path<String>) -> Answered<Response> {
    Ok(attached("labels.ply", answered(&runs, &run, |studio| studio.labelled_ply()).await?))
}

async fn coco(State(runs): State<Runs>, Path(run): Path<String>) -> Answered<Response> {
    let (name, bytes) = calls::coco(&runs, &run, None).await?;
    Ok(attached(&name, bytes))
}

async fn object_coco(
    State(runs): State<Runs>,
    Path((run, object)): Path<(String, String)>,
) -> Answered<Response> {
    let (name, bytes) = calls::coco(&runs, &run, Some(number(&object)?)).await?;
    Ok(attached(&name, bytes))
}

async fn masks(State(runs): State<Runs>, Path(run): Path<String>) -> Answered<Response> {
    let (name, parts) = calls::masks(&runs, &run, None).await?;
    Ok(attached_parts(&name, parts))
}

async fn object_masks(
    State(runs): State<Runs>,
    Path((run, object)): Path<(String, String)>,
) -> Answered<Response> {
    let (name, parts) = calls::masks(&runs, &run, Some(number(&object)?)).await?;
    Ok(attached_parts(&name, parts))
}

/// An archive to be saved, as it is made. A connection that breaks off says that it is not whole.
fn attached_parts(file: &str, parts: MadeParts) -> Response {
    let disposition = format!("attachment; filename=\"{file}\"");
    let headers = [(header::CONTENT_TYPE, ZIP.into()), (header::CONTENT_DISPOSITION, disposition)];
    let parts = parts.map(|part| part.map_err(|error| std::io::Error::other(error.to_string())));
    (headers, Body::from_stream(parts)).into_response()
}

/// Answers with an object as a file of a format.
fn object_file(method: MethodFilter, format: SplatFormat) -> MethodRouter<Runs> {
    let answer = async move |State(runs): State<Runs>,
                             Path((run, object)): Path<(String, String)>|
                -> Answered<Response> {
        let object = number(&object)?;
        let (name, bytes) = answered(&runs, &run, move |studio| studio.object_file(object, format)).await?;
        Ok(attached(&name, bytes))
    };
    on(method, answer)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_names_its_call() {
        for route in API {
            let path = route.path.replace('{', "a%2F").replace('}', "");
            assert_eq!(call_of(&format!("{ROOT}{path}")), Some(route.call), "{}", route.path);
            assert_eq!(call_of(&format!("{ROOT}{path}/")), None);
            assert_eq!(
                crate::grpc::call_of(&format!("/segwild.v1.Session/{}", route.call)),
                Some(route.call)
            );
        }
        assert_eq!((call_of("/page/main.js"), crate::grpc::call_of("/")), (None, None));
    }
}
