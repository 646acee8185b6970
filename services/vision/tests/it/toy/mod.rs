//! Small networks with exactly the interfaces of the SAM family's exports, which compute something that can be checked: the
//! encoder describes each cell of 16 x 16 pixels by its mean colour and its place, and the decoder answers the cells that
//! are as coloured as those that were clicked, within three tolerances.
#![allow(dead_code, reason = "each test file uses a part of it")]

pub mod clip;
pub mod onnx;
pub mod sam2;

use onnx::{Attribute::*, FLOAT, INT64, OPEN, OnnxGraph, UINT8};
use std::path::Path;

const MEAN: [f32; 3] = [123.675, 116.28, 103.53];
const DEVIATION: [f32; 3] = [58.395, 57.12, 57.375];
/// Tolerances of the three masks, in squared distance of standardised colours, and the scores they are given.
pub const TOLERANCES: [f32; 3] = [0.2, 1.0, 4.0];
pub const SCORES: [f32; 3] = [0.9, 0.95, 0.93];

/// What an encoder takes.
#[derive(Clone, Copy, PartialEq)]
pub enum Takes {
    /// SAM's: `[1, 3, 1024, 1024]`.
    Planes,
    /// EfficientSAM's: `batched_images` of any size.
    Whole,
    /// SAM's with the padding inside, for landscapes: `[684, 1024, 3]`, bytes or floats.
    Pixels(u64),
}

/// What is wrong with an encoder.
#[derive(Clone, Copy, PartialEq)]
pub enum ToyFault {
    None,
    /// Answers what is no number.
    NoNumber,
    /// Answers half of the columns; how many is known only when it is run.
    Half,
    /// A loop without end.
    Endless,
    /// Asks for 4.8 GB on its way.
    Huge,
    /// The same, known when the file is loaded.
    HugeAtOnce,
}

/// An encoder's file.
pub fn encoder(takes: Takes, fault: ToyFault) -> Vec<u8> {
    let mut g = OnnxGraph::default();
    let thirds = |values: [f32; 3], by: f32| values.map(|v| v / by);
    let planes = match takes {
        Takes::Planes => {
            g.input("image", FLOAT, &[1, 3, 1024, 1024]);
            "image".to_owned()
        }
        Takes::Whole => {
            g.input("batched_images", FLOAT, &[OPEN, 3, OPEN, OPEN]);
            let sizes = g.ints(&[4], &[1, 3, 1024, 1024]);
            let wide = g.op("Resize", &["batched_images", "", "", &sizes], vec![("mode", Text("linear"))]);
            standardised(&mut g, &wide, thirds(MEAN, 255.0), thirds(DEVIATION, 255.0))
        }
        Takes::Pixels(kind) => {
            g.input("input_image", kind, &[684, 1024, 3]);
            let floats = g.op("Cast", &["input_image"], vec![("to", Int(FLOAT as i64))]);
            let turned = g.op("Transpose", &[&floats], vec![("perm", Ints(vec![2, 0, 1]))]);
            let axis = g.ints(&[1], &[0]);
            let four = g.op("Unsqueeze", &[&turned, &axis], vec![]);
            let even = standardised(&mut g, &four, MEAN, DEVIATION);
            let below = g.ints(&[4], &[1, 3, 340, 1024]);
            let below = g.op("ConstantOfShape", &[&below], vec![]);
            g.op("Concat", &[&even, &below], vec![("axis", Int(2))])
        }
    };
    let pool = vec![("kernel_shape", Ints(vec![16, 16])), ("strides", Ints(vec![16, 16]))];
    let colours = g.op("AveragePool", &[&planes], pool);
    let n = 64;
    let centre = |i: usize| (i as f32 + 0.5) / n as f32;
    let positions: Vec<f32> =
        (0..n * n).map(|i| centre(i % n)).chain((0..n * n).map(|i| centre(i / n))).collect();
    let positions = g.floats(&[1, 2, n as i64, n as i64], &positions);
    let mut all = g.op("Concat", &[&colours, &positions], vec![("axis", Int(1))]);
    match fault {
        ToyFault::None => {}
        ToyFault::Half => {
            let (none, columns, third) =
                (g.floats(&[1], &[0.0]), g.floats(&[1], &[32.0]), g.ints(&[1], &[3]));
            let flat = g.ints(&[1], &[-1]);
            let values = g.op("Reshape", &[&planes, &flat], vec![]);
            let most = g.op("ReduceMax", &[&values], vec![("keepdims", Int(1))]);
            let nothing = g.op("Mul", &[&most, &none], vec![]);
            let ends = g.op("Add", &[&nothing, &columns], vec![]);
            let ends = g.op("Cast", &[&ends], vec![("to", Int(INT64 as i64))]);
            let start = g.ints(&[1], &[0]);
            all = g.op("Slice", &[&all, &start, &ends, &third], vec![]);
        }
        ToyFault::NoNumber => {
            let nan = g.floats(&[1], &[f32::NAN]);
            all = g.op("Add", &[&all, &nan], vec![]);
        }
        ToyFault::Endless => {
            let mut body = OnnxGraph::default();
            body.input("turn", INT64, &[]);
            body.input("go", onnx::BOOL, &[]);
            body.input("value", FLOAT, &[1]);
            body.op_to("Identity", &["go"], "go_on", vec![]);
            body.op_to("Identity", &["value"], "same", vec![]);
            body.output("go_on", onnx::BOOL, &[]);
            body.output("same", FLOAT, &[1]);
            let (go, start) = (g.truth(true), g.floats(&[1], &[0.0]));
            let end = g.op("Loop", &["", &go, &start], vec![("body", OnnxGraph(body))]);
            all = g.op("Add", &[&all, &end], vec![]);
        }
        ToyFault::HugeAtOnce => {
            let shape = g.ints(&[4], &[40_000, 30_000, 1, 1]);
            let zeros = g.op("ConstantOfShape", &[&shape], vec![]);
            let sum = g.op("ReduceMax", &[&zeros], vec![("keepdims", Int(1))]);
            all = g.op("Add", &[&all, &sum], vec![]);
        }
        ToyFault::Huge => {
            // Its size is worked out from the photo, so that it is not known before.
            let shape = g.op("Shape", &[&planes], vec![]);
            let times = g.ints(&[4], &[40_000, 10_000, 0, 0]);
            let one = g.ints(&[4], &[0, 0, 1, 1]);
            let huge = g.op("Mul", &[&shape, &times], vec![]);
            let huge = g.op("Add", &[&huge, &one], vec![]);
            let zeros = g.op("ConstantOfShape", &[&huge], vec![]);
            let sum = g.op("ReduceMax", &[&zeros], vec![("keepdims", Int(1))]);
            all = g.op("Add", &[&all, &sum], vec![]);
        }
    }
    let pads = g.ints(&[8], &[0, 0, 0, 0, 0, 251, 0, 0]);
    g.op_to("Pad", &[&all, &pads], "image_embeddings", vec![]);
    let open = if fault == ToyFault::Half { OPEN } else { 64 };
    g.output("image_embeddings", FLOAT, &[if takes == Takes::Whole { OPEN } else { 1 }, 256, open, open]);
    g.file()
}

fn standardised(g: &mut OnnxGraph, planes: &str, mean: [f32; 3], deviation: [f32; 3]) -> String {
    let (mean, deviation) = (g.floats(&[1, 3, 1, 1], &mean), g.floats(&[1, 3, 1, 1], &deviation));
    let less = g.op("Sub", &[planes, &mean], vec![]);
    g.op("Div", &[&less, &deviation], vec![])
}

/// What a decoder takes and answers.
#[derive(Clone, Copy)]
pub struct ToyDecoder {
    pub efficient: bool,
    /// 3, or 4 with one for precise prompts before them, or 1.
    pub masks: i64,
    /// Whether there are small masks beside those of the photo's size.
    pub small: bool,
    /// Number of queries: SAM's is 1, or open.
    pub queries: i64,
    /// Points per query.
    pub points: i64,
    /// Answers scores that are no numbers.
    pub spoilt: bool,
}

/// SAM's published export.
pub const SAM: ToyDecoder =
    ToyDecoder { efficient: false, masks: 4, small: true, queries: 1, points: OPEN, spoilt: false };
/// EfficientSAM's.
pub const EFFICIENT: ToyDecoder = ToyDecoder { efficient: true, masks: 3, queries: OPEN, ..SAM };

/// A decoder's file.
pub fn decoder(d: ToyDecoder) -> Vec<u8> {
    let mut g = OnnxGraph::default();
    g.input("image_embeddings", FLOAT, &[1, 256, 64, 64]);
    let prefix = if d.efficient { "batched_" } else { "" };
    let (coords, labels) = (format!("{prefix}point_coords"), format!("{prefix}point_labels"));
    if d.efficient {
        g.input(&coords, FLOAT, &[1, d.queries, d.points, 2]);
        g.input(&labels, FLOAT, &[1, d.queries, d.points]);
        g.input("orig_im_size", INT64, &[2]);
    } else {
        g.input(&coords, FLOAT, &[d.queries, d.points, 2]);
        g.input(&labels, FLOAT, &[d.queries, d.points]);
        g.input("mask_input", FLOAT, &[1, 1, 256, 256]);
        g.input("has_mask_input", FLOAT, &[1]);
        g.input("orig_im_size", FLOAT, &[2]);
    }
    let zero = g.ints(&[1], &[0]);
    let (mut at, mut label) = (coords, labels);
    let size = g.op("Cast", &["orig_im_size"], vec![("to", Int(FLOAT as i64))]);
    if d.efficient {
        // From the photo's pixels to the square's, each side for itself.
        (at, label) = (g.op("Squeeze", &[&at, &zero], vec![]), g.op("Squeeze", &[&label, &zero], vec![]));
        let turned = g.ints(&[2], &[1, 0]);
        let width_height = g.op("Gather", &[&size, &turned], vec![("axis", Int(0))]);
        let side = g.floats(&[1], &[1024.0]);
        let share = g.op("Div", &[&at, &width_height], vec![]);
        at = g.op("Mul", &[&share, &side], vec![]);
    }
    let previous = (!d.efficient).then_some(["mask_input", "has_mask_input"]);
    let from = LogitSources { embedding: "image_embeddings", previous, grid: [64, 16], masks: d.masks };
    let logits = logits(&mut g, &from, &at, &label);

    // [Q, M, 64, 64] -> [Q, M, 256, 256]
    let scales = g.floats(&[4], &[1.0, 1.0, 4.0, 4.0]);
    let small = g.op("Resize", &[&logits, "", &scales], vec![("mode", Text("linear"))]);
    let scores: Vec<f32> = match d.masks {
        4 => [&[0.99], &SCORES[..]].concat(),
        1 => vec![0.91],
        _ => SCORES.to_vec(),
    };
    let scores = g.floats(&[1, d.masks], &scores);
    // One row per question.
    let one = g.ints(&[1], &[1]);
    let nothing = g.op("ReduceSum", &[&label, &one], vec![("keepdims", Int(1))]);
    let factor = g.floats(&[1], &[if d.spoilt { f32::NAN } else { 0.0 }]);
    let nothing = g.op("Mul", &[&nothing, &factor], vec![]);
    let scores = g.op("Add", &[&scores, &nothing], vec![]);
    let full = full_size(&mut g, &d, &small, &size);
    let give = |g: &mut OnnxGraph, value: &str, name: &str, dims: &[i64]| match d.efficient {
        true => {
            g.op_to("Unsqueeze", &[value, &zero], name, vec![]);
            g.output(name, FLOAT, &[&[1], dims].concat());
        }
        false => {
            g.op_to("Identity", &[value], name, vec![]);
            g.output(name, FLOAT, dims);
        }
    };
    let q = d.queries;
    give(&mut g, &full, if d.efficient { "output_masks" } else { "masks" }, &[q, d.masks, OPEN, OPEN]);
    give(&mut g, &scores, "iou_predictions", &[q, d.masks]);
    if d.small {
        // EfficientSAM's export leaves it without a name of its own.
        give(&mut g, &small, if d.efficient { "2973" } else { "low_res_masks" }, &[q, d.masks, 256, 256]);
    }
    g.file()
}

/// What the logits are made of: names of values in the graph, and sizes.
struct LogitSources<'a> {
    embedding: &'a str,
    /// Logits of an earlier answer, and whether there are any.
    previous: Option<[&'a str; 2]>,
    /// Cells along a side, and pixels along a side of a cell.
    grid: [i64; 2],
    masks: i64,
}

/// `[Q, N, 2]` positions and `[Q, N]` labels to `[Q, M, n, n]` logits, with n = 64 in SAM's.
fn logits(g: &mut OnnxGraph, from: &LogitSources, at: &str, label: &str) -> String {
    let [n, pixels] = from.grid;
    let flat = g.ints(&[2], &[256, n * n]);
    let cells = g.op("Reshape", &[from.embedding, &flat], vec![]);
    let (colours, positions) = (g.ints(&[3], &[0, 1, 2]), g.ints(&[2], &[3, 4]));
    let colours = g.op("Gather", &[&cells, &colours], vec![("axis", Int(0))]);
    let positions = g.op("Gather", &[&cells, &positions], vec![("axis", Int(0))]);
    // The cell under each point.
    let (side, columns) = (g.floats(&[1], &[pixels as f32]), g.floats(&[1], &[n as f32]));
    let (zero, last) = (g.floats(&[], &[0.0]), g.floats(&[], &[n as f32 - 1.0]));
    let cell = g.op("Div", &[at, &side], vec![]);
    let cell = g.op("Floor", &[&cell], vec![]);
    let cell = g.op("Clip", &[&cell, &zero, &last], vec![]);
    let (first, second) = (g.ints(&[], &[0]), g.ints(&[], &[1]));
    let of =
        |g: &mut OnnxGraph, value: &str, which: &str| g.op("Gather", &[value, which], vec![("axis", Int(2))]);
    let (x, y) = (of(g, &cell, &first), of(g, &cell, &second));
    let row = g.op("Mul", &[&y, &columns], vec![]);
    let index = g.op("Add", &[&row, &x], vec![]);
    let index = g.op("Cast", &[&index], vec![("to", Int(INT64 as i64))]);
    // [3, Q, N, 1] against [3, 1, 1, 4096]
    let clicked = g.op("Gather", &[&colours, &index], vec![("axis", Int(1))]);
    let (three, one_two) = (g.ints(&[1], &[3]), g.ints(&[2], &[1, 2]));
    let clicked = g.op("Unsqueeze", &[&clicked, &three], vec![]);
    let every = g.op("Unsqueeze", &[&colours, &one_two], vec![]);
    let difference = g.op("Sub", &[&every, &clicked], vec![]);
    let square = g.op("Mul", &[&difference, &difference], vec![]);
    let axis = g.ints(&[1], &[0]);
    let distance = g.op("ReduceSum", &[&square, &axis], vec![("keepdims", Int(0))]);
    let two = g.ints(&[1], &[2]);
    let labels_wide = g.op("Unsqueeze", &[label, &two], vec![]); // [Q, N, 1]
    let (far, unit) = (g.floats(&[1], &[1000.0]), g.floats(&[1], &[1.0]));
    let is = |g: &mut OnnxGraph, value: f32| {
        let value = g.floats(&[1], &[value]);
        let equal = g.op("Equal", &[&labels_wide, &value], vec![]);
        g.op("Cast", &[&equal], vec![("to", Int(FLOAT as i64))])
    };
    let over_points = |g: &mut OnnxGraph, value: &str| {
        let axis = g.ints(&[1], &[1]);
        g.op("ReduceSum", &[value, &axis], vec![("keepdims", Int(0))])
    };
    let nearest = |g: &mut OnnxGraph, of: &str| {
        let not = g.op("Sub", &[&unit, of], vec![]);
        let penalty = g.op("Mul", &[&not, &far], vec![]);
        let sum = g.op("Add", &[&distance, &penalty], vec![]);
        g.op("ReduceMin", &[&sum], vec![("axes", Ints(vec![1])), ("keepdims", Int(0))]) // [Q, 4096]
    };
    let (inside, outside) = (is(g, 1.0), is(g, 0.0));
    let near = nearest(g, &inside);
    let any = over_points(g, &inside);
    let any = g.op("Min", &[&any, &unit], vec![]);
    let near = g.op("Mul", &[&near, &any], vec![]); // a box alone: all of it
    let wrong = nearest(g, &outside);
    // Logits by tolerance, less what is like a click outside.
    let one = g.ints(&[1], &[1]);
    let tolerances = match from.masks {
        4 => [&[1.0], &TOLERANCES[..]].concat(),
        1 => vec![1.0],
        _ => TOLERANCES.to_vec(),
    };
    let tolerances = g.floats(&[from.masks, 1], &tolerances);
    let gain = g.floats(&[1], &[20.0]);
    let near = g.op("Unsqueeze", &[&near, &one], vec![]);
    let within = g.op("Sub", &[&tolerances, &near], vec![]);
    let within = g.op("Mul", &[&within, &gain], vec![]); // [Q, M, 4096]
    let least = g.floats(&[1], &[TOLERANCES[0]]);
    let beyond = g.op("Sub", &[&wrong, &least], vec![]);
    let beyond = g.op("Mul", &[&beyond, &gain], vec![]);
    let beyond = g.op("Unsqueeze", &[&beyond, &one], vec![]);
    let mut all = g.op("Min", &[&within, &beyond], vec![]);
    // Within the box, in cells from its edge.
    let (low, high) = (is(g, 2.0), is(g, 3.0));
    let boxed = over_points(g, &low);
    let corner = |g: &mut OnnxGraph, which: &str| {
        let picked = g.op("Mul", &[at, which], vec![]);
        over_points(g, &picked) // [Q, 2]
    };
    let (low, high) = (corner(g, &low), corner(g, &high));
    let (low, high) = (g.op("Unsqueeze", &[&low, &two], vec![]), g.op("Unsqueeze", &[&high, &two], vec![]));
    let side = g.floats(&[1], &[(n * pixels) as f32]);
    let pixels = g.op("Mul", &[&positions, &side], vec![]); // [2, 4096]
    let (a, b) = (g.op("Sub", &[&pixels, &low], vec![]), g.op("Sub", &[&high, &pixels], vec![]));
    let depth = g.op("Min", &[&a, &b], vec![]);
    let depth = g.op("ReduceMin", &[&depth], vec![("axes", Ints(vec![1])), ("keepdims", Int(0))]);
    let not = g.op("Sub", &[&unit, &boxed], vec![]);
    let penalty = g.op("Mul", &[&not, &far], vec![]);
    let depth = g.op("Mul", &[&depth, &boxed], vec![]);
    let depth = g.op("Add", &[&depth, &penalty], vec![]);
    let depth = g.op("Unsqueeze", &[&depth, &one], vec![]);
    all = g.op("Min", &[&all, &depth], vec![]);
    let (least, most) = (g.floats(&[], &[-10.0]), g.floats(&[], &[10.0]));
    all = g.op("Clip", &[&all, &least, &most], vec![]);
    if let Some([mask, has]) = from.previous {
        // A quarter of what was answered before.
        let pool = vec![("kernel_shape", Ints(vec![4, 4])), ("strides", Ints(vec![4, 4]))];
        let before = g.op("AveragePool", &[mask], pool);
        let shape = g.ints(&[3], &[-1, 1, n * n]);
        let before = g.op("Reshape", &[&before, &shape], vec![]);
        let quarter = g.floats(&[1], &[0.25]);
        let weight = g.op("Mul", &[has, &quarter], vec![]);
        let before = g.op("Mul", &[&before, &weight], vec![]);
        all = g.op("Add", &[&all, &before], vec![]);
    }
    let shape = g.ints(&[4], &[-1, from.masks, n, n]);
    g.op("Reshape", &[&all, &shape], vec![])
}

/// The masks at the photo's size, as the published exports make them.
fn full_size(g: &mut OnnxGraph, d: &ToyDecoder, small: &str, size: &str) -> String {
    let linear = || vec![("mode", Text("linear")), ("coordinate_transformation_mode", Text("half_pixel"))];
    let (zero, two) = (g.ints(&[1], &[0]), g.ints(&[1], &[2]));
    let shape = g.op("Shape", &[small], vec![]);
    let before = g.op("Slice", &[&shape, &zero, &two], vec![]); // Q, M
    let whole = g.op("Cast", &[size], vec![("to", Int(INT64 as i64))]);
    let sizes = g.op("Concat", &[&before, &whole], vec![("axis", Int(0))]);
    if d.efficient {
        return g.op("Resize", &[small, "", "", &sizes], linear());
    }
    let square = g.ints(&[2], &[1024, 1024]);
    let square = g.op("Concat", &[&before, &square], vec![("axis", Int(0))]);
    let wide = g.op("Resize", &[small, "", "", &square], linear());
    let (side, half) = (g.floats(&[1], &[1024.0]), g.floats(&[1], &[0.5]));
    let long = g.op("ReduceMax", &[size], vec![("keepdims", Int(1))]);
    let scale = g.op("Div", &[&side, &long], vec![]);
    let content = g.op("Mul", &[size, &scale], vec![]);
    let content = g.op("Add", &[&content, &half], vec![]);
    let content = g.op("Floor", &[&content], vec![]);
    let content = g.op("Cast", &[&content], vec![("to", Int(INT64 as i64))]);
    let (starts, axes) = (g.ints(&[2], &[0, 0]), g.ints(&[2], &[2, 3]));
    let cut = g.op("Slice", &[&wide, &starts, &content, &axes], vec![]);
    g.op("Resize", &[&cut, "", "", &sizes], linear())
}

/// Puts a pair into a folder.
pub fn write(folder: &Path, stem: &str, encoder: &[u8], decoder: &[u8]) {
    std::fs::create_dir_all(folder).expect("a folder");
    std::fs::write(folder.join(format!("{stem}_encoder.onnx")), encoder).expect("it is written");
    std::fs::write(folder.join(format!("{stem}_decoder.onnx")), decoder).expect("it is written");
}

/// MobileSAM's names, SAM's interface.
pub fn write_usual(folder: &Path) {
    write(folder, "mobile_sam", &encoder(Takes::Planes, ToyFault::None), &decoder(SAM));
}

/// Whether networks can be run here; if not, says so as the tests' summary counts it.
pub fn can_run(test: &str) -> bool {
    match segwild_vision::Runtime::find("") {
        Ok(_) => true,
        Err(error) => {
            eprintln!("skipped: {test}: {error}");
            false
        }
    }
}

/// The kinds that a packed encoder takes.
pub const PIXEL_KINDS: [u64; 2] = [FLOAT, UINT8];
