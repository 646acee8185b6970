//! Connected regions of masks, found by runs: a mask of a photo has some hundreds of runs, and a hundred times as many
//! pixels.

use crate::Mask;
use std::ops::Range;

/// The connected regions of a mask.
struct LabelledRegions {
    /// Pixels of one row that follow one another, as indexes, and the region they lie in, row by row.
    runs: Vec<(Range<usize>, usize)>,
    /// Pixels of each region; regions are in the order of their first pixels.
    areas: Vec<usize>,
}

impl LabelledRegions {
    fn of(mask: &Mask, diagonals: bool) -> LabelledRegions {
        let (w, n) = (mask.width() as usize, mask.width() as usize * mask.height() as usize);
        let mut runs: Vec<Range<usize>> = Vec::new();
        // Per run an earlier one of its region, or itself where none is known.
        let mut first: Vec<usize> = Vec::new();
        let mut above = 0;
        let mut at = mask.next(0, true);
        while at < n {
            let run = at..mask.next(at, false).min((at / w + 1) * w);
            // What touches it in the row above begins before `end` and ends after `start`.
            let (start, end) = if diagonals {
                // Where the row begins or ends there is nothing further to touch.
                let row = run.start / w * w;
                (run.start.max(row + 1) - 1, (run.end + 1).min(row + w))
            } else {
                (run.start, run.end)
            };
            let k = runs.len();
            first.push(k);
            while runs.get(above).is_some_and(|r| r.end + w <= start) {
                above += 1;
            }
            let touching = (above..k).take_while(|&r| runs[r].start + w < end);
            for other in touching {
                let (a, b) = (root(&mut first, other), root(&mut first, k));
                let (older, newer) = (a.min(b), a.max(b));
                first[newer] = older;
            }
            at = mask.next(run.end, true);
            runs.push(run);
        }
        let mut areas = Vec::new();
        let mut region: Vec<usize> = Vec::with_capacity(runs.len());
        for k in 0..runs.len() {
            let of = root(&mut first, k);
            // A root is its region's first run: it is met before all others of the region.
            let name = if of == k { areas.len() } else { region[of] };
            if of == k {
                areas.push(0);
            }
            areas[name] += runs[k].len();
            region.push(name);
        }
        LabelledRegions { runs: runs.into_iter().zip(region).collect(), areas }
    }
}

/// The first run of the region that a run is known to be in.
fn root(first: &mut [usize], mut run: usize) -> usize {
    while first[run] != run {
        first[run] = first[first[run]];
        run = first[run];
    }
    run
}

impl Mask {
    /// Connected regions: per pixel 0 outside and 1.. inside, in the order of their first pixels, and their number.
    pub(crate) fn labelled(&self, diagonals: bool) -> (Vec<u32>, usize) {
        let regions = LabelledRegions::of(self, diagonals);
        let mut labels = vec![0; self.width() as usize * self.height() as usize];
        for (run, region) in regions.runs {
            labels[run].fill(region as u32 + 1);
        }
        (labels, regions.areas.len())
    }

    /// The mask without islands of fewer than `least` pixels (8-connected) and with holes of fewer than `least` pixels
    /// (4-connected) filled. If every island is that small, the mask becomes empty.
    pub fn without_specks(&self, least: usize) -> Mask {
        let small = |mask: &Mask, diagonals| {
            let regions = LabelledRegions::of(mask, diagonals);
            let small = |region: usize| regions.areas[region] < least;
            regions.runs.iter().filter(|r| small(r.1)).map(|r| r.0.clone()).collect::<Vec<_>>()
        };
        let mut mask = self.clone();
        small(&mask, true).into_iter().for_each(|run| mask.fill(run, false));
        if !mask.is_empty() {
            // Islands connect over corners, so holes must not.
            small(&mask.not(), false).into_iter().for_each(|run| mask.fill(run, true));
        }
        mask
    }
}
