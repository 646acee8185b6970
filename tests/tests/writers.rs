//! Who writes files, and who reads those of others: one crate, `services/files`, and nobody else.

use std::path::{Path, PathBuf};

/// What writes a file, or makes one.
const WRITERS: [&str; 9] = [
    "fs::write(",
    "File::create(",
    "File::create_new(",
    "File::options(",
    "OpenOptions",
    "fs::copy(",
    ".save(&",
    ".save_with_format(",
    "write_whole(",
];

/// Who may: the one writer, and what is no writing of contents.
const MAY: [(&str, &str); 3] = [
    ("services/files/src/write.rs", "the one writer"),
    ("services/files/src/read.rs", "opens for reading alone, with a flag that plain opening does not have"),
    ("services/flow/src/process.rs", "a lock is a file that stays open; it holds a process's number"),
];

/// The source files below a folder.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let (mut found, mut open) = (Vec::new(), vec![folder.to_owned()]);
    while let Some(next) = open.pop() {
        for entry in std::fs::read_dir(&next).expect("a folder").flatten() {
            let path = entry.path();
            match path.is_dir() {
                true => open.push(path),
                false if path.extension().is_some_and(|e| e == "rs") => found.push(path),
                false => {}
            }
        }
    }
    found.sort();
    found
}

/// The lines of a source that write files, outside of tests and comments.
fn writing_lines(text: &str) -> Vec<(usize, &str)> {
    // Unit tests are the last thing in a file.
    let end = text.find("#[cfg(test)]\nmod ").or_else(|| text.find("mod tests {")).unwrap_or(text.len());
    let code = text[..end].lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with("//"));
    // What is written to the kernel through /proc is no file, and the keeper of checkpoints writes by the one module.
    let code = code.filter(|(_, line)| !line.contains("(\"/proc/") && !line.contains("keeper().save("));
    code.filter(|(_, line)| WRITERS.iter().any(|writer| line.contains(writer)))
        .map(|(i, line)| (i + 1, line.trim()))
        .collect()
}

#[test]
fn files_are_written_by_one_module_only() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the tests crate lies in the workspace");
    let mut wrong = Vec::new();
    let mut seen = 0;
    for service in std::fs::read_dir(root.join("services")).expect("services").flatten() {
        // The package for Python is no crate.
        if !service.path().join("Cargo.toml").is_file() {
            continue;
        }
        for source in sources(&service.path().join("src")) {
            let name = source.strip_prefix(root).expect("inside").display().to_string().replace('\\', "/");
            seen += 1;
            if MAY.iter().any(|(may, _)| *may == name) {
                continue;
            }
            let text = std::fs::read_to_string(&source).expect("a source file");
            wrong.extend(
                writing_lines(&text).into_iter().map(|(line, code)| format!("{name}:{line}: {code}")),
            );
        }
    }
    assert!(seen > 100, "the sources are not where they are looked for");
    assert!(
        wrong.is_empty(),
        "use segwild_files (a full disk is simulated and reported there):\n{}",
        wrong.join("\n")
    );
}

/// Crates that read what somebody else may have made.
const READ_OTHERS: [&str; 5] = ["pipeline", "scene", "flow", "farm", "monitor"];

/// What reads a whole file and waits for a pipe in its place.
const READERS: [&str; 2] = ["fs::read(", "read_to_string("];

/// Which lines may, by their file and a part of them.
const MAY_READ: [(&str, &str, &str); 4] = [
    ("services/farm/src/manifest/mod.rs", "std::fs::read(file)", "a person may name a pipe"),
    ("services/farm/src/machine.rs", "read_to_string(file)", "the kernel's limits of the control group"),
    ("services/pipeline/src/settings/layers.rs", "std::fs::read(file)", "a person may name a pipe"),
    ("services/scene/src/export/mod.rs", "&beside", "the note beside an export, which this program writes"),
];

/// The lines of a source that read whole files, outside of tests and comments.
fn reading_lines(text: &str) -> Vec<(usize, &str)> {
    let end = text.find("#[cfg(test)]\nmod ").unwrap_or(text.len());
    let code = text[..end].lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with("//"));
    let code = code.filter(|(_, line)| !line.contains("(\"/proc/"));
    code.filter(|(_, line)| READERS.iter().any(|reader| line.contains(reader)))
        .map(|(i, line)| (i + 1, line.trim()))
        .collect()
}

#[test]
fn files_of_others_are_read_by_what_waits_for_no_pipe() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the tests crate lies in the workspace");
    let mut wrong = Vec::new();
    for service in READ_OTHERS {
        for source in sources(&root.join("services").join(service).join("src")) {
            let name = source.strip_prefix(root).expect("inside").display().to_string().replace('\\', "/");
            let text = std::fs::read_to_string(&source).expect("a source file");
            let may =
                |line: &str| MAY_READ.iter().any(|(file, part, _)| *file == name && line.contains(part));
            let lines = reading_lines(&text).into_iter().filter(|(_, line)| !may(line));
            wrong.extend(lines.map(|(line, code)| format!("{name}:{line}: {code}")));
        }
    }
    assert!(wrong.is_empty(), "use segwild_files::read_plain:\n{}", wrong.join("\n"));
}

#[test]
fn a_new_reader_is_seen() {
    let text = "/// fs::read(\nfn f() {\n std::fs::read(&path)\n}\n#[cfg(test)]\nmod tests {\n fs::read( }\n";
    assert_eq!(reading_lines(text), [(3, "std::fs::read(&path)")]);
}

#[test]
fn a_new_writer_is_seen() {
    let text = "use std::fs;\n/// fs::write(\nfn save() {\n    std::fs::write(\"a\", b\"x\")\n}\n#[cfg(test)]\nmod tests {\n fs::write( }\n";
    assert_eq!(writing_lines(text), [(4, "std::fs::write(\"a\", b\"x\")")]);
    assert_eq!(writing_lines("let f = File::create(path)?;").len(), 1);
}
