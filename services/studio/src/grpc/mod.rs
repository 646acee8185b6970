//! The calls of `session.proto`: the same work as the requests of `routes.rs`, as gRPC.

mod replies;
mod requests;
mod status;

use crate::StudioError;
use crate::calls::{
    self, JPEG, MadeParts, OCTETS, PNG, Refusal, RefusalKind, Runs, SHOWN_SIZE, ZIP, answered,
};
use crate::rates::{AdmittedClient, RequestCost};
use futures_util::StreamExt;
use futures_util::stream::{self, BoxStream};
use requests::NoSuchRequest;
use segwild_proto::v1;
use segwild_proto::v1::session_server::{SERVICE_NAME, Session, SessionServer};
use tonic::{Request, Response, Status};

/// Bytes of a part of a file at most.
const MOST_PART: usize = 1 << 20;

/// The calls of a server's runs.
pub(crate) struct SessionService {
    runs: Runs,
}

/// The service, with requests of so many bytes at most, and the paths below which its calls are.
pub(crate) fn session(runs: Runs, most_request: usize) -> (String, SessionServer<SessionService>) {
    let service = SessionServer::new(SessionService { runs }).max_decoding_message_size(most_request);
    (format!("/{SERVICE_NAME}/{{*call}}"), service)
}

/// The call that a path names; `None` where it is none of this service's.
pub(crate) fn call_of(path: &str) -> Option<&str> {
    path.strip_prefix('/')?.strip_prefix(SERVICE_NAME)?.strip_prefix('/')
}

impl From<Refusal> for Status {
    fn from(refusal: Refusal) -> Status {
        match refusal {
            Refusal::Because(kind, why) => match kind {
                RefusalKind::Request => Status::invalid_argument(why),
                RefusalKind::Missing => Status::not_found(why),
                RefusalKind::Conflict => Status::failed_precondition(why),
                RefusalKind::Unavailable => Status::unavailable(why),
                RefusalKind::Broken => Status::internal(why),
            },
            Refusal::Waiting(entry) => {
                let reason = entry.reason.map_or(String::new(), |reason| format!(": {reason}"));
                Status::unavailable(format!("`{}` is {}{reason}", entry.name, entry.state))
            }
        }
    }
}

impl From<NoSuchRequest> for Status {
    fn from(error: NoSuchRequest) -> Status {
        Status::invalid_argument(error.to_string())
    }
}

type Reply<T> = Result<Response<T>, Status>;

type Replies<T> = BoxStream<'static, Result<T, Status>>;

fn reply<T>(message: T) -> Reply<T> {
    Ok(Response::new(message))
}

/// A file in parts. All but its bytes is in the first.
fn parts(bytes: Vec<u8>, media_type: &str, name: &str, version: String) -> Reply<Replies<v1::FilePart>> {
    let count = bytes.len().div_ceil(MOST_PART).max(1);
    let (name, media_type) = (name.to_owned(), media_type.to_owned());
    let mut head = Some(v1::FilePart { name, media_type, version, bytes: Vec::new() });
    let part = move |k: usize| -> Result<v1::FilePart, Status> {
        let bytes = bytes[k * MOST_PART..bytes.len().min((k + 1) * MOST_PART)].to_vec();
        Ok(v1::FilePart { bytes, ..head.take().unwrap_or_default() })
    };
    reply(stream::iter((0..count).map(part)).boxed())
}

/// A file that is made while it is sent.
fn made_parts(made: MadeParts, media_type: &str, name: String) -> Reply<Replies<v1::FilePart>> {
    let mut head = Some(v1::FilePart { name, media_type: media_type.into(), ..Default::default() });
    let split = |part: Result<Vec<u8>, StudioError>| {
        let pieces: Vec<Result<Vec<u8>, Status>> = match part {
            Ok(bytes) => bytes.chunks(MOST_PART).map(|piece| Ok(piece.to_vec())).collect(),
            Err(error) => vec![Err(Refusal::from(error).into())],
        };
        stream::iter(pieces)
    };
    let part = move |piece: Result<Vec<u8>, Status>| -> Result<v1::FilePart, Status> {
        Ok(v1::FilePart { bytes: piece?, ..head.take().unwrap_or_default() })
    };
    reply(made.flat_map(split).map(part).boxed())
}

/// A file without a name or a version.
fn unnamed(bytes: Vec<u8>, media_type: &str) -> Reply<Replies<v1::FilePart>> {
    parts(bytes, media_type, "", String::new())
}

fn size(size: Option<u32>) -> u32 {
    size.unwrap_or(SHOWN_SIZE)
}

#[tonic::async_trait]
impl Session for SessionService {
    type EventsStream = Replies<v1::StateMessage>;
    type TrainingPhotoStream = Replies<v1::FilePart>;
    type FrameStream = Replies<v1::FilePart>;
    type SplatsStream = Replies<v1::FilePart>;
    type ChangesStream = Replies<v1::FilePart>;
    type SplatLabelsStream = Replies<v1::FilePart>;
    type SheetStream = Replies<v1::FilePart>;
    type PhotoStream = Replies<v1::FilePart>;
    type ObjectFileStream = Replies<v1::FilePart>;
    type ObjectPromptsStream = Replies<v1::FilePart>;
    type LabelledPlyStream = Replies<v1::FilePart>;
    type CocoStream = Replies<v1::FilePart>;
    type ObjectCocoStream = Replies<v1::FilePart>;
    type MasksStream = Replies<v1::FilePart>;
    type ObjectMasksStream = Replies<v1::FilePart>;

    async fn list(&self, _: Request<v1::ListRequest>) -> Reply<v1::ListResponse> {
        let runs = self.runs.list().into_iter().map(replies::entry).collect();
        reply(v1::ListResponse { runs })
    }

    async fn status(&self, request: Request<v1::StatusRequest>) -> Reply<v1::MonitorView> {
        reply(status::view(calls::status(self.runs.clone(), request.into_inner().run).await?))
    }

    async fn retry(&self, request: Request<v1::RetryRequest>) -> Reply<v1::RetryResponse> {
        calls::retry(self.runs.clone(), request.into_inner().scene).await?;
        reply(v1::RetryResponse { retried: true })
    }

    async fn farm(&self, _: Request<v1::FarmRequest>) -> Reply<v1::FarmResponse> {
        let farm = calls::farm(&self.runs).await?;
        reply(v1::FarmResponse { farm: farm.map(|farm| status::batch(farm.view.clone())) })
    }

    async fn retry_on_farm(&self, request: Request<v1::RetryRequest>) -> Reply<v1::RetryResponse> {
        calls::retry_on_farm(self.runs.clone(), request.into_inner().scene).await?;
        reply(v1::RetryResponse { retried: true })
    }

    async fn describe(&self, request: Request<v1::RunRequest>) -> Reply<v1::RunDescription> {
        let found = answered(&self.runs, &request.get_ref().run, |studio| Ok(studio.describe())).await?;
        reply(replies::description(found))
    }

    async fn state(&self, request: Request<v1::RunRequest>) -> Reply<v1::StateMessage> {
        let found = answered(&self.runs, &request.get_ref().run, |studio| Ok(studio.message())).await?;
        reply(replies::state(found))
    }

    async fn events(&self, request: Request<v1::RunRequest>) -> Reply<Self::EventsStream> {
        let states = calls::states(&self.runs, &request.get_ref().run)?;
        reply(states.map(|state| Ok(replies::state(state))).boxed())
    }

    async fn act(&self, request: Request<v1::ActRequest>) -> Reply<v1::StateMessage> {
        let v1::ActRequest { run, r#do } = request.into_inner();
        let action = requests::action(r#do)?;
        reply(replies::state(calls::act(&self.runs, &run, action).await?))
    }

    async fn train(&self, request: Request<v1::RunRequest>) -> Reply<v1::TrainResponse> {
        calls::train(self.runs.clone(), request.into_inner().run).await?;
        reply(v1::TrainResponse { training: true })
    }

    async fn training(&self, request: Request<v1::RunRequest>) -> Reply<v1::TrainingMessage> {
        let found = calls::training(self.runs.clone(), request.into_inner().run).await?;
        reply(replies::training(found))
    }

    async fn training_photo(&self, request: Request<v1::PhotoRequest>) -> Reply<Self::TrainingPhotoStream> {
        let v1::PhotoRequest { run, photo, size: side } = request.into_inner();
        let jpeg = calls::training_photo(self.runs.clone(), run, photo as usize, size(side)).await?;
        unnamed(jpeg, JPEG)
    }

    async fn hover(&self, request: Request<v1::HoverRequest>) -> Reply<v1::HoverResponse> {
        let at = requests::hover(request.get_ref())?;
        if let (Some(_), Some(client)) = (&at.view, request.extensions().get::<AdmittedClient>()) {
            client.charge(RequestCost::OF_VIEW);
        }
        let found = answered(&self.runs, &request.get_ref().run, move |studio| studio.hover(&at)).await?;
        reply(v1::HoverResponse { candidate: found.map(replies::labels) })
    }

    async fn pick(&self, request: Request<v1::PickRequest>) -> Reply<v1::PickResponse> {
        let at = requests::pick(request.get_ref())?;
        let found = answered(&self.runs, &request.get_ref().run, move |studio| studio.pick(&at)).await?;
        reply(v1::PickResponse { pixel: found.map(replies::pixel) })
    }

    async fn frame(&self, request: Request<v1::FrameRequest>) -> Reply<Self::FrameStream> {
        let view = requests::frame(request.get_ref())?;
        let jpeg = answered(&self.runs, &request.get_ref().run, move |studio| studio.frame(&view)).await?;
        unnamed(jpeg, JPEG)
    }

    async fn splats(&self, request: Request<v1::SplatsRequest>) -> Reply<Self::SplatsStream> {
        let v1::SplatsRequest { run, appearance } = request.into_inner();
        let photo = appearance.map(|photo| photo as usize);
        let mut head = Some(v1::FilePart { media_type: OCTETS.into(), ..Default::default() });
        let part = move |bytes| Ok(v1::FilePart { bytes, ..head.take().unwrap_or_default() });
        reply(calls::splats(&self.runs, &run, photo).await?.map(part).boxed())
    }

    async fn changes(&self, request: Request<v1::RunRequest>) -> Reply<Self::ChangesStream> {
        let (packed, version) = calls::changes(&self.runs, &request.get_ref().run).await?;
        parts(packed, OCTETS, "", version)
    }

    async fn splat_labels(&self, request: Request<v1::RunRequest>) -> Reply<Self::SplatLabelsStream> {
        let run = &request.get_ref().run;
        let (labels, revision) = answered(&self.runs, run, |studio| Ok(studio.splat_labels())).await?;
        parts(labels, OCTETS, "", revision.to_string())
    }

    async fn sheet(&self, request: Request<v1::RunRequest>) -> Reply<Self::SheetStream> {
        let png = answered(&self.runs, &request.get_ref().run, |studio| studio.sheet()).await?;
        unnamed(png, PNG)
    }

    async fn photo(&self, request: Request<v1::PhotoRequest>) -> Reply<Self::PhotoStream> {
        let v1::PhotoRequest { run, photo, size: side } = request.into_inner();
        let jpeg = answered(&self.runs, &run, move |studio| studio.photo(photo as usize, size(side))).await?;
        unnamed(jpeg, JPEG)
    }

    async fn photo_labels(&self, request: Request<v1::PhotoRequest>) -> Reply<v1::LabelMap> {
        let v1::PhotoRequest { run, photo, size: _ } = request.into_inner();
        let found = answered(&self.runs, &run, move |studio| studio.labels(photo as usize)).await?;
        reply(replies::labels(found))
    }

    async fn photo_transients(&self, request: Request<v1::PhotoRequest>) -> Reply<v1::LabelMap> {
        let v1::PhotoRequest { run, photo, size: _ } = request.into_inner();
        let found = answered(&self.runs, &run, move |studio| studio.transients(photo as usize)).await?;
        reply(replies::labels(found))
    }

    async fn object_photos(&self, request: Request<v1::ObjectRequest>) -> Reply<v1::ObjectPhotosResponse> {
        let v1::ObjectRequest { run, object } = request.into_inner();
        let found = calls::photos_of(&self.runs, &run, object).await?;
        reply(v1::ObjectPhotosResponse { pixels: found.into_iter().map(|pixels| pixels as u64).collect() })
    }

    async fn object_file(&self, request: Request<v1::ObjectFileRequest>) -> Reply<Self::ObjectFileStream> {
        let request = request.into_inner();
        let (object, format) = (request.object, requests::format(request.format())?);
        let made = answered(&self.runs, &request.run, move |studio| studio.object_file(object, format));
        let (name, bytes) = made.await?;
        parts(bytes, OCTETS, &name, String::new())
    }

    async fn object_prompts(&self, request: Request<v1::ObjectRequest>) -> Reply<Self::ObjectPromptsStream> {
        let v1::ObjectRequest { run, object } = request.into_inner();
        let made = answered(&self.runs, &run, move |studio| studio.prompts_file(object));
        let (name, text) = made.await?;
        parts(text, OCTETS, &name, String::new())
    }

    async fn save(&self, request: Request<v1::ObjectRequest>) -> Reply<v1::SaveResponse> {
        let v1::ObjectRequest { run, object } = request.into_inner();
        let selection = calls::save(&self.runs, &run, object).await?;
        reply(v1::SaveResponse { selection })
    }

    async fn labelled_ply(&self, request: Request<v1::RunRequest>) -> Reply<Self::LabelledPlyStream> {
        let run = &request.get_ref().run;
        let bytes = answered(&self.runs, run, |studio| studio.labelled_ply()).await?;
        parts(bytes, OCTETS, "labels.ply", String::new())
    }

    async fn coco(&self, request: Request<v1::RunRequest>) -> Reply<Self::CocoStream> {
        let (name, bytes) = calls::coco(&self.runs, &request.get_ref().run, None).await?;
        parts(bytes, OCTETS, &name, String::new())
    }

    async fn object_coco(&self, request: Request<v1::ObjectRequest>) -> Reply<Self::ObjectCocoStream> {
        let v1::ObjectRequest { run, object } = request.into_inner();
        let (name, bytes) = calls::coco(&self.runs, &run, Some(object)).await?;
        parts(bytes, OCTETS, &name, String::new())
    }

    async fn masks(&self, request: Request<v1::RunRequest>) -> Reply<Self::MasksStream> {
        let (name, made) = calls::masks(&self.runs, &request.get_ref().run, None).await?;
        made_parts(made, ZIP, name)
    }

    async fn object_masks(&self, request: Request<v1::ObjectRequest>) -> Reply<Self::ObjectMasksStream> {
        let v1::ObjectRequest { run, object } = request.into_inner();
        let (name, made) = calls::masks(&self.runs, &run, Some(object)).await?;
        made_parts(made, ZIP, name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn collected(bytes: &[u8]) -> Vec<v1::FilePart> {
        let parts = parts(bytes.to_vec(), OCTETS, "a.ply", "7".into()).unwrap().into_inner();
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        runtime.block_on(parts.map(Result::unwrap).collect())
    }

    #[test]
    fn a_file_goes_in_parts_of_which_the_first_describes_it() {
        let bytes: Vec<u8> = (0..2 * MOST_PART + 9).map(|i| i as u8).collect();
        let all = collected(&bytes);
        let sizes: Vec<usize> = all.iter().map(|part| part.bytes.len()).collect();
        assert_eq!(sizes, [MOST_PART, MOST_PART, 9]);
        assert!(all.iter().flat_map(|part| &part.bytes).eq(&bytes));
        let named = |part: &v1::FilePart| (part.name.clone(), part.media_type.clone(), part.version.clone());
        assert_eq!(named(&all[0]), ("a.ply".into(), OCTETS.into(), "7".into()));
        assert!(all[1..].iter().all(|part| named(part) == Default::default()));
        // A file without bytes is a part as well.
        assert_eq!(collected(&[]).len(), 1);
    }

    #[test]
    fn refusals_of_requests_are_refusals_of_calls() {
        let of = |kind| Status::from(Refusal::Because(kind, "why".into())).code();
        assert_eq!(of(RefusalKind::Request), tonic::Code::InvalidArgument);
        assert_eq!(of(RefusalKind::Conflict), tonic::Code::FailedPrecondition);
        let entry = crate::messages::RunEntry { name: "a".into(), state: "opening", reason: None };
        let status = Status::from(Refusal::Waiting(entry));
        assert_eq!((status.code(), status.message()), (tonic::Code::Unavailable, "`a` is opening"));
    }
}
