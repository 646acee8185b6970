//! `.sog` of PlayCanvas and SuperSplat, version 2: an archive of `meta.json` and lossless WebP images with a pixel per
//! splat (github.com/playcanvas/splat-transform, `src/lib/readers/read-sog.ts`).

use super::program::plain;
use super::quantised::{stored_logit, with_largest};
use super::zip::ZipArchive;
use crate::{SceneError, Splats};
use image::codecs::webp::WebPDecoder;
use image::{DynamicImage, ImageDecoder, RgbaImage};
use serde::Deserialize;
use std::io::Cursor;
use std::path::Path;

/// The description, and its most bytes: two tables of 256 numbers make most of it.
const META: &str = "meta.json";
const MOST_META: usize = 4 << 20;
/// The version that is read.
const VERSION: u32 = 2;
/// An image may have so many times as many pixels as there are splats, and so many more.
const MOST_TIMES: usize = 4;
const MORE_PIXELS: usize = 1 << 20;
/// Most bytes of an image per pixel: lossless ones have four and tables.
const PIXEL_BYTES: usize = 8;
/// Most entries of a table of numbers: one for each byte. Of few splats LichtFeld Studio writes fewer.
const CODEBOOK: usize = 256;
/// Alpha of a rotation whose largest component is the first (w); the following ones name x, y and z.
const LARGEST_IS_FIRST: u8 = 252;
/// Groups of colour coefficients in a row of their image.
const ACROSS: usize = 64;

#[derive(Deserialize)]
struct SogMeta {
    version: Option<u32>,
    #[serde(default)]
    count: usize,
    /// How the splats were trained, since version 3 of splat-transform: `antialiased` or `2dgs`.
    model: Option<String>,
    /// The same, as GaussForge writes it; false in what most programs write, whatever the splats are.
    #[serde(default)]
    antialias: bool,
    #[serde(default)]
    asset: SogAsset,
    means: Option<SogMeans>,
    scales: Option<SogTable>,
    quats: Option<SogImages>,
    sh0: Option<SogTable>,
    #[serde(rename = "shN")]
    rest: Option<SogPalette>,
}

#[derive(Default, Deserialize)]
struct SogAsset {
    generator: Option<String>,
}

#[derive(Deserialize)]
struct SogMeans {
    mins: [f32; 3],
    maxs: [f32; 3],
    files: [String; 2],
}

#[derive(Deserialize)]
struct SogImages {
    files: [String; 1],
}

#[derive(Deserialize)]
struct SogTable {
    #[serde(default)]
    codebook: Vec<f32>,
    files: [String; 1],
}

#[derive(Deserialize)]
struct SogPalette {
    /// Groups of coefficients. LichtFeld Studio's first files call them `palette_size`.
    count: Option<usize>,
    palette_size: Option<usize>,
    #[serde(default)]
    bands: u32,
    #[serde(default)]
    codebook: Vec<f32>,
    files: [String; 2],
}

/// The fields of the description that are used.
#[derive(Debug)]
pub(super) struct SogHead {
    pub splats: usize,
    pub sh_degree: u32,
    /// The program that names itself as the writer.
    pub generator: Option<String>,
    /// Whether opacities are compensated for the pixel filter, where the file says so.
    pub antialias: Option<bool>,
}

/// Reads the description of a file.
pub(super) fn head(path: &Path, bytes: &[u8]) -> Result<SogHead, SceneError> {
    let meta = meta(path, &ZipArchive::open(path, bytes)?)?;
    let antialias = match meta.model.as_deref() {
        Some("antialiased") => Some(true),
        Some("default" | "2dgs") => Some(false),
        _ => meta.antialias.then_some(true),
    };
    let sh_degree = meta.rest.as_ref().map_or(0, |rest| rest.bands);
    Ok(SogHead { splats: meta.count, sh_degree, generator: meta.asset.generator, antialias })
}

fn invalid(path: &Path, reason: impl std::fmt::Display) -> SceneError {
    SceneError::invalid(path, META, reason)
}

fn meta(path: &Path, archive: &ZipArchive) -> Result<SogMeta, SceneError> {
    let text = archive.read(META, MOST_META)?;
    let other = |e: serde_json::Error| invalid(path, format!("it is no description of splats: {e}"));
    let mut meta: SogMeta = serde_json::from_slice(&text).map_err(other)?;
    if meta.version != Some(VERSION) {
        let version = meta.version.map_or("1".to_owned(), |version| version.to_string());
        let reason = format!(
            "it is of version {version} of `.sog`, and {VERSION} is read: `splat-transform {} splats.ply` writes \
             it as .ply",
            path.display()
        );
        return Err(invalid(path, reason));
    }
    if let Some(rest) = meta.rest.as_ref().filter(|rest| !(1..=3).contains(&rest.bands)) {
        return Err(invalid(path, format!("colours of degree {} cannot be", rest.bands)));
    }
    let tables = [meta.scales.as_mut(), meta.sh0.as_mut()].into_iter().flatten();
    let tables = tables.map(|table| &mut table.codebook);
    for table in tables.chain(meta.rest.as_mut().map(|rest| &mut rest.codebook)) {
        if !(1..=CODEBOOK).contains(&table.len()) {
            let reason = format!("a table has {} numbers, and 1 to {CODEBOOK} are read", table.len());
            return Err(invalid(path, reason));
        }
        // A splat that takes a number which is not there has none.
        table.resize(CODEBOOK, f32::NAN);
    }
    Ok(meta)
}

/// An image of an archive with `least` pixels and more, but not many more.
fn pixels(path: &Path, archive: &ZipArchive, name: &str, least: usize) -> Result<RgbaImage, SceneError> {
    let most = least.saturating_mul(MOST_TIMES).saturating_add(MORE_PIXELS);
    let bytes = archive.read(name, most.saturating_mul(PIXEL_BYTES))?;
    let name = plain(name);
    let damaged = |e: image::ImageError| invalid(path, format!("`{name}` cannot be decoded: {e}"));
    let decoder = WebPDecoder::new(Cursor::new(bytes)).map_err(damaged)?;
    let (width, height) = decoder.dimensions();
    let count = width as usize * height as usize;
    if !(least..=most).contains(&count) {
        let reason = format!("`{name}` has {width} x {height} pixels, which do not fit {least}");
        return Err(invalid(path, reason));
    }
    Ok(DynamicImage::from_decoder(decoder).map_err(damaged)?.into_rgba8())
}

/// The four bytes of pixel `i`, row by row.
fn pixel(image: &RgbaImage, i: usize) -> [u8; 4] {
    let bytes = &image.as_raw()[4 * i..];
    [bytes[0], bytes[1], bytes[2], bytes[3]]
}

/// Reads such a file, which may have `most` splats. Its axes are those of `.ply`.
///
/// # Errors
/// When it is damaged, has more splats, or an image does not fit them.
pub(super) fn read(path: &Path, bytes: &[u8], most: usize) -> Result<Splats, SceneError> {
    let archive = ZipArchive::open(path, bytes)?;
    let meta = meta(path, &archive)?;
    let n = meta.count;
    if n > most {
        return Err(invalid(path, format!("{n} splats are more than the {most} that are read")));
    }
    let missing = |what: &str| invalid(path, format!("`{what}` is missing"));
    let means = meta.means.as_ref().ok_or_else(|| missing("means"))?;
    let scales = meta.scales.as_ref().ok_or_else(|| missing("scales"))?;
    let quats = meta.quats.as_ref().ok_or_else(|| missing("quats"))?;
    let sh0 = meta.sh0.as_ref().ok_or_else(|| missing("sh0"))?;
    let image = |name: &str| pixels(path, &archive, name, n);
    let [low, high] = [image(&means.files[0])?, image(&means.files[1])?];
    let [sizes, turns, colours] = [image(&scales.files[0])?, image(&quats.files[0])?, image(&sh0.files[0])?];
    let rest = meta.rest.as_ref().map(|rest| SogColours::read(path, &archive, rest, n)).transpose()?;
    let sh_degree = rest.as_ref().map_or(0, |rest| rest.bands);
    let mut splats = Splats { sh_degree, ..Splats::default() };
    for i in 0..n {
        let (low, high) = (pixel(&low, i), pixel(&high, i));
        splats.means.push([0, 1, 2].map(|k| {
            let range = means.maxs[k] - means.mins[k];
            // A range of nothing is stored as one.
            let range = if range == 0.0 { 1.0 } else { range };
            let share = f32::from(u16::from_le_bytes([low[k], high[k]])) / f32::from(u16::MAX);
            exponential(means.mins[k] + range * share)
        }));
        let size = pixel(&sizes, i);
        splats.log_scales.push([0, 1, 2].map(|k| scales.codebook[usize::from(size[k])]));
        splats.rotations.push(rotation(pixel(&turns, i)));
        let [r, g, b, opacity] = pixel(&colours, i);
        splats.opacities.push(stored_logit(f32::from(opacity) / 255.0));
        splats.sh.extend([r, g, b].map(|v| sh0.codebook[usize::from(v)]));
        if let Some(rest) = &rest {
            rest.add(i, &mut splats.sh);
        }
    }
    Ok(splats)
}

/// The colour coefficients beyond the constant: a group of them for each splat.
struct SogColours<'a> {
    bands: u32,
    /// Coefficients of a channel.
    coefficients: usize,
    codebook: &'a [f32],
    groups: usize,
    centroids: RgbaImage,
    labels: RgbaImage,
}

impl<'a> SogColours<'a> {
    fn read(
        path: &Path,
        archive: &ZipArchive,
        palette: &'a SogPalette,
        splats: usize,
    ) -> Result<SogColours<'a>, SceneError> {
        let coefficients = (palette.bands + 1).pow(2) as usize - 1;
        // Labels have two bytes.
        let most = usize::from(u16::MAX) + 1;
        let stated = palette.count.or(palette.palette_size).map(|groups| groups.min(most));
        // Where their number is not stated, the image is full of them.
        let least = stated.unwrap_or(1).div_ceil(ACROSS) * ACROSS * coefficients;
        let centroids = pixels(path, archive, &palette.files[0], least)?;
        if centroids.width() as usize != ACROSS * coefficients {
            let reason = format!(
                "`{}` is {} pixels wide, and {} fit colours of degree {}",
                plain(&palette.files[0]),
                centroids.width(),
                ACROSS * coefficients,
                palette.bands
            );
            return Err(invalid(path, reason));
        }
        let groups = stated.unwrap_or(centroids.height() as usize * ACROSS).min(most);
        let labels = pixels(path, archive, &palette.files[1], splats)?;
        let (bands, codebook) = (palette.bands, &palette.codebook[..]);
        Ok(SogColours { bands, coefficients, codebook, groups, centroids, labels })
    }

    /// Adds the coefficients of splat `i`; none of a group that is not there.
    fn add(&self, i: usize, sh: &mut Vec<f32>) {
        let [low, high, ..] = pixel(&self.labels, i);
        let group = usize::from(u16::from_le_bytes([low, high]));
        // The image is as wide as its groups: their pixels follow each other.
        let first = group * self.coefficients;
        for k in 0..self.coefficients {
            match group < self.groups {
                true => {
                    let [r, g, b, _] = pixel(&self.centroids, first + k);
                    sh.extend([r, g, b].map(|v| self.codebook[usize::from(v)]));
                }
                false => sh.extend([0.0; 3]),
            }
        }
    }
}

/// The inverse of `sign(x) ln(|x| + 1)`.
fn exponential(value: f32) -> f32 {
    value.abs().exp_m1().copysign(value)
}

/// A rotation (w, x, y, z): three components in units of the square root of a half, and which one is left out, the
/// largest.
fn rotation([a, b, c, largest]: [u8; 4]) -> [f32; 4] {
    let component = |v: u8| (f32::from(v) / 255.0 * 2.0 - 1.0) * std::f32::consts::FRAC_1_SQRT_2;
    match largest.checked_sub(LARGEST_IS_FIRST) {
        Some(largest) => with_largest(largest.into(), [a, b, c].map(component)),
        None => [1.0, 0.0, 0.0, 0.0],
    }
}
