//! Writes ONNX files: the few messages of protobuf that a small network needs.

/// Kinds of numbers, as ONNX counts them.
pub const FLOAT: u64 = 1;
pub const UINT8: u64 = 2;
pub const INT32: u64 = 6;
pub const INT64: u64 = 7;
pub const BOOL: u64 = 9;
pub const FLOAT16: u64 = 10;

/// A size that the file leaves open.
pub const OPEN: i64 = -1;

/// An attribute of a node.
pub enum Attribute {
    Int(i64),
    Ints(Vec<i64>),
    Text(&'static str),
    OnnxGraph(OnnxGraph),
}

/// A graph, while it is written.
#[derive(Default)]
pub struct OnnxGraph {
    bytes: Vec<u8>,
    names: usize,
}

fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 128 {
        out.push(value as u8 | 128);
        value >>= 7;
    }
    out.push(value as u8);
}

pub fn number(out: &mut Vec<u8>, field: u64, value: u64) {
    varint(out, field << 3);
    varint(out, value);
}

pub fn bytes(out: &mut Vec<u8>, field: u64, value: &[u8]) {
    varint(out, field << 3 | 2);
    varint(out, value.len() as u64);
    out.extend_from_slice(value);
}

/// A tensor with its numbers in it.
pub fn tensor(name: &str, kind: u64, dims: &[i64], raw: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    dims.iter().for_each(|&d| number(&mut out, 1, d as u64));
    number(&mut out, 2, kind);
    bytes(&mut out, 8, name.as_bytes());
    bytes(&mut out, 9, raw);
    out
}

/// A tensor whose numbers are in another file.
pub fn tensor_elsewhere(name: &str, dims: &[i64], entries: &[(&str, &str)]) -> Vec<u8> {
    let mut out = Vec::new();
    dims.iter().for_each(|&d| number(&mut out, 1, d as u64));
    number(&mut out, 2, FLOAT);
    bytes(&mut out, 8, name.as_bytes());
    for (key, value) in entries {
        let mut entry = Vec::new();
        bytes(&mut entry, 1, key.as_bytes());
        bytes(&mut entry, 2, value.as_bytes());
        bytes(&mut out, 13, &entry);
    }
    number(&mut out, 14, 1);
    out
}

fn declared(name: &str, kind: u64, dims: &[i64]) -> Vec<u8> {
    let mut shape = Vec::new();
    for (i, &dim) in dims.iter().enumerate() {
        let mut one = Vec::new();
        if dim == OPEN {
            bytes(&mut one, 2, format!("{name}_{i}").as_bytes());
        } else {
            number(&mut one, 1, dim as u64);
        }
        bytes(&mut shape, 1, &one);
    }
    let (mut tensor, mut kind_of, mut out) = (Vec::new(), Vec::new(), Vec::new());
    number(&mut tensor, 1, kind);
    bytes(&mut tensor, 2, &shape);
    bytes(&mut kind_of, 1, &tensor);
    bytes(&mut out, 1, name.as_bytes());
    bytes(&mut out, 2, &kind_of);
    out
}

impl OnnxGraph {
    pub fn input(&mut self, name: &str, kind: u64, dims: &[i64]) {
        bytes(&mut self.bytes, 11, &declared(name, kind, dims));
    }

    pub fn output(&mut self, name: &str, kind: u64, dims: &[i64]) {
        bytes(&mut self.bytes, 12, &declared(name, kind, dims));
    }

    /// Adds a tensor that is written already.
    pub fn weight(&mut self, tensor: &[u8]) {
        bytes(&mut self.bytes, 5, tensor);
    }

    fn fresh(&mut self) -> String {
        self.names += 1;
        format!("v{}", self.names)
    }

    pub fn floats(&mut self, dims: &[i64], values: &[f32]) -> String {
        let name = self.fresh();
        let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.weight(&tensor(&name, FLOAT, dims, &raw));
        name
    }

    pub fn ints(&mut self, dims: &[i64], values: &[i64]) -> String {
        let name = self.fresh();
        let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.weight(&tensor(&name, INT64, dims, &raw));
        name
    }

    pub fn truth(&mut self, value: bool) -> String {
        let name = self.fresh();
        self.weight(&tensor(&name, BOOL, &[], &[u8::from(value)]));
        name
    }

    /// A node of one output, which gets a name of its own.
    pub fn op(&mut self, op: &str, inputs: &[&str], attributes: Vec<(&str, Attribute)>) -> String {
        let name = self.fresh();
        self.op_to(op, inputs, &name, attributes);
        name
    }

    pub fn op_to(&mut self, op: &str, inputs: &[&str], output: &str, attributes: Vec<(&str, Attribute)>) {
        let mut node = Vec::new();
        inputs.iter().for_each(|i| bytes(&mut node, 1, i.as_bytes()));
        bytes(&mut node, 2, output.as_bytes());
        bytes(&mut node, 4, op.as_bytes());
        for (name, value) in attributes {
            let mut attribute = Vec::new();
            bytes(&mut attribute, 1, name.as_bytes());
            let kind = match value {
                Attribute::Int(i) => {
                    number(&mut attribute, 3, i as u64);
                    2
                }
                Attribute::Ints(all) => {
                    all.iter().for_each(|&i| number(&mut attribute, 8, i as u64));
                    7
                }
                Attribute::Text(text) => {
                    bytes(&mut attribute, 4, text.as_bytes());
                    3
                }
                Attribute::OnnxGraph(graph) => {
                    bytes(&mut attribute, 6, &graph.named("inner"));
                    5
                }
            };
            number(&mut attribute, 20, kind);
            bytes(&mut node, 5, &attribute);
        }
        bytes(&mut self.bytes, 1, &node);
    }

    fn named(mut self, name: &str) -> Vec<u8> {
        bytes(&mut self.bytes, 2, name.as_bytes());
        self.bytes
    }

    /// The file.
    pub fn file(self) -> Vec<u8> {
        let (mut out, mut opset) = (Vec::new(), Vec::new());
        number(&mut out, 1, 8);
        bytes(&mut out, 7, &self.named("toy"));
        bytes(&mut opset, 1, b"");
        number(&mut opset, 2, 13);
        bytes(&mut out, 8, &opset);
        out
    }
}
