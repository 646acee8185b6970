//! A training by blocks: what starts a turn ([`crate::blocks`]). Everything else is a training like any other, on fewer
//! photos and with some splats frozen.

use crate::blocks::{Aabb, BlockPart, BlockTurns};
use crate::density::Strategy;
use crate::initial::first_splats;
use crate::sampler::Sampler;
use crate::schedule::Schedule;
use crate::trainer::Trainer;
use crate::{TrainError, TrainSettings};
use glam::Vec3;
use segwild_objective::AnyAppearance;
use segwild_scene::{Point, Scene, Splats, knn};
use std::sync::Arc;

/// Points that start splats in a block, at least: fewer show no surface.
const LEAST_POINTS: usize = 32;
/// The warning about a scene that has several blocks by the given settings, and one in fact.
const UNDIVIDED: &str =
    "the scene cannot be divided into blocks: its cameras and points are too few, or lie at one position";

impl Trainer {
    /// Divides the scene, where the settings name several blocks; `requested` is their number before it was decided
    /// ([`TrainSettings::decided`]). `given`: the scene with its poses as given; `points`: its points with their colours.
    pub(crate) fn divided(mut self, requested: usize, given: &Scene, points: &[Point]) -> Trainer {
        let TrainSettings { blocks, steps, .. } = self.settings;
        if blocks > 1 {
            self.blocks = BlockTurns::of(given, points, blocks, steps).map(Arc::new);
        }
        if self.blocks.is_none() {
            if requested > 1 {
                tracing::warn!("{UNDIVIDED}");
                self.warnings.push(UNDIVIDED.into());
            }
            self.settings.blocks = self.settings.blocks.min(1);
        }
        self
    }

    /// A warning about a training that goes on past its end up to step `until`, where some blocks get no step of it.
    pub(crate) fn unreached_in_words(&self, until: u32) -> Option<String> {
        let blocks = self.blocks.as_ref()?;
        let (left, all) = (blocks.unreached(self.state.step, until), blocks.division.blocks.len());
        let round = blocks.round();
        (left > 0).then(|| {
            format!(
                "the further steps come to {} of the {all} blocks, and the others stay as they are: a step for each \
                 photo of each block takes {round} steps",
                all - left
            )
        })
    }

    /// Leaves a turn none of whose photos can be used: its splats stay as they are, and its steps fit the other photos.
    /// False where no photo of any block can be used.
    pub(crate) fn leave_turn(&mut self) -> Result<bool, TrainError> {
        let Some(blocks) = self.blocks.clone() else { return Ok(false) };
        let views = self.usable(blocks.all_photos());
        if views.is_empty() {
            return Ok(false);
        }
        self.download()?;
        tracing::warn!("no photo of a block can be used: its splats stay as they are");
        let params = &mut self.state.params;
        let (marked, none) = (vec![false; params.splats.len()], params.splats.select(&[]));
        params.train_only(&marked, (&none, &[]));
        self.state.strategy = Strategy::new(&self.settings, 0);
        self.state.sampler = Sampler::new(&views);
        Ok(true)
    }

    /// Those of the views whose photos have not turned out to be unusable.
    fn usable(&self, mut views: Vec<usize>) -> Vec<usize> {
        views.retain(|&view| !self.state.is_skipped(&self.views[view].name));
        views
    }

    /// Whether appearance, background and pose of the photos stay as they are: as the coarse training of the whole
    /// scene left them, so that blocks do not differ in light.
    pub(crate) fn photos_are_fixed(&self) -> bool {
        self.turn.is_some_and(|turn| turn.part != BlockPart::Coarse)
    }

    /// Most splats that may be trained now.
    pub(crate) fn cap(&self) -> usize {
        let (most, params) = (self.state.splat_budget.splats(), &self.state.params);
        match (&self.blocks, self.turn.map(|turn| turn.part)) {
            (Some(blocks), Some(BlockPart::Block(block))) => {
                let frozen = params.splats.len() - params.trained();
                blocks.division.cap(block, most, frozen).max(1)
            }
            (Some(_), Some(BlockPart::Seams)) => params.trained(),
            (Some(_), Some(BlockPart::Coarse) | None) | (None, _) => self.settings.first_cap(most),
        }
    }

    /// The box in which splats may be removed for want of photos that need or support them; `None`: everywhere. Around
    /// the core of a block such photos may take part in another one.
    pub(crate) fn core(&self) -> Option<Aabb> {
        match (&self.blocks, self.turn.map(|turn| turn.part)) {
            (Some(blocks), Some(BlockPart::Block(block))) => Some(blocks.division.blocks[block].core),
            _ => None,
        }
    }

    /// Starts the turn of the coming step, where that is the first of it: its splats alone are trained from then on, on
    /// its photos.
    pub(crate) fn start_turn(&mut self) -> Result<(), TrainError> {
        let Some(blocks) = self.blocks.clone() else { return Ok(()) };
        let step = self.state.step;
        let turn = blocks.turn_at(step);
        self.turn = Some(turn);
        self.schedule = Schedule::of_turn(&self.settings, &turn);
        if turn.part == BlockPart::Coarse || turn.first != step {
            return Ok(());
        }
        self.download()?;
        let views = self.usable(blocks.photos(turn.part));
        if views.is_empty() && self.leave_turn()? {
            return Ok(());
        }
        let means = &self.state.params.splats.means;
        let marked: Vec<bool> = means.iter().map(|mean| blocks.trains(&turn, Vec3::from(*mean))).collect();
        let added = match turn.part {
            BlockPart::Block(block) if !turn.late => self.points_of_block(&blocks, block, &marked),
            BlockPart::Block(_) | BlockPart::Coarse | BlockPart::Seams => None,
        };
        let added = added.unwrap_or_else(|| self.state.params.splats.select(&[]));
        let appearance = self.state.appearance.as_appearance();
        let embeddings = match added.is_empty() {
            true => Vec::new(),
            false => appearance.first_embeddings(&added.means),
        };
        self.state.params.train_only(&marked, (&added, &embeddings[..]));
        let steps = if turn.late { self.settings.steps } else { turn.steps };
        let settings = TrainSettings { steps, ..self.settings.clone() };
        self.state.strategy = Strategy::new(&settings, self.state.params.trained());
        self.sample_photos(&views);
        // Photos grow finer from the coarse training to the blocks, and by new splats a block is to learn more of them.
        if !turn.late && !matches!(self.state.appearance, AnyAppearance::Gsw(_)) {
            self.state.pause_until = step + self.schedule.pause();
        }
        Ok(())
    }

    /// New splats at the points in the core of a block, where it has fewer splats than points and the splat budget
    /// allows more. Not for `gsw`, whose embeddings start from the extent of all splats.
    fn points_of_block(&self, blocks: &BlockTurns, block: usize, marked: &[bool]) -> Option<Splats> {
        if matches!(self.state.appearance, AnyAppearance::Gsw(_)) {
            return None;
        }
        let (points, core) = (&blocks.points[block], &blocks.division.blocks[block].core);
        let splats = &self.state.params.splats;
        let own = splats.means.iter().filter(|mean| core.contains(Vec3::from(**mean))).count();
        let trained = marked.iter().filter(|marked| **marked).count();
        let most = self.state.splat_budget.splats();
        let space = blocks.division.cap(block, most, splats.len() - trained).saturating_sub(trained);
        let count = points.len().saturating_sub(own).min(space);
        if count < LEAST_POINTS {
            return None;
        }
        let (positions, colours): (Vec<[f32; 3]>, Vec<[f32; 3]>) =
            (0..count).map(|i| points[i * points.len() / count]).unzip();
        let distances = knn::nearest(&positions, 3).mean_distances();
        Some(first_splats(positions, &colours, &vec![self.state.pixel; count], &distances, splats.sh_degree))
    }

    /// Trains on these photos from now on.
    fn sample_photos(&mut self, views: &[usize]) {
        // Whether growth pays is measured within the turn.
        views.iter().for_each(|&view| self.state.quality[view] = None);
        self.state.sampler = Sampler::new(views);
    }
}
