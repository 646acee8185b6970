//! The page's files, part of the program. They are sent compressed to who can read that, as every browser can.

use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use flate2::Compression;
use flate2::write::GzEncoder;
use std::io::Write;
use std::sync::LazyLock;

/// A file of the page.
struct PageFile {
    name: &'static str,
    kind: &'static str,
    bytes: &'static [u8],
}

macro_rules! files {
    ($($name:literal: $kind:expr),* $(,)?) => {
        &[$(PageFile { name: $name, kind: $kind, bytes: include_bytes!(concat!("page/", $name)) }),*]
    };
}

const SCRIPT: &str = "text/javascript; charset=utf-8";

const FILES: &[PageFile] = files! {
    "index.html": "text/html; charset=utf-8",
    "style.css": "text/css; charset=utf-8",
    "icon.svg": "image/svg+xml",
    "main.js": SCRIPT,
    "api.js": SCRIPT,
    "budget.js": SCRIPT,
    "cursor.js": SCRIPT,
    "farm.js": SCRIPT,
    "geometry.js": SCRIPT,
    "objects.js": SCRIPT,
    "overlay.js": SCRIPT,
    "photos.js": SCRIPT,
    "scene.js": SCRIPT,
    "shortcuts.js": SCRIPT,
    "splats.js": SCRIPT,
    "status.js": SCRIPT,
    "strings.js": SCRIPT,
    "tables.js": SCRIPT,
    "tools.js": SCRIPT,
    "training.js": SCRIPT,
};

/// Each of [`FILES`] by gzip, made when the first page is opened.
static COMPRESSED: LazyLock<Vec<Vec<u8>>> = LazyLock::new(|| {
    let compress = |file: &PageFile| {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
        // A vector takes every byte.
        let _ = encoder.write_all(file.bytes);
        encoder.finish().unwrap_or_default()
    };
    FILES.iter().map(compress).collect()
});

/// Whether a request says that it reads gzip. A coding with the weight 0 is refused.
fn reads_gzip(request: &HeaderMap) -> bool {
    let codings =
        request.get(header::ACCEPT_ENCODING).and_then(|value| value.to_str().ok()).unwrap_or_default();
    codings.split(',').any(|coding| {
        let mut parts = coding.split(';').map(str::trim);
        let refused = |weight: &str| weight.strip_prefix("q=").is_some_and(|q| q.parse() == Ok(0.0f32));
        parts.next() == Some("gzip") && !parts.any(refused)
    })
}

/// A file of the page by its name, as its request can read it.
pub(crate) fn file(name: &str, request: &HeaderMap) -> Response {
    let Some(at) = FILES.iter().position(|file| file.name == name) else {
        return StatusCode::NOT_FOUND.into_response();
    };
    let kind = [(header::CONTENT_TYPE, FILES[at].kind), (header::VARY, "accept-encoding")];
    match reads_gzip(request) {
        true => (kind, [(header::CONTENT_ENCODING, "gzip")], COMPRESSED[at].as_slice()).into_response(),
        false => (kind, FILES[at].bytes).into_response(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes that the whole page may have as it is sent to a browser.
    const MOST: usize = 60_000;

    fn headers(accepted: &'static str) -> HeaderMap {
        HeaderMap::from_iter([(header::ACCEPT_ENCODING, axum::http::HeaderValue::from_static(accepted))])
    }

    #[test]
    fn browsers_get_gzip_and_others_the_plain_file() {
        for accepted in ["gzip", "gzip, deflate, br", "br;q=1.0, gzip;q=0.8", "deflate,gzip"] {
            assert!(reads_gzip(&headers(accepted)), "{accepted}");
            let sent = file("main.js", &headers(accepted));
            assert_eq!(sent.headers()[header::CONTENT_ENCODING], "gzip");
        }
        for accepted in ["", "identity", "br", "gzip;q=0", "gzip; q=0.0, br", "gzipped"] {
            assert!(!reads_gzip(&headers(accepted)), "{accepted}");
            assert!(!file("main.js", &headers(accepted)).headers().contains_key(header::CONTENT_ENCODING));
        }
        assert!(!reads_gzip(&HeaderMap::new()));
        assert_eq!(file("../lib.rs", &headers("gzip")).status(), StatusCode::NOT_FOUND);
    }

    #[test]
    fn compressed_files_hold_the_same_bytes() {
        use std::io::Read;
        for (file, compressed) in FILES.iter().zip(COMPRESSED.iter()) {
            let mut unpacked = Vec::new();
            flate2::read::GzDecoder::new(&compressed[..]).read_to_end(&mut unpacked).expect("gzip");
            assert_eq!(unpacked, file.bytes, "{}", file.name);
        }
    }

    #[test]
    fn the_page_is_small_and_fetches_nothing_from_elsewhere() {
        let all: usize = COMPRESSED.iter().map(Vec::len).sum();
        assert!(all < MOST, "{all} bytes");
        for file in FILES {
            let text = std::str::from_utf8(file.bytes).expect("text");
            // The name of SVG's language is no address.
            let text = text.replace("http://www.w3.org/2000/svg", "");
            assert!(!text.contains("http:") && !text.contains("https:"), "{}", file.name);
        }
    }
}
