//! What a training on the device has: splats with their moments, embeddings, networks, sums for density control.

use crate::GpuError;
use crate::bin::Cloud;
use crate::compare::GpuPhotoCache;
use crate::device::{DeviceWork, GpuDevice, PooledBuffer};
use crate::nets::GpuNetworks;
use segwild_objective::{EmbedAppearance, TrainingSplats};
use segwild_scene::Splats;
use std::sync::Arc;

/// Splats or their moments.
pub(crate) struct GpuParameters {
    pub shapes: Arc<Cloud>,
    /// `[splat][basis function][r, g, b]`.
    pub sh: PooledBuffer,
}

impl GpuParameters {
    pub fn upload(work: &mut DeviceWork, splats: &Splats) -> Result<GpuParameters, GpuError> {
        let shapes = Arc::new(Cloud::upload(work, splats)?);
        Ok(GpuParameters { shapes, sh: work.upload("the splats' harmonics", &splats.sh)? })
    }

    pub fn read(&self, work: &mut DeviceWork, sh_degree: u32) -> Result<Splats, GpuError> {
        let mut splats = Splats { sh_degree, ..Splats::default() };
        self.shapes.read(work, &mut splats)?;
        splats.sh = work.read(&self.sh, self.shapes.splats * splats.sh_stride())?;
        Ok(splats)
    }
}

/// Appearance embeddings of splats and their moments.
pub(crate) struct GpuSplatEmbeddings {
    pub values: PooledBuffer,
    pub first: PooledBuffer,
    pub second: PooledBuffer,
    /// Length of an embedding.
    pub width: usize,
}

impl GpuSplatEmbeddings {
    /// Numbers of an embedding before those of the appearance model `embed`.
    pub fn before(&self) -> usize {
        self.width - EmbedAppearance::EMBEDDING_SIZE
    }

    /// A job over so many splats, for the part of the appearance model `embed`.
    pub fn job(&self, splats: usize) -> [u32; 4] {
        [splats, self.width / 4, self.before() / 4, 0].map(|n| n as u32)
    }
}

/// Splats in training on the device.
pub(crate) struct GpuTraining {
    pub device: Arc<GpuDevice>,
    pub photos_on_device: Arc<GpuPhotoCache>,
    pub sh_degree: u32,
    pub splats: GpuParameters,
    pub first: GpuParameters,
    pub second: GpuParameters,
    /// For density control: gradient, error, steps, radius.
    pub sums: PooledBuffer,
    pub splat_embeddings: Option<GpuSplatEmbeddings>,
    pub networks: Option<GpuNetworks>,
}

impl GpuTraining {
    pub fn upload(
        device: &Arc<GpuDevice>,
        photos_on_device: &Arc<GpuPhotoCache>,
        state: &TrainingSplats,
    ) -> Result<GpuTraining, GpuError> {
        let mut work = device.work();
        Ok(GpuTraining {
            sh_degree: state.splats.sh_degree,
            splats: GpuParameters::upload(&mut work, &state.splats)?,
            first: GpuParameters::upload(&mut work, &state.first)?,
            second: GpuParameters::upload(&mut work, &state.second)?,
            sums: work.upload("the sums for density control", &state.sums)?,
            splat_embeddings: match &state.splat_embeddings.values {
                none if none.is_empty() => None,
                values => Some(GpuSplatEmbeddings {
                    values: work.upload("the splats' embeddings", values)?,
                    first: work.upload("the embeddings' first moments", &state.splat_embeddings.first)?,
                    second: work.upload("the embeddings' second moments", &state.splat_embeddings.second)?,
                    width: values.len() / state.splats.len(),
                }),
            },
            networks: match &state.networks {
                Some(networks) => Some(GpuNetworks::upload(&mut work, networks)?),
                None => None,
            },
            device: device.clone(),
            photos_on_device: photos_on_device.clone(),
        })
    }

    /// Numbers of a splat's harmonics.
    pub fn sh_stride(&self) -> usize {
        3 * (self.sh_degree as usize + 1).pow(2)
    }
}
