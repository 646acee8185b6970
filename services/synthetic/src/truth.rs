//! The manifest of a set, `truth.json`: collected photo by photo, without their pixels.

use crate::options::SyntheticOptions;
use crate::photo::SyntheticPhoto;
use crate::scene::SyntheticScene;
use crate::world::{Instance, ObjectKind, WorldPart};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;

/// The contents of `truth.json`: how a set was made, its photos, and what they show.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// The options that it was made with.
    pub options: SyntheticOptions,
    /// The photos, in order.
    pub photos: Vec<PhotoTruth>,
    /// The named things; an id is an index, 0 is the sky.
    pub instances: Vec<Instance>,
    /// The parts; an id is an index, 0 is the sky.
    pub parts: Vec<WorldPart>,
    /// The instances with masks in `truth/<name>/`, in the order of their ids.
    pub objects: Vec<ObjectTruth>,
}

/// One photo in `truth.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhotoTruth {
    /// File name.
    pub name: String,
    /// Whether it is held out.
    pub test: bool,
    /// Whether it was taken from the front.
    pub front: bool,
    /// Share of its pixels that transients touch.
    pub covered: f32,
}

/// One instance in `truth.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ObjectTruth {
    /// Its id.
    pub id: u16,
    /// Its name.
    pub name: String,
    /// What it is good for.
    pub kind: ObjectKind,
    /// Photos to click on it, the best first, at most [`CLICKS`].
    pub clicks: Vec<Click>,
}

/// A click deep inside an object.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Click {
    /// The photo.
    pub photo: String,
    /// Pixel position, x.
    pub x: f32,
    /// Pixel position, y.
    pub y: f32,
    /// Pixels of the object that the photo shows.
    pub visible: usize,
}

/// Most clicks that `truth.json` gives for an object.
pub const CLICKS: usize = 6;

/// Share of what a photo shows of an object that transients must leave uncovered for the photo to show it well.
const UNCOVERED: f32 = 0.9;

/// Collects [`Manifest`] photo by photo.
#[derive(Clone, Serialize, Deserialize)]
pub struct TruthBuilder {
    instances: Vec<Instance>,
    photos: Vec<PhotoTruth>,
    /// Of each instance but the sky.
    rankings: Vec<ClickRanking>,
}

impl TruthBuilder {
    /// Of a set with these instances, before its first photo.
    pub fn new(instances: &[Instance]) -> TruthBuilder {
        let rankings = instances.iter().skip(1).map(|_| ClickRanking::default()).collect();
        TruthBuilder { instances: instances.to_vec(), photos: Vec::new(), rankings }
    }

    /// Whether its parts fit together: it may have been read from a file.
    pub fn is_sound(&self) -> bool {
        let is_listed =
            |(_, click): &(bool, Click)| self.photos.iter().any(|photo| photo.name == click.photo);
        // Ids have 8 bits, and 0 is the sky.
        (1..=usize::from(u8::MAX) + 1).contains(&self.instances.len())
            && self.rankings.len() + 1 == self.instances.len()
            && self
                .rankings
                .iter()
                .all(|ranking| ranking.0.len() <= CLICKS && ranking.0.iter().all(is_listed))
    }

    /// The instances of the set.
    pub fn instances(&self) -> &[Instance] {
        &self.instances
    }

    /// Names of the photos that were added, in order.
    pub fn photo_names(&self) -> impl ExactSizeIterator<Item = &str> {
        self.photos.iter().map(|photo| photo.name.as_str())
    }

    /// Adds the next photo.
    pub fn add(&mut self, photo: &SyntheticPhoto) {
        self.photos.push(PhotoTruth {
            name: photo.name.clone(),
            test: photo.test,
            front: photo.front,
            covered: photo.transients.count() as f32 / photo.instances.len() as f32,
        });
        let ids = 1..self.instances.len() as u16;
        let shown = ids.clone().into_par_iter().map(|id| shown_instance(photo, id));
        let shown: Vec<Option<ShownInstance>> = shown.collect();
        // One after the other: the search for a click takes more memory than the photo has pixels.
        for ((id, shown), ranking) in ids.zip(shown).zip(&mut self.rankings) {
            if let Some(shown) = shown {
                ranking.add(photo, id, shown);
            }
        }
    }

    /// The manifest of the photos that were added.
    pub fn manifest(self, options: &SyntheticOptions, parts: &[WorldPart]) -> Manifest {
        let named = self.instances.iter().skip(1).zip(self.rankings).enumerate();
        let objects = named.map(|(i, (instance, ranking))| ObjectTruth {
            id: i as u16 + 1,
            name: instance.name.clone(),
            kind: instance.kind,
            clicks: ranking.into_clicks(),
        });
        Manifest {
            options: options.clone(),
            photos: self.photos,
            objects: objects.collect(),
            parts: parts.to_vec(),
            instances: self.instances,
        }
    }
}

impl SyntheticScene {
    /// The contents of the set's `truth.json`.
    pub fn manifest(&self) -> Manifest {
        let mut truth = TruthBuilder::new(&self.instances);
        self.photos.iter().for_each(|photo| truth.add(photo));
        truth.manifest(&self.options, &self.parts)
    }

    /// Clicks on an instance in the training photos that show it best: first those in which no part of it is out of
    /// the frame and transients cover little of it, the largest first, then the others.
    pub fn clicks(&self, instance: u16) -> Vec<Click> {
        let mut ranking = ClickRanking::default();
        for photo in &self.photos {
            if let Some(shown) = shown_instance(photo, instance) {
                ranking.add(photo, instance, shown);
            }
        }
        ranking.into_clicks()
    }
}

/// How a photo shows an instance that can be clicked there.
#[derive(Clone, Copy)]
struct ShownInstance {
    /// Whether no part of it is out of the frame and transients cover little of it.
    well: bool,
    /// Pixels that transients leave of it.
    visible: usize,
}

/// How a training photo shows an instance; `None` of test photos, and where fewer than one pixel in 250 are of the instance.
fn shown_instance(photo: &SyntheticPhoto, instance: u16) -> Option<ShownInstance> {
    if photo.test {
        return None;
    }
    let whole = photo.mask(instance);
    let visible = whole.minus(&photo.transients).count();
    if visible * 250 < photo.instances.len() {
        return None;
    }
    let (w, h) = (whole.width(), whole.height());
    let cut_off = whole.pixels().any(|(x, y)| x == 0 || y == 0 || x + 1 == w || y + 1 == h);
    let well = !cut_off && visible as f32 >= UNCOVERED * whole.count() as f32;
    Some(ShownInstance { well, visible })
}

/// The best clicks on an instance among the photos so far, at most [`CLICKS`]; with each whether its photo shows the instance
/// well.
#[derive(Clone, Default, Serialize, Deserialize)]
struct ClickRanking(Vec<(bool, Click)>);

impl ClickRanking {
    /// Adds the click into a photo, if it is among the best. Only then is it searched for.
    fn add(&mut self, photo: &SyntheticPhoto, instance: u16, ShownInstance { well, visible }: ShownInstance) {
        let ours = (well, visible, Reverse(photo.name.as_str()));
        let rank = self.0.partition_point(|(well, c)| (*well, c.visible, Reverse(c.photo.as_str())) > ours);
        if rank >= CLICKS {
            return;
        }
        if let Some([x, y]) = photo.click(instance) {
            self.0.insert(rank, (well, Click { photo: photo.name.clone(), x, y, visible }));
            self.0.truncate(CLICKS);
        }
    }

    fn into_clicks(self) -> Vec<Click> {
        self.0.into_iter().map(|(_, click)| click).collect()
    }
}
