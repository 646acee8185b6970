//! The regions of photos in a run's cache: a click finds there what the run has seen.

use segwild_flow::{Cache, Key};
use segwild_vision::{RegionCache, Regions};

/// What the cache has them under; part of what a run uses as it stands, for clicks.
pub(crate) const REGIONS: &str = "regions";

/// A cache that regions are kept in.
pub(crate) struct InCache(pub Cache);

fn key(name: &str) -> Key {
    Key::of(REGIONS).value("photo", name).finish()
}

impl RegionCache for InCache {
    fn regions(&self, name: &str) -> Option<Regions> {
        // One that cannot be read is found anew, as one that is not there.
        self.0.get_typed(&key(name), REGIONS).ok().flatten()
    }

    fn keep(&self, name: &str, regions: &Regions) {
        if let Err(error) = self.0.put_typed(&key(name), REGIONS, regions) {
            tracing::warn!("a photo's regions are not kept, so that each click looks for them: {error}");
        }
    }
}
