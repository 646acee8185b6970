//! Which part of a divided scene is trained when.

use super::division::Division;
use glam::Vec3;
use segwild_scene::{Point, Scene};

/// Shares of the steps for the coarse training of the whole scene, and for the seams at the end; the blocks share the
/// rest in proportion to their photos. By choice: each photo comes as often as in a training of the whole scene.
const COARSE: f32 = 0.25;
pub(crate) const SEAMS: f32 = 0.1;
/// Most of the steps that the coarse training takes to come to every photo.
const MOST_COARSE: f32 = 0.5;

/// A part of a divided scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BlockPart {
    /// All of it, by few splats on small photos. Photos learn their appearance, background and pose here, and keep
    /// them.
    Coarse,
    /// The block at this index, with its border.
    Block(usize),
    /// What lies in the border boxes of two blocks or more.
    Seams,
}

/// Steps in which one part is trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct BlockTurn {
    pub part: BlockPart,
    /// The first step of the turn, of the whole training.
    pub first: u32,
    /// Its steps.
    pub steps: u32,
    /// Whether it goes on at the end of the whole training's schedules. Otherwise it has schedules of its own.
    pub late: bool,
}

/// A divided scene with the turns of its training.
pub(crate) struct BlockTurns {
    pub division: Division,
    /// Per block, position and colour of the points in its core.
    pub points: Vec<Vec<([f32; 3], [f32; 3])>>,
    /// In ascending order; the first starts at step 0.
    turns: Vec<BlockTurn>,
    /// Steps of the whole training.
    steps: u32,
}

impl BlockTurns {
    /// The turns of a training of so many steps on a scene in `count` blocks, which start with these points; `None`
    /// where the scene cannot be divided.
    pub fn of(scene: &Scene, points: &[Point], count: usize, steps: u32) -> Option<BlockTurns> {
        let division = Division::of(scene, count);
        if division.blocks.len() < 2 {
            return None;
        }
        let photos = scene.views.iter().filter(|view| !view.test).count() as u32;
        let of = |share: f32| (steps as f32 * share) as u32;
        let coarse = of(COARSE).max(photos.min(of(MOST_COARSE))).max(1);
        let seams = of(SEAMS);
        let rest = u64::from(steps.saturating_sub(coarse + seams));
        let mut turns = vec![BlockTurn { part: BlockPart::Coarse, first: 0, steps: coarse, late: false }];
        let all: u64 = division.photos.iter().map(|photos| photos.len() as u64).sum();
        let (mut before, mut first) = (0, coarse);
        for (block, photos) in division.photos.iter().enumerate() {
            before += photos.len() as u64;
            let end = coarse + (rest * before / all.max(1)) as u32;
            turns.push(BlockTurn { part: BlockPart::Block(block), first, steps: end - first, late: false });
            first = end;
        }
        turns.push(BlockTurn { part: BlockPart::Seams, first, steps: seams, late: true });
        turns.retain(|turn| turn.steps > 0);
        let of_core = |block: usize| {
            let core = division.blocks[block].core;
            let own = points.iter().filter(|point| core.contains(point.position));
            own.map(|point| (point.position.to_array(), point.colour)).collect::<Vec<_>>()
        };
        let points = (0..division.blocks.len()).map(of_core).collect();
        Some(BlockTurns { points, division, turns, steps })
    }

    /// The turn of a step. After the last one blocks take turns of a step per photo, for as long as the training goes
    /// on.
    pub fn turn_at(&self, step: u32) -> BlockTurn {
        let photos = self.division.photos.iter().map(|photos| photos.len() as u32);
        let round: u32 = photos.clone().sum();
        if step >= self.steps && round > 0 {
            let at = (step - self.steps) % round;
            let mut first = step - at;
            for (block, steps) in photos.enumerate() {
                if step < first + steps {
                    return BlockTurn { part: BlockPart::Block(block), first, steps, late: true };
                }
                first += steps;
            }
        }
        let started = self.turns.iter().rev().find(|turn| turn.first <= step);
        *started.unwrap_or(&self.turns[0])
    }

    /// Steps in which each block takes a turn after the last step of the schedules.
    pub fn round(&self) -> usize {
        self.division.photos.iter().map(Vec::len).sum()
    }

    /// Number of blocks without a turn in the steps from `from` up to `until` that come after the last step of the
    /// schedules; 0 where there is none.
    pub fn unreached(&self, from: u32, until: u32) -> usize {
        let further = from.max(self.steps)..until;
        if further.is_empty() || further.len() >= self.round() {
            return 0;
        }
        let mut reached = vec![false; self.division.blocks.len()];
        for step in further {
            if let BlockPart::Block(block) = self.turn_at(step).part {
                reached[block] = true;
            }
        }
        let left_out = reached.iter().zip(&self.division.photos);
        left_out.filter(|(reached, photos)| !**reached && !photos.is_empty()).count()
    }

    /// Whether a splat at a position is trained in a turn.
    pub fn trains(&self, turn: &BlockTurn, position: Vec3) -> bool {
        let blocks = &self.division.blocks;
        match turn.part {
            BlockPart::Coarse => true,
            BlockPart::Seams => self.division.at_seam(position),
            BlockPart::Block(block) if turn.late => blocks[block].core.contains(position),
            BlockPart::Block(block) => self.division.trains(block, position),
        }
    }

    /// The views that are trained on in a part, in ascending order.
    pub fn photos(&self, part: BlockPart) -> Vec<usize> {
        match part {
            BlockPart::Block(block) => self.division.photos[block].clone(),
            BlockPart::Seams => self.division.photos_at_seams(),
            BlockPart::Coarse => self.all_photos(),
        }
    }

    /// All views that are trained on, in ascending order.
    pub fn all_photos(&self) -> Vec<usize> {
        let mut all: Vec<usize> = self.division.photos.iter().flatten().copied().collect();
        all.sort_unstable();
        all.dedup();
        all
    }
}

#[cfg(test)]
mod tests {
    use super::super::division::{Aabb, SceneBlock};
    use super::*;

    #[test]
    fn blocks_that_further_steps_do_not_come_to_are_counted() {
        let everywhere = Aabb { min: Vec3::NEG_INFINITY, max: Vec3::INFINITY };
        let block = SceneBlock { core: everywhere, border: everywhere };
        let division = Division {
            blocks: vec![block; 2],
            photos: vec![vec![0, 1, 2], vec![2, 3]],
            shares: vec![0.5; 2],
            trained_shares: vec![0.5; 2],
            seam_share: 0.1,
        };
        let turns = BlockTurns { division, points: vec![Vec::new(); 2], turns: Vec::new(), steps: 100 };
        assert_eq!(turns.round(), 5);
        let unreached = [(0, 100), (90, 101), (100, 103), (100, 104), (103, 105), (100, 105), (100, 107)]
            .map(|(from, until)| turns.unreached(from, until));
        assert_eq!(unreached, [0, 1, 1, 0, 1, 0, 0]);
    }
}
