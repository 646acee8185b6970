//! Circles of a graph of files.

use crate::modules::ImportGraph;
use std::collections::BTreeSet;

/// The circles, each as its files: from each of them imports lead to each other one and back.
pub fn circles(graph: &ImportGraph) -> Vec<BTreeSet<String>> {
    let mut found: Vec<BTreeSet<String>> = Vec::new();
    for start in graph.keys().filter(|file| reachable(graph, file).contains(*file)) {
        if found.iter().any(|circle| circle.contains(start)) {
            continue;
        }
        let after = reachable(graph, start);
        found.push(after.into_iter().filter(|file| reachable(graph, file).contains(start)).collect());
    }
    found
}

/// The graph of the folders below a crate's root: what the files of one import of those of another. A file of the root is a node
/// of its own, unless it is the parent of a folder.
pub fn of_folders(graph: &ImportGraph) -> ImportGraph {
    let files: BTreeSet<&String> = graph.keys().chain(graph.values().flat_map(|to| to.keys())).collect();
    let node = |file: &str| -> String {
        let top = file.split('/').next().unwrap_or(file);
        let folder = top.strip_suffix(".rs").map(|stem| format!("{stem}/"));
        match folder.filter(|folder| files.iter().any(|file| file.starts_with(folder.as_str()))) {
            Some(folder) => folder,
            None if top == file => top.to_owned(),
            None => format!("{top}/"),
        }
    };
    let mut folders = ImportGraph::new();
    for (from, all) in graph {
        for (to, names) in all.iter().filter(|(to, _)| node(from) != node(to)) {
            folders.entry(node(from)).or_default().entry(node(to)).or_default().extend(names.iter().cloned());
        }
    }
    folders
}

/// The files that the imports of a file lead to.
fn reachable(graph: &ImportGraph, from: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    let mut open = vec![from];
    while let Some(file) = open.pop() {
        for next in graph.get(file).into_iter().flat_map(|to| to.keys()) {
            if found.insert(next.clone()) {
                open.push(next);
            }
        }
    }
    found
}

/// The imports that make a circle, a line each.
pub fn lines(graph: &ImportGraph, circle: &BTreeSet<String>) -> Vec<String> {
    let mut found = Vec::new();
    for (from, all) in graph.iter().filter(|(from, _)| circle.contains(*from)) {
        for (to, names) in all.iter().filter(|(to, _)| circle.contains(*to)) {
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            found.push(format!("{from} -> {to}: {}", names.join(", ")));
        }
    }
    found
}
