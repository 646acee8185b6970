//! What a model sees of each group that a text may describe: an embedding per group, kept in the run's cache.

use super::crop::crop;
use super::prompts::negatives;
use crate::RunError;
use crate::artifacts::cache::DESCRIBED;
use crate::output::objects::{ListRequest, SHOWS, whole_pixels};
use segwild_flow::{Cache, Key, Stopper, lock};
use segwild_scene::{Image, Mask};
use segwild_segmenter::scene_tree::{GroupCandidate, LeafMap, SceneTree, ShownPixels};
use segwild_vision::{TextEmbedder, VisionError};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard};
use wincode::{SchemaRead, SchemaWrite};

/// Raised when the bytes of a record of the same input change.
const FORMAT: u32 = 2;

/// Photos per group at most (docs/method.md, section 13.1). By choice: more of them show the same.
const MOST_PHOTOS: usize = 3;
/// Crops in memory together.
const AT_ONCE: usize = 16;

/// A group with its embedding.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct DescribedGroup {
    /// Number of its tree, and its node.
    pub tree: u32,
    /// See [`DescribedGroup::tree`].
    pub node: u32,
    /// Expected IoU with a thing that a person would click.
    pub score: f32,
    /// Its share of the light that all photos see.
    pub area: f32,
    /// Its number in the scene's list of objects; 0 where it is not listed.
    pub object: u32,
    /// Views that show it best, the best one first.
    pub views: Vec<u32>,
    /// The mean of its crops' embeddings, a unit vector.
    pub embedding: Vec<f32>,
}

/// The groups of a scene with their embeddings by one model.
#[derive(Clone, Debug, Default, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct DescribedGroups {
    /// Those that show in a photo.
    pub groups: Vec<DescribedGroup>,
    /// Embeddings of the texts that describe anything, unit vectors as long as those of the groups.
    pub negatives: Vec<Vec<f32>>,
}

impl DescribedGroup {
    /// It as a candidate of a query.
    pub fn candidate(&self) -> GroupCandidate {
        let nodes = vec![(self.tree as usize, self.node)];
        GroupCandidate { nodes, score: self.score, area: self.area }
    }
}

impl DescribedGroups {
    /// Whether they are of this tree and so many views: they may have been read from a file.
    fn fit(&self, tree: &SceneTree, views: usize) -> bool {
        let dims = self.negatives.first().map_or(0, Vec::len);
        let sound = |embedding: &Vec<f32>| embedding.len() == dims && embedding.iter().all(|v| v.is_finite());
        let of_texts = self.negatives.len() == negatives().len() && self.negatives.iter().all(sound);
        of_texts
            && self.groups.iter().all(|group| {
                let nodes = tree.trees.get(group.tree as usize).map_or(0, |tree| tree.merges.len());
                (group.node as usize) < nodes
                    && !group.views.is_empty()
                    && group.views.iter().all(|&view| (view as usize) < views)
                    && sound(&group.embedding)
            })
    }

    /// Refuses embeddings of texts whose length is not that of the groups': they cannot be compared.
    pub fn fit_texts(&self, texts: &[Vec<f32>]) -> Result<(), VisionError> {
        let groups = || self.groups.iter().map(|group| group.embedding.len());
        let lengths = || groups().chain(self.negatives.iter().map(Vec::len));
        for text in texts {
            if let Some(images) = lengths().find(|length| *length != text.len()) {
                return Err(VisionError::EmbeddingLengths { texts: text.len(), images });
            }
        }
        Ok(())
    }
}

/// What is embedded of a scene so far, kept by its session: a query that is cancelled leaves it to the next one.
#[derive(Default)]
pub(crate) struct PartlyDescribed(Mutex<EmbeddedViews>);

/// The embeddings of some views' crops.
#[derive(Default)]
struct EmbeddedViews {
    /// Key of the groups that are described.
    key: Option<Key>,
    /// Per group, the photos that show it best, once they are found.
    best: Option<Arc<Vec<BestPhotos>>>,
    /// By view.
    views: BTreeMap<usize, Arc<EmbeddedCrops>>,
}

/// Groups by their numbers, with the embeddings of their crops from one view.
type EmbeddedCrops = Vec<(usize, Vec<f32>)>;

impl PartlyDescribed {
    /// What is known of the groups of a key; nothing is where it was another one.
    fn of(&self, key: &Key) -> MutexGuard<'_, EmbeddedViews> {
        let mut views = lock(&self.0);
        if views.key.as_ref() != Some(key) {
            *views = EmbeddedViews { key: Some(*key), ..EmbeddedViews::default() };
        }
        views
    }
}

/// What groups are embedded from.
pub(crate) struct DescribeRequest<'a> {
    /// The scene with its tree.
    pub scene: ListRequest<'a>,
    /// The model.
    pub embedder: &'a dyn TextEmbedder,
    /// Reads the transient masks of the views: what they occlude is not cropped.
    pub transients: &'a dyn Fn(usize) -> Option<Mask>,
    /// What they are: a part of the key.
    pub transients_digest: String,
    /// What an earlier query that was cancelled has embedded.
    pub so_far: &'a PartlyDescribed,
}

/// The photos in which a group shows best: pixels that count, and the view.
type BestPhotos = Vec<(u32, usize)>;

impl DescribeRequest<'_> {
    /// Reads the embeddings from the cache, or makes them.
    ///
    /// # Errors
    /// When the scene cannot be rendered, the model fails, the cache cannot be read, or `stopper` stops it.
    pub fn groups(&self, cache: &Cache, stopper: &Stopper) -> Result<DescribedGroups, RunError> {
        let ListRequest { tree, key, .. } = &self.scene;
        let model = self.embedder.key()?;
        let key = Key::of(DESCRIBED)
            .value("format", FORMAT)
            .part("tree", key)
            .part("model", model)
            .part("transients", &self.transients_digest)
            .part("negatives", negatives().join("\n"))
            .finish();
        let kept = cache.get_typed::<DescribedGroups>(&key, DESCRIBED)?;
        if let Some(kept) = kept.filter(|kept| kept.fit(tree, self.scene.scene().views.len())) {
            return Ok(kept);
        }
        let (made, unread) = self.describe(&key, stopper)?;
        if unread > 0 {
            tracing::warn!(
                "{unread} photos cannot be read: groups are described without them, until they can be read again"
            );
            return Ok(made);
        }
        match cache.put_typed(&key, DESCRIBED, &made) {
            Ok(()) => *self.so_far.of(&key) = EmbeddedViews::default(),
            Err(error) => tracing::warn!("embeddings of groups are kept by this session alone: {error}"),
        }
        Ok(made)
    }

    /// The groups, and the number of photos that could not be read: they show nothing.
    fn describe(&self, key: &Key, stopper: &Stopper) -> Result<(DescribedGroups, usize), RunError> {
        let tree = self.scene.tree;
        let groups = tree.describable();
        let known = self.so_far.of(key).best.clone();
        let best = match known {
            Some(best) => best,
            None => {
                let best = Arc::new(self.best_photos(&groups, stopper)?);
                self.so_far.of(key).best = Some(best.clone());
                best
            }
        };
        let views: BTreeSet<usize> = best.iter().flatten().map(|(_, view)| *view).collect();
        let mut sums: Vec<Vec<f64>> = vec![Vec::new(); groups.len()];
        let mut unread = BTreeSet::new();
        for view in views {
            let known = self.so_far.of(key).views.get(&view).cloned();
            let embedded = match known {
                Some(embedded) => embedded,
                None => {
                    let Ok(photo) = self.scene.photos.read(view) else {
                        unread.insert(view);
                        continue;
                    };
                    let embedded = Arc::new(self.embedded(view, &photo.image, &groups, &best, stopper)?);
                    self.so_far.of(key).views.insert(view, embedded.clone());
                    embedded
                }
            };
            for (i, embedding) in embedded.iter() {
                sums[*i].resize(embedding.len(), 0.0);
                sums[*i].iter_mut().zip(embedding).for_each(|(sum, v)| *sum += f64::from(*v));
            }
        }
        let listed = tree.parts().groups.len();
        let described =
            groups.iter().zip(&sums).zip(best.iter()).enumerate().filter_map(|(i, ((group, sum), best))| {
                let (tree, node) = group.nodes[0];
                Some(DescribedGroup {
                    tree: tree as u32,
                    node,
                    score: group.score,
                    area: group.area,
                    // The parts of the scene come first, in the order of the list.
                    object: if i < listed { i as u32 + 1 } else { 0 },
                    views: best
                        .iter()
                        .map(|(_, view)| *view)
                        .filter(|view| !unread.contains(view))
                        .map(|view| view as u32)
                        .collect(),
                    embedding: unit(sum)?,
                })
            });
        let groups = described.collect();
        let described = DescribedGroups { groups, negatives: self.embedder.embed_texts(&negatives())? };
        described.fit_texts(&described.negatives)?;
        Ok((described, unread.len()))
    }

    /// The embeddings of the crops of the groups that a view is among the best of.
    fn embedded(
        &self,
        view: usize,
        photo: &Image,
        groups: &[GroupCandidate],
        best: &[BestPhotos],
        stopper: &Stopper,
    ) -> Result<EmbeddedCrops, RunError> {
        let tree = self.scene.tree;
        let map = self.map(view)?;
        let shown: Vec<usize> =
            (0..groups.len()).filter(|&i| best[i].iter().any(|(_, of)| *of == view)).collect();
        let mut embedded = EmbeddedCrops::new();
        for some in shown.chunks(AT_ONCE) {
            RunError::unless_running(stopper)?;
            let crop_of = |&i: &usize| Some((i, crop(photo, &map.mask(&tree.leaves_of(&groups[i])))?));
            let (of, crops): (Vec<usize>, Vec<Image>) = some.iter().filter_map(crop_of).unzip();
            embedded.extend(of.into_iter().zip(self.embedder.embed_images(&crops)?));
        }
        Ok(embedded)
    }

    /// The leaves that a photo shows, without its transients.
    fn map(&self, view: usize) -> Result<LeafMap, RunError> {
        let ListRequest { engine, model, tree, .. } = &self.scene;
        let (options, posed) = (model.options(), self.scene.posed(view));
        let mut map = LeafMap::render(engine, &model.splats, &options, &posed, tree)?;
        if let Some(transients) = (self.transients)(view) {
            map.leave_out(&transients);
        }
        Ok(map)
    }

    /// Per group, the photos of the training that show it best.
    fn best_photos(&self, groups: &[GroupCandidate], stopper: &Stopper) -> Result<Vec<BestPhotos>, RunError> {
        let mut best = vec![BestPhotos::new(); groups.len()];
        for (view, _) in self.scene.scene().views.iter().enumerate().filter(|(_, view)| !view.test) {
            RunError::unless_running(stopper)?;
            let shown = self.map(view)?.shown(self.scene.tree, groups);
            for (best, ShownPixels { all, on_frame }) in best.iter_mut().zip(shown) {
                let whole = whole_pixels(all, on_frame);
                if whole >= SHOWS {
                    best.push((whole, view));
                }
            }
        }
        for best in &mut best {
            // Of equal photos the first counts.
            best.sort_by_key(|(pixels, view)| (u32::MAX - pixels, *view));
            best.truncate(MOST_PHOTOS);
        }
        Ok(best)
    }
}

/// A vector at length 1; `None` where it has no direction.
fn unit(sum: &[f64]) -> Option<Vec<f32>> {
    let length = sum.iter().map(|v| v * v).sum::<f64>().sqrt();
    (length > 0.0 && length.is_finite()).then(|| sum.iter().map(|v| (v / length) as f32).collect())
}
