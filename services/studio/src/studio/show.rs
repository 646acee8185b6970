//! What viewers see: masks, photos, renders.

use super::state::{ANSWER_COLOUR, COLOURS, CachedScene, Studio, StudioError, mark};
use crate::document::{DocumentError, KeptObject, ObjectId};
use crate::fronts::FrontMap;
use crate::messages::{
    ANSWER_LABEL, ANSWER_OBJECT, FrameRequest, HIDDEN_LABEL, LabelMap, PickRequest, PickedPixel,
};
use segwild_flow::lock;
use segwild_pipeline::{BlendedAppearance, PackedSplats, RunError, Selected, ShownParts, ShownScene};
use segwild_scene::{Camera, Image, Mask, NEAR, View};
use std::sync::Arc;

/// Quality of JPEGs that are sent to the page.
pub(crate) const JPEG_QUALITY: u8 = 88;

/// Photos that are tried for what a pixel of the 3D view shows.
const TRIED_PHOTOS: usize = 8;

/// How far it is to find out which splats all photos show.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PhotoSearch {
    /// All photos are known.
    Over,
    /// One more is known.
    GoesOn,
    /// An answer comes first.
    Waits,
}

/// Relative depth by which a point may lie behind what a photo shows there.
const SAME_DEPTH: f32 = 0.03;

impl Studio {
    /// The labels of a photo's pixels: visible objects, and the answer over them.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn labels(&self, photo: usize) -> Result<LabelMap, StudioError> {
        self.check_photo(photo)?;
        let front = self.fronts.of(&self.session, photo)?;
        let (labels, revision) = self.splat_labels();
        let visible = |label| if label == HIDDEN_LABEL { 0 } else { label };
        let runs = front.runs(|splat| visible(labels[splat as usize]));
        Ok(LabelMap { width: front.width, height: front.height, runs, revision })
    }

    /// Per splat, the label of the object or answer that it belongs to or [`HIDDEN_LABEL`], and the revision.
    pub fn splat_labels(&self) -> (Vec<u8>, u64) {
        let mut state = self.state();
        let objects = state.document.objects();
        let alone = objects.isolated;
        let label = |(i, object): (usize, &KeptObject)| {
            let shown = alone.map_or(object.visible, |id| object.id == id);
            (object.selection.clone(), if shown { i as u8 + 1 } else { HIDDEN_LABEL })
        };
        // Of hidden and shown objects that overlap, the shown one counts.
        let mut labelled: Vec<_> = objects.all.iter().enumerate().map(label).collect();
        labelled.sort_by_key(|(_, label)| *label != HIDDEN_LABEL);
        let all = if alone.is_some() { HIDDEN_LABEL } else { 0 };
        let mut labels = vec![all; self.session.model().splats.len()];
        for (selection, label) in labelled {
            if let Some(selected) = state.store.get(&selection) {
                mark(&mut labels, &selected.labels, label);
            }
        }
        if let Some(selected) = &state.answer.selected {
            mark(&mut labels, &selected.labels, ANSWER_LABEL);
        }
        (labels, state.revision)
    }

    /// The splats of an object, or of the answer ([`ANSWER_OBJECT`]), to be counted by [`Studio::pixels_of`].
    ///
    /// # Errors
    /// When there is no such object or no answer yet.
    pub fn shown_by_photos(&self, id: ObjectId) -> Result<Arc<Selected>, StudioError> {
        Ok(match id {
            ANSWER_OBJECT => self.state().answer.selected.clone().ok_or(DocumentError::NoAnswer)?,
            id => self.selection_of(id)?,
        })
    }

    /// Pixels of each photo that show selected splats, at working size; counted in small renders. Photos on which a person could not
    /// see them have few or none.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn pixels_of(&self, selected: &Selected) -> Result<Vec<usize>, StudioError> {
        let pixels = |photo| self.photo_splats.pixels(&self.session, photo, &selected.labels);
        Ok((0..self.session.scene().views.len()).map(pixels).collect::<Result<_, RunError>>()?)
    }

    /// The turn to find out which splats the photos show.
    pub(crate) fn photos_turn(&self) -> Arc<tokio::sync::Mutex<()>> {
        self.photo_splats.turn()
    }

    /// Finds out which splats one more photo shows, unless an answer is being made, which comes first.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub(crate) fn find_next_splats(&self) -> Result<PhotoSearch, StudioError> {
        let next = (0..self.session.scene().views.len()).find(|photo| !self.photo_splats.knows(*photo));
        let Some(photo) = next else { return Ok(PhotoSearch::Over) };
        if self.state().answer.message.state == "working" {
            return Ok(PhotoSearch::Waits);
        }
        self.photo_splats.pixels(&self.session, photo, &[])?;
        Ok(PhotoSearch::GoesOn)
    }

    /// A photo as JPEG, with a long side of at most `size` pixels.
    ///
    /// # Errors
    /// When there is no such photo, or it cannot be read any more.
    pub fn photo(&self, photo: usize, size: u32) -> Result<Vec<u8>, StudioError> {
        self.check_photo(photo)?;
        let image = self.session.photo(photo, size.clamp(16, 4096))?;
        Ok(three_planes(image).to_jpeg(JPEG_QUALITY))
    }

    /// A view of the scene as JPEG.
    ///
    /// # Errors
    /// When the camera is none, or the engine fails.
    pub fn frame(&self, request: &FrameRequest) -> Result<Vec<u8>, StudioError> {
        let (camera, pose) = request.view.view().map_err(StudioError::Request)?;
        let scene = self.shown(request.marks, request.appearance)?;
        let image = match request.background {
            true => self.session.background(&scene, &camera, &pose),
            false => self.session.render(&scene, &camera, &pose)?,
        };
        Ok(image.to_jpeg(JPEG_QUALITY))
    }

    /// The scene as the present state shows it.
    pub(super) fn shown(
        &self,
        marks: bool,
        appearance: Option<usize>,
    ) -> Result<Arc<ShownScene>, StudioError> {
        if let Some(photo) = appearance {
            self.check_photo(photo)?;
        }
        let mut state = self.state();
        let revision = state.revision;
        let mut cached = lock(&self.shown);
        let same = |c: &&CachedScene| (c.revision, c.marks, c.appearance) == (revision, marks, appearance);
        if let Some(known) = cached.iter().find(same) {
            return Ok(known.scene.clone());
        }
        let objects = state.document.objects().clone();
        let selected: Vec<_> = objects.all.iter().map(|object| state.store.get(&object.selection)).collect();
        let answer = state.answer.selected.clone();
        drop(state);
        let views = &self.session.scene().views;
        let mut parts = ShownParts {
            appearance: match appearance {
                Some(photo) => BlendedAppearance { photo: views[photo].name.clone(), ..Default::default() },
                None => objects.appearance.clone(),
            },
            alone: objects.isolated.is_some(),
            ..ShownParts::default()
        };
        let mut named = format!("{:?} alone {}\n", parts.appearance, parts.alone);
        for (object, selected) in objects.all.iter().zip(&selected) {
            let Some(selected) = selected else { continue };
            let isolated = objects.isolated == Some(object.id);
            let hidden = match objects.isolated {
                Some(_) if isolated => Some(false),
                Some(_) => None,
                None if object.visible => None,
                None => Some(true),
            };
            let hash = &object.selection.hash;
            if let Some(hides) = hidden {
                named += &format!("hidden {hides} {hash}\n");
                if parts.hidden.is_empty() {
                    parts.hidden = vec![objects.isolated.is_some(); selected.labels.len()];
                }
                let inside = parts.hidden.iter_mut().zip(&selected.labels).filter(|(_, label)| **label);
                inside.for_each(|(hidden, _)| *hidden = hides);
            }
            if objects.cuts(object) {
                named += &format!("cut {hash}\n");
                parts.cut.push(selected);
            }
            if let Some(own) = &object.appearance {
                named += &format!("appearance {hash} {own:?}\n");
                parts.appearances.push((&selected.labels, own));
            }
            if marks && object.visible && !isolated {
                parts.highlights.push((&selected.labels, unit(COLOURS[usize::from(object.colour)])));
            }
        }
        if let Some(answer) = answer.as_ref().filter(|_| marks) {
            parts.highlights.push((&answer.labels, unit(ANSWER_COLOUR)));
        }
        // Steps of an answer change the highlights alone: splats and colours stay as they are.
        let known = cached.iter().find(|c| c.parts == named).map(|c| c.scene.highlighted(&parts.highlights));
        let scene = Arc::new(match known {
            Some(scene) => scene,
            None => self.session.show(&parts)?,
        });
        cached.retain(|c| c.revision == revision);
        cached.push(CachedScene { revision, marks, appearance, parts: named, scene: scene.clone() });
        // One with marks, one without, and one of another appearance.
        if cached.len() > 3 {
            cached.remove(0);
        }
        Ok(scene)
    }

    /// The splats for the page's own rasteriser ([`Session::packed_splats`]).
    ///
    /// # Errors
    /// When there is no such photo, or it has no appearance.
    pub fn packed(&self, appearance: Option<usize>) -> Result<PackedSplats, StudioError> {
        let appearance = match appearance {
            Some(photo) => BlendedAppearance { photo: self.lit_by(Some(photo))?, ..Default::default() },
            None => self.state().document.objects().appearance.clone(),
        };
        Ok(self.session.packed_splats(&appearance)?)
    }

    /// The photo that shows best what a pixel of a view shows; `None` where the pixel shows nothing.
    ///
    /// # Errors
    /// When the camera is none, or the scene cannot be rendered.
    pub fn pick(&self, request: &PickRequest) -> Result<Option<PickedPixel>, StudioError> {
        let (camera, pose) = request.view.view().map_err(StudioError::Request)?;
        let at = glam::Vec2::from(request.at);
        if !camera.contains(at) {
            return Ok(None);
        }
        // One pixel is enough.
        let one = Camera {
            width: 1,
            height: 1,
            cx: camera.cx - at.x.floor(),
            cy: camera.cy - at.y.floor(),
            ..camera
        };
        let front = FrontMap::from(self.session.front_from(&one, &pose)?);
        let Some(splat) = front.at(0.5, 0.5) else { return Ok(None) };
        let splats = &self.session.model().splats;
        // The point on the ray, at the splat's depth.
        let depth = pose.to_camera(splats.mean(splat as usize)).z;
        let point = pose.rotation.transpose() * (camera.ray(at) * depth - pose.translation);
        let views = &self.session.scene().views;
        let seen = |view: &View| {
            let p = view.pose.to_camera(point);
            let pixel =
                (p.z > NEAR).then(|| view.camera.pixel(p)).filter(|pixel| view.camera.contains(*pixel))?;
            Some((pixel, p.z, self.session.size() as f32 / view.camera.width.max(view.camera.height) as f32))
        };
        let mut found: Vec<_> = views
            .iter()
            .enumerate()
            .filter(|(_, view)| !view.test)
            .filter_map(|(i, view)| {
                let (pixel, z, scale) = seen(view)?;
                Some((i, pixel, z, view.camera.fx * scale / z))
            })
            .collect();
        found.sort_by(|a, b| b.3.total_cmp(&a.3).then(a.0.cmp(&b.0)));
        let picked = |(photo, pixel): (usize, glam::Vec2)| PickedPixel {
            photo,
            x: pixel.x,
            y: pixel.y,
            point: point.to_array(),
        };
        for &(photo, pixel, z, _) in found.iter().take(TRIED_PHOTOS) {
            let camera = &views[photo].camera;
            let front = self.fronts.of(&self.session, photo)?;
            let share = [pixel.x / camera.width as f32, pixel.y / camera.height as f32];
            let Some(before) = front.at(share[0], share[1]) else { continue };
            let depth = views[photo].pose.to_camera(splats.mean(before as usize)).z;
            if before == splat || depth > z * (1.0 - SAME_DEPTH) {
                return Ok(Some(picked((photo, pixel))));
            }
        }
        Ok(found.first().map(|&(photo, pixel, ..)| picked((photo, pixel))))
    }
}

/// A mask as labels.
pub(super) fn label_map(mask: &Mask, revision: u64) -> LabelMap {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let pixels = (0..height as u32).flat_map(|y| (0..width as u32).map(move |x| (x, y)));
    let splats = pixels.map(|(x, y)| u32::from(mask.get(x, y))).collect();
    let map = FrontMap { width, height, splats };
    let runs = map.runs(|inside| if inside == 1 { ANSWER_LABEL } else { 0 });
    LabelMap { width, height, runs, revision }
}

fn unit(colour: [u8; 3]) -> [f32; 3] {
    colour.map(|c| f32::from(c) / 255.0)
}

/// A photo with exactly three planes.
pub(crate) fn three_planes(mut image: Image) -> Image {
    if image.channels > 3 {
        image.data.truncate(3 * image.pixels());
        image.channels = 3;
    }
    image
}
