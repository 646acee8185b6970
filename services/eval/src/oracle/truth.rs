//! The truth of a set, and which of its views an image shows.

use super::options::OracleOptions;
use segwild_scene::Image;
use segwild_synthetic::SyntheticScene;
use segwild_vision::VisionError;
use std::collections::HashMap;

/// The truth of one photo.
pub(super) struct ViewTruth {
    pub width: usize,
    pub height: usize,
    pub instances: Vec<u16>,
    pub parts: Vec<u16>,
    /// Transients, one number each; 0 where there is none.
    pub transients: Vec<u32>,
    pub likeness: [Vec<f32>; 2],
}

/// What an image was recognised as.
#[derive(Clone, Copy)]
pub(super) struct RecognisedView {
    pub view: usize,
    pub transients: bool,
}

/// A thing that can have a mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Thing {
    Instance(u16),
    Part(u16),
    Transient(u32),
}

/// All four kinds of provider over one set.
pub struct Oracle {
    pub(super) options: OracleOptions,
    pub(super) views: Vec<ViewTruth>,
    exact: HashMap<[u8; 32], RecognisedView>,
    pub(super) instance_of: Vec<u16>,
    /// Per instance, whether it is one of the built things.
    pub(super) built: Vec<bool>,
    pub(super) key: String,
}

/// Side of the thumbnails by which images are compared.
const THUMBNAIL: usize = 24;
/// Least correlation at which a render counts as a view of the set.
const LIKE: f32 = 0.45;

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

    pub(super) fn recognise(&self, image: &Image) -> Result<RecognisedView, VisionError> {
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
    pub(super) fn under(&self, known: &ViewTruth, image: &Image, x: f32, y: f32) -> usize {
        let scale =
            |v: f32, from: usize, to: usize| ((v / from as f32 * to as f32).max(0.0) as usize).min(to - 1);
        scale(y, image.height, known.height) * known.width + scale(x, image.width, known.width)
    }

    pub(super) fn holds(&self, sight: RecognisedView, thing: Thing, i: usize) -> bool {
        let known = &self.views[sight.view];
        let covered = sight.transients && known.transients[i] != 0;
        match thing {
            Thing::Instance(id) => !covered && known.instances[i] == id,
            Thing::Part(id) => !covered && known.parts[i] == id,
            Thing::Transient(id) => sight.transients && known.transients[i] == id,
        }
    }

    pub(super) fn thing_at(&self, sight: RecognisedView, image: &Image, x: f32, y: f32, fine: bool) -> Thing {
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
