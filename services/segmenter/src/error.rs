//! Why a selection cannot be made.

use segwild_raster::RasterError;

/// Why a selection cannot be made, and what to do.
#[derive(Debug, thiserror::Error)]
pub enum SegmentError {
    /// Arrays that belong together differ in length.
    #[error("{0}")]
    Shape(String),
    /// A setting is out of its range.
    #[error("setting `{name}` is {value}: {reason}")]
    Setting {
        /// The setting.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// The rasteriser refused.
    #[error("photo {photo}: {source}")]
    Raster {
        /// The photo.
        photo: String,
        /// Why.
        source: RasterError,
    },
    /// Nobody waits for the selection any more.
    #[error("cancelled")]
    Cancelled,
    /// There is neither a mask nor a click.
    #[error("nothing is prompted: give a click or a box on some photo")]
    NoPrompt,
    /// The 2D segmenter or the photo fails.
    #[error("photo {photo}: {reason}")]
    Provider {
        /// Name of the photo.
        photo: String,
        /// Why.
        reason: String,
    },
    /// The setting `alternative` is beyond what the prompts may select.
    #[error("there is no alternative {requested}: {offers}", offers = offered_in_words(*offered))]
    NoAlternative {
        /// The setting.
        requested: u32,
        /// How many there are.
        offered: usize,
    },
    /// A prompt names a view that does not exist.
    #[error("a prompt names view {view}, but the scene has {views} views")]
    NoView {
        /// The view named.
        view: usize,
        /// Number of views.
        views: usize,
    },
    /// A click lies outside its photo.
    #[error("photo {photo}: the click at ({x}, {y}) lies outside its {width} x {height} pixels")]
    OutsideFrame {
        /// The photo.
        photo: String,
        /// Pixel position.
        x: f32,
        /// Pixel position.
        y: f32,
        /// The photo's width.
        width: u32,
        /// The photo's height.
        height: u32,
    },
    /// A positive click hits no splat.
    #[error(
        "photo {photo}: there is nothing at the click ({x}, {y}), only empty space (opacity {alpha:.2}): click on the object itself"
    )]
    EmptySpace {
        /// The photo.
        photo: String,
        /// Pixel position.
        x: f32,
        /// Pixel position.
        y: f32,
        /// Accumulated alpha found there.
        alpha: f32,
    },
    /// A positive click hits the sky or another part that cannot be selected.
    #[error(
        "photo {photo}: the click ({x}, {y}) is on the sky or background, which cannot be selected: click on the object itself"
    )]
    Background {
        /// The photo.
        photo: String,
        /// Pixel position.
        x: f32,
        /// Pixel position.
        y: f32,
    },
    /// A prompted mask holds no pixel.
    #[error("photo {photo}: the mask of the prompts is empty: click on the object, or make the box larger")]
    EmptyMask {
        /// The photo.
        photo: String,
    },
    /// Only resemblance is to decide, and there is no feature to compare with.
    #[error(
        "resemblance alone is to decide (`similarity_use` = alone), but the scene has no feature field, or the clicks hit \
         nothing that has a feature: finish the run, click elsewhere, or let masks decide (`similarity_use` = unseen)"
    )]
    NoFeatures,
    /// No splat is left.
    #[error(
        "no splat belongs to the prompts ({reason}): click elsewhere on the object, or lower `tau` or `rho`"
    )]
    NothingSelected {
        /// The test at which the last one was removed.
        reason: &'static str,
    },
}

/// The numbers that the setting `alternative` may have.
fn offered_in_words(offered: usize) -> String {
    match offered {
        0 | 1 => "there is one, 0".to_owned(),
        more => {
            let numbers: Vec<String> = (0..more).map(|number| number.to_string()).collect();
            format!("there are {more}: {}", numbers.join(", "))
        }
    }
}

impl SegmentError {
    /// Whether the prompts were valid and selected nothing, which a benchmark counts as a miss; all else
    /// is a mistake in the request or a failure.
    pub fn is_nothing(&self) -> bool {
        use SegmentError::{Background, EmptyMask, EmptySpace, NothingSelected, Provider};
        matches!(
            self,
            EmptySpace { .. }
                | Background { .. }
                | EmptyMask { .. }
                | NothingSelected { .. }
                | Provider { .. }
        )
    }

    pub(crate) fn raster(photo: &str) -> impl Fn(RasterError) -> SegmentError + '_ {
        move |source| SegmentError::Raster { photo: photo.to_owned(), source }
    }
}
