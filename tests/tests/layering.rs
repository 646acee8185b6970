//! The floors of the workspace: an arrow may only point down.

use std::collections::HashMap;
use std::path::Path;
use std::process::Command;

/// Floor of every member, read from the `# floor N:` comments of the root manifest.
fn floors(manifest: &str) -> HashMap<String, u32> {
    let mut floor = None;
    let mut found = HashMap::new();
    for line in manifest.lines().map(str::trim) {
        if let Some(rest) = line.strip_prefix("# floor ") {
            floor = rest.split(':').next().and_then(|n| n.parse().ok());
        } else if let (Some(floor), Some(path)) =
            (floor, line.strip_prefix('"').and_then(|l| l.strip_suffix("\",")))
        {
            let name = path.rsplit('/').next().unwrap_or(path);
            found.insert(format!("segwild-{name}"), floor);
        } else if line == "]" && !found.is_empty() {
            break;
        }
    }
    found
}

/// Edges that do not point down, as sentences.
fn upward_edges(floors: &HashMap<String, u32>, edges: &[(String, String)]) -> Vec<String> {
    let mut wrong: Vec<String> = edges
        .iter()
        .filter(|(from, to)| floors[to] >= floors[from])
        .map(|(from, to)| format!("{from} (floor {}) depends on {to} (floor {})", floors[from], floors[to]))
        .collect();
    wrong.sort();
    wrong
}

#[test]
fn dependencies_point_down_only() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the tests crate lies in the workspace");
    let manifest = std::fs::read_to_string(root.join("Cargo.toml")).expect("root manifest");
    let floors = floors(&manifest);
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version", "1", "--no-deps", "--offline", "--manifest-path"])
        .arg(root.join("Cargo.toml"))
        .output()
        .expect("cargo metadata runs");
    let metadata: serde_json::Value = serde_json::from_slice(&output.stdout).expect("cargo metadata is JSON");
    let mut edges = Vec::new();
    for package in metadata["packages"].as_array().expect("packages") {
        let from = package["name"].as_str().expect("a name").to_owned();
        assert!(floors.contains_key(&from), "{from} stands on no floor of the root manifest");
        for dependency in package["dependencies"].as_array().expect("dependencies") {
            let to = dependency["name"].as_str().expect("a name");
            if to.starts_with("segwild-") {
                edges.push((from.clone(), to.to_owned()));
            }
        }
    }
    assert!(edges.len() > 10, "the workspace has lost its edges: {edges:?}");
    assert_eq!(upward_edges(&floors, &edges), Vec::<String>::new());
}

#[test]
fn an_upward_edge_is_seen() {
    let floors = floors(
        "# floor 0: a\n\"services/scene\",\n# floor 1: b\n\"services/masks\",\n\"services/trainer\",\n]",
    );
    let edge = |a: &str, b: &str| (format!("segwild-{a}"), format!("segwild-{b}"));
    assert_eq!(upward_edges(&floors, &[edge("masks", "scene")]), Vec::<String>::new());
    assert_eq!(upward_edges(&floors, &[edge("scene", "masks")]).len(), 1);
    assert_eq!(
        upward_edges(&floors, &[edge("masks", "trainer")]).len(),
        1,
        "neighbours never import each other"
    );
}
