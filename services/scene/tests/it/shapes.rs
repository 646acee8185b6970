//! Shapes of masks against plain definitions.

use proptest::prelude::*;
use segwild_scene::Mask;

fn mask() -> impl Strategy<Value = Mask> {
    (1u32..20, 1u32..16, prop::collection::vec(any::<bool>(), 320), prop::bool::ANY).prop_map(
        |(w, h, bits, sparse)| {
            let bit = |x: u32, y: u32| {
                bits[(y * w + x) as usize] && (!sparse || bits[((y * w + x) * 7 % 320) as usize])
            };
            Mask::from_fn(w, h, bit)
        },
    )
}

/// Squared distance to the nearest pixel of the mask, by looking at all of them.
fn squared(mask: &Mask, x: u32, y: u32) -> Option<u32> {
    mask.pixels().map(|(u, v)| u.abs_diff(x).pow(2) + v.abs_diff(y).pow(2)).min()
}

/// The size of the region that a pixel lies in, by walking through all of it.
fn size(mask: &Mask, pixel: (u32, u32), diagonals: bool) -> usize {
    let mut left = mask.clone();
    let mut walk = vec![pixel];
    let mut size = 0;
    while let Some((x, y)) = walk.pop() {
        if !left.get(x, y) {
            continue;
        }
        left.set(x, y, false);
        size += 1;
        for (v, u) in
            (y.saturating_sub(1)..y + 2).flat_map(|v| (x.saturating_sub(1)..x + 2).map(move |u| (v, u)))
        {
            if (diagonals || u == x || v == y) && left.get(u, v) {
                walk.push((u, v));
            }
        }
    }
    size
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn shapes_are_as_defined(mask in mask(), radius in 0.0..5.0f32, width in 1u32..4) {
        let (w, h) = (mask.width(), mask.height());
        let distances = mask.distances();
        for y in 0..h {
            for x in 0..w {
                let wanted = squared(&mask, x, y).map_or(f32::INFINITY, |d| (d as f32).sqrt());
                prop_assert_eq!(distances[(y * w + x) as usize], wanted);
            }
        }
        let near = |m: &Mask, x: u32, y: u32| squared(m, x, y).is_some_and(|d| d as f32 <= radius * radius);
        prop_assert_eq!(mask.dilated(radius), Mask::from_fn(w, h, |x, y| near(&mask, x, y)));
        let outside = mask.not();
        prop_assert_eq!(mask.eroded(radius), Mask::from_fn(w, h, |x, y| !near(&outside, x, y)));

        // The band: pixels of the mask with something else, or the frame's end, within `width` along both axes.
        let k = width as i64;
        let window = || (-k..=k).flat_map(move |v| (-k..=k).map(move |u| (u, v)));
        let at = |x: i64, y: i64| x >= 0 && y >= 0 && mask.get(x as u32, y as u32);
        let band = Mask::from_fn(w, h, |x, y| {
            mask.get(x, y) && window().any(|(u, v)| !at(i64::from(x) + u, i64::from(y) + v))
        });
        prop_assert_eq!(mask.boundary(width), band);

        // Neighbours share a label, labels are dense, and number as they first appear.
        let (labels, count) = mask.components();
        let mut seen = 0;
        for (i, &l) in labels.iter().enumerate() {
            prop_assert_eq!(l > 0, mask.index(i));
            prop_assert!(l <= seen + 1);
            seen = seen.max(l);
        }
        prop_assert_eq!(seen as usize, count);
        let label = |x: u32, y: u32| labels[(y * w + x) as usize];
        for (x, y) in mask.pixels() {
            for (u, v) in [(x + 1, y), (x, y + 1), (x + 1, y + 1), (x.wrapping_sub(1), y + 1)] {
                prop_assert!(!mask.get(u, v) || label(u, v) == label(x, y));
            }
        }
        // What is no speck, and then what is no hole.
        let least = 2 * width as usize;
        let islands = Mask::from_fn(w, h, |x, y| mask.get(x, y) && size(&mask, (x, y), true) >= least);
        let around = islands.not();
        let hole = |x: u32, y: u32| {
            !islands.is_empty() && around.get(x, y) && size(&around, (x, y), false) < least
        };
        let clean = Mask::from_fn(w, h, |x, y| islands.get(x, y) || hole(x, y));
        prop_assert_eq!(mask.without_specks(least), clean);
        // Every component is connected: flooding its first pixel by dilation reaches all of it.
        for l in 1..=count as u32 {
            let whole = Mask::from_fn(w, h, |x, y| label(x, y) == l);
            let (x, y) = whole.pixels().next().unwrap();
            let mut flood = Mask::from_fn(w, h, |u, v| (u, v) == (x, y));
            loop {
                let grown = flood.dilated(1.5).and(&whole);
                if grown == flood { break; }
                flood = grown;
            }
            prop_assert_eq!(flood, whole);
        }
        prop_assert_eq!(mask.fill_holes(0), mask.clone());
        prop_assert_eq!(mask.minus(&mask.fill_holes(9)).count(), 0);
    }
}

#[test]
fn holes_are_filled_up_to_their_area_and_only_when_closed() {
    let ring = |open: bool| {
        Mask::from_fn(9, 9, |x, y| {
            let hole = (3..6).contains(&x) && (3..6).contains(&y);
            (1..8).contains(&x) && (1..8).contains(&y) && !hole && !(open && y == 4 && x < 4)
        })
    };
    assert_eq!(ring(false).fill_holes(8), ring(false));
    assert_eq!(ring(false).fill_holes(9).count(), 49);
    assert_eq!(ring(true).fill_holes(1000), ring(true));
}

#[test]
fn boundary_iou_sees_what_iou_does_not() {
    let disc = |r: f32| Mask::from_fn(200, 150, |x, y| (x as f32 - 100.0).hypot(y as f32 - 75.0) < r);
    let (a, b) = (disc(60.0), disc(57.0));
    assert_eq!(a.boundary_iou(&a, 0.02), 1.0);
    assert!(a.iou(&b) > 0.9 && a.boundary_iou(&b, 0.02) < 0.45, "{}", a.boundary_iou(&b, 0.02));
    assert_eq!(Mask::empty(5, 5).boundary_iou(&Mask::empty(5, 5), 0.02), 1.0);
}

#[test]
fn specks_go_and_holes_close() {
    const W: u32 = 80;
    const H: u32 = 60;
    let block = |x0: u32, y0: u32, x1: u32, y1: u32| {
        Mask::from_fn(W, H, |x, y| x >= x0 && x < x1 && y >= y0 && y < y1)
    };
    let mut mask = block(10, 10, 50, 50);
    for (x, y) in [(20, 20), (21, 20), (70, 5), (71, 6)] {
        mask.set(x, y, !mask.get(x, y));
    }
    assert_eq!(mask.without_specks(5), block(10, 10, 50, 50));
    assert!(mask.without_specks(2).get(70, 5), "islands connect over corners");
    let mut diagonal = block(10, 10, 50, 50);
    diagonal.set(20, 20, false);
    diagonal.set(21, 21, false);
    assert_eq!(diagonal.without_specks(2), block(10, 10, 50, 50), "holes do not");
    assert_eq!(mask.without_specks(0), mask);
    assert!(block(0, 0, 3, 3).without_specks(10).is_empty());
    assert_eq!(Mask::full(W, H).without_specks(10), Mask::full(W, H));
    assert!(Mask::empty(W, H).without_specks(10_000).is_empty(), "an empty mask is not a hole");
}

#[test]
fn depths_end_at_the_outline_and_at_the_frame() {
    let strip = Mask::from_fn(9, 5, |x, _| x >= 4);
    let depths = strip.depths();
    let at = |x: usize, y: usize| depths[y * 9 + x];
    assert_eq!([at(3, 2), at(4, 2), at(6, 2), at(6, 0), at(8, 2)], [0.0, 1.0, 3.0, 1.0, 1.0]);
    assert_eq!(Mask::full(9, 5).depths()[2 * 9 + 4], 3.0, "nothing is outside but the frame");
    assert!(Mask::empty(9, 5).depths().iter().all(|depth| *depth == 0.0));
}
