//! A small model with exactly the interface of CLIP's exports: the image encoder answers the mean colour, the text encoder the sum of
//! its tokens' colours. A tokenizer knows some words; of others it has the letters, which have no colour.

use super::onnx::{Attribute::*, FLOAT, INT32, INT64, OPEN, OnnxGraph};
use std::path::Path;

/// Numbers of an embedding: a colour around grey, and a share of what has none.
const DIMS: i64 = 4;
/// Mean and standard deviation of CLIP's images.
const MEAN: [f32; 3] = [0.481_454_66, 0.457_827_5, 0.408_210_73];
const DEVIATION: [f32; 3] = [0.268_629_54, 0.261_302_6, 0.275_777_1];

const NOTHING: [f32; 4] = [0.0; 4];
const GREY: [f32; 4] = [0.0, 0.0, 0.0, 1.0];

/// Words with their embeddings.
const WORDS: [(&str, [f32; 4]); 9] = [
    ("photo", NOTHING),
    ("of", NOTHING),
    ("red", [1.0, -0.5, -0.5, 0.0]),
    ("green", [-0.5, 1.0, -0.5, 0.0]),
    ("blue", [-0.5, -0.5, 1.0, 0.0]),
    ("object", GREY),
    ("things", GREY),
    ("texture", GREY),
    ("background", GREY),
];

/// What a text encoder takes.
#[derive(Clone, Copy)]
pub struct TextTakes {
    pub kind: u64,
    /// Tokens of a text.
    pub length: i64,
    /// Whether it is given which tokens count.
    pub attention: bool,
}

/// As Hugging Face's exports.
pub const USUAL_TEXT: TextTakes = TextTakes { kind: INT64, length: OPEN, attention: false };
/// Everything else that is served.
pub const FIXED_TEXT: TextTakes = TextTakes { kind: INT32, length: 16, attention: true };

/// Tokens with their embeddings, by their numbers.
fn tokens() -> Vec<(String, [f32; 4])> {
    let letters = || ('a'..='z').map(String::from);
    let alone = letters().map(|letter| (letter, NOTHING));
    let at_end = letters().map(|letter| (letter + "</w>", NOTHING));
    let words = WORDS.iter().map(|(word, colour)| (format!("{word}</w>"), *colour));
    let special = ["<|startoftext|>", "<|endoftext|>"].map(|token| (token.to_owned(), NOTHING));
    alone.chain(at_end).chain(words).chain(special).collect()
}

/// Merges that put each word together from its end, so that none matches inside of another word.
fn merges() -> Vec<String> {
    let mut found = Vec::new();
    for (word, _) in WORDS {
        for at in (1..word.len()).rev() {
            let merge = format!("{} {}</w>", &word[at - 1..at], &word[at..]);
            if !found.contains(&merge) {
                found.push(merge);
            }
        }
    }
    found
}

fn vocabulary() -> String {
    let all: Vec<String> =
        tokens().iter().enumerate().map(|(i, (token, _))| format!("\"{token}\": {i}")).collect();
    format!("{{{}}}", all.join(", "))
}

/// `tokenizer.json`.
pub fn tokenizer() -> String {
    let merges: Vec<String> = merges().iter().map(|merge| format!("\"{merge}\"")).collect();
    let model =
        format!("\"type\": \"BPE\", \"vocab\": {}, \"merges\": [{}]", vocabulary(), merges.join(", "));
    format!("{{\"version\": \"1.0\", \"added_tokens\": [], \"model\": {{{model}}}}}")
}

/// `vocab.json` and `merges.txt`.
pub fn tokenizer_parts() -> [String; 2] {
    [vocabulary(), format!("#version: 0.2\n{}\n", merges().join("\n"))]
}

fn add_images(g: &mut OnnxGraph, side: i64) {
    g.input("pixel_values", FLOAT, &[OPEN, 3, side, side]);
    let mean = g.op("GlobalAveragePool", &["pixel_values"], vec![]);
    let deviation = g.floats(&[1, 3, 1, 1], &DEVIATION);
    let middle = g.floats(&[1, 3, 1, 1], &MEAN.map(|mean| mean - 0.5));
    let colour = g.op("Mul", &[&mean, &deviation], vec![]);
    let colour = g.op("Add", &[&colour, &middle], vec![]);
    let colour = g.op("Flatten", &[&colour], vec![("axis", Int(1))]);
    let wide: Vec<f32> = (0..3 * DIMS).map(|i| f32::from(u8::from(i % DIMS == i / DIMS))).collect();
    let (wide, rest) = (g.floats(&[3, DIMS], &wide), g.floats(&[DIMS], &[0.0, 0.0, 0.0, 0.1]));
    let wide = g.op("MatMul", &[&colour, &wide], vec![]);
    g.op_to("Add", &[&wide, &rest], "image_embeds", vec![]);
    g.output("image_embeds", FLOAT, &[OPEN, DIMS]);
}

fn add_texts(g: &mut OnnxGraph, takes: TextTakes) {
    g.input("input_ids", takes.kind, &[OPEN, takes.length]);
    let all = tokens();
    let table: Vec<f32> = all.iter().flat_map(|(_, colour)| *colour).collect();
    let table = g.floats(&[all.len() as i64, DIMS], &table);
    let mut found = g.op("Gather", &[&table, "input_ids"], vec![("axis", Int(0))]);
    if takes.attention {
        g.input("attention_mask", takes.kind, &[OPEN, takes.length]);
        let counted = g.op("Cast", &["attention_mask"], vec![("to", Int(FLOAT as i64))]);
        let two = g.ints(&[1], &[2]);
        let counted = g.op("Unsqueeze", &[&counted, &two], vec![]);
        found = g.op("Mul", &[&found, &counted], vec![]);
    }
    let one = g.ints(&[1], &[1]);
    g.op_to("ReduceSum", &[&found, &one], "text_embeds", vec![("keepdims", Int(0))]);
    g.output("text_embeds", FLOAT, &[OPEN, DIMS]);
}

/// An image encoder's file.
pub fn image_encoder(side: i64) -> Vec<u8> {
    let mut g = OnnxGraph::default();
    add_images(&mut g, side);
    g.file()
}

/// A text encoder's file.
pub fn text_encoder(takes: TextTakes) -> Vec<u8> {
    let mut g = OnnxGraph::default();
    add_texts(&mut g, takes);
    g.file()
}

/// A file with both.
pub fn both_encoders() -> Vec<u8> {
    let mut g = OnnxGraph::default();
    add_texts(&mut g, USUAL_TEXT);
    add_images(&mut g, OPEN);
    g.file()
}

/// Puts a model into a folder, under the names of Hugging Face's exports.
pub fn write_usual(folder: &Path) {
    std::fs::create_dir_all(folder).expect("a folder");
    let put = |name: &str, bytes: &[u8]| std::fs::write(folder.join(name), bytes).expect("it is written");
    put("vision_model.onnx", &image_encoder(OPEN));
    put("text_model.onnx", &text_encoder(USUAL_TEXT));
    put("tokenizer.json", tokenizer().as_bytes());
}
