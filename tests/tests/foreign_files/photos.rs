//! Photos: formats, sizes, damage.

use crate::{Expect, Row};

pub const ROWS: &[Row] = &[Row {
    name: "photo cut short",
    make: |files| {
        let name = "images/photo03.png";
        let bytes = std::fs::read(files.path(name)).expect("the photo is there");
        files.write(name, &bytes[..20]);
    },
    settings: &[],
    expect: Expect::Reads { photos: 11, words: &["photo03.png"] },
}];
