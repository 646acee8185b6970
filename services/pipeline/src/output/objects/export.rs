//! All objects of a scene as files that other tools open.

use super::bounds::bounds;
use super::coco::{CocoAnnotation, CocoFile, CocoImage, CocoRle};
use super::list::{ListRequest, ListedObjects};
use super::npy::to_npy;
use super::sheet;
use crate::output::light;
use crate::settings::AT_ONCE;
use crate::{ExportFormat, ExportProvenance, RunError};
use rayon::prelude::*;
use segwild_flow::{Stopper, files};
use segwild_raster::CpuEngine;
use segwild_scene::{Export, Mask, Scene};
use segwild_segmenter::PosedView;
use segwild_segmenter::scene_tree::{PartMap, SceneParts};
use segwild_trainer::Model;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What [`crate::export_objects`] wrote.
#[derive(Clone, Debug, Serialize)]
pub struct ExportedObjects {
    /// The folder.
    pub folder: PathBuf,
    /// Objects, a file each.
    pub objects: usize,
    /// Masks in `coco.json`.
    pub masks: usize,
}

/// As [`crate::export_objects`], of the scene of `request`.
///
/// # Errors
/// As there.
pub(crate) fn write_objects(
    request: &ListRequest,
    listed: &ListedObjects,
    provenance: ExportProvenance,
    out: &Path,
    appearance: &str,
    format: ExportFormat,
    stopper: &Stopper,
) -> Result<ExportedObjects, RunError> {
    if out.read_dir().is_ok_and(|mut entries| entries.next().is_some()) {
        return Err(RunError::Request(format!("{} is not empty: choose a new folder", out.display())));
    }
    let writer = format.writer()?;
    let (scene, model) = (request.scene(), request.model);
    let in_colour = light::shown(scene, model, appearance)?;
    let made_by = provenance.value();
    let coco = annotations(scene, model, request.photos.long_side(), provenance, &listed.parts, stopper)?;
    files::write_folder(out, |aside| -> Result<(), RunError> {
        let json = |name: &str, value: serde_json::Result<Vec<u8>>| -> Result<(), RunError> {
            let path = aside.join(name);
            let bytes = value.map_err(|e| RunError::Folder { path: path.clone(), reason: e.to_string() })?;
            Ok(files::write_atomic(&path, &bytes)?)
        };
        let export = Export { provenance: Some(&made_by), ..light::export(scene, model) };
        for object in &listed.list.objects {
            let holds = |i: &usize| usize::from(listed.parts.labels[*i]) == object.number;
            let splats: Vec<usize> = (0..in_colour.len()).filter(holds).collect();
            let file = aside.join(format!("{}.{format}", object.label()));
            writer.write(&export, &file, &in_colour.select(&splats), stopper)?;
        }
        let labelled = Export { extra: &[("object", &listed.parts.labels)], ..export };
        labelled.write(&aside.join("labels.ply"), &in_colour)?;
        files::write_atomic(&aside.join("labels.npy"), &to_npy(&listed.parts.labels))?;
        json("coco.json", serde_json::to_vec(&coco))?;
        json("objects.json", serde_json::to_vec_pretty(&listed.list))?;
        Ok(sheet::sheet(&listed.thumbnails).write_png(&aside.join("sheet.png"))?)
    })?;
    let objects = listed.list.objects.len();
    Ok(ExportedObjects { folder: out.to_owned(), objects, masks: coco.annotations.len() })
}

/// The masks of the objects of `provenance` on all photos, as the bytes of a COCO file. `labels`: per splat, the number of its object
/// from 1, 0 for none. `size`: the long side at which masks are rendered, in pixels.
pub(crate) fn coco_masks(
    scene: &Scene,
    model: &Model,
    size: u32,
    provenance: ExportProvenance,
    labels: Vec<u8>,
    stopper: &Stopper,
) -> Result<Vec<u8>, RunError> {
    let parts = SceneParts { labels, ..SceneParts::default() };
    let file = annotations(scene, model, size, provenance, &parts, stopper)?;
    serde_json::to_vec(&file).map_err(|e| RunError::Request(e.to_string()))
}

/// The masks of the parts that `provenance` names on all photos, in pixels of the photos as taken.
fn annotations(
    scene: &Scene,
    model: &Model,
    size: u32,
    provenance: ExportProvenance,
    parts: &SceneParts,
    stopper: &Stopper,
) -> Result<CocoFile, RunError> {
    let objects = provenance.objects.len();
    let mut file = CocoFile::of(provenance);
    let engine = CpuEngine::new();
    let views: Vec<usize> = (0..scene.views.len()).collect();
    // Masks have the photos' full size: only a few photos at once fit into memory.
    for some in views.chunks(rayon::current_num_threads().min(AT_ONCE)) {
        RunError::unless_running(stopper)?;
        let masks_of = |&index: &usize| -> Result<Vec<(usize, Mask)>, RunError> {
            let view = &scene.views[index];
            let posed = PosedView { camera: view.camera.scaled_to(size), ..view.into() };
            let map = PartMap::render(&engine, &model.splats, &model.options(), &posed, parts)?;
            let counts = map.counts();
            let present = (1..=objects).filter(|&number| counts.get(number) > Some(&0));
            let large = |number: usize| {
                view.mask_to_taken(map.enlarged(number as u8, view.camera.width, view.camera.height))
            };
            Ok(present.map(|number| (number, large(number))).collect())
        };
        let masks: Vec<Vec<(usize, Mask)>> = some.par_iter().map(masks_of).collect::<Result<_, _>>()?;
        for (&index, masks) in some.iter().zip(masks) {
            let view = &scene.views[index];
            let (width, height) = (view.camera.width, view.camera.height);
            file.images.push(CocoImage { id: index + 1, file_name: view.name.clone(), width, height });
            for (number, mask) in masks {
                let Some((low, high)) = bounds(&mask) else { continue };
                file.annotations.push(CocoAnnotation {
                    id: file.annotations.len() + 1,
                    image_id: index + 1,
                    category_id: number,
                    bbox: [low[0], low[1], high[0] - low[0], high[1] - low[1]],
                    area: mask.count(),
                    segmentation: CocoRle::of(&mask),
                    iscrowd: 0,
                });
            }
        }
    }
    Ok(file)
}
