//! The server: this machine's providers for other machines.

use crate::service::wire::{self, Arriving, MessageError};
use crate::service_tls::ServiceIdentity;
use crate::{Providers, TextEmbedder, VisionError};
use futures_util::StreamExt;
use futures_util::stream::{self, BoxStream};
use segwild_files::lock;
use segwild_proto::Token;
use segwild_proto::v1::{self, Capability, PixelFormat};
use segwild_scene::{Image, Mask};
use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tokio::sync::Semaphore;
use tonic::transport::server::TcpIncoming;
use tonic::{Request, Response, Status, Streaming};

/// Calls that wait, per call that is computed: more are refused, and the client asks another service.
const WAITING: usize = 32;
/// Images that arrive at the same time.
const ARRIVING: usize = 8;
/// Bytes of a call's message at most: an image comes in smaller parts.
const MOST_CALL: usize = 4 << 20;
/// Time between two signs of life on a connection that is idle: one without an answer is closed.
const SIGN_OF_LIFE: Duration = Duration::from_secs(20);
/// Time that calls under way have when a service ends.
const SHUTDOWN: Duration = Duration::from_secs(1);
/// Side of the image by which it is found out if the provider finds boundaries.
const PROBE: usize = 32;

/// How a service is started.
#[derive(Clone, Debug)]
pub struct VisionServiceOptions {
    /// Where it listens; port 0 takes a free one.
    pub address: SocketAddr,
    /// What clients must know; `None` lets all in.
    pub token: Option<Token>,
    /// Bytes of images that are kept for calls.
    pub memory: usize,
    /// Calls that are computed at the same time.
    pub parallel: usize,
    /// Who the service is; `None`: nothing is encrypted.
    pub tls: Option<ServiceIdentity>,
}

/// A running service; dropping it ends it.
pub struct VisionServer {
    runtime: Option<tokio::runtime::Runtime>,
    address: SocketAddr,
    computed: Arc<ComputedCalls>,
}

/// The calls that a service has computed.
#[derive(Default)]
struct ComputedCalls {
    count: AtomicUsize,
    micros: AtomicU64,
}

impl VisionServer {
    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Calls that were computed so far.
    pub fn computed(&self) -> usize {
        self.computed.count.load(Ordering::Relaxed)
    }

    /// Time that these calls took, summed over all that were computed at the same time. What they waited is not counted.
    pub fn busy(&self) -> Duration {
        Duration::from_micros(self.computed.micros.load(Ordering::Relaxed))
    }
}

impl Drop for VisionServer {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            // The port is free again when this returns.
            runtime.shutdown_timeout(SHUTDOWN);
        }
    }
}

/// Serves providers to other machines, on threads of its own.
///
/// # Errors
/// When the address cannot be listened on, threads cannot be started, or the certificate cannot be used.
pub fn serve_vision(providers: Providers, options: VisionServiceOptions) -> std::io::Result<VisionServer> {
    let VisionServiceOptions { address, token, memory, parallel, tls } = options;
    let parallel = parallel.max(1);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .max_blocking_threads(parallel)
        .thread_name("vision service")
        .enable_all()
        .build()?;
    let listener = std::net::TcpListener::bind(address)?;
    listener.set_nonblocking(true)?;
    let address = listener.local_addr()?;
    let computed = Arc::<ComputedCalls>::default();
    let service = Service {
        description: described(&providers, parallel),
        providers: Arc::new(providers),
        images: Mutex::new(KeptImages { most: memory, ..KeptImages::default() }),
        arriving: Semaphore::new(ARRIVING),
        computing: Arc::new(Semaphore::new(parallel)),
        waiting: AtomicUsize::new(0),
        most_waiting: parallel * WAITING,
        computed: computed.clone(),
    };
    let service = v1::vision_server::VisionServer::new(service).max_decoding_message_size(MOST_CALL);
    let guard = move |request: Request<()>| {
        token.as_ref().map_or(Ok(()), |token| token.check(request.metadata()))?;
        Ok(request)
    };
    let service = tonic::service::interceptor::InterceptedService::new(service, guard);
    let incoming = {
        let _inside = runtime.enter();
        TcpIncoming::from(tokio::net::TcpListener::from_std(listener)?).with_nodelay(Some(true))
    };
    let mut server = tonic::transport::Server::builder()
        .http2_keepalive_interval(Some(SIGN_OF_LIFE))
        .http2_keepalive_timeout(Some(SIGN_OF_LIFE));
    if let Some(identity) = tls {
        server = server.tls_config(identity.config()).map_err(std::io::Error::other)?;
    }
    let server = server.add_service(service);
    runtime.spawn(async move {
        if let Err(error) = server.serve_with_incoming(incoming).await {
            tracing::error!("the vision service has ended: {error}");
        }
    });
    Ok(VisionServer { runtime: Some(runtime), address, computed })
}

/// What providers can do.
fn described(providers: &Providers, parallel: usize) -> v1::DescribeResponse {
    let Providers { embedder, proposer, segmenter, sky, transients, texts, name, .. } = providers;
    let model = |capability: Capability, key: String| v1::Model { capability: capability.into(), key };
    let mut models = vec![
        model(Capability::Embed, embedder.key()),
        model(Capability::ProposeMasks, proposer.key()),
        model(Capability::SegmentPrompts, segmenter.key()),
        model(Capability::RefineMask, segmenter.key()),
        model(Capability::FindSky, sky.key()),
    ];
    models.extend(transients.iter().map(|network| model(Capability::FindTransients, network.key())));
    if matches!(segmenter.boundary_strengths(&Image::zeros(PROBE, PROBE, 3)), Ok(Some(_))) {
        models.push(model(Capability::FindBoundaries, segmenter.key()));
    }
    match texts.as_ref().map(|texts| texts.key()) {
        Some(Ok(key)) => models.push(model(Capability::EmbedText, key)),
        Some(Err(error)) => tracing::warn!("no texts are served: {error}"),
        None => {}
    }
    v1::DescribeResponse {
        name: name.clone(),
        models,
        pixel_format: PixelFormat::F32Planes.into(),
        parallel: parallel as u32,
        sky_uses_points: sky.by_points(),
    }
}

/// Images that were put, by their hashes. Those used longest ago leave first.
#[derive(Default)]
struct KeptImages {
    images: HashMap<String, (Arc<Image>, u64)>,
    bytes: usize,
    most: usize,
    uses: u64,
}

fn bytes_of(image: &Image) -> usize {
    image.data.len() * size_of::<f32>()
}

impl KeptImages {
    fn get(&mut self, hash: &str) -> Option<Arc<Image>> {
        self.uses += 1;
        let (image, used) = self.images.get_mut(hash)?;
        *used = self.uses;
        Some(image.clone())
    }

    /// Keeps an image. The newest stays, whatever its size.
    fn put(&mut self, hash: String, image: Image) {
        self.uses += 1;
        self.bytes += bytes_of(&image);
        if let Some((before, _)) = self.images.insert(hash, (Arc::new(image), self.uses)) {
            self.bytes -= bytes_of(&before);
        }
        while self.bytes > self.most && self.images.len() > 1 {
            let oldest = self.images.iter().min_by_key(|(_, (_, used))| *used).map(|(hash, _)| hash.clone());
            if let Some((image, _)) = oldest.and_then(|hash| self.images.remove(&hash)) {
                self.bytes -= bytes_of(&image);
            }
        }
    }
}

struct Service {
    providers: Arc<Providers>,
    description: v1::DescribeResponse,
    images: Mutex<KeptImages>,
    arriving: Semaphore,
    computing: Arc<Semaphore>,
    waiting: AtomicUsize,
    most_waiting: usize,
    computed: Arc<ComputedCalls>,
}

/// Counts a call that waits for as long as it does.
struct Waiting<'a>(&'a AtomicUsize);

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::AcqRel);
    }
}

impl From<MessageError> for Status {
    fn from(error: MessageError) -> Status {
        Status::invalid_argument(error.to_string())
    }
}

fn refused(error: VisionError) -> Status {
    match error {
        VisionError::Image(_) => Status::invalid_argument(error.to_string()),
        _ => Status::internal(error.to_string()),
    }
}

impl Service {
    fn text_model(&self) -> Result<Arc<dyn TextEmbedder>, Status> {
        let none = || Status::unimplemented("no model of texts is served here");
        self.providers.texts.clone().ok_or_else(none)
    }

    fn image(&self, hash: &str) -> Result<Arc<Image>, Status> {
        let kept = lock(&self.images).get(hash);
        kept.ok_or_else(|| Status::not_found("this image is not here: put it first"))
    }

    /// Computes beside the threads that talk to clients, in turn. A client that leaves while it waits costs nothing.
    async fn compute<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Providers) -> Result<T, VisionError> + Send + 'static,
    ) -> Result<T, Status> {
        let before = self.waiting.fetch_add(1, Ordering::AcqRel);
        let waiting = Waiting(&self.waiting);
        if before >= self.most_waiting {
            return Err(Status::resource_exhausted("too many calls wait here"));
        }
        let permit = self.computing.clone().acquire_owned().await;
        drop(waiting);
        let (providers, computed) = (self.providers.clone(), self.computed.clone());
        let answer = tokio::task::spawn_blocking(move || {
            let _permit = permit;
            let began = Instant::now();
            let answer = work(&providers);
            computed.micros.fetch_add(began.elapsed().as_micros() as u64, Ordering::Relaxed);
            computed.count.fetch_add(1, Ordering::Relaxed);
            answer
        });
        answer.await.map_err(|_| Status::internal("the model failed unexpectedly"))?.map_err(refused)
    }

    async fn mask(
        &self,
        image: &str,
        find: impl FnOnce(&Providers, &Image) -> Result<Mask, VisionError> + Send + 'static,
    ) -> Result<Response<v1::Mask>, Status> {
        let image = self.image(image)?;
        let mask = self.compute(move |providers| find(providers, &image)).await?;
        Ok(Response::new(wire::mask(&mask)))
    }
}

type Answer<T> = BoxStream<'static, Result<T, Status>>;

fn streamed<T: Send + 'static>(messages: Vec<T>) -> Response<Answer<T>> {
    Response::new(stream::iter(messages.into_iter().map(Ok)).boxed())
}

#[tonic::async_trait]
impl v1::vision_server::Vision for Service {
    type EmbedStream = Answer<v1::ImagePart>;
    type ProposeMasksStream = Answer<v1::ScoredMask>;
    type FindBoundariesStream = Answer<v1::ImagePart>;

    async fn describe(
        &self,
        _: Request<v1::DescribeRequest>,
    ) -> Result<Response<v1::DescribeResponse>, Status> {
        Ok(Response::new(self.description.clone()))
    }

    async fn put_image(
        &self,
        request: Request<Streaming<v1::ImagePart>>,
    ) -> Result<Response<v1::PutImageResponse>, Status> {
        let _permit = self.arriving.acquire().await;
        let (mut parts, mut arriving) = (request.into_inner(), Arriving::default());
        while let Some(part) = parts.message().await? {
            arriving.push(part)?;
        }
        let (image, hash) = arriving.finish()?;
        lock(&self.images).put(hash, image);
        Ok(Response::new(v1::PutImageResponse {}))
    }

    async fn embed(&self, request: Request<v1::EmbedRequest>) -> Result<Response<Self::EmbedStream>, Status> {
        let image = self.image(&request.get_ref().image)?;
        let found = self.compute(move |providers| providers.embedder.embed(&image)).await?;
        Ok(streamed(wire::answer_parts(&found.data, [found.width, found.height, found.channels])))
    }

    async fn propose_masks(
        &self,
        request: Request<v1::ProposeMasksRequest>,
    ) -> Result<Response<Self::ProposeMasksStream>, Status> {
        let request = request.into_inner();
        let (image, points) = (self.image(&request.image)?, wire::positions(&request.points)?);
        let masks = self.compute(move |providers| providers.proposer.propose(&image, &points)).await?;
        Ok(streamed(masks.iter().map(wire::scored).collect()))
    }

    async fn segment_prompts(
        &self,
        request: Request<v1::SegmentPromptsRequest>,
    ) -> Result<Response<v1::SegmentPromptsResponse>, Status> {
        let request = request.into_inner();
        let (image, prompts) = (self.image(&request.image)?, wire::prompts_of(&request)?);
        let prompted = self.compute(move |providers| providers.segmenter.prompted(&image, &prompts)).await?;
        let answer = Some(wire::scored(&prompted.answer));
        Ok(Response::new(v1::SegmentPromptsResponse { answer, open: wire::plane(&prompted.open) }))
    }

    async fn refine_mask(
        &self,
        request: Request<v1::RefineMaskRequest>,
    ) -> Result<Response<v1::ScoredMask>, Status> {
        let request = request.into_inner();
        let (image, certainty) = (self.image(&request.image)?, self.image(&request.certainty)?);
        let mask = self.compute(move |providers| providers.segmenter.refine(&image, &certainty)).await?;
        Ok(Response::new(wire::scored(&mask)))
    }

    async fn find_sky(&self, request: Request<v1::FindSkyRequest>) -> Result<Response<v1::Mask>, Status> {
        let request = request.into_inner();
        let points = wire::positions(&request.points)?;
        self.mask(&request.image, move |providers, image| providers.sky.sky_above(image, &points)).await
    }

    async fn find_transients(
        &self,
        request: Request<v1::FindTransientsRequest>,
    ) -> Result<Response<v1::Mask>, Status> {
        let Some(network) = self.providers.transients.clone() else {
            return Err(Status::unimplemented("no network for persons and vehicles is served here"));
        };
        self.mask(&request.get_ref().image, move |_, image| network.transients(image)).await
    }

    async fn find_boundaries(
        &self,
        request: Request<v1::FindBoundariesRequest>,
    ) -> Result<Response<Self::FindBoundariesStream>, Status> {
        let image = self.image(&request.get_ref().image)?;
        let found = self.compute(move |providers| providers.segmenter.boundary_strengths(&image)).await?;
        let Some(found) = found else {
            return Err(Status::unimplemented("this model finds whole objects, no boundaries"));
        };
        Ok(streamed(wire::answer_parts(&found.data, [found.width, found.height, found.channels])))
    }

    async fn embed_text(
        &self,
        request: Request<v1::EmbedTextRequest>,
    ) -> Result<Response<v1::EmbedTextResponse>, Status> {
        let model = self.text_model()?;
        let texts = wire::texts(request.into_inner().texts)?;
        let found = self.compute(move |_| model.embed_texts(&texts)).await?;
        Ok(Response::new(v1::EmbedTextResponse { vectors: wire::vectors(found) }))
    }

    async fn embed_crops(
        &self,
        request: Request<v1::EmbedCropsRequest>,
    ) -> Result<Response<v1::EmbedCropsResponse>, Status> {
        let model = self.text_model()?;
        let hashes = request.into_inner().images;
        wire::few_embedded(hashes.len())?;
        let crops: Vec<Arc<Image>> = hashes.iter().map(|hash| self.image(hash)).collect::<Result<_, _>>()?;
        let found = self
            .compute(move |_| {
                let crops: Vec<Image> = crops.iter().map(|crop| Image::clone(crop)).collect();
                model.embed_images(&crops)
            })
            .await?;
        Ok(Response::new(v1::EmbedCropsResponse { vectors: wire::vectors(found) }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_used_longest_ago_leave_first_and_the_newest_stays() {
        let image = || Image::zeros(10, 10, 1);
        let mut kept = KeptImages { most: 1000, ..KeptImages::default() };
        kept.put("a".into(), image());
        kept.put("b".into(), image());
        assert!(kept.get("a").is_some());
        kept.put("a".into(), image());
        kept.put("c".into(), image());
        assert!(kept.get("b").is_none() && kept.get("a").is_some() && kept.get("c").is_some());
        assert_eq!(kept.bytes, 800);
        kept.put("large".into(), Image::zeros(100, 100, 1));
        assert!(kept.get("large").is_some() && kept.images.len() == 1 && kept.bytes == 40_000);
    }
}
