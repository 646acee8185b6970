//! Files of splats that another program trained: what wrote them, and the splats as this program holds them.
//!
//! Read are 3D Gaussian splatting's `.ply` in the forms that programs write (docs/reference/imports.md),
//! `.compressed.ply`, `.splat`, `.spz`, `.glb` and `.sog`. What a file is follows from its content; only `.splat`,
//! which has no head, is known by its name.

mod compressed;
mod filter;
mod glb;
mod program;
mod quantised;
mod sog;
mod spz;
mod zip;

pub use program::{SplatWriter, UpAxis};

use crate::digest::hash_file;
use crate::ply::{self, header::Header};
use crate::{SceneError, Splats, open_file};
use segwild_files::read_within;
use serde::{Deserialize, Serialize};
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

/// Bytes from which the head of a file is read: headers are a few KiB.
const HEAD: u64 = 1 << 20;
/// Most splats that are read: as many take 2.4 GB in memory, and no program shows more.
const MOST_SPLATS: usize = 10_000_000;
/// Bytes of a splat in a `.splat`.
const SPLAT_RECORD: u64 = 32;

/// The form of a file of splats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SplatLayout {
    /// 3D Gaussian splatting's `.ply`.
    Ply,
    /// PlayCanvas' `.compressed.ply`.
    CompressedPly,
    /// Antimatter15's `.splat`.
    Splat,
    /// Niantic's `.spz`.
    Spz,
    /// Binary glTF with `KHR_gaussian_splatting`.
    Glb,
    /// PlayCanvas' `.sog`.
    Sog,
}

impl SplatLayout {
    /// Its name for a person.
    pub fn name(self) -> &'static str {
        match self {
            SplatLayout::Ply => ".ply",
            SplatLayout::CompressedPly => ".compressed.ply",
            SplatLayout::Splat => ".splat",
            SplatLayout::Spz => ".spz",
            SplatLayout::Glb => ".glb",
            SplatLayout::Sog => ".sog",
        }
    }
}

/// A file of splats, its head read.
#[derive(Clone, Debug, PartialEq)]
pub struct SplatFile {
    /// The file.
    pub path: PathBuf,
    /// Its form.
    pub layout: SplatLayout,
    /// Splats in it.
    pub splats: usize,
    /// Degree of its colours, 0 to 3.
    pub sh_degree: u32,
    /// What wrote it, as far as the file says.
    pub writer: SplatWriter,
}

/// Splats that take the place of a scene's training.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportedSplats {
    /// The file.
    pub file: SplatFile,
    /// How its world lies in that of the poses ([`crate::SceneSettings::imported_frame`]).
    pub frame: String,
    /// Whether the photos are renders of these splats: then their world is that of the poses, and they are as they were rendered.
    pub rendered: bool,
}

/// The file in a scene's folder that holds [`RenderedViews`].
pub const RENDERED_VIEWS: &str = "views.json";

/// Most bytes of that file: it holds three short fields, but other programs may have one of that name.
const MOST_RENDERED_VIEWS: u64 = 64 << 20;

/// What the photos of a scene were rendered from, where they are renders of splats.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RenderedViews {
    /// The rule by which the views were chosen.
    pub rule: u32,
    /// The splats, by [`SplatFile::digest`].
    pub splats: String,
    /// Long side of the views in pixels.
    pub size: u32,
}

/// The name of nerfstudio's file with the transform from the world of the poses to that of the splats.
const DATAPARSER_TRANSFORMS: &str = "dataparser_transforms.json";

impl ImportedSplats {
    /// The files that may say how the splats' world lies: the one that the setting names, or those of nerfstudio near
    /// the splats.
    pub fn transform_files(&self) -> Vec<PathBuf> {
        match &*self.frame {
            "auto" => {}
            "poses" => return Vec::new(),
            file => return vec![PathBuf::from(file)],
        }
        let folder = self.file.path.parent();
        let folders = [folder, folder.and_then(Path::parent)].into_iter().flatten();
        folders.map(|folder| folder.join(DATAPARSER_TRANSFORMS)).filter(|file| file.is_file()).collect()
    }

    /// The hash of all that the splats of the scene follow from.
    ///
    /// # Errors
    /// When a file cannot be read.
    pub fn digest(&self) -> Result<String, SceneError> {
        let files = digest_of([self.file.path.clone()].into_iter().chain(self.transform_files()))?;
        Ok(if self.rendered { format!("{files} rendered") } else { files })
    }
}

/// The hash of the bytes of files, one after the other.
fn digest_of(paths: impl IntoIterator<Item = PathBuf>) -> Result<String, SceneError> {
    let mut hasher = blake3::Hasher::new();
    for path in paths {
        hash_file(&mut hasher, &path).map_err(SceneError::io(&path))?;
    }
    Ok(hasher.finalize().to_hex().to_string())
}

/// The splats of a file, in its own world.
#[derive(Clone, Debug, PartialEq)]
pub struct ReadSplats {
    /// Those that can be rendered.
    pub splats: Splats,
    /// What was changed or left out, in words.
    pub notes: Vec<String>,
}

impl SplatFile {
    /// Recognises a file of splats. A folder is one that 3D Gaussian splatting wrote: its last iteration is taken.
    ///
    /// # Errors
    /// When there is no such file, or it holds no splats.
    pub fn open(path: &Path) -> Result<SplatFile, SceneError> {
        let path = if path.is_dir() { last_iteration(path)? } else { path.to_owned() };
        let file = open_file(&path).map_err(SceneError::io(&path))?;
        let size = file.metadata().map_err(SceneError::io(&path))?.len();
        let mut start = Vec::new();
        file.take(HEAD).read_to_end(&mut start).map_err(SceneError::io(&path))?;
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        let opened = if spz::is_packed(&start) {
            let head = spz::head(&path, &start)?;
            let writer = SplatWriter::of_spz(head.program.as_deref(), head.antialias());
            let (splats, sh_degree) = (head.splats, head.sh_degree());
            SplatFile { path, layout: SplatLayout::Spz, splats, sh_degree, writer }
        } else if glb::is_glb(&start) {
            let head = glb::head(&path, &start, MOST_SPLATS)?;
            // glTF has y up; read in the axes of `.ply`, y points down.
            let named = SplatWriter::named(head.generator.as_deref(), head.antialias);
            let writer = SplatWriter { up: Some(UpAxis::MinusY), ..named };
            let (splats, sh_degree) = (head.splats, head.sh_degree);
            SplatFile { path, layout: SplatLayout::Glb, splats, sh_degree, writer }
        } else if zip::is_archive(&start) {
            // Its list stands at the end.
            let bytes = crate::bytes::read_bytes(&path).map_err(SceneError::io(&path))?;
            let head = sog::head(&path, &bytes)?;
            let writer = SplatWriter::named(head.generator.as_deref(), head.antialias);
            let (splats, sh_degree) = (head.splats, head.sh_degree);
            SplatFile { path, layout: SplatLayout::Sog, splats, sh_degree, writer }
        } else if start.starts_with(b"ply") {
            of_ply(path, &start)?
        } else if ending == "splat" {
            let (splats, sh_degree) = ((size / SPLAT_RECORD) as usize, 0);
            SplatFile { path, layout: SplatLayout::Splat, splats, sh_degree, writer: SplatWriter::default() }
        } else {
            return Err(unknown(&path, &ending));
        };
        if opened.splats == 0 {
            return Err(SceneError::invalid(&opened.path, "header", "there are no splats in it"));
        }
        if opened.splats > MOST_SPLATS {
            let reason = format!(
                "{} splats are more than the {MOST_SPLATS} that are read: thin them out",
                opened.splats
            );
            return Err(SceneError::invalid(&opened.path, "header", reason));
        }
        Ok(opened)
    }

    /// Reads the splats. Those whose numbers are none, or that no pixel can show, are left out.
    ///
    /// # Errors
    /// When the file is damaged, or nothing of it can be rendered.
    pub fn read(&self) -> Result<ReadSplats, SceneError> {
        let path = &self.path;
        let bytes = crate::bytes::read_bytes(path).map_err(SceneError::io(path))?;
        let mut notes = Vec::new();
        let splats = match self.layout {
            SplatLayout::Splat => ply::splat_of_bytes(path, &bytes)?,
            SplatLayout::Spz => {
                let (splats, done) = spz::read(path, &bytes)?;
                notes.extend(done);
                splats
            }
            SplatLayout::Glb => glb::read(path, &bytes, MOST_SPLATS)?,
            SplatLayout::Sog => sog::read(path, &bytes, MOST_SPLATS)?,
            SplatLayout::CompressedPly => compressed::read(path, &bytes, &Header::parse(path, &bytes)?)?,
            SplatLayout::Ply => {
                let mut splats = ply::of_bytes(path, &bytes)?;
                notes.extend(filter::apply(path, &bytes, &mut splats)?);
                splats
            }
        };
        let sound: Vec<usize> = (0..splats.len()).filter(|&i| is_sound(&splats, i)).collect();
        let left_out = splats.len() - sound.len();
        if sound.is_empty() {
            let reason = "none of its splats has numbers that can be rendered".to_owned();
            return Err(SceneError::NothingUsable { path: path.clone(), reason });
        }
        if left_out > 0 {
            notes.push(format!(
                "{left_out} of {} splats are left out: their numbers are none, or too large",
                splats.len()
            ));
        }
        let splats = if left_out > 0 { splats.select(&sound) } else { splats };
        Ok(ReadSplats { splats, notes })
    }

    /// The hash of its bytes.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn digest(&self) -> Result<String, SceneError> {
        digest_of([self.path.clone()])
    }

    /// Whether the photos in a scene's folder are renders of these splats: [`RENDERED_VIEWS`] there says so.
    ///
    /// # Errors
    /// When that file or the splats cannot be read.
    pub fn is_rendered_in(&self, scene: &Path) -> Result<bool, SceneError> {
        let path = scene.join(RENDERED_VIEWS);
        let text = match read_within(&path, MOST_RENDERED_VIEWS) {
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(false),
            text => text.map_err(SceneError::io(&path))?,
        };
        // Other programs may have a file of that name.
        match serde_json::from_slice::<RenderedViews>(&text) {
            Ok(views) => Ok(views.splats == self.digest()?),
            Err(_) => Ok(false),
        }
    }

    /// What it is, in words.
    pub fn in_words(&self) -> String {
        let SplatFile { layout, splats, sh_degree, writer, .. } = self;
        format!("{splats} splats with colours of degree {sh_degree}, {} {}", layout.name(), writer.in_words())
    }
}

fn of_ply(path: PathBuf, start: &[u8]) -> Result<SplatFile, SceneError> {
    let header = Header::parse(&path, start)?;
    let vertex = header.element("vertex");
    let Some(vertex) = vertex else {
        return Err(SceneError::invalid(&path, "header", "there is no `element vertex` line"));
    };
    let splats = usize::try_from(vertex.count).unwrap_or(usize::MAX);
    let writer = SplatWriter::of_ply(&header);
    if compressed::is_compressed(&header) {
        let sh_degree = ply::degree_of(&path, compressed::coefficients(&header))?;
        return Ok(SplatFile { layout: SplatLayout::CompressedPly, splats, sh_degree, writer, path });
    }
    if vertex.names().any(|name| name.starts_with("f_anchor_feat")) {
        let reason =
            "its vertices are the anchors of Scaffold-GS, whose splats a network makes: let it write splats";
        return Err(SceneError::invalid(&path, "header", reason));
    }
    if !vertex.has("opacity") || !vertex.has("scale_0") {
        let reason = "its vertices have no `opacity` and no `scale_0`: it is a cloud of points or a mesh, and no splats";
        return Err(SceneError::invalid(&path, "header", reason));
    }
    let rest = vertex.names().filter(|name| name.starts_with("f_rest_")).count();
    Ok(SplatFile { layout: SplatLayout::Ply, splats, sh_degree: ply::degree_of(&path, rest)?, writer, path })
}

/// The file that 3D Gaussian splatting wrote last into a folder: `point_cloud/iteration_30000/point_cloud.ply`.
fn last_iteration(folder: &Path) -> Result<PathBuf, SceneError> {
    let iterations = std::fs::read_dir(folder.join("point_cloud")).into_iter().flatten().flatten();
    let numbered = iterations.filter_map(|entry| {
        let number: u64 = entry.file_name().to_str()?.strip_prefix("iteration_")?.parse().ok()?;
        let file = entry.path().join("point_cloud.ply");
        file.is_file().then_some((number, file))
    });
    numbered.max().map(|(_, file)| file).ok_or_else(|| {
        let reason =
            "it is a folder without `point_cloud/iteration_N/point_cloud.ply`: name the file of splats";
        SceneError::invalid(folder, "the folder", reason)
    })
}

fn unknown(path: &Path, ending: &str) -> SceneError {
    let reason = match ending {
        "json" | "ksplat" | "lcc" => format!(
            "`.{ending}` is not read: `splat-transform {} splats.ply` writes it as .ply (npm install -g @playcanvas/splat-transform)",
            path.display()
        ),
        "gltf" => "glTF in several files is not read: pack it into one .glb".to_owned(),
        _ => {
            "it is no file of splats: .ply, .compressed.ply, .splat, .spz, .glb and .sog are read".to_owned()
        }
    };
    SceneError::invalid(path, "the start of the file", reason)
}

/// Whether a splat can be rendered: its numbers are finite, and its logarithms no larger than an `f32` holds.
fn is_sound(splats: &Splats, i: usize) -> bool {
    const LARGEST: f32 = 1e15;
    let stride = splats.sh_stride();
    let finite = |values: &[f32]| values.iter().all(|v| v.abs() < LARGEST);
    finite(&splats.means[i])
        && finite(&splats.rotations[i])
        && finite(&splats.sh[i * stride..(i + 1) * stride])
        && splats.log_scales[i].iter().all(|v| v.is_finite() && *v < LARGEST.ln())
        && !splats.opacities[i].is_nan()
}
