//! The graph of a run: which stage needs what of which other one. The coordinator starts what can start by it, and
//! `segwild run --explain --graph` prints it.

use super::need::{Extent, Need};
use super::node::StageNode;
use super::stage::Stage;
use super::stages::NODES;
use std::collections::{BTreeMap, BTreeSet};

/// The stages of a run and their needs.
pub struct StageGraph {
    needs: BTreeMap<Stage, Vec<Need>>,
}

impl StageGraph {
    /// The graph of every run.
    pub fn of_a_run() -> StageGraph {
        StageGraph { needs: NODES.iter().map(|node| (node.stage, node.needs.to_vec())).collect() }
    }

    /// Makes a stage wait for at least this much of another one that it needs.
    pub fn require(&mut self, stage: Stage, of: Stage, extent: Extent) {
        for need in self.needs.get_mut(&stage).into_iter().flatten().filter(|need| need.stage == of) {
            need.extent = need.extent.max(extent);
        }
    }

    /// What a stage needs before it may start.
    pub fn needs(&self, stage: Stage) -> &[Need] {
        self.needs.get(&stage).map_or(&[], Vec::as_slice)
    }

    /// Whether a stage may start. `gives` says how much of another stage is there.
    pub fn is_ready(&self, stage: Stage, gives: impl Fn(Stage, Extent) -> bool) -> bool {
        self.needs(stage).iter().all(|need| gives(need.stage, need.extent))
    }

    /// The stages that a run works on: those up to `last`, and those that they need.
    pub fn wanted(&self, last: Stage) -> BTreeSet<Stage> {
        let mut wanted: BTreeSet<Stage> = self.needs.keys().copied().filter(|stage| *stage <= last).collect();
        let mut open: Vec<Stage> = wanted.iter().copied().collect();
        while let Some(stage) = open.pop() {
            open.extend(self.needs(stage).iter().map(|need| need.stage).filter(|s| wanted.insert(*s)));
        }
        wanted
    }
}

/// The node of a stage.
pub fn node_of(stage: Stage) -> &'static StageNode {
    NODES.iter().find(|node| node.stage == stage).expect("a test asks that every stage has a node")
}

/// What a stage needs, as far as it is listed: what [`Stage::Visibility`] needs counts for the stages that need it. A
/// stage that is needed twice is listed once, with the larger extent.
///
/// ```
/// use segwild_pipeline::{Extent, Stage, needs};
/// let names: Vec<&str> = needs(Stage::Features).iter().map(|need| need.stage.name()).collect();
/// assert_eq!(names, ["sky", "embed", "masks", "geometry"]);
/// assert_eq!(needs(Stage::Masks)[1].extent, Extent::Part, "the snapshot of the training");
/// ```
pub fn needs(stage: Stage) -> Vec<Need> {
    let graph = StageGraph::of_a_run();
    let mut found: BTreeMap<Stage, Need> = BTreeMap::new();
    let mut open = graph.needs(stage).to_vec();
    while let Some(need) = open.pop() {
        if need.stage.listed() != need.stage {
            open.extend(graph.needs(need.stage));
            continue;
        }
        let known = found.entry(need.stage).or_insert(need);
        if known.extent < need.extent {
            *known = need;
        }
    }
    found.into_values().collect()
}

/// The listed stages that an actor or a source works on, in the order in which it comes to them. A source that computes
/// a stage of its own works for the stages that need it.
///
/// ```
/// use segwild_pipeline::{Stage, stages_of};
/// assert_eq!(stages_of("masks"), [Stage::Sky, Stage::Masks]);
/// assert_eq!(stages_of("visibility"), [Stage::Features, Stage::Objects]);
/// ```
pub fn stages_of(actor: &str) -> Vec<Stage> {
    let mut stages = Vec::new();
    for stage in NODES.iter().filter(|node| node.is_work_of(actor)).map(|node| node.stage) {
        if stage.listed() == stage {
            stages.push(stage);
        } else {
            let users = NODES.iter().filter(|node| node.needs.iter().any(|need| need.stage == stage));
            stages.extend(users.map(|node| node.stage));
        }
    }
    stages
}

/// The listed stage that the failure of an actor or a source counts for: the last one that it works on.
pub fn stage_of_failure(actor: &str) -> Stage {
    let last = NODES.iter().rfind(|node| node.is_work_of(actor));
    last.map_or(Stage::Masks, |node| node.stage.listed())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_stage_has_a_node_and_needs_nothing_of_itself() {
        let graph = StageGraph::of_a_run();
        assert_eq!(graph.needs.len(), NODES.len());
        for stage in Stage::all_listed() {
            assert!(graph.needs.contains_key(&stage), "{stage}");
        }
        // From the stages that need nothing, every stage is reached in turn: there is no circle.
        let mut ended = BTreeSet::new();
        while ended.len() < NODES.len() {
            let next = NODES.iter().map(|node| node.stage).find(|stage| {
                !ended.contains(stage) && graph.is_ready(*stage, |other, _| ended.contains(&other))
            });
            assert!(ended.insert(next.expect("one of the others can start")));
        }
    }

    #[test]
    fn a_run_up_to_the_masks_trains_and_makes_no_field() {
        let wanted = StageGraph::of_a_run().wanted(Stage::Masks);
        assert_eq!(
            wanted,
            BTreeSet::from([Stage::Poses, Stage::Sky, Stage::Embed, Stage::Masks, Stage::Geometry])
        );
        assert_eq!(
            StageGraph::of_a_run().wanted(Stage::Embed),
            BTreeSet::from([Stage::Poses, Stage::Sky, Stage::Embed])
        );
        assert_eq!(StageGraph::of_a_run().wanted(Stage::Report).len(), NODES.len());
    }

    #[test]
    fn a_training_may_be_made_to_wait_for_all_skies() {
        let mut graph = StageGraph::of_a_run();
        let started = |_: Stage, extent: Extent| extent == Extent::PerPhoto;
        assert!(graph.is_ready(Stage::Geometry, started));
        graph.require(Stage::Geometry, Stage::Sky, Extent::Part);
        assert!(!graph.is_ready(Stage::Geometry, started));
    }

    #[test]
    fn actors_and_sources_name_their_stages() {
        let of = |actor: &str| stages_of(actor).iter().map(|stage| stage.name()).collect::<Vec<_>>();
        assert_eq!(of("masks"), ["sky", "masks"]);
        assert_eq!(of("features"), ["embed", "features"]);
        assert_eq!(of("trainer"), ["geometry"]);
        assert_eq!(of("ingest"), ["sky"]);
        assert_eq!(of("photos"), ["embed"]);
        assert_eq!(of("intrinsic renders"), ["masks"]);
        assert_eq!(of("visibility"), ["features", "objects"]);
        assert!(of("coordinator").is_empty());
    }

    #[test]
    fn a_failed_actor_fails_the_stage_that_it_works_on_last() {
        let of = |actor: &str| stage_of_failure(actor).name();
        assert_eq!((of("trainer"), of("features"), of("visibility")), ("geometry", "features", "features"));
        assert_eq!((of("photos"), of("ingest"), of("masks")), ("embed", "sky", "masks"));
        assert_eq!(of("intrinsic renders"), "masks");
    }
}
