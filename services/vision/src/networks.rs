//! The networks: boundaries, sky, persons and vehicles.

use crate::onnx::{Network, Runtime};
use crate::{EdgeDetector, SkyDetector, TransientDetector, VisionError};
use segwild_scene::{Image, Mask};
use std::path::Path;

/// ImageNet mean and standard deviation per channel.
const IMAGENET: [(f32, f32); 3] = [(0.485, 0.229), (0.456, 0.224), (0.406, 0.225)];

/// Each channel minus its mean, over its deviation.
fn standardised(mut image: Image, by: [(f32, f32); 3]) -> Image {
    for (c, (mean, deviation)) in by.into_iter().enumerate() {
        image.plane_mut(c).iter_mut().for_each(|v| *v = (*v - mean) / deviation);
    }
    image
}

/// A learned boundary detector: `[1, 3, h, w]` standardised by ImageNet's figures in, `[1, 1, h, w]` probability out.
pub struct EdgeNetwork {
    network: Network,
}

impl EdgeNetwork {
    /// Hash of its file.
    pub(crate) fn hash(&self) -> &str {
        self.network.key()
    }

    /// Loads a file. The error names the file and says what does not fit.
    pub fn load(runtime: &Runtime, path: &Path, threads: u32) -> Result<EdgeNetwork, VisionError> {
        let network = Network::load(runtime, path, threads)?;
        if network.answers.is_some_and(|c| c != 1) {
            return Err(VisionError::Model(format!(
                "{}: answers {} maps; an edge network answers one",
                network.name(),
                network.answers.unwrap_or(0)
            )));
        }
        Ok(EdgeNetwork { network })
    }
}

/// The photo continued by mirroring to a width and height that are multiples of `step`.
fn padded(image: &Image, step: usize) -> Image {
    let (w, h) = (image.width.next_multiple_of(step), image.height.next_multiple_of(step));
    let mut out = Image::zeros(w, h, image.channels);
    let mirror = |i: usize, n: usize| {
        let m = i % (2 * n);
        if m < n { m } else { 2 * n - 1 - m }
    };
    for c in 0..image.channels {
        for y in 0..h {
            for x in 0..w {
                out.data[(c * h + y) * w + x] = image.at(c, mirror(x, image.width), mirror(y, image.height));
            }
        }
    }
    out
}

impl EdgeDetector for EdgeNetwork {
    fn key(&self) -> String {
        format!("edges-{}", self.network.key())
    }

    fn edges(&self, image: &Image) -> Result<Image, VisionError> {
        // The network halves the photo three times.
        let step = 8;
        let fitted = match self.network.size {
            [Some(h), Some(w)] => image.resized(w, h),
            _ => padded(image, step),
        };
        let sized = (fitted.width, fitted.height);
        let map = self.network.run(standardised(fitted, IMAGENET))?;
        if map.channels != 1 || (map.width, map.height) != sized {
            return Err(VisionError::Model(format!(
                "{}: answered {} x {} x {} for a photo of {} x {}",
                self.network.name(),
                map.channels,
                map.width,
                map.height,
                sized.0,
                sized.1
            )));
        }
        if self.network.size.iter().all(Option::is_some) {
            return Ok(map.resized(image.width, image.height));
        }
        let mut out = Image::zeros(image.width, image.height, 1);
        for y in 0..image.height {
            let to = y * image.width;
            out.data[to..to + image.width]
                .copy_from_slice(&map.data[y * map.width..y * map.width + image.width]);
        }
        Ok(out)
    }
}

/// Cityscapes' train id of sky, and how many classes there are.
const CITYSCAPES: (usize, usize) = (10, 19);

/// A sky network: either one probability map (photo standardised by ImageNet's figures), or the 19 class scores of
/// Cityscapes (photo as `(x - 128) / 128`; the paper's provider).
pub struct SkyNetwork {
    network: Network,
    classes: bool,
    confidence: f32,
}

impl SkyNetwork {
    /// Hash of its file.
    pub(crate) fn hash(&self) -> &str {
        self.network.key()
    }

    /// Loads a file and recognises the kind by the number of its output maps. A pixel is sky from probability `confidence` on.
    /// The error names the file and says what does not fit.
    pub fn load(
        runtime: &Runtime,
        path: &Path,
        threads: u32,
        confidence: f32,
    ) -> Result<SkyNetwork, VisionError> {
        let network = Network::load(runtime, path, threads)?;
        let classes = match network.answers {
            Some(1) => false,
            Some(c) if c == CITYSCAPES.1 => true,
            other => {
                return Err(VisionError::Model(format!(
                    "{}: answers {} maps; a sky network answers 1 (probability) or {} (Cityscapes classes)",
                    network.name(),
                    other.map_or("an unknown number of".to_owned(), |c| c.to_string()),
                    CITYSCAPES.1
                )));
            }
        };
        Ok(SkyNetwork { network, classes, confidence })
    }

    /// Probability of sky per pixel, at the network's own size.
    fn probability(&self, image: &Image) -> Result<Image, VisionError> {
        let [h, w] = self.network.size.map(|n| n.unwrap_or(384));
        let fitted = image.resized(w, h);
        if !self.classes {
            return self.network.run(standardised(fitted, IMAGENET));
        }
        class_probability(&self.network, fitted, |class| class == CITYSCAPES.0)
    }
}

/// Probability per pixel of some classes of Cityscapes together.
fn class_probability(
    network: &Network,
    fitted: Image,
    wanted: impl Fn(usize) -> bool,
) -> Result<Image, VisionError> {
    let half = 128.0 / 255.0;
    let scores = network.run(standardised(fitted, [(half, half); 3]))?;
    if scores.channels != CITYSCAPES.1 {
        return Err(VisionError::Model(format!("{}: answered {} classes", network.name(), scores.channels)));
    }
    let mut out = Image::zeros(scores.width, scores.height, 1);
    for i in 0..scores.pixels() {
        let score = |c: usize| scores.data[c * scores.pixels() + i];
        let top = (0..scores.channels).map(score).fold(f32::NEG_INFINITY, f32::max);
        let of = |c: usize| (score(c) - top).exp();
        let sum: f32 = (0..scores.channels).map(of).sum();
        out.data[i] = (0..scores.channels).filter(|&c| wanted(c)).map(of).sum::<f32>() / sum;
    }
    Ok(out)
}

impl SkyDetector for SkyNetwork {
    fn key(&self) -> String {
        format!("sky-{}-{}", self.network.key(), self.confidence)
    }

    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        crate::builtin::check(image)?;
        let map = self.probability(image)?.resized(image.width, image.height);
        Ok(Mask::over(image.width as u32, image.height as u32, map.plane(0), self.confidence))
    }
}

/// Cityscapes' train ids of what moves: person, rider, car, truck, bus, train, motorcycle, bicycle.
const MOVING: std::ops::RangeInclusive<usize> = 11..=18;

/// A network over the classes of Cityscapes whose persons and vehicles are transients.
pub struct TransientNetwork {
    network: Network,
}

impl TransientNetwork {
    /// Hash of its file.
    pub(crate) fn hash(&self) -> &str {
        self.network.key()
    }

    /// Loads a file. The error names the file and says what does not fit.
    pub fn load(runtime: &Runtime, path: &Path, threads: u32) -> Result<TransientNetwork, VisionError> {
        let network = Network::load(runtime, path, threads)?;
        if network.answers.is_some_and(|c| c != CITYSCAPES.1) {
            return Err(VisionError::Model(format!(
                "{}: answers {} maps; a network of transients answers the {} classes of Cityscapes",
                network.name(),
                network.answers.unwrap_or(0),
                CITYSCAPES.1
            )));
        }
        Ok(TransientNetwork { network })
    }
}

impl TransientDetector for TransientNetwork {
    fn key(&self) -> String {
        format!("transients-{}", self.network.key())
    }

    fn transients(&self, image: &Image) -> Result<Mask, VisionError> {
        crate::builtin::check(image)?;
        let [h, w] = self.network.size.map(|n| n.unwrap_or(513));
        let map = class_probability(&self.network, image.resized(w, h), |class| MOVING.contains(&class))?;
        let map = map.resized(image.width, image.height);
        Ok(Mask::over(image.width as u32, image.height as u32, map.plane(0), 0.5))
    }
}
