//! Spectral globalisation (method, section 13): the eigenvectors of a graph's affinity tell how far two nodes are apart in the
//! whole graph, where a distance on an edge knows its two ends only.

use rayon::prelude::*;
use segwild_nn::eigen;

/// Vectors that are iterated together. The first is known; the last few only speed up the others.
const BLOCK: usize = 16;

/// Degree of the Chebyshev polynomial of each iteration.
const DEGREE: usize = 24;

/// Iterations: on graphs of 20,000 splats the embedding then changes by less than 1 % with each more.
const ITERATIONS: usize = 8;

/// Rows that one task sums: fixed, so that nothing depends on the number of threads.
const ROWS: usize = 1024;

/// Least distance of an eigenvalue from 1: vectors of parts that nothing connects would count without limit.
const LEAST_GAP: f64 = 1e-4;

/// Symmetric affinities as compressed rows.
pub struct Affinities {
    /// Where each row starts; one more than there are rows.
    pub offsets: Vec<u32>,
    /// Columns.
    pub columns: Vec<u32>,
    /// Affinities, over 0.
    pub values: Vec<f32>,
}

type Row = [f32; BLOCK];

impl Affinities {
    /// From undirected edges, each named once.
    pub fn of(nodes: usize, edges: impl Iterator<Item = (u32, u32, f32)> + Clone) -> Affinities {
        let mut offsets = vec![0u32; nodes + 1];
        for (a, b, _) in edges.clone() {
            offsets[a as usize + 1] += 1;
            offsets[b as usize + 1] += 1;
        }
        for i in 0..nodes {
            offsets[i + 1] += offsets[i];
        }
        let mut cursor = offsets.clone();
        let (mut columns, mut values) =
            (vec![0; offsets[nodes] as usize], vec![0.0; offsets[nodes] as usize]);
        for (a, b, x) in edges {
            for (from, to) in [(a, b), (b, a)] {
                let at = &mut cursor[from as usize];
                (columns[*at as usize], values[*at as usize]) = (to, x);
                *at += 1;
            }
        }
        Affinities { offsets, columns, values }
    }

    fn rows(&self) -> usize {
        self.offsets.len() - 1
    }

    fn row(&self, i: usize) -> std::ops::Range<usize> {
        self.offsets[i] as usize..self.offsets[i + 1] as usize
    }

    /// Sum of each row.
    fn degrees(&self) -> Vec<f64> {
        (0..self.rows()).map(|i| self.values[self.row(i)].iter().map(|&x| f64::from(x)).sum()).collect()
    }

    /// `out = scale (M x - shift x) - before`, for the affinities `M`.
    fn step(&self, x: &[Row], before: Option<&[Row]>, scale: f32, shift: f32, out: &mut [Row]) {
        out.par_iter_mut().enumerate().with_min_len(ROWS).for_each(|(i, out)| {
            let mut sum: Row = std::array::from_fn(|k| -shift * x[i][k]);
            for at in self.row(i) {
                let (value, row) = (self.values[at], &x[self.columns[at] as usize]);
                sum.iter_mut().zip(row).for_each(|(sum, x)| *sum += value * x);
            }
            *out = match before {
                Some(before) => std::array::from_fn(|k| scale * sum[k] - before[i][k]),
                None => sum.map(|s| scale * s),
            };
        });
    }
}

/// `count` numbers per node, at most 15: the eigenvectors of the largest eigenvalues under 1 of the normalised affinity, each
/// divided by the root of its eigenvalue's distance from 1 (Arbelaez et al., PAMI 2011, Eq. 12), so that slow vectors count
/// most. The same bytes whatever the number of threads.
pub fn embedding(affinities: Affinities, count: usize) -> Vec<f32> {
    let n = affinities.rows();
    let count = count.min(BLOCK - 1);
    let degrees = affinities.degrees();
    let root: Vec<f64> = degrees.iter().map(|d| d.sqrt()).collect();
    let mut normalised = affinities;
    for i in 0..n {
        for at in normalised.row(i) {
            let both = root[i] * root[normalised.columns[at] as usize];
            normalised.values[at] =
                if both > 0.0 { (f64::from(normalised.values[at]) / both) as f32 } else { 0.0 };
        }
    }
    // The first vector is the root of the degrees; the others start from fixed noise.
    let mut noise = 0x9e37_79b9_7f4a_7c15u64;
    let mut random = || {
        noise ^= noise << 13;
        noise ^= noise >> 7;
        noise ^= noise << 17;
        (noise >> 40) as f32 / (1u64 << 24) as f32 - 0.5
    };
    let mut x: Vec<Row> =
        (0..n).map(|i| std::array::from_fn(|k| if k == 0 { root[i] as f32 } else { random() })).collect();
    let (mut a, mut b) = (vec![[0.0; BLOCK]; n], vec![[0.0; BLOCK]; n]);
    let mut values = orthonormal(&normalised, &mut x, &mut b);
    for _ in 0..ITERATIONS {
        // Damp what lies between -1 and the least eigenvalue of the block.
        let top = values[BLOCK - 1].clamp(0.0, 0.9999);
        let (centre, half) = ((top - 1.0) / 2.0, (top + 1.0) / 2.0);
        normalised.step(&x, None, (1.0 / half) as f32, centre as f32, &mut a);
        for _ in 1..DEGREE {
            normalised.step(&a, Some(&x), (2.0 / half) as f32, centre as f32, &mut b);
            std::mem::swap(&mut x, &mut a);
            std::mem::swap(&mut a, &mut b);
        }
        std::mem::swap(&mut x, &mut a);
        values = orthonormal(&normalised, &mut x, &mut b);
    }
    drop((normalised, a, b));
    let scale: Vec<f64> = values.iter().map(|&v| 1.0 / (1.0 - v).max(LEAST_GAP).sqrt()).collect();
    let mut rows = Vec::with_capacity(n * count);
    for (row, root) in x.iter().zip(&root) {
        let inverse = if *root > 0.0 { 1.0 / root } else { 0.0 };
        rows.extend((1..=count).map(|k| (f64::from(row[k]) * scale[k] * inverse) as f32));
    }
    rows
}

/// Turns the vectors into orthonormal ones that are as near to eigenvectors as their span allows, in the order of falling
/// eigenvalues, which are returned (Rayleigh and Ritz). `mapped` is memory of the size of `x`, whatever it holds.
fn orthonormal(m: &Affinities, x: &mut [Row], mapped: &mut [Row]) -> Vec<f64> {
    // Vectors of one length first: a polynomial makes some large and some small.
    let square = products(x, x);
    let by: Row = std::array::from_fn(|k| {
        let length = square[k * BLOCK + k].sqrt();
        if length > 0.0 { (1.0 / length) as f32 } else { 0.0 }
    });
    x.par_iter_mut().with_min_len(ROWS).for_each(|row| row.iter_mut().zip(&by).for_each(|(x, by)| *x *= by));
    let (lengths, vectors) = eigen::symmetric(products(x, x), BLOCK);
    let mut whiten = vec![0.0; BLOCK * BLOCK];
    for (k, &length) in lengths.iter().enumerate() {
        let scale = if length > 1e-9 * lengths[0] { 1.0 / length.sqrt() } else { 0.0 };
        for j in 0..BLOCK {
            whiten[j * BLOCK + k] = scale * vectors[k * BLOCK + j];
        }
    }
    turn(x, &whiten);
    m.step(x, None, 1.0, 0.0, mapped);
    let (values, vectors) = eigen::symmetric(products(x, mapped), BLOCK);
    let mut rotation = vec![0.0; BLOCK * BLOCK];
    for k in 0..BLOCK {
        for j in 0..BLOCK {
            rotation[j * BLOCK + k] = vectors[k * BLOCK + j];
        }
    }
    turn(x, &rotation);
    values
}

/// Products of all pairs of vectors, symmetrised.
fn products(x: &[Row], y: &[Row]) -> Vec<f64> {
    let parts: Vec<Vec<f64>> = x
        .par_chunks(ROWS)
        .zip(y.par_chunks(ROWS))
        .map(|(x, y)| {
            let mut sums = vec![0.0; BLOCK * BLOCK];
            for (x, y) in x.iter().zip(y) {
                for (sums, &x) in sums.chunks_exact_mut(BLOCK).zip(x) {
                    sums.iter_mut().zip(y).for_each(|(sum, &y)| *sum += f64::from(x) * f64::from(y));
                }
            }
            sums
        })
        .collect();
    let mut sums = vec![0.0; BLOCK * BLOCK];
    for part in parts {
        sums.iter_mut().zip(part).for_each(|(sum, x)| *sum += x);
    }
    (0..BLOCK * BLOCK).map(|i| 0.5 * (sums[i] + sums[i % BLOCK * BLOCK + i / BLOCK])).collect()
}

/// Replaces each row by its product with a matrix.
fn turn(x: &mut [Row], by: &[f64]) {
    x.par_iter_mut().with_min_len(ROWS).for_each(|row| {
        let mut out = [0.0f64; BLOCK];
        for (&x, by) in row.iter().zip(by.chunks_exact(BLOCK)) {
            out.iter_mut().zip(by).for_each(|(out, by)| *out += f64::from(x) * by);
        }
        *row = out.map(|x| x as f32);
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A path of nodes, its links of affinity 1 but for one weak one.
    fn path(n: usize, weak: usize) -> Affinities {
        let edges = (0..n as u32 - 1).map(|i| (i, i + 1, if i as usize == weak { 0.01 } else { 1.0 }));
        Affinities::of(n, edges.collect::<Vec<_>>().into_iter())
    }

    #[test]
    fn the_first_vector_parts_a_graph_at_its_weakest_link() {
        let rows = embedding(path(200, 79), 3);
        let first = |i: usize| rows[i * 3];
        let (left, right) = (first(40), first(140));
        assert!(left * right < 0.0);
        assert!((0..200).all(|i| (first(i) * left > 0.0) == (i <= 79)));
        // Steepest at the weak link.
        let step = |i: usize| (first(i + 1) - first(i)).abs();
        assert!((0..199).filter(|&i| i != 79).all(|i| step(i) < step(79)));
    }

    /// Against a dense solver in f64.
    #[test]
    fn distances_are_those_of_the_exact_eigenvectors() {
        let (n, count) = (120, 4);
        let graph = path(n, 50);
        let degrees = graph.degrees();
        let mut dense = vec![0.0; n * n];
        for i in 0..n {
            for at in graph.row(i) {
                let j = graph.columns[at] as usize;
                dense[i * n + j] = f64::from(graph.values[at]) / (degrees[i] * degrees[j]).sqrt();
            }
        }
        let (values, vectors) = eigen::symmetric(dense, n);
        let rows = embedding(graph, count);
        for (i, j) in [(0, 119), (10, 90), (49, 52), (70, 71)] {
            let exact =
                |i: usize, k: usize| vectors[k * n + i] / degrees[i].sqrt() / (1.0 - values[k]).sqrt();
            let wanted: f64 = (1..=count).map(|k| (exact(i, k) - exact(j, k)).powi(2)).sum::<f64>().sqrt();
            let got: f64 = (0..count)
                .map(|k| f64::from(rows[i * count + k] - rows[j * count + k]).powi(2))
                .sum::<f64>()
                .sqrt();
            assert!((got - wanted).abs() < 0.02 * wanted, "{i} {j}: {got} {wanted}");
        }
    }

    #[test]
    fn the_same_bytes_on_one_thread_and_on_many() {
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| embedding(path(5000, 2000), 12))
        };
        assert_eq!(on(1), on(4));
    }

    #[test]
    fn nodes_without_links_are_no_numbers_of_their_own() {
        let graph = Affinities::of(40, [(0u32, 1u32, 1.0f32), (1, 2, 1.0)].into_iter());
        assert!(embedding(graph, 5).iter().all(|x| x.is_finite()));
        assert!(embedding(Affinities::of(0, std::iter::empty()), 5).is_empty());
    }
}
