//! No circles of imports: where a file imports another one, no way of imports leads back. So a reader can start at the
//! files that import nothing, and meets each name after its definition.

mod circles;
mod modules;
mod tokens;

use modules::{ImportGraph, Modules};
use std::path::Path;

/// The circles of a crate, each as one text: its imports, a line each.
fn circles_of(graph: &ImportGraph) -> Vec<String> {
    circles::circles(graph).iter().map(|circle| circles::lines(graph, circle).join("\n  ")).collect()
}

/// The graph of imports of each crate, by its name.
fn crates() -> Vec<(String, ImportGraph)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the tests crate lies in the workspace");
    let mut crates = Vec::new();
    for entry in std::fs::read_dir(root.join("services")).expect("the services").flatten() {
        let source = entry.path().join("src");
        for file in ["lib.rs", "main.rs"].into_iter().filter(|file| source.join(file).is_file()) {
            let read = |file: &str| std::fs::read_to_string(source.join(file)).ok();
            let name = entry.file_name().to_string_lossy().into_owned();
            crates.push((name, Modules::read(file, &read).imports()));
        }
    }
    crates
}

/// Fails where a graph of a crate has circles.
fn has_no_circles(graphs: &[(String, ImportGraph)]) {
    let lines = |(name, graph): &(String, ImportGraph)| -> Vec<String> {
        circles_of(graph).into_iter().map(|circle| format!("services/{name}:\n  {circle}")).collect()
    };
    let mut wrong: Vec<String> = graphs.iter().flat_map(lines).collect();
    wrong.sort();
    assert!(wrong.is_empty(), "{} circles of imports:\n{}", wrong.len(), wrong.join("\n"));
}

#[test]
fn no_imports_of_files_make_a_circle() {
    let crates = crates();
    let imports: usize = crates.iter().flat_map(|(_, graph)| graph.values()).map(|to| to.len()).sum();
    assert!(imports > 1000, "imports are found: {imports}");
    has_no_circles(&crates);
}

#[test]
fn no_imports_of_folders_make_a_circle() {
    let folders: Vec<_> =
        crates().into_iter().map(|(name, graph)| (name, circles::of_folders(&graph))).collect();
    assert!(folders.iter().any(|(_, graph)| graph.len() > 5), "folders are found");
    has_no_circles(&folders);
}

/// The imports of a crate of small files, a line each.
fn imports(files: &[(&str, &str)]) -> Vec<String> {
    let read = |file: &str| files.iter().find(|(name, _)| *name == file).map(|(_, text)| (*text).to_owned());
    let graph = Modules::read(files[0].0, &read).imports();
    let all = graph.keys().chain(graph.values().flat_map(|to| to.keys())).cloned().collect();
    circles::lines(&graph, &all)
}

/// How many circles a crate of small files has.
fn circles_in(files: &[(&str, &str)]) -> usize {
    let read = |file: &str| files.iter().find(|(name, _)| *name == file).map(|(_, text)| (*text).to_owned());
    circles_of(&Modules::read(files[0].0, &read).imports()).len()
}

#[test]
fn a_circle_of_neighbours_and_one_with_a_parent_are_found() {
    let neighbours = [
        ("lib.rs", "mod a; mod b;"),
        ("a.rs", "use crate::b::Second; pub struct First;"),
        ("b.rs", "use super::a::First; pub struct Second;"),
    ];
    assert_eq!(imports(&neighbours), ["a.rs -> b.rs: Second", "b.rs -> a.rs: First"]);
    assert_eq!(circles_in(&neighbours), 1);
    let parent = [
        ("lib.rs", "mod a;"),
        ("a/mod.rs", "mod b; pub struct Type; fn f() { b::build() }"),
        ("a/b.rs", "use super::Type; pub fn build() -> Type { Type }"),
    ];
    assert_eq!(imports(&parent), ["a/b.rs -> a/mod.rs: Type", "a/mod.rs -> a/b.rs: build"]);
    assert_eq!(circles_in(&parent), 1);
}

#[test]
fn folders_that_import_each_other_are_found_where_their_files_do_not() {
    let files = [
        ("lib.rs", "mod a; mod b;"),
        ("a/mod.rs", "pub mod first; pub mod second;"),
        ("a/first.rs", "pub struct First;"),
        ("a/second.rs", "use crate::b::Third;"),
        ("b.rs", "pub mod inner; use crate::a::first::First; pub struct Third;"),
        ("b/inner.rs", "use super::Third; pub struct Fourth;"),
    ];
    let read = |file: &str| files.iter().find(|(name, _)| *name == file).map(|(_, text)| (*text).to_owned());
    let graph = Modules::read("lib.rs", &read).imports();
    assert!(circles_of(&graph).is_empty());
    assert_eq!(circles_of(&circles::of_folders(&graph)), ["a/ -> b/: Third\n  b/ -> a/: First"]);
}

#[test]
fn a_circle_of_three_is_one_and_a_way_without_return_is_none() {
    let mut three = [
        ("lib.rs", "mod a; mod b; mod c; mod d; use d::D;"),
        ("a.rs", "use crate::b::B; pub struct A;"),
        ("b.rs", "use crate::{c::C, d::D}; pub struct B;"),
        ("c.rs", "use crate::a::A; pub struct C;"),
        ("d.rs", "pub struct D;"),
    ];
    assert_eq!(circles_in(&three), 1);
    three[3].1 = "pub struct C;";
    assert_eq!(circles_in(&three), 0, "{:?}", imports(&three));
}

#[test]
fn a_re_export_leads_to_the_definition_and_is_no_import() {
    let files = [
        ("lib.rs", "mod a; pub use a::{One, b::two};"),
        ("a.rs", "pub mod b; mod c; pub use c::One; pub(crate) use self::b::two as second;"),
        ("a/b.rs", "use crate::One; pub fn two() { super::second() }"),
        ("a/c.rs", "pub struct One;"),
    ];
    assert_eq!(imports(&files), ["a/b.rs -> a/c.rs: One"]);
    let used = [("lib.rs", "mod a; pub use a::One; fn f(x: One) {}"), ("a.rs", "pub struct One;")];
    assert_eq!(imports(&used), ["lib.rs -> a.rs: One"]);
}

#[test]
fn groups_aliases_globs_and_paths_in_code_are_followed() {
    let lib = "mod a; mod b; #[macro_export] macro_rules! four { () => {} }";
    let a = "pub mod inner { pub struct One; } pub enum Two { X } pub fn three() {} use super::four;";
    let of = |b: &str| imports(&[("lib.rs", lib), ("a.rs", a), ("b.rs", b)]).join("; ");
    let only = |names: &str| format!("a.rs -> lib.rs: four; b.rs -> a.rs: {names}");
    assert_eq!(of("use crate::{a::{self as other, inner::{One}, Two}, missing};"), only("One, Two"));
    assert_eq!(of("use super::a as other; fn f() { other::three() }"), only("three"));
    assert_eq!(of("use crate::a::*; fn f() { three(); let x = 1; }"), only("three"));
    assert_eq!(of("fn f(x: crate::a::Two) { match x { super::a::Two::X => {} } }"), only("Two"));
    assert_eq!(of("fn f() { use super::a::three as t; t() }"), only("three"));
    assert_eq!(of("macro_rules! m { () => { $crate::a::three() } }"), only("three"));
    assert_eq!(of("use std::a::three; fn f() { a::three(); x.a::<u8>() }"), "a.rs -> lib.rs: four");
}

#[test]
fn tests_comments_and_declarations_are_no_imports() {
    let of = |b: &str| imports(&[("lib.rs", "mod a; mod b;"), ("a.rs", "pub fn one() {}"), ("b.rs", b)]);
    assert!(of("#[cfg(test)] mod tests { use crate::a::one; }").is_empty());
    assert!(
        of("#[cfg(test)]\n#[path = \"x\"]\nuse crate::a::one; /// See crate::a::one\nfn f() {}").is_empty()
    );
    assert!(of("fn f() { print(\"crate::a::one()\") } // crate::a::one()").is_empty());
    assert_eq!(of("#[cfg(test)] fn f(x: [u8; 2]) {} fn g() { crate::a::one() }").len(), 1);
}
