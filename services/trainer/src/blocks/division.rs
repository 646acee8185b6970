//! How a scene is divided into blocks.

use glam::Vec3;
use segwild_scene::{NEAR, Scene, View};

/// How far a border box reaches beyond its core, as a share of the core's extent. By choice.
const BORDER: f32 = 0.15;
/// Least share of a photo's points in the border box of a block in which the photo takes part. By choice.
const LEAST_SEEN: f32 = 0.02;
/// Share of the positions that is left out at either end where an extent is measured: a reconstruction has outliers.
const OUTLIERS: f32 = 0.02;
/// Most points that are projected into a photo that saw none, evenly over all.
const PROJECTED: usize = 8192;
/// Most points that decide where blocks lie, evenly over all.
const DECIDING: usize = 1 << 16;

/// A box along the axes. It is half-open: its lower sides belong to it, its upper sides do not.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Aabb {
    pub min: Vec3,
    pub max: Vec3,
}

impl Aabb {
    /// All of space.
    const EVERYWHERE: Aabb = Aabb { min: Vec3::NEG_INFINITY, max: Vec3::INFINITY };

    /// Whether a position lies in it; one that is not finite does not.
    pub fn contains(&self, position: Vec3) -> bool {
        position.is_finite() && position.cmpge(self.min).all() && position.cmplt(self.max).all()
    }

    /// The two parts below and from `at` on along an axis.
    fn cut(&self, axis: usize, at: f32) -> [Aabb; 2] {
        let mut parts = [*self; 2];
        (parts[0].max[axis], parts[1].min[axis]) = (at, at);
        parts
    }
}

/// A block of a scene, in the scene's normalised frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SceneBlock {
    /// What it alone holds: each finite position lies in the core of one block.
    pub core: Aabb,
    /// The core and what is around it, which it shares with its neighbours.
    pub border: Aabb,
}

/// A scene divided into blocks. It depends on the scene's poses as given and on its points alone.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Division {
    pub blocks: Vec<SceneBlock>,
    /// Per block, the views that take part in it, in ascending order. Each view that is trained on takes part in one or
    /// more.
    pub photos: Vec<Vec<usize>>,
    /// Per block, the share of cameras and points in its border box.
    pub shares: Vec<f32>,
    /// Per block, the share of cameras and points that its turn trains ([`Division::trains`]).
    pub trained_shares: Vec<f32>,
    /// The share of cameras and points in the border boxes of two blocks or more.
    pub seam_share: f32,
}

impl Division {
    /// Divides a scene into `count` blocks by median splits of camera centres and points on the ground plane; into
    /// fewer where these are too few, or lie at one position.
    pub fn of(scene: &Scene, count: usize) -> Division {
        let boxes = Division::boxes(scene, count);
        Division { photos: photos(scene, &boxes.blocks), ..boxes }
    }

    /// The blocks without their photos.
    fn boxes(scene: &Scene, count: usize) -> Division {
        let cameras = scene.views.iter().filter(|view| !view.test).map(|view| view.pose.centre());
        let every = scene.points.len().div_ceil(DECIDING).max(1);
        let positions = cameras.chain(scene.points.iter().step_by(every).map(|point| point.position));
        let positions: Vec<Vec3> = positions.filter(|position| position.is_finite()).collect();
        let mut blocks = Vec::with_capacity(count);
        split(positions.clone(), count, ground_axes(scene), Aabb::EVERYWHERE, &mut blocks);
        let (shares, trained_shares) = (Vec::new(), Vec::new());
        let mut division = Division { photos: Vec::new(), shares, trained_shares, seam_share: 0.0, blocks };
        let share = |of: &dyn Fn(Vec3) -> bool| {
            positions.iter().filter(|&&position| of(position)).count() as f32 / positions.len().max(1) as f32
        };
        let shares = division.blocks.iter().map(|block| share(&|position| block.border.contains(position)));
        division.shares = shares.collect();
        let blocks = 0..division.blocks.len();
        let trained = blocks.map(|block| share(&|position| division.trains(block, position)));
        division.trained_shares = trained.collect();
        division.seam_share = share(&|position| division.at_seam(position));
        division
    }

    /// Whether a block trains a splat at a position: one in its core or, of its border, in the core of a block that has
    /// yet to come. The photos of this block alone would spoil what the others have finished.
    pub fn trains(&self, block: usize, position: Vec3) -> bool {
        let finished = self.blocks[..block].iter().any(|before| before.core.contains(position));
        self.blocks[block].border.contains(position) && !finished
    }

    /// Most splats that a block may come to in its turn, of `most` in all of which so many are frozen. All positions
    /// are given as many splats each: what a block trains in the border it hands on, and the next one does not start
    /// with less.
    pub fn cap(&self, block: usize, most: usize, frozen: usize) -> usize {
        ((most as f32 * self.trained_shares[block]) as usize).min(most.saturating_sub(frozen))
    }

    /// Whether a position lies at a seam: in the border boxes of two blocks or more.
    pub fn at_seam(&self, position: Vec3) -> bool {
        self.blocks.iter().filter(|block| block.border.contains(position)).nth(1).is_some()
    }

    /// The views that take part in two blocks or more, in ascending order.
    pub fn photos_at_seams(&self) -> Vec<usize> {
        let mut all: Vec<usize> = self.photos.iter().flatten().copied().collect();
        all.sort_unstable();
        let same = |pair: &[usize]| (pair[0] == pair[1]).then_some(pair[0]);
        let mut twice: Vec<usize> = all.windows(2).filter_map(same).collect();
        twice.dedup();
        twice
    }
}

/// The largest share of a scene's splats that a training by so many blocks trains at a time, in (0, 1]: of a block with
/// its border, of what lies at seams, or of the few splats that are trained on all photos.
pub fn trained_share(scene: &Scene, blocks: usize) -> f64 {
    if blocks < 2 {
        return 1.0;
    }
    let boxes = Division::boxes(scene, blocks);
    let largest = boxes.shares.iter().copied().fold(boxes.seam_share, f32::max);
    f64::from(largest).clamp(1.0 / blocks as f64, 1.0)
}

/// Whether a scene can be divided into `count` blocks, or into fewer, but more than one.
pub(crate) fn is_divisible(scene: &Scene, count: usize) -> bool {
    Division::boxes(scene, count).blocks.len() > 1
}

/// The two axes that lie closest to the ground plane: those that the cameras' upward direction is farthest from.
fn ground_axes(scene: &Scene) -> [usize; 2] {
    let upward = scene.views.iter().map(|view| -view.pose.rotation.row(1));
    let up = upward.filter(|up| up.is_finite()).sum::<Vec3>().abs();
    match (0..3).max_by(|&a, &b| up[a].total_cmp(&up[b])) {
        Some(0) => [1, 2],
        Some(1) => [0, 2],
        _ => [0, 1],
    }
}

/// The lowest and the highest of the positions along an axis, without outliers; 0 where there is none.
fn range(positions: &[Vec3], axis: usize) -> [f32; 2] {
    let mut along: Vec<f32> = positions.iter().map(|position| position[axis]).collect();
    along.sort_unstable_by(f32::total_cmp);
    let Some(last) = along.len().checked_sub(1) else { return [0.0; 2] };
    let left_out = (last as f32 * OUTLIERS) as usize;
    [along[left_out], along[last - left_out]]
}

/// Divides a part of the scene with these positions into `count` blocks.
fn split(positions: Vec<Vec3>, count: usize, ground: [usize; 2], core: Aabb, blocks: &mut Vec<SceneBlock>) {
    let extent = ground.map(|axis| {
        let [low, high] = range(&positions, axis);
        high - low
    });
    let axis = if extent[0] >= extent[1] { ground[0] } else { ground[1] };
    let below = count / 2;
    if count > 1 && positions.len() >= 2 * count {
        let mut along: Vec<f32> = positions.iter().map(|position| position[axis]).collect();
        let (_, &mut at, _) = along.select_nth_unstable_by(positions.len() * below / count, f32::total_cmp);
        let (low, high): (Vec<Vec3>, Vec<Vec3>) =
            positions.into_iter().partition(|position| position[axis] < at);
        if !low.is_empty() {
            let [low_core, high_core] = core.cut(axis, at);
            split(low, below, ground, low_core, blocks);
            split(high, count - below, ground, high_core, blocks);
            return;
        }
    }
    let mut reach = Vec3::ZERO;
    ground.iter().zip(extent).for_each(|(&axis, extent)| reach[axis] = BORDER * extent);
    blocks.push(SceneBlock { core, border: Aabb { min: core.min - reach, max: core.max + reach } });
}

/// Per block, the views that take part in it: those whose camera, or enough of whose points, lie in its border box.
fn photos(scene: &Scene, blocks: &[SceneBlock]) -> Vec<Vec<usize>> {
    let holding = |position: Vec3| (0..blocks.len()).filter(move |&b| blocks[b].border.contains(position));
    let mut seen = vec![(0u32, vec![0u32; blocks.len()]); scene.views.len()];
    let mut count = |view: usize, position: Vec3| {
        if let Some((all, inside)) = seen.get_mut(view) {
            *all += 1;
            holding(position).for_each(|block| inside[block] += 1);
        }
    };
    for point in &scene.points {
        point.track.iter().for_each(|seen| count(seen.view as usize, point.position));
    }
    // Points without tracks, as they come with poses of other programs: those before the camera.
    let untracked: Vec<usize> = (0..scene.views.len()).filter(|&view| seen[view].0 == 0).collect();
    let every = scene.points.len().div_ceil(PROJECTED).max(1);
    for view in untracked {
        for point in scene.points.iter().step_by(every) {
            if is_before(&scene.views[view], point.position) {
                let (all, inside) = &mut seen[view];
                *all += 1;
                holding(point.position).for_each(|block| inside[block] += 1);
            }
        }
    }
    let takes_part = |view: usize, block: usize| {
        let (all, inside) = (seen[view].0, seen[view].1[block]);
        let enough = inside > 0 && inside as f32 >= LEAST_SEEN * all as f32;
        enough || blocks[block].border.contains(scene.views[view].pose.centre())
    };
    let trained: Vec<usize> = (0..scene.views.len()).filter(|&view| !scene.views[view].test).collect();
    (0..blocks.len())
        .map(|block| trained.iter().copied().filter(|&view| takes_part(view, block)).collect())
        .collect()
}

/// Whether a position lies in a view's image.
fn is_before(view: &View, position: Vec3) -> bool {
    let at = view.pose.to_camera(position);
    at.z > NEAR && view.camera.contains(view.camera.pixel(at))
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::{Camera, Observation, Photo, Point, Pose, Random};

    /// A street along x with cameras that face it from one side, and a far outlier; z is up.
    fn street(cameras: usize, points: usize, tracks: bool) -> Scene {
        let view = |i: usize| View {
            name: format!("{i:03}.jpg"),
            camera: Camera { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 },
            pose: {
                let eye = Vec3::new(i as f32 * 10.0 / cameras as f32, -2.0, 0.5);
                Pose::look_at(eye, eye + Vec3::Y, Vec3::Z)
            },
            photo: Photo::new("none"),
            test: false,
        };
        let views: Vec<View> = (0..cameras).map(view).collect();
        let mut random = Random::new(7);
        let mut point = |i: usize| {
            let far = if i == 0 { 1e4 } else { 1.0 };
            let position = Vec3::new(10.0 * random.uniform(), random.uniform(), 3.0 * random.uniform()) * far;
            let sees = |view: &usize| tracks && is_before(&views[*view], position);
            let seen = (0..cameras).filter(sees);
            let track = seen.map(|view| Observation { view: view as u32, pixel: [0.0; 2] }).collect();
            Point { position, colour: [0.5; 3], track }
        };
        let points = (0..points).map(&mut point).collect();
        Scene::new(views, points)
    }

    #[test]
    fn every_position_has_one_owner_and_every_photo_a_block() {
        for tracks in [false, true] {
            let mut scene = street(30, 900, tracks);
            scene.points[5].position = Vec3::NAN;
            for count in [2, 3, 5, 8] {
                let division = Division::of(&scene, count);
                assert_eq!(division.blocks.len(), count);
                assert_eq!(division, Division::of(&scene, count), "the same scene, the same blocks");
                let mut random = Random::new(count as u64);
                let mut positions: Vec<Vec3> = scene.points.iter().map(|point| point.position).collect();
                positions.extend(scene.views.iter().map(|view| view.pose.centre()));
                positions.extend((0..500).map(|_| Vec3::new(random.normal(), random.normal(), 9.0) * 20.0));
                // On the seams themselves, and as far out as numbers go.
                positions.extend(division.blocks.iter().map(|block| block.core.min.max(Vec3::splat(-1e30))));
                for position in positions.into_iter().filter(|position| position.is_finite()) {
                    let owners: Vec<&SceneBlock> =
                        division.blocks.iter().filter(|block| block.core.contains(position)).collect();
                    assert_eq!(owners.len(), 1, "{position} of {count}");
                    assert!(owners[0].border.contains(position), "the border box holds the core");
                }
                for view in 0..30 {
                    assert!(division.photos.iter().any(|photos| photos.contains(&view)), "{view} of {count}");
                }
                assert!(division.photos.iter().all(|photos| photos.len() < 30), "a part of the photos each");
                assert!(!division.photos_at_seams().is_empty());
                let largest = division.shares.iter().copied().fold(0.0, f32::max);
                // A block with its border, which along a thin side is as wide as the block.
                assert!(
                    largest < (2.4 / count as f32 + 0.05).min(0.9),
                    "{largest} of {count}: the blocks are alike"
                );
            }
        }
    }

    #[test]
    fn every_block_comes_to_its_share_of_the_splats() {
        const MOST: usize = 100_000;
        let mut scene = street(16, 3000, false);
        // A square, so that a block has neighbours along both axes.
        scene.points.iter_mut().for_each(|point| point.position.y *= 10.0);
        let positions = scene.views.iter().map(|view| view.pose.centre());
        let positions: Vec<Vec3> = positions.chain(scene.points.iter().map(|point| point.position)).collect();
        let all = positions.len() as f32;
        for count in [4, 8, 16] {
            let division = Division::of(&scene, count);
            let owns = |block: usize, position: Vec3| division.blocks[block].core.contains(position);
            let handed_on = |block: usize| {
                let trained = positions.iter().filter(|position| division.trains(block, **position));
                trained.filter(|position| !owns(block, **position)).count() as f32 / all
            };
            let kept: f32 = (0..count).map(|block| division.trained_shares[block] - handed_on(block)).sum();
            assert!((0.99..=1.0 + 1e-4).contains(&kept), "{kept} of {count}");
            // The coarse training spreads its splats over all positions, a turn its own over what it trains.
            let mut splats = vec![MOST as f32 / count as f32 / all; positions.len()];
            for block in 0..count {
                let trains: Vec<bool> = positions.iter().map(|at| division.trains(block, *at)).collect();
                let frozen: f32 =
                    splats.iter().zip(&trains).filter(|(_, trains)| !**trains).map(|(own, _)| own).sum();
                let cap = division.cap(block, MOST, frozen.ceil() as usize) as f32;
                let each = cap / trains.iter().filter(|trains| **trains).count() as f32;
                let trained = splats.iter_mut().zip(&trains).filter(|(_, trains)| **trains);
                trained.for_each(|(own, _)| *own = each);
            }
            assert!(splats.iter().sum::<f32>() <= MOST as f32 * (1.0 + 1e-3), "{count}");
            for block in 0..count {
                let own = positions.iter().zip(&splats).filter(|(at, _)| owns(block, **at));
                let own: Vec<f32> = own.map(|(_, splats)| *splats).collect();
                let (fair, got) = (own.len() as f32 / all * MOST as f32, own.iter().sum::<f32>());
                assert!(got >= 0.9 * fair, "block {block} of {count}: {got} of {fair}");
            }
        }
    }

    #[test]
    fn more_blocks_are_smaller_and_a_scene_at_one_position_stays_whole() {
        let scene = street(40, 2000, true);
        let shares: Vec<f64> = [1, 2, 4, 8].map(|blocks| trained_share(&scene, blocks)).to_vec();
        assert!(shares[0] == 1.0 && shares.windows(2).all(|pair| pair[1] < pair[0]), "{shares:?}");
        let mut one = street(6, 0, false);
        let pose = one.views[0].pose;
        one.views.iter_mut().for_each(|view| view.pose = pose);
        assert_eq!(Division::of(&one, 2).blocks.len(), 1);
        assert_eq!(Division::of(&Scene { views: vec![], ..one }, 2).blocks.len(), 1);
    }
}
