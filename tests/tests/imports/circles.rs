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
