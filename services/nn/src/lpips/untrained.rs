//! Weights that nobody trained, for tests and measurements: the trained ones cannot be had everywhere.

use super::LpipsNet;

/// Numbers in [-1, 1), the same in Python: a hash (`lowbias32`) of the index and of a stream's number.
pub(super) fn noise(stream: u32, count: usize) -> impl Iterator<Item = f32> {
    (0..count as u32).map(move |i| {
        let mut x = i ^ stream.wrapping_mul(0x9e37_79b9);
        x = (x ^ x >> 16).wrapping_mul(0x7feb_352d);
        x = (x ^ x >> 15).wrapping_mul(0x846c_a68b);
        x ^= x >> 16;
        (x >> 8) as f32 / (1 << 23) as f32 - 1.0
    })
}

/// A file of tensors: the entries of its header, and its numbers.
#[derive(Clone, Default)]
pub(super) struct TensorFile {
    pub entries: Vec<String>,
    pub data: Vec<u8>,
}

impl TensorFile {
    fn put(&mut self, key: &str, shape: &[usize], numbers: impl Iterator<Item = f32>) {
        let from = self.data.len();
        self.data.extend(numbers.flat_map(f32::to_le_bytes));
        let to = self.data.len();
        self.entries
            .push(format!(r#""{key}":{{"dtype":"F32","shape":{shape:?},"data_offsets":[{from},{to}]}}"#));
    }

    pub fn bytes(&self) -> Vec<u8> {
        let header = format!("{{{}}}", self.entries.join(","));
        [&(header.len() as u64).to_le_bytes(), header.as_bytes(), &self.data].concat()
    }
}

/// The tensors of a network with random weights of the size that keeps the features' size from layer to layer.
pub(super) fn tensors(net: LpipsNet) -> TensorFile {
    let mut file = TensorFile::default();
    let forms = net.layers();
    for (k, form) in forms.iter().filter(|form| form.compared).enumerate() {
        let weights = noise(100 + k as u32, form.planes[1]).map(|v| (v + 1.0) * 0.25);
        file.put(&format!("lin{k}.model.1.weight"), &[1, form.planes[1], 1, 1], weights);
    }
    for (l, form) in (0..).zip(forms) {
        let ([input, output], k) = (form.planes, form.kernel);
        let fan_in = input * k * k;
        let size = (6.0 / fan_in as f64).sqrt() as f32;
        file.put(&format!("{}.bias", form.key), &[output], noise(2 * l + 2, output).map(|v| v * 0.05));
        let weights = noise(2 * l + 1, output * fan_in).map(|v| v * size);
        file.put(&format!("{}.weight", form.key), &[output, input, k, k], weights);
    }
    file.put("scaling_layer.scale", &[1, 3, 1, 1], [0.458, 0.448, 0.45].into_iter());
    file.put("scaling_layer.shift", &[1, 3, 1, 1], [-0.03, -0.088, -0.188].into_iter());
    file
}

impl LpipsNet {
    /// A file as [`Lpips::parse`](super::Lpips::parse) reads it, with random weights, the same each time. Its distances grow
    /// with the difference of two images, and are no scores.
    pub fn untrained(self) -> Vec<u8> {
        tensors(self).bytes()
    }
}
