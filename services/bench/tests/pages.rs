//! README and the pages under `docs/`: a figure says who made its masks, and none of the oracle's passes for a user's.

use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn read(file: &Path) -> String {
    std::fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()))
}

/// Every page under a folder.
fn pages(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap().flatten() {
        let path = entry.path();
        if path.is_dir() {
            found.extend(pages(&path));
        } else if path.extension().is_some_and(|e| e == "md") {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// The title, and the first sentence below it.
fn head(text: &str) -> (String, String) {
    let mut lines = text.lines().filter(|l| !l.trim().is_empty());
    let title = lines.next().unwrap_or("").to_lowercase();
    let below: Vec<&str> =
        text.lines().skip(1).skip_while(|l| l.trim().is_empty()).take_while(|l| !l.is_empty()).collect();
    let below = below.join(" ");
    (title, below.split(". ").next().unwrap_or("").to_lowercase())
}

/// The cells of a table's row.
fn cells(line: &str) -> Vec<&str> {
    line.trim().trim_matches('|').split('|').map(str::trim).collect()
}

#[test]
fn readmes_figures_name_their_provider_and_none_is_the_oracles() {
    let text = read(&root().join("README.md"));
    let (_, section) = text.split_once("## What it measures").expect("the section of figures");
    let table: Vec<&str> = section.lines().filter(|l| l.starts_with('|')).collect();
    let column = cells(table[0]).iter().position(|c| *c == "provider").expect("a column `provider`");
    assert!(table.len() > 3, "rows with figures");
    for row in &table[2..] {
        let provider = cells(row)[column];
        assert!(!provider.is_empty() && provider != "oracle", "{row}");
    }
    // It neither shows nor cites figures of the oracle without the word.
    for line in text.lines().filter(|l| l.contains("oracle")) {
        assert!(!line.contains(".9") && !line.contains("IoU"), "{line}");
    }
}

#[test]
fn a_page_with_the_oracles_figures_has_the_word_in_its_title_and_first_sentence() {
    let mut seen = 0;
    for page in pages(&root().join("docs")) {
        let text = read(&page);
        let stamped = text.contains("Provider: oracle") || text.contains(", oracle. Command:");
        let named = text.contains("| oracle |") || text.contains("--providers oracle");
        if stamped || named {
            seen += 1;
            let (title, first) = head(&text);
            assert!(title.contains("oracle"), "{}: its title is {title}", page.display());
            assert!(first.contains("oracle"), "{}: it starts with {first}", page.display());
        }
    }
    assert!(seen >= 4, "pages of the oracle are there: {seen}");
}

#[test]
fn a_generated_page_names_provider_command_commit_and_machine() {
    for page in pages(&root().join("docs")) {
        // Pages of reference are generated from definitions, and have no figures.
        if page.parent().is_some_and(|p| p.ends_with("reference")) {
            continue;
        }
        let text = read(&page);
        if text.contains("This page is generated") {
            for word in ["Provider: ", "Command: `segwild bench", "Commit: ", "Machine: "] {
                assert!(text.contains(word), "{}: {word}", page.display());
            }
            // "unknown" is what a program says that was built outside of the repository: nobody can measure that again.
            for made in text.split("Commit: ").skip(1) {
                let named = made.split("Machine: ").next().unwrap_or_default();
                let is_hash = |word: &str| word.len() >= 7 && word.bytes().all(|b| b.is_ascii_hexdigit());
                let hash = named.split(|c: char| !c.is_ascii_alphanumeric()).find(|word| is_hash(word));
                assert!(hash.is_some(), "{}: no commit in `{named}`", page.display());
            }
        }
    }
}

#[test]
fn a_page_with_rows_named_after_other_methods_says_first_that_they_are_settings_of_this_program() {
    for page in pages(&root().join("docs")) {
        let text = read(&page);
        let rows = ["| feature-3dgs", "| saga", "| gs-w |", "| flashsplat", "| graph-cut", "| paper |"];
        if text.contains("This page is generated")
            && text.lines().any(|l| rows.iter().any(|r| l.starts_with(r)))
        {
            let (_, first) = head(&text);
            assert!(first.contains("settings of this program"), "{}: {first}", page.display());
        }
    }
    let readme = read(&root().join("README.md"));
    for line in readme.lines().filter(|l| l.contains("Feature 3DGS")) {
        assert!(line.contains("settings of this program"), "{line}");
    }
}

#[test]
fn a_row_over_its_bar_is_named_in_the_first_sentence_of_its_page_and_where_that_is_cited() {
    let mut over = Vec::new();
    for page in pages(&root().join("docs")) {
        let text = read(&page);
        for line in text.lines().filter(|l| l.starts_with('|') && l.contains("**over**")) {
            let row = cells(line);
            let (_, first) = head(&text);
            assert!(first.contains(row[0]) && first.contains(row[2]), "{}: {first}", page.display());
            over.push((page.file_name().unwrap().to_string_lossy().into_owned(), row[2].to_owned()));
        }
    }
    let readme = read(&root().join("README.md"));
    for (page, value) in over {
        if readme.contains(&page) {
            assert!(readme.contains(&value), "README cites {page}, of which a row is over its bar: {value}");
        }
    }
}

#[test]
fn every_page_that_is_linked_is_there() {
    let mut all = pages(&root().join("docs"));
    all.extend(["README.md", "ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md"].map(|f| root().join(f)));
    for page in all {
        for link in read(&page).split("](").skip(1) {
            let target = link.split([')', '#', ' ']).next().unwrap_or("");
            if target.is_empty() || target.contains("://") {
                continue;
            }
            let file = page.parent().unwrap().join(target);
            assert!(file.exists(), "{}: {target}", page.display());
        }
    }
}
