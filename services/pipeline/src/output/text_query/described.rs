//! What a model sees of each group that a text may describe: an embedding per group, kept in the run's cache.

use super::crop::crop;
use crate::RunError;
use crate::output::objects::{ListRequest, SHOWS, whole_pixels};
use segwild_flow::{Cache, Key, Phase, Stopper};
use segwild_scene::{Image, Mask};
use segwild_segmenter::scene_tree::{GroupCandidate, LeafMap, SceneTree, ShownPixels};
use segwild_vision::TextEmbedder;
use std::collections::BTreeSet;
use wincode::{SchemaRead, SchemaWrite};

/// Their domain in the cache, and the kind of their record.
const DESCRIBED: &str = "described";
/// Raised when the bytes of a record of the same input change.
const FORMAT: u32 = 1;

/// Photos per group at most. By choice: more of them show the same.
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
        let dims = self.groups.first().map_or(0, |group| group.embedding.len());
        self.groups.iter().all(|group| {
            let nodes = tree.trees.get(group.tree as usize).map_or(0, |tree| tree.merges.len());
            (group.node as usize) < nodes
                && !group.views.is_empty()
                && group.views.iter().all(|&view| (view as usize) < views)
                && group.embedding.len() == dims
                && group.embedding.iter().all(|v| v.is_finite())
        })
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
        let key = Key::of(DESCRIBED).value("format", FORMAT).part("tree", key).part("model", model).finish();
        let kept = cache.get_typed::<DescribedGroups>(&key, DESCRIBED)?;
        if let Some(kept) = kept.filter(|kept| kept.fit(tree, self.scene.scene().views.len())) {
            return Ok(kept);
        }
        let made = self.describe(stopper)?;
        if let Err(error) = cache.put_typed(&key, DESCRIBED, &made) {
            tracing::warn!("embeddings of groups are not kept, so that each text makes them again: {error}");
        }
        Ok(made)
    }

    fn describe(&self, stopper: &Stopper) -> Result<DescribedGroups, RunError> {
        let tree = self.scene.tree;
        let groups = tree.describable();
        let best = self.best_photos(&groups, stopper)?;
        let views: BTreeSet<usize> = best.iter().flatten().map(|(_, view)| *view).collect();
        let mut sums: Vec<Vec<f64>> = vec![Vec::new(); groups.len()];
        for view in views {
            // A photo that can no longer be read shows nothing.
            let Ok(photo) = self.scene.photos.read(view) else { continue };
            let map = self.map(view)?;
            let shown: Vec<usize> =
                (0..groups.len()).filter(|&i| best[i].iter().any(|(_, of)| *of == view)).collect();
            for some in shown.chunks(AT_ONCE) {
                if stopper.phase() != Phase::Running {
                    return Err(RunError::Interrupted);
                }
                let crop_of =
                    |&i: &usize| Some((i, crop(&photo.image, &map.mask(&tree.leaves_of(&groups[i])))?));
                let (of, crops): (Vec<usize>, Vec<Image>) = some.iter().filter_map(crop_of).unzip();
                for (i, embedding) in of.into_iter().zip(self.embedder.embed_images(&crops)?) {
                    sums[i].resize(embedding.len(), 0.0);
                    sums[i].iter_mut().zip(&embedding).for_each(|(sum, v)| *sum += f64::from(*v));
                }
            }
        }
        let listed = tree.parts().groups.len();
        let described =
            groups.iter().zip(&sums).zip(&best).enumerate().filter_map(|(i, ((group, sum), best))| {
                let (tree, node) = group.nodes[0];
                Some(DescribedGroup {
                    tree: tree as u32,
                    node,
                    score: group.score,
                    area: group.area,
                    // The parts of the scene come first, in the order of the list.
                    object: if i < listed { i as u32 + 1 } else { 0 },
                    views: best.iter().map(|(_, view)| *view as u32).collect(),
                    embedding: unit(sum)?,
                })
            });
        Ok(DescribedGroups { groups: described.collect() })
    }

    /// The leaves that a photo shows, without its transients.
    fn map(&self, view: usize) -> Result<LeafMap, RunError> {
        let ListRequest { model, tree, .. } = &self.scene;
        let mut map = LeafMap::render(&model.splats, &model.options(), &self.scene.posed(view), tree)?;
        if let Some(transients) = (self.transients)(view) {
            map.leave_out(&transients);
        }
        Ok(map)
    }

    /// Per group, the photos of the training that show it best.
    fn best_photos(&self, groups: &[GroupCandidate], stopper: &Stopper) -> Result<Vec<BestPhotos>, RunError> {
        let mut best = vec![BestPhotos::new(); groups.len()];
        for (view, _) in self.scene.scene().views.iter().enumerate().filter(|(_, view)| !view.test) {
            if stopper.phase() != Phase::Running {
                return Err(RunError::Interrupted);
            }
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
