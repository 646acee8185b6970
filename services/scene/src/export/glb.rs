//! `.glb` with Khronos' `KHR_gaussian_splatting`: one mesh of points whose attributes are the splats, as 32-bit
//! floats. Programs that do not know the extension show the points in their colours.

use super::rotation::unit_rotation;
use crate::Splats;
use serde_json::{Value, json};

/// The constant spherical harmonic. It is one unit in the last place above [`crate::ply::SH0`], so that files keep their
/// bytes.
const SH_0: f32 = 0.282_094_8;
/// glTF's number for 32-bit floats, and for a buffer of vertices.
const FLOAT: u32 = 5126;
const ARRAY_BUFFER: u32 = 34_962;
const JSON_CHUNK: u32 = 0x4e4f_534a;
const BINARY_CHUNK: u32 = 0x004e_4942;

/// The attributes of the mesh while they are collected.
#[derive(Default)]
struct MeshBuffer {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    attributes: serde_json::Map<String, Value>,
}

impl MeshBuffer {
    /// Adds an attribute of `N` numbers per splat. `bounds` are its least and largest values, where glTF wants them.
    fn add<const N: usize>(
        &mut self,
        name: &str,
        kind: &str,
        count: usize,
        value: impl Fn(usize) -> [f32; N],
        bounds: Option<([f32; 3], [f32; 3])>,
    ) {
        let offset = self.bytes.len();
        self.bytes.extend((0..count).flat_map(value).flat_map(f32::to_le_bytes));
        let view = self.views.len();
        self.views.push(json!({
            "buffer": 0,
            "byteOffset": offset,
            "byteLength": self.bytes.len() - offset,
            "target": ARRAY_BUFFER
        }));
        let mut accessor =
            json!({ "bufferView": view, "componentType": FLOAT, "count": count, "type": kind });
        if let Some((least, most)) = bounds {
            accessor["min"] = json!(least);
            accessor["max"] = json!(most);
        }
        self.attributes.insert(name.to_owned(), json!(self.accessors.len()));
        self.accessors.push(accessor);
    }
}

/// The file of splats in glTF's axes. `notes` are for people and programs that read them.
pub(super) fn to_bytes(splats: &Splats, notes: &Value) -> Vec<u8> {
    let mesh = mesh(splats);
    let document = json!({
        "asset": { "version": "2.0", "generator": concat!("segwild ", env!("CARGO_PKG_VERSION")), "extras": notes },
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{
            "mode": 0,
            "attributes": mesh.attributes,
            "extensions": { "KHR_gaussian_splatting": {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance"
            } }
        }] }],
        "buffers": [{ "byteLength": mesh.bytes.len() }],
        "bufferViews": mesh.views,
        "accessors": mesh.accessors,
    });
    container(document.to_string().into_bytes(), mesh.bytes)
}

fn mesh(splats: &Splats) -> MeshBuffer {
    let (count, stride) = (splats.len(), splats.sh_stride());
    let mut mesh = MeshBuffer::default();
    let least = |a: [f32; 3], b: [f32; 3]| [0, 1, 2].map(|k| a[k].min(b[k]));
    let most = |a: [f32; 3], b: [f32; 3]| [0, 1, 2].map(|k| a[k].max(b[k]));
    let bounds = splats.means.iter().copied().map(|mean| (mean, mean));
    let bounds = bounds.reduce(|a, b| (least(a.0, b.0), most(a.1, b.1)));
    mesh.add("POSITION", "VEC3", count, |i| splats.means[i], bounds);
    let colour = |i: usize| {
        let sh = &splats.sh[i * stride..];
        let [r, g, b] = [0, 1, 2].map(|k| linear((sh[k] * SH_0 + 0.5).clamp(0.0, 1.0)));
        [r, g, b, splats.opacity(i)]
    };
    mesh.add("COLOR_0", "VEC4", count, colour, None);
    let named = |name: &str| format!("KHR_gaussian_splatting:{name}");
    mesh.add(&named("SCALE"), "VEC3", count, |i| splats.scale(i).to_array(), None);
    mesh.add(&named("ROTATION"), "VEC4", count, |i| unit_rotation(splats.rotations[i]), None);
    mesh.add(&named("OPACITY"), "SCALAR", count, |i| [splats.opacity(i)], None);
    for degree in 0..=splats.sh_degree as usize {
        for coefficient in 0..=2 * degree {
            let at = 3 * (degree * degree + coefficient);
            let name = named(&format!("SH_DEGREE_{degree}_COEF_{coefficient}"));
            mesh.add(&name, "VEC3", count, |i| [0, 1, 2].map(|k| splats.sh[i * stride + at + k]), None);
        }
    }
    mesh
}

/// Linear light of an sRGB value: glTF's colours are linear.
fn linear(value: f32) -> f32 {
    if value <= 0.040_45 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// The binary container: a header and two chunks, each padded to four bytes.
fn container(mut json: Vec<u8>, mut binary: Vec<u8>) -> Vec<u8> {
    json.resize(json.len().next_multiple_of(4), b' ');
    binary.resize(binary.len().next_multiple_of(4), 0);
    let length = 12 + 8 + json.len() + 8 + binary.len();
    let mut file = Vec::with_capacity(length);
    file.extend(b"glTF");
    for number in [2, length as u32, json.len() as u32, JSON_CHUNK] {
        file.extend(number.to_le_bytes());
    }
    file.extend(&json);
    for number in [binary.len() as u32, BINARY_CHUNK] {
        file.extend(number.to_le_bytes());
    }
    file.extend(&binary);
    file
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_container_holds_its_two_chunks() {
        let splats = Splats {
            means: vec![[1.0, -2.0, 0.5], [3.0, 4.0, -5.0]],
            log_scales: vec![[0.0; 3]; 2],
            rotations: vec![[2.0, 0.0, 0.0, 0.0], [0.0; 4]],
            opacities: vec![0.0; 2],
            sh_degree: 1,
            sh: (0..24).map(|v| v as f32).collect(),
        };
        let file = to_bytes(&splats, &json!({ "SplatRenderMode": "mip" }));
        let number = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&file[..4], number(4), number(8)), (&b"glTF"[..], 2, file.len()));
        let document: Value = serde_json::from_slice(&file[20..20 + number(12)]).unwrap();
        let binary = &file[28 + number(12)..];
        let attributes = &document["meshes"][0]["primitives"][0]["attributes"];
        let values = |name: &str| -> Vec<f32> {
            let view = &document["bufferViews"][attributes[name].as_u64().unwrap() as usize];
            let at = view["byteOffset"].as_u64().unwrap() as usize;
            let end = at + view["byteLength"].as_u64().unwrap() as usize;
            binary[at..end].chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
        };
        assert_eq!(values("POSITION"), [1.0, -2.0, 0.5, 3.0, 4.0, -5.0]);
        assert_eq!(document["accessors"][0]["min"], json!([1.0, -2.0, -5.0]));
        assert_eq!(values("KHR_gaussian_splatting:ROTATION"), [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
        assert_eq!(values("KHR_gaussian_splatting:OPACITY"), [0.5; 2]);
        assert_eq!(values("KHR_gaussian_splatting:SH_DEGREE_1_COEF_2"), [9.0, 10.0, 11.0, 21.0, 22.0, 23.0]);
        assert_eq!(attributes.as_object().unwrap().len(), 9);
    }
}
