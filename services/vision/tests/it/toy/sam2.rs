//! Small networks with exactly the interfaces of SAM 2's exports, of SAM 3's tracker and of SAM by Transformers; and files with the
//! inputs and outputs of SAM 3's model of text and exemplars, and of a decoder for videos.
//!
//! The encoder answers each cell's mean colour and position, and the colours once more in its finer maps. The decoder selects by
//! colour at the position that it is given, and answers nothing at all where a finer map is not the encoder's.

use super::onnx::{Attribute::*, BOOL, FLOAT, FLOAT16, INT32, INT64, OPEN, OnnxGraph, UINT8};
use super::{LogitSources, SCORES, logits};

/// The interface of an export.
#[derive(Clone, Copy)]
pub struct ToyExport {
    /// The photo.
    pub photo: &'static str,
    /// The embedding, and the two finer maps if there are such.
    pub embedding: &'static str,
    pub finer: Option<[&'static str; 2]>,
    /// Whether encodings of positions are handed over.
    pub positions: bool,
    /// Points and labels.
    pub points: [&'static str; 2],
    /// Type of the labels.
    pub labels: u64,
    /// Whether boxes are an input of their own.
    pub boxes: bool,
    /// Logits of an earlier answer, and whether there are any.
    pub previous: Option<[&'static str; 2]>,
    /// The photo's size, its type, and that of the masks of this size.
    pub size: Option<(&'static str, u64, u64)>,
    /// Small masks, and scores.
    pub answers: [&'static str; 2],
    /// 3, or 4 with one for precise prompts before them, or 1.
    pub masks: i64,
    /// Cells along a side, and pixels along a side of a cell.
    pub grid: [i64; 2],
    /// Type of the numbers that go in and come out.
    pub numbers: u64,
    /// The encoder answers finer maps whose rows and columns are exchanged.
    pub turned: bool,
}

/// samexporter.
pub const SAMEXPORTER: ToyExport = ToyExport {
    photo: "image",
    embedding: "image_embed",
    finer: Some(["high_res_feats_0", "high_res_feats_1"]),
    positions: false,
    points: ["point_coords", "point_labels"],
    labels: FLOAT,
    boxes: false,
    previous: Some(["mask_input", "has_mask_input"]),
    size: None,
    answers: ["masks", "iou_predictions"],
    masks: 3,
    grid: [64, 16],
    numbers: FLOAT,
    turned: false,
};

/// sam-cpp-macos.
pub const SAM_CPP: ToyExport = ToyExport {
    photo: "input",
    embedding: "image_embeddings",
    finer: Some(["high_res_features1", "high_res_features2"]),
    size: Some(("orig_im_size", INT64, FLOAT)),
    answers: ["low_res_masks", "iou_predictions"],
    masks: 4,
    ..SAMEXPORTER
};

/// onnxruntime's tool for SAM 2.
pub const ORT_TOOL: ToyExport = ToyExport {
    embedding: "image_embeddings",
    finer: Some(["image_features_0", "image_features_1"]),
    labels: INT32,
    previous: Some(["input_masks", "has_input_masks"]),
    size: Some(("original_image_size", INT32, BOOL)),
    answers: ["low_res_masks", "iou_predictions"],
    ..SAMEXPORTER
};

/// SAM 2 by Hugging Face's Transformers.
pub const TRANSFORMERS: ToyExport = ToyExport {
    photo: "pixel_values",
    embedding: "image_embeddings.2",
    finer: Some(["image_embeddings.0", "image_embeddings.1"]),
    points: ["input_points", "input_labels"],
    labels: INT64,
    boxes: true,
    previous: None,
    answers: ["pred_masks", "iou_scores"],
    ..SAMEXPORTER
};

/// SAM 3's tracker by Transformers.
pub const TRACKER: ToyExport = ToyExport { grid: [72, 14], ..TRANSFORMERS };

/// SAM by Transformers, which takes no boxes.
pub const SAM_TRANSFORMERS: ToyExport =
    ToyExport { embedding: "image_embeddings", finer: None, positions: true, boxes: false, ..TRANSFORMERS };

const POSITIONS: &str = "image_positional_embeddings";

fn pool(g: &mut OnnxGraph, value: &str, side: i64) -> String {
    let pool = vec![("kernel_shape", Ints(vec![side, side])), ("strides", Ints(vec![side, side]))];
    g.op("AveragePool", &[value], pool)
}

fn cast(g: &mut OnnxGraph, value: &str, kind: u64) -> String {
    g.op("Cast", &[value], vec![("to", Int(kind as i64))])
}

/// Adds channels of zeros.
fn widen(g: &mut OnnxGraph, value: &str, channels: i64) -> String {
    let pads = g.ints(&[8], &[0, 0, 0, 0, 0, channels, 0, 0]);
    g.op("Pad", &[value, &pads], vec![])
}

/// An encoder's file.
pub fn encoder(e: &ToyExport) -> Vec<u8> {
    let mut g = OnnxGraph::default();
    let [n, pixels] = e.grid;
    g.input(e.photo, e.numbers, &[1, 3, n * pixels, n * pixels]);
    let planes = cast(&mut g, e.photo, FLOAT);
    let colours = pool(&mut g, &planes, pixels);
    let centre = |i: i64| (i as f32 + 0.5) / n as f32;
    let at: Vec<f32> = (0..n * n).map(|i| centre(i % n)).chain((0..n * n).map(|i| centre(i / n))).collect();
    let at = g.floats(&[1, 2, n, n], &at);
    let cells = g.op("Concat", &[&colours, &at], vec![("axis", Int(1))]);
    let cells = widen(&mut g, &cells, 251);
    let give = |g: &mut OnnxGraph, value: &str, name: &str, dims: &[i64]| {
        g.op_to("Cast", &[value], name, vec![("to", Int(e.numbers as i64))]);
        g.output(name, e.numbers, dims);
    };
    // samexporter's order: the embedding comes last.
    for (k, name) in e.finer.into_iter().flatten().enumerate() {
        let (times, channels) = ([4, 2][k], [32, 64][k]);
        let scales = g.floats(&[4], &[1.0, 1.0, times as f32, times as f32]);
        let mut map = g.op("Resize", &[&colours, "", &scales], vec![("mode", Text("nearest"))]);
        if e.turned {
            map = g.op("Transpose", &[&map], vec![("perm", Ints(vec![0, 1, 3, 2]))]);
        }
        let map = widen(&mut g, &map, channels - 3);
        give(&mut g, &map, name, &[1, channels, n * times, n * times]);
    }
    give(&mut g, &cells, e.embedding, &[1, 256, n, n]);
    if e.positions {
        let one = g.floats(&[1], &[1.0]);
        let more = g.op("Add", &[&cells, &one], vec![]);
        give(&mut g, &more, POSITIONS, &[1, 256, n, n]);
    }
    g.file()
}

/// A decoder's file.
pub fn decoder(e: &ToyExport) -> Vec<u8> {
    let mut g = OnnxGraph::default();
    let [n, _] = e.grid;
    let batched = e.points[0] == "input_points";
    g.input(e.embedding, e.numbers, &[1, 256, n, n]);
    for (k, name) in e.finer.into_iter().flatten().enumerate() {
        let (times, channels) = ([4, 2][k], [32, 64][k]);
        g.input(name, e.numbers, &[1, channels, n * times, n * times]);
    }
    if e.positions {
        g.input(POSITIONS, e.numbers, &[1, 256, n, n]);
    }
    let open: &[i64] = if batched { &[1, OPEN, OPEN] } else { &[OPEN, OPEN] };
    g.input(e.points[0], e.numbers, &[open, &[2]].concat());
    g.input(e.points[1], e.labels, open);
    if e.boxes {
        g.input("input_boxes", e.numbers, &[1, OPEN, 4]);
    }
    if let Some([mask, has]) = e.previous {
        g.input(mask, e.numbers, &[OPEN, 1, 4 * n, 4 * n]);
        g.input(has, e.numbers, &[OPEN]);
    }
    if let Some((name, kind, _)) = e.size {
        g.input(name, kind, &[2]);
    }
    let (at, label) = points(&mut g, e, batched);
    let (embedding, wrong) = embedding(&mut g, e);
    let previous = e.previous.map(|names| names.map(|name| cast(&mut g, name, FLOAT)));
    let previous = previous.as_ref().map(|[mask, has]| [mask.as_str(), has.as_str()]);
    let from = LogitSources { embedding: &embedding, previous, grid: e.grid, masks: e.masks };
    let all = logits(&mut g, &from, &at, &label);
    let all = g.op("Sub", &[&all, &wrong], vec![]);
    let scales = g.floats(&[4], &[1.0, 1.0, 4.0, 4.0]);
    let small = g.op("Resize", &[&all, "", &scales], vec![("mode", Text("linear"))]);
    let scores = scores(&mut g, e, &label);
    let zero = g.ints(&[1], &[0]);
    let give = |g: &mut OnnxGraph, value: &str, name: &str, dims: &[i64]| {
        let value = cast(g, value, e.numbers);
        match batched {
            true => g.op_to("Unsqueeze", &[&value, &zero], name, vec![]),
            false => g.op_to("Identity", &[&value], name, vec![]),
        }
        g.output(name, e.numbers, &if batched { [&[1], dims].concat() } else { dims.to_vec() });
    };
    if let Some((size, _, kind)) = e.size {
        full_size(&mut g, &small, size, kind, e.masks);
    }
    give(&mut g, &small, e.answers[0], &[OPEN, e.masks, 4 * n, 4 * n]);
    give(&mut g, &scores, e.answers[1], &[OPEN, e.masks]);
    if e.boxes {
        let object = g.op("ReduceMax", &[&scores], vec![("axes", Ints(vec![1])), ("keepdims", Int(1))]);
        give(&mut g, &object, "object_score_logits", &[OPEN, 1]);
    }
    g.file()
}

/// `[Q, N, 2]` positions and `[Q, N]` labels; the corners of a box are points of the labels 2 and 3.
fn points(g: &mut OnnxGraph, e: &ToyExport, batched: bool) -> (String, String) {
    let (mut at, mut label) = (cast(g, e.points[0], FLOAT), cast(g, e.points[1], FLOAT));
    if e.boxes {
        let boxes = cast(g, "input_boxes", FLOAT);
        let shape = g.ints(&[4], &[1, 1, -1, 2]);
        let corners = g.op("Reshape", &[&boxes, &shape], vec![]);
        // The labels of [1, M, 4]: the first two numbers times 0 and 2 more, the others 3 more.
        let (none, kinds) = (g.floats(&[1], &[0.0]), g.floats(&[2, 1], &[2.0, 3.0]));
        let shape = g.ints(&[4], &[1, -1, 2, 2]);
        let pairs = g.op("Reshape", &[&boxes, &shape], vec![]);
        let pairs = g.op("Mul", &[&pairs, &none], vec![]);
        let pairs = g.op("Add", &[&pairs, &kinds], vec![]);
        let first = g.ints(&[], &[0]);
        let pairs = g.op("Gather", &[&pairs, &first], vec![("axis", Int(3))]);
        let shape = g.ints(&[3], &[1, 1, -1]);
        let kinds = g.op("Reshape", &[&pairs, &shape], vec![]);
        at = g.op("Concat", &[&at, &corners], vec![("axis", Int(2))]);
        label = g.op("Concat", &[&label, &kinds], vec![("axis", Int(2))]);
    }
    if batched {
        let zero = g.ints(&[1], &[0]);
        (at, label) = (g.op("Squeeze", &[&at, &zero], vec![]), g.op("Squeeze", &[&label, &zero], vec![]));
    }
    (at, label)
}

/// The embedding with colours in SAM's range, and a number that is large where a further map is not the encoder's.
fn embedding(g: &mut OnnxGraph, e: &ToyExport) -> (String, String) {
    let cells = cast(g, e.embedding, FLOAT);
    let three = g.ints(&[3], &[0, 1, 2]);
    let colours = g.op("Gather", &[&cells, &three], vec![("axis", Int(1))]);
    let mut wrong = g.floats(&[1, 1, 1, 1], &[0.0]);
    let mut add = |g: &mut OnnxGraph, a: &str, b: &str| {
        let difference = g.op("Sub", &[a, b], vec![]);
        let difference = g.op("Abs", &[&difference], vec![]);
        let most = g.op("ReduceMax", &[&difference], vec![("keepdims", Int(1))]);
        let thousand = g.floats(&[1], &[1000.0]);
        let penalty = g.op("Mul", &[&most, &thousand], vec![]);
        wrong = g.op("Add", &[&wrong, &penalty], vec![]);
    };
    for (k, name) in e.finer.into_iter().flatten().enumerate() {
        let map = cast(g, name, FLOAT);
        let map = g.op("Gather", &[&map, &three], vec![("axis", Int(1))]);
        let coarse = pool(g, &map, [4, 2][k]);
        add(g, &coarse, &colours);
    }
    if e.positions {
        let (map, one) = (cast(g, POSITIONS, FLOAT), g.floats(&[1], &[1.0]));
        let less = g.op("Sub", &[&map, &one], vec![]);
        add(g, &less, &cells);
    }
    // Colours in [-1, 1] are nearer to each other than standardised ones.
    let factor = if e.grid[0] == 72 { 2.2 } else { 1.0 };
    let factors: Vec<f32> = (0..256).map(|c| if c < 3 { factor } else { 1.0 }).collect();
    let factors = g.floats(&[1, 256, 1, 1], &factors);
    (g.op("Mul", &[&cells, &factors], vec![]), wrong)
}

/// `[Q, M]`: the same scores for each query.
fn scores(g: &mut OnnxGraph, e: &ToyExport, label: &str) -> String {
    let scores: Vec<f32> = match e.masks {
        4 => [&[0.99], &SCORES[..]].concat(),
        1 => vec![0.91],
        _ => SCORES.to_vec(),
    };
    let scores = g.floats(&[1, e.masks], &scores);
    let (one, none) = (g.ints(&[1], &[1]), g.floats(&[1], &[0.0]));
    let nothing = g.op("ReduceSum", &[label, &one], vec![("keepdims", Int(1))]);
    let nothing = g.op("Mul", &[&nothing, &none], vec![]);
    g.op("Add", &[&scores, &nothing], vec![])
}

/// The masks at the photo's size: logits, or whether a pixel is inside.
fn full_size(g: &mut OnnxGraph, small: &str, size: &str, kind: u64, masks: i64) {
    let (zero, two) = (g.ints(&[1], &[0]), g.ints(&[1], &[2]));
    let shape = g.op("Shape", &[small], vec![]);
    let before = g.op("Slice", &[&shape, &zero, &two], vec![]);
    let whole = cast(g, size, INT64);
    let sizes = g.op("Concat", &[&before, &whole], vec![("axis", Int(0))]);
    let wide = g.op("Resize", &[small, "", "", &sizes], vec![("mode", Text("linear"))]);
    if kind == BOOL {
        let none = g.floats(&[1], &[0.0]);
        g.op_to("Greater", &[&wide, &none], "masks", vec![]);
    } else {
        g.op_to("Identity", &[&wide], "masks", vec![]);
    }
    g.output("masks", kind, &[OPEN, masks, OPEN, OPEN]);
}

/// A file with these inputs and outputs. Its numbers hang on an input, so that none is computed when it is loaded.
pub fn blank(inputs: &[(&str, u64, &[i64])], outputs: &[(&str, &[i64])]) -> Vec<u8> {
    let mut g = OnnxGraph::default();
    inputs.iter().for_each(|(name, kind, dims)| g.input(name, *kind, dims));
    let first = inputs.iter().find(|(_, _, dims)| !dims.is_empty()).expect("an input with a size").0;
    let numbers = cast(&mut g, first, FLOAT);
    let most = g.op("ReduceMax", &[&numbers], vec![("keepdims", Int(0))]);
    for (name, dims) in outputs {
        let sizes: Vec<i64> = dims.iter().map(|&n| n.max(1)).collect();
        let shape = g.ints(&[dims.len() as i64], &sizes);
        g.op_to("Expand", &[&most, &shape], name, vec![]);
        g.output(name, FLOAT, dims);
    }
    g.file()
}

/// The three files of SAM 3's model of text and exemplars, by samexporter: image encoder, text encoder and decoder.
pub fn concept() -> [(&'static str, Vec<u8>); 3] {
    const MAPS: [(&str, &[i64]); 6] = [
        ("vision_pos_enc_0", &[1, 256, 288, 288]),
        ("vision_pos_enc_1", &[1, 256, 144, 144]),
        ("vision_pos_enc_2", &[1, 256, 72, 72]),
        ("backbone_fpn_0", &[1, 256, 288, 288]),
        ("backbone_fpn_1", &[1, 256, 144, 144]),
        ("backbone_fpn_2", &[1, 256, 72, 72]),
    ];
    let mut takes: Vec<(&str, u64, &[i64])> =
        vec![("original_height", INT64, &[]), ("original_width", INT64, &[])];
    takes.extend(MAPS.map(|(name, dims)| (name, FLOAT, dims)));
    let prompts: [(&str, u64, &[i64]); 6] = [
        ("language_mask", BOOL, &[1, 32]),
        ("language_features", FLOAT, &[32, 1, 256]),
        ("language_embeds", FLOAT, &[32, 1, 1024]),
        ("box_coords", FLOAT, &[1, 1, 4]),
        ("box_labels", INT64, &[1, 1]),
        ("box_masks", BOOL, &[1, 1]),
    ];
    takes.extend(prompts);
    let text: [(&str, &[i64]); 3] =
        [("text_attention_mask", &[1, 32]), ("text_memory", &[32, 1, 256]), ("text_embeds", &[32, 1, 1024])];
    [
        ("sam3_image_encoder.onnx", blank(&[("image", UINT8, &[3, 1008, 1008])], &MAPS)),
        ("sam3_language_encoder.onnx", blank(&[("tokens", INT64, &[1, 32])], &text)),
        (
            "sam3_decoder.onnx",
            blank(&takes, &[("boxes", &[OPEN, 4]), ("scores", &[OPEN]), ("masks", &[OPEN, 1, OPEN, OPEN])]),
        ),
    ]
}

/// A decoder of SAM 2 for videos, which chooses one mask and answers no scores.
pub fn video_decoder() -> Vec<u8> {
    blank(
        &[
            ("point_coords", FLOAT, &[OPEN, OPEN, 2]),
            ("point_labels", FLOAT, &[OPEN, OPEN]),
            ("frame_size", INT64, &[2]),
            ("image_embed", FLOAT, &[1, 256, 64, 64]),
            ("high_res_feats_0", FLOAT, &[1, 32, 256, 256]),
            ("high_res_feats_1", FLOAT, &[1, 64, 128, 128]),
        ],
        &[("obj_ptr", &[1, 256]), ("mask_for_mem", &[1, 1, 1024, 1024]), ("pred_mask", &[1, 1, OPEN, OPEN])],
    )
}

/// An export whose numbers have 16 bits.
pub fn halved(e: ToyExport) -> ToyExport {
    ToyExport { numbers: FLOAT16, ..e }
}
