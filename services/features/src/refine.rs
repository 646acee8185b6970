//! From targets to a feature field: lifting, then refinement by L_FE and L_Com (method, section 4).
//!
//! Geometry is only read: it is borrowed immutably, and the losses' gradients go no further than
//! [`Projected::gather`], the transpose of blending. So a view's projection never changes and is kept as long
//! as memory allows.

use crate::bilinear::bilinear;
use crate::{
    Compression, FeatureDecoder, FeatureError, FeatureField, FeatureSettings, Lifter, Pca, TargetSource,
    ViewTarget,
};
use segwild_objective::field::{
    AreaAverage, FeatureTarget, FieldLosses, FieldRefinement, FieldWeights, LearnedDecoder, Membership,
    SampledPixels,
};
use segwild_objective::{Engine, FieldBackend};
use segwild_raster::{ProjectOptions, Projected, Rasterizer};
use segwild_scene::{Embedding, Image, Random, Splats};
use std::any::Any;
use std::ops::ControlFlow;
use std::sync::{Arc, OnceLock};

/// Pixels trusted less than this take no part in compactness (method, section 4).
const TRUSTED: f32 = 0.5;

/// Every so many steps the losses are reported. Reading them back may have to wait for the device.
const LOSS_INTERVAL: usize = 20;

/// How far [`build`] is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Progress {
    /// A photo was lifted.
    Lifted {
        /// Photos done.
        done: usize,
        /// Photos in all.
        of: usize,
    },
    /// A step refined the field.
    Refined {
        /// Steps done.
        done: usize,
        /// Steps in all.
        of: usize,
        /// The losses on this step's photo, of the first and of every twentieth step.
        losses: Option<FieldLosses>,
    },
}

/// Makes a scene's feature field from its photos' targets: lifts all in order, then refines.
///
/// `progress` is called after every photo and step and may end the refinement early with
/// [`ControlFlow::Break`] (lifting is always completed: a half-lifted field is none).
pub fn build(
    engine: &dyn Engine,
    splats: &Splats,
    source: &dyn TargetSource,
    pca: &Pca,
    settings: &FeatureSettings,
    options: &ProjectOptions,
    progress: &mut dyn FnMut(Progress) -> ControlFlow<()>,
) -> Result<FeatureField, FeatureError> {
    let resident = engine.upload_splats(splats)?;
    let rasterizer = resident.as_deref().unwrap_or(engine);
    let mut views = Views::new(rasterizer, engine, splats, source, pca, settings, options);
    let mut lifter = Lifter::new(splats.len(), pca.channels);
    lifter.allocate_on_device(engine)?;
    for i in 0..source.len() {
        let view = views.get(i)?;
        let compressed = view.compressed(pca, settings.compression)?;
        let target = bilinear(&compressed, view.validity.width, view.validity.height);
        lifter.add(&view.target.name, view.projected.as_ref(), &target, &view.validity)?;
        // Lifting cannot stop half-way, so the answer is ignored.
        let _ = progress(Progress::Lifted { done: i + 1, of: source.len() });
    }
    let lifted = lifter.finish()?.values;
    let (values, learned) = refine(&mut views, pca, lifted, progress)?;
    FeatureField::rounded(pca.channels, &values, pca.clone(), learned.unwrap_or_else(|| pca.decoder()))
}

/// Refines features, `[splat][channel]`, flat. Returns them and the learned decoder, where there is one.
fn refine(
    views: &mut Views,
    pca: &Pca,
    values: Vec<f32>,
    progress: &mut dyn FnMut(Progress) -> ControlFlow<()>,
) -> Result<(Vec<f32>, Option<FeatureDecoder>), FeatureError> {
    let settings = views.settings;
    let (count, of) = (views.source.len(), settings.refine_steps as usize);
    if count == 0 || values.is_empty() {
        return Ok((values, None));
    }
    // It starts at the principal components' decoder: from a random one, features need tens of thousands of steps before they
    // are of use.
    let offsets: Vec<f32> = pca.mean.iter().map(|m| m * pca.scale).collect();
    let decoder = (settings.compression == Compression::Learned)
        .then(|| LearnedDecoder::new(&pca.basis, &offsets, settings.decoder_lr));
    let weights = FieldWeights {
        embedding: settings.weight_embedding,
        compact: settings.weight_compact,
        rate: settings.feature_lr,
    };
    let mut refinement = FieldRefinement::new(pca.channels, values, decoder, weights);
    refinement.upload(views.engine)?;
    let mut order: Vec<usize> = (0..count).collect();
    for step in 0..of {
        if step % count == 0 {
            Random::stream(settings.feature_seed, (step / count) as u64).draw(&mut order, count);
        }
        let photo = order[step % count];
        let view = views.get(photo)?;
        let unused = Members::default();
        let (members, pixels) = if settings.compactness && settings.weight_compact > 0.0 {
            let members = views.members(photo, &view)?;
            let mut random = Random::stream(!settings.feature_seed, step as u64);
            (members, members.draw(settings.pixels_per_step as usize, &mut random))
        } else {
            (&unused, Vec::new())
        };
        let rendered = SampledPixels { pixels: &pixels, membership: &members.membership };
        refinement.step(&*view.projected, &view.feature_target(), &rendered)?;
        let done = step + 1;
        let losses = if step == 0 || done % LOSS_INTERVAL == 0 { Some(refinement.losses()?) } else { None };
        if progress(Progress::Refined { done, of, losses }).is_break() {
            break;
        }
    }
    let refined = refinement.finish()?;
    let learned = refined.decoder.map(|mut weights| {
        weights.iter_mut().for_each(|w| *w /= pca.scale);
        let bias = weights.split_off(pca.basis.len());
        let embedding_channels = bias.len();
        FeatureDecoder { channels: pca.channels, embedding_channels, weights, bias }
    });
    Ok((refined.values, learned))
}

/// A view ready to be rendered and compared.
struct Prepared<'a> {
    projected: Box<dyn Projected + 'a>,
    target: Arc<ViewTarget>,
    /// By how much the target is multiplied to be in the field's units.
    scale: f32,
    /// VM at the render's size.
    validity: Image,
    /// VM on the target's grid.
    cell_validity: Vec<f32>,
    average: AreaAverage,
    /// The target in the engine's memory, if the engine keeps it there.
    on_device: Option<Box<dyn Any + Send + Sync>>,
    /// Which mask each pixel belongs to, once it was computed.
    members: OnceLock<Members>,
}

/// Which mask each pixel of a view belongs to.
#[derive(Default)]
struct Members {
    membership: Membership,
    /// Pixels that compactness may sample: trusted and in a mask.
    eligible: Vec<u32>,
}

impl Members {
    /// At most `most` of these pixels, sampled at random.
    fn draw(&self, most: usize, random: &mut Random) -> Vec<u32> {
        let mut pixels = self.eligible.clone();
        let count = pixels.len().min(most);
        random.draw(&mut pixels, count);
        pixels.truncate(count);
        pixels
    }
}

impl Prepared<'_> {
    /// The target that the view's rendered features are compared with.
    fn feature_target(&self) -> FeatureTarget<'_> {
        FeatureTarget {
            target: &self.target.target,
            scale: self.scale,
            validity: &self.cell_validity,
            average: &self.average,
            on_device: self.on_device.as_deref(),
        }
    }

    /// The target compressed to the field's channels.
    fn compressed(&self, pca: &Pca, compression: Compression) -> Result<Image, FeatureError> {
        let Image { width, height, channels, ref data } = self.target.target;
        match compression {
            Compression::Pca => Ok(self.target.target.clone()),
            Compression::Learned => {
                pca.encode(&self.target.name, &Embedding { width, height, channels, data: data.clone() })
            }
        }
    }
}

/// The prepared views, kept while memory allows.
struct Views<'a> {
    rasterizer: &'a dyn Rasterizer,
    engine: &'a dyn FieldBackend,
    splats: &'a Splats,
    source: &'a dyn TargetSource,
    settings: &'a FeatureSettings,
    options: &'a ProjectOptions,
    /// Channels and name of what targets must hold, and what they are multiplied by.
    wanted: (usize, &'static str),
    scale: f32,
    kept: Vec<Option<Arc<Prepared<'a>>>>,
    memory: usize,
}

impl<'a> Views<'a> {
    fn new(
        rasterizer: &'a dyn Rasterizer,
        engine: &'a dyn FieldBackend,
        splats: &'a Splats,
        source: &'a dyn TargetSource,
        pca: &Pca,
        settings: &'a FeatureSettings,
        options: &'a ProjectOptions,
    ) -> Views<'a> {
        let (wanted, scale) = match settings.compression {
            Compression::Pca => ((pca.channels, "the compressed embedding"), 1.0),
            Compression::Learned => ((pca.embedding_channels, "the embedding"), pca.scale),
        };
        let kept = (0..source.len()).map(|_| None).collect();
        let memory = settings.feature_memory as usize * (1 << 20);
        Views { rasterizer, engine, splats, source, settings, options, wanted, scale, kept, memory }
    }

    fn get(&mut self, i: usize) -> Result<Arc<Prepared<'a>>, FeatureError> {
        if let Some(view) = &self.kept[i] {
            return Ok(view.clone());
        }
        let mut view = self.prepare(i)?;
        // A projection holds its splats' screen-space state and its tiles' lists; the engine does not say how
        // much, so count generously.
        let visible = view.projected.radii().iter().filter(|&&r| r > 0.0).count();
        let pixels = 4 * view.validity.pixels() * 3;
        let bytes = 24 * self.splats.len() + 256 * visible + pixels + view.target.bytes();
        let keep = bytes <= self.memory;
        if keep {
            self.memory -= bytes;
            view.on_device = self.engine.upload_target(&view.feature_target())?;
        }
        let view = Arc::new(view);
        if keep {
            self.kept[i] = Some(view.clone());
        }
        Ok(view)
    }

    fn prepare(&self, i: usize) -> Result<Prepared<'a>, FeatureError> {
        let target = self.source.load(i)?;
        target.check()?;
        let (wanted, what) = self.wanted;
        let grid = &target.target;
        if grid.channels != wanted {
            return Err(FeatureError::Shape(format!(
                "{}: the target has {} channels, but {what} would have {wanted}",
                target.name, grid.channels
            )));
        }
        let camera = target.camera.scaled_to(self.settings.feature_size.max(1));
        let (w, h) = (camera.width as usize, camera.height as usize);
        let projected = self.rasterizer.project(self.splats, &camera, &target.pose, self.options)?;
        let mut vm = target.validity.clone();
        vm.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
        let cells = AreaAverage::new((vm.width, vm.height), (grid.width, grid.height)).forward(&vm).data;
        let validity = AreaAverage::new((vm.width, vm.height), (w, h)).forward(&vm);
        let average = AreaAverage::new((w, h), (grid.width, grid.height));
        let (scale, members) = (self.scale, OnceLock::new());
        Ok(Prepared {
            projected,
            scale,
            validity,
            cell_validity: cells,
            average,
            on_device: None,
            members,
            target,
        })
    }

    /// The mask membership of a view's pixels; the first call loads the masks.
    fn members<'v>(&self, i: usize, view: &'v Prepared) -> Result<&'v Members, FeatureError> {
        if let Some(members) = view.members.get() {
            return Ok(members);
        }
        let masks = self.source.masks(i, &view.target)?;
        view.target.check_masks(&masks)?;
        let membership = Membership::new(&masks, view.validity.width, view.validity.height);
        let eligible = (0..view.validity.pixels())
            .filter(|&p| membership.groups[p] != Membership::NONE && view.validity.data[p] >= TRUSTED)
            .map(|p| p as u32)
            .collect();
        Ok(view.members.get_or_init(|| Members { membership, eligible }))
    }
}
