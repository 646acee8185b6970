//! Providers that know the truth of a synthetic set, with faults of a chosen size: what a perfect, or a known
//! imperfect, 2D model would let the rest of the program reach (method, section 11).
//!
//! An image is known by its content: exactly, when it is a photo or a clean view of the set, and otherwise (a
//! render, a scaled photo) by likeness.

mod embed;

use glam::Vec3;
use segwild_scene::{Image, Mask, Prompts, ScoredMask};
use segwild_synthetic::SyntheticScene;
use segwild_synthetic::random::{Rng, noise};
use segwild_vision::{MaskProposer, PromptSegmenter, Prompted, SkyDetector, VisionError};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// The oracle's name as a provider of masks, in records, tables and pages.
pub const ORACLE: &str = "oracle";

/// How good the oracle is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OracleOptions {
    /// Seeds the descriptors and the faults.
    pub seed: u64,
    /// Numbers per cell of an embedding.
    pub channels: usize,
    /// Cells along the long side of a photo.
    pub cells: usize,
    /// Length of a part's descriptor beside its instance's, which is 1.
    pub part_code: f32,
    /// How much all built things are alike, 0 to 1: the mean cosine between the descriptors of two of them. Networks tell a
    /// column from the sky better than from the next column.
    pub kinship: f32,
    /// Length of the noise on each cell.
    pub noise: f32,
    /// Length of the offset that all cells of a photo share.
    pub offset: f32,
    /// Share of masks that are missing.
    pub drop: f32,
    /// Share of masks that run into a neighbour.
    pub merge: f32,
    /// Most pixels by which a mask's boundary wanders.
    pub wobble: f32,
}

impl Default for OracleOptions {
    fn default() -> Self {
        OracleOptions {
            seed: 1,
            channels: 64,
            cells: 64,
            part_code: 0.35,
            kinship: 0.0,
            noise: 0.25,
            offset: 0.15,
            drop: 0.10,
            merge: 0.05,
            wobble: 3.0,
        }
    }
}

impl OracleOptions {
    /// An oracle without a fault.
    pub fn perfect() -> OracleOptions {
        OracleOptions {
            noise: 0.0,
            offset: 0.0,
            drop: 0.0,
            merge: 0.0,
            wobble: 0.0,
            ..OracleOptions::default()
        }
    }
}

/// The truth of one photo.
struct ViewTruth {
    width: usize,
    height: usize,
    instances: Vec<u16>,
    parts: Vec<u16>,
    /// Transients, one number each; 0 where there is none.
    transients: Vec<u32>,
    likeness: [Vec<f32>; 2],
}

/// What an image was recognised as.
#[derive(Clone, Copy)]
struct RecognisedView {
    view: usize,
    transients: bool,
}

/// A thing that can have a mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Thing {
    Instance(u16),
    Part(u16),
    Transient(u32),
}

/// All four kinds of provider over one set.
pub struct Oracle {
    options: OracleOptions,
    views: Vec<ViewTruth>,
    exact: HashMap<[u8; 32], RecognisedView>,
    instance_of: Vec<u16>,
    /// Per instance, whether it is one of the built things.
    built: Vec<bool>,
    key: String,
}

/// Side of the thumbnails by which images are compared.
const THUMBNAIL: usize = 24;
/// Least correlation at which a render counts as a view of the set.
const LIKE: f32 = 0.45;
/// Mean certainty below which a thing is known to be outside, and above which it is known to be inside; between
/// them nothing is known of it.
const KNOWN: [f64; 2] = [0.4, 0.72];
/// Granularity below which a prompt means a part.
const FINE: f32 = 0.34;

impl Oracle {
    /// The oracle of a set.
    pub fn new(scene: &SyntheticScene, options: OracleOptions) -> Oracle {
        let mut exact = HashMap::new();
        let mut all = blake3::Hasher::new();
        let views = scene.photos.iter().enumerate().map(|(view, photo)| {
            // Where a photo is also a clean view, it has no transients.
            exact.insert(digest(&photo.photo), RecognisedView { view, transients: true });
            exact.insert(digest(&photo.clean), RecognisedView { view, transients: false });
            all.update(&digest(&photo.photo));
            ViewTruth {
                width: photo.photo.width,
                height: photo.photo.height,
                instances: photo.instances.clone(),
                parts: photo.parts.clone(),
                transients: photo.transients.components().0,
                likeness: [thumbnail(&photo.photo), thumbnail(&photo.clean)],
            }
        });
        let views = views.collect();
        let key = format!("oracle {} {options:?}", all.finalize().to_hex());
        let instance_of = scene.parts.iter().map(|p| p.instance).collect();
        let built = scene.instances.iter().map(|i| !["sky", "ground"].contains(&i.name.as_str())).collect();
        Oracle { options, views, exact, instance_of, built, key }
    }

    fn recognise(&self, image: &Image) -> Result<RecognisedView, VisionError> {
        if image.channels != 3 || image.pixels() == 0 || image.data.len() != 3 * image.pixels() {
            return Err(VisionError::Image(format!(
                "an image of {}x{} with {} planes is not a photo",
                image.width, image.height, image.channels
            )));
        }
        if let Some(sight) = self.exact.get(&digest(image)) {
            return Ok(*sight);
        }
        let this = thumbnail(image);
        let mut best = (LIKE, None);
        for (view, known) in self.views.iter().enumerate() {
            let aspect =
                image.width as f32 * known.height as f32 / (image.height as f32 * known.width as f32);
            if (aspect - 1.0).abs() > 0.03 {
                continue;
            }
            for (k, other) in known.likeness.iter().enumerate() {
                let like: f32 = this.iter().zip(other).map(|(a, b)| a * b).sum();
                if like > best.0 {
                    best = (like, Some(RecognisedView { view, transients: k == 0 }));
                }
            }
        }
        best.1.ok_or_else(|| {
            VisionError::Image(format!(
                "no view of the set resembles this {}x{} image",
                image.width, image.height
            ))
        })
    }

    /// Index in the truth of the pixel under a position of an image of that size.
    fn under(&self, known: &ViewTruth, image: &Image, x: f32, y: f32) -> usize {
        let scale =
            |v: f32, from: usize, to: usize| ((v / from as f32 * to as f32).max(0.0) as usize).min(to - 1);
        scale(y, image.height, known.height) * known.width + scale(x, image.width, known.width)
    }

    fn holds(&self, sight: RecognisedView, thing: Thing, i: usize) -> bool {
        let known = &self.views[sight.view];
        let covered = sight.transients && known.transients[i] != 0;
        match thing {
            Thing::Instance(id) => !covered && known.instances[i] == id,
            Thing::Part(id) => !covered && known.parts[i] == id,
            Thing::Transient(id) => sight.transients && known.transients[i] == id,
        }
    }

    fn exact_mask(&self, sight: RecognisedView, image: &Image, things: &[Thing]) -> Mask {
        let known = &self.views[sight.view];
        Mask::from_fn(image.width as u32, image.height as u32, |x, y| {
            let i = self.under(known, image, x as f32 + 0.5, y as f32 + 0.5);
            things.iter().any(|&t| self.holds(sight, t, i))
        })
    }

    /// The mask with a boundary that wanders by up to `wobble` pixels, scored by what it lost.
    fn wandering(&self, sight: RecognisedView, image: &Image, things: &[Thing], rng: &mut Rng) -> ScoredMask {
        let exact = self.exact_mask(sight, image, things);
        let reach = self.options.wobble * rng.unit();
        let offset = rng.triple(0.0, 100.0);
        if reach <= 0.0 {
            return ScoredMask { mask: exact, predicted_iou: 1.0, stability: 1.0 };
        }
        let (w, h) = (exact.width() as f32, exact.height() as f32);
        let mask = Mask::from_fn(exact.width(), exact.height(), |x, y| {
            let p = Vec3::new(x as f32, y as f32, 0.0) / 11.0 + offset;
            let push = |q: Vec3| (noise(q) - 0.5) * 2.0 * reach;
            // An object cut off by the frame stays cut off by it.
            let u = (x as f32 + 0.5 + push(p)).clamp(0.0, w - 0.5);
            let v = (y as f32 + 0.5 + push(p + 31.0)).clamp(0.0, h - 0.5);
            exact.at(u, v)
        });
        let iou = mask.iou(&exact) as f32;
        ScoredMask { mask, predicted_iou: iou, stability: 0.5 + 0.5 * iou }
    }

    /// The thing that touches another most, among those of its kind.
    fn neighbour(&self, sight: RecognisedView, thing: Thing) -> Option<Thing> {
        let known = &self.views[sight.view];
        let (ids, id) = match thing {
            Thing::Instance(id) => (&known.instances, id),
            Thing::Part(id) => (&known.parts, id),
            Thing::Transient(_) => return None,
        };
        let mut contact: BTreeMap<u16, usize> = BTreeMap::new();
        let mut touch = |a: u16, b: u16| {
            if a == id && b != id && b != 0 {
                *contact.entry(b).or_default() += 1;
            }
        };
        for y in 0..known.height {
            for x in 0..known.width {
                let i = y * known.width + x;
                let right = (x + 1 < known.width).then_some(i + 1);
                let below = (y + 1 < known.height).then_some(i + known.width);
                for j in right.into_iter().chain(below) {
                    touch(ids[i], ids[j]);
                    touch(ids[j], ids[i]);
                }
            }
        }
        let most = contact.into_iter().max_by_key(|&(id, n)| (n, std::cmp::Reverse(id)))?;
        Some(if matches!(thing, Thing::Part(_)) { Thing::Part(most.0) } else { Thing::Instance(most.0) })
    }

    /// The faults of a thing's mask in a view: the same at every request.
    fn faults(&self, sight: RecognisedView, thing: Thing) -> Rng {
        let (kind, id) = match thing {
            Thing::Instance(id) => (1, u64::from(id)),
            Thing::Part(id) => (2, u64::from(id)),
            Thing::Transient(id) => (3, u64::from(id)),
        };
        Rng::new(self.options.seed, (sight.view as u64) << 40 | kind << 36 | id)
    }

    fn thing_at(&self, sight: RecognisedView, image: &Image, x: f32, y: f32, fine: bool) -> Thing {
        let known = &self.views[sight.view];
        let i = self.under(known, image, x, y);
        if sight.transients && known.transients[i] != 0 {
            Thing::Transient(known.transients[i])
        } else if fine {
            Thing::Part(known.parts[i])
        } else {
            Thing::Instance(known.instances[i])
        }
    }
}

impl MaskProposer for Oracle {
    fn key(&self) -> String {
        self.key.clone()
    }

    fn propose(&self, image: &Image, points: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
        let sight = self.recognise(image)?;
        let mut things = BTreeSet::new();
        for &[x, y] in points {
            let inside = x >= 0.0 && y >= 0.0 && x < image.width as f32 && y < image.height as f32;
            if inside {
                things.insert(self.thing_at(sight, image, x, y, false));
                things.insert(self.thing_at(sight, image, x, y, true));
            }
        }
        let mut masks: Vec<ScoredMask> = Vec::new();
        for thing in things {
            let mut rng = self.faults(sight, thing);
            let (dropped, merged) = (rng.chance(self.options.drop), rng.chance(self.options.merge));
            if dropped {
                continue;
            }
            let mut together = vec![thing];
            if merged {
                together.extend(self.neighbour(sight, thing));
            }
            let mask = self.wandering(sight, image, &together, &mut rng);
            if !mask.mask.is_empty() {
                masks.push(mask);
            }
        }
        Ok(masks)
    }
}

impl PromptSegmenter for Oracle {
    fn key(&self) -> String {
        self.key.clone()
    }

    fn prompted(&self, image: &Image, prompts: &Prompts) -> Result<Prompted, VisionError> {
        let sight = self.recognise(image)?;
        let fine = prompts.granularity.is_some_and(|g| g < FINE);
        let known = &self.views[sight.view];
        let at = |x: f32, y: f32| self.under(known, image, x, y);
        let mut things = BTreeSet::new();
        for p in prompts.points.iter().filter(|p| p.inside) {
            things.insert(self.thing_at(sight, image, p.x, p.y, fine));
        }
        for b in &prompts.boxes {
            let (x0, x1) = (b.x0.min(b.x1), b.x0.max(b.x1));
            let (y0, y1) = (b.y0.min(b.y1), b.y0.max(b.y1));
            things.extend(self.boxed(sight, image, [x0, y0, x1, y1], fine));
        }
        if things.is_empty() {
            return Err(VisionError::Image(
                "the prompts name nothing: give a click inside the object or a box".into(),
            ));
        }
        let things: Vec<Thing> = things.into_iter().collect();
        let mut rng = self.faults(sight, things[0]);
        let mut found = self.wandering(sight, image, &things, &mut rng);
        // What a negative click lies on goes: its part if a positive click keeps the instance, all of it otherwise.
        for p in prompts.points.iter().filter(|p| !p.inside) {
            let i = at(p.x, p.y);
            let whole = self.thing_at(sight, image, p.x, p.y, false);
            let shared = prompts.points.iter().any(|q| q.inside && self.holds(sight, whole, at(q.x, q.y)));
            let out = if shared { Thing::Part(known.parts[i]) } else { whole };
            found.mask = found.mask.minus(&self.exact_mask(sight, image, &[out]));
        }
        Ok(Prompted::sure(found))
    }

    fn refine(&self, image: &Image, certainty: &Image) -> Result<ScoredMask, VisionError> {
        let sight = self.recognise(image)?;
        if (certainty.width, certainty.height, certainty.channels) != (image.width, image.height, 1) {
            return Err(VisionError::Image(format!(
                "the certainty is {}x{} with {} planes, the image {}x{}",
                certainty.width, certainty.height, certainty.channels, image.width, image.height
            )));
        }
        let known = &self.views[sight.view];
        let mut parts: BTreeMap<u16, (f64, usize)> = BTreeMap::new();
        for y in 0..image.height {
            for x in 0..image.width {
                let i = self.under(known, image, x as f32 + 0.5, y as f32 + 0.5);
                if known.transients[i] != 0 && sight.transients {
                    continue; // they hide what the certainty is about
                }
                let c = certainty.at(0, x, y);
                let entry = parts.entry(known.parts[i]).or_default();
                entry.0 += if c.is_finite() { f64::from(c) } else { 0.5 };
                entry.1 += 1;
            }
        }
        let mut wholes: BTreeMap<u16, (f64, usize)> = BTreeMap::new();
        for (&part, &(sum, n)) in &parts {
            let entry = wholes.entry(self.instance_of[usize::from(part)]).or_default();
            (entry.0, entry.1) = (entry.0 + sum, entry.1 + n);
        }
        // A part that is known decides for itself; one that is open goes with what is known of its whole.
        let mean = |(sum, n): (f64, usize)| sum / n as f64;
        let things: Vec<Thing> = parts
            .iter()
            .filter(|(id, part)| {
                let whole = wholes[&self.instance_of[usize::from(**id)]];
                let (part, whole) = (mean(**part), mean(whole));
                part > KNOWN[1] || (part > KNOWN[0] && whole > KNOWN[1])
            })
            .map(|(&id, _)| Thing::Part(id))
            .collect();
        if things.is_empty() {
            return Err(VisionError::Image("nothing in this image is known to belong to the object".into()));
        }
        let mut rng = self.faults(sight, things[0]);
        Ok(self.wandering(sight, image, &things, &mut rng))
    }
}

impl SkyDetector for Oracle {
    fn key(&self) -> String {
        self.key.clone()
    }

    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        let sight = self.recognise(image)?;
        Ok(self.exact_mask(sight, image, &[Thing::Instance(0)]))
    }
}

impl Oracle {
    /// The thing whose seen extent fits a box best.
    fn boxed(
        &self,
        sight: RecognisedView,
        image: &Image,
        [x0, y0, x1, y1]: [f32; 4],
        fine: bool,
    ) -> Option<Thing> {
        let known = &self.views[sight.view];
        let mut extents: BTreeMap<Thing, [f32; 4]> = BTreeMap::new();
        for y in 0..image.height {
            for x in 0..image.width {
                let (u, v) = (x as f32, y as f32);
                let i = self.under(known, image, u + 0.5, v + 0.5);
                let thing =
                    if fine { Thing::Part(known.parts[i]) } else { Thing::Instance(known.instances[i]) };
                let e = extents.entry(thing).or_insert([u, v, u + 1.0, v + 1.0]);
                *e = [e[0].min(u), e[1].min(v), e[2].max(u + 1.0), e[3].max(v + 1.0)];
            }
        }
        let area = |e: [f32; 4]| (e[2] - e[0]).max(0.0) * (e[3] - e[1]).max(0.0);
        let fit = |e: [f32; 4]| {
            let both = area([e[0].max(x0), e[1].max(y0), e[2].min(x1), e[3].min(y1)]);
            both / (area(e) + area([x0, y0, x1, y1]) - both).max(1e-6)
        };
        let best = extents.into_iter().max_by(|a, b| fit(a.1).total_cmp(&fit(b.1)).then(b.0.cmp(&a.0)))?;
        (fit(best.1) > 0.0).then_some(best.0)
    }
}

fn digest(image: &Image) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&(image.width as u64).to_le_bytes());
    hasher.update(&(image.height as u64).to_le_bytes());
    for value in &image.data {
        hasher.update(&value.to_le_bytes());
    }
    *hasher.finalize().as_bytes()
}

/// Brightness and its slopes on a coarse grid, of mean 0 and length 1: alike for two images of one view in
/// different light.
fn thumbnail(image: &Image) -> Vec<f32> {
    const N: usize = THUMBNAIL;
    let small = image.resized(N, N);
    let finite = |v: f32| if v.is_finite() { v } else { 0.0 };
    let grey: Vec<f32> =
        (0..N * N).map(|i| (0..3).map(|c| finite(small.data[c * N * N + i])).sum()).collect();
    let unit = |mut v: Vec<f32>| {
        let mean = v.iter().sum::<f32>() / v.len() as f32;
        v.iter_mut().for_each(|x| *x -= mean);
        let length = v.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-6);
        v.iter_mut().for_each(|x| *x /= length * std::f32::consts::SQRT_2);
        v
    };
    let slope = |i: usize, step: usize, inside: bool| if inside { grey[i + step] - grey[i] } else { 0.0 };
    let slopes = (0..N * N).flat_map(|i| [slope(i, 1, i % N + 1 < N), slope(i, N, i / N + 1 < N)]).collect();
    let mut out = unit(grey.clone());
    out.extend(unit(slopes));
    out
}
