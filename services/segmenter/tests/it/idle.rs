//! The segmenter prepares the first click while there is no task.

use crate::common::{engine, options, posed, walls};
use glam::Vec3;
use segwild_flow::{ActorOptions, Limits, System, SystemOptions, mailbox};
use segwild_scene::{Image, Mask, ReaderError, Splats};
use segwild_segmenter::{SceneGraph, SegmentActor, SegmentTask, ViewSplats};
use segwild_vision::Builtin;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

const NEIGHBOURS: usize = 10;

/// Bytes that an actor with a graph keeps once it has nothing left to do without a task.
fn kept_after_idling(splats: &Arc<Splats>, ahead: Range<usize>) -> usize {
    let bytes = Arc::new(AtomicUsize::new(0));
    let views = ["a.jpg", "b.jpg"].map(|name| posed(name, Vec3::ZERO, Vec3::Z));
    let views = Arc::new(Vec::from(views));
    let system = System::new(SystemOptions::default()).unwrap();
    let (_tasks, inbox) = mailbox::<SegmentTask>("segmenter", Limits::default());
    let (splats, counted) = (splats.clone(), bytes.clone());
    let make = move || {
        Ok(SegmentActor {
            engine: Arc::new(engine()),
            options: options(),
            splats: splats.clone(),
            views: views.clone(),
            barred: Arc::new(vec![false; 2]),
            features: None,
            photos: Arc::new(|_: usize| Ok::<Image, ReaderError>(Image::zeros(160, 120, 3))),
            skies: Arc::new(|_: usize| None::<Mask>),
            transients: Arc::new(|_: usize| None::<Mask>),
            segmenter: Arc::new(Builtin::new()),
            tree: None,
            seen_once: None,
            graph: SceneGraph::new(&splats, NEIGHBOURS),
            shown: ViewSplats::new(splats.len(), 2),
            ahead: ahead.clone(),
            bytes: counted.clone(),
        })
    };
    system.spawn(inbox, ActorOptions::default(), make).unwrap();
    let report = system.shutdown();
    assert!(report.finished(), "{report:?}");
    bytes.load(Ordering::Relaxed)
}

#[test]
fn affinities_are_computed_before_a_click_whether_or_not_views_are_computed_ahead() {
    let splats = Arc::new(walls().0.splats);
    let graph = SceneGraph::new(&splats, NEIGHBOURS);
    let affinities = graph.graph().unwrap().affinities(&splats, None);
    let with_affinities = graph.bytes() + size_of_val(&affinities[..]);
    assert_eq!(kept_after_idling(&splats, 0..0), with_affinities, "of many photos none is computed ahead");
    let of_views = 2 * size_of::<u64>() * splats.len().div_ceil(64);
    assert_eq!(kept_after_idling(&splats, 0..2), with_affinities + of_views);
}
