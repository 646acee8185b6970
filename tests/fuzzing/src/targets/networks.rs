//! Network files, as they are checked before the runtime gets them.

use crate::yard::{folder, put};
use crate::{FuzzTarget, seal};
use segwild_trainer::{Lpips, LpipsNet};

fn varint(mut value: u64) -> Vec<u8> {
    let mut out = Vec::new();
    while value >= 128 {
        out.push(value as u8 | 128);
        value >>= 7;
    }
    out.push(value as u8);
    out
}

fn number(field: u64, value: u64) -> Vec<u8> {
    [varint(field << 3), varint(value)].concat()
}

fn bytes(field: u64, value: &[u8]) -> Vec<u8> {
    [varint(field << 3 | 2), varint(value.len() as u64), value.to_vec()].concat()
}

/// A network that adds a constant: with its weights in the file, or in one beside it.
fn network(elsewhere: bool) -> Vec<u8> {
    let name = |field, text: &str| bytes(field, text.as_bytes());
    let entry = |key: &str, value: &str| bytes(13, &[name(1, key), name(2, value)].concat());
    let weights = match elsewhere {
        true => [entry("location", "weights.bin"), entry("offset", "0"), entry("length", "8"), number(14, 1)]
            .concat(),
        false => bytes(9, &[0; 8]),
    };
    let tensor = [number(1, 2), number(2, 1), name(8, "c"), weights].concat();
    let shape = bytes(2, &bytes(1, &number(1, 2)));
    let value =
        |text: &str| [name(1, text), bytes(2, &bytes(1, &[number(1, 1), shape.clone()].concat()))].concat();
    let node = [name(1, "x"), name(1, "c"), name(2, "y"), name(4, "Add")].concat();
    let graph =
        [bytes(1, &node), name(2, "g"), bytes(5, &tensor), bytes(11, &value("x")), bytes(12, &value("y"))]
            .concat();
    [number(1, 8), bytes(7, &graph), bytes(8, &[name(1, ""), number(2, 17)].concat())].concat()
}

pub(super) const ONNX: FuzzTarget = FuzzTarget {
    name: "onnx",
    seeds: || vec![network(false), network(true)],
    words: &[
        "location",
        "offset",
        "length",
        "../weights.bin",
        "/etc/hostname",
        "-1",
        "18446744073709551615",
        "Loop",
        "If",
    ],
    seal: seal::nothing,
    read: |bytes| {
        let folder = folder("onnx");
        put(&folder.join("network.onnx"), bytes);
        put(&folder.join("weights.bin"), &[0; 16]);
        let found = segwild_vision::models_in(&folder).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(found.len(), 1);
    },
};

/// The head of a file of weights with its first numbers: a whole file is too long to be changed often. What is missing is
/// refused at its tensor, after those before it are read.
fn head_of_weights(net: LpipsNet, kept: usize) -> Vec<u8> {
    let mut bytes = net.untrained();
    let header = u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes")) as usize;
    bytes.truncate(8 + header + kept);
    bytes
}

pub(super) const LPIPS: FuzzTarget = FuzzTarget {
    name: "lpips_safetensors",
    seeds: || {
        vec![head_of_weights(LpipsNet::Alex, 110_000), head_of_weights(LpipsNet::Vgg, 20_000), {
            let mut small = head_of_weights(LpipsNet::Alex, 0);
            small.extend([0; 64]);
            small
        }]
    },
    words: &[
        "F32",
        "F16",
        "BF16",
        "data_offsets",
        "[1,3,1,1]",
        "lins.0.model.1.weight",
        "net.slice5.28.weight",
        "__metadata__",
        "18446744073709551615",
        "-1",
        "[[[[",
    ],
    seal: seal::nothing,
    read: |bytes| {
        let _ = Lpips::parse(bytes);
    },
};
