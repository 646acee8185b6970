//! Checks of a network file before the runtime reads it: it is an ONNX file, it is whole, and its weights lie in its folder.
//!
//! A network file is a program from an untrusted source. Every refusal gives a reason; the caller adds the file's name.

use super::wire::{WireError, WireValue, fields};
use segwild_scene::hash_file;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Component, Path, PathBuf};

/// Protobuf allows no larger file; larger networks keep their weights in a second one.
pub(super) const LARGEST: u64 = 2 << 30;
/// Most bytes of weights in files beside the network's.
const LARGEST_BESIDE: u64 = 16 << 30;
/// Most numbers in one declared input or output: 512 MiB of them.
const LARGEST_SHAPE: u64 = 1 << 27;
/// Graphs within graphs (branches, loops) go no deeper in any network.
const DEEPEST: u32 = 16;

/// A file that may be given to the runtime.
pub(crate) struct Inspected {
    pub bytes: Vec<u8>,
    /// BLAKE3 of the file, and of the files with its weights if it has such; hexadecimal.
    pub hash: String,
    /// Whether it keeps weights in other files.
    pub beside: bool,
}

/// Why a network file is not given to the runtime. The words follow the file's name, which the caller adds.
#[derive(Debug, thiserror::Error)]
pub enum ModelFileError {
    /// The system refuses the file.
    #[error("cannot be read: {0}")]
    Unreadable(std::io::Error),
    /// It is a folder, or a device.
    #[error("is no file")]
    NoFile,
    /// It is larger than any network file.
    #[error("has {bytes} bytes; no network file is larger than {LARGEST}")]
    TooLarge {
        /// Its size.
        bytes: u64,
    },
    /// It is something else, which its first bytes show.
    #[error("is no network: {0}")]
    NoNetwork(&'static str),
    /// Its structure is not that of a whole and sound network.
    #[error("is no whole ONNX file: {0}")]
    Structure(OnnxError),
    /// It names weights that do not lie in its folder.
    #[error("wants weights from `{name}`, outside its folder; it is not followed there")]
    Outside {
        /// The file with weights, as the network names it.
        name: String,
    },
    /// A file with its weights is a folder, or a device.
    #[error("keeps weights in `{name}`, which is no file")]
    WeightsNoFile {
        /// The file with weights.
        name: String,
    },
    /// The system refuses a file with its weights.
    #[error("keeps weights in `{name}` beside it, which cannot be read: {source}")]
    WeightsUnreadable {
        /// The file with weights.
        name: String,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file with its weights is too short.
    #[error("wants {wanted} bytes of `{name}` beside it, which has {bytes}")]
    WeightsCutShort {
        /// The file with weights.
        name: String,
        /// Bytes that the network takes from it.
        wanted: u64,
        /// Its size.
        bytes: u64,
    },
    /// The files with its weights are larger than those of any network.
    #[error("keeps more than {LARGEST_BESIDE} bytes of weights beside it")]
    WeightsTooLarge,
}

/// What is wrong in the structure of an ONNX file.
#[derive(Debug, thiserror::Error)]
pub enum OnnxError {
    /// It is no protobuf message.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// It holds no graph.
    #[error("it holds no graph")]
    NoGraph,
    /// Graphs within graphs go deeper than in any network.
    #[error("its graphs are nested more than {DEEPEST} deep")]
    TooDeep,
    /// A sparse weight is larger than any photo's input.
    #[error("a sparse weight claims {} numbers", sides(dims))]
    SparseSize {
        /// Its dimensions.
        dims: Vec<u64>,
    },
    /// A weight is larger than the bytes that hold it.
    #[error("its weight `{name}` claims {} numbers, which are not there", sides(dims))]
    WeightSize {
        /// The weight.
        name: String,
        /// Its dimensions.
        dims: Vec<u64>,
    },
    /// A weight lies in another file, at no position.
    #[error("its weight `{name}` lies at {key} `{text}` of `{location}`")]
    WeightPosition {
        /// The weight.
        name: String,
        /// `offset` or `length`.
        key: &'static str,
        /// Its value, which is no number.
        text: String,
        /// The file with the weight.
        location: String,
    },
    /// An input or output is larger than any photo's.
    #[error("its input or output `{name}` is declared as {}, larger than any photo's", sides(dims))]
    Declared {
        /// The input or output.
        name: String,
        /// Its dimensions, as far as they are fixed.
        dims: Vec<u64>,
    },
}

/// Reads a file and checks it.
pub(crate) fn inspect(path: &Path) -> Result<Inspected, ModelFileError> {
    let unreadable = ModelFileError::Unreadable;
    let about = std::fs::metadata(path).map_err(unreadable)?;
    if !about.is_file() {
        return Err(ModelFileError::NoFile);
    }
    if about.len() > LARGEST {
        return Err(ModelFileError::TooLarge { bytes: about.len() });
    }
    let mut bytes = Vec::with_capacity(about.len() as usize);
    // At most the limit, whatever size was reported: the file may be growing.
    File::open(path).map_err(unreadable)?.take(LARGEST).read_to_end(&mut bytes).map_err(unreadable)?;
    if let Some(what) = something_else(&bytes) {
        return Err(ModelFileError::NoNetwork(what));
    }
    let mut walk = OnnxWalk { graphs: 0, beside: BTreeMap::new() };
    walk.model(&bytes).map_err(ModelFileError::Structure)?;
    let mut hasher = blake3::Hasher::new();
    hasher.update(&bytes);
    let mut total = 0;
    for (name, end) in &walk.beside {
        let file = beside(path, name)?;
        let unreadable = |source| ModelFileError::WeightsUnreadable { name: name.clone(), source };
        let length = std::fs::metadata(&file).map_err(unreadable)?.len();
        if *end > length {
            return Err(ModelFileError::WeightsCutShort { name: name.clone(), wanted: *end, bytes: length });
        }
        total += length;
        if total > LARGEST_BESIDE {
            return Err(ModelFileError::WeightsTooLarge);
        }
        hash_file(&mut hasher, &file).map_err(unreadable)?;
    }
    Ok(Inspected { hash: hasher.finalize().to_hex().to_string(), beside: !walk.beside.is_empty(), bytes })
}

/// What a file is instead, where it is something that is often found under the name of a network.
fn something_else(bytes: &[u8]) -> Option<&'static str> {
    let starts = |magic: &[u8]| bytes.starts_with(magic);
    match () {
        () if bytes.is_empty() => Some("the file is empty"),
        () if starts(b"\x89PNG") || starts(b"\xff\xd8\xff") => Some("it is an image"),
        () if starts(b"PK\x03\x04") => {
            Some("it is a ZIP archive (PyTorch's weights are; an ONNX export is needed)")
        }
        () if starts(b"version https://git-lfs") => {
            Some("it stands for a file that Git LFS has yet to fetch")
        }
        () if starts(b"<") => Some("it is a web page or XML; the download went wrong"),
        () => None,
    }
}

/// The file with weights that a network names: in the network's folder, or below it.
fn beside(path: &Path, name: &str) -> Result<PathBuf, ModelFileError> {
    let outside = || ModelFileError::Outside { name: name.to_owned() };
    let plain = |part: Component| matches!(part, Component::Normal(_) | Component::CurDir);
    if name.is_empty() || name.contains('\\') || !Path::new(name).components().all(plain) {
        return Err(outside());
    }
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let real = |p: &Path| {
        std::fs::canonicalize(p)
            .map_err(|source| ModelFileError::WeightsUnreadable { name: name.to_owned(), source })
    };
    let (folder, file) = (real(folder)?, real(&folder.join(name))?);
    if !file.starts_with(&folder) {
        return Err(outside()); // by a link
    }
    if file.is_file() { Ok(file) } else { Err(ModelFileError::WeightsNoFile { name: name.to_owned() }) }
}

/// The state of a walk through a file.
struct OnnxWalk {
    graphs: u32,
    /// Files with weights, and up to which byte each is needed.
    beside: BTreeMap<String, u64>,
}

impl OnnxWalk {
    fn model(&mut self, bytes: &[u8]) -> Result<(), OnnxError> {
        for field in fields(bytes) {
            let field = field?;
            match field.number {
                7 => self.graph(field.value.bytes(), 0)?,
                25 => self.function(field.value.bytes())?,
                _ => {}
            }
        }
        match self.graphs {
            0 => Err(OnnxError::NoGraph),
            _ => Ok(()),
        }
    }

    fn graph(&mut self, bytes: &[u8], depth: u32) -> Result<(), OnnxError> {
        if depth > DEEPEST {
            return Err(OnnxError::TooDeep);
        }
        self.graphs += 1;
        for field in fields(bytes) {
            let field = field?;
            let inner = field.value.bytes();
            match field.number {
                1 => self.node(inner, depth)?,
                5 => self.tensor(inner)?,
                15 => self.sparse(inner)?,
                11 | 12 => declared(inner)?,
                _ => {}
            }
        }
        Ok(())
    }

    fn function(&mut self, bytes: &[u8]) -> Result<(), OnnxError> {
        for field in fields(bytes) {
            let field = field?;
            if field.number == 7 {
                self.node(field.value.bytes(), 0)?;
            }
        }
        Ok(())
    }

    fn node(&mut self, bytes: &[u8], depth: u32) -> Result<(), OnnxError> {
        for field in fields(bytes) {
            let field = field?;
            if field.number != 5 {
                continue;
            }
            for attribute in fields(field.value.bytes()) {
                let attribute = attribute?;
                let inner = attribute.value.bytes();
                match attribute.number {
                    5 | 10 => self.tensor(inner)?,
                    6 | 11 => self.graph(inner, depth + 1)?,
                    22 | 23 => self.sparse(inner)?,
                    _ => {}
                }
            }
        }
        Ok(())
    }

    /// Values and indices, which are tensors; its dimensions are those of a tensor that nobody makes until it is run.
    fn sparse(&mut self, bytes: &[u8]) -> Result<(), OnnxError> {
        let mut dims = Vec::new();
        for field in fields(bytes) {
            let field = field?;
            match field.number {
                1 | 2 => self.tensor(field.value.bytes())?,
                3 => dims.append(&mut field.value.numbers()?),
                _ => {}
            }
        }
        match elements(&dims) {
            Some(n) if n <= LARGEST_SHAPE => Ok(()),
            _ => Err(OnnxError::SparseSize { dims }),
        }
    }

    fn tensor(&mut self, bytes: &[u8]) -> Result<(), OnnxError> {
        let (mut dims, mut name, mut elsewhere) = (Vec::new(), String::new(), false);
        let mut entries = BTreeMap::new();
        for field in fields(bytes) {
            let field = field?;
            match field.number {
                1 => dims.append(&mut field.value.numbers()?),
                8 => name = field.value.text(),
                13 => {
                    let (key, value) = entry(field.value.bytes())?;
                    entries.insert(key, value);
                }
                14 => elsewhere = matches!(field.value, WireValue::Number(1)),
                _ => {}
            }
        }
        // The smallest numbers take half a byte.
        let most = if elsewhere { 2 * LARGEST_BESIDE } else { 2 * bytes.len() as u64 };
        match elements(&dims) {
            Some(n) if n <= most => {}
            _ => return Err(OnnxError::WeightSize { name, dims }),
        }
        if !elsewhere {
            return Ok(());
        }
        let location = entries.get("location").cloned().unwrap_or_default();
        let number = |key: &'static str| -> Result<u64, OnnxError> {
            let text = entries.get(key).map_or("0", String::as_str);
            text.parse().map_err(|_| OnnxError::WeightPosition {
                name: name.clone(),
                key,
                text: text.to_owned(),
                location: location.clone(),
            })
        };
        let end = number("offset")?.saturating_add(number("length")?);
        let known = self.beside.entry(location).or_default();
        *known = end.max(*known);
        Ok(())
    }
}

fn entry(bytes: &[u8]) -> Result<(String, String), WireError> {
    let (mut key, mut value) = (String::new(), String::new());
    for field in fields(bytes) {
        let field = field?;
        match field.number {
            1 => key = field.value.text(),
            2 => value = field.value.text(),
            _ => {}
        }
    }
    Ok((key, value))
}

/// Refuses an input or output that is declared larger than any photo's.
fn declared(bytes: &[u8]) -> Result<(), OnnxError> {
    let (mut name, mut dims) = (String::new(), Vec::new());
    for field in fields(bytes) {
        let field = field?;
        match field.number {
            1 => name = field.value.text(),
            // type, its tensor, its shape, one dimension each, its size where it is fixed
            2 => {
                for tensor in within(field.value.bytes(), 1)? {
                    for shape in within(tensor, 2)? {
                        for dim in within(shape, 1)? {
                            for size in fields(dim) {
                                let size = size?;
                                if size.number == 1 {
                                    dims.append(&mut size.value.numbers()?);
                                }
                            }
                        }
                    }
                }
            }
            _ => {}
        }
    }
    // -1 and 0 stand for sizes that are left open.
    dims.retain(|&d| d as i64 > 0);
    match elements(&dims) {
        Some(n) if n <= LARGEST_SHAPE => Ok(()),
        _ => Err(OnnxError::Declared { name, dims }),
    }
}

/// The messages in one field.
fn within(bytes: &[u8], number: u64) -> Result<Vec<&[u8]>, WireError> {
    fields(bytes)
        .filter(|f| f.as_ref().is_ok_and(|f| f.number == number) || f.is_err())
        .map(|f| f.map(|f| f.value.bytes()))
        .collect()
}

fn elements(dims: &[u64]) -> Option<u64> {
    dims.iter().try_fold(1u64, |product, &d| product.checked_mul(d))
}

fn sides(dims: &[u64]) -> String {
    dims.iter().map(|&d| (d as i64).to_string()).collect::<Vec<_>>().join(" x ")
}
