//! Why a feature field cannot be made.

use segwild_flow::ActorFailure;
use segwild_raster::RasterError;

/// Why a feature field cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum FeatureError {
    /// A value that is not finite.
    #[error(
        "{name}: the {what} holds {value} in channel {channel} at cell ({x}, {y}); make it again or leave the photo out"
    )]
    NotFinite {
        /// The photo.
        name: String,
        /// Which array.
        what: &'static str,
        /// The value.
        value: f32,
        /// Its channel.
        channel: usize,
        /// Its column.
        x: usize,
        /// Its row.
        y: usize,
    },
    /// Sizes do not fit each other.
    #[error("{0}")]
    Shape(String),
    /// Nothing to fit the compression on.
    #[error("no photo has a cell that may be used: everything is sky, masked out or distrusted")]
    NoSamples,
    /// All embeddings are equal.
    #[error("the embedding is the same everywhere, so it tells nothing apart; choose another embedder")]
    Flat,
    /// The rasteriser refused.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// A photo's target could not be read.
    #[error("{name}: {reason}")]
    Source {
        /// The photo.
        name: String,
        /// What went wrong.
        reason: String,
    },
    /// An input of the field cannot be read.
    #[error("{0}")]
    Input(ActorFailure),
}

impl From<ActorFailure> for FeatureError {
    fn from(failure: ActorFailure) -> FeatureError {
        FeatureError::Input(failure)
    }
}

/// Refuses planar data (`channels` planes of `width` x `height`) of the wrong length or with a value that is
/// not finite.
pub(crate) fn check_planes(
    name: &str,
    what: &'static str,
    (width, height, channels): (usize, usize, usize),
    data: &[f32],
) -> Result<(), FeatureError> {
    if width == 0 || height == 0 || channels == 0 || data.len() != width * height * channels {
        return Err(FeatureError::Shape(format!(
            "{name}: the {what} is {width}x{height} cells of {channels} channels but holds {} values",
            data.len()
        )));
    }
    match data.iter().position(|v| !v.is_finite()) {
        None => Ok(()),
        Some(i) => Err(FeatureError::NotFinite {
            name: name.to_owned(),
            what,
            value: data[i],
            channel: i / (width * height),
            x: i % width,
            y: i / width % height,
        }),
    }
}
