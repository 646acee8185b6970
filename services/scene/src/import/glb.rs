//! `.glb` with Khronos' `KHR_gaussian_splatting`: primitives of points whose attributes are the splats, at
//! the nodes of a scene (github.com/KhronosGroup/glTF, `extensions/2.0/Khronos/KHR_gaussian_splatting/README.md`; the
//! container and the accessors: glTF 2.0, sections 3 and 4).

use super::program::plain;
use crate::{SceneError, Similarity, Splats, logit};
use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::Deserialize;
use serde_json::{Map, Value};
use std::collections::BTreeMap;
use std::path::Path;

/// How such a file begins, and the version of the container that is read.
const MAGIC: &[u8; 4] = b"glTF";
const VERSION: u32 = 2;
const JSON_CHUNK: u32 = 0x4e4f_534a;
const BINARY_CHUNK: u32 = 0x004e_4942;
/// Bytes before the first chunk, and before the data of a chunk.
const HEADER: usize = 12;
const CHUNK_HEADER: usize = 8;
/// The extension, and the others that change nothing about how its attributes are read.
const EXTENSION: &str = "KHR_gaussian_splatting";
const HARMLESS: [&str; 2] = [EXTENSION, "KHR_mesh_quantization"];
/// glTF's number for primitives of points.
const POINTS: u32 = 0;
/// Most primitives of splats that a scene may show, counted at each of their nodes. A program writes one, or one per part of
/// a scene; each takes about 200 bytes, and a pass over its splats.
const MOST_INSTANCES: usize = 1 << 16;
/// Highest degree of colours that the extension has.
const DEGREES: u32 = 3;
/// Opacities whose logits are finite.
const OPACITIES: [f32; 2] = [f32::MIN_POSITIVE, 1.0 - f32::EPSILON / 2.0];
/// A deviation of 0 would be the logarithm of nothing; e^-30 is nothing enough.
const LEAST_LOG_SCALE: f32 = -30.0;
/// How far the axes of a node may be from those of a similarity, as a share of its scale.
const SKEW: f64 = 1e-3;
/// About which axis half a turn leads from glTF's axes (x left, y up, z ahead) to those of `.ply`.
const TURN_ABOUT: usize = 2;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct GlbDocument {
    #[serde(default)]
    asset: GlbAsset,
    #[serde(default)]
    extensions_required: Vec<String>,
    scene: Option<usize>,
    #[serde(default)]
    scenes: Vec<GlbScene>,
    #[serde(default)]
    nodes: Vec<GlbNode>,
    #[serde(default)]
    meshes: Vec<GlbMesh>,
    #[serde(default)]
    accessors: Vec<GlbAccessor>,
    #[serde(default)]
    buffer_views: Vec<GlbView>,
    #[serde(default)]
    buffers: Vec<GlbBuffer>,
}

#[derive(Default, Deserialize)]
struct GlbAsset {
    generator: Option<String>,
    #[serde(default)]
    extras: Value,
}

#[derive(Deserialize)]
struct GlbScene {
    #[serde(default)]
    nodes: Vec<usize>,
}

#[derive(Deserialize)]
struct GlbNode {
    mesh: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    /// Column by column.
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    /// x, y, z, w.
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

impl GlbNode {
    fn local(&self) -> DMat4 {
        if let Some(matrix) = &self.matrix {
            return DMat4::from_cols_array(matrix);
        }
        let [x, y, z, w] = self.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]);
        let length = (x * x + y * y + z * z + w * w).sqrt();
        let rotation = DQuat::from_xyzw(x / length, y / length, z / length, w / length);
        let scale = DVec3::from_array(self.scale.unwrap_or([1.0; 3]));
        let translation = DVec3::from_array(self.translation.unwrap_or([0.0; 3]));
        DMat4::from_translation(translation) * DMat4::from_quat(rotation) * DMat4::from_scale(scale)
    }
}

#[derive(Deserialize)]
struct GlbMesh {
    #[serde(default)]
    primitives: Vec<GlbPrimitive>,
}

#[derive(Deserialize)]
struct GlbPrimitive {
    #[serde(default)]
    attributes: BTreeMap<String, usize>,
    #[serde(default)]
    extensions: Map<String, Value>,
    mode: Option<u32>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct GlbAccessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    #[serde(default)]
    normalized: bool,
    count: usize,
    #[serde(rename = "type")]
    shape: String,
    sparse: Option<Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct GlbView {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

#[derive(Deserialize)]
struct GlbBuffer {
    uri: Option<String>,
}

/// The fields of a file's description that are used.
#[derive(Debug)]
pub(super) struct GlbHead {
    pub splats: usize,
    pub sh_degree: u32,
    /// The program that names itself as the writer.
    pub generator: Option<String>,
    /// Whether opacities are compensated for the pixel filter, where the file says so: in `asset.extras`, in the words
    /// of the comment that `.ply` files have.
    pub antialias: Option<bool>,
}

/// Type of the numbers of an accessor.
#[derive(Clone, Copy)]
enum GlbNumber {
    I8,
    U8,
    I16,
    U16,
    F32,
}

impl GlbNumber {
    fn of(component_type: u32) -> Option<GlbNumber> {
        Some(match component_type {
            5120 => GlbNumber::I8,
            5121 => GlbNumber::U8,
            5122 => GlbNumber::I16,
            5123 => GlbNumber::U16,
            5126 => GlbNumber::F32,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            GlbNumber::I8 | GlbNumber::U8 => 1,
            GlbNumber::I16 | GlbNumber::U16 => 2,
            GlbNumber::F32 => 4,
        }
    }

    /// The number at the start of `bytes`, which hold [`GlbNumber::size`] at least. A normalised whole number is a
    /// share of the largest one (glTF 2.0, section 3.11).
    fn value(self, bytes: &[u8], normalized: bool) -> f32 {
        let (value, largest) = match self {
            GlbNumber::I8 => (f32::from(bytes[0] as i8), 127.0),
            GlbNumber::U8 => (f32::from(bytes[0]), 255.0),
            GlbNumber::I16 => (f32::from(i16::from_le_bytes([bytes[0], bytes[1]])), 32_767.0),
            GlbNumber::U16 => (f32::from(u16::from_le_bytes([bytes[0], bytes[1]])), 65_535.0),
            GlbNumber::F32 => return f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]),
        };
        if normalized { (value / largest).max(-1.0) } else { value }
    }
}

/// An attribute: `N` numbers per splat.
struct GlbColumn<'a, const N: usize> {
    bytes: &'a [u8],
    stride: usize,
    number: GlbNumber,
    normalized: bool,
}

impl<const N: usize> GlbColumn<'_, N> {
    fn at(&self, row: usize) -> [f32; N] {
        let own = &self.bytes[row * self.stride..];
        std::array::from_fn(|k| self.number.value(&own[k * self.number.size()..], self.normalized))
    }
}

/// A primitive of splats in a mesh: how many, and the degree of their colours.
struct SplatPrimitive<'a> {
    primitive: &'a GlbPrimitive,
    splats: usize,
    sh_degree: u32,
}

/// A primitive of splats at a node.
struct GlbInstance<'a> {
    primitive: &'a GlbPrimitive,
    /// From the primitive's axes to those of the scene.
    world: DMat4,
    splats: usize,
    sh_degree: u32,
}

/// Whether a file begins as one of these.
pub(super) fn is_glb(start: &[u8]) -> bool {
    start.starts_with(MAGIC)
}

/// Reads the description at the start of a file.
///
/// # Errors
/// When it is damaged, shows more than `most` splats, or shows none that can be read.
pub(super) fn head(path: &Path, start: &[u8], most: usize) -> Result<GlbHead, SceneError> {
    let (document, _) = description(path, start)?;
    let instances = instances(path, &document, most)?;
    let mode = document.asset.extras["SplatRenderMode"].as_str();
    Ok(GlbHead {
        splats: instances.iter().map(|instance| instance.splats).sum(),
        sh_degree: instances.iter().map(|instance| instance.sh_degree).max().unwrap_or(0),
        antialias: mode.map(|mode| mode == "mip"),
        generator: document.asset.generator.clone(),
    })
}

/// Reads such a file, in the axes of `.ply`. Primitives at several nodes become one list of splats; those of lower
/// degrees have no colours of the higher ones.
///
/// # Errors
/// When the file is damaged, has more than `most` splats, or holds what cannot be read as splats.
pub(super) fn read(path: &Path, bytes: &[u8], most: usize) -> Result<Splats, SceneError> {
    let (document, end) = description(path, bytes)?;
    let instances = instances(path, &document, most)?;
    let binary = binary(path, bytes, end)?;
    let sh_degree = instances.iter().map(|instance| instance.sh_degree).max().unwrap_or(0);
    let mut all = Splats { sh_degree, ..Splats::default() };
    let stride = all.sh_stride();
    for instance in &instances {
        let own = splats_of(path, &document, binary, instance)?;
        let own_stride = own.sh_stride();
        all.means.extend(own.means);
        all.log_scales.extend(own.log_scales);
        all.rotations.extend(own.rotations);
        all.opacities.extend(own.opacities);
        for colours in own.sh.chunks_exact(own_stride) {
            all.sh.extend(colours);
            all.sh.extend(std::iter::repeat_n(0.0, stride - own_stride));
        }
    }
    Ok(all.half_turned(TURN_ABOUT))
}

fn invalid(path: &Path, reason: impl std::fmt::Display) -> SceneError {
    SceneError::invalid(path, "the description", reason)
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    let bytes = bytes.get(at..at.checked_add(4)?)?;
    Some(u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
}

/// The JSON of a file, and the byte at which it ends.
fn description(path: &Path, bytes: &[u8]) -> Result<(GlbDocument, usize), SceneError> {
    let header = |reason: String| SceneError::invalid(path, "header", reason);
    let cut = || header("it ends within its header or its description, or that is larger than 1 MiB".into());
    let (version, length) = word(bytes, 4).zip(word(bytes, HEADER)).ok_or_else(cut)?;
    if version != VERSION {
        return Err(header(format!("it is of version {version} of glTF, and {VERSION} is read")));
    }
    if word(bytes, HEADER + 4) != Some(JSON_CHUNK) {
        return Err(header("its first chunk is no description in JSON".into()));
    }
    let start = HEADER + CHUNK_HEADER;
    let end = start.checked_add(length as usize).ok_or_else(cut)?;
    let json = bytes.get(start..end).ok_or_else(cut)?;
    let document: GlbDocument =
        serde_json::from_slice(json).map_err(|e| invalid(path, format!("it is damaged: {e}")))?;
    if let Some(other) = document.extensions_required.iter().find(|name| !HARMLESS.contains(&name.as_str())) {
        let reason =
            format!("it takes the extension `{}`, which is not read: write it as .ply", plain(other));
        return Err(invalid(path, reason));
    }
    Ok((document, end))
}

/// The data of the chunk after the description.
fn binary<'a>(path: &Path, bytes: &'a [u8], at: usize) -> Result<&'a [u8], SceneError> {
    let data = |length: u32| bytes.get(at + CHUNK_HEADER..(at + CHUNK_HEADER).checked_add(length as usize)?);
    let kind = word(bytes, at + 4).filter(|&kind| kind == BINARY_CHUNK);
    kind.and_then(|_| word(bytes, at)).and_then(data).ok_or_else(|| {
        SceneError::invalid(path, format!("byte {at}"), "the binary chunk is missing or cut short")
    })
}

/// The primitives of splats that the scene shows, each at its node: at most [`MOST_INSTANCES`] of them, with `most` splats
/// together. A mesh may stand at any number of nodes, so it is read once.
fn instances<'a>(
    path: &Path,
    document: &'a GlbDocument,
    most: usize,
) -> Result<Vec<GlbInstance<'a>>, SceneError> {
    let nodes = &document.nodes;
    let roots = match document.scenes.get(document.scene.unwrap_or(0)) {
        Some(scene) => scene.nodes.clone(),
        // Without scenes the roots are the nodes that are nobody's children.
        None => {
            let mut is_child = vec![false; nodes.len()];
            for &child in nodes.iter().flat_map(|node| &node.children) {
                is_child.get_mut(child).into_iter().for_each(|child| *child = true);
            }
            (0..nodes.len()).filter(|&i| !is_child[i]).collect()
        }
    };
    let mut reached = vec![false; nodes.len()];
    let mut left: Vec<(usize, DMat4)> = roots.into_iter().rev().map(|root| (root, DMat4::IDENTITY)).collect();
    let mut of_meshes: Vec<Option<Vec<SplatPrimitive>>> = document.meshes.iter().map(|_| None).collect();
    let mut found = Vec::new();
    let mut total = 0usize;
    while let Some((index, above)) = left.pop() {
        let node = nodes.get(index).ok_or_else(|| invalid(path, format!("there is no node {index}")))?;
        if std::mem::replace(&mut reached[index], true) {
            return Err(invalid(path, format!("node {index} has two parents, or is its own")));
        }
        let world = above * node.local();
        left.extend(node.children.iter().rev().map(|&child| (child, world)));
        let Some(mesh) = node.mesh else { continue };
        let read = of_meshes.get_mut(mesh);
        let read = read.ok_or_else(|| invalid(path, format!("there is no mesh {mesh}")))?;
        if read.is_none() {
            *read = Some(splat_primitives(path, document, &document.meshes[mesh])?);
        }
        for &SplatPrimitive { primitive, splats, sh_degree } in read.iter().flatten() {
            total = total.saturating_add(splats);
            if total > most {
                let reason = format!("it has more than the {most} splats that are read: thin them out");
                return Err(invalid(path, reason));
            }
            if found.len() == MOST_INSTANCES {
                let reason = format!(
                    "it shows more than {MOST_INSTANCES} primitives of splats, those at several nodes counted at each: \
                     write it as one primitive, or as .ply"
                );
                return Err(invalid(path, reason));
            }
            found.push(GlbInstance { primitive, world, splats, sh_degree });
        }
    }
    if found.is_empty() {
        let reason = format!(
            "no primitive in its scene has `{EXTENSION}`: it is a mesh or a cloud of points, and no splats"
        );
        return Err(invalid(path, reason));
    }
    Ok(found)
}

/// The primitives of a mesh that are splats.
fn splat_primitives<'a>(
    path: &Path,
    document: &GlbDocument,
    mesh: &'a GlbMesh,
) -> Result<Vec<SplatPrimitive<'a>>, SceneError> {
    let mut found = Vec::new();
    for primitive in &mesh.primitives {
        let Some(extension) = primitive.extensions.get(EXTENSION) else { continue };
        check_form(path, primitive, extension)?;
        let (splats, sh_degree) = extent(path, document, primitive)?;
        found.push(SplatPrimitive { primitive, splats, sh_degree });
    }
    Ok(found)
}

/// Refuses splats of another form than Gaussians whose colours are those of a screen.
fn check_form(path: &Path, primitive: &GlbPrimitive, extension: &Value) -> Result<(), SceneError> {
    // A file that leaves the mode out has splats all the same: the extension is for points alone.
    if let Some(mode) = primitive.mode.filter(|&mode| mode != POINTS) {
        let reason = format!("its splats are a primitive of mode {mode}, and {POINTS}, points, is read");
        return Err(invalid(path, reason));
    }
    let word = |name: &str| extension[name].as_str();
    if let Some(kernel) = word("kernel").filter(|&kernel| kernel != "ellipse") {
        let reason = format!("its splats are of the form `{}`, and `ellipse` is read", plain(kernel));
        return Err(invalid(path, reason));
    }
    if let Some(space) = word("colorSpace").filter(|&space| space != "srgb_rec709_display") {
        let reason = format!(
            "its colours are `{}`, and `srgb_rec709_display` is read: the sum of coefficients cannot be converted",
            plain(space)
        );
        return Err(invalid(path, reason));
    }
    if let Some(projection) = word("projection").filter(|&projection| projection != "perspective") {
        let reason =
            format!("its splats are projected as `{}`, and `perspective` is read", plain(projection));
        return Err(invalid(path, reason));
    }
    if let Some(packed) = extension["extensions"].as_object().and_then(|more| more.keys().next()) {
        let reason =
            format!("its splats are packed as `{}`, which is not read: write it as .ply", plain(packed));
        return Err(invalid(path, reason));
    }
    Ok(())
}

fn attribute(name: &str) -> String {
    format!("{EXTENSION}:{name}")
}

fn colour_attribute(degree: u32, coefficient: u32) -> String {
    attribute(&format!("SH_DEGREE_{degree}_COEF_{coefficient}"))
}

/// The splats of a primitive, and the degree of its colours.
fn extent(path: &Path, document: &GlbDocument, primitive: &GlbPrimitive) -> Result<(usize, u32), SceneError> {
    let has = |degree: u32, k: u32| primitive.attributes.contains_key(&colour_attribute(degree, k));
    let present = |degree: u32| (0..=2 * degree).filter(|&k| has(degree, k)).count();
    let degree =
        (1..=DEGREES).take_while(|&degree| present(degree) == 2 * degree as usize + 1).count() as u32;
    if let Some(part) = (degree + 1..=DEGREES).find(|&degree| present(degree) > 0) {
        let reason = format!("a part of the colour coefficients up to degree {part} is missing");
        return Err(invalid(path, reason));
    }
    let position = primitive.attributes.get("POSITION").and_then(|&index| document.accessors.get(index));
    let position = position.ok_or_else(|| invalid(path, "its splats have no `POSITION`"))?;
    if position.count == 0 {
        return Err(invalid(path, "a primitive of splats has none: leave it out of the file"));
    }
    Ok((position.count, degree))
}

/// The column of an attribute of `count` splats.
fn column<'a, const N: usize>(
    path: &Path,
    (document, binary): (&GlbDocument, &'a [u8]),
    instance: &GlbInstance,
    name: &str,
) -> Result<GlbColumn<'a, N>, SceneError> {
    let wrong = |what: &str| invalid(path, format!("`{name}` {what}"));
    let index = instance.primitive.attributes.get(name).ok_or_else(|| wrong("is missing"))?;
    let accessor = document.accessors.get(*index).ok_or_else(|| wrong("has no accessor"))?;
    let shape = ["SCALAR", "VEC2", "VEC3", "VEC4"].get(N - 1).copied().unwrap_or_default();
    if accessor.shape != shape {
        return Err(wrong(&format!("is `{}`, and `{shape}` is read", plain(&accessor.shape))));
    }
    if accessor.count != instance.splats {
        return Err(wrong(&format!("has {} values for {} splats", accessor.count, instance.splats)));
    }
    if accessor.sparse.is_some() {
        return Err(wrong("is sparse, which is not read"));
    }
    let number =
        GlbNumber::of(accessor.component_type).ok_or_else(|| wrong("has a type that is not read"))?;
    let view = accessor.buffer_view.and_then(|view| document.buffer_views.get(view));
    let view = view.ok_or_else(|| wrong("has no buffer view"))?;
    if view.buffer != 0 || document.buffers.first().is_none_or(|buffer| buffer.uri.is_some()) {
        return Err(wrong("lies in another file: pack it into the .glb"));
    }
    let size = N * number.size();
    let stride = view.byte_stride.unwrap_or(size);
    if stride < size {
        return Err(wrong("has values that overlap"));
    }
    let bytes = || {
        let length = instance.splats.checked_sub(1)?.checked_mul(stride)?.checked_add(size)?;
        let within = accessor.byte_offset.checked_add(length)? <= view.byte_length;
        let start = view.byte_offset.checked_add(accessor.byte_offset)?;
        binary.get(start..start.checked_add(length)?).filter(|_| within)
    };
    let bytes = bytes().ok_or_else(|| wrong("ends after its buffer: the file is cut short or damaged"))?;
    Ok(GlbColumn { bytes, stride, number, normalized: accessor.normalized })
}

/// The splats of a primitive in the axes of the scene.
fn splats_of(
    path: &Path,
    document: &GlbDocument,
    binary: &[u8],
    instance: &GlbInstance,
) -> Result<Splats, SceneError> {
    let data = (document, binary);
    let positions = column::<3>(path, data, instance, "POSITION")?;
    let rotations = column::<4>(path, data, instance, &attribute("ROTATION"))?;
    let scales = column::<3>(path, data, instance, &attribute("SCALE"))?;
    let opacities = column::<1>(path, data, instance, &attribute("OPACITY"))?;
    let names = (0..=instance.sh_degree).flat_map(|degree| (0..=2 * degree).map(move |k| (degree, k)));
    let colours = names
        .map(|(degree, k)| column::<3>(path, data, instance, &colour_attribute(degree, k)))
        .collect::<Result<Vec<_>, _>>()?;
    let mut splats = Splats { sh_degree: instance.sh_degree, ..Splats::default() };
    for i in 0..instance.splats {
        splats.means.push(positions.at(i));
        splats.log_scales.push(scales.at(i).map(log_scale));
        let [x, y, z, w] = rotations.at(i);
        splats.rotations.push([w, x, y, z]);
        let [opacity] = opacities.at(i);
        splats.opacities.push(logit(opacity.clamp(OPACITIES[0], OPACITIES[1])));
        for column in &colours {
            splats.sh.extend(column.at(i));
        }
    }
    if instance.world == DMat4::IDENTITY {
        return Ok(splats);
    }
    let to = similarity(&instance.world).ok_or_else(|| {
        invalid(path, "a node squeezes or mirrors its splats, which stay no Gaussians of known colours")
    })?;
    Ok(splats.transformed(&to))
}

/// The logarithm of a standard deviation; NaN stays NaN.
fn log_scale(scale: f32) -> f32 {
    let log = scale.abs().ln();
    if log < LEAST_LOG_SCALE { LEAST_LOG_SCALE } else { log }
}

/// A transform of a node as a rotation, one scale and a translation; `None` where it is none.
fn similarity(world: &DMat4) -> Option<Similarity> {
    let axes = DMat3::from_mat4(*world);
    let scale = axes.determinant().cbrt();
    let translation = world.w_axis.truncate();
    if !(scale.is_finite() && scale > 0.0 && translation.is_finite()) {
        return None;
    }
    let rotation = axes * scale.recip();
    let straight = (rotation.transpose() * rotation).abs_diff_eq(DMat3::IDENTITY, SKEW);
    straight.then_some(Similarity { rotation, scale, translation })
}
