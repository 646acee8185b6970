//! A set before its photos are taken, and its photos one by one: memory grows with their number, and not with their pixels.

use crate::error::SyntheticError;
use crate::layout::build;
use crate::options::SyntheticOptions;
use crate::photo::{PhotoRecord, SyntheticPhoto};
use crate::planned::PlannedPhoto;
use crate::points::{SyntheticPoint, reconstruct};
use crate::scene::SyntheticScene;
use crate::truth::Manifest;
use crate::world::SyntheticWorld;
use crate::write::SetWriter;
use rayon::prelude::*;
use std::ops::ControlFlow;
use std::path::Path;

/// A set before its photos are taken: the world, the cameras with the light and the transients of each photo, and the points.
/// [`crate::generate`] takes all of its photos at once.
///
/// ```
/// use segwild_synthetic::{SyntheticOptions, SyntheticPlan};
///
/// let options = SyntheticOptions { train: 3, test: 1, long_side: 48, points: 50, ..SyntheticOptions::small() };
/// let plan = SyntheticPlan::new(&options).unwrap();
/// // One photo is in memory at a time.
/// assert!(plan.photos().all(|photo| photo.photo.width.max(photo.photo.height) == 48));
/// ```
#[derive(Clone, Debug)]
pub struct SyntheticPlan {
    options: SyntheticOptions,
    world: SyntheticWorld,
    planned: Vec<PlannedPhoto>,
    points: Vec<SyntheticPoint>,
}

impl SyntheticPlan {
    /// Samples the set. For the colours of its points, the pixels that show them are traced.
    ///
    /// # Errors
    /// When an option is out of its range, or no camera position shows enough of the scene.
    pub fn new(options: &SyntheticOptions) -> Result<SyntheticPlan, SyntheticError> {
        options.check()?;
        let world = build(options.seed);
        let count = options.train + options.test;
        let mut ranks = [0, 0];
        let ranked = (0..count).map(|index| {
            let test = (index + 1) * options.test / count > index * options.test / count;
            let next = &mut ranks[usize::from(test)];
            *next += 1;
            (test, *next - 1)
        });
        let split: Vec<(bool, usize)> = ranked.collect();
        let sample = |index: usize| {
            let (test, rank) = split[index];
            PlannedPhoto::sample(&world, options, index, test, rank)
        };
        // The first that fails is the one that is reported, whichever thread is the fastest.
        let sampled: Vec<Result<_, _>> = (0..count).into_par_iter().map(sample).collect();
        let planned = sampled.into_iter().collect::<Result<Vec<PlannedPhoto>, SyntheticError>>()?;
        let points = reconstruct(&world, options, &planned);
        Ok(SyntheticPlan { options: options.clone(), world, planned, points })
    }

    /// Number of photos, at least 1.
    pub fn photo_count(&self) -> usize {
        self.planned.len()
    }

    /// The points a reconstruction of the photos would have.
    pub fn points(&self) -> &[SyntheticPoint] {
        &self.points
    }

    /// Takes a photo, by its index.
    ///
    /// # Panics
    /// When there are no more than `index` photos.
    pub fn photo(&self, index: usize) -> SyntheticPhoto {
        self.planned[index].take(&self.world, &self.options)
    }

    /// Takes the photos, in order, each when it is requested.
    pub fn photos(&self) -> impl Iterator<Item = SyntheticPhoto> + '_ {
        (0..self.photo_count()).map(move |index| self.photo(index))
    }

    /// The set in memory, of all of its photos, in order.
    pub fn with_photos(self, photos: Vec<SyntheticPhoto>) -> SyntheticScene {
        SyntheticScene {
            options: self.options,
            instances: self.world.instances.clone(),
            parts: self.world.parts.clone(),
            photos,
            points: self.points,
            world: self.world,
        }
    }

    /// Writes the files that [`SyntheticScene::write`] writes, photo by photo: each is taken while the one before it is written,
    /// and no third one is in memory. `report` receives how many are written after each, and may stop the rest. A folder in which
    /// the same set was stopped goes on after its last photo.
    ///
    /// # Errors
    /// When a file cannot be written, or `report` stops it. The reconstruction and `truth.json` are written last: what was stopped
    /// is no scene, unless the folder held the same one before.
    pub fn write(
        &self,
        dir: &Path,
        mut report: impl FnMut(usize) -> ControlFlow<()>,
    ) -> Result<Manifest, SyntheticError> {
        let records: Vec<PhotoRecord> = self.planned.iter().map(|p| p.record.clone()).collect();
        let mut writer = SetWriter::new(dir, &self.options, &self.world.instances, &records)?;
        let count = self.photo_count();
        let take = |index: usize| (index < count).then(|| self.photo(index));
        let mut next = take(writer.written());
        while let Some(photo) = next.take() {
            let done = writer.written() + 1;
            let (written, taken) = rayon::join(|| writer.add(&photo), || take(done));
            written?;
            if report(done).is_break() && done < count {
                return Err(SyntheticError::Stopped { written: done, photos: count });
            }
            next = taken;
        }
        writer.finish(&self.world.parts, &self.points)
    }
}
