//! The field's words: none of the left side of `tests/words.toml` comes back, and no type name stands for two things.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// The files that the list is about, by their endings.
const KINDS: [&str; 20] = [
    "cff", "css", "csv", "html", "ipynb", "js", "json", "md", "mjs", "proto", "py", "rs", "sbatch",
    "service", "svg", "toml", "txt", "wgsl", "yaml", "yml",
];

/// Folders whose files count whatever their endings are.
const SCRIPTS: [&str; 2] = [".ci", "deploy"];

/// Where a word is refused.
#[derive(PartialEq)]
enum Scope {
    /// Everywhere.
    Text,
    /// In sources, comments and strings included.
    Code,
    /// In identifiers of sources.
    Names,
}

/// An entry of the list.
struct Entry {
    phrases: Vec<String>,
    instead: String,
    scope: Scope,
    under: String,
}

/// The list.
struct List {
    entries: Vec<Entry>,
    /// Phrases that are right, and the folder below which they are.
    allowed: Vec<(String, String)>,
    /// Files that are not read.
    skipped: Vec<String>,
    /// Documents of which only the prose is read.
    prose: Vec<String>,
}

/// Where a language's comments and strings start and end.
struct Syntax {
    /// What starts a comment that ends with its line.
    comment: &'static str,
    /// Starts and ends of other comments and of strings, the longer ones first.
    quotes: &'static [(&'static str, &'static str)],
    /// Whether strings may be raw or go over lines, and `'` may start a lifetime.
    rust: bool,
}

impl Syntax {
    /// The syntax of a source; `None` of other files.
    fn of(file: &str) -> Option<Syntax> {
        match file.rsplit_once('.')?.1 {
            "rs" | "wgsl" => Some(Syntax { comment: "//", quotes: &[("\"", "\"")], rust: true }),
            "js" | "mjs" | "proto" => Some(Syntax {
                comment: "//",
                quotes: &[("/*", "*/"), ("\"", "\""), ("'", "'"), ("`", "`")],
                rust: false,
            }),
            "py" => Some(Syntax {
                comment: "#",
                quotes: &[("\"\"\"", "\"\"\""), ("'''", "'''"), ("\"", "\""), ("'", "'")],
                rust: false,
            }),
            _ => None,
        }
    }
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the tests crate lies in the workspace")
}

fn read_list() -> List {
    let text = std::fs::read_to_string(root().join("tests/words.toml")).expect("the list");
    let table: toml::Table = text.parse().expect("a TOML file");
    let rows = |name: &str| table[name].as_array().expect("a list").clone();
    let word =
        |row: &toml::Value, name: &str| row.get(name).and_then(|v| v.as_str()).unwrap_or("").to_owned();
    let entries = rows("word").into_iter().map(|row| Entry {
        phrases: row["not"]
            .as_array()
            .expect("a list")
            .iter()
            .map(|p| words(p.as_str().expect("text")))
            .collect(),
        instead: word(&row, "use"),
        scope: match word(&row, "in").as_str() {
            "text" => Scope::Text,
            "code" => Scope::Code,
            "names" => Scope::Names,
            other => panic!("`in = {other}` is none of text, code, names"),
        },
        under: word(&row, "under"),
    });
    for row in rows("allow").iter().chain(&rows("skip")) {
        assert!(word(row, "why").len() > 10, "an exception needs a reason: {row}");
    }
    for row in rows("skip") {
        assert!(["", "code"].contains(&&*word(&row, "part")), "`part` is `code` or not there: {row}");
    }
    let skipped = |part: &str| {
        let rows = rows("skip").into_iter().filter(|row| word(row, "part") == part);
        rows.map(|row| word(&row, "path")).collect()
    };
    List {
        entries: entries.collect(),
        allowed: rows("allow").iter().map(|row| (words(&word(row, "phrase")), word(row, "under"))).collect(),
        skipped: skipped(""),
        prose: skipped("code"),
    }
}

/// A text as lower-case words with one space before, between and after them; names are split at `_` and at capitals.
fn words(text: &str) -> String {
    let mut out = String::from(" ");
    let letters: Vec<char> = text.chars().collect();
    for (i, &c) in letters.iter().enumerate() {
        let before = i.checked_sub(1).map(|i| letters[i]);
        let after_small = before.is_some_and(|b| b.is_ascii_lowercase() || b.is_ascii_digit());
        let ends_capitals = before.is_some_and(|b| b.is_ascii_uppercase())
            && letters.get(i + 1).is_some_and(char::is_ascii_lowercase);
        if c.is_ascii_uppercase() && (after_small || ends_capitals) && !out.ends_with(' ') {
            out.push(' ');
        }
        match c {
            c if c.is_ascii_alphanumeric() => out.push(c.to_ascii_lowercase()),
            _ if !out.ends_with(' ') => out.push(' '),
            _ => {}
        }
    }
    if !out.ends_with(' ') {
        out.push(' ');
    }
    out
}

/// A document without its code, line by line as before.
fn prose(text: &str) -> String {
    let mut fenced = false;
    let line_of = |line: &str| {
        let fence = line.trim_start().starts_with("```");
        fenced ^= fence;
        // Code spans are the odd parts between back quotes.
        let spans = line.split('`').step_by(2);
        if fence || fenced { String::new() } else { spans.collect::<Vec<_>>().join(" ") }
    };
    text.lines().map(line_of).collect::<Vec<_>>().join("\n")
}

/// Where a string or comment ends whose inside starts at `from`: behind `end`, or with its line where it is `short`.
fn end_of(text: &str, from: usize, end: &str, short: bool) -> usize {
    let bytes = text.as_bytes();
    let mut i = from;
    while i < bytes.len() && !bytes[i..].starts_with(end.as_bytes()) {
        if short && bytes[i] == b'\n' {
            return i;
        }
        i += if bytes[i] == b'\\' { 2 } else { 1 };
    }
    (i + end.len()).min(bytes.len())
}

/// The identifiers of a source by line, without comments and strings.
fn names<'a>(text: &'a str, syntax: &Syntax) -> Vec<Vec<&'a str>> {
    let mut found = vec![Vec::new(); text.lines().count() + 1];
    let (bytes, mut i, mut line) = (text.as_bytes(), 0, 0);
    let starts = |i: usize, what: &str| text.get(i..).is_some_and(|rest| rest.starts_with(what));
    let count = |from: usize, to: usize| bytes[from..to].iter().filter(|&&b| b == b'\n').count();
    while i < bytes.len() {
        let from = i;
        let quote = syntax.quotes.iter().find(|(start, _)| starts(i, start));
        if starts(i, syntax.comment) {
            i = text[i..].find('\n').map_or(bytes.len(), |n| i + n);
        } else if syntax.rust && bytes[i] == b'r' && (starts(i, "r\"") || starts(i, "r#\"")) {
            let hashes = bytes[i + 1..].iter().take_while(|&&b| b == b'#').count();
            let end = format!("\"{}", "#".repeat(hashes));
            let inside = i + 2 + hashes;
            i = text[inside..].find(&end).map_or(bytes.len(), |n| inside + n + end.len());
        } else if let Some((start, end)) = quote {
            // A quote that closes nothing, as in a pattern of JavaScript, hides no more than its line.
            let short = !syntax.rust && ["\"", "'"].contains(end);
            i = end_of(text, i + start.len(), end, short);
        } else if syntax.rust && bytes[i] == b'\'' {
            // A character, or a lifetime: that has no second quote right behind.
            let quoted = text[i + 1..].char_indices().nth(1).is_some_and(|(n, c)| c == '\'' && n > 0);
            let escaped = starts(i, "'\\");
            i += match text[i + 1..].find('\'') {
                Some(n) if escaped && n <= 10 => (if starts(i, "'\\''") { 4 } else { n + 2 }).max(3),
                Some(n) if quoted => n + 2,
                _ => 1,
            };
        } else if bytes[i].is_ascii_alphabetic() || bytes[i] == b'_' {
            while i < bytes.len() && (bytes[i].is_ascii_alphanumeric() || bytes[i] == b'_') {
                i += 1;
            }
            found[line].push(&text[from..i]);
        } else {
            i += 1;
        }
        while !text.is_char_boundary(i.min(text.len())) {
            i += 1;
        }
        line += count(from, i.min(bytes.len()));
    }
    found
}

/// The files of the repository, by their names from its root: no build results, no folders with a dot but `.ci`.
fn files() -> Vec<String> {
    let (mut found, mut open) = (Vec::new(), vec![PathBuf::new()]);
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(root().join(&folder)).expect("a folder").flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            let path = folder.join(&name);
            let dotted = name.starts_with('.') && name != ".ci";
            if entry.path().is_dir() {
                let built = ["target", "runs", "node_modules"].contains(&name.as_str());
                if !dotted && !built {
                    open.push(path);
                }
                continue;
            }
            let text = path.extension().is_some_and(|e| KINDS.contains(&e.to_string_lossy().as_ref()));
            if text || SCRIPTS.iter().any(|folder| path.starts_with(folder)) {
                found.push(path.to_string_lossy().replace('\\', "/"));
            }
        }
    }
    found.sort();
    found
}

/// Every word of the list in a file: line, phrase, what to use instead.
fn refused(list: &List, file: &str, text: &str) -> Vec<String> {
    let syntax = Syntax::of(file);
    let named = syntax.as_ref().map_or(Vec::new(), |syntax| names(text, syntax));
    let mut wrong = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let without_allowed = |mut text: String| {
            for (phrase, under) in &list.allowed {
                if file.starts_with(under) {
                    text = text.replace(phrase, " ");
                }
            }
            text
        };
        let whole = without_allowed(words(line));
        let ids: Vec<String> =
            named.get(i).map_or(Vec::new(), |ids| ids.iter().map(|id| words(id)).collect());
        let ids: Vec<String> = ids.into_iter().map(without_allowed).collect();
        for entry in list.entries.iter().filter(|entry| file.starts_with(&entry.under)) {
            if entry.scope != Scope::Text && syntax.is_none() {
                continue;
            }
            let has = |phrase: &&String| match entry.scope {
                Scope::Names => ids.iter().any(|id| id.contains(*phrase)),
                Scope::Text | Scope::Code => whole.contains(*phrase),
            };
            for phrase in entry.phrases.iter().filter(has) {
                wrong.push(format!("{file}:{}: `{}`: use {}", i + 1, phrase.trim(), entry.instead));
            }
        }
    }
    wrong
}

/// The files that are read, with what of their text is.
fn texts(list: &List) -> Vec<(String, String)> {
    let is_of = |file: &str, paths: &[String]| paths.iter().any(|path| file.starts_with(path));
    let read = |file: String| {
        let text = std::fs::read_to_string(root().join(&file)).ok()?;
        let text = if is_of(&file, &list.prose) { prose(&text) } else { text };
        Some((file, text))
    };
    files().into_iter().filter(|file| !is_of(file, &list.skipped)).filter_map(read).collect()
}

#[test]
fn no_word_of_the_old_language_comes_back() {
    let list = read_list();
    let texts = texts(&list);
    assert!(texts.len() > 500, "files are read: {}", texts.len());
    let wrong: Vec<String> = texts.iter().flat_map(|(file, text)| refused(&list, file, text)).collect();
    assert!(wrong.is_empty(), "{} words of tests/words.toml:\n{}", wrong.len(), wrong.join("\n"));
}

#[test]
fn no_word_is_allowed_that_nothing_needs() {
    let mut list = read_list();
    let texts: Vec<(String, String, String)> =
        texts(&list).into_iter().map(|(file, text)| (file, words(&text), text)).collect();
    let mut idle = Vec::new();
    for i in 0..list.allowed.len() {
        let (phrase, under) = list.allowed.remove(i);
        let needed = texts.iter().any(|(file, words, text)| {
            file.starts_with(&under) && words.contains(&phrase) && !refused(&list, file, text).is_empty()
        });
        if !needed {
            idle.push(format!("`{}` under `{under}`", phrase.trim()));
        }
        list.allowed.insert(i, (phrase, under));
    }
    assert!(idle.is_empty(), "take these off the list of tests/words.toml: {idle:?}");
}

#[test]
fn a_word_is_found_in_names_comments_and_strings_and_not_where_it_is_allowed() {
    let list = read_list();
    let of = |text: &str| refused(&list, "services/raster/src/a.rs", text).len();
    assert_eq!(of("let strangers = 3;"), 1);
    assert_eq!(of("struct StrangerMask; // a stranger"), 1, "a phrase counts once a line");
    assert_eq!(of("let x = \"a stranger's\";"), 1);
    assert_eq!(of("let pose = Pose::look_at(eye, target, up);"), 0);
    assert_eq!(of("let look = 1;"), 1);
    assert_eq!(of("// it looks at the photo"), 0, "a verb of a sentence is no name");
    assert_eq!(of("let estranged = 1;"), 0, "a part of a word is no word");
    let of = |file: &str, text: &str| refused(&list, file, text).len();
    for file in ["a.js", "a.proto"] {
        assert_eq!(of(file, "look = 1; // a rung\n"), 2, "{file}");
        assert_eq!(of(file, "x = \"look\" /* look\n look */ + 'look' + `\n look`;\n"), 0, "{file}");
    }
    assert_eq!(
        of("a.js", "x.replace(/\"/, y); // it's\nlook();"),
        1,
        "a quote of a pattern ends with its line"
    );
    assert_eq!(of("a.py", "x = '''it's\n look'''  # a look's\nlook = 'look'\n"), 2);
    assert_eq!(of("a.md", "look = `look`"), 0, "a document has no names");
    assert_eq!(prose("a `--b` c\n```\nd\n```\ne"), "a   c\n\n\n\ne");
    assert_eq!(words("AppearanceMaps of GPUs, set_by"), " appearance maps of gp us set by ");
}

#[test]
fn no_type_name_stands_for_two_things() {
    let mut owners: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for file in files().iter().filter(|file| file.starts_with("services/") && file.contains("/src/")) {
        let text = std::fs::read_to_string(root().join(file)).expect("a source");
        for line in text.lines() {
            let line = line.trim_start();
            let line = line.strip_prefix("pub ").unwrap_or(line);
            let line =
                line.split_once(") ").filter(|_| line.starts_with("pub(")).map_or(line, |(_, rest)| rest);
            let item = ["struct ", "enum ", "trait "].iter().find_map(|kind| line.strip_prefix(kind));
            let name = item.and_then(|rest| rest.split(|c: char| !c.is_alphanumeric()).next());
            // A macro's `$name` is no name.
            if let Some(name) = name.filter(|name| !name.is_empty()) {
                owners.entry(name.to_owned()).or_default().insert(file.clone());
            }
        }
    }
    assert!(owners.len() > 400, "types are found: {}", owners.len());
    let text = std::fs::read_to_string(root().join("tests/words.toml")).expect("the list");
    let table: toml::Table = text.parse().expect("a TOML file");
    let shared: Vec<&str> =
        table["types"]["shared"].as_array().expect("a list").iter().filter_map(|t| t.as_str()).collect();
    let twice: Vec<String> = owners
        .iter()
        .filter(|(name, files)| files.len() > 1 && !shared.contains(&name.as_str()))
        .map(|(name, files)| format!("{name}: {files:?}"))
        .collect();
    assert!(twice.is_empty(), "types of one name, {} in all:\n{}", twice.len(), twice.join("\n"));
    let once: Vec<&&str> =
        shared.iter().filter(|name| owners.get(**name).is_none_or(|files| files.len() < 2)).collect();
    assert!(once.is_empty(), "these are shared no longer, take them off the list: {once:?}");
}
