//! The client: vision services as a provider.

use super::member::{Client, Member, described};
use super::pool::{CallError, ServicePool, ServiceTerms};
use super::queue::Priority;
use super::wire::{self, Arriving, MOST_EMBEDDED, MOST_MESSAGE, MessageError, NamedImage};
use crate::network_file::NetworkFile;
use crate::provider::check_certainty;
use crate::sam::{bounds, middle};
use crate::service_address::ServiceAddress;
use crate::service_error::ServiceError;
use crate::service_tls::TrustedCertificates;
use crate::{
    Embedder, MaskProposer, PromptSegmenter, Prompted, SkyDetector, TextEmbedder, TransientDetector,
    VisionError, Work,
};
use futures_util::stream;
use segwild_files::lock;
use segwild_proto::Token;
use segwild_proto::v1::{self, Capability, PixelFormat};
use segwild_scene::{BoxPrompt, Embedding, Image, Mask, PointPrompt, Prompts, ScoredMask};
use std::sync::{Arc, Mutex, mpsc};
use std::time::Instant;
use tonic::{Code, Status, Streaming};

/// Part of the keys of all that a service answers, so that no service makes artefacts under the keys of a local model.
const KEY: &str = "service";
/// An image that was put and is gone again is put so often.
const PUTS: usize = 3;
/// Least IoU of a refined mask with the rough one; below it, the prompts meant something else.
const LIKE: f64 = 0.5;

/// Models on other machines. Its calls block.
pub struct RemoteVision {
    pool: Arc<ServicePool>,
    runtime: Option<tokio::runtime::Runtime>,
    work: Mutex<Work>,
}

impl Drop for RemoteVision {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

impl RemoteVision {
    /// Connects to services that have the same models. Those by TLS must show certificates that `trusted` signed; without it,
    /// those that the system trusts.
    ///
    /// # Errors
    /// When none answers, one refuses the token, or two have different models.
    pub fn connect(
        addresses: Vec<ServiceAddress>,
        token: Option<&Token>,
        trusted: Option<&TrustedCertificates>,
        terms: ServiceTerms,
    ) -> Result<RemoteVision, ServiceError> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("vision client")
            .enable_all()
            .build()
            .map_err(ServiceError::Start)?;
        let members = {
            let _inside = runtime.enter();
            let member = |address| Member::new(address, token, trusted, MOST_MESSAGE).map(Arc::new);
            addresses.into_iter().map(member).collect::<Result<Vec<_>, _>>()?
        };
        let pool = wait(&runtime, ServicePool::connect(members, terms))?;
        Ok(RemoteVision { pool, runtime: Some(runtime), work: Mutex::default() })
    }

    /// Name of their model of masks.
    pub fn name(&self) -> &str {
        &self.pool.described.name
    }

    /// Key of the model of a capability; `None` where they do not have it.
    pub fn key_of(&self, capability: Capability) -> Option<String> {
        self.pool.described.keys.get(&capability).map(|key| format!("{KEY} {key}"))
    }

    /// Whether they answer clicks and propose masks.
    pub fn finds_masks(&self) -> bool {
        [Capability::ProposeMasks, Capability::SegmentPrompts].iter().all(|c| self.key_of(*c).is_some())
    }

    /// Whether they describe photos.
    pub fn embeds(&self) -> bool {
        self.key_of(Capability::Embed).is_some()
    }

    /// Whether they find skies.
    pub fn finds_skies(&self) -> bool {
        self.key_of(Capability::FindSky).is_some()
    }

    /// Whether they find persons and vehicles.
    pub fn finds_transients(&self) -> bool {
        self.key_of(Capability::FindTransients).is_some()
    }

    /// Whether they embed texts and crops.
    pub fn embeds_texts(&self) -> bool {
        self.key_of(Capability::EmbedText).is_some()
    }

    /// Calls that are worth making at the same time: those that all of them take, and a few that wait.
    pub fn calls(&self) -> usize {
        self.pool.calls()
    }

    /// What a run records of them, as of a network file.
    pub(crate) fn as_network_file(&self) -> NetworkFile {
        let keys = self.pool.described.models_of_run().fold(String::new(), |all, (_, key)| all + key + "\n");
        let hash = blake3::hash(keys.as_bytes()).to_hex()[..16].to_owned();
        let addresses: Vec<String> =
            self.pool.members.iter().map(|member| member.address.to_string()).collect();
        NetworkFile { setting: "vision_service".into(), file: addresses.join(",").into(), hash }
    }

    /// Their addresses, and which of them do not answer yet.
    pub fn addresses(&self) -> String {
        let words = |member: &Member| match member.is_unknown() {
            true => format!("{} (does not answer yet)", member.address),
            false => member.address.to_string(),
        };
        self.pool.members.iter().map(|member| words(member)).collect::<Vec<_>>().join(", ")
    }

    /// Calls with images that the service must hold: those that it lacks are put.
    fn call<T, F>(
        &self,
        priority: Priority,
        images: &[&Image],
        operation: impl Fn(Client, Vec<String>) -> F + Send + Sync + 'static,
    ) -> Result<T, VisionError>
    where
        T: Send + 'static,
        F: Future<Output = Result<T, CallError>> + Send,
    {
        self.call_with(None, priority, images, operation)
    }

    /// As [`RemoteVision::call`], where the service must have the model of texts.
    fn call_texts<T, F>(
        &self,
        images: &[&Image],
        operation: impl Fn(Client, Vec<String>) -> F + Send + Sync + 'static,
    ) -> Result<T, VisionError>
    where
        T: Send + 'static,
        F: Future<Output = Result<T, CallError>> + Send,
    {
        self.call_with(self.pool.described.texts().cloned(), Priority::Click, images, operation)
    }

    fn call_with<T, F>(
        &self,
        texts: Option<String>,
        priority: Priority,
        images: &[&Image],
        operation: impl Fn(Client, Vec<String>) -> F + Send + Sync + 'static,
    ) -> Result<T, VisionError>
    where
        T: Send + 'static,
        F: Future<Output = Result<T, CallError>> + Send,
    {
        let format = self.pool.described.format;
        let images: Vec<Arc<NamedImage>> = images
            .iter()
            .map(|image| {
                // A plane of probabilities is no photo: 8 bits would cost its small ones.
                let format = if image.channels == 1 { PixelFormat::F32Planes } else { format };
                Arc::new(NamedImage::of(image, format))
            })
            .collect();
        let pool = self.pool.clone();
        let operation = Arc::new(operation);
        let answer = async move {
            pool.clone()
                .call(priority, texts.clone(), move |client| {
                    let (images, operation, pool) = (images.clone(), operation.clone(), pool.clone());
                    let texts = texts.clone();
                    async move {
                        // A service that was started again may have another one.
                        if texts.is_some() && described(client.clone()).await?.0.texts() != texts.as_ref() {
                            return Err(CallError::OtherTexts);
                        }
                        let hashes =
                            || images.iter().map(|image| image.hash().to_owned()).collect::<Vec<_>>();
                        for _ in 0..PUTS {
                            match operation(client.clone(), hashes()).await {
                                Err(CallError::Status(status)) if status.code() == Code::NotFound => {}
                                answer => return answer,
                            }
                            // A service that was started again holds no image: it may have become another one.
                            if !described(client.clone()).await?.0.serves_as(&pool.described) {
                                return Err(CallError::Changed);
                            }
                            for image in &images {
                                client.clone().put_image(stream::iter(image.clone().parts())).await?;
                            }
                        }
                        let message = "it does not keep an image for as long as a call";
                        Err(Status::failed_precondition(message).into())
                    }
                })
                .await
        };
        let runtime = self.runtime.as_ref().expect("it lives as long as this");
        Ok(wait(runtime, answer)?)
    }

    fn count(&self, add: impl FnOnce(&mut Work)) {
        add(&mut lock(&self.work));
    }

    fn prompt(&self, image: &Image, prompts: &Prompts) -> Result<Prompted, VisionError> {
        let (size, prompts) = ([image.width, image.height], prompts.clone());
        self.call(Priority::Click, &[image], move |mut client, hashes| {
            let request = wire::prompts(hashes[0].clone(), &prompts);
            async move {
                let answer = client.segment_prompts(request).await?.into_inner();
                let scored = answer.answer.ok_or(MessageError("there is no mask"))?;
                Ok(Prompted {
                    answer: wire::scored_of(scored, size)?,
                    open: wire::plane_of(&answer.open, size)?,
                })
            }
        })
    }
}

/// Waits for a future of the runtime, from a thread that is none of its own.
fn wait<T: Send + 'static>(
    runtime: &tokio::runtime::Runtime,
    future: impl Future<Output = T> + Send + 'static,
) -> T {
    let (send, receive) = mpsc::channel();
    runtime.spawn(async move { send.send(future.await) });
    receive.recv().expect("the future ends, and does not panic")
}

/// All parts of an image that a service answers.
async fn arrived(mut parts: Streaming<v1::ImagePart>) -> Result<Arriving, CallError> {
    let mut arriving = Arriving::default();
    while let Some(part) = parts.message().await? {
        arriving.push(part)?;
    }
    Ok(arriving)
}

fn key(vision: &RemoteVision, capability: Capability) -> String {
    vision.key_of(capability).unwrap_or_else(|| KEY.to_owned())
}

impl Embedder for RemoteVision {
    fn key(&self) -> String {
        key(self, Capability::Embed)
    }

    fn embed(&self, image: &Image) -> Result<Embedding, VisionError> {
        self.call(Priority::Bulk, &[image], |mut client, hashes| async move {
            let request = v1::EmbedRequest { image: hashes[0].clone() };
            Ok(arrived(client.embed(request).await?.into_inner()).await?.embedding()?)
        })
    }
}

impl MaskProposer for RemoteVision {
    fn key(&self) -> String {
        key(self, Capability::ProposeMasks)
    }

    fn propose(&self, image: &Image, points: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
        let began = Instant::now();
        let (size, prompts) = ([image.width, image.height], points.len() as u64);
        let points: Vec<v1::Position> = points.iter().map(|p| wire::position(*p)).collect();
        let masks = self.call(Priority::Bulk, &[image], move |mut client, hashes| {
            let request = v1::ProposeMasksRequest { image: hashes[0].clone(), points: points.clone() };
            // A model may nest some masks per point; more than that fills memory.
            let most = 16 * (points.len() + 64);
            async move {
                let (mut masks, mut answer) = (Vec::new(), client.propose_masks(request).await?.into_inner());
                while let Some(mask) = answer.message().await? {
                    if masks.len() == most {
                        return Err(MessageError("there are more than 16 masks per point").into());
                    }
                    masks.push(wire::scored_of(mask, size)?);
                }
                Ok(masks)
            }
        })?;
        self.count(|work| {
            work.prompts += prompts;
            work.decode_s += began.elapsed().as_secs_f64();
        });
        Ok(masks)
    }

    fn work(&self) -> Option<Work> {
        Some(*lock(&self.work))
    }
}

impl PromptSegmenter for RemoteVision {
    fn key(&self) -> String {
        key(self, Capability::SegmentPrompts)
    }

    fn prompted(&self, image: &Image, prompts: &Prompts) -> Result<Prompted, VisionError> {
        self.prompt(image, prompts)
    }

    /// Without a call for it, a box and a click in the middle are what is sent.
    fn refine(&self, image: &Image, certainty: &Image) -> Result<ScoredMask, VisionError> {
        check_certainty(image, certainty)?;
        let (width, height) = (image.width as u32, image.height as u32);
        let rough = Mask::over(width, height, certainty.plane(0), 0.5);
        if self.key_of(Capability::RefineMask).is_none() {
            if rough.is_empty() {
                return Ok(ScoredMask { mask: rough, predicted_iou: 0.0, stability: 0.0 });
            }
            let ([[x0, y0], [x1, y1]], [x, y]) = (bounds(&rough), middle(&rough));
            let prompts = Prompts {
                points: vec![PointPrompt { x, y, inside: true }],
                boxes: vec![BoxPrompt { x0, y0, x1, y1 }],
                granularity: None,
            };
            let answer = self.prompt(image, &prompts)?.answer;
            let like = answer.mask.iou(&rough) >= LIKE;
            return Ok(if like { answer } else { ScoredMask { mask: rough, ..answer } });
        }
        let size = [image.width, image.height];
        let plane = Image { channels: 1, data: certainty.plane(0).to_vec(), ..*certainty };
        self.call(Priority::Click, &[image, &plane], move |mut client, hashes| async move {
            let request = v1::RefineMaskRequest { image: hashes[0].clone(), certainty: hashes[1].clone() };
            Ok(wire::scored_of(client.refine_mask(request).await?.into_inner(), size)?)
        })
    }

    fn finds_objects(&self) -> bool {
        self.key_of(Capability::FindBoundaries).is_none()
    }

    fn boundary_strengths(&self, image: &Image) -> Result<Option<Image>, VisionError> {
        if self.finds_objects() {
            return Ok(None);
        }
        let size = (image.width, image.height, 1);
        self.call(Priority::Bulk, &[image], move |mut client, hashes| async move {
            let request = v1::FindBoundariesRequest { image: hashes[0].clone() };
            let (found, _) = arrived(client.find_boundaries(request).await?.into_inner()).await?.finish()?;
            let strengths = found.data.iter().all(|v| (0.0..=1.0).contains(v));
            if (found.width, found.height, found.channels) != size || !strengths {
                return Err(
                    MessageError("the boundaries are no plane of strengths of the photo's size").into()
                );
            }
            Ok(Some(found))
        })
    }
}

impl TextEmbedder for RemoteVision {
    fn key(&self) -> Result<String, VisionError> {
        Ok(key(self, Capability::EmbedText))
    }

    fn embed_images(&self, images: &[Image]) -> Result<Vec<Vec<f32>>, VisionError> {
        let mut found = Vec::with_capacity(images.len());
        for some in images.chunks(MOST_EMBEDDED) {
            let (count, some) = (some.len(), some.iter().collect::<Vec<_>>());
            found.extend(self.call_texts(&some, move |mut client, hashes| async move {
                let request = v1::EmbedCropsRequest { images: hashes };
                Ok(wire::vectors_of(client.embed_crops(request).await?.into_inner().vectors, count)?)
            })?);
        }
        Ok(found)
    }

    fn embed_texts(&self, texts: &[String]) -> Result<Vec<Vec<f32>>, VisionError> {
        let mut found = Vec::with_capacity(texts.len());
        for some in texts.chunks(MOST_EMBEDDED) {
            let request = v1::EmbedTextRequest { texts: some.to_vec() };
            let count = some.len();
            found.extend(
                self.call_texts(&[], move |mut client, _| {
                    let request = request.clone();
                    async move {
                        Ok(wire::vectors_of(client.embed_text(request).await?.into_inner().vectors, count)?)
                    }
                })?,
            );
        }
        Ok(found)
    }
}

impl SkyDetector for RemoteVision {
    fn key(&self) -> String {
        key(self, Capability::FindSky)
    }

    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        self.sky_above(image, &[])
    }

    fn by_points(&self) -> bool {
        self.pool.described.sky_uses_points
    }

    fn sky_above(&self, image: &Image, seen: &[[f32; 2]]) -> Result<Mask, VisionError> {
        let size = [image.width, image.height];
        let seen = if self.by_points() { seen } else { &[] };
        let points: Vec<v1::Position> = seen.iter().map(|p| wire::position(*p)).collect();
        self.call(Priority::Training, &[image], move |mut client, hashes| {
            let request = v1::FindSkyRequest { image: hashes[0].clone(), points: points.clone() };
            async move { Ok(wire::mask_of(Some(client.find_sky(request).await?.into_inner()), size)?) }
        })
    }
}

impl TransientDetector for RemoteVision {
    fn key(&self) -> String {
        key(self, Capability::FindTransients)
    }

    fn transients(&self, image: &Image) -> Result<Mask, VisionError> {
        let size = [image.width, image.height];
        self.call(Priority::Training, &[image], move |mut client, hashes| async move {
            let request = v1::FindTransientsRequest { image: hashes[0].clone() };
            Ok(wire::mask_of(Some(client.find_transients(request).await?.into_inner()), size)?)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::{VisionServiceOptions, serve_vision};
    use crate::{Providers, VisionSettings};
    use std::time::Duration;

    /// Models that note which of them is called, and answer when the gate is open.
    struct Gated {
        gate: Mutex<mpsc::Receiver<()>>,
        called: Mutex<Vec<&'static str>>,
    }

    impl Gated {
        fn answer<T>(&self, name: &'static str, answer: T) -> Result<T, VisionError> {
            self.called.lock().unwrap().push(name);
            // An error once the sender is dropped.
            let _ = self.gate.lock().unwrap().recv();
            Ok(answer)
        }
    }

    impl MaskProposer for Gated {
        fn key(&self) -> String {
            "gated".into()
        }
        fn propose(&self, _: &Image, _: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
            self.answer("masks", Vec::new())
        }
    }

    impl SkyDetector for Gated {
        fn key(&self) -> String {
            "gated".into()
        }
        fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
            self.answer("sky", Mask::empty(image.width as u32, image.height as u32))
        }
    }

    impl PromptSegmenter for Gated {
        fn key(&self) -> String {
            "gated".into()
        }
        fn prompted(&self, image: &Image, _: &Prompts) -> Result<Prompted, VisionError> {
            let mask = Mask::empty(image.width as u32, image.height as u32);
            self.answer("click", Prompted::sure(ScoredMask { mask, predicted_iou: 1.0, stability: 1.0 }))
        }
        fn refine(&self, _: &Image, _: &Image) -> Result<ScoredMask, VisionError> {
            Err(VisionError::Image("it is not called".into()))
        }
    }

    #[test]
    fn skies_and_clicks_overtake_masks_that_wait() {
        let (open, gate) = mpsc::channel();
        let gated = Arc::new(Gated { gate: Mutex::new(gate), called: Mutex::default() });
        let providers = Providers {
            proposer: gated.clone(),
            sky: gated.clone(),
            segmenter: gated.clone(),
            ..Providers::from_settings(&VisionSettings::default()).unwrap()
        };
        let options = VisionServiceOptions {
            address: "127.0.0.1:0".parse().unwrap(),
            token: None,
            memory: 1 << 20,
            parallel: 1,
            tls: None,
        };
        let server = serve_vision(providers, options).unwrap();
        let addresses = ServiceAddress::list(&format!("grpc://{}", server.address())).unwrap();
        let time = Duration::from_secs(60);
        let terms = ServiceTerms { deadline: time, patience: time, first_patience: time };
        let there = RemoteVision::connect(addresses, None, None, terms).unwrap();
        let image = Image::zeros(16, 16, 3);
        let until = |met: &dyn Fn() -> bool| {
            while !met() {
                std::thread::yield_now();
            }
        };
        let until_waiting = |calls: usize| until(&|| there.pool.queue.len() == calls);
        let until_called = |calls: usize| until(&|| gated.called.lock().unwrap().len() == calls);
        std::thread::scope(|scope| {
            // Two of them get a slot: one is computed, and one is sent ahead. Then the others wait.
            for arrived in 1..=4_usize {
                scope.spawn(|| there.propose(&image, &[[1.0, 1.0]]).unwrap());
                until(&|| there.pool.queue.arrived() == arrived as u64);
                until_waiting(arrived.saturating_sub(2));
                until_called(1);
            }
            for _ in 0..2 {
                scope.spawn(|| there.sky(&image).unwrap());
            }
            until_waiting(4);
            scope.spawn(|| there.prompted(&image, &Prompts::click(1.0, 1.0)).unwrap());
            until_waiting(5);
            drop(open);
        });
        let called = gated.called.lock().unwrap();
        let mut order = ["masks", "masks", "sky", "sky", "click", "masks", "masks"].into_iter();
        let mut sent: Vec<_> = order.next().into_iter().collect();
        // Of the two calls that are sent, the service may compute either first.
        for name in &*called {
            sent.extend(order.next());
            let at = sent.iter().position(|sent| sent == name);
            sent.remove(at.unwrap_or_else(|| panic!("{name} came too early: {called:?}")));
        }
        assert!(sent.is_empty(), "{called:?}");
    }
}
