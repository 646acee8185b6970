//! The calls of gRPC: the answers of the requests, the same token, the same bounds.

use crate::common::{run, trained};
use crate::http::get;
use segwild_proto::Token;
use segwild_proto::v1::act_request::{self, Do};
use segwild_proto::v1::session_client::SessionClient;
use segwild_proto::v1::{self, answer_step};
use segwild_studio::{ServeOptions, StudioServer, serve};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request, Response, Status, Streaming};

/// How long anything may take before a test fails.
const LONGEST: Duration = Duration::from_secs(60);

/// Adds a token to each call.
#[derive(Clone)]
struct Credentials(Option<Token>);

impl Interceptor for Credentials {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = &self.0 {
            request.metadata_mut().insert("authorization", token.credentials());
        }
        Ok(request)
    }
}

type Client = SessionClient<InterceptedService<Channel, Credentials>>;

/// A client of a server. It is connected when it calls.
fn client(server: &StudioServer, token: Option<Token>) -> Client {
    let endpoint = Endpoint::from_shared(format!("http://{}", server.socket())).unwrap();
    SessionClient::with_interceptor(endpoint.connect_lazy(), Credentials(token))
}

fn wait<T>(work: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(work)
}

/// A server of one run, and the run's name.
fn served(folder: &std::path::Path) -> (StudioServer, String) {
    let server = serve(folder, ServeOptions::default()).unwrap();
    (server, folder.file_name().unwrap().to_str().unwrap().to_owned())
}

/// Waits until a run is open.
async fn described(client: &mut Client, run: &str) -> v1::RunDescription {
    let began = Instant::now();
    loop {
        match client.describe(v1::RunRequest { run: run.into() }).await {
            Ok(found) => return found.into_inner(),
            Err(status) => {
                assert!(status.code() == Code::Unavailable && began.elapsed() < LONGEST, "{status}")
            }
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

async fn act(client: &mut Client, run: &str, what: Do) -> Result<v1::StateMessage, Status> {
    let request = v1::ActRequest { run: run.into(), r#do: Some(what) };
    client.act(request).await.map(Response::into_inner)
}

/// All parts of a file: the first one, and all bytes.
async fn file(answer: Result<Response<Streaming<v1::FilePart>>, Status>) -> (v1::FilePart, Vec<u8>) {
    let mut parts = answer.unwrap().into_inner();
    let first = parts.message().await.unwrap().expect("a file has a part");
    let mut bytes = first.bytes.clone();
    while let Some(part) = parts.message().await.unwrap() {
        bytes.extend(part.bytes);
    }
    (first, bytes)
}

#[test]
fn a_program_clicks_keeps_and_exports_by_grpc() {
    let (_dir, folder) = run();
    let (server, name) = served(folder.path());
    let (photo, [x, y]) = trained().clicks[0].clone();
    let of_run = v1::RunRequest { run: name.clone() };
    let last = wait(async {
        let mut client = client(&server, Some(server.token().clone()));
        let runs = client.list(v1::ListRequest {}).await.unwrap().into_inner().runs;
        assert_eq!(runs[0].name, name);
        let description = described(&mut client, &name).await;
        assert_eq!((description.palette.len(), description.photos[0].rotation.len()), (12, 9));
        let photo = description.photos.iter().position(|p| p.name == photo).unwrap() as u32;

        let mut states = client.events(of_run.clone()).await.unwrap().into_inner();
        let points = vec![v1::Click { x, y, inside: true }];
        let prompts = vec![v1::ShownPrompts { photo, points, ..Default::default() }];
        let prompt = act_request::Prompt { prompts, alternative: 0 };
        act(&mut client, &name, Do::Prompt(prompt)).await.unwrap();
        let mut steps: Vec<answer_step::Case> = Vec::new();
        let done = loop {
            let state = states.message().await.unwrap().expect("the session stays open");
            let answer = state.answer.clone().unwrap();
            steps.extend(answer.step.and_then(|step| step.case));
            match answer.state.as_str() {
                "done" => break state,
                "failed" => panic!("{:?}", answer.error),
                _ => {}
            }
        };
        assert!(!steps.is_empty() && done.answer.unwrap().splats > 0);
        let requested = &done.draft.unwrap().prompts[0];
        assert!(requested.photo == photo && (requested.points[0].x - x).abs() < 0.01, "{requested:?}");

        let hover = v1::HoverRequest { run: name.clone(), photo, x, y, ..Default::default() };
        let candidate = client.hover(hover).await.unwrap().into_inner().candidate.expect("a candidate");
        assert!(candidate.runs.chunks(2).any(|run| run[0] == 255));
        let keep = Do::Keep(act_request::Keep { name: Some("statue".into()) });
        let kept = act(&mut client, &name, keep).await.unwrap();
        assert!(kept.objects[0].name == "statue" && kept.objects[0].prompted);
        let object = kept.objects[0].id;
        let request =
            v1::ObjectFileRequest { run: name.clone(), object, format: v1::ObjectFormat::Ply.into() };
        let (first, bytes) = file(client.object_file(request).await).await;
        assert_eq!(
            (first.name.as_str(), first.media_type.as_str()),
            ("statue.ply", "application/octet-stream")
        );
        assert!(bytes.starts_with(b"ply\n"));
        let of_object = v1::ObjectRequest { run: name.clone(), object };
        let pixels = client.object_photos(of_object.clone()).await.unwrap().into_inner().pixels;
        assert!(pixels.len() == description.photos.len() && pixels[photo as usize] > 0);

        // Its masks: two of each photo, and how they were made.
        let (first, zip) = file(client.object_masks(of_object).await).await;
        assert_eq!((first.name.as_str(), first.media_type.as_str()), ("statue.masks.zip", "application/zip"));
        let count = |wanted: &[u8]| zip.windows(wanted.len()).filter(|bytes| *bytes == wanted).count();
        assert_eq!(count(b"PK\x01\x02"), 2 * description.photos.len() + 1);
        assert!(count(b"amodal/") == 2 * description.photos.len() && count(b"\"replay\"") == 1);
        assert_eq!(zip[zip.len() - 22..][..4], *b"PK\x05\x06");

        // A view of the scene, and back to a photo.
        let seen = description.photos[photo as usize].clone();
        let view = v1::FrameRequest {
            run: name.clone(),
            camera: seen.camera,
            rotation: seen.rotation.clone(),
            translation: seen.translation.clone(),
            marks: true,
            ..Default::default()
        };
        let (first, jpeg) = file(client.frame(view).await).await;
        assert!(first.media_type == "image/jpeg" && jpeg.starts_with(&[0xff, 0xd8]));
        let pick = v1::PickRequest {
            run: name.clone(),
            camera: seen.camera,
            rotation: seen.rotation,
            translation: seen.translation,
            at: vec![x, y],
        };
        assert_eq!(client.pick(pick).await.unwrap().into_inner().pixel.expect("a splat").point.len(), 3);
        let (first, labels) = file(client.splat_labels(of_run.clone()).await).await;
        assert_eq!(labels.len() as u64, description.splats);
        assert_eq!(
            first.version,
            client.state(of_run.clone()).await.unwrap().into_inner().revision.to_string()
        );

        let (first, _) = file(client.changes(of_run.clone()).await).await;
        let state = act(&mut client, &name, Do::Undo(act_request::Step {})).await.unwrap();
        assert_eq!(first.version, kept.changes);
        assert!(state.objects.is_empty() && state.redo.as_deref() == Some("keep object"));
        let back = act(&mut client, &name, Do::Redo(act_request::Step {})).await.unwrap();
        let Some(v1::monitor_view::Kind::Run(view)) =
            client.status(v1::StatusRequest { run: None }).await.unwrap().into_inner().kind
        else {
            panic!("it is a run")
        };
        assert!(!view.stages.is_empty() && view.name == name);
        back
    });
    // The same state as JSON.
    let json = get(&server, &format!("/api/v1/runs/{name}/state"));
    let json: serde_json::Value = serde_json::from_str(json.split_once("\r\n\r\n").unwrap().1).unwrap();
    assert_eq!(json["revision"], last.revision);
    assert_eq!(json["objects"][0]["name"], last.objects[0].name.as_str());
    assert_eq!(json["objects"][0]["splats"], last.objects[0].splats);
    assert_eq!(json["undo"], last.undo.unwrap().as_str());
}

#[test]
fn calls_need_the_token_and_are_refused_for_the_reasons_of_requests() {
    let (_dir, folder) = run();
    let (server, name) = served(folder.path());
    wait(async {
        for token in [None, Some(Token::random().unwrap())] {
            let refused = client(&server, token).list(v1::ListRequest {}).await.unwrap_err();
            assert_eq!(refused.code(), Code::Unauthenticated, "{refused}");
            assert!(refused.message().contains("has the token"), "{refused}");
        }
        let mut client = client(&server, Some(server.token().clone()));
        described(&mut client, &name).await;
        let nobody = client.state(v1::RunRequest { run: "../nobody".into() }).await.unwrap_err();
        assert_eq!(nobody.code(), Code::NotFound, "{nobody}");
        let undo = act(&mut client, &name, Do::Undo(act_request::Step {})).await.unwrap_err();
        assert_eq!(undo.code(), Code::FailedPrecondition, "{undo}");
        let nothing = client.act(v1::ActRequest { run: name.clone(), r#do: None }).await.unwrap_err();
        assert_eq!(nothing.code(), Code::InvalidArgument, "{nothing}");
        let prompts =
            vec![v1::ShownPrompts { photo: 999, points: vec![v1::Click::default()], ..Default::default() }];
        let outside = Do::Prompt(act_request::Prompt { prompts, alternative: 0 });
        let outside = act(&mut client, &name, outside).await.unwrap_err();
        assert_eq!(outside.code(), Code::InvalidArgument, "{outside}");
        let combine = Do::Combine(act_request::Combine { id: 1, with: 2, how: 0 });
        let combine = act(&mut client, &name, combine).await.unwrap_err();
        assert_eq!(combine.code(), Code::InvalidArgument, "{combine}");
        let view = v1::FrameRequest { run: name.clone(), rotation: vec![0.0; 8], ..Default::default() };
        assert_eq!(client.frame(view).await.unwrap_err().code(), Code::InvalidArgument);
        let long = Do::Keep(act_request::Keep { name: Some("x".repeat(2 << 20)) });
        let long = act(&mut client, &name, long).await.unwrap_err();
        assert!([Code::OutOfRange, Code::ResourceExhausted].contains(&long.code()), "{long}");
        let retry = client.retry(v1::RetryRequest { scene: name.clone() }).await.unwrap_err();
        assert_eq!(retry.code(), Code::NotFound, "{retry}");
        assert!(client.farm(v1::FarmRequest {}).await.unwrap().into_inner().farm.is_none());
        let retry = client.retry_on_farm(v1::RetryRequest { scene: name.clone() }).await.unwrap_err();
        assert_eq!(retry.code(), Code::NotFound, "{retry}");
    });
}

#[test]
fn a_connection_that_starts_a_protocol_and_falls_silent_is_closed() {
    let (_dir, folder) = run();
    let (server, _) = served(folder.path());
    let began = Instant::now();
    let mut silent: Vec<TcpStream> = ["PRI * HT", "P", ""]
        .iter()
        .map(|start| {
            let mut stream = TcpStream::connect(server.socket()).unwrap();
            stream.set_read_timeout(Some(LONGEST)).unwrap();
            stream.write_all(start.as_bytes()).unwrap();
            stream
        })
        .collect();
    for stream in &mut silent {
        // Whatever it answers, it ends.
        let _ = stream.read_to_end(&mut Vec::new());
    }
    assert!(began.elapsed() < LONGEST / 2, "{:?}", began.elapsed());
}
