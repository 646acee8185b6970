//! How the regions of a view merge, in half the memory of a [`MergeTree`]: the views that were added are all kept.

use segwild_vision::linkage::MergeTree;

/// The merges of at most 65,535 regions.
pub(super) struct RegionMerges {
    regions: u32,
    /// Per region, then per merge, the number of the merge that it is a part of next; the last merge names itself.
    next: Vec<u16>,
    /// Per merge, its height.
    height: Vec<f32>,
}

impl RegionMerges {
    /// The merges of a tree, whose leaves are the regions; `None` where there are too many.
    pub fn of(tree: &MergeTree) -> Option<RegionMerges> {
        let regions = u16::try_from(tree.leaves).ok()?;
        // One region alone merges with nothing and names itself.
        let merge = |&parent: &u32| parent.saturating_sub(regions.into()) as u16;
        Some(RegionMerges {
            regions: regions.into(),
            next: tree.parent.iter().map(merge).collect(),
            height: tree.height[tree.leaves..].to_vec(),
        })
    }

    /// The height at which two regions merge; 0 of one region.
    pub fn height(&self, a: u16, b: u16) -> f32 {
        let (mut a, mut b) = (u32::from(a), u32::from(b));
        let next = |node: u32| self.regions + u32::from(self.next[node as usize]);
        // A merge has a larger number than its parts.
        while a != b {
            if a < b {
                a = next(a);
            } else {
                b = next(b);
            }
        }
        a.checked_sub(self.regions).map_or(0.0, |merge| self.height[merge as usize])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_vision::linkage::{LinkageCost, LinkageEdge, agglomerate};

    #[test]
    fn regions_merge_at_the_heights_of_the_tree() {
        let mut state = 5u64;
        let mut random = |below: u64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            ((state >> 33) % below) as u32
        };
        for regions in [1u16, 2, 3, 50, 300] {
            let mut edges = Vec::new();
            // Not all regions are linked.
            for b in (1..u32::from(regions)).filter(|b| b % 9 != 0) {
                let (a, distance) = (random(b.into()), random(1000) as f32 / 1000.0);
                edges.push(LinkageEdge { a, b, distance, weight: 1.0 });
            }
            let sizes = vec![1.0; regions.into()];
            let tree = agglomerate(&sizes, edges.into_iter(), LinkageCost::AVERAGE);
            let merges = RegionMerges::of(&tree).expect("few enough");
            for a in 0..regions {
                for b in 0..regions {
                    let meet = tree.meet(a.into(), b.into());
                    assert_eq!(merges.height(a, b), tree.height[meet as usize], "{a} {b} of {regions}");
                }
            }
        }
        assert!(RegionMerges::of(&MergeTree { leaves: 1 << 16, ..MergeTree::default() }).is_none());
        assert!(RegionMerges::of(&MergeTree::default()).is_some_and(|none| none.height.is_empty()));
    }
}
