//! Scores: held-out photos by the official protocol, selections against true masks (method, section 10).

use crate::artifacts::folder::Loaded;
use crate::artifacts::images::{ImageFiles, check_shape};
use crate::artifacts::intact::Intact;
use crate::artifacts::prompts::Replay;
use crate::output::object_masks::ObjectMasks;
use crate::{RunError, RunFolder, Selected, Settings, choose_engine, log_loss};
use segwild_flow::{ActorFailure, fault};
use segwild_raster::Rasterizer;
use segwild_scene::{Image, Mask, MaskFiles, PhotoStore, ReaderError};
use segwild_segmenter::MaskMode;
use segwild_trainer::{Lpips, Model, Photos, Protocol, TrainPhoto, ViewScore, evaluate};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// Scores of the held-out photos.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct HeldOut {
    /// How they were scored, in words.
    pub protocol: String,
    /// Mean PSNR in dB.
    pub psnr: f32,
    /// Mean SSIM.
    pub ssim: f32,
    /// Mean LPIPS of the photos that have one; `None` without weights of it. Less is better.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f32>,
    /// The network of LPIPS: `vgg` or `alex`. Scores of one do not compare with those of the other.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lpips_net: Option<String>,
    /// Mean PSNR in dB without the pixels that contradict the scene.
    pub kept_psnr: f32,
    /// Mean share of the pixels that do.
    pub left_out: f32,
    /// Per photo.
    pub photos: Vec<HeldOutScore>,
}

/// Scores of a held-out photo.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct HeldOutScore {
    /// The photo's name.
    pub photo: String,
    /// PSNR in dB.
    pub psnr: f32,
    /// SSIM.
    pub ssim: f32,
    /// LPIPS; `None` without weights of it, and where too little of the photo is scored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f32>,
    /// PSNR in dB without the pixels that contradict the scene.
    pub kept_psnr: f32,
    /// Share of the pixels that do.
    pub left_out: f32,
}

impl HeldOut {
    /// The mean scores in words.
    pub fn in_words(&self) -> String {
        let mut words = format!("PSNR {:.2} dB, SSIM {:.3}", self.psnr, self.ssim);
        if let Some((name, lpips)) = self.named_lpips() {
            words += &format!(", {name} {lpips:.3}");
        }
        if self.left_out > 0.0 {
            let share = 100.0 * self.left_out;
            words += &format!(
                "; PSNR {:.2} dB without the {share:.1} % of the pixels that contradict the scene (transients)",
                self.kept_psnr
            );
        }
        words
    }
}

impl HeldOut {
    /// The mean LPIPS with its name and that of its network, as `LPIPS (vgg)`.
    pub fn named_lpips(&self) -> Option<(String, f32)> {
        let net = self.lpips_net.as_deref().unwrap_or("unknown network");
        self.lpips.map(|lpips| (format!("LPIPS ({net})"), lpips))
    }

    /// The mean scores by their names in records: `psnr`, `ssim`, and `lpips_vgg` or `lpips_alex` where there is one.
    pub fn numbers(&self) -> Vec<(String, f64)> {
        let mut numbers = vec![("psnr".to_owned(), self.psnr.into()), ("ssim".to_owned(), self.ssim.into())];
        if let (Some(net), Some(lpips)) = (&self.lpips_net, self.lpips) {
            numbers.push((format!("lpips_{net}"), lpips.into()));
        }
        numbers
    }
}

/// Score of a selection's masks on one photo.
#[derive(Clone, Debug, Serialize)]
pub struct SelectionMaskScore {
    /// The photo's name.
    pub photo: String,
    /// Whether prompts were given on it.
    pub prompted: bool,
    /// IoU of the visible mask.
    pub iou: f64,
    /// Share of the photo's pixels that are classified correctly.
    pub accuracy: f64,
    /// Boundary IoU, with a boundary of 2 % of the diagonal.
    pub boundary_iou: f64,
    /// IoU of the amodal mask (the object alone).
    pub amodal_iou: f64,
    /// Share of the light of the object alone that lies outside the true mask, by over 2 % of the diagonal, in [0, 1]: haze and
    /// streaks that an exported object has around it, however thin. 0 where the object does not show.
    pub stray_light: f64,
}

/// Scores of a selection.
#[derive(Clone, Debug, Serialize)]
pub struct Score {
    /// The selection.
    pub selection: String,
    /// The provider of the masks that the selection is made of; `None` in selections of versions that did not record it.
    pub provider: Option<String>,
    /// Mean IoU over the photos without prompts.
    pub iou: f64,
    /// Mean accuracy over them.
    pub accuracy: f64,
    /// Mean Boundary IoU over them.
    pub boundary_iou: f64,
    /// Mean amodal IoU over them.
    pub amodal_iou: f64,
    /// Mean stray light over them ([`SelectionMaskScore::stray_light`]).
    pub stray_light: f64,
    /// Per photo, the prompted ones too.
    pub photos: Vec<SelectionMaskScore>,
    /// True masks that could not be read, and why: their photos do not count.
    pub unread: Vec<String>,
}

impl Score {
    /// The most stray light in a photo without prompts ([`SelectionMaskScore::stray_light`]).
    pub fn worst_stray_light(&self) -> f64 {
        self.photos.iter().filter(|p| !p.prompted).map(|p| p.stray_light).fold(0.0, f64::max)
    }
}

/// Width of a boundary, and of what counts as near the true mask, as a share of the diagonal.
pub const BOUNDARY: f32 = 0.02;

/// How often a photo is scored before it is left out.
const ATTEMPTS: u32 = 3;

/// Folder of the renders of held-out photos in the run folder.
const RENDERS: &str = "held_out";

/// The render of a held-out photo in the run folder, as it was scored: a PNG as large as the photo was trained at. Where the
/// photo was not scored there is no such file.
///
/// # Errors
/// When the list of photos cannot be read, or has none of this name.
pub fn held_out_render(folder: &RunFolder, photo: &str) -> Result<PathBuf, RunError> {
    let photos = folder.intake()?.photos;
    let unknown = || RunError::Request(format!("this run has no photo {photo}"));
    let view = photos.iter().position(|name| name == photo).ok_or_else(unknown)?;
    Ok(ImageFiles::of(photos.iter().map(String::as_str)).find(&folder.path().join(RENDERS), view))
}

/// Scores the usable held-out photos, if there are any, and writes `evaluation.json` and their renders. Photos that cannot be
/// scored are left out. `record` is called for each view with the seconds that its score took, or the reason why it is left out.
///
/// # Errors
/// When no photo can be scored, when the file cannot be written, and the errors of `record`.
pub(crate) fn held_out(
    folder: &RunFolder,
    store: &Arc<PhotoStore>,
    model: &Model,
    engine: &dyn Rasterizer,
    settings: &Settings,
    lpips: Option<&Lpips>,
    usable: impl Fn(usize) -> bool,
    sky: impl Fn(usize) -> Result<Option<Mask>, ActorFailure> + Send + Sync + 'static,
    mut record: impl FnMut(usize, Result<f64, ActorFailure>) -> Result<(), RunError>,
) -> Result<Option<HeldOut>, RunError> {
    let scene = &**store.scene();
    let views: Vec<usize> = (0..scene.views.len())
        .filter(|&i| scene.views[i].test && usable(i) && store.read(i).is_ok())
        .collect();
    if views.is_empty() {
        return Ok(None);
    }
    let protocol = settings.protocol(model.is_aligned());
    let words = match protocol {
        Protocol::Plain => "whole photo, no appearance fitted",
        Protocol::Halves if model.is_aligned() => {
            "appearance and pose fitted on the left half, right half scored"
        }
        Protocol::Halves => "appearance fitted on the left half, right half scored",
    };
    let source = store.clone();
    let photos: Arc<dyn Photos> = Arc::new(move |view: usize| -> Result<TrainPhoto, ReaderError> {
        let loaded = source.read(view)?;
        let sky = sky(view).map_err(|lost| lost.to_string())?;
        Ok(TrainPhoto::new(Arc::unwrap_or_clone(loaded), sky))
    });
    let resident = engine.upload_splats(&model.splats);
    let resident = resident.map_err(|e| RunError::Stage { stage: "evaluate", reason: e.to_string() })?;
    let engine = resident.as_deref().unwrap_or(engine);
    // One photo at a time: an evaluation holds its renders in memory.
    let files = ImageFiles::of(scene.views.iter().map(|v| v.name.as_str()));
    let renders = folder.path().join(RENDERS);
    let score = |view: usize| -> Result<_, ActorFailure> {
        let scored = evaluate(model, engine, scene, photos.clone(), &[view], protocol, lpips)?;
        let file = renders.join(files.name(view));
        file.parent().map_or(Ok(()), std::fs::create_dir_all)?;
        scored.renders[0].write_png(&file)?;
        fault::point("evaluate.photo")?;
        let of = |v: ViewScore| {
            let ViewScore { name: photo, psnr, ssim, lpips, kept_psnr, left_out, .. } = v;
            HeldOutScore { photo, psnr, ssim, lpips, kept_psnr, left_out }
        };
        Ok(scored.views.into_iter().map(of))
    };
    let (mut scores, mut first_error) = (Vec::new(), None);
    for &view in &views {
        let (began, first) = (Instant::now(), score(view));
        match (1..ATTEMPTS).fold(first, |scored, _| scored.or_else(|_| score(view))) {
            Ok(scored) => {
                scores.extend(scored);
                record(view, Ok(began.elapsed().as_secs_f64()))?;
            }
            Err(reason) => {
                first_error.get_or_insert_with(|| reason.clone());
                record(view, Err(reason))?;
            }
        }
    }
    if let Some(reason) = first_error.filter(|_| scores.is_empty()) {
        let reason = format!("not one of {} photos could be scored; the first: {reason}", views.len());
        return Err(RunError::Stage { stage: "evaluate", reason });
    }
    let mean =
        |pick: fn(&HeldOutScore) -> f32| scores.iter().map(pick).sum::<f32>() / scores.len().max(1) as f32;
    let known: Vec<f32> = scores.iter().filter_map(|s| s.lpips).collect();
    let held = HeldOut {
        protocol: words.into(),
        psnr: mean(|s| s.psnr),
        ssim: mean(|s| s.ssim),
        lpips: (!known.is_empty()).then(|| known.iter().sum::<f32>() / known.len() as f32),
        lpips_net: lpips.filter(|_| !known.is_empty()).map(|lpips| lpips.net().to_string()),
        kept_psnr: mean(|s| s.kept_psnr),
        left_out: mean(|s| s.left_out),
        photos: scores,
    };
    folder.write_json("evaluation.json", &held)?;
    Ok(Some(held))
}

/// Scores a selection's masks against the true masks in `truth`: one image per photo, named as the photo
/// ([`MaskFiles`]) and in pixels of the photo as taken. Photos without a true mask do not count, and the means leave
/// out the prompted photos. The object is rendered alone for its stray light.
///
/// # Errors
/// When the folder or the selection is missing, a file of the selection is damaged, no true mask counts, or the engine fails.
pub fn score(folder: &RunFolder, selection: &str, truth: &Path) -> Result<Score, RunError> {
    let intake = folder.intake()?;
    let prompted = Replay::of(folder, selection)?.prompts;
    if !truth.is_dir() {
        return Err(RunError::Input(format!("--truth {}: there is no such folder", truth.display())));
    }
    let intact = Intact::of(folder, selection)?;
    let Loaded { settings, scene, model, .. } = folder.load()?;
    // Refuses masks of a scene that has been trained again since.
    let selected = Selected::read(folder, selection, model.splats.len())?;
    let engine = choose_engine(&settings.run, log_loss)?.engine;
    let alone = selected.cut_scene(&model.splats).select(&selected.splats());
    let whole = vec![true; alone.len()];
    let alone = ObjectMasks::new(&*engine, &alone, &whole, model.options(), MaskMode::Amodal)?;
    let (mut photos, mut unread) = (Vec::new(), Vec::new());
    let names = intake.photos.iter().map(String::as_str);
    let (files, truths) = (ImageFiles::of(names.clone()), MaskFiles::new(truth, names));
    for (i, photo) in intake.photos.iter().enumerate() {
        let Some(file) = truths.find(photo).transpose() else { continue };
        let truth = match file.map_err(ReaderError::from).and_then(|file| Ok(Mask::read_png(&file)?)) {
            Ok(truth) => truth,
            Err(error) => {
                unread.push(error.to_string());
                continue;
            }
        };
        if truth.is_empty() {
            continue; // the photo does not show the object
        }
        let read = |sub: &str| -> Result<Mask, RunError> {
            let file = files.find(&folder.selection(selection).join(sub), i);
            intact.check(&file)?;
            Ok(Mask::read_png(&file)?)
        };
        let (visible, amodal) = (read("masks")?, read("amodal")?);
        let (w, h) = (truth.width(), truth.height());
        if let Err(shape) = check_shape(&truth, "the photo", (visible.width(), visible.height())) {
            unread.push(format!("the true mask of {photo} has {shape}"));
            continue;
        }
        let fit = |m: Mask| if (m.width(), m.height()) == (w, h) { m } else { m.resized(w, h) };
        let (visible, amodal) = (fit(visible), fit(amodal));
        let share = alone.share(&scene.views[i].camera, &scene.views[i].pose, settings.scene.size)?;
        let wrong = visible.minus(&truth).count() + truth.minus(&visible).count();
        photos.push(SelectionMaskScore {
            photo: photo.clone(),
            prompted: prompted.iter().any(|p| p.photo == *photo),
            iou: visible.iou(&truth),
            accuracy: 1.0 - wrong as f64 / (f64::from(truth.width()) * f64::from(truth.height())),
            boundary_iou: visible.boundary_iou(&truth, BOUNDARY),
            amodal_iou: amodal.iou(&truth),
            stray_light: stray_light(&share, scene.views[i].mask_from_taken(truth)),
        });
    }
    let others: Vec<&SelectionMaskScore> = photos.iter().filter(|p| !p.prompted).collect();
    if others.is_empty() {
        let reason = format!(
            "--truth {}: it holds no true mask (PHOTO.png) of a photo of this run that was not prompted",
            truth.display()
        );
        return Err(RunError::no_truth(reason, &unread));
    }
    let mean = |pick: fn(&SelectionMaskScore) -> f64| {
        others.iter().map(|p| pick(p)).sum::<f64>() / others.len() as f64
    };
    Ok(Score {
        selection: selection.to_owned(),
        provider: folder.provider_of(selection),
        iou: mean(|p| p.iou),
        accuracy: mean(|p| p.accuracy),
        boundary_iou: mean(|p| p.boundary_iou),
        amodal_iou: mean(|p| p.amodal_iou),
        stray_light: mean(|p| p.stray_light),
        photos,
        unread,
    })
}

/// Share of an object's light that lies farther from a true mask than [`BOUNDARY`]. `share` is one plane: how much of each pixel
/// the object covers.
fn stray_light(share: &Image, truth: Mask) -> f64 {
    let (w, h) = (share.width as u32, share.height as u32);
    let near = BOUNDARY * (w as f32).hypot(h as f32);
    let far = truth.resized(w, h).distances().into_iter().map(|distance| distance > near);
    let light = |&v: &f32| f64::from(v);
    let all: f64 = share.plane(0).iter().map(light).sum();
    let stray: f64 = share.plane(0).iter().zip(far).filter(|(_, far)| *far).map(|(v, _)| light(v)).sum();
    if all > 0.0 { stray / all } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_far_from_the_true_mask_is_stray_and_light_at_its_rim_is_not() {
        let truth = || Mask::from_fn(100, 100, |x, _| x < 40);
        let share = |v: f32, from: usize, to: usize| {
            let mut image = Image::filled(100, 100, 1, 0.0);
            let lit = image.data.iter_mut().enumerate().filter(|(i, _)| (from..to).contains(&(i % 100)));
            lit.for_each(|(_, p)| *p = v);
            image
        };
        assert_eq!(stray_light(&share(1.0, 0, 40), truth()), 0.0);
        assert_eq!(stray_light(&share(1.0, 0, 42), truth()), 0.0, "2 % of the diagonal are near");
        assert_eq!(stray_light(&share(0.2, 80, 100), truth()), 1.0);
        assert_eq!(stray_light(&share(0.0, 0, 0), truth()), 0.0, "an object that does not show");
        let mut hazy = share(1.0, 0, 40);
        hazy.data.iter_mut().zip(share(0.1, 60, 100).data).for_each(|(a, b)| *a += b);
        assert!((stray_light(&hazy, truth()) - 4.0 / 44.0).abs() < 1e-6);
    }
}
