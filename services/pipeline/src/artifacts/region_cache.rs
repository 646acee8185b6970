//! Keeps the regions of photos in a run's cache, so that a click need not compute them.

use segwild_flow::{Cache, Key};
use segwild_vision::{RegionCache, Regions};

/// Their domain in the cache. They count as used by the run, since clicks read them.
pub(crate) const REGIONS: &str = "regions";

/// A cache that keeps regions.
pub(crate) struct InCache(pub Cache);

fn key(name: &str) -> Key {
    Key::of(REGIONS).value("photo", name).finish()
}

impl RegionCache for InCache {
    fn regions(&self, name: &str) -> Option<Regions> {
        // A record that cannot be read counts as missing.
        self.0.get_typed(&key(name), REGIONS).ok().flatten()
    }

    fn keep(&self, name: &str, regions: &Regions) {
        if let Err(error) = self.0.put_typed(&key(name), REGIONS, regions) {
            tracing::warn!("a photo's regions are not kept, so that each click looks for them: {error}");
        }
    }
}
