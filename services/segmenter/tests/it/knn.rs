//! The neighbour graph against brute force, and its behaviour on hostile points.

use proptest::prelude::*;
use segwild_scene::{Splats, knn};
use segwild_segmenter::NeighbourGraph;
use std::collections::BTreeMap;

fn distance2(a: [f32; 3], b: [f32; 3]) -> f32 {
    let d = [0, 1, 2].map(|k| a[k] - b[k]);
    d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
}

fn brute(points: &[[f32; 3]], i: usize, k: usize) -> Vec<f32> {
    let finite = |p: &[f32; 3]| p.iter().all(|x| x.is_finite());
    let mut all: Vec<f32> = (0..points.len())
        .filter(|&j| j != i && finite(&points[i]) && finite(&points[j]))
        .map(|j| distance2(points[i], points[j]))
        .collect();
    all.sort_by(f32::total_cmp);
    all.resize(k.max(all.len()), f32::INFINITY);
    all.truncate(k);
    all
}

fn points() -> impl Strategy<Value = Vec<[f32; 3]>> {
    let coordinate = prop_oneof![
        6 => -1.0f32..1.0,
        // A coarse grid: many duplicates and ties.
        3 => (-3i32..3).prop_map(|x| x as f32),
        1 => prop_oneof![Just(f32::NAN), Just(f32::INFINITY), Just(1e-30), Just(1e6)],
    ];
    proptest::collection::vec(proptest::array::uniform3(coordinate), 0..200)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn neighbours_are_those_of_brute_force(points in points(), k in 1usize..14) {
        let found = knn::nearest(&points, k);
        for i in 0..points.len() {
            let row = i * k..(i + 1) * k;
            prop_assert_eq!(&found.distance2[row.clone()], &brute(&points, i, k)[..], "point {}", i);
            for (&j, &d) in found.index[row.clone()].iter().zip(&found.distance2[row]) {
                if j != knn::NONE {
                    prop_assert!(j as usize != i);
                    prop_assert_eq!(distance2(points[i], points[j as usize]), d);
                }
            }
        }
    }

    #[test]
    fn graph_is_symmetric_and_each_edge_occurs_once(points in points(), k in 1usize..8) {
        let graph = NeighbourGraph::of_points(&points, k);
        for i in 0..graph.len() {
            let row: Vec<usize> = graph.edges(i).map(|e| graph.neighbour(e)).collect();
            prop_assert!(row.windows(2).all(|w| w[0] < w[1]));
            for &j in &row {
                prop_assert!(graph.edges(j).any(|e| graph.neighbour(e) == i));
            }
        }
    }

    #[test]
    fn the_rows_of_a_graph_are_the_nearest_of_either_end_with_their_distances(
        points in points(),
        k in 1usize..8,
    ) {
        let (graph, nearest) = (NeighbourGraph::of_points(&points, k), knn::nearest(&points, k));
        let mut expected = vec![BTreeMap::new(); points.len()];
        for (at, (&j, &distance2)) in nearest.index.iter().zip(&nearest.distance2).enumerate() {
            if j != knn::NONE {
                expected[at / k].insert(j as usize, distance2.sqrt().to_bits());
                expected[j as usize].insert(at / k, distance2.sqrt().to_bits());
            }
        }
        prop_assert_eq!(graph.len(), points.len());
        for (i, expected) in expected.into_iter().enumerate() {
            let edges = graph.edges(i).map(|e| (graph.neighbour(e), graph.distance(e).to_bits()));
            prop_assert!(edges.eq(expected), "point {}", i);
        }
    }
}

#[test]
fn the_rows_of_many_points_are_those_of_either_end() {
    // More rows than one task takes, and more queries than are answered at once.
    let points = cloud(70_000, 5);
    let (graph, nearest) = (NeighbourGraph::of_points(&points, 4), knn::nearest(&points, 4));
    let mut links: Vec<(usize, usize)> = Vec::new();
    for (at, &j) in nearest.index.iter().enumerate() {
        links.extend([(at / 4, j as usize), (j as usize, at / 4)]);
    }
    links.sort_unstable();
    links.dedup();
    let edges = (0..graph.len()).flat_map(|i| graph.edges(i).map(move |e| (i, e)));
    assert!(edges.clone().map(|(i, e)| (i, graph.neighbour(e))).eq(links));
    let wrong = edges.filter(|&(i, e)| {
        graph.distance(e).to_bits() != distance2(points[i], points[graph.neighbour(e)]).sqrt().to_bits()
    });
    assert_eq!(wrong.count(), 0);
}

fn cloud(n: usize, seed: u64) -> Vec<[f32; 3]> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u64 << 24) as f32
    };
    (0..n).map(|_| [next(), next(), next() * 0.1]).collect()
}

fn splats_at(means: Vec<[f32; 3]>, scale: f32) -> Splats {
    let n = means.len();
    Splats {
        means,
        log_scales: vec![[scale.ln(); 3]; n],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacities: vec![2.0; n],
        sh_degree: 0,
        sh: vec![0.5; 3 * n],
    }
}

/// CPU seconds of the whole process so far.
#[cfg(target_os = "linux")]
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

#[cfg(target_os = "linux")]
#[test]
fn two_hundred_thousand_splats_take_a_second() {
    let points = cloud(200_000, 7);
    let start = cpu_seconds();
    let found = knn::nearest(&points, 10);
    let spent = cpu_seconds() - start;
    eprintln!("kNN of 200 k points: {spent:.2} CPU-s");
    assert!(spent < 1.5, "{spent} CPU-s");
    for i in (0..points.len()).step_by(50_021) {
        assert_eq!(&found.distance2[i * 10..(i + 1) * 10], &brute(&points, i, 10)[..]);
    }
}

#[test]
fn a_pile_of_duplicates_does_not_hang() {
    let found = knn::nearest(&vec![[0.25, 0.5, -1.0]; 50_000], 10);
    assert!(found.distance2.iter().all(|&d| d == 0.0));
    assert!(found.index.chunks(10).enumerate().all(|(i, row)| !row.contains(&(i as u32))));
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let points = cloud(20_000, 3);
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| knn::nearest(&points, 6))
    };
    assert_eq!(on(1), on(5));
}

#[test]
fn a_floater_connects_nothing() {
    // Two slabs 2 apart with one lone splat between them: the slabs are its neighbours, but it is not theirs.
    let mut points = cloud(2000, 1);
    points.extend(cloud(2000, 2).into_iter().map(|[x, y, z]| [x, y, z + 2.0]));
    points.push([0.5, 0.5, 1.05]);
    let splats = splats_at(points, 0.01);
    let graph = NeighbourGraph::new(&splats, 10);
    let (part, parts) = graph.components(&splats, &vec![true; splats.len()]);
    assert_eq!(parts, 3);
    assert!(part[..2000].iter().all(|p| *p == Some(0)) && part[2000..4000].iter().all(|p| *p == Some(1)));
    // A splat as large as the gap is no floater but a bridge.
    let mut bridged = splats.clone();
    bridged.log_scales[4000] = [0.5f32.ln(); 3];
    assert_eq!(graph.components(&bridged, &vec![true; splats.len()]).1, 1);
    // Restricted to a selection, the rest is as if it were not there.
    let selected: Vec<bool> = (0..4001).map(|i| i < 10).collect();
    assert!(graph.components(&splats, &selected).0[10..].iter().all(Option::is_none));
}
