//! Every layer against plain f64 loops: its result, and its gradients by central differences of the loops.

use segwild_nn::{
    BilinearSample, Conv, GroupNorm, Map, Mlp, UNet, UNetShape, Up, WeightLayout, scatter, take,
};

/// Numbers in [-1, 1).
struct TestNoise(u64);

impl TestNoise {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (self.0 >> 40) as f32 / (1 << 23) as f32 - 1.0
    }

    fn vec(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.next()).collect()
    }

    fn map(&mut self, channels: usize, height: usize, width: usize) -> Map {
        Map { channels, height, width, data: self.vec(channels * height * width) }
    }
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

fn close(what: &str, found: &[f32], exact: &[f64]) {
    assert_eq!(found.len(), exact.len(), "{what}: length");
    let size = exact.iter().fold(1.0f64, |m, v| m.max(v.abs()));
    for (i, (a, b)) in found.iter().zip(exact).enumerate() {
        assert!((f64::from(*a) - b).abs() < 2e-5 * size, "{what} at {i}: {a} instead of {b}");
    }
}

/// Checks gradients of `sum of pull * f(values)` for a plain f64 `f` by central differences.
fn differences(what: &str, values: &[f32], pull: &[f32], found: &[f32], f: impl Fn(&[f64]) -> Vec<f64>) {
    assert_eq!(values.len(), found.len(), "{what}: length");
    let loss = |v: &[f64]| f(v).iter().zip(pull).map(|(y, p)| y * f64::from(*p)).sum::<f64>();
    let mut at = wide(values);
    let step = 1e-5;
    let size = found.iter().fold(1.0f64, |m, v| m.max(f64::from(v.abs())));
    for i in 0..values.len() {
        let middle = at[i];
        at[i] = middle + step;
        let above = loss(&at);
        at[i] = middle - step;
        let below = loss(&at);
        at[i] = middle;
        let exact = (above - below) / (2.0 * step);
        assert!(
            (f64::from(found[i]) - exact).abs() < 1e-4 * size,
            "{what} {i}: {} instead of {exact}",
            found[i]
        );
    }
}

fn conv_plain(
    w: &[f64],
    x: &[f64],
    [input, output, kernel, stride]: [usize; 4],
    [height, width]: [usize; 2],
) -> Vec<f64> {
    let (h, v) = (height.div_ceil(stride), width.div_ceil(stride));
    let border = (kernel / 2) as isize;
    let mut out = Vec::new();
    for o in 0..output {
        for y in 0..h {
            for u in 0..v {
                let mut sum = w[output * input * kernel * kernel + o];
                for c in 0..input {
                    for i in 0..kernel {
                        for j in 0..kernel {
                            let yy = (y * stride + i) as isize - border;
                            let xx = (u * stride + j) as isize - border;
                            if yy >= 0 && xx >= 0 && (yy as usize) < height && (xx as usize) < width {
                                let at = (c * height + yy as usize) * width + xx as usize;
                                sum += w[((o * input + c) * kernel + i) * kernel + j] * x[at];
                            }
                        }
                    }
                }
                out.push(sum);
            }
        }
    }
    out
}

#[test]
fn convolutions() {
    let mut noise = TestNoise(1);
    let forms = [
        ([3, 5, 3, 1], [7, 9]),
        ([2, 7, 3, 2], [8, 6]),
        ([2, 3, 3, 2], [7, 5]),
        ([4, 3, 1, 1], [5, 6]),
        ([3, 4, 1, 2], [6, 8]),
        ([2, 3, 7, 2], [12, 10]),
        ([1, 66, 3, 1], [11, 13]),
        ([1, 2, 3, 1], [40, 33]),
    ];
    for (form, [height, width]) in forms {
        let [input, output, kernel, stride] = form;
        let mut layout = WeightLayout::new();
        // A layer before it: weights must be taken from the right offset.
        Conv::new(&mut layout, "other", [1, 1], 1, 1);
        let conv = Conv::new(&mut layout, "conv", [input, output], kernel, stride);
        let weights = noise.vec(layout.len());
        let own = layout.layers()[1].weights.clone();
        let x = noise.map(input, height, width);
        let y = conv.forward(&weights, &x);
        let what = format!("{form:?}");
        close(
            &what,
            &y.data,
            &conv_plain(&wide(&weights[own.clone()]), &wide(&x.data), form, [height, width]),
        );
        let pull = noise.map(y.channels, y.height, y.width);
        let mut sums = vec![0.0; layout.len()];
        let grad = conv.backward(&weights, &x, &pull, &mut sums, true).unwrap();
        let w = wide(&weights[own.clone()]);
        differences(&what, &x.data, &pull.data, &grad.data, |x| conv_plain(&w, x, form, [height, width]));
        let v = wide(&x.data);
        let found = &sums[own.clone()];
        differences(&what, &weights[own], &pull.data, found, |w| conv_plain(w, &v, form, [height, width]));
        assert_eq!(sums[..2], [0.0; 2], "another layer's weights");
    }
}

#[test]
fn transposed_convolutions() {
    let (input, output, height, width) = (3, 5, 4, 6);
    let plain = |w: &[f64], x: &[f64]| {
        let mut out = vec![0.0; output * 4 * height * width];
        for o in 0..output {
            for y in 0..2 * height {
                for u in 0..2 * width {
                    let mut sum = w[4 * output * input + o];
                    for c in 0..input {
                        let tap = w[(4 * o + 2 * (y % 2) + u % 2) * input + c];
                        sum += tap * x[(c * height + y / 2) * width + u / 2];
                    }
                    out[(o * 2 * height + y) * 2 * width + u] = sum;
                }
            }
        }
        out
    };
    let mut noise = TestNoise(2);
    let mut layout = WeightLayout::new();
    let up = Up::new(&mut layout, "up", [input, output]);
    let weights = noise.vec(layout.len());
    let x = noise.map(input, height, width);
    let y = up.forward(&weights, &x);
    close("up", &y.data, &plain(&wide(&weights), &wide(&x.data)));
    let pull = noise.map(y.channels, y.height, y.width);
    let mut sums = vec![0.0; layout.len()];
    let grad = up.backward(&weights, &x, &pull, &mut sums);
    differences("input", &x.data, &pull.data, &grad.data, |x| plain(&wide(&weights), x));
    differences("weights", &weights, &pull.data, &sums, |w| plain(w, &wide(&x.data)));
}

#[test]
fn group_and_instance_norms() {
    let (channels, n) = (6, 4 * 5);
    for groups in [1, 3, 6] {
        let plain = |w: &[f64], x: &[f64]| {
            let size = channels / groups * n;
            let mut out = Vec::new();
            for (g, group) in x.chunks(size).enumerate() {
                let mean = group.iter().sum::<f64>() / size as f64;
                let variance = group.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / size as f64;
                for (k, v) in group.iter().enumerate() {
                    let c = g * channels / groups + k / n;
                    out.push((v - mean) / (variance + 1e-5).sqrt() * w[c] + w[channels + c]);
                }
            }
            out
        };
        let mut noise = TestNoise(3);
        let mut layout = WeightLayout::new();
        let norm = GroupNorm::new(&mut layout, "norm", channels, groups);
        let weights = noise.vec(layout.len());
        let x = noise.map(channels, 4, 5);
        let (y, state) = norm.forward(&weights, x.clone());
        close("norm", &y.data, &plain(&wide(&weights), &wide(&x.data)));
        let pull = noise.map(channels, 4, 5);
        let mut sums = vec![0.0; layout.len()];
        let grad = norm.backward(&weights, &state, pull.clone(), &mut sums);
        differences("input", &x.data, &pull.data, &grad.data, |x| plain(&wide(&weights), x));
        differences("weights", &weights, &pull.data, &sums, |w| plain(w, &wide(&x.data)));
    }
}

#[test]
fn relu_passes_what_is_above_zero() {
    let mut noise = TestNoise(4);
    let x = noise.map(2, 3, 5);
    let y = x.clone().relu();
    let pull = noise.map(2, 3, 5);
    let grad = pull.clone().relu_backward(&y);
    let plain = |x: &[f64]| x.iter().map(|v| v.max(0.0)).collect::<Vec<_>>();
    close("relu", &y.data, &plain(&wide(&x.data)));
    differences("relu", &x.data, &pull.data, &grad.data, plain);
}

#[test]
fn dense_layers() {
    let sizes = [5, 19, 16, 3];
    let points = 13;
    for last_relu in [false, true] {
        let plain = |w: &[f64], x: &[f64]| {
            let mut x = x.to_vec();
            let mut from = 0;
            for (layer, pair) in sizes.windows(2).enumerate() {
                let (input, output) = (pair[0], pair[1]);
                let (matrix, offsets) = w[from..].split_at(input * output);
                let mut out = Vec::new();
                for point in x.chunks(input) {
                    for o in 0..output {
                        let sum =
                            (0..input).map(|i| point[i] * matrix[i * output + o]).sum::<f64>() + offsets[o];
                        out.push(if layer < 2 || last_relu { sum.max(0.0) } else { sum });
                    }
                }
                from += input * output + output;
                x = out;
            }
            x
        };
        let mut noise = TestNoise(5);
        let mut layout = WeightLayout::new();
        Conv::new(&mut layout, "other", [1, 1], 1, 1);
        let mlp = Mlp::new(&mut layout, "mlp", &sizes, last_relu);
        let weights = noise.vec(layout.len());
        let own = &weights[mlp.range()];
        let x = noise.vec(points * sizes[0]);
        let made = mlp.forward(&weights, x.clone());
        close("dense", made.result(), &plain(&wide(own), &wide(&x)));
        let pull = noise.vec(points * sizes[3]);
        let mut sums = vec![0.0; mlp.range().len()];
        let turned = mlp.turned(&weights);
        let grad = mlp.backward(&turned, &made, pull.clone(), &mut sums, sizes[0]);
        differences("input", &x, &pull, &grad, |x| plain(&wide(own), x));
        differences("weights", own, &pull, &sums, |w| plain(w, &wide(&x)));
        // Only the first numbers' gradient.
        let some = mlp.backward(&turned, &made, pull.clone(), &mut sums, 2);
        for (some, all) in some.chunks(2).zip(grad.chunks(sizes[0])) {
            assert_eq!(some, &all[..2]);
        }
    }
}

#[test]
fn bilinear_reading() {
    let mut noise = TestNoise(6);
    for (width, height) in [(7, 5), (1, 4), (6, 1), (1, 1)] {
        let map = noise.map(3, height, width);
        let pixels = take(&map, 0, 3);
        let plain = |map: &[f64], at: &[f64]| {
            let axis = |v: f64, n: usize| {
                let p = ((v + 1.0) / 2.0 * (n - 1) as f64).clamp(0.0, (n - 1) as f64);
                let low = (p.floor() as usize).min(n.saturating_sub(2));
                (low, (low + 1).min(n - 1), p - low as f64)
            };
            let ((x0, x1, fx), (y0, y1, fy)) = (axis(at[0], width), axis(at[1], height));
            let at = |c: usize, y: usize, x: usize| map[(c * height + y) * width + x];
            (0..3)
                .map(|c| {
                    let row = |y| (1.0 - fx) * at(c, y, x0) + fx * at(c, y, x1);
                    (1.0 - fy) * row(y0) + fy * row(y1)
                })
                .collect::<Vec<_>>()
        };
        for _ in 0..20 {
            let at = [1.3 * noise.next(), 1.3 * noise.next()];
            let spot = BilinearSample::new(width, height, at);
            let mut read = vec![0.0; 3];
            spot.read(&pixels, &mut read);
            close("read", &read, &plain(&wide(&map.data), &wide(&at)));
            let pull = noise.vec(3);
            let mut sums = vec![0.0; pixels.len()];
            spot.add(&pull, &mut sums);
            let mut grad = Map::zeros(3, height, width);
            scatter(&sums, &mut grad, 0, 3);
            differences("map", &map.data, &pull, &grad.data, |m| plain(m, &wide(&at)));
            let slope = spot.slope(&pull, &pixels);
            differences("point", &at, &pull, &slope, |at| plain(&wide(&map.data), at));
        }
    }
    // NaN or far outside: clamped to a point on the map.
    for at in [[f32::NAN, 0.0], [f32::INFINITY, f32::NEG_INFINITY], [1e30, -1e30]] {
        let mut read = [0.0];
        BilinearSample::new(4, 4, at).read(&[0.5; 16], &mut read);
        assert_eq!(read, [0.5]);
    }
}

fn shape() -> UNetShape {
    UNetShape {
        input: 4,
        stem: 3,
        encoder: [8, 8, 16, 16, 24],
        blocks: 2,
        decoder: [16, 8, 8, 8],
        beside: 2,
        output: 6,
        head: [8, 8, 8],
    }
}

#[test]
fn a_whole_network_falls_as_its_gradient_says_whatever_the_number_of_threads() {
    let mut layout = WeightLayout::new();
    let net = UNet::new(&mut layout, ["net", "head"], &shape());
    let mut noise = TestNoise(7);
    let weights = layout.initial_weights(|| 1.7 * noise.next());
    let (image, beside) = (noise.map(4, 64, 96), noise.map(2, 32, 48));
    let pull = noise.map(6, 32, 48);
    let head_pull = noise.map(1, 16, 24);
    let dot = |a: &Map, b: &Map| a.data.iter().zip(&b.data).map(|(a, b)| f64::from(a * b)).sum::<f64>();
    let run = |weights: &[f32]| {
        let tape = net.forward(weights, image.clone(), beside.clone());
        (dot(tape.of(net.maps), &pull) + dot(tape.of(net.plane), &head_pull), tape)
    };
    let gradient = || {
        let (_, tape) = run(&weights);
        let mut sums = vec![0.0; layout.len()];
        net.backward(&weights, &tape, pull.clone(), Some(head_pull.clone()), &mut sums);
        sums
    };
    let pool = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
    let sums = pool(1).install(gradient);
    assert!(sums == pool(3).install(gradient), "threads matter");
    // Along the gradient of one layer after the other: the loss changes by its square length.
    for layer in layout.layers() {
        let own = layer.weights.clone();
        let length = sums[own.clone()].iter().map(|g| f64::from(*g).powi(2)).sum::<f64>();
        assert!(length > 0.0, "{} gets no gradient", layer.name);
        let size = weights[own.clone()].iter().map(|w| f64::from(*w).powi(2)).sum::<f64>().sqrt().max(1.0);
        let step = 5e-5 * size / length.sqrt();
        let moved = |sign: f64| {
            let mut weights = weights.clone();
            for i in own.clone() {
                weights[i] += (sign * step * f64::from(sums[i])) as f32;
            }
            run(&weights).0
        };
        let change = (moved(1.0) - moved(-1.0)) / (2.0 * step);
        let off = (change - length).abs() / length;
        assert!(off < 0.05, "{}: {change} instead of {length}", layer.name);
    }
}

#[test]
fn a_poisoned_image_stays_where_it_is_and_does_not_panic() {
    let mut layout = WeightLayout::new();
    let net = UNet::new(&mut layout, ["net", "head"], &shape());
    let mut noise = TestNoise(8);
    let weights = layout.initial_weights(|| 1.7 * noise.next());
    for poison in [f32::NAN, f32::INFINITY, -f32::MAX, f32::MIN_POSITIVE / 4.0] {
        let mut image = noise.map(4, 32, 32);
        image.data[500] = poison;
        let tape = net.forward(&weights, image, Map::zeros(2, 16, 16));
        let mut sums = vec![0.0; layout.len()];
        net.backward(&weights, &tape, noise.map(6, 16, 16), None, &mut sums);
        if poison.abs() < 1.0 {
            assert!(sums.iter().all(|g| g.is_finite()), "a denormal number is a number");
        }
    }
    // An image without any contrast has no variance to divide by.
    let tape = net.forward(&weights, Map::zeros(4, 32, 32), Map::zeros(2, 16, 16));
    let mut sums = vec![0.0; layout.len()];
    net.backward(&weights, &tape, noise.map(6, 16, 16), None, &mut sums);
    assert!(tape.of(net.maps).data.iter().chain(&sums).all(|v| v.is_finite()));
}

#[test]
fn a_network_learns_to_copy_an_image_at_half_its_size() {
    let mut layout = WeightLayout::new();
    let net = UNet::new(&mut layout, ["net", "head"], &UNetShape { output: 1, ..shape() });
    let mut noise = TestNoise(9);
    let mut weights = layout.initial_weights(|| 1.7 * noise.next());
    let image = noise.map(4, 32, 64);
    let beside = Map::zeros(2, 16, 32);
    // The target: the second plane, every other pixel.
    let wanted: Vec<f32> = (0..16 * 32).map(|i| image.plane(1)[2 * (i / 32) * 64 + 2 * (i % 32)]).collect();
    let mut losses = Vec::new();
    for _ in 0..150 {
        let tape = net.forward(&weights, image.clone(), beside.clone());
        let mut grad = tape.of(net.maps).clone();
        grad.data.iter_mut().zip(&wanted).for_each(|(v, w)| *v -= w);
        losses.push(grad.data.iter().map(|v| v * v).sum::<f32>() / wanted.len() as f32);
        let mut sums = vec![0.0; layout.len()];
        net.backward(&weights, &tape, grad, None, &mut sums);
        weights.iter_mut().zip(&sums).for_each(|(w, g)| *w -= 2e-4 * g);
    }
    let (first, last) = (losses[0], losses[149]);
    assert!(last < 0.1 * first, "{first} fell to {last} only");
}
