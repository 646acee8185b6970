//! The seams of a scene that was trained by blocks: how well its photos are shown there, and elsewhere.

use crate::TrainError;
use crate::model::options;
use crate::trainer::Trainer;
use glam::Vec3;
use segwild_objective::compare::mean_difference;
use segwild_raster::Channels;
use serde::{Deserialize, Serialize};

/// Least share of a photo's pixels at seams, and elsewhere, for the two to be compared.
const COMPARED: f32 = 0.02;
/// Share of a pixel's light that comes from splats at seams, from which it lies at a seam, and up to which it lies
/// elsewhere.
const AT_SEAM: f32 = 0.5;
const ELSEWHERE: f32 = 0.1;
/// A seam stands out in a photo where the residual there is so many times that elsewhere, and so much larger. By
/// choice.
const STANDS_OUT: (f32, f32) = (1.5, 0.01);

/// How well the photos of a scene that was trained by blocks are shown at the seams.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SeamCheck {
    /// Blocks of the scene.
    pub blocks: usize,
    /// Photos that show a seam and what lies elsewhere.
    pub photos: usize,
    /// Means over these photos.
    pub mean: SeamResidual,
    /// The photo whose residual at seams exceeds that elsewhere most; `None` where no photo shows a seam.
    pub worst: Option<SeamPhoto>,
}

/// How well one photo is shown at the seams.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SeamPhoto {
    /// Its name.
    pub photo: String,
    /// The comparison.
    #[serde(flatten)]
    pub residual: SeamResidual,
}

/// Mean absolute colour differences of a render and its photo, from 0 to 1, over pixels that show no sky and no
/// transient.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SeamResidual {
    /// Where splats lie in the border boxes of two blocks or more.
    pub at_seams: f32,
    /// Where they lie in one.
    pub elsewhere: f32,
}

impl SeamResidual {
    fn excess(&self) -> f32 {
        self.at_seams - self.elsewhere
    }

    /// Whether a seam can be expected to be visible.
    pub fn stands_out(&self) -> bool {
        self.at_seams > STANDS_OUT.0 * self.elsewhere && self.excess() > STANDS_OUT.1
    }

    fn in_words(&self) -> String {
        format!("{:.1} % at seams and {:.1} % elsewhere", 100.0 * self.at_seams, 100.0 * self.elsewhere)
    }
}

impl SeamCheck {
    fn of(blocks: usize, compared: Vec<SeamPhoto>) -> SeamCheck {
        let photos = compared.len();
        let mean = |of: fn(&SeamResidual) -> f32| {
            compared.iter().map(|photo| of(&photo.residual)).sum::<f32>() / photos.max(1) as f32
        };
        let mean = SeamResidual { at_seams: mean(|r| r.at_seams), elsewhere: mean(|r| r.elsewhere) };
        let larger = |a: &SeamPhoto, b: &SeamPhoto| {
            a.residual.excess().total_cmp(&b.residual.excess()).then_with(|| b.photo.cmp(&a.photo))
        };
        SeamCheck { blocks, photos, mean, worst: compared.into_iter().max_by(larger) }
    }

    /// Whether a seam can be expected to be visible in a photo.
    pub fn stands_out(&self) -> bool {
        self.worst.as_ref().is_some_and(|worst| worst.residual.stands_out())
    }

    /// The result in a sentence.
    pub fn in_words(&self) -> String {
        let SeamCheck { blocks, photos, mean, worst } = self;
        match worst {
            None => format!("trained in {blocks} blocks; no photo shows a seam"),
            Some(SeamPhoto { photo, residual }) => format!(
                "trained in {blocks} blocks; {photos} photos show seams: renders differ from them by {}, and from the \
                 worst, {photo}, by {}",
                mean.in_words(),
                residual.in_words()
            ),
        }
    }
}

impl Trainer {
    /// Compares the photos with the scene at the seams of its blocks; `None` where it was trained as a whole.
    /// `stopping` ends the work.
    ///
    /// # Errors
    /// When the rasteriser refuses, or the work is stopped.
    pub fn seam_check(&mut self, stopping: &dyn Fn() -> bool) -> Result<Option<SeamCheck>, TrainError> {
        let Some(blocks) = self.blocks.clone() else { return Ok(None) };
        self.download()?;
        let engine = self.engine.clone();
        let splats = &self.state.params.splats;
        let resident = engine.upload_splats(splats)?;
        let engine = resident.as_deref().unwrap_or(&*engine);
        let division = &blocks.division;
        let at_seams = splats.means.iter().map(|mean| division.at_seam(Vec3::from(*mean)));
        let at_seams: Vec<f32> = at_seams.map(|at| f32::from(u8::from(at))).collect();
        let mut compared = Vec::new();
        for view in self.state.trained_views(self.settings.blocks, |view| self.views[view].name.as_str()) {
            if stopping() {
                return Err(TrainError::Stopped);
            }
            let Some(stored) = self.photos.usable(view)? else { continue };
            let (level, photo) = stored.level(1);
            let (camera, pose) = (self.camera(view, &stored, level), self.views[view].pose);
            let projected = engine.project(splats, &camera, &pose, &options(self.settings.antialias))?;
            let painter = self.state.painter(view);
            let rendered = painter.render(&self.state.params, &*projected, &pose, None)?;
            let shown = painter.show(&rendered.frame, &camera, &pose);
            let light = projected.blend(&Channels { count: 1, values: &at_seams })?.image;
            let most = if self.settings.robust { self.state.robust.shares()[view] } else { 0.0 };
            let share = stored.transient_share(most);
            let transient = self.views[view].contradicted(&shown, photo, share);
            let difference = mean_difference(&shown, &photo.image());
            let mean = |within: &dyn Fn(f32) -> bool| {
                let counts = |&i: &usize| photo.counts(i) && !transient[i] && within(light.data[i]);
                let of: Vec<f32> = (0..photo.pixels()).filter(counts).map(|i| difference[i]).collect();
                let enough = of.len() as f32 >= COMPARED * photo.pixels() as f32 && !of.is_empty();
                enough.then(|| of.iter().sum::<f32>() / of.len() as f32)
            };
            let residuals = mean(&|light| light >= AT_SEAM).zip(mean(&|light| light <= ELSEWHERE));
            if let Some((at_seams, elsewhere)) = residuals {
                let photo = self.views[view].name.clone();
                compared.push(SeamPhoto { photo, residual: SeamResidual { at_seams, elsewhere } });
            }
        }
        Ok(Some(SeamCheck::of(division.blocks.len(), compared)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_photo_is_named_and_stands_out_where_its_seam_differs_more_than_the_rest() {
        let of = |photos: &[(&str, f32, f32)]| {
            let of_photo = |&(name, at_seams, elsewhere): &(&str, f32, f32)| SeamPhoto {
                photo: name.to_owned(),
                residual: SeamResidual { at_seams, elsewhere },
            };
            SeamCheck::of(2, photos.iter().map(of_photo).collect())
        };
        let level = of(&[("a.jpg", 0.03, 0.03), ("b.jpg", 0.035, 0.03), ("c.jpg", 0.09, 0.12)]);
        assert!(!level.stands_out() && level.photos == 3, "{level:?}");
        let worst = "the worst, b.jpg, by 3.5 % at seams and 3.0 % elsewhere";
        assert!(level.in_words().contains(worst), "{}", level.in_words());
        let seam = of(&[("a.jpg", 0.03, 0.03), ("b.jpg", 0.06, 0.03)]);
        assert!(seam.stands_out() && (seam.mean.at_seams - 0.045).abs() < 1e-6, "{seam:?}");
        let none = of(&[]);
        assert!(!none.stands_out() && none.in_words().contains("no photo shows a seam"), "{none:?}");
    }
}
