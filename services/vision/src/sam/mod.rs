//! Networks of the SAM family behind the provider traits: SAM, MobileSAM, EfficientSAM, SAM 2 and SAM 3's tracker as ONNX
//! exports, an image encoder and a prompted decoder each.
//!
//! [`crate::sam_interface`] recognises the files, [`frame`] is the pre-processing, [`encoder`] and [`decoder`] run the networks, [`logits`] is
//! the post-processing, [`prompt`] turns clicks and boxes into queries. A photo is encoded once and its embedding kept in memory,
//! so that every further prompt costs a run of the decoder alone.

mod choice;
mod decoder;
mod encoder;
mod frame;
mod logits;
mod prompt;
mod refine;
mod refused;

use crate::builtin::{Memory, PREPARED, Weighed, check, content};
use crate::network_file::NetworkFile;
use crate::onnx::{NetworkDevice, NetworkModel, Options, Runtime};
use crate::survey::ModelPair;
use crate::{Embedder, MaskProposer, PromptSegmenter, Prompted, VisionError, VisionSettings, Work};
pub(crate) use choice::find_pair;
use decoder::{PromptDecoder, Query};
use encoder::{Encoded, Encoder};
use frame::PhotoFit;
use logits::{Logits, Upscale, choose, stability};
use prompt::{INSIDE, Labelled, PromptGroup};
pub(crate) use refine::{bounds, middle};
use segwild_files::lock;
use segwild_scene::{Embedding, Image, Mask, Prompts, ScoredMask, sigmoid};
use std::ops::Range;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Changes whenever the same files would give other bytes for the same photo.
const VERSION: &str = "sam-1";
/// Prompts per run of a decoder, where its file allows several: their logits are in memory together.
const BATCH: usize = 16;
/// Bytes for answers from which the next click may continue.
const ANSWERS: usize = 32 << 20;

/// A pair of networks.
pub struct Sam {
    encoder: Encoder,
    decoder: PromptDecoder,
    /// Paths of the two files.
    pair: ModelPair,
    device: NetworkDevice,
    stability_offset: f32,
    /// Held while a photo is encoded, so that two who ask for the same one share the work.
    encoding: Mutex<()>,
    embeddings: Memory<Encoded>,
    answers: Memory<SamAnswer>,
    work: Mutex<Work>,
}

/// An answer: one mask, and the IoU that was predicted for it.
#[derive(Clone)]
struct SamAnswer {
    logits: Logits,
    score: f32,
}

impl Weighed for SamAnswer {
    fn bytes(&self) -> usize {
        self.logits.bytes()
    }
}

impl Sam {
    /// Loads a pair on a device. The error names the file and says what does not fit.
    pub(crate) fn load(
        runtime: &Runtime,
        pair: &ModelPair,
        settings: &VisionSettings,
        device: NetworkDevice,
    ) -> Result<Sam, VisionError> {
        let options = Options {
            threads: settings.network_threads,
            device,
            limit: Duration::from_secs(settings.network_limit.max(1).into()),
            memory_mib: settings.network_memory,
        };
        let encoder = Encoder::new(NetworkModel::load(runtime, &pair.encoder, options)?)?;
        let decoder = NetworkModel::load(runtime, &pair.decoder, options)?;
        let decoder = PromptDecoder::new(decoder, &encoder, BATCH)?;
        Ok(Sam {
            encoder,
            decoder,
            pair: pair.clone(),
            device,
            stability_offset: settings.stability_offset,
            encoding: Mutex::new(()),
            // The other half is the built-in provider's.
            embeddings: Memory::new(settings.vision_memory as usize * (1 << 20) / 2),
            answers: Memory::new(ANSWERS),
            work: Mutex::default(),
        })
    }

    /// Its two files.
    pub(crate) fn files(&self) -> [NetworkFile; 2] {
        let ModelPair { encoder, decoder, .. } = &self.pair;
        [
            NetworkFile::of_models(encoder, self.encoder.key()),
            NetworkFile::of_models(decoder, self.decoder.key()),
        ]
    }

    /// The stem of its files' names, such as `mobile_sam`.
    pub(crate) fn stem(&self) -> &str {
        &self.pair.stem
    }

    /// Names a part. CUDA's numbers differ from a CPU's in the last places.
    fn name(&self, part: &str, decodes: bool) -> String {
        let mut name = format!("{VERSION}-{part}-{}", self.encoder.key());
        if decodes {
            name += &format!("-{}-{}", self.decoder.key(), self.stability_offset);
        }
        if self.device == NetworkDevice::Cuda {
            name += "+cuda";
        }
        name
    }

    /// A photo's embedding, from memory or computed now; and the photo's hash.
    fn encoded(&self, image: &Image) -> Result<(Arc<Encoded>, blake3::Hash), VisionError> {
        check(image)?;
        let key = content(image);
        let slot = self.embeddings.slot(key);
        let _alone = lock(&self.encoding);
        if let Some(known) = slot.get() {
            return Ok((known.clone(), key));
        }
        let began = Instant::now();
        let encoded = Arc::new(self.encoder.encode(image)?);
        self.count(|work| {
            work.encoded += 1;
            work.encode_s += began.elapsed().as_secs_f64();
        });
        let encoded = slot.get_or_init(|| encoded).clone();
        self.embeddings.trim();
        Ok((encoded, key))
    }

    fn count(&self, add: impl FnOnce(&mut Work)) {
        add(&mut lock(&self.work));
    }

    /// How the decoder's logits lie over a photo.
    fn upscale(&self, encoded: &Encoded, logits: &Logits) -> Upscale {
        let fit = if self.decoder.full_size() { PhotoFit::filling(encoded.fit.photo) } else { encoded.fit };
        Upscale::new(logits.width, logits.height, &fit)
    }

    /// The answer to all of a group, step by step: each click starts from the answer to those before it. Earlier answers
    /// are kept.
    fn answer(
        &self,
        (encoded, photo): (&Encoded, blake3::Hash),
        group: &PromptGroup,
        granularity: Option<f32>,
    ) -> Result<SamAnswer, VisionError> {
        let mut steps = group.steps();
        if self.decoder.takes_logits().is_none() {
            steps.drain(..steps.len().saturating_sub(1));
        }
        let mut answer: Option<Arc<SamAnswer>> = None;
        for points in steps {
            let slot = self.answers.slot(answer_key(photo, &points, granularity));
            if let Some(known) = slot.get() {
                answer = Some(known.clone());
                continue;
            }
            let precise = points.len() > 1;
            let query = Query { points, previous: answer.as_deref().map(|c| &c.logits) };
            let began = Instant::now();
            let mut masks = self.decoder.ask(encoded, &[query])?.pop().unwrap_or_default();
            self.count(|work| {
                work.prompts += 1;
                work.decode_s += began.elapsed().as_secs_f64();
            });
            let range = candidates(masks.len(), precise && granularity.is_none());
            let masks: Vec<(Logits, f32)> = masks.drain(range).collect();
            let Some(best) = choose(&masks, granularity) else { continue };
            let (logits, score) = masks[best].clone();
            answer = Some(slot.get_or_init(|| Arc::new(SamAnswer { logits, score })).clone());
            self.answers.trim();
        }
        match answer {
            Some(answer) => Ok((*answer).clone()),
            None => Err(VisionError::Model("the decoder gave no mask".into())),
        }
    }
}

/// The range of a decoder's masks that are candidates. Of four, the first is for precise prompts (several points), and the
/// others are the part, the larger part and the whole that one click may mean; three are those alone.
fn candidates(masks: usize, precise: bool) -> Range<usize> {
    match (masks, precise) {
        (4, true) => 0..1,
        (4, false) => 1..4,
        _ => 0..masks,
    }
}

/// The key of an answer: photo, points with labels, granularity.
fn answer_key(photo: blake3::Hash, points: &[Labelled], granularity: Option<f32>) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new();
    hasher.update(photo.as_bytes());
    hasher.update(&granularity.unwrap_or(f32::NAN).to_le_bytes());
    for ([x, y], label) in points {
        for v in [x, y, label] {
            hasher.update(&v.to_le_bytes());
        }
    }
    hasher.finalize()
}

impl Embedder for Sam {
    fn key(&self) -> String {
        self.name("embed", false)
    }

    fn accelerator(&self) -> bool {
        self.device == NetworkDevice::Cuda
    }

    fn embed(&self, image: &Image) -> Result<Embedding, VisionError> {
        Ok(self.encoded(image)?.0.cropped())
    }
}

impl MaskProposer for Sam {
    fn key(&self) -> String {
        self.name("propose", true)
    }

    fn accelerator(&self) -> bool {
        self.device == NetworkDevice::Cuda
    }

    fn propose(&self, image: &Image, points: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
        let (encoded, _) = self.encoded(image)?;
        let began = Instant::now();
        let (mut found, mut upscale) = (Vec::new(), None);
        for some in points.chunks(BATCH) {
            let queries: Vec<Query> =
                some.iter().map(|&at| Query { points: vec![(at, INSIDE)], previous: None }).collect();
            for mut masks in self.decoder.ask(&encoded, &queries)? {
                let range = candidates(masks.len(), false);
                for (logits, score) in masks.drain(range) {
                    let upscale = upscale.get_or_insert_with(|| self.upscale(&encoded, &logits));
                    found.push(upscale.mask(&logits, score.clamp(0.0, 1.0), self.stability_offset));
                }
            }
        }
        self.count(|work| {
            work.prompts += points.len() as u64;
            work.decode_s += began.elapsed().as_secs_f64();
        });
        Ok(found)
    }

    fn work(&self) -> Option<Work> {
        Some(*lock(&self.work))
    }
}

impl PromptSegmenter for Sam {
    fn key(&self) -> String {
        self.name("segment", true)
    }

    fn accelerator(&self) -> bool {
        self.device == NetworkDevice::Cuda
    }

    fn prompted(&self, image: &Image, prompts: &Prompts) -> Result<Prompted, VisionError> {
        check(image)?;
        let groups = prompt::groups(image, prompts)?;
        let (encoded, photo) = self.encoded(image)?;
        let mut plane: Option<Vec<f32>> = None;
        let mut score = 1.0f32;
        for group in &groups {
            let answer = self.answer((&encoded, photo), group, prompts.granularity)?;
            score = score.min(answer.score.clamp(0.0, 1.0));
            let wide = self.upscale(&encoded, &answer.logits).plane(&answer.logits);
            plane = Some(match plane {
                None => wide,
                Some(before) => before.iter().zip(&wide).map(|(a, b)| a.max(*b)).collect(),
            });
        }
        let plane = plane.unwrap_or_else(|| vec![f32::NEG_INFINITY; image.pixels()]);
        let answer = ScoredMask {
            mask: Mask::over(image.width as u32, image.height as u32, &plane, 0.0),
            predicted_iou: score,
            stability: stability(&plane, self.stability_offset),
        };
        let chance = |(i, logit): (usize, &f32)| if answer.mask.index(i) { 0.0 } else { sigmoid(*logit) };
        let data = plane.iter().enumerate().map(chance).collect();
        let open = Image { width: image.width, height: image.height, channels: 1, data };
        Ok(Prompted { answer, open })
    }

    fn refine(&self, image: &Image, certainty: &Image) -> Result<ScoredMask, VisionError> {
        self.snap(image, certainty)
    }

    fn prepare(&self, image: &Image) {
        if self.embeddings.has_space_for(PREPARED) {
            drop(self.encoded(image));
        }
    }

    fn is_prepared(&self, image: &Image) -> bool {
        self.embeddings.has(content(image))
    }
}
