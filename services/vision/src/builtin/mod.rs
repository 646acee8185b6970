//! The built-in provider: everything the program needs to see, without weights and without a GPU.
//!
//! Boundaries ([`boundary`]), superpixels ([`watershed`]) and a tree of nested regions ([`tree`]) are worked out once per
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
use analysis::{Analysis, Pixels};
pub(crate) use memory::{Memory, Weighed};
use plane::Plane;
pub use record::{RegionCache, Regions};
use segwild_scene::{Embedding, Image, Mask, Prompts, ScoredMask};
use select::Means;
use std::borrow::Cow;
use std::sync::Arc;
use steps::{Chosen, Offer};
pub use traits::Step;
pub use weights::Weights;

/// Changes whenever the same photo would give other bytes.
const VERSION: &str = "builtin-4";
/// Memory for photos when nothing else is said: the analyses of about 70 of 320 px, or 45 of 640.
const MEMORY: usize = 256 << 20;
/// Memory for answers: some thousand.
const ANSWERS: usize = 4 << 20;
/// Analyses that there must be room for, or none is made before it is asked for: it would only push out others.
pub(crate) const PREPARED: usize = 6;
/// Photos whose long side is over this are looked at smaller: boundaries are those of things, not of grain.
const LONG_SIDE: usize = 800;

/// Where boundary strengths come from, when not from the built-in detector.
pub trait EdgeDetector: Send + Sync {
    /// Names the model and its parameters.
    fn key(&self) -> String;
    /// Boundary probability per pixel: one plane of the photo's size.
    fn edges(&self, image: &Image) -> Result<Image, VisionError>;
}

/// What a prompt could have meant.
#[derive(Clone, Debug)]
pub struct Meaning {
    /// Whether each superpixel is inside.
    pub inside: Vec<bool>,
    /// What is known of it, in the order of [`Weights`].
    pub traits: Vec<f32>,
}

/// What a prompt asked, and everything that it could have meant.
#[derive(Clone, Debug)]
pub struct Question {
    /// The kind of question.
    pub step: Step,
    /// Width and height of the photo as it was looked at.
    pub size: (usize, usize),
    /// Superpixel of every pixel.
    pub superpixels: Vec<u32>,
    /// What it could have meant.
    pub meanings: Vec<Meaning>,
}

/// The provider that needs no weights.
pub struct Builtin {
    weights: Weights,
    edges: Option<Arc<dyn EdgeDetector>>,
    /// Answers of `edges`, which take far longer than the rest of the analysis and are far smaller than it.
    strengths: Memory<Plane>,
    /// What skies and descriptions are made of.
    pixels: Memory<Pixels>,
    /// What masks, clicks and refinements ask for, of many more photos.
    analyses: Memory<Analysis>,
    /// What was answered to the prompts of late.
    answers: Memory<Chosen>,
    /// Where regions outlive the process.
    shelf: Option<Arc<dyn RegionCache>>,
}

impl Weighed for Plane {
    fn bytes(&self) -> usize {
        4 * self.data.len()
    }
}

impl Default for Builtin {
    fn default() -> Builtin {
        Builtin {
            weights: Weights::builtin(),
            edges: None,
            strengths: Memory::new(0),
            pixels: Memory::new(0),
            analyses: Memory::new(0),
            answers: Memory::new(ANSWERS),
            shelf: None,
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
        Builtin { weights: Weights::network(), edges: Some(edges), ..Builtin::default() }
    }

    /// Keeps analyses of photos within about that many bytes; the newest one is always kept.
    pub fn within(self, bytes: usize) -> Builtin {
        // A click asks for the analyses of all photos, round after round; what is known of pixels is asked for once or twice, soon.
        Builtin {
            strengths: Memory::new(bytes / 4),
            pixels: Memory::new(bytes / 4),
            analyses: Memory::new(bytes / 2),
            ..self
        }
    }

    /// Keeps the regions of photos on a shelf, and takes them from there: a click in a process of its own then need not look
    /// at the photos that the run has looked at.
    pub fn keeping(self, shelf: Arc<dyn RegionCache>) -> Builtin {
        Builtin { shelf: Some(shelf), ..self }
    }

    /// Weighs what prompts could mean by other weights than the built-in ones: for learning them.
    pub fn weighing(self, weights: Weights) -> Builtin {
        Builtin { weights, ..self }
    }

    fn name(&self, part: &str) -> String {
        let mut name = format!("{VERSION}-{part}");
        let usual = if self.edges.is_some() { Weights::network() } else { Weights::builtin() };
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
        hear: Option<&mut select::Listener>,
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
        let kept = |said: &[u8]| {
            let key = blake3::Hasher::new().update(photo.as_bytes()).update(said).finalize();
            self.answers.slot(key)
        };
        let found = select::select(&analysis, &prompts, Means { weights: &self.weights, kept: &kept, hear })?;
        self.answers.trim();
        let open = found.open.resized(image.width, image.height);
        Ok(Prompted { answer: at_size_of(image, found.answer), open })
    }

    /// The answer to prompts, and the question that the last of them asked; `None` where it agreed with what was chosen
    /// before it. For learning [`Weights`].
    pub fn answer(
        &self,
        image: &Image,
        prompts: &Prompts,
    ) -> Result<(ScoredMask, Option<Question>), VisionError> {
        let tree = &self.analysis(image)?.tree;
        let mut last = None;
        let mut hear = |step: Step, offers: &[Offer]| {
            let meaning = |o: &Offer| Meaning { inside: o.choice.inside.clone(), traits: o.traits.to_vec() };
            last = Some(Question {
                step,
                size: (tree.width, tree.height),
                superpixels: tree.labels.to_vec(),
                meanings: offers.iter().map(meaning).collect(),
            });
        };
        let answer = self.select(image, prompts, Some(&mut hear))?.answer;
        Ok((answer, last))
    }

    /// The analysis of a photo.
    fn analysis(&self, image: &Image) -> Result<Arc<Analysis>, VisionError> {
        self.analysed(image, self.shelf.as_deref())
    }

    fn analysed(&self, image: &Image, shelf: Option<&dyn RegionCache>) -> Result<Arc<Analysis>, VisionError> {
        let image = &*fitted(image)?;
        let key = content(image);
        match self.known(image, key, shelf) {
            Some(done) => Ok(done),
            None => Ok(self.looked_at(image, key, shelf)?.analysis.clone()),
        }
    }

    /// The analysis of a photo that was looked at before: in this process, or in one that kept its regions.
    fn known(
        &self,
        image: &Image,
        key: blake3::Hash,
        shelf: Option<&dyn RegionCache>,
    ) -> Option<Arc<Analysis>> {
        let slot = self.analyses.slot(key);
        if let Some(done) = slot.get() {
            return Some(done.clone());
        }
        let kept = shelf?.regions(&self.shelved(key))?.analysis(image.width, image.height)?;
        let done = slot.get_or_init(|| Arc::new(kept)).clone();
        self.analyses.trim();
        Some(done)
    }

    /// The name that the regions of a photo are kept under.
    fn shelved(&self, key: blake3::Hash) -> String {
        let edges = self.edges.as_ref().map(|edges| edges.key()).unwrap_or_default();
        format!("{VERSION}+{edges} {key}")
    }

    /// What is known of a photo's pixels, and its analysis, worked out once; two threads that ask for one photo share the work.
    fn pixels(&self, image: &Image) -> Result<Arc<Pixels>, VisionError> {
        let image = &*fitted(image)?;
        self.looked_at(image, content(image), self.shelf.as_deref())
    }

    /// As [`Builtin::pixels`], of a photo at the size it is looked at.
    fn looked_at(
        &self,
        image: &Image,
        key: blake3::Hash,
        shelf: Option<&dyn RegionCache>,
    ) -> Result<Arc<Pixels>, VisionError> {
        let slot = self.pixels.slot(key);
        if let Some(done) = slot.get() {
            return Ok(done.clone());
        }
        let strength = self.strength(image, key)?;
        let known = self.known(image, key, shelf);
        let found = known.is_none();
        let done = slot.get_or_init(|| Arc::new(Pixels::of(image, strength, known))).clone();
        if let (true, Some(shelf)) = (found, shelf) {
            shelf.keep(&self.shelved(key), &Regions::of(&done.analysis));
        }
        self.analyses.slot(key).get_or_init(|| done.analysis.clone());
        self.pixels.trim();
        self.analyses.trim();
        Ok(done)
    }

    /// What the edge network says about a photo at the size it is looked at; `None` without one.
    fn strength(&self, image: &Image, key: blake3::Hash) -> Result<Option<Plane>, VisionError> {
        let Some(edges) = &self.edges else { return Ok(None) };
        let slot = self.strengths.slot(key);
        if let Some(done) = slot.get() {
            return Ok(Some(Plane::clone(done)));
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
        let done = slot.get_or_init(|| Arc::new(Plane::new(image.width, image.height, data))).clone();
        self.strengths.trim();
        Ok(Some(Plane::clone(&done)))
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

    /// Boundary strengths one pixel wide, probability-like, one plane: for pictures and measurements.
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
    let mut bytes = Vec::with_capacity(4 * 4096);
    for chunk in image.data.chunks(4096) {
        bytes.clear();
        chunk.iter().for_each(|v| bytes.extend_from_slice(&v.to_le_bytes()));
        hasher.update(&bytes);
    }
    hasher.finalize()
}

/// A photo at the size it is looked at.
fn fitted(image: &Image) -> Result<Cow<'_, Image>, VisionError> {
    check(image)?;
    let long = image.width.max(image.height);
    if long <= LONG_SIDE {
        return Ok(Cow::Borrowed(image));
    }
    let size = |n: usize| (n * LONG_SIDE / long).max(1);
    Ok(Cow::Owned(image.resized(size(image.width), size(image.height))))
}

/// A mask at the size of the photo that was asked about.
fn at_size_of(image: &Image, mut answer: ScoredMask) -> ScoredMask {
    let (w, h) = (image.width as u32, image.height as u32);
    if (answer.mask.width(), answer.mask.height()) != (w, h) {
        answer.mask = answer.mask.resized(w, h);
    }
    answer
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
        // Of a picture that was drawn of the scene as it was at one step: nobody asks for it again.
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
        crate::provider::check_certainty(image, certainty)?;
        let analysis = self.analysis(image)?;
        let plane = Plane::new(image.width, image.height, certainty.plane(0).to_vec());
        let plane = plane.pooled_to(analysis.tree.width, analysis.tree.height);
        Ok(at_size_of(image, refine::snap(&analysis, &plane.data)))
    }

    fn prepare(&self, image: &Image) {
        if self.analyses.has_room_for(PREPARED) {
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

    /// A click that asks sixty photos in three rounds looked at each of them three times.
    #[test]
    fn photos_asked_round_after_round_are_looked_at_once() {
        let builtin = Builtin::new().within(32 << 20);
        let first: Vec<_> = (0..8).map(|k| builtin.analysis(&photo(k)).unwrap()).collect();
        for (k, first) in first.iter().enumerate() {
            assert!(Arc::ptr_eq(first, &builtin.analysis(&photo(k)).unwrap()), "photo {k}");
        }
        // Descriptions need the pixels anew, but not the regions.
        assert!(Arc::ptr_eq(&first[0], &builtin.pixels(&photo(0)).unwrap().analysis));
        assert!(first[0].bytes() * 3 < builtin.pixels(&photo(0)).unwrap().bytes());
    }

    /// Counts what is taken from it.
    #[derive(Default)]
    struct Kept(Mutex<(BTreeMap<String, Regions>, usize)>);

    impl RegionCache for Kept {
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
    fn a_process_that_finds_kept_regions_answers_as_the_one_that_looked() {
        let shelf = Arc::new(Kept::default());
        let answers = |builtin: &Builtin| {
            let click = builtin.prompted(&photo(1), &Prompts::click(100.0, 90.0)).unwrap();
            let rough = Image { channels: 1, ..click.open.clone() };
            let proposed = builtin.propose(&photo(1), &[[40.0, 50.0], [200.0, 120.0]]).unwrap();
            (click, builtin.refine(&photo(1), &rough).unwrap(), proposed)
        };
        let drawn = Builtin::new().keeping(shelf.clone());
        drawn.propose(&photo(3), &[[40.0, 50.0]]).unwrap();
        assert!(shelf.0.lock().unwrap().0.is_empty(), "nobody asks for it again");
        let looked = answers(&Builtin::new().keeping(shelf.clone()));
        assert_eq!(shelf.0.lock().unwrap().1, 0, "there was nothing to find");
        assert_eq!(answers(&Builtin::new().keeping(shelf.clone())), looked);
        assert_eq!(shelf.0.lock().unwrap().1, 1);
        assert_eq!(answers(&Builtin::new()), looked);
        // Another photo has regions of its own, and what does not fit is looked for anew.
        Builtin::new().keeping(shelf.clone()).analysis(&photo(2)).unwrap();
        assert_eq!(shelf.0.lock().unwrap().0.len(), 2);
        for regions in shelf.0.lock().unwrap().0.values_mut() {
            regions.cut_short();
        }
        assert_eq!(answers(&Builtin::new().keeping(shelf.clone())), looked);
    }
}
