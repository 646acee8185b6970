//! The splat in front at each pixel of the photos, kept in memory for hovering and for masks.

use segwild_flow::lock;
use segwild_pipeline::{RunError, Session};
use segwild_raster::{FrontLayer, NO_SPLAT};
use segwild_scene::{Camera, Pose};
use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex};

/// Bytes of maps in memory at most.
const MOST_BYTES: usize = 256 << 20;

/// Long side in pixels of the maps of views: an outline that follows a pointer needs no more.
const VIEW_SIDE: u32 = 256;

/// Views whose maps are in memory at most: a few viewers who move their pointers, each over one view.
const MOST_VIEWS: usize = 8;

/// Accumulated alpha under which a pixel shows no splat.
const SHOWS: f32 = 0.5;

/// The splat in front at each pixel.
pub struct FrontMap {
    /// Pixels of a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Per pixel, row by row, the splat that makes up most of it; [`NO_SPLAT`] where nothing opaque is.
    pub splats: Vec<u32>,
}

impl From<FrontLayer> for FrontMap {
    fn from(front: FrontLayer) -> FrontMap {
        let opaque = |(splat, alpha): (u32, &f32)| if *alpha >= SHOWS { splat } else { NO_SPLAT };
        let splats = front.splats.into_iter().zip(&front.alpha.data).map(opaque).collect();
        FrontMap { width: front.width, height: front.height, splats }
    }
}

impl FrontMap {
    /// The splat at a position, in shares of width and height.
    pub fn at(&self, x: f32, y: f32) -> Option<u32> {
        let index = |share: f32, side: usize| ((share * side as f32) as usize).min(side.saturating_sub(1));
        if !(0.0..=1.0).contains(&x) || !(0.0..=1.0).contains(&y) {
            return None;
        }
        let splat = *self.splats.get(index(y, self.height) * self.width + index(x, self.width))?;
        (splat != NO_SPLAT).then_some(splat)
    }

    /// Runs of equal labels, row by row: label and length, one after the other. `label` is of a splat; 0 is none.
    pub fn runs(&self, label: impl Fn(u32) -> u8) -> Vec<u32> {
        let mut runs: Vec<u32> = Vec::new();
        for &splat in &self.splats {
            let label = if splat == NO_SPLAT { 0 } else { u32::from(label(splat)) };
            match runs.len() {
                n if n > 0 && runs[n - 2] == label => runs[n - 1] += 1,
                _ => runs.extend([label, 1]),
            }
        }
        runs
    }
}

/// A view and its map.
struct ViewFront {
    camera: Camera,
    pose: Pose,
    map: Arc<FrontMap>,
}

/// The maps of a session's photos, and of the views that pointers were over last.
#[derive(Default)]
pub struct FrontMaps {
    maps: Mutex<HashMap<usize, (Arc<FrontMap>, u64)>>,
    views: Mutex<VecDeque<ViewFront>>,
}

impl FrontMaps {
    /// The map of a photo; rendered if it is not there.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn of(&self, session: &Session, view: usize) -> Result<Arc<FrontMap>, RunError> {
        if let Some(map) = self.known(view) {
            return Ok(map);
        }
        let map = Arc::new(FrontMap::from(session.front(view)?));
        let mut maps = lock(&self.maps);
        let clock = maps.values().map(|(_, used)| used + 1).max().unwrap_or(0);
        maps.insert(view, (map.clone(), clock));
        while maps.len() > 1 && maps.values().map(|(map, _)| 4 * map.splats.len()).sum::<usize>() > MOST_BYTES
        {
            let oldest = maps.iter().min_by_key(|(_, (_, used))| *used).map(|(view, _)| *view);
            oldest.map(|view| maps.remove(&view));
        }
        Ok(map)
    }

    /// The map of a view, small; rendered if it is not there.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn of_view(
        &self,
        session: &Session,
        camera: &Camera,
        pose: &Pose,
    ) -> Result<Arc<FrontMap>, RunError> {
        let same = |view: &&ViewFront| (view.camera, view.pose) == (*camera, *pose);
        if let Some(view) = lock(&self.views).iter().find(same) {
            return Ok(view.map.clone());
        }
        let map = Arc::new(FrontMap::from(session.front_from(&camera.scaled_to(VIEW_SIDE), pose)?));
        let mut views = lock(&self.views);
        views.push_back(ViewFront { camera: *camera, pose: *pose, map: map.clone() });
        if views.len() > MOST_VIEWS {
            views.pop_front();
        }
        Ok(map)
    }

    /// Bytes of all maps.
    pub fn bytes(&self) -> usize {
        let of = |map: &FrontMap| 4 * map.splats.len();
        let photos: usize = lock(&self.maps).values().map(|(map, _)| of(map)).sum();
        photos + lock(&self.views).iter().map(|view| of(&view.map)).sum::<usize>()
    }

    fn known(&self, view: usize) -> Option<Arc<FrontMap>> {
        let mut maps = lock(&self.maps);
        let clock = maps.values().map(|(_, used)| used + 1).max().unwrap_or(0);
        let (map, used) = maps.get_mut(&view)?;
        *used = clock;
        Some(map.clone())
    }
}
