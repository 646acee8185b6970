//! The built-in provider: descriptors, masks, prompts, refinement and sky, without network weights and without a GPU.
//!
//! Boundaries ([`boundary`]), superpixels ([`watershed`]) and a tree of nested regions ([`tree`]) are computed once per
//! photo and shared by embeddings, proposals, prompted masks, refinement and sky.

mod analysis;
mod boundary;
mod candidates;
mod colour;
mod colours;
mod cut;
mod embed;
mod memory;
mod nesting;
mod plane;
mod pool;
mod propose;
mod record;
mod refine;
mod select;
mod shape;
mod sky;
mod steps;
mod traits;
mod tree;
mod watershed;
mod weights;

use crate::{Embedder, MaskProposer, PromptSegmenter, Prompted, SkyDetector, VisionError};
pub(crate) use analysis::check;
use analysis::{Analysis, PixelFeatures, boundaries};
pub(crate) use memory::{Memory, Weighed};
pub(crate) use plane::FloatPlane;
pub use record::{RegionCache, Regions};
use segwild_scene::{Embedding, Image, Mask, Prompts, ScoredMask};
use select::Means;
use std::borrow::Cow;
use std::sync::Arc;
use steps::{CandidateMask, PromptAnswer};
pub use traits::PromptStep;
pub(crate) use watershed::{basins, neighbours};
pub use weights::TraitWeights;

/// Part of every cache key; changes whenever the same photo would give other bytes.
const VERSION: &str = "builtin-4";
/// Default memory for photos, in bytes: holds the analyses of about 70 photos of 320 px, or 45 of 640.
const MEMORY: usize = 256 << 20;
/// Memory for answers to prompts, in bytes: some thousand of them.
const ANSWERS: usize = 4 << 20;
/// Analyses that must fit into memory, or none is prepared in advance: it would only evict others.
pub(crate) const PREPARED: usize = 6;
/// Photos whose long side is over this are analysed smaller, so that boundaries are those of objects and not of grain.
const LONG_SIDE: usize = 800;

/// A boundary detector that replaces the built-in one.
pub trait EdgeDetector: Send + Sync {
    /// Names the model and its parameters.
    fn key(&self) -> String;
    /// Boundary probability per pixel: one plane of the photo's size.
    fn edges(&self, image: &Image) -> Result<Image, VisionError>;
}

/// One interpretation of a prompt: a candidate mask with its traits.
#[derive(Clone, Debug)]
pub struct PromptInterpretation {
    /// Whether each superpixel is inside.
    pub inside: Vec<bool>,
    /// The candidate's traits, in the order of [`TraitWeights`].
    pub traits: Vec<f32>,
}

/// A prompt's kind and every interpretation of it. For learning [`TraitWeights`].
#[derive(Clone, Debug)]
pub struct PromptQuery {
    /// The kind of prompt.
    pub step: PromptStep,
    /// Width and height of the photo at analysis size, in pixels.
    pub size: (usize, usize),
    /// Superpixel of every pixel.
    pub superpixels: Vec<u32>,
    /// The candidate masks.
    pub interpretations: Vec<PromptInterpretation>,
}

/// The provider that needs no weights.
pub struct Builtin {
    weights: TraitWeights,
    edges: Option<Arc<dyn EdgeDetector>>,
    /// Outputs of `edges`, which take far longer than the rest of the analysis and are far smaller than it.
    strengths: Memory<FloatPlane>,
    /// Per-pixel features, for skies and descriptors.
    pixels: Memory<PixelFeatures>,
    /// Analyses, for masks, clicks and refinements; of many more photos.
    analyses: Memory<Analysis>,
    /// Answers to the latest prompts.
    answers: Memory<PromptAnswer>,
    /// Keeps regions for later processes.
    cache: Option<Arc<dyn RegionCache>>,
}

impl Weighed for FloatPlane {
    fn bytes(&self) -> usize {
        4 * self.data.len()
    }
}

impl Default for Builtin {
    fn default() -> Builtin {
        Builtin {
            weights: TraitWeights::builtin(),
            edges: None,
            strengths: Memory::new(0),
            pixels: Memory::new(0),
            analyses: Memory::new(0),
            answers: Memory::new(ANSWERS),
            cache: None,
        }
        .within(MEMORY)
    }
}

impl Builtin {
    /// With its own boundary detector.
    pub fn new() -> Builtin {
        Builtin::default()
    }

    /// With boundaries from a network.
    pub fn with_edges(edges: Arc<dyn EdgeDetector>) -> Builtin {
        Builtin { weights: TraitWeights::network(), edges: Some(edges), ..Builtin::default() }
    }

    /// Keeps analyses of photos within about that many bytes; the newest one is always kept.
    pub fn within(self, bytes: usize) -> Builtin {
        // A click needs the analyses of all photos, round after round; per-pixel features are used once or twice, soon after.
        Builtin {
            strengths: Memory::new(bytes / 4),
            pixels: Memory::new(bytes / 4),
            analyses: Memory::new(bytes / 2),
            ..self
        }
    }

    /// Keeps the regions of photos in a cache and reads them from there: a click in a process of its own then need not analyse
    /// the photos that the run has analysed.
    pub fn keeping(self, cache: Arc<dyn RegionCache>) -> Builtin {
        Builtin { cache: Some(cache), ..self }
    }

    /// Scores candidate masks by other weights than the built-in ones: for learning them.
    pub fn weighing(self, weights: TraitWeights) -> Builtin {
        Builtin { weights, ..self }
    }

    fn name(&self, part: &str) -> String {
        let mut name = format!("{VERSION}-{part}");
        let usual = if self.edges.is_some() { TraitWeights::network() } else { TraitWeights::builtin() };
        if self.weights != usual {
            name += &format!("-{:?}", self.weights);
        }
        match &self.edges {
            Some(edges) => format!("{name}+{}", edges.key()),
            None => name,
        }
    }

    fn select(
        &self,
        image: &Image,
        prompts: &Prompts,
        listener: Option<&mut select::CandidateListener>,
    ) -> Result<Prompted, VisionError> {
        let analysis = self.analysis(image)?;
        let (w, h) = (image.width as f32, image.height as f32);
        if let Some(p) = prompts.points.iter().find(|p| !(p.x >= 0.0 && p.y >= 0.0 && p.x < w && p.y < h)) {
            return Err(VisionError::Image(format!(
                "the click at ({}, {}) lies outside the photo ({w} x {h})",
                p.x, p.y
            )));
        }
        let (sx, sy) = analysis.scale_from(image);
        let prompts = prompts.scaled(sx, sy);
        let photo = content(&*fitted(image)?);
        let kept = |prompts: &[u8]| {
            let key = blake3::Hasher::new().update(photo.as_bytes()).update(prompts).finalize();
            self.answers.slot(key)
        };
        let found =
            select::select(&analysis, &prompts, Means { weights: &self.weights, kept: &kept, listener })?;
        self.answers.trim();
        let open = found.open.resized(image.width, image.height);
        Ok(Prompted { answer: at_size_of(image, found.answer), open })
    }

    /// The answer to prompts, and the interpretations of the last of them; `None` where the last prompt agreed with the answer
    /// before it. For learning [`TraitWeights`].
    pub fn answer(
        &self,
        image: &Image,
        prompts: &Prompts,
    ) -> Result<(ScoredMask, Option<PromptQuery>), VisionError> {
        let tree = &self.analysis(image)?.tree;
        let mut last = None;
        let mut listener = |step: PromptStep, candidate_masks: &[CandidateMask]| {
            let interpretation = |o: &CandidateMask| PromptInterpretation {
                inside: o.region_set.inside.clone(),
                traits: o.traits.to_vec(),
            };
            last = Some(PromptQuery {
                step,
                size: (tree.width, tree.height),
                superpixels: tree.labels.to_vec(),
                interpretations: candidate_masks.iter().map(interpretation).collect(),
            });
        };
        let answer = self.select(image, prompts, Some(&mut listener))?.answer;
        Ok((answer, last))
    }

    /// The analysis of a photo.
    fn analysis(&self, image: &Image) -> Result<Arc<Analysis>, VisionError> {
        self.analysed(image, self.cache.as_deref())
    }

    fn analysed(&self, image: &Image, cache: Option<&dyn RegionCache>) -> Result<Arc<Analysis>, VisionError> {
        let image = &*fitted(image)?;
        let key = content(image);
        match self.known(image, key, cache) {
            Some(done) => Ok(done),
            None => Ok(self.computed(image, key, cache)?.analysis.clone()),
        }
    }

    /// The analysis of a photo, where this process has computed it before, or another one has kept its regions.
    fn known(
        &self,
        image: &Image,
        key: blake3::Hash,
        cache: Option<&dyn RegionCache>,
    ) -> Option<Arc<Analysis>> {
        let slot = self.analyses.slot(key);
        if let Some(done) = slot.get() {
            return Some(done.clone());
        }
        let kept = cache?.regions(&self.cache_name(key))?.analysis(image.width, image.height)?;
        let done = slot.get_or_init(|| Arc::new(kept)).clone();
        self.analyses.trim();
        Some(done)
    }

    /// The name that the regions of a photo are kept under.
    fn cache_name(&self, key: blake3::Hash) -> String {
        let edges = self.edges.as_ref().map(|edges| edges.key()).unwrap_or_default();
        format!("{VERSION}+{edges} {key}")
    }

    /// A photo's per-pixel features and its analysis, computed once; two threads that need one photo share the work.
    fn pixels(&self, image: &Image) -> Result<Arc<PixelFeatures>, VisionError> {
        let image = &*fitted(image)?;
        self.computed(image, content(image), self.cache.as_deref())
    }

    /// As [`Builtin::pixels`], of a photo at analysis size.
    fn computed(
        &self,
        image: &Image,
        key: blake3::Hash,
        cache: Option<&dyn RegionCache>,
    ) -> Result<Arc<PixelFeatures>, VisionError> {
        let slot = self.pixels.slot(key);
        if let Some(done) = slot.get() {
            return Ok(done.clone());
        }
        let strength = self.strength(image, key)?;
        let known = self.known(image, key, cache);
        let found = known.is_none();
        let done = slot.get_or_init(|| Arc::new(PixelFeatures::of(image, strength, known))).clone();
        if let (true, Some(cache)) = (found, cache) {
            cache.keep(&self.cache_name(key), &Regions::of(&done.analysis));
        }
        self.analyses.slot(key).get_or_init(|| done.analysis.clone());
        self.pixels.trim();
        self.analyses.trim();
        Ok(done)
    }

    /// The analysis of a photo, and a certainty at its size.
    fn guess(&self, image: &Image, certainty: &Image) -> Result<(Arc<Analysis>, FloatPlane), VisionError> {
        crate::provider::check_certainty(image, certainty)?;
        let analysis = self.analysis(image)?;
        let plane = FloatPlane::new(image.width, image.height, certainty.plane(0).to_vec());
        let plane = plane.pooled_to(analysis.tree.width, analysis.tree.height);
        Ok((analysis, plane))
    }

    /// The edge network's output for a photo at analysis size; `None` without a network.
    fn strength(&self, image: &Image, key: blake3::Hash) -> Result<Option<FloatPlane>, VisionError> {
        let Some(edges) = &self.edges else { return Ok(None) };
        let slot = self.strengths.slot(key);
        if let Some(done) = slot.get() {
            return Ok(Some(FloatPlane::clone(done)));
        }
        let map = edges.edges(image)?;
        if (map.width, map.height, map.channels) != (image.width, image.height, 1) {
            return Err(VisionError::Model(format!(
                "the edge network {} answered {} x {} x {} for a photo of {} x {}",
                edges.key(),
                map.width,
                map.height,
                map.channels,
                image.width,
                image.height
            )));
        }
        let data = map.data.iter().map(|v| if v.is_finite() { v.clamp(0.0, 1.0) } else { 0.0 }).collect();
        let done = slot.get_or_init(|| Arc::new(FloatPlane::new(image.width, image.height, data))).clone();
        self.strengths.trim();
        Ok(Some(FloatPlane::clone(&done)))
    }

    /// Which region every pixel belongs to at a granularity in [0, 1] (`None`: superpixels); numbers are not in order.
    pub fn regions(&self, image: &Image, granularity: Option<f32>) -> Result<Vec<u32>, VisionError> {
        let tree = &self.analysis(image)?.tree;
        let limit = granularity.map(|g| select::altitude(tree, g));
        let of_leaf: Vec<u32> =
            (0..tree.leaves as u32).map(|l| limit.map_or(l, |limit| tree.region_at(l, limit))).collect();
        let (w, h) = (image.width, image.height);
        let under = |i: usize| (i / w * tree.height / h) * tree.width + i % w * tree.width / w;
        Ok((0..w * h).map(|i| of_leaf[tree.labels[under(i)] as usize]).collect())
    }

    /// Boundary strengths one pixel wide, probability-like, one plane: for figures and measurements.
    pub fn boundaries(&self, image: &Image) -> Result<Image, VisionError> {
        let thin = self.pixels(image)?.edges.thinned();
        let map = Image { width: thin.width, height: thin.height, channels: 1, data: thin.data };
        Ok(if (map.width, map.height) == (image.width, image.height) {
            map
        } else {
            map.resized(image.width, image.height)
        })
    }
}

/// Hash of a photo's size and numbers.
pub(crate) fn content(image: &Image) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new();
    for n in [image.width, image.height, image.channels] {
        hasher.update(&(n as u64).to_le_bytes());
    }
    let mut bytes = [[0; 4]; 4096];
    for chunk in image.data.chunks(bytes.len()) {
        let of_chunk = &mut bytes[..chunk.len()];
        of_chunk.iter_mut().zip(chunk).for_each(|(bytes, v)| *bytes = v.to_le_bytes());
        hasher.update(of_chunk.as_flattened());
    }
    hasher.finalize()
}

/// A photo at analysis size.
fn fitted(image: &Image) -> Result<Cow<'_, Image>, VisionError> {
    check(image)?;
    let long = image.width.max(image.height);
    if long <= LONG_SIDE {
        return Ok(Cow::Borrowed(image));
    }
    let size = |n: usize| (n * LONG_SIDE / long).max(1);
    Ok(Cow::Owned(image.resized(size(image.width), size(image.height))))
}

/// A mask at the size of the queried photo.
fn at_size_of(image: &Image, answer: ScoredMask) -> ScoredMask {
    ScoredMask { mask: at_size(image, answer.mask), ..answer }
}

/// The same of a mask alone.
fn at_size(image: &Image, mask: Mask) -> Mask {
    let (w, h) = (image.width as u32, image.height as u32);
    if (mask.width(), mask.height()) == (w, h) { mask } else { mask.resized(w, h) }
}

impl Embedder for Builtin {
    fn key(&self) -> String {
        self.name("embed")
    }

    fn embed(&self, image: &Image) -> Result<Embedding, VisionError> {
        Ok(embed::embed(&*self.pixels(image)?))
    }
}

impl MaskProposer for Builtin {
    fn key(&self) -> String {
        self.name("propose")
    }

    fn propose(&self, image: &Image, points: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
        // The image is a render of the scene at one training step, which is never queried again: no cache.
        let analysis = self.analysed(image, None)?;
        let (sx, sy) = analysis.scale_from(image);
        let points: Vec<[f32; 2]> = points.iter().map(|p| [p[0] * sx, p[1] * sy]).collect();
        Ok(propose::propose(&analysis, &points).into_iter().map(|m| at_size_of(image, m)).collect())
    }
}

impl PromptSegmenter for Builtin {
    fn key(&self) -> String {
        self.name("segment")
    }

    fn prompted(&self, image: &Image, prompts: &Prompts) -> Result<Prompted, VisionError> {
        self.select(image, prompts, None)
    }

    fn refine(&self, image: &Image, certainty: &Image) -> Result<ScoredMask, VisionError> {
        let (analysis, plane) = self.guess(image, certainty)?;
        Ok(at_size_of(image, refine::snap(&analysis, &plane.data)))
    }

    fn refined_mask(&self, image: &Image, certainty: &Image) -> Result<(Mask, f32), VisionError> {
        let (analysis, plane) = self.guess(image, certainty)?;
        let (mask, predicted_iou, _) = refine::snapped(&analysis, &plane.data);
        Ok((at_size(image, mask), predicted_iou))
    }

    fn finds_objects(&self) -> bool {
        false
    }

    fn boundary_strengths(&self, image: &Image) -> Result<Option<Image>, VisionError> {
        let photo = &*fitted(image)?;
        // The photo's regions, which take longer, are not needed.
        let strength = match self.strength(photo, content(photo))? {
            Some(strength) => strength,
            None => boundaries(photo).strength,
        };
        let map = Image { width: strength.width, height: strength.height, channels: 1, data: strength.data };
        Ok(Some(map.resized(image.width, image.height)))
    }

    fn prepare(&self, image: &Image) {
        if self.analyses.has_space_for(PREPARED) {
            drop(self.analysis(image));
        }
    }
}

impl SkyDetector for Builtin {
    fn key(&self) -> String {
        self.name("sky")
    }

    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        let mask = sky::sky(&*self.pixels(image)?);
        Ok(mask.resized(image.width as u32, image.height as u32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;
    use std::sync::Mutex;

    fn photo(k: usize) -> Image {
        let mut image = Image::zeros(320, 240, 3);
        let value = |i: usize| ((i * 7919 + (i / 320 / 24 + k) * 31) % 101) as f32 / 100.0;
        image.data.iter_mut().enumerate().for_each(|(i, v)| *v = value(i));
        image
    }

    /// Regression: a click over sixty photos in three rounds analysed each of them three times.
    #[test]
    fn photos_queried_round_after_round_are_analysed_once() {
        let builtin = Builtin::new().within(32 << 20);
        let first: Vec<_> = (0..8).map(|k| builtin.analysis(&photo(k)).unwrap()).collect();
        for (k, first) in first.iter().enumerate() {
            assert!(Arc::ptr_eq(first, &builtin.analysis(&photo(k)).unwrap()), "photo {k}");
        }
        // Descriptors recompute the pixels' features, but not the regions.
        assert!(Arc::ptr_eq(&first[0], &builtin.pixels(&photo(0)).unwrap().analysis));
        assert!(first[0].bytes() * 3 < builtin.pixels(&photo(0)).unwrap().bytes());
    }

    /// Counts what is taken from it.
    #[derive(Default)]
    struct TestCache(Mutex<(BTreeMap<String, Regions>, usize)>);

    impl RegionCache for TestCache {
        fn regions(&self, name: &str) -> Option<Regions> {
            let mut kept = self.0.lock().unwrap();
            let found = kept.0.get(name).cloned();
            kept.1 += usize::from(found.is_some());
            found
        }
        fn keep(&self, name: &str, regions: &Regions) {
            self.0.lock().unwrap().0.insert(name.to_owned(), regions.clone());
        }
    }

    #[test]
    fn a_process_that_finds_kept_regions_answers_as_the_one_that_analysed() {
        let cache = Arc::new(TestCache::default());
        let answers = |builtin: &Builtin| {
            let click = builtin.prompted(&photo(1), &Prompts::click(100.0, 90.0)).unwrap();
            let rough = Image { channels: 1, ..click.open.clone() };
            let proposed = builtin.propose(&photo(1), &[[40.0, 50.0], [200.0, 120.0]]).unwrap();
            (click, builtin.refine(&photo(1), &rough).unwrap(), proposed)
        };
        let proposing = Builtin::new().keeping(cache.clone());
        proposing.propose(&photo(3), &[[40.0, 50.0]]).unwrap();
        assert!(cache.0.lock().unwrap().0.is_empty(), "a render is never queried again");
        let expected = answers(&Builtin::new().keeping(cache.clone()));
        assert_eq!(cache.0.lock().unwrap().1, 0, "there was nothing to find");
        assert_eq!(answers(&Builtin::new().keeping(cache.clone())), expected);
        assert_eq!(cache.0.lock().unwrap().1, 1);
        assert_eq!(answers(&Builtin::new()), expected);
        // Another photo has regions of its own, and a record that does not fit is computed again.
        Builtin::new().keeping(cache.clone()).analysis(&photo(2)).unwrap();
        assert_eq!(cache.0.lock().unwrap().0.len(), 2);
        for regions in cache.0.lock().unwrap().0.values_mut() {
            regions.cut_short();
        }
        assert_eq!(answers(&Builtin::new().keeping(cache.clone())), expected);
    }
}
