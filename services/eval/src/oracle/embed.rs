//! The oracle's embedding: a descriptor per thing, mixed, offset and noisy.

use super::truth::{Oracle, Thing};
use segwild_scene::{Embedding, Image};
use segwild_synthetic::random::Rng;
use segwild_vision::{Embedder, VisionError};
use std::collections::BTreeMap;

impl Oracle {
    fn descriptor(&self, stream: u64) -> Vec<f32> {
        let mut rng = Rng::new(self.options.seed, stream);
        let raw: Vec<f32> = (0..self.options.channels).map(|_| rng.normal()).collect();
        let length = raw.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-6);
        raw.into_iter().map(|v| v / length).collect()
    }

    fn instance_descriptor(&self, id: u16) -> Vec<f32> {
        let own = self.descriptor(1 << 53 | u64::from(id));
        let similarity = self.options.embedding_similarity.clamp(0.0, 1.0);
        if similarity == 0.0 || !self.built[usize::from(id)] {
            return own;
        }
        let shared = self.descriptor(1 << 55);
        let (a, b) = (similarity.sqrt(), (1.0 - similarity).sqrt());
        shared.iter().zip(own).map(|(shared, own)| a * shared + b * own).collect()
    }
}

impl Embedder for Oracle {
    fn key(&self) -> String {
        self.key.clone()
    }

    fn embed(&self, image: &Image) -> Result<Embedding, VisionError> {
        let sight = self.recognise(image)?;
        let o = &self.options;
        let long = image.width.max(image.height) as f32;
        let side = |n: usize| ((n as f32 / long * o.cells as f32).round() as usize).max(1);
        let (width, height, n) = (side(image.width), side(image.height), o.channels);
        let mut descriptors: BTreeMap<Thing, Vec<f32>> = BTreeMap::new();
        let mut data = vec![0.0; n * width * height];
        let offset = self.descriptor(1 << 50 | sight.view as u64);
        let mut rng = Rng::new(o.seed, 1 << 51 | (sight.view as u64) << 1 | u64::from(sight.transients));
        const GRID: usize = 3;
        let noise_scale = o.noise / (n as f32).sqrt();
        for cell in 0..width * height {
            // The mean over the cell: descriptors mix across borders, as a network's do.
            for sample in 0..GRID * GRID {
                let at = |cell: usize, sub: usize, cells: usize, full: usize| {
                    (cell as f32 + (sub as f32 + 0.5) / GRID as f32) / cells as f32 * full as f32
                };
                let x = at(cell % width, sample % GRID, width, image.width);
                let y = at(cell / width, sample / GRID, height, image.height);
                let thing = self.thing_at(sight, image, x, y, true);
                let descriptor = descriptors.entry(thing).or_insert_with(|| match thing {
                    Thing::Transient(id) => {
                        self.descriptor(1 << 52 | (sight.view as u64) << 20 | u64::from(id))
                    }
                    Thing::Instance(id) => self.instance_descriptor(id),
                    Thing::Part(id) => {
                        let whole = self.instance_descriptor(self.instance_of[usize::from(id)]);
                        let part = self.descriptor(1 << 54 | u64::from(id));
                        whole.iter().zip(part).map(|(w, p)| w + o.part_code * p).collect()
                    }
                });
                for c in 0..n {
                    data[c * width * height + cell] += descriptor[c] / (GRID * GRID) as f32;
                }
            }
            for c in 0..n {
                data[c * width * height + cell] += o.offset * offset[c] + noise_scale * rng.normal();
            }
        }
        Ok(Embedding { width, height, channels: n, data })
    }
}
