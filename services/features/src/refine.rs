//! From targets to a feature field: lifting, then refinement by L_FE and L_Com (method, section 4).
//!
//! Geometry is only read: it is borrowed immutably, and the losses' gradients go no further than
//! [`Projected::gather`], the transpose of blending. So a view's projection never changes and is kept as long
//! as memory allows.

use crate::compact::compactness;
use crate::embedding_loss::{LearnedDecoder, embedding_loss};
use crate::grid::{AreaAverage, bilinear};
use crate::{
    Compression, FeatureError, FeatureField, FeatureSettings, Lifter, Membership, Pca, TargetSource,
    ViewTarget,
};
use segwild_raster::{Engine, Learning, ProjectOptions, Projected};
use segwild_scene::Random;
use segwild_scene::{Embedding, Image, Splats};
use std::ops::ControlFlow;
use std::sync::{Arc, OnceLock};

/// Pixels trusted less than this take no part in compactness (method, section 4).
const TRUSTED: f32 = 0.5;

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
        /// Embedding loss on this step's photo, before weighting.
        embedding: f32,
        /// Compactness loss on this step's photo, before weighting; 0 when it is off or the photo has no masks.
        compact: f32,
    },
}

/// Makes a scene's feature field from its photos' targets: lifts all in order, then refines.
///
/// `progress` hears of every photo and step and may end the refinement early with
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
    let held = engine.hold(splats)?;
    let engine = held.as_deref().unwrap_or(engine);
    let mut views = Views::new(engine, splats, source, pca, settings, options);
    let mut lifter = Lifter::new(splats.len(), pca.channels);
    lifter.settle(engine)?;
    for i in 0..source.len() {
        let view = views.get(i)?;
        let codes = view.codes(pca, settings.compression)?;
        let target = bilinear(&codes, view.validity.width, view.validity.height);
        lifter.add(&view.target.name, view.projected.as_ref(), &target, &view.validity)?;
        // Lifting cannot stop half-way, so the answer is not asked for.
        let _ = progress(Progress::Lifted { done: i + 1, of: source.len() });
    }
    let mut field = FeatureField {
        channels: pca.channels,
        values: lifter.finish()?.values,
        pca: pca.clone(),
        decoder: pca.decoder(),
    };
    refine(&mut views, &mut field, progress)?;
    Ok(field)
}

/// Refines `field` in place.
fn refine(
    views: &mut Views,
    field: &mut FeatureField,
    progress: &mut dyn FnMut(Progress) -> ControlFlow<()>,
) -> Result<(), FeatureError> {
    let settings = views.settings;
    let count = views.source.len();
    if count == 0 || field.is_empty() {
        return Ok(());
    }
    let channels = field.channels;
    let mut rows = Learning::new(channels, std::mem::take(&mut field.values), settings.feature_lr);
    rows.settle(views.engine)?;
    let mut decoder = (settings.compression == Compression::Learned)
        .then(|| LearnedDecoder::new(&field.pca, settings.decoder_lr));
    let mut order: Vec<usize> = (0..count).collect();
    for step in 0..settings.refine_steps as usize {
        if step % count == 0 {
            Random::stream(settings.feature_seed, (step / count) as u64).draw(&mut order, count);
        }
        let view = views.get(order[step % count])?;
        let frame = view.projected.blend_learning(&rows)?;
        let mut grad = Image::zeros(frame.image.width, frame.image.height, channels);

        let rendered = view.average.forward(&frame.image);
        let mut cell_grad = Image::zeros(rendered.width, rendered.height, channels);
        let embedding = match &mut decoder {
            Some(decoder) => {
                decoder.step(&rendered, &view.target.target, &view.cell_validity, &mut cell_grad)
            }
            None => embedding_loss(&rendered, &view.target.target, &view.cell_validity, &mut cell_grad),
        };
        view.average.transposed(&cell_grad, settings.weight_embedding, &mut grad);

        let mut compact = 0.0;
        if settings.compactness && settings.weight_compact > 0.0 {
            let mut random = Random::stream(!settings.feature_seed, step as u64);
            let members = views.members(order[step % count], &view)?;
            compact = add_compactness(members, &frame.image, settings, &mut random, &mut grad);
        }
        view.projected.learn(&mut rows, &grad)?;
        let done =
            Progress::Refined { done: step + 1, of: settings.refine_steps as usize, embedding, compact };
        if progress(done).is_break() {
            break;
        }
    }
    field.values = rows.finish()?;
    if let Some(decoder) = decoder {
        field.decoder = decoder.finish();
    }
    Ok(())
}

/// A view ready to be rendered and compared.
struct Prepared<'a> {
    projected: Box<dyn Projected + 'a>,
    target: Arc<ViewTarget>,
    /// VM at the render's size.
    validity: Image,
    /// VM on the target's grid.
    cell_validity: Vec<f32>,
    average: AreaAverage,
    /// What its masks say, once it was asked.
    members: OnceLock<Members>,
}

/// What a view's masks say of its pixels.
struct Members {
    membership: Membership,
    /// Pixels that compactness may draw: trusted and in a mask.
    drawable: Vec<u32>,
}

impl Prepared<'_> {
    /// The target as codes.
    fn codes(&self, pca: &Pca, compression: Compression) -> Result<Image, FeatureError> {
        let Image { width, height, channels, ref data } = self.target.target;
        match compression {
            Compression::Pca => Ok(self.target.target.clone()),
            Compression::Learned => {
                pca.encode(&self.target.name, &Embedding { width, height, channels, data: data.clone() })
            }
        }
    }
}

/// Draws pixels, adds the weighted gradient of their compactness to `grad` and returns the loss.
fn add_compactness(
    members: &Members,
    rendered: &Image,
    settings: &FeatureSettings,
    random: &mut Random,
    grad: &mut Image,
) -> f32 {
    let (n, c) = (rendered.pixels(), rendered.channels);
    let mut pixels = members.drawable.clone();
    let count = pixels.len().min(settings.pixels_per_step as usize);
    random.draw(&mut pixels, count);
    pixels.truncate(count);
    let mut features = Vec::with_capacity(count * c);
    for &p in &pixels {
        features.extend((0..c).map(|k| rendered.data[k * n + p as usize]));
    }
    let groups: Vec<u32> = pixels.iter().map(|&p| members.membership.groups[p as usize]).collect();
    let mut pull = vec![0.0; features.len()];
    let result = compactness(&features, c, &groups, &members.membership, &mut pull);
    for (pull, &p) in pull.chunks_exact(c).zip(&pixels) {
        for (k, g) in pull.iter().enumerate() {
            grad.data[k * n + p as usize] += settings.weight_compact * g;
        }
    }
    result.loss
}

/// The prepared views, kept while memory allows.
struct Views<'a> {
    engine: &'a dyn Engine,
    splats: &'a Splats,
    source: &'a dyn TargetSource,
    settings: &'a FeatureSettings,
    options: &'a ProjectOptions,
    /// Channels and name of what targets must hold.
    wanted: (usize, &'static str),
    kept: Vec<Option<Arc<Prepared<'a>>>>,
    room: usize,
}

impl<'a> Views<'a> {
    fn new(
        engine: &'a dyn Engine,
        splats: &'a Splats,
        source: &'a dyn TargetSource,
        pca: &Pca,
        settings: &'a FeatureSettings,
        options: &'a ProjectOptions,
    ) -> Views<'a> {
        let wanted = match settings.compression {
            Compression::Pca => (pca.channels, "codes"),
            Compression::Learned => (pca.embedding_channels, "the embedding"),
        };
        let kept = (0..source.len()).map(|_| None).collect();
        let room = settings.feature_memory as usize * (1 << 20);
        Views { engine, splats, source, settings, options, wanted, kept, room }
    }

    fn get(&mut self, i: usize) -> Result<Arc<Prepared<'a>>, FeatureError> {
        if let Some(view) = &self.kept[i] {
            return Ok(view.clone());
        }
        let view = Arc::new(self.prepare(i)?);
        // A projection holds its splats' screen-space state and its tiles' lists; the engine does not say how
        // much, so count generously.
        let visible = view.projected.radii().iter().filter(|&&r| r > 0.0).count();
        let pixels = 4 * view.validity.pixels() * 3;
        let bytes = 24 * self.splats.len() + 256 * visible + pixels + view.target.bytes();
        if bytes <= self.room {
            self.room -= bytes;
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
        let projected = self.engine.project(self.splats, &camera, &target.pose, self.options)?;
        let mut vm = target.validity.clone();
        vm.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
        let cells = AreaAverage::new((vm.width, vm.height), (grid.width, grid.height)).forward(&vm).data;
        let validity = AreaAverage::new((vm.width, vm.height), (w, h)).forward(&vm);
        let average = AreaAverage::new((w, h), (grid.width, grid.height));
        let members = OnceLock::new();
        Ok(Prepared { projected, validity, cell_validity: cells, average, members, target })
    }

    /// What the masks of a view say; the first call asks for them.
    fn members<'v>(&self, i: usize, view: &'v Prepared) -> Result<&'v Members, FeatureError> {
        if let Some(members) = view.members.get() {
            return Ok(members);
        }
        let masks = self.source.masks(i, &view.target)?;
        view.target.check_masks(&masks)?;
        let membership = Membership::new(&masks, view.validity.width, view.validity.height);
        let drawable = (0..view.validity.pixels())
            .filter(|&p| membership.groups[p] != Membership::NONE && view.validity.data[p] >= TRUSTED)
            .map(|p| p as u32)
            .collect();
        Ok(view.members.get_or_init(|| Members { membership, drawable }))
    }
}
