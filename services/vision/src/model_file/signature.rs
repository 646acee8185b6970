//! The inputs and outputs that a network file declares. Weights are skipped, so that a file of gigabytes takes milliseconds.

use super::inspect::LARGEST;
use super::tensor_spec::TensorSpec;
use super::wire::{WireError, WireValue, fields};
use ort::value::TensorElementType;
use std::collections::HashSet;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

/// Most bytes of one declared input or output, or of a weight's name.
const LONGEST: u64 = 1 << 16;

/// What a network takes and answers.
#[derive(Debug, Default)]
pub(crate) struct GraphSignature {
    pub inputs: Vec<TensorSpec>,
    pub outputs: Vec<TensorSpec>,
}

/// The signature of a file; `None` where it is no whole network: [`super::inspect()`] has the reason.
pub(crate) fn signature(path: &Path) -> Option<GraphSignature> {
    let about = std::fs::metadata(path).ok().filter(std::fs::Metadata::is_file)?;
    // A file of holes may claim terabytes; `inspect` refuses it as well.
    let end = about.len();
    if end > LARGEST {
        return None;
    }
    let mut scan = OnnxScan { from: BufReader::new(File::open(path).ok()?), at: 0 };
    let mut found = None;
    while scan.at < end {
        match scan.tag()? {
            (7, 2) => {
                let stop = scan.nested(end)?;
                found = Some(scan.graph(stop)?);
            }
            (_, wire) => scan.skip(wire, end)?,
        }
    }
    found
}

/// A walk through a file that reads what it needs and skips the rest.
struct OnnxScan {
    from: BufReader<File>,
    at: u64,
}

impl OnnxScan {
    fn graph(&mut self, stop: u64) -> Option<GraphSignature> {
        let mut found = GraphSignature::default();
        // Old exports declare every weight as an input as well.
        let mut weights = HashSet::new();
        while self.at < stop {
            match self.tag()? {
                (5, 2) => {
                    let end = self.nested(stop)?;
                    weights.extend(self.weight_name(end)?);
                }
                (11, 2) => found.inputs.push(declared(&self.message(stop)?).ok()?),
                (12, 2) => found.outputs.push(declared(&self.message(stop)?).ok()?),
                (_, wire) => self.skip(wire, stop)?,
            }
        }
        found.inputs.retain(|input| !weights.contains(&input.name));
        Some(found)
    }

    /// The name of the weight that ends at `end`; the walk goes on after it.
    fn weight_name(&mut self, end: u64) -> Option<Option<String>> {
        let mut name = None;
        while self.at < end {
            match self.tag()? {
                (8, 2) => name = Some(String::from_utf8_lossy(&self.message(end)?).into_owned()),
                (_, wire) => self.skip(wire, end)?,
            }
        }
        Some(name)
    }

    /// Number and wire type of the next field.
    fn tag(&mut self) -> Option<(u64, u64)> {
        let tag = self.varint()?;
        Some((tag >> 3, tag & 7))
    }

    fn varint(&mut self) -> Option<u64> {
        let mut value = 0u64;
        for i in 0..10u32 {
            let mut byte = [0];
            self.from.read_exact(&mut byte).ok()?;
            self.at += 1;
            value |= u64::from(byte[0] & 127).checked_shl(7 * i).unwrap_or(0);
            if byte[0] < 128 {
                return Some(value);
            }
        }
        None
    }

    /// Where the next message ends: within `stop`.
    fn nested(&mut self, stop: u64) -> Option<u64> {
        let length = self.varint()?;
        self.at.checked_add(length).filter(|&end| end <= stop)
    }

    fn message(&mut self, stop: u64) -> Option<Vec<u8>> {
        let length = self.nested(stop)? - self.at;
        if length > LONGEST {
            return None;
        }
        let mut bytes = vec![0; length as usize];
        self.from.read_exact(&mut bytes).ok()?;
        self.at += length;
        Some(bytes)
    }

    fn skip(&mut self, wire: u64, stop: u64) -> Option<()> {
        let length = match wire {
            0 => return self.varint().map(drop),
            1 => 8,
            2 => self.nested(stop)? - self.at,
            5 => 4,
            _ => return None,
        };
        self.at = self.at.checked_add(length).filter(|&end| end <= stop)?;
        self.from.seek_relative(i64::try_from(length).ok()?).ok()
    }
}

/// The name, the type and the shape of one input or output.
fn declared(bytes: &[u8]) -> Result<TensorSpec, WireError> {
    let mut spec = TensorSpec { name: String::new(), kind: None, shape: Vec::new() };
    for field in fields(bytes) {
        let field = field?;
        match field.number {
            1 => spec.name = field.value.text(),
            2 => {
                for kind in fields(field.value.bytes()) {
                    let kind = kind?;
                    // Sequences and maps have other numbers.
                    if kind.number == 1 {
                        tensor_type(kind.value.bytes(), &mut spec)?;
                    }
                }
            }
            _ => {}
        }
    }
    Ok(spec)
}

fn tensor_type(bytes: &[u8], spec: &mut TensorSpec) -> Result<(), WireError> {
    for field in fields(bytes) {
        let field = field?;
        match (field.number, &field.value) {
            (1, WireValue::Number(kind)) => spec.kind = element(*kind),
            (2, WireValue::Bytes(shape)) => {
                for dim in fields(shape) {
                    let mut size = None;
                    for part in fields(dim?.value.bytes()) {
                        let part = part?;
                        if let (1, WireValue::Number(n)) = (part.number, &part.value) {
                            size = usize::try_from(*n as i64).ok().filter(|&n| n > 0);
                        }
                    }
                    spec.shape.push(size);
                }
            }
            _ => {}
        }
    }
    Ok(())
}

/// A type of numbers as ONNX counts them.
fn element(kind: u64) -> Option<TensorElementType> {
    Some(match kind {
        1 => TensorElementType::Float32,
        2 => TensorElementType::Uint8,
        3 => TensorElementType::Int8,
        4 => TensorElementType::Uint16,
        5 => TensorElementType::Int16,
        6 => TensorElementType::Int32,
        7 => TensorElementType::Int64,
        8 => TensorElementType::String,
        9 => TensorElementType::Bool,
        10 => TensorElementType::Float16,
        11 => TensorElementType::Float64,
        12 => TensorElementType::Uint32,
        13 => TensorElementType::Uint64,
        16 => TensorElementType::Bfloat16,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_of_holes_that_is_larger_than_any_network_is_not_scanned() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("network.onnx");
        // An empty graph, and a field that fills the rest.
        std::fs::write(&path, [0x3a, 0, 0x0a, 0x80, 0x80, 0x80, 0x80, 0x08]).unwrap();
        let Ok(()) = File::options().write(true).open(&path).unwrap().set_len(LARGEST + 8) else {
            return println!("skipped: a_file_of_holes_that_is_larger: this file system has no holes");
        };
        assert!(signature(&path).is_none());
        std::fs::write(&path, [0x3a, 0]).unwrap();
        assert!(signature(&path).is_some());
    }
}
