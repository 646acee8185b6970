//! Test cases of the feature field, for the device and the host.

use segwild_objective::field::{
    AreaAverage, FeatureTarget, FieldRefinement, FieldWeights, LearnedDecoder, Membership, SampledPixels,
};
use segwild_scene::{Image, Mask, MaskSet, Random, ScoredMask};

/// Sizes of a test case.
#[derive(Clone, Copy, Debug)]
pub struct FeatureCase {
    /// Width and height of its view.
    pub size: (u32, u32),
    /// Numbers of a splat.
    pub channels: usize,
    /// What they are decoded to, if a decoder learns.
    pub decoded: Option<usize>,
    /// Columns and rows of cells.
    pub grid: [usize; 2],
    /// Sampled pixels.
    pub pixels: usize,
    /// Masks that hold some.
    pub masks: usize,
}

/// A test case with random numbers.
pub struct FeatureCaseData {
    target: Image,
    /// How much each cell of the target is trusted.
    pub validity: Vec<f32>,
    average: AreaAverage,
    /// Positions of the sampled pixels.
    pub pixels: Vec<u32>,
    membership: Membership,
}

impl FeatureCaseData {
    /// The feature target.
    pub fn feature_target(&self) -> FeatureTarget<'_> {
        let FeatureCaseData { target, validity, average, .. } = self;
        FeatureTarget { target, scale: 0.7, validity, average, on_device: None }
    }

    /// The sampled pixels.
    pub fn sampled_pixels(&self) -> SampledPixels<'_> {
        SampledPixels { pixels: &self.pixels, membership: &self.membership }
    }
}

impl FeatureCase {
    /// Samples the numbers of the case.
    pub fn make(&self, random: &mut Random) -> FeatureCaseData {
        let size = self.size;
        let (width, height) = (size.0 as usize, size.1 as usize);
        let [columns, rows] = self.grid;
        let mut target = Image::zeros(columns, rows, self.decoded.unwrap_or(self.channels));
        target.data.iter_mut().for_each(|v| *v = random.uniform() - 0.5);
        // Rectangles, some within others; some pixels are in none.
        let masks = (0..self.masks).map(|k| {
            let [x, y] = [random.below(width) as u32, random.below(height) as u32];
            let side = 4 + (k % 7 * 5) as u32;
            let within = move |v: u32, start: u32| v >= start && v < start + side;
            let mask = Mask::from_fn(size.0, size.1, |px, py| within(px, x) && within(py, y));
            ScoredMask { mask, predicted_iou: 1.0, stability: 1.0 }
        });
        let masks = MaskSet { width: size.0, height: size.1, masks: masks.collect() };
        let mut pixels: Vec<u32> = (0..size.0 * size.1).collect();
        random.draw(&mut pixels, self.pixels);
        pixels.truncate(self.pixels);
        FeatureCaseData {
            target,
            validity: (0..columns * rows).map(|_| random.uniform()).collect(),
            average: AreaAverage::new((width, height), (columns, rows)),
            pixels,
            membership: Membership::new(&masks, width, height),
        }
    }

    /// A view of features, all of which have a direction.
    pub fn image(&self, random: &mut Random) -> Image {
        let mut image = Image::zeros(self.size.0 as usize, self.size.1 as usize, self.channels);
        image.data.iter_mut().for_each(|v| *v = random.uniform() - 0.3);
        image
    }

    /// Features to be refined.
    pub fn refinement(&self, values: Vec<f32>, weights: FieldWeights) -> FieldRefinement {
        let random = &mut Random::new(8);
        let decoder = self.decoded.map(|outputs| {
            let mut many = |n: usize| (0..n).map(|_| random.uniform() - 0.5).collect::<Vec<_>>();
            LearnedDecoder::new(&many(self.channels * outputs), &many(outputs), weights.rate)
        });
        FieldRefinement::new(self.channels, values, decoder, weights)
    }
}
