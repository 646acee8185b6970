//! The file of the weights: `.safetensors`, which is eight bytes with the length of a header, the header as JSON (type,
//! shape and bytes of each tensor), then the numbers. Somebody else made it: every claim is checked before it is used.

use serde::Deserialize;
use std::collections::BTreeMap;

/// Most bytes of a header; those of the networks here have under 8 KiB.
const MOST_HEADER: u64 = 1 << 20;

/// Why a file holds no weights of LPIPS. The sentence names the tensor by its key; the file's name is the caller's to add.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LpipsError {
    /// The file is no `.safetensors`.
    #[error("it is no .safetensors file: {0}")]
    Form(&'static str),
    /// The header is no table of tensors.
    #[error("its header cannot be read: {0}")]
    Header(String),
    /// The tensors are of neither network.
    #[error(
        "its tensors are neither those of LPIPS over VGG-16 nor over AlexNet (keys as `net.slice5.28.weight` or \
         `net.slice5.10.weight`): save the state_dict of lpips.LPIPS(net=\"vgg\") or (net=\"alex\")"
    )]
    Net,
    /// A tensor is missing.
    #[error("tensor `{0}` is missing: save the whole state_dict of lpips.LPIPS")]
    Missing(String),
    /// A tensor's entry in the header is malformed.
    #[error("the header's entry of tensor `{key}` cannot be read: {reason}")]
    Entry {
        /// The tensor.
        key: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A tensor has another shape.
    #[error("tensor `{key}` has the shape {found:?}, and the network needs {wanted:?}")]
    Shape {
        /// The tensor.
        key: String,
        /// Its shape.
        found: Vec<u64>,
        /// The shape of the network's tensor.
        wanted: Vec<usize>,
    },
    /// A tensor's numbers are of a type that is not read.
    #[error("tensor `{key}` holds numbers of type {dtype:?}; F32, F16 and BF16 are read")]
    Type {
        /// The tensor.
        key: String,
        /// Its type.
        dtype: String,
    },
    /// The bytes of a tensor are not where the header says.
    #[error("the bytes of tensor `{0}` are not in the file: it is cut short or damaged")]
    Bytes(String),
    /// A number is none, or infinite.
    #[error("number {index} of tensor `{key}` is not finite")]
    NotFinite {
        /// The tensor.
        key: String,
        /// Index of the number.
        index: usize,
    },
    /// A number that must be positive is not.
    #[error("number {index} of tensor `{key}` is {value}, and {wanted}")]
    Sign {
        /// The tensor.
        key: String,
        /// Index of the number.
        index: usize,
        /// The number.
        value: String,
        /// What it must be.
        wanted: &'static str,
    },
}

/// A tensor as the header describes it.
#[derive(Deserialize)]
struct TensorEntry {
    dtype: String,
    shape: Vec<u64>,
    data_offsets: [u64; 2],
}

/// The tensors of a file.
pub(super) struct TensorTable<'a> {
    entries: BTreeMap<String, serde_json::Value>,
    /// Everything after the header.
    data: &'a [u8],
}

impl<'a> TensorTable<'a> {
    /// Reads the header.
    pub fn of(bytes: &'a [u8]) -> Result<TensorTable<'a>, LpipsError> {
        let (length, rest) =
            bytes.split_first_chunk::<8>().ok_or(LpipsError::Form("it has fewer than eight bytes"))?;
        let length = u64::from_le_bytes(*length);
        if length > MOST_HEADER {
            return Err(LpipsError::Form("its first bytes are not the length of a header"));
        }
        let header = rest.get(..length as usize).ok_or(LpipsError::Form("it ends within its header"))?;
        let entries = serde_json::from_slice(header).map_err(|e| LpipsError::Header(e.to_string()))?;
        Ok(TensorTable { entries, data: &rest[length as usize..] })
    }

    /// Whether there is a tensor of this key.
    pub fn has(&self, key: &str) -> bool {
        self.entries.contains_key(key)
    }

    /// The numbers of a tensor, which must have this shape and be finite.
    pub fn numbers(&self, key: &str, wanted: &[usize]) -> Result<Vec<f32>, LpipsError> {
        let entry = self.entries.get(key).ok_or_else(|| LpipsError::Missing(key.into()))?;
        let entry = TensorEntry::deserialize(entry)
            .map_err(|e| LpipsError::Entry { key: key.into(), reason: e.to_string() })?;
        if !entry.shape.iter().copied().eq(wanted.iter().map(|&n| n as u64)) {
            return Err(LpipsError::Shape { key: key.into(), found: entry.shape, wanted: wanted.to_vec() });
        }
        let (size, number): (usize, fn(&[u8]) -> f32) = match entry.dtype.as_str() {
            "F32" => (4, |b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            "F16" => (2, |b| from_half(u16::from_le_bytes([b[0], b[1]]))),
            "BF16" => (2, |b| f32::from_bits(u32::from(u16::from_le_bytes([b[0], b[1]])) << 16)),
            _ => return Err(LpipsError::Type { key: key.into(), dtype: entry.dtype }),
        };
        let [from, to] = entry.data_offsets.map(|n| usize::try_from(n).unwrap_or(usize::MAX));
        let count: usize = wanted.iter().product();
        let bytes = self.data.get(from..to).filter(|bytes| bytes.len() == count * size);
        let bytes = bytes.ok_or_else(|| LpipsError::Bytes(key.into()))?;
        let numbers: Vec<f32> = bytes.chunks_exact(size).map(number).collect();
        match numbers.iter().position(|v| !v.is_finite()) {
            Some(index) => Err(LpipsError::NotFinite { key: key.into(), index }),
            None => Ok(numbers),
        }
    }

    /// The same for numbers that must all fulfil a condition, which `wanted` puts in words.
    pub fn numbers_that(
        &self,
        key: &str,
        shape: &[usize],
        fulfil: fn(f32) -> bool,
        wanted: &'static str,
    ) -> Result<Vec<f32>, LpipsError> {
        let numbers = self.numbers(key, shape)?;
        match numbers.iter().position(|v| !fulfil(*v)) {
            Some(index) => {
                Err(LpipsError::Sign { key: key.into(), index, value: numbers[index].to_string(), wanted })
            }
            None => Ok(numbers),
        }
    }
}

/// A number of 16 bits (IEEE 754 binary16).
fn from_half(bits: u16) -> f32 {
    let (sign, exponent, fraction) = (u32::from(bits >> 15) << 31, (bits >> 10) & 31, u32::from(bits & 1023));
    match exponent {
        0 => {
            let small = fraction as f32 * (1.0 / (1 << 24) as f32);
            if sign == 0 { small } else { -small }
        }
        31 => f32::from_bits(sign | 0x7f80_0000 | fraction << 13),
        _ => f32::from_bits(sign | (u32::from(exponent) + 112) << 23 | fraction << 13),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file of such a header and numbers.
    fn file(header: &str, data: &[u8]) -> Vec<u8> {
        [&(header.len() as u64).to_le_bytes(), header.as_bytes(), data].concat()
    }

    #[test]
    fn numbers_of_every_type_are_read() {
        let header = r#"{"__metadata__":{"format":"pt"},
            "a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},
            "b":{"dtype":"F16","shape":[1,4],"data_offsets":[8,16]},
            "c":{"dtype":"BF16","shape":[],"data_offsets":[16,18]}}"#;
        let half = [0x3555u16, 0xc000, 0x0001, 0x83ff].map(u16::to_le_bytes).concat();
        let data = [&1.5f32.to_le_bytes()[..], &(-0.25f32).to_le_bytes(), &half, &[0x20, 0xc1]].concat();
        let bytes = file(header, &data);
        let table = TensorTable::of(&bytes).unwrap();
        assert_eq!(table.numbers("a", &[2]).unwrap(), [1.5, -0.25]);
        let exact = [0.333_251_95, -2.0, 2f32.powi(-24), -1023.0 * 2f32.powi(-24)];
        assert_eq!(table.numbers("b", &[1, 4]).unwrap(), exact);
        assert_eq!(table.numbers("c", &[]).unwrap(), [-10.0]);
        assert!(table.has("a") && !table.has("d"));
    }

    #[test]
    fn what_is_wrong_with_a_file_is_named_with_the_tensor() {
        let one = |entry: &str, data: &[u8]| {
            let bytes = file(&format!(r#"{{"w":{entry}}}"#), data);
            let table = TensorTable::of(&bytes).unwrap();
            table.numbers("w", &[2]).unwrap_err().to_string()
        };
        let good = r#"{"dtype":"F32","shape":[2],"data_offsets":[0,8]}"#;
        for (entry, data, words) in [
            (r#"{"dtype":"F32","shape":[3],"data_offsets":[0,12]}"#, &[0; 12][..], "`w` has the shape [3]"),
            (r#"{"dtype":"I64","shape":[2],"data_offsets":[0,16]}"#, &[0; 16], "\"I64\""),
            (good, &[0; 7], "`w` are not in the file"),
            (r#"{"dtype":"F32","shape":[2],"data_offsets":[8,0]}"#, &[0; 8], "`w` are not in the file"),
            (r#"{"dtype":"F32","shape":[2],"data_offsets":[0,18446744073709551615]}"#, &[0; 8], "not in"),
            (r#"{"dtype":"F32","shape":[2]}"#, &[0; 8], "entry of tensor `w`"),
            (r#"[1]"#, &[0; 8], "entry of tensor `w`"),
            (good, &[0, 0, 0, 0, 0, 0, 0xc0, 0x7f], "number 1 of tensor `w` is not finite"),
            (good, &[0, 0, 0x80, 0xff, 0, 0, 0, 0], "number 0 of tensor `w` is not finite"),
        ] {
            let message = one(entry, data);
            assert!(message.contains(words), "{message}");
        }
        let bytes = file(&format!(r#"{{"w":{good}}}"#), &[0; 8]);
        let table = TensorTable::of(&bytes).unwrap();
        assert_eq!(table.numbers("v", &[2]), Err(LpipsError::Missing("v".into())));
        let sign = table.numbers_that("w", &[2], |v| v > 0.0, "it must be above 0").unwrap_err().to_string();
        assert_eq!(sign, "number 0 of tensor `w` is 0, and it must be above 0");
    }

    #[test]
    fn what_is_no_such_file_is_refused_whatever_it_claims() {
        let claim = |length: u64| length.to_le_bytes().to_vec();
        for bytes in
            [vec![], vec![1; 7], claim(1), claim(u64::MAX), claim(1 << 20), b"PK\x03\x04torch".to_vec()]
        {
            assert!(matches!(TensorTable::of(&bytes), Err(LpipsError::Form(_))), "{bytes:?}");
        }
        for header in ["", "[]", "{", "{\"a\":", &"[".repeat(100_000)] {
            assert!(matches!(TensorTable::of(&file(header, &[])), Err(LpipsError::Header(_))), "{header:.9}");
        }
    }
}
