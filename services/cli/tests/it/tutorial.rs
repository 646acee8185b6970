//! `docs/tutorial.md`, followed literally: every shell block is run in order, in one empty folder.

use crate::common::folder;
use std::path::Path;
use std::process::Command;

/// The lines of the page's `sh` blocks, with the line of the page on which each stands.
fn commands(page: &str) -> Vec<(usize, &str)> {
    let mut inside = false;
    let mut found = Vec::new();
    for (i, line) in page.lines().enumerate() {
        match line.trim() {
            "```sh" => inside = true,
            "```" => inside = false,
            command if inside && !command.is_empty() => found.push((i + 1, command)),
            _ => {}
        }
    }
    found
}

#[test]
fn the_tutorial_works_when_it_is_followed_literally() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/tutorial.md");
    let page = std::fs::read_to_string(&file).expect("the tutorial");
    let commands = commands(&page);
    assert!(commands.len() >= 15, "{commands:?}");
    let dir = folder();
    let program = Path::new(env!("CARGO_BIN_EXE_segwild")).parent().expect("a folder");
    let path = format!("{}:{}", program.display(), std::env::var("PATH").unwrap_or_default());
    for (line, command) in commands {
        let output =
            Command::new("sh").args(["-ec", command]).current_dir(dir.path()).env("PATH", &path).output();
        let output = output.expect("a shell");
        let printed = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "docs/tutorial.md:{line}: `{command}`: {printed}");
    }
    for file in ["pavilion.ply", "pavilion-dusk.ply", "scene.ply", "runs/tutorial/report.html"] {
        assert!(dir.path().join(file).is_file(), "{file}");
    }
}
