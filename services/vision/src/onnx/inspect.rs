//! Checks of a network file before the runtime reads it: it is an ONNX file, it is whole, and its weights lie in its folder.
//!
//! A network file is a program from an untrusted source. Every refusal gives a reason; the caller adds the file's name.

use super::wire::{WireValue, fields};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Component, Path, PathBuf};

/// Protobuf allows no larger file; larger networks keep their weights in a second one.
const LARGEST: u64 = 2 << 30;
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

/// Reads a file and checks it. The error does not name the file.
pub(crate) fn inspect(path: &Path) -> Result<Inspected, String> {
    let unreadable = |e: std::io::Error| format!("cannot be read: {e}");
    let about = std::fs::metadata(path).map_err(unreadable)?;
    if !about.is_file() {
        return Err("is no file".into());
    }
    if about.len() > LARGEST {
        return Err(format!("has {} bytes; no network file is larger than {LARGEST}", about.len()));
    }
    let mut bytes = Vec::with_capacity(about.len() as usize);
    // At most the limit, whatever size was reported: the file may be growing.
    File::open(path).map_err(unreadable)?.take(LARGEST).read_to_end(&mut bytes).map_err(unreadable)?;
    if let Some(what) = something_else(&bytes) {
        return Err(format!("is no network: {what}"));
    }
    let mut walk = OnnxWalk { graphs: 0, beside: BTreeMap::new() };
    walk.model(&bytes).map_err(|e| format!("is no whole ONNX file: {e}"))?;
    let mut hasher = blake3::Hasher::new();
    hasher.update(&bytes);
    let mut total = 0;
    for (name, end) in &walk.beside {
        let file = beside(path, name)?;
        let unreadable =
            |e: std::io::Error| format!("keeps weights in `{name}` beside it, which cannot be read: {e}");
        let length = std::fs::metadata(&file).map_err(unreadable)?.len();
        if *end > length {
            return Err(format!("wants {end} bytes of `{name}` beside it, which has {length}"));
        }
        total += length;
        if total > LARGEST_BESIDE {
            return Err(format!("keeps more than {LARGEST_BESIDE} bytes of weights beside it"));
        }
        hasher.update_reader(File::open(&file).map_err(unreadable)?).map_err(unreadable)?;
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
fn beside(path: &Path, name: &str) -> Result<PathBuf, String> {
    let outside = || format!("wants weights from `{name}`, outside its folder; it is not followed there");
    let plain = |part: Component| matches!(part, Component::Normal(_) | Component::CurDir);
    if name.is_empty() || name.contains('\\') || !Path::new(name).components().all(plain) {
        return Err(outside());
    }
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let real = |p: &Path| {
        std::fs::canonicalize(p)
            .map_err(|e| format!("keeps weights in `{name}` beside it, which cannot be read: {e}"))
    };
    let (folder, file) = (real(folder)?, real(&folder.join(name))?);
    if !file.starts_with(&folder) {
        return Err(outside()); // by a link
    }
    if file.is_file() { Ok(file) } else { Err(format!("keeps weights in `{name}`, which is no file")) }
}

/// The state of a walk through a file.
struct OnnxWalk {
    graphs: u32,
    /// Files with weights, and up to which byte each is needed.
    beside: BTreeMap<String, u64>,
}

impl OnnxWalk {
    fn model(&mut self, bytes: &[u8]) -> Result<(), String> {
        for field in fields(bytes) {
            let field = field?;
            match field.number {
                7 => self.graph(field.value.bytes(), 0)?,
                25 => self.function(field.value.bytes())?,
                _ => {}
            }
        }
        match self.graphs {
            0 => Err("it holds no graph".into()),
            _ => Ok(()),
        }
    }

    fn graph(&mut self, bytes: &[u8], depth: u32) -> Result<(), String> {
        if depth > DEEPEST {
            return Err(format!("its graphs are nested more than {DEEPEST} deep"));
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

    fn function(&mut self, bytes: &[u8]) -> Result<(), String> {
        for field in fields(bytes) {
            let field = field?;
            if field.number == 7 {
                self.node(field.value.bytes(), 0)?;
            }
        }
        Ok(())
    }

    fn node(&mut self, bytes: &[u8], depth: u32) -> Result<(), String> {
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
    fn sparse(&mut self, bytes: &[u8]) -> Result<(), String> {
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
            _ => Err(format!("a sparse weight claims {} numbers", sides(&dims))),
        }
    }

    fn tensor(&mut self, bytes: &[u8]) -> Result<(), String> {
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
            _ => {
                return Err(format!(
                    "its weight `{name}` claims {} numbers, which are not there",
                    sides(&dims)
                ));
            }
        }
        if !elsewhere {
            return Ok(());
        }
        let location = entries.get("location").cloned().unwrap_or_default();
        let number = |key: &str| -> Result<u64, String> {
            let text = entries.get(key).map_or("0", String::as_str);
            text.parse().map_err(|_| format!("its weight `{name}` lies at {key} `{text}` of `{location}`"))
        };
        let end = number("offset")?.saturating_add(number("length")?);
        let known = self.beside.entry(location).or_default();
        *known = end.max(*known);
        Ok(())
    }
}

fn entry(bytes: &[u8]) -> Result<(String, String), String> {
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
fn declared(bytes: &[u8]) -> Result<(), String> {
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
        _ => Err(format!(
            "its input or output `{name}` is declared as {}, larger than any photo's",
            sides(&dims)
        )),
    }
}

/// The messages in one field.
fn within(bytes: &[u8], number: u64) -> Result<Vec<&[u8]>, String> {
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
