//! Running sums and the sort by subgroups and without: the same numbers, and faults in either are seen.

mod common;

use common::{broken_with, either_way, image, misled, splats, view};
use segwild_gpu::{AdapterChoice, GpuEngine};
use segwild_raster::{Channels, FrameGrad, ProjectOptions, Rasterizer};
use segwild_selftest::{STAGES, check};

#[test]
fn a_view_is_the_same_by_subgroups_and_without() {
    let engines = either_way("a_view_is_the_same_by_subgroups_and_without");
    let [by_subgroups, plain] = engines[..] else { return };
    assert!(plain.adapter().subgroups.is_none());
    // More than a block of the sort, and pairs over three levels of the running sum.
    let scene = splats(71, 3000, (0.01, 0.3));
    let (camera, pose) = view(200, 150);
    let draw = |engine: &GpuEngine| {
        let projected =
            engine.project(&scene, &camera, &pose, &ProjectOptions::default()).expect("projected");
        let values = projected.shade();
        let channels = Channels { count: 3, values: &values };
        let frame = projected.blend(&channels).expect("it blends");
        let (grad, alpha) = (image(72, 200, 150, 3), image(73, 200, 150, 1));
        let grad = FrameGrad { image: &grad, alpha: Some(&alpha) };
        let grads = projected.backward(&channels, &frame, &grad).expect("it goes back");
        (frame, grads)
    };
    let rendered = draw(by_subgroups);
    assert!(rendered.0.alpha.data.iter().any(|&a| a > 0.5), "nothing is seen");
    assert!(rendered == draw(plain));
}

/// Whether by subgroups, a kernel, a piece of its text, and its replacement.
const FAULTS: &[(bool, &str, &str, &str)] = &[
    (false, "scan", "position.number - step", "position.number"),
    (false, "scatter", "sums[p] -= mine[p]", "sums[p] -= mine[0]"),
    (true, "scan", "sums[p] + mine[p]", "sums[p]"),
    (true, "scan", "(first & 0xffffu) + lane", "(first >> 16u) * lanes + lanes - 1u - lane"),
    (true, "scatter", "s < position.rank", "s + 1u < position.rank"),
    (true, "scatter", "subgroupExclusiveAdd(mine[p])", "subgroupInclusiveAdd(mine[p])"),
];

#[test]
fn a_fault_in_either_way_to_sum_is_seen() {
    let engines = either_way("a_fault_in_either_way_to_sum_is_seen");
    // By subgroups every kernel is checked in `parity.rs`.
    if let Some(plain) = engines.last() {
        for step in check(plain).expect("every kernel runs") {
            assert!(step.off.is_none(), "without a fault: {step:?}");
        }
    }
    let Some(first) = engines.first() else { return };
    let (choice, has_some) = (AdapterChoice::Named(first.adapter().name.clone()), engines.len() == 2);
    for &(by_subgroups, kernel, text, fault) in FAULTS.iter().filter(|fault| has_some || !fault.0) {
        let broken = broken_with(by_subgroups, &choice, kernel, text, fault);
        assert_eq!(misled(&STAGES, &broken, kernel, fault), None);
    }
}
