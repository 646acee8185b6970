//! What can be wrong with an image file.

/// Why an image file cannot be decoded. The words name neither the file nor the photo: who knows them adds them.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// The system refuses the file.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// It has no bytes.
    #[error("the file is empty")]
    Empty,
    /// Its first bytes are those of no image.
    #[error("does not decode: it is neither a JPEG nor a PNG, WEBP, TIFF or BMP file")]
    UnknownFormat,
    /// It is in a format that is not read.
    #[error(
        "it is {format} file, which this program does not read; convert it, and the copy beside it is used: {command}"
    )]
    ForeignFormat {
        /// The format, with its article.
        format: &'static str,
        /// The command that converts it.
        command: String,
    },
    /// A side of the image has no pixel.
    #[error("the photo has {width} x {height} pixels")]
    NoPixels {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
    },
    /// The image has more pixels than the setting allows.
    #[error(
        "the file claims {width} x {height} pixels, which are {claimed} megapixels; --max-megapixels allows {allowed}",
        claimed = (u64::from(*width) * u64::from(*height)).div_ceil(1_000_000),
        allowed = most_pixels / 1_000_000
    )]
    TooManyPixels {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Most pixels that are allowed.
        most_pixels: u64,
    },
    /// The file is too small to hold the image that its head claims.
    #[error(
        "the file claims {width} x {height} pixels, which its {bytes} bytes cannot hold: it is cut short or damaged; copy it again"
    )]
    TooFewBytes {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Size of the file.
        bytes: u64,
    },
    /// The file is larger than that of any image which the setting allows.
    #[error(
        "the file has {bytes} bytes, and {most} are enough for the largest image that --max-megapixels allows: it is damaged; \
         copy it again"
    )]
    TooLarge {
        /// Size of the file.
        bytes: u64,
        /// Most bytes that are allowed.
        most: u64,
    },
    /// A JPEG's data are far larger than its image.
    #[error("the JPEG has {bytes} bytes for {width} x {height} pixels: it is damaged")]
    TooManyBytes {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Bytes up to the end marker.
        bytes: u64,
    },
    /// The file holds another image than when its head was read.
    #[error("the file was changed while it was read")]
    ChangedWhileRead,
    /// The decoder of JPEGs refuses the data.
    #[error("does not decode: {0}")]
    Jpeg(zune_jpeg::errors::DecodeErrors),
    /// The decoder of PNGs refuses the data.
    #[error("does not decode: {0}")]
    Png(png::DecodingError),
    /// The decoder of another format refuses the data.
    #[error("does not decode: {0}")]
    Other(image::ImageError),
    /// What was decoded is not the image that was declared.
    #[error("does not decode: {0}")]
    Malformed(&'static str),
    /// A JPEG ends before its first frame.
    #[error(
        "the file is cut short: the JPEG has no end, and nothing of its image is there; copy the photo again"
    )]
    NoFrame,
    /// A JPEG ends in the middle of its image.
    #[error(
        "the file is cut short: the JPEG has no end, and {percent:.0} % of its image is there; copy the photo again"
    )]
    CutShort {
        /// How much of the image is there.
        percent: f64,
    },
    /// A JPEG's data are of no valid coding from some position on.
    #[error(
        "its data are damaged: {percent:.0} % of the image can be read before they make no sense; copy the photo again"
    )]
    Broken {
        /// How much of the image comes before.
        percent: f64,
    },
    /// A JPEG has data left when its image is full.
    #[error(
        "its data are damaged: {bytes} bytes of them are left when the image is full, so part of it is out of place; copy the photo \
         again"
    )]
    LeftOver {
        /// Bytes that belong to no part of the image.
        bytes: u64,
    },
    /// A TIFF's directory claims more values than the file can hold.
    #[error(
        "tag {tag} of the TIFF claims {count} values, which its {bytes} bytes cannot hold: it is damaged; copy it again"
    )]
    TiffCount {
        /// The tag.
        tag: u64,
        /// Values that it claims.
        count: u64,
        /// Size of the file.
        bytes: u64,
    },
    /// The decoded pixels do not fill their image.
    #[error("{0}")]
    Pixels(fast_image_resize::ImageBufferError),
    /// The decoded image cannot be scaled down.
    #[error("{0}")]
    Resize(fast_image_resize::ResizeError),
}
