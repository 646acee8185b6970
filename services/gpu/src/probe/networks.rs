//! Networks on the device: one alone, and those of the appearance model `gsw` over the splats in sight.

use super::device_passes::DevicePasses;
use crate::device::{DeviceWork, PooledBuffer};
use crate::nets::{GpuNetworks, GpuTape, GpuWeights, NetworkLighting, NetworkPlan, floor};
use crate::{GpuEngine, GpuError};
use glam::Vec3;
use segwild_nn::{Map, NetworkGraph};
use segwild_objective::gsw::EMBEDDING_SIZE;
use segwild_objective::{GswWidth, NetworksStep, TrainingNetworks};

/// A network's maps and gradients after one run forward and backward.
pub struct NetworkRun {
    plan: NetworkPlan,
    maps: Vec<f32>,
    /// Gradients of all weights.
    pub weight_grads: Vec<f32>,
}

impl NetworkRun {
    /// The first `count` numbers of a map, by its number in the graph.
    pub fn map(&self, id: usize, count: usize) -> &[f32] {
        &self.maps[self.plan.position(id)..][..count]
    }
}

/// Runs a network forward on inputs of one height and width, or half of these, and backward from the gradients
/// `output_grads` of some of its maps, by their numbers in the graph.
///
/// # Errors
/// When the device refuses or fails.
pub fn run_network(
    engine: &GpuEngine,
    graph: &NetworkGraph,
    weights: &[f32],
    inputs: &[Map],
    output_grads: &[(usize, Map)],
) -> Result<NetworkRun, GpuError> {
    let numbers: Vec<f32> = inputs.iter().flat_map(|map| map.data.iter().copied()).collect();
    let plan = NetworkPlan::of(graph, [inputs[0].height, inputs[0].width]);
    let work = &mut engine.device.work();
    let values = work.upload("weights", weights)?;
    let grads = work.upload("gradients", &vec![0.0f32; weights.len()])?;
    let any = work.upload("splats in sight", &[0u32])?;
    let up = work.upload("inputs of the network", &numbers)?;
    let mut uploaded = Vec::new();
    for (id, map) in output_grads {
        uploaded.push((*id, map.data.len(), work.upload("gradients", &map.data)?));
    }
    let tape = GpuTape::new(work, &plan)?;
    work.copy_to(&up, &tape.maps, 0, 4 * numbers.len());
    tape.forward(work, &plan, &values, &any, 0);
    for (id, numbers, output_grad) in uploaded {
        work.copy_to(&output_grad, &tape.grads, 4 * plan.position(id), 4 * numbers);
    }
    tape.backward(work, &plan, GpuWeights { values: &values, grads: &grads }, &any, 0);
    let maps = work.read(&tape.maps, plan.maps())?;
    let weight_grads = work.read(&grads, weights.len())?;
    Ok(NetworkRun { plan, maps, weight_grads })
}

/// Least bytes that the networks of a width move forward and backward, for a photo as long as they take it on all
/// sides and so many splats in sight, and their operations.
pub fn networks_floor(width: GswWidth, splats: usize) -> (f64, f64) {
    floor(width, splats)
}

/// The networks of the appearance model `gsw` on the device.
pub struct UploadedNetworks(GpuNetworks);

impl UploadedNetworks {
    /// Uploads them.
    ///
    /// # Errors
    /// When they do not fit.
    pub fn upload(engine: &GpuEngine, networks: &TrainingNetworks) -> Result<UploadedNetworks, GpuError> {
        GpuNetworks::upload(&mut engine.device.work(), networks).map(UploadedNetworks)
    }
}

/// What the networks left.
pub struct LightingResults {
    /// Tinted colours; the fourth number has no meaning.
    pub colours: Vec<[f32; 4]>,
    /// Gradients of the splats' embeddings, `[splat][EMBEDDING_SIZE]`.
    pub embedding_grads: Vec<f32>,
    /// Gradients of all weights.
    pub weight_grads: Vec<f32>,
}

/// One step of the networks over splats.
pub struct LightingPasses<'e> {
    work: DeviceWork<'e>,
    lighting: NetworkLighting<'e>,
    weights: usize,
    splats: usize,
    seen: PooledBuffer,
    means: PooledBuffer,
    embeddings: PooledBuffer,
    colours: PooledBuffer,
    by_embedding: PooledBuffer,
}

impl<'e> LightingPasses<'e> {
    /// Uploads splats with centres `means`, `radii` in pixels (0: out of sight), embeddings of
    /// [`EMBEDDING_SIZE`] numbers and colours of 3, seen from `eye`, and the inputs of a step. Networks take at most
    /// `piece` splats at once; as many as in a training where there is none.
    ///
    /// # Errors
    /// When they do not fit.
    pub fn upload(
        engine: &'e GpuEngine,
        networks: &'e UploadedNetworks,
        step: &NetworksStep,
        eye: Vec3,
        (means, radii): (&[[f32; 3]], &[f32]),
        (embeddings, colours): (&[f32], &[f32]),
        piece: Option<usize>,
    ) -> Result<LightingPasses<'e>, GpuError> {
        let splats = means.len();
        let mut work = engine.device.work();
        let seen: Vec<[f32; 4]> = radii.iter().map(|&radius| [1.0, radius, 0.0, 0.0]).collect();
        let means: Vec<[f32; 4]> = means.iter().map(|&[x, y, z]| [x, y, z, 0.0]).collect();
        let seen = work.upload("depths and radii", &seen)?;
        let means = work.upload("centres", &means)?;
        let embeddings = work.upload("the splats' embeddings", embeddings)?;
        let colours = work.upload("the splats' colours", &wide(colours))?;
        let piece = piece.unwrap_or(crate::nets::PIECE);
        let lighting = NetworkLighting::upload(&mut work, &networks.0, step, eye, splats, piece)?;
        let by_embedding = work.take::<f32>("the embeddings' gradients", splats * EMBEDDING_SIZE)?;
        work.clear(&by_embedding);
        let weights = networks.0.len();
        Ok(LightingPasses { work, lighting, weights, splats, seen, means, embeddings, colours, by_embedding })
    }

    /// Tints the colours.
    ///
    /// # Errors
    /// When memory does not suffice.
    pub fn tint(&mut self) -> Result<(), GpuError> {
        let LightingPasses { work, lighting, seen, means, embeddings, colours, .. } = self;
        lighting.tint(work, seen, means, embeddings, colours)
    }

    /// Gradients from those of the colours, which the colours themselves stand for.
    ///
    /// # Errors
    /// When memory does not suffice.
    pub fn backward(&mut self) -> Result<(), GpuError> {
        let LightingPasses { work, lighting, means, embeddings, colours, by_embedding, .. } = self;
        lighting.backward(work, colours, (means, embeddings), by_embedding, None)
    }

    /// Tints the colours, computes gradients from those of the colours, `[splat][3]`, and from the `part_residuals` that
    /// the visibility map learns from, and downloads all.
    ///
    /// # Errors
    /// When memory does not suffice, or the device fails.
    pub fn results(
        &mut self,
        colour_grads: &[f32],
        part_residuals: Option<&[f32]>,
    ) -> Result<LightingResults, GpuError> {
        let by_colour = self.work.upload("gradients", &wide(colour_grads))?;
        let part_residuals = part_residuals
            .map(|part_residuals| self.work.upload("the residuals of parts of the photo", part_residuals))
            .transpose()?;
        self.tint()?;
        let LightingPasses { work, lighting, means, embeddings, colours, by_embedding, .. } = self;
        lighting.backward(work, &by_colour, (means, embeddings), by_embedding, part_residuals.as_ref())?;
        Ok(LightingResults {
            colours: work.read(colours, self.splats)?,
            embedding_grads: work.read(by_embedding, self.splats * EMBEDDING_SIZE)?,
            weight_grads: work.read(&lighting.weight_grads, self.weights)?,
        })
    }
}

impl DevicePasses for LightingPasses<'_> {
    fn wait(&mut self) -> Result<(), GpuError> {
        self.work.wait()
    }
}

/// Colours of 3 numbers as the device holds them.
fn wide(colours: &[f32]) -> Vec<[f32; 4]> {
    colours.chunks_exact(3).map(|v| [v[0], v[1], v[2], 1.0]).collect()
}
