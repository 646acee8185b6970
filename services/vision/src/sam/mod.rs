//! Networks of the SAM family behind the provider traits: SAM, MobileSAM and EfficientSAM as ONNX exports, an image
//! encoder and a prompted decoder each.
//!
//! [`frame`] is the pre-processing, [`encoder`] and [`decoder`] read from their files what they take, [`logits`] is the
//! post-processing, [`prompt`] what clicks and boxes ask. A photo is encoded once and its embedding kept in memory, so
//! that every further prompt costs a decoder's run alone.

mod choice;
mod decoder;
mod encoder;
mod frame;
mod logits;
mod prompt;
mod refine;

use crate::builtin::{Memory, PREPARED, Weighed, check, content};
use crate::onnx::{Device, Model, Options, Runtime};
use crate::registry::Pair;
use crate::settings::NetworkFile;
use crate::{Embedder, MaskProposer, PromptSegmenter, Prompted, VisionError, VisionSettings, Work};
pub(crate) use choice::chosen;
use decoder::{Decoder, INSIDE, Query};
use encoder::{Encoded, Encoder};
use frame::Fit;
use logits::{Logits, Upscale, choose, stability};
use prompt::{Group, Labelled};
use segwild_scene::{Embedding, Image, Mask, Prompts, ScoredMask};
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Changes whenever the same files would give other bytes for the same photo.
const VERSION: &str = "sam-1";
/// Prompts that a decoder is asked at once, where its file allows it: their logits are in memory together.
const BATCH: usize = 16;
/// Bytes for answers that the next click may go on from.
const ANSWERS: usize = 32 << 20;

/// A pair of networks.
pub struct Sam {
    encoder: Encoder,
    decoder: Decoder,
    /// Where the two are.
    pair: Pair,
    device: Device,
    stability_offset: f32,
    /// Held while a photo is encoded, so that two who ask for the same one share the work.
    encoding: Mutex<()>,
    embeddings: Memory<Encoded>,
    answers: Memory<Chosen>,
    work: Mutex<Work>,
}

/// An answer: one mask, and the IoU that was predicted for it.
#[derive(Clone)]
struct Chosen {
    logits: Logits,
    score: f32,
}

impl Weighed for Chosen {
    fn bytes(&self) -> usize {
        self.logits.bytes()
    }
}

impl Sam {
    /// Loads a pair, on CUDA where that is asked for; what does not fit is said in words.
    pub(crate) fn load(
        runtime: &Runtime,
        pair: &Pair,
        settings: &VisionSettings,
        device: Device,
    ) -> Result<Sam, VisionError> {
        let options = Options {
            threads: settings.network_threads,
            device,
            limit: Duration::from_secs(settings.network_limit.max(1).into()),
            memory_mib: settings.network_memory,
        };
        let encoder = Encoder::new(Model::load(runtime, &pair.encoder, options)?)?;
        let decoder = Model::load(runtime, &pair.decoder, options)?;
        let fits = (encoder.name(), encoder.shape, encoder.is_efficient());
        let decoder = Decoder::new(decoder, fits, BATCH)?;
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
        let Pair { encoder, decoder, .. } = &self.pair;
        [
            NetworkFile::of_models(encoder, self.encoder.key()),
            NetworkFile::of_models(decoder, self.decoder.key()),
        ]
    }

    /// What the names of its files begin with, as in `mobile_sam`.
    pub(crate) fn stem(&self) -> &str {
        &self.pair.stem
    }

    /// Names a part. CUDA's numbers differ from a CPU's in the last places.
    fn name(&self, part: &str, decodes: bool) -> String {
        let mut name = format!("{VERSION}-{part}-{}", self.encoder.key());
        if decodes {
            name += &format!("-{}-{}", self.decoder.key(), self.stability_offset);
        }
        if self.device == Device::Cuda {
            name += "+cuda";
        }
        name
    }

    /// A photo's embedding, from memory or made now; and the photo's hash.
    fn encoded(&self, image: &Image) -> Result<(Arc<Encoded>, blake3::Hash), VisionError> {
        check(image)?;
        let key = content(image);
        let slot = self.embeddings.slot(key);
        let _alone = self.encoding.lock().unwrap_or_else(PoisonError::into_inner);
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
        add(&mut self.work.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// How the decoder's logits lie over a photo.
    fn upscale(&self, encoded: &Encoded, logits: &Logits) -> Upscale {
        let fit = if self.decoder.full_size { Fit::filling(encoded.fit.photo) } else { encoded.fit };
        Upscale::new(logits.width, logits.height, &fit)
    }

    /// The answer to all of a group, step by step: each click starts from the answer to those before it. What was
    /// answered before is known.
    fn answer(
        &self,
        (encoded, photo): (&Encoded, blake3::Hash),
        group: &Group,
        granularity: Option<f32>,
    ) -> Result<Chosen, VisionError> {
        let mut steps = group.steps();
        if self.decoder.takes_logits().is_none() {
            steps.drain(..steps.len().saturating_sub(1));
        }
        let mut chosen: Option<Arc<Chosen>> = None;
        for points in steps {
            let slot = self.answers.slot(said(photo, &points, granularity));
            if let Some(known) = slot.get() {
                chosen = Some(known.clone());
                continue;
            }
            let precise = points.len() > 1;
            let query = Query { points, previous: chosen.as_deref().map(|c| &c.logits) };
            let began = Instant::now();
            let mut masks = self.decoder.ask(encoded, &[query])?.pop().unwrap_or_default();
            self.count(|work| {
                work.prompts += 1;
                work.decode_s += began.elapsed().as_secs_f64();
            });
            let offered = offered(masks.len(), precise && granularity.is_none());
            let masks: Vec<(Logits, f32)> = masks.drain(offered).collect();
            let Some(best) = choose(&masks, granularity) else { continue };
            let (logits, score) = masks[best].clone();
            chosen = Some(slot.get_or_init(|| Arc::new(Chosen { logits, score })).clone());
            self.answers.trim();
        }
        match chosen {
            Some(chosen) => Ok((*chosen).clone()),
            None => Err(VisionError::Model("the decoder gave no mask".into())),
        }
    }
}

/// Which of a decoder's masks come into question. Of four, the first is for prompts that leave no doubt, and the others
/// are the part, the larger part and the whole that one click may mean; three are those alone.
fn offered(masks: usize, precise: bool) -> Range<usize> {
    match (masks, precise) {
        (4, true) => 0..1,
        (4, false) => 1..4,
        _ => 0..masks,
    }
}

/// Names what was asked about a photo.
fn said(photo: blake3::Hash, points: &[Labelled], granularity: Option<f32>) -> blake3::Hash {
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
        self.device == Device::Cuda
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
        self.device == Device::Cuda
    }

    fn propose(&self, image: &Image, points: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
        let (encoded, _) = self.encoded(image)?;
        let began = Instant::now();
        let (mut found, mut upscale) = (Vec::new(), None);
        for some in points.chunks(BATCH) {
            let queries: Vec<Query> =
                some.iter().map(|&at| Query { points: vec![(at, INSIDE)], previous: None }).collect();
            for mut masks in self.decoder.ask(&encoded, &queries)? {
                let offered = offered(masks.len(), false);
                for (logits, score) in masks.drain(offered) {
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
        Some(*self.work.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl PromptSegmenter for Sam {
    fn key(&self) -> String {
        self.name("segment", true)
    }

    fn accelerator(&self) -> bool {
        self.device == Device::Cuda
    }

    fn prompted(&self, image: &Image, prompts: &Prompts) -> Result<Prompted, VisionError> {
        check(image)?;
        let groups = prompt::groups(image, prompts)?;
        let (encoded, photo) = self.encoded(image)?;
        let mut plane: Option<Vec<f32>> = None;
        let mut score = 1.0f32;
        for group in &groups {
            let chosen = self.answer((&encoded, photo), group, prompts.granularity)?;
            score = score.min(chosen.score.clamp(0.0, 1.0));
            let wide = self.upscale(&encoded, &chosen.logits).plane(&chosen.logits);
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
        let chance = |(i, logit): (usize, &f32)| {
            if answer.mask.index(i) { 0.0 } else { 1.0 / (1.0 + (-logit).exp()) }
        };
        let data = plane.iter().enumerate().map(chance).collect();
        let open = Image { width: image.width, height: image.height, channels: 1, data };
        Ok(Prompted { answer, open })
    }

    fn refine(&self, image: &Image, certainty: &Image) -> Result<ScoredMask, VisionError> {
        self.snap(image, certainty)
    }

    fn prepare(&self, image: &Image) {
        if self.embeddings.has_room_for(PREPARED) {
            drop(self.encoded(image));
        }
    }
}
