//! Names: which are allowed, files that cannot collide, and text from untrusted sources that is safe to show.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path};

/// Longest name, in bytes, that a person may give to something that becomes a file: endings and numbers are added to it,
/// and file systems take 255.
pub const LONGEST: usize = 100;
/// Longest part of a file's name that is made from another name.
const PART: usize = 180;
/// Names that Windows keeps for devices, whatever the ending.
const DEVICES: [&str; 6] = ["con", "prn", "aux", "nul", "com", "lpt"];

fn is_device(name: &str) -> bool {
    let stem = name.split('.').next().unwrap_or_default().trim_end().to_ascii_lowercase();
    let numbered = |s: &str| s.len() == 4 && s.is_char_boundary(3) && s.as_bytes()[3].is_ascii_digit();
    DEVICES[..4].contains(&stem.as_str()) || (numbered(&stem) && DEVICES[4..].contains(&&stem[..3]))
}

/// Whether a name that a person gave can be a file's name everywhere.
///
/// ```
/// use segwild_files::name::usable;
/// assert_eq!(usable("statue-2"), Ok(()));
/// for name in ["", "..", ".hidden", "a/b", "a\\b", "tab\t", "con.txt", "end.", &"n".repeat(101)] {
///     assert!(usable(name).is_err(), "{name}");
/// }
/// ```
///
/// # Errors
/// What is wrong with it, to be put after the name: `it begins with a dot`.
pub fn usable(name: &str) -> Result<(), &'static str> {
    let odd = |c: char| c.is_control() || is_unseen(c) || "/\\<>:\"|?*".contains(c);
    match name {
        "" => Err("it is empty"),
        _ if name.len() > LONGEST => Err("it is longer than 100 bytes"),
        _ if name.starts_with('.') => Err("it begins with a dot"),
        _ if name.ends_with(['.', ' ']) => Err("it ends in a dot or a blank"),
        _ if name.chars().any(odd) => Err("it has signs that a file's name must not have"),
        _ if is_device(name) => Err("Windows keeps it for a device"),
        _ => Ok(()),
    }
}

/// Whether text that came with a folder names a file in it and nothing else: one part, no `..`, no separator of any system.
pub fn is_plain(name: &str) -> bool {
    let mut parts = Path::new(name).components();
    matches!((parts.next(), parts.next()), (Some(Component::Normal(_)), None))
        && !name.contains(['/', '\\', '\0'])
}

/// Signs that change how text around them is shown, or are not shown: bidirectional overrides and their like.
fn is_unseen(c: char) -> bool {
    matches!(c,
        '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}' | '\u{061c}' | '\u{feff}'
        | '\u{fff9}'..='\u{fffb}' | '\u{e0000}'..='\u{e007f}')
}

/// Text from outside (names of photos, contents of a file) as it is safe to show in a terminal, a log or a page: control
/// characters and signs that reverse the direction of writing are escaped. Line ends stay: use [`one_line`] for a single line.
///
/// ```
/// use segwild_files::name::shown;
/// assert_eq!(shown("plain \u{e9}.jpg"), "plain \u{e9}.jpg");
/// assert_eq!(shown("\u{1b}[2Jx\u{202e}gpj"), "\\u{1b}[2Jx\\u{202e}gpj");
/// ```
pub fn shown(text: &str) -> Cow<'_, str> {
    written_out(text, |c| (c.is_control() && c != '\n' && c != '\t') || is_unseen(c))
}

/// As [`shown`], with line ends escaped as well.
pub fn one_line(text: &str) -> Cow<'_, str> {
    written_out(text, |c| c.is_control() || is_unseen(c))
}

fn written_out(text: &str, odd: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.chars().any(&odd) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        match odd(c) {
            true => out.extend(c.escape_default()),
            false => out.push(c),
        }
    }
    Cow::Owned(out)
}

/// One part of a path, as every file system takes it.
fn part(text: &str) -> String {
    let odd = |c: char| c.is_control() || is_unseen(c) || "<>:\"|?*".contains(c);
    let mut name: String = text.chars().map(|c| if odd(c) { '_' } else { c }).collect();
    if name.starts_with('.') {
        name.insert(0, '_');
    }
    if name.ends_with(['.', ' ']) || is_device(&name) {
        name.push('_');
    }
    let end = (0..=name.len().min(PART)).rev().find(|&i| name.is_char_boundary(i)).unwrap_or(0);
    name.truncate(end);
    name
}

/// FNV-1a, 32 bits: distinguishes names that nothing else distinguishes.
fn digest(text: &str) -> u32 {
    text.bytes().fold(0x811c_9dc5, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193))
}

/// A file for each photo, with another ending: folders stay folders (`a/b.jpg` -> `a/b.png`). No two are one file on any file
/// system, whether it distinguishes capitals or not, and none lies outside the folder that they are put in: a file that would
/// collide has the whole name of its photo (`b.jpg.png`), and a hash besides if that name is taken, too.
///
/// ```
/// use segwild_files::name::beside;
/// let names = beside(["a/b.jpg", "a_b.jpg", "c.jpg", "C.JPG", "../d.jpg"].into_iter(), "png");
/// assert_eq!(names, ["a/b.png", "a_b.png", "c.jpg.png", "C.JPG-61e570db.png", "_.._/d.png"]);
/// ```
pub fn beside<'a>(photos: impl Iterator<Item = &'a str> + Clone, ending: &str) -> Vec<String> {
    let called = |i: usize, photo: &str, way: usize| -> String {
        let parts: Vec<&str> = photo.split(['/', '\\']).filter(|p| !p.is_empty() && *p != ".").collect();
        let (last, folders) = parts.split_last().unwrap_or((&"photo", &[]));
        let stem = last.rsplit_once('.').map_or(*last, |(stem, _)| stem);
        let name = match way {
            0 if !stem.is_empty() => part(stem),
            0 | 1 => part(last),
            2 => format!("{}-{:08x}", part(last), digest(photo)),
            // Two photos of one name, or a chance in four billions.
            _ => format!("{}-{:08x}", part(last), digest(&format!("{photo} {i} {way}"))),
        };
        let folders: String = folders.iter().map(|f| part(f) + "/").collect();
        format!("{folders}{name}.{ending}")
    };
    let mut names: Vec<(usize, String)> =
        photos.clone().enumerate().map(|(i, photo)| (0, called(i, photo, 0))).collect();
    loop {
        let again = taken_twice(&names);
        if again.is_empty() {
            return names.into_iter().map(|(_, name)| name).collect();
        }
        for (i, photo) in photos.clone().enumerate().filter(|(i, _)| again.contains(i)) {
            let way = names[i].0 + 1;
            names[i] = (way, called(i, photo, way));
        }
    }
}

/// For each name, whether it is another's file or folder where capitals do not count.
fn taken_twice(names: &[(usize, String)]) -> BTreeSet<usize> {
    let folded: Vec<String> = names.iter().map(|(_, name)| name.to_lowercase()).collect();
    let mut owners: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    folded.iter().enumerate().for_each(|(i, name)| owners.entry(name).or_default().push(i));
    let mut again = BTreeSet::new();
    for (i, name) in folded.iter().enumerate() {
        let owners_of_folders = name.match_indices('/').filter_map(|(at, _)| owners.get(&name[..at]));
        again.extend(owners_of_folders.flatten());
        let same = &owners[name.as_str()];
        // By its stem neither is called; of those called by more the first keeps its name.
        if same.len() > 1 && (names[i].0 == 0 || same[0] != i) {
            again.insert(i);
        }
    }
    again
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folded(names: &[String]) -> BTreeSet<String> {
        names.iter().map(|n| n.to_lowercase()).collect()
    }

    #[test]
    fn photos_in_folders_do_not_overwrite_each_others_images() {
        let photos =
            ["a/b.jpg", "a_b.jpg", "a\\c.jpg", "b.jpg", "b.png", "B.JPG", "b.jpg.png", "b.jpg", "", ".jpg"];
        let names = beside(photos.into_iter(), "png");
        assert_eq!(folded(&names).len(), photos.len(), "{names:?}");
        assert_eq!(names[..3], ["a/b.png", "a_b.png", "a/c.png"]);
    }

    #[test]
    fn no_photo_has_its_image_outside_of_the_folder() {
        let long = format!("{}/{}.jpg", "f".repeat(300), "\u{e9}".repeat(300));
        let photos =
            ["../../etc/x.jpg", "/etc/x.jpg", "..\\..\\x.jpg", "C:\\x.jpg", "a/./../b.jpg", &long, "con.jpg"];
        for name in beside(photos.into_iter(), "png") {
            let normal = |part: Component| matches!(part, Component::Normal(name) if name.len() < 250);
            assert!(Path::new(&name).components().all(normal), "{name}");
            assert!(!name.contains(['\\', ':']) && !is_device(name.rsplit('/').next().unwrap()), "{name}");
        }
    }

    #[test]
    fn an_image_is_no_folder_of_another_one() {
        let names = beside(["a.jpg", "a.png/b.jpg", "A.png"].into_iter(), "png");
        assert_eq!(names[1], "a.png/b.png");
        assert!(!names.contains(&"a.png".to_owned()) && folded(&names).len() == 3, "{names:?}");
    }

    #[test]
    fn two_hundred_thousand_photos_are_named_at_once() {
        let photos: Vec<String> = (0..200_000).map(|i| format!("f{}/{}.jpg", i % 7, i / 2)).collect();
        let began = std::time::Instant::now();
        let names = beside(photos.iter().map(String::as_str), "png");
        assert_eq!(folded(&names).len(), photos.len());
        assert!(began.elapsed().as_secs() < 20, "{:?}", began.elapsed());
    }

    #[test]
    fn names_from_a_folder_that_lead_elsewhere_are_not_plain() {
        assert!(is_plain("geometry-0123-00000500.bin"));
        for name in ["", ".", "..", "../x", "a/b", "/etc/passwd", "a\\b", "a/", "nul\0"] {
            assert!(!is_plain(name), "{name}");
        }
    }
}
