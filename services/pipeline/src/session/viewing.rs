//! What a person sees of a session: photos, the scene from any camera, and files of objects.

use super::answer::Answer;
use super::kept_masks::MASK_BYTES;
use super::resident::{PHOTO_BYTES, Session};
use crate::artifacts::selected::Selected;
use crate::output::cover::cover;
use crate::output::light::{self, BlendedAppearance};
use crate::output::objects::coco_masks;
use crate::output::provenance::{scene_digest, without_paths};
use crate::output::render::{HIGHLIGHT, over_white};
use crate::{ExportProvenance, ObjectProvenance, PhotoPrompts, RunError, transients};
use segwild_flow::Stopper;
use segwild_raster::{Channels, FrontLayer, Rasterizer};
use segwild_scene::{
    BoxPrompt, Camera, Export, Image, Mask, PointPrompt, Pose, Prompts, SceneError, SplatFormat, Splats,
};
use segwild_trainer::{Model, SceneLighting, render_lit};
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// Numbers per splat that a highlight blends: colour times share, and share.
const HIGHLIGHT_CHANNELS: usize = 4;

/// Bytes of a group of the scene tree, with its merge.
const GROUP_BYTES: usize = 48;

/// Bytes of a photo's decoded pixel.
const PIXEL_BYTES: usize = 12;

/// What is shown of a scene.
#[derive(Clone, Debug, Default)]
pub struct ShownParts<'a> {
    /// The appearance of the scene.
    pub appearance: BlendedAppearance,
    /// Objects with appearances of their own: per splat whether it belongs to the object, and its appearance.
    pub appearances: Vec<(&'a [bool], &'a BlendedAppearance)>,
    /// Per splat, whether it is left out; empty where all are shown.
    pub hidden: Vec<bool>,
    /// Whether what is shown stands before white instead of before the scene's background.
    pub alone: bool,
    /// Selections whose spikes are cut.
    pub cut: Vec<&'a Selected>,
    /// Highlighted splats with their colours, sRGB in [0, 1]. Of several, the last counts.
    pub highlights: Vec<(&'a [bool], [f32; 3])>,
}

/// A scene as it is shown: made once, rendered from many cameras.
pub struct ShownScene {
    base: Arc<PlainScene>,
    /// `[splat][red, green, blue, share]` of the splats that are shown; empty where nothing is highlighted.
    highlight: Vec<f32>,
}

/// A scene as it is shown, without highlights.
struct PlainScene {
    model: Model,
    lighting: SceneLighting,
    alone: bool,
    /// Splats of the whole scene.
    splats: usize,
    /// Indices of those that are shown; `None` where all are.
    shown: Option<Vec<usize>>,
}

impl PlainScene {
    /// The highlights of the splats that are shown.
    fn highlight(&self, highlights: &[(&[bool], [f32; 3])]) -> Vec<f32> {
        if highlights.is_empty() {
            return Vec::new();
        }
        let mut rows = vec![0.0; self.splats * HIGHLIGHT_CHANNELS];
        for (labels, [red, green, blue]) in highlights {
            let labelled = rows.chunks_exact_mut(HIGHLIGHT_CHANNELS).zip(*labels);
            labelled
                .filter(|(_, label)| **label)
                .for_each(|(row, _)| row.copy_from_slice(&[*red, *green, *blue, 1.0]));
        }
        let row = |&i: &usize| &rows[i * HIGHLIGHT_CHANNELS..][..HIGHLIGHT_CHANNELS];
        match &self.shown {
            Some(shown) => shown.iter().flat_map(row).copied().collect(),
            None => rows,
        }
    }
}

impl ShownScene {
    /// Bytes that scenes take in memory together: what those share that differ in their highlights alone counts once.
    pub fn bytes_of<'a>(scenes: impl IntoIterator<Item = &'a ShownScene>) -> usize {
        let (mut bases, mut numbers) = (Vec::new(), 0);
        for scene in scenes {
            numbers += scene.highlight.len();
            if !bases.contains(&Arc::as_ptr(&scene.base)) {
                bases.push(Arc::as_ptr(&scene.base));
                let PlainScene { model, .. } = &*scene.base;
                numbers += model.splats.len() * 11 + model.splats.sh.len() + model.splat_embeddings.len();
            }
        }
        4 * numbers
    }

    /// The same with other highlights ([`ShownParts::highlights`]).
    pub fn highlighted(&self, highlights: &[(&[bool], [f32; 3])]) -> ShownScene {
        ShownScene { base: self.base.clone(), highlight: self.base.highlight(highlights) }
    }
}

impl Session {
    /// About how many bytes the session takes in memory: splats, features, tree, photos, masks of skies and transients, what
    /// clicks have computed of the scene so far, and buffers that are kept from view to view.
    pub fn bytes(&self) -> usize {
        let splats = &self.model.splats;
        let of_splats = 4 * (11 * splats.len() + splats.sh.len() + self.model.splat_embeddings.len());
        let groups: usize = self.tree().map_or(0, |tree| tree.trees.iter().map(|t| t.groups.len()).sum());
        let pixels = |view: usize| {
            let camera = self.working_camera(view);
            camera.width as usize * camera.height as usize
        };
        let photos: usize = (0..self.scene.views.len()).map(|view| PIXEL_BYTES * pixels(view)).sum();
        let masks = 2 * (photos / (8 * PIXEL_BYTES)).min(MASK_BYTES);
        let of_clicks = self.segmenter_bytes.load(Ordering::Relaxed) + masks;
        let of_engines = self.fronts.kept_bytes() + self.engine.kept_bytes();
        of_splats
            + self.feature_bytes
            + of_clicks
            + of_engines
            + GROUP_BYTES * groups
            + photos.min(PHOTO_BYTES)
    }

    /// Long side in pixels at which photos are worked with.
    pub fn size(&self) -> u32 {
        self.made_with.scene.size
    }

    /// The camera of a photo at working size.
    pub fn working_camera(&self, view: usize) -> Camera {
        self.scene.views[view].camera.scaled_to(self.size())
    }

    /// A photo, undistorted, with a long side of at most `long_side` pixels.
    ///
    /// # Errors
    /// When it cannot be read any more.
    pub fn photo(&self, view: usize, long_side: u32) -> Result<Image, RunError> {
        if long_side == self.size() {
            return Ok(self.photos.read(view)?.image.clone());
        }
        // The store has photos at working size alone.
        Ok(self.scene.views[view].load(long_side)?.image)
    }

    /// The splat in front at each pixel of a photo at working size.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn front(&self, view: usize) -> Result<FrontLayer, RunError> {
        self.front_from(&self.working_camera(view), &self.scene.views[view].pose)
    }

    /// The splat in front at each pixel of a camera.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn front_from(&self, camera: &Camera, pose: &Pose) -> Result<FrontLayer, RunError> {
        Ok(self.fronts.front(&self.model.splats, camera, pose, &self.model.options())?)
    }

    /// The mask that prompts mean on one photo, by its pixels alone. Prompts and mask are in pixels of the photo at working size.
    ///
    /// # Errors
    /// When the photo cannot be read, or the provider fails.
    pub fn candidate_mask(&self, view: usize, prompts: &Prompts) -> Result<Mask, RunError> {
        let photo = self.photos.read(view)?;
        Ok(self.providers.segmenter.segment(&photo.image, prompts)?.mask)
    }

    /// Whether the provider finds whole objects by itself, so that its mask of a photo comes before the groups of the scene tree.
    pub fn finds_objects(&self) -> bool {
        self.providers.segmenter.finds_objects()
    }

    /// Whether the provider has in memory what every mask of a photo needs. One that keeps nothing, such as a vision service, never has.
    ///
    /// # Errors
    /// When the photo cannot be read.
    pub fn is_prepared(&self, view: usize) -> Result<bool, RunError> {
        let photo = self.photos.read(view)?;
        Ok(self.providers.segmenter.is_prepared(&photo.image))
    }

    /// [`Session::candidate_mask`] where the provider has what it needs of the photo in memory; `None` where it has not.
    ///
    /// # Errors
    /// When the photo cannot be read, or the provider fails.
    pub fn prepared_mask(&self, view: usize, prompts: &Prompts) -> Result<Option<Mask>, RunError> {
        let photo = self.photos.read(view)?;
        let segmenter = &self.providers.segmenter;
        if !segmenter.is_prepared(&photo.image) {
            return Ok(None);
        }
        Ok(Some(segmenter.segment(&photo.image, prompts)?.mask))
    }

    /// Lets the provider compute what every mask of a photo needs, if it has the memory. A click reports what fails here.
    pub fn prepare(&self, view: usize) {
        if let Ok(photo) = self.photos.read(view) {
            self.providers.segmenter.prepare(&photo.image);
        }
    }

    /// Prompts on a photo as it is shown (undistorted, at full size), as prompts on the photo as taken. `None` where a position
    /// lies outside of what the lens can have seen.
    pub fn prompts_as_taken(&self, view: usize, prompts: &Prompts) -> Option<PhotoPrompts> {
        let view = &self.scene.views[view];
        let prompts = mapped(prompts, |at| view.to_taken(at))?;
        Some(PhotoPrompts { photo: view.name.clone(), prompts })
    }

    /// The inverse of [`Session::prompts_as_taken`], with the index of the photo; `None` where there is no such photo.
    pub fn prompts_as_shown(&self, prompts: &PhotoPrompts) -> Option<(usize, Prompts)> {
        let index = self.scene.view_named(&prompts.photo)?;
        let view = &self.scene.views[index];
        Some((index, mapped(&prompts.prompts, |at| view.from_taken(at))?))
    }

    /// What an answer selects, after the spike cut.
    pub fn selected(answer: &Answer) -> Selected {
        Selected::new(&answer.segmented.selection.labels, &answer.segmented.cut)
    }

    /// Makes a scene to render from many cameras.
    ///
    /// # Errors
    /// When a photo whose appearance is requested is unknown or took no part in the training.
    pub fn show(&self, parts: &ShownParts) -> Result<ShownScene, RunError> {
        let mut model = self.model.clone();
        for cut in &parts.cut {
            model.splats = cut.cut_scene(&model.splats).into();
        }
        let n = model.splats.len();
        let mut labels: Vec<Vec<bool>> =
            parts.appearances.iter().map(|(labels, _)| labels.to_vec()).collect();
        let mut shown = None;
        if !parts.hidden.is_empty() {
            let keep: Vec<usize> = (0..n).filter(|&i| !parts.hidden[i]).collect();
            model.select(&keep);
            for labels in &mut labels {
                *labels = keep.iter().map(|&i| labels[i]).collect();
            }
            shown = Some(keep);
        }
        let scene = parts.appearance.light(&self.scene, &model)?;
        let of_objects = labels.into_iter().zip(&parts.appearances);
        let objects = of_objects.map(|(labels, (_, of))| Ok((labels, of.light(&self.scene, &model)?)));
        let objects = objects.collect::<Result<_, RunError>>()?;
        let lighting = SceneLighting { scene, objects };
        let base = Arc::new(PlainScene { model, lighting, alone: parts.alone, splats: n, shown });
        Ok(ShownScene { highlight: base.highlight(&parts.highlights), base })
    }

    /// Renders a scene as it is shown; sRGB in [0, 1].
    ///
    /// # Errors
    /// When the engine fails.
    pub fn render(&self, shown: &ShownScene, camera: &Camera, pose: &Pose) -> Result<Image, RunError> {
        let ShownScene { base, highlight } = shown;
        let PlainScene { model, lighting, alone, .. } = &**base;
        let mut image = render_lit(model, &*self.engine, camera, pose, lighting)?;
        if !alone && highlight.is_empty() {
            return Ok(image);
        }
        let projected = self.engine.project(&model.splats, camera, pose, &model.options())?;
        if *alone {
            let alpha = cover(&*projected)?;
            over_white(&mut image, &alpha, &lighting.scene.background().paint(camera, pose));
        }
        if !highlight.is_empty() {
            let channels = Channels { count: HIGHLIGHT_CHANNELS, values: highlight };
            let blended = projected.blend(&channels)?.image;
            let n = image.pixels();
            for c in 0..3 {
                for i in 0..n {
                    let share = HIGHLIGHT * blended.data[3 * n + i].clamp(0.0, 1.0);
                    let v = &mut image.data[c * n + i];
                    *v = (*v * (1.0 - share) + HIGHLIGHT * blended.data[c * n + i]).clamp(0.0, 1.0);
                }
            }
        }
        Ok(image)
    }

    /// What stands behind all splats of a scene as it is shown; sRGB in [0, 1].
    pub fn background(&self, shown: &ShownScene, camera: &Camera, pose: &Pose) -> Image {
        match shown.base.alone {
            true => Image::filled(camera.width as usize, camera.height as usize, 3, 1.0),
            false => shown.base.lighting.scene.background().paint(camera, pose),
        }
    }

    /// The splats with the colours of an appearance.
    fn in_colour(&self, appearance: &BlendedAppearance) -> Result<Splats, RunError> {
        Ok(self.model.baked(&appearance.light(&self.scene, &self.model)?.into()))
    }

    /// How files of this scene, or of some of its objects, are made.
    pub fn provenance(&self, objects: Vec<ObjectProvenance>) -> ExportProvenance {
        ExportProvenance {
            version: env!("CARGO_PKG_VERSION"),
            scene: self.digest.get_or_init(|| scene_digest(&self.model.splats)).clone(),
            training: self.training.clone(),
            provider: self.providers.name.clone(),
            settings: without_paths(&self.made_with),
            objects,
        }
    }

    /// The splats of an object, its spikes cut, as the bytes of a file for other programs.
    ///
    /// # Errors
    /// When a photo of the appearance is unknown or took no part in the training, or the compression fails.
    pub fn object_file(
        &self,
        selected: &Selected,
        appearance: &BlendedAppearance,
        format: SplatFormat,
        provenance: &ExportProvenance,
    ) -> Result<Vec<u8>, RunError> {
        let in_colour = selected.cut_scene(&self.in_colour(appearance)?);
        let made_by = provenance.value();
        let export = Export { provenance: Some(&made_by), ..light::export(&self.scene, &self.model) };
        Ok(export
            .encode(format, &in_colour.select(&selected.splats()))
            .map_err(SceneError::io(self.folder.path()))?)
    }

    /// The whole scene as the bytes of a `.ply`; the property `object` of a splat is its number in `labels`, 0 for none.
    ///
    /// # Errors
    /// When a photo of the appearance is unknown or took no part in the training.
    pub fn labelled_ply(&self, labels: &[u8], appearance: &BlendedAppearance) -> Result<Vec<u8>, RunError> {
        let extra: &[(&str, &[u8])] = &[("object", labels)];
        let made_by = self.provenance(Vec::new()).value();
        let provenance = Some(&made_by);
        let export = Export { extra, provenance, ..light::export(&self.scene, &self.model) };
        let bytes = export.encode(SplatFormat::Ply, &self.in_colour(appearance)?);
        Ok(bytes.map_err(SceneError::io(self.folder.path()))?)
    }

    /// The masks of the objects of `provenance` on all photos, as a COCO file with compressed run lengths, in pixels of the photos as
    /// taken. `labels`: per splat, the number of its object from 1, 0 for none.
    ///
    /// # Errors
    /// When the scene cannot be rendered, or `stopper` stops it.
    pub fn coco_masks(
        &self,
        provenance: ExportProvenance,
        labels: Vec<u8>,
        stopper: &Stopper,
    ) -> Result<Vec<u8>, RunError> {
        coco_masks(&self.scene, &self.model, self.size(), provenance, labels, stopper)
    }

    /// The mask of a photo's transients, as taken; `None` where the photo has none.
    pub fn transient_mask(&self, view: usize) -> Option<Mask> {
        transients::read_image(&self.folder, &self.scene, view)
    }

    /// Writes a person's mask of a photo's transients, as taken: the next run trains without what it marks.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn correct_transients(&self, view: usize, mask: &Mask) -> Result<(), RunError> {
        transients::write_image(&self.folder, &self.scene, view, mask)
    }
}

/// Prompts with their positions mapped; `None` where one of them has no image.
fn mapped(prompts: &Prompts, map: impl Fn([f32; 2]) -> Option<[f32; 2]>) -> Option<Prompts> {
    let point = |p: &PointPrompt| map([p.x, p.y]).map(|[x, y]| PointPrompt { x, y, ..*p });
    let corners = |b: &BoxPrompt| {
        let ([x0, y0], [x1, y1]) = (map([b.x0, b.y0])?, map([b.x1, b.y1])?);
        Some(BoxPrompt { x0, y0, x1, y1 })
    };
    Some(Prompts {
        points: prompts.points.iter().map(point).collect::<Option<_>>()?,
        boxes: prompts.boxes.iter().map(corners).collect::<Option<_>>()?,
        granularity: prompts.granularity,
    })
}
