//! A step of the appearance model `gsw` on the device: a network of the photo, and small ones of the splats in sight.
//! Splats pass through them piece by piece, so that activations take the same memory whatever their number. Twin:
//! `objective/src/appearance/gsw/points.rs`.

use super::plan::{GpuTape, GpuWeights, Link, NetworkPlan};
use crate::GpuError;
use crate::device::{DeviceWork, PooledBuffer};
use crate::groups::GROUP;
use crate::shaders::{
    COMPACT_IN_SIGHT, GSW_COLOURS, GSW_COLOURS_BACKWARD, GSW_INPUTS, GSW_INPUTS_BACKWARD, IN_SIGHT, MAP_SUMS,
    VISIBILITY_GRADIENT,
};
use crate::sort::{scan, sort};
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use segwild_nn::Mlp;
use segwild_objective::gsw::{DYNAMIC, HIDDEN_LAYER, INTRINSIC, LAYER, MAPS, Networks, OFF_MAP, VECTOR};
use segwild_objective::{GswWidth, NetworksStep, TrainingNetworks, UNetInput};
use segwild_scene::NEAR;

/// Splats of a piece, at most.
pub(crate) const PIECE: usize = 1 << 15;

/// The networks with their optimiser state.
pub(crate) struct GpuNetworks {
    pub width: GswWidth,
    pub weights: PooledBuffer,
    pub first: PooledBuffer,
    pub second: PooledBuffer,
}

impl GpuNetworks {
    pub fn upload(work: &mut DeviceWork, networks: &TrainingNetworks) -> Result<GpuNetworks, GpuError> {
        Ok(GpuNetworks {
            width: networks.width,
            weights: work.upload("the networks' weights", &networks.weights)?,
            first: work.upload("the weights' first moments", &networks.first)?,
            second: work.upload("the weights' second moments", &networks.second)?,
        })
    }

    pub fn read(&self, work: &mut DeviceWork) -> Result<TrainingNetworks, GpuError> {
        let mut read = |of: &PooledBuffer| work.read(of, self.len());
        let [weights, first, second] = [read(&self.weights)?, read(&self.first)?, read(&self.second)?];
        Ok(TrainingNetworks { width: self.width, weights, first, second })
    }

    pub fn nets(&self) -> &'static Networks {
        Networks::of(self.width)
    }

    /// Number of weights.
    pub fn len(&self) -> usize {
        self.nets().layout.len() + LAYER
    }
}

/// Layout of the planes of splats: inputs and outputs of each network.
struct Planes {
    links: Vec<Link>,
    /// Inputs of the network for vectors: light first, `made` planes of it.
    fuse: usize,
    made: usize,
    /// Inputs of the network for colours: the vector, and the direction.
    colour: usize,
    /// Colours.
    output: usize,
    /// Shares of the spots on the maps.
    spots: usize,
    all: usize,
}

impl Planes {
    fn of(nets: &Networks) -> Planes {
        let mut all = nets.light.ends().0;
        let mut take = |planes: usize| {
            all += planes;
            all - planes
        };
        let made = nets.light.ends().1;
        let (fuse, colour) = (take(made + INTRINSIC), take(VECTOR + 3));
        let (hidden_layer, output, spots) = (take(HIDDEN_LAYER), take(3), take(2 * (MAPS + 1)));
        let mut links = Vec::new();
        // A chain's first input and last output have fixed planes; planes of inner layers are its own.
        let mut chain = |mlp: &Mlp, shift: usize, from: usize, to: usize, wanted: usize| {
            let (mut at, mut wanted) = (from, Some(wanted));
            let last = mlp.layers().count() - 1;
            for (k, ([input, output], weights, relu)) in mlp.layers().enumerate() {
                let to = if k == last { to } else { take(output) };
                links.push(Link {
                    weights: weights.start + shift..weights.end + shift,
                    input,
                    output,
                    from: at,
                    to,
                    relu,
                    wanted: wanted.take().unwrap_or(input),
                });
                at = to;
            }
        };
        chain(&nets.light, 0, 0, fuse, DYNAMIC + INTRINSIC);
        chain(&nets.fuse, 0, fuse, colour, made + INTRINSIC);
        chain(&nets.colour, 0, colour, hidden_layer, VECTOR);
        chain(&nets.last, nets.layout.len(), hidden_layer, output, HIDDEN_LAYER);
        Planes { links, fuse, made, colour, output, spots, all }
    }
}

/// `Reader` of `shaders/shared/reader.wgsl`.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct ReaderUniform {
    pose: [[f32; 4]; 3],
    lens: [f32; 4],
    frame: [f32; 4],
    eye: [f32; 4],
    map: [u32; 4],
    capacity: [u32; 4],
    more: [u32; 4],
}

/// A photo with the maps of its network.
struct PhotoPass {
    plan: NetworkPlan,
    tape: GpuTape,
    given: PooledBuffer,
    /// Numbers of the input.
    numbers: usize,
    /// Width and height of the image.
    size: [usize; 2],
    whole: bool,
}

/// One step of the networks.
pub(crate) struct NetworkLighting<'a> {
    networks: &'a GpuNetworks,
    photo: Option<PhotoPass>,
    points: NetworkPlan,
    tape: GpuTape,
    planes: Planes,
    reader: PooledBuffer,
    capacity: usize,
    splats: usize,
    /// Splats in sight, and how many.
    which: PooledBuffer,
    count: PooledBuffer,
    /// Keys of the reads of a piece (map and pixel), and the index of each.
    keys: PooledBuffer,
    items: PooledBuffer,
    /// Gradients of all weights.
    pub weight_grads: PooledBuffer,
}

/// The visibility map of a photo.
pub(crate) struct Visible<'a> {
    pub maps: &'a PooledBuffer,
    /// Where it starts in the maps, before the sigmoid.
    pub position: usize,
    /// Width and height.
    pub size: [usize; 2],
    /// Whether it may replace the robust mask.
    pub decides: bool,
}

impl<'a> NetworkLighting<'a> {
    /// Uploads the inputs of a step; `eye` is the camera's centre, `splats` their number, `piece` the largest piece.
    pub fn upload(
        work: &mut DeviceWork,
        networks: &'a GpuNetworks,
        step: &NetworksStep,
        eye: Vec3,
        splats: usize,
        piece: usize,
    ) -> Result<NetworkLighting<'a>, GpuError> {
        let nets = networks.nets();
        let planes = Planes::of(nets);
        let capacity = splats.clamp(1, piece);
        let points = NetworkPlan::of_points(&planes.links, planes.all, capacity);
        let tape = GpuTape::new(work, &points)?;
        let photo = step
            .unet_input
            .as_ref()
            .map(|unet_input| PhotoPass::upload(work, nets, unet_input))
            .transpose()?;
        let at = |plane: usize| (plane * capacity) as u32;
        let mut reader = ReaderUniform {
            eye: [eye.x, eye.y, eye.z, 0.0],
            capacity: [capacity as u32, 0, at(planes.fuse), at(planes.colour)],
            more: [at(planes.spots), planes.made as u32, nets.octaves as u32, step.draw as u32],
            ..ReaderUniform::zeroed()
        };
        if let (Some(photo), Some(unet_input)) = (&photo, &step.unet_input) {
            let (camera, pose) = unet_input.image_conditioning.stand();
            let [width, height] = photo.size.map(|n| (n / 2) as u32);
            reader.pose = *pose;
            reader.lens = [camera.fx, camera.fy, camera.cx, camera.cy];
            let off_map = OFF_MAP / splats as f32;
            reader.frame = [camera.width as f32, camera.height as f32, NEAR, off_map];
            reader.map = [width, height, photo.plan.position(nets.unet.maps) as u32, 1];
        }
        let reads = (MAPS + 1) * capacity;
        Ok(NetworkLighting {
            reader: work.upload("the camera and layout of light", &[reader])?,
            items: work.take::<u32>("the splats' numbers", reads)?,
            which: work.take::<u32>("the splats in sight", splats)?,
            count: work.take::<u32>("how many are in sight", 1)?,
            keys: work.take::<u32>("where splats read", reads)?,
            weight_grads: work.take::<f32>("the weights' gradients", networks.len())?,
            networks,
            photo,
            points,
            tape,
            planes,
            capacity,
            splats,
        })
    }

    /// The photo's visibility map, if its network saw all of it; once colours were tinted.
    pub fn visible(&self, decides: bool) -> Option<Visible<'_>> {
        let PhotoPass { plan, tape, size, .. } = self.photo.as_ref().filter(|photo| photo.whole)?;
        let position = plan.position(self.networks.nets().unet.plane);
        Some(Visible { maps: &tape.maps, position, size: size.map(|n| n / 4), decides })
    }

    /// Adds the photo's light to the colours of the splats in sight. `seen` are their depths and radii, `means` their
    /// centres.
    pub fn tint(
        &self,
        work: &mut DeviceWork,
        seen: &PooledBuffer,
        means: &PooledBuffer,
        splat_embeddings: &PooledBuffer,
        colours: &PooledBuffer,
    ) -> Result<(), GpuError> {
        let n = self.splats;
        let positions = work.take::<u32>("positions of the splats in sight", n + 1)?;
        let job = [n as u32, 0, 0, 0];
        work.run(&IN_SIGHT, 1, job, &[seen, &positions], (n + 1).div_ceil(GROUP));
        scan(work, &positions, n + 1)?;
        work.run(
            &COMPACT_IN_SIGHT,
            1,
            job,
            &[&positions, &self.which, &self.count],
            n.max(1).div_ceil(GROUP),
        );
        if let Some(photo) = &self.photo {
            work.copy_to(&photo.given, &photo.tape.maps, 0, 4 * photo.numbers);
            photo.tape.forward(work, &photo.plan, &self.networks.weights, &self.count, 0);
        }
        for first in self.pieces() {
            self.run_piece(work, first, means, splat_embeddings);
            let output = (self.planes.output * self.capacity) as u32;
            let job = [self.capacity as u32, first as u32, output, 0];
            let buffers = [&self.which, &self.count, &self.tape.maps, colours];
            work.run(&GSW_COLOURS, 1, job, &buffers, self.capacity.div_ceil(GROUP));
        }
        Ok(())
    }

    fn pieces(&self) -> impl Iterator<Item = usize> + use<> {
        (0..self.splats).step_by(self.capacity)
    }

    /// Runs the small networks on the piece that starts with a splat in sight.
    fn run_piece(
        &self,
        work: &mut DeviceWork,
        first: usize,
        means: &PooledBuffer,
        splat_embeddings: &PooledBuffer,
    ) {
        // Without a photo this binding is not read.
        let maps = self.photo.as_ref().map_or(means, |photo| &photo.tape.maps);
        let job = [self.splats as u32, first as u32, 0, 0];
        let NetworkLighting { reader, which, count, tape, keys, items, .. } = self;
        let buffers = [reader, which, count, means, splat_embeddings, maps, &tape.maps, keys, items];
        work.run(&GSW_INPUTS, 1, job, &buffers, self.capacity.div_ceil(GROUP));
        tape.forward(work, &self.points, &self.networks.weights, count, first);
    }

    /// Gradients of the embeddings of splats in sight, without the base model's part, and of all weights, from those of
    /// the colours that [`NetworkLighting::tint`] returned and from the `part_residuals` that the visibility
    /// map learns from.
    pub fn backward(
        &self,
        work: &mut DeviceWork,
        by_colour: &PooledBuffer,
        (means, splat_embeddings): (&PooledBuffer, &PooledBuffer),
        by_embedding: &PooledBuffer,
        part_residuals: Option<&PooledBuffer>,
    ) -> Result<(), GpuError> {
        let NetworkLighting { networks, photo, reader, which, count, tape, capacity, .. } = self;
        let weights = GpuWeights { values: &networks.weights, grads: &self.weight_grads };
        let each = capacity.div_ceil(GROUP);
        work.clear(&self.weight_grads);
        let maps = photo.as_ref().map_or(means, |photo| &photo.tape.maps);
        for first in self.pieces() {
            // Activations of a single piece are still there.
            if self.splats > *capacity {
                self.run_piece(work, first, means, splat_embeddings);
            }
            let output = (self.planes.output * capacity) as u32;
            let job = [*capacity as u32, first as u32, output, 0];
            work.run(&GSW_COLOURS_BACKWARD, 1, job, &[which, count, by_colour, &tape.grads], each);
            tape.backward(work, &self.points, weights, count, first);
            let job = [self.splats as u32, first as u32, 0, 0];
            let buffers = [reader, which, count, splat_embeddings, maps, &tape.grads, by_embedding];
            work.run(&GSW_INPUTS_BACKWARD, 1, job, &buffers, each);
            if let Some(photo) = photo {
                self.sum_maps(work, photo, first)?;
            }
        }
        if let Some(PhotoPass { plan, tape, size, .. }) = photo {
            let parts = size.iter().map(|n| n / 4).product::<usize>();
            let position = plan.position(networks.nets().unet.plane);
            let job = [parts as u32, position as u32, u32::from(part_residuals.is_some()), 0];
            // Without residuals this binding is not read.
            let part_residuals = part_residuals.unwrap_or(&self.items);
            work.run(&VISIBILITY_GRADIENT, 1, job, &[part_residuals, &tape.maps, &tape.grads], 1);
            tape.backward(work, plan, weights, count, 0);
        }
        Ok(())
    }

    /// Adds the gradients of the light that a piece read to those of the photo's maps.
    fn sum_maps(&self, work: &mut DeviceWork, photo: &PhotoPass, first: usize) -> Result<(), GpuError> {
        let count = (MAPS + 1) * self.capacity;
        let pixels = photo.size.iter().map(|n| n / 2).product::<usize>();
        let [keys, items] =
            [work.take::<u32>("where splats read", count)?, work.take::<u32>("splats", count)?];
        work.copy_to(&self.keys, &keys, 0, 4 * count);
        work.copy_to(&self.items, &items, 0, 4 * count);
        let bits = u32::BITS - (((MAPS + 1) * (pixels + 1)) as u32).leading_zeros();
        let (keys, items) = sort(work, keys, items, count, bits)?;
        let job = [0, first as u32, 0, 0];
        let GpuTape { maps, grads, .. } = &self.tape;
        let buffers = [&self.reader, &keys, &items, maps, grads, &photo.tape.grads];
        work.run(&MAP_SUMS, 1, job, &buffers, ((MAPS + 1) * pixels).div_ceil(GROUP));
        Ok(())
    }
}

impl PhotoPass {
    fn upload(work: &mut DeviceWork, nets: &Networks, unet_input: &UNetInput) -> Result<PhotoPass, GpuError> {
        let image = &unet_input.image;
        let plan = NetworkPlan::of(&nets.unet.graph, [image.height, image.width]);
        let given = [image.data.as_slice(), &unet_input.beside.data].concat();
        Ok(PhotoPass {
            given: work.upload("the photo for its network", &given)?,
            tape: GpuTape::new(work, &plan)?,
            plan,
            numbers: given.len(),
            size: [image.width, image.height],
            whole: unet_input.whole,
        })
    }
}

/// [`NetworkPlan::floor`] of all networks of a width together, for a photo as long as they take it on all sides and so many splats in
/// sight.
pub(crate) fn floor(width: GswWidth, splats: usize) -> (f64, f64) {
    let nets = Networks::of(width);
    let planes = Planes::of(nets);
    let (bytes, operations) = NetworkPlan::of(&nets.unet.graph, [nets.side; 2]).floor(nets.border);
    let small = nets.layout.len() - nets.border + LAYER;
    let (more, others) = NetworkPlan::of_points(&planes.links, planes.all, splats).floor(small);
    (bytes + more, operations + others)
}

/// Estimated bytes that networks take on the device, without the splats' embeddings, to be trained on so many splats.
pub(crate) fn bytes(width: GswWidth, splats: usize) -> usize {
    let nets = Networks::of(width);
    let planes = Planes::of(nets);
    let capacity = splats.clamp(1, PIECE);
    let photo = NetworkPlan::of(&nets.unet.graph, [nets.side; 2]);
    let weights = 4 * 4 * (nets.layout.len() + LAYER);
    NetworkPlan::of_points(&planes.links, planes.all, capacity).bytes() + photo.bytes() + weights + 4 * splats
}
