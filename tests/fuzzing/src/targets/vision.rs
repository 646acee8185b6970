//! Calls to a vision service, and the files beside CLIP's encoders.

use crate::{FuzzTarget, seal};
use futures_util::stream;
use prost::Message;
use segwild_proto::v1::vision_client::VisionClient;
use segwild_proto::v1::{self, ImageHeader, ImagePart, PixelFormat, image_part::Part};
use segwild_vision::{
    ClipScaling, ClipTokenizer, Providers, VisionServer, VisionServiceOptions, VisionSettings, serve_vision,
};
use std::sync::OnceLock;
use std::time::Duration;
use tokio::runtime::Runtime;
use tonic::transport::Endpoint;

/// Longer than the built-in provider takes for an image as small as these.
const PATIENCE: Duration = Duration::from_secs(30);
/// Bytes of images that the service keeps.
const IMAGES: usize = 8 << 20;
/// Side of the image of good inputs.
const SIDE: u32 = 24;

struct Served {
    server: VisionServer,
    runtime: Runtime,
}

fn served() -> &'static Served {
    static SERVED: OnceLock<Served> = OnceLock::new();
    SERVED.get_or_init(|| {
        let start = || -> Result<Served, Box<dyn std::error::Error>> {
            let address = ([127, 0, 0, 1], 0).into();
            let options =
                VisionServiceOptions { address, token: None, memory: IMAGES, parallel: 1, tls: None };
            let providers = Providers::from_settings(&VisionSettings::default())?;
            let runtime =
                tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
            Ok(Served { server: serve_vision(providers, options)?, runtime })
        };
        start().unwrap_or_else(|e| panic!("{e}"))
    })
}

/// The image of good inputs in its parts: a square on a gradient.
fn image() -> (String, Vec<ImagePart>) {
    let inside = |x: u32, y: u32| (6..16).contains(&x) && (8..18).contains(&y);
    let pixel = |i: u32| {
        let (x, y) = (i % SIDE, i / SIDE);
        if inside(x, y) { [220, 60, 30] } else { [10 * y as u8, 40, 90] }
    };
    let numbers: Vec<u8> = (0..SIDE * SIDE).flat_map(pixel).collect();
    let format = PixelFormat::U8.into();
    let mut hasher = blake3::Hasher::new();
    for number in [SIDE, SIDE, 3, format as u32] {
        hasher.update(&number.to_le_bytes());
    }
    let hash = hasher.update(&numbers).finalize().to_hex().to_string();
    let header = ImageHeader { hash: hash.clone(), width: SIDE, height: SIDE, channels: 3, format };
    (
        hash,
        vec![
            ImagePart { part: Some(Part::Header(header)) },
            ImagePart { part: Some(Part::Numbers(numbers)) },
        ],
    )
}

fn call(kind: u8, message: &impl Message) -> Vec<u8> {
    [vec![kind], message.encode_to_vec()].concat()
}

fn seeds() -> Vec<Vec<u8>> {
    let (hash, parts) = image();
    let at = || Some(v1::Position { x: 10.5, y: 12.0 });
    let points = vec![v1::Position { x: 10.5, y: 12.0 }];
    let put = parts.iter().flat_map(Message::encode_length_delimited_to_vec);
    vec![
        std::iter::once(0).chain(put).collect(),
        call(1, &v1::EmbedRequest { image: hash.clone() }),
        call(2, &v1::ProposeMasksRequest { image: hash.clone(), points: points.clone() }),
        call(
            3,
            &v1::SegmentPromptsRequest {
                image: hash.clone(),
                points: vec![v1::PointPrompt { at: at(), positive: true }],
                boxes: vec![v1::BoxPrompt { corner: at(), opposite: Some(v1::Position { x: 2.0, y: 20.0 }) }],
                granularity: Some(0.5),
            },
        ),
        call(4, &v1::RefineMaskRequest { image: hash.clone(), certainty: hash.clone() }),
        call(5, &v1::FindSkyRequest { image: hash.clone(), points }),
        call(6, &v1::FindBoundariesRequest { image: hash }),
    ]
}

/// Sends what the bytes say, whatever the service answers.
async fn exchange(address: String, bytes: &[u8]) {
    let endpoint = Endpoint::from_shared(address).unwrap_or_else(|e| panic!("{e}"));
    let channel = endpoint.connect().await.unwrap_or_else(|e| panic!("it accepts no more: {e}"));
    let mut client = VisionClient::new(channel);
    let (&kind, message) = bytes.split_first().unwrap_or((&0, &[]));
    let (_, parts) = image();
    let _ = client.put_image(stream::iter(parts)).await;
    match kind {
        0 => {
            let mut rest = message;
            let parts = std::iter::from_fn(|| ImagePart::decode_length_delimited(&mut rest).ok());
            let parts: Vec<ImagePart> = parts.take(64).collect();
            let _ = client.put_image(stream::iter(parts)).await;
        }
        1 => {
            if let Ok(message) = v1::EmbedRequest::decode(message) {
                let _ = client.embed(message).await;
            }
        }
        2 => {
            if let Ok(message) = v1::ProposeMasksRequest::decode(message) {
                let _ = client.propose_masks(message).await;
            }
        }
        3 => {
            if let Ok(message) = v1::SegmentPromptsRequest::decode(message) {
                let _ = client.segment_prompts(message).await;
            }
        }
        4 => {
            if let Ok(message) = v1::RefineMaskRequest::decode(message) {
                let _ = client.refine_mask(message).await;
            }
        }
        5 => {
            if let Ok(message) = v1::FindSkyRequest::decode(message) {
                let _ = client.find_sky(message).await;
            }
        }
        _ => {
            if let Ok(message) = v1::FindBoundariesRequest::decode(message) {
                let _ = client.find_boundaries(message).await;
            }
        }
    }
    let alive = client.describe(v1::DescribeRequest {}).await;
    assert!(alive.is_ok(), "it answers nobody any more: {alive:?}");
}

pub(super) const CALL: FuzzTarget = FuzzTarget {
    name: "vision_call",
    seeds,
    words: &["\u{0}\u{0}\u{c0}\u{7f}", "\u{ff}\u{ff}\u{ff}\u{ff}\u{f}", "grpc", "../"],
    seal: seal::nothing,
    read: |bytes| {
        let Served { server, runtime } = served();
        let address = format!("http://{}", server.address());
        let done = runtime.block_on(async { tokio::time::timeout(PATIENCE, exchange(address, bytes)).await });
        assert!(done.is_ok(), "it neither answers nor refuses");
    },
};

/// Ends the first of two files in one input.
const FILE_END: u8 = 0;
/// Tokens of a text at most, as in CLIP.
const CONTEXT: usize = 77;

/// Inputs by their first byte: `tokenizer.json`, `vocab.json` with `merges.txt`, `preprocessor_config.json`.
fn clip_seeds() -> Vec<Vec<u8>> {
    let vocabulary =
        r#"{"d": 0, "o": 1, "m": 2, "e</w>": 3, "me</w>": 4, "<|startoftext|>": 5, "<|endoftext|>": 6}"#;
    let whole = format!(
        r#"{{"model": {{"type": "BPE", "vocab": {vocabulary}, "merges": ["m e</w>", ["o", "me</w>"]]}},
            "added_tokens": [{{"id": 7, "content": "ome</w>"}}]}}"#
    );
    let parts = [vocabulary.as_bytes(), &[FILE_END][..], &b"#version: 0.2\nm e</w>\n"[..]].concat();
    let scaling = br#"{"crop_size": {"height": 224, "width": 224}, "size": {"shortest_edge": 224},
        "image_mean": [0.48, 0.46, 0.41], "image_std": [0.27, 0.26, 0.28]}"#;
    let of = |kind: u8, file: &[u8]| [&[kind][..], file].concat();
    vec![of(0, whole.as_bytes()), of(1, &parts), of(2, scaling)]
}

pub(super) const CLIP: FuzzTarget = FuzzTarget {
    name: "clip_files",
    seeds: clip_seeds,
    words: &[
        "<|startoftext|>",
        "<|endoftext|>",
        "</w>",
        "WordPiece",
        "added_tokens",
        "longest_edge",
        "image_std",
        "4294967295",
        "1e999",
        "-1",
        "[[[[",
    ],
    seal: seal::nothing,
    read: |bytes| {
        let (&kind, file) = bytes.split_first().unwrap_or((&0, &[]));
        let tokenizer = match kind {
            0 => ClipTokenizer::of_json(file),
            1 => {
                let mut parts = file.splitn(2, |byte| *byte == FILE_END);
                let mut part = || parts.next().unwrap_or_default();
                ClipTokenizer::of_parts(part(), part())
            }
            _ => {
                if let Ok(scaling) = ClipScaling::of_json(file, None) {
                    assert!((16..=1024).contains(&scaling.side), "{scaling:?}");
                }
                return;
            }
        };
        if let Ok(tokens) =
            tokenizer.and_then(|tokenizer| tokenizer.tokens("the dome's 2 windows, 窓", CONTEXT))
        {
            assert!(tokens.len() <= CONTEXT, "{tokens:?}");
        }
    },
};
