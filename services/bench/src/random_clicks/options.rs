//! What random clicks measure.

use std::path::PathBuf;

/// What to measure.
#[derive(Clone, Debug)]
pub struct ClickOptions {
    /// The scenes' folders, with true masks as for `bench folder`.
    pub scenes: Vec<PathBuf>,
    /// Long sides of the photos, in pixels.
    pub sizes: Vec<u32>,
    /// Clicks on each object.
    pub clicks: usize,
    /// Seed of the clicks and of the trainings.
    pub seed: u64,
    /// Whether each of them is a box around the object in the stead of a click.
    pub boxes: bool,
    /// Whether the alternatives of each click are measured as well.
    pub alternatives: bool,
    /// Whether each click is measured by the trees of the photos' boundaries and by those of the geometry's alone, too.
    pub boundaries: bool,
    /// Further clicks, each where the answer is most wrong.
    pub corrections: usize,
    /// Folder for the results and the page, and for runs while they are made.
    pub out: PathBuf,
    /// The command line that makes it again.
    pub command: String,
    /// Settings of the runs, by name.
    pub settings: Vec<(String, String)>,
}
