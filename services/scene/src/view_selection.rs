//! Which photos of many are worth their time: a greedy selection by what each photo adds (docs/method.md, section 6.9).
//!
//! A photo covers cells: a point that it shows, seen from one of [`DIRECTION_BINS`] directions. The `n`-th photo that covers a cell
//! adds `2^-n`, so that a further photo from where others were taken adds less and less, and one of another side adds the most. What
//! a set of photos covers is a monotone submodular function of the set: the greedy order is at least 1 - 1/e as good as the best set
//! of each size (Nemhauser, Wolsey and Fisher 1978), and a photo's gain never grows, so that gains are computed again only for the
//! photos that may come next (Minoux 1978). Gains are whole numbers: the order of points and of photos changes no sum.

use crate::{Camera, NEAR, Pose};
use glam::Vec3;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Directions from a point to cameras that count as different: of each octant, the parts nearest to its three axes.
pub const DIRECTION_BINS: usize = 24;

/// What covering a cell any number of times tends to; the first photo adds half of it.
const WHOLE: u64 = 1 << 32;

/// How often photos cover each cell of some points.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewCoverage {
    /// `[point][bin]`, flat. It stops counting at 255: what is added has long been nothing.
    covered: Vec<u8>,
}

/// A photo that may be selected.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CandidateView<'a> {
    /// Its name. Of photos that add the same, the one whose name comes first is selected.
    pub name: &'a str,
    /// The cells that it covers, each once: see [`cells_in_frame`].
    pub cells: &'a [u32],
}

/// A photo that may be selected, known by its frame: what stands before the points is found by rendering it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FramedView<'a> {
    /// Its name, as in [`CandidateView`].
    pub name: &'a str,
    /// The cells that it covers at most, ascending, each once: see [`cells_in_frame`].
    pub cells: &'a [u32],
    /// How far from the points its camera stands, in units of the scene.
    pub distance: f32,
}

/// A photo that is selected.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SelectedView {
    /// Its index among the candidates.
    pub candidate: usize,
    /// What it adds to those selected before it, in [0, 1]: 1 is what the first photo adds that shows all points.
    pub added: f64,
}

impl ViewCoverage {
    /// Of so many points that no photo covers yet.
    pub fn none(points: usize) -> ViewCoverage {
        ViewCoverage { covered: vec![0; points.saturating_mul(DIRECTION_BINS)] }
    }

    /// Adds a photo. Cells of points that there are not count for nothing.
    pub fn add(&mut self, cells: &[u32]) {
        for &cell in cells {
            if let Some(covered) = self.covered.get_mut(cell as usize) {
                *covered = covered.saturating_add(1);
            }
        }
    }

    /// What a photo would add, in [0, 1]: 1 is what the first photo adds that shows all points. 0 where there are no points.
    pub fn gain(&self, cells: &[u32]) -> f64 {
        self.share(self.units(cells))
    }

    /// Parts of [`WHOLE`] as what is added.
    fn share(&self, units: u64) -> f64 {
        let points = self.covered.len() / DIRECTION_BINS;
        if points == 0 { 0.0 } else { units as f64 / (points as f64 * (WHOLE / 2) as f64) }
    }

    /// What a photo would add, in parts of [`WHOLE`].
    fn units(&self, cells: &[u32]) -> u64 {
        cells.iter().map(|&cell| self.units_of(cell)).sum()
    }

    /// The same of one cell.
    fn units_of(&self, cell: u32) -> u64 {
        let covered = self.covered.get(cell as usize);
        covered.and_then(|&covered| WHOLE.checked_shr(u32::from(covered) + 1)).unwrap_or(0)
    }
}

/// What rendered photos had in their frame and did not show, since something stands before it.
struct Occlusions {
    /// `[point][bin]`, flat: in how many photos, and the least distance of their cameras.
    cells: Vec<(u8, f32)>,
}

impl Occlusions {
    fn none(points: usize) -> Occlusions {
        Occlusions { cells: vec![(0, f32::INFINITY); points.saturating_mul(DIRECTION_BINS)] }
    }

    /// Adds a photo that was rendered, of whose cells it covers those of `shown`. Returns whether it leaves any out.
    fn add(&mut self, view: &FramedView, shown: &[u32]) -> bool {
        let occluded = view.cells.iter().filter(|cell| shown.binary_search(cell).is_err());
        let mut any = false;
        for &cell in occluded {
            if let Some((times, nearest)) = self.cells.get_mut(cell as usize) {
                (*times, *nearest) = (times.saturating_add(1), nearest.min(view.distance));
                any = true;
            }
        }
        any
    }

    /// What a photo that is not rendered yet is expected to add, in parts of [`WHOLE`]: a cell that `n` photos did not show
    /// counts by `1 / (n + 1)`, but for a camera that stands nearer than all of theirs.
    fn expected(&self, view: &FramedView, covered: &ViewCoverage) -> u64 {
        let of_cell = |&cell: &u32| {
            let (times, nearest) = self.cells.get(cell as usize).copied().unwrap_or((0, f32::INFINITY));
            let times = if view.distance >= nearest { u64::from(times) } else { 0 };
            covered.units_of(cell) / (times + 1)
        };
        view.cells.iter().map(of_cell).sum()
    }
}

/// The cells that a photo covers of points in its frame for which `shows` is true, ascending, each once. Without a test of what
/// stands before a point, they are those that the photo covers at most.
pub fn cells_in_frame(
    points: &[Vec3],
    camera: &Camera,
    pose: &Pose,
    shows: impl Fn(usize) -> bool,
) -> Vec<u32> {
    let centre = pose.centre();
    let covered = |(i, point): (usize, &Vec3)| {
        let seen = pose.to_camera(*point);
        let in_frame = seen.z > NEAR && camera.contains(camera.pixel(seen));
        (in_frame && shows(i)).then(|| cell(i, centre - *point))
    };
    points.iter().enumerate().filter_map(covered).collect()
}

/// The cell of the point of a number, seen from a direction.
pub fn cell(point: usize, direction: Vec3) -> u32 {
    (point * DIRECTION_BINS + direction_bin(direction)) as u32
}

/// The bin of a direction: its octant, and the axis to which it is nearest.
fn direction_bin(direction: Vec3) -> usize {
    let Vec3 { x, y, z } = direction.abs();
    let axis = if x >= y && x >= z {
        0
    } else if y >= z {
        1
    } else {
        2
    };
    let [x, y, z] = direction.to_array().map(|component| usize::from(component < 0.0));
    axis * 8 + x * 4 + y * 2 + z
}

/// A candidate in the queue.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct QueuedView<'a> {
    /// What it added when it was last computed: it adds no more now.
    units: u64,
    /// Of equal gains, the first name counts; of equal names, the first candidate.
    order: Reverse<(&'a str, usize)>,
    /// Photos that were selected by then, and those that were rendered and left something out.
    changes: usize,
}

/// Selects photos, each the one that adds most to `covered` and to those selected before it, until there are `most` or the next
/// adds less than `least` (as [`ViewCoverage::gain`]), or nothing. Every prefix is the selection of its size.
///
/// Each candidate is computed once, and again only while it may be the next: at worst all of them for each one that is selected.
///
/// ```
/// use segwild_scene::view_selection::{CandidateView, DIRECTION_BINS, ViewCoverage, select_views};
///
/// // Two points. Two photos show both from one direction; a third shows the first point alone, from another one.
/// let (both, other_side) = ([0, DIRECTION_BINS as u32], [7]);
/// let candidates = [("a", &both[..]), ("b", &both[..]), ("c", &other_side[..])]
///     .map(|(name, cells)| CandidateView { name, cells });
/// let selected = select_views(&candidates, ViewCoverage::none(2), 3, 0.0);
/// let order: Vec<(usize, f64)> = selected.iter().map(|s| (s.candidate, s.added)).collect();
/// assert_eq!(order, [(0, 1.0), (1, 0.5), (2, 0.5)]);
/// ```
pub fn select_views(
    candidates: &[CandidateView],
    mut covered: ViewCoverage,
    most: usize,
    least: f64,
) -> Vec<SelectedView> {
    let mut selected: Vec<SelectedView> = Vec::new();
    let mut queue = BinaryHeap::with_capacity(candidates.len());
    for (index, candidate) in candidates.iter().enumerate() {
        let units = covered.units(candidate.cells);
        queue.push(QueuedView { units, order: Reverse((candidate.name, index)), changes: 0 });
    }
    while selected.len() < most {
        let Some(mut next) = queue.pop() else { break };
        let Reverse((_, index)) = next.order;
        let cells = candidates[index].cells;
        if next.changes < selected.len() {
            (next.units, next.changes) = (covered.units(cells), selected.len());
            queue.push(next);
            continue;
        }
        let added = covered.gain(cells);
        // No other adds more.
        if next.units == 0 || added < least {
            break;
        }
        covered.add(cells);
        selected.push(SelectedView { candidate: index, added });
    }
    selected
}

/// As [`select_views`], where only `render` finds which of its cells a candidate covers, ascending: it is called for at most
/// `renders` of them, and each that is selected is one of these.
///
/// What is rendered next is the candidate that is expected to add most to what the selected photos do cover: by its frame alone
/// that is what it adds at most. Where rendered photos did not show a cell, others that are as far away are expected to show it
/// the less: in a house, photos of other rooms have the object in their frames, and a wall before it.
///
/// # Errors
/// Those of `render`.
pub fn select_rendered_views<E>(
    candidates: &[FramedView],
    mut covered: ViewCoverage,
    most: usize,
    least: f64,
    mut renders: usize,
    mut render: impl FnMut(usize) -> Result<Vec<u32>, E>,
) -> Result<Vec<SelectedView>, E> {
    let mut occlusions = Occlusions::none(covered.covered.len() / DIRECTION_BINS);
    let mut rendered: Vec<Option<Vec<u32>>> = vec![None; candidates.len()];
    let mut selected: Vec<SelectedView> = Vec::new();
    let mut changes = 0;
    let mut queue = BinaryHeap::with_capacity(candidates.len());
    for (index, candidate) in candidates.iter().enumerate() {
        let units = covered.units(candidate.cells);
        queue.push(QueuedView { units, order: Reverse((candidate.name, index)), changes });
    }
    while selected.len() < most {
        let Some(mut next) = queue.pop() else { break };
        let Reverse((_, index)) = next.order;
        let candidate = &candidates[index];
        if next.changes < changes {
            next.units = match &rendered[index] {
                Some(cells) => covered.units(cells),
                None => occlusions.expected(candidate, &covered),
            };
            next.changes = changes;
            queue.push(next);
            continue;
        }
        let added = covered.share(next.units);
        // No other adds more, or is expected to.
        if next.units == 0 || added < least {
            break;
        }
        match &rendered[index] {
            Some(cells) => {
                covered.add(cells);
                selected.push(SelectedView { candidate: index, added });
                changes += 1;
            }
            // Of the rendered ones more may be selected.
            None if renders == 0 => {}
            None => {
                renders -= 1;
                let cells = render(index)?;
                changes += usize::from(occlusions.add(candidate, &cells));
                let units = covered.units(&cells);
                queue.push(QueuedView { units, order: next.order, changes });
                rendered[index] = Some(cells);
            }
        }
    }
    Ok(selected)
}
