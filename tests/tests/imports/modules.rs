//! The modules of a crate: what each defines, and what its file takes from other files.

use crate::tokens::tokens as tokens_of;
use std::collections::{BTreeMap, BTreeSet};

/// Files that import files, and the names they take: `graph[from][to]`.
pub type ImportGraph = BTreeMap<String, BTreeMap<String, BTreeSet<String>>>;

/// Words before the name of an item.
const ITEMS: [&str; 7] = ["struct", "enum", "trait", "fn", "type", "const", "static"];

/// A module, in a file of its own or inside of its parent's.
#[derive(Default)]
struct Module {
    file: String,
    parent: usize,
    children: BTreeMap<String, usize>,
    /// The items by name, with the file that defines each.
    items: BTreeMap<String, String>,
    uses: Vec<Use>,
    /// Paths in the code outside of `use`.
    paths: Vec<Vec<String>>,
    /// Names in the code outside of `use` that stand alone or start a path.
    words: BTreeSet<String>,
}

/// A name that a `use` brings into a module.
#[derive(Clone)]
struct Use {
    /// The name; `*` for all names of the path's target.
    name: String,
    path: Vec<String>,
    public: bool,
}

/// The modules of a crate; the first is the root.
pub struct Modules(Vec<Module>);

impl Modules {
    /// Reads the modules from the crate's root on. `read` has the text of a file, by its path from the root's folder.
    pub fn read(root: &str, read: &dyn Fn(&str) -> Option<String>) -> Modules {
        let mut modules = Modules(vec![Module { file: root.to_owned(), ..Module::default() }]);
        let text = read(root).unwrap_or_else(|| panic!("{root} can be read"));
        modules.read_module(0, &tokens_of(&text), "", read);
        modules
    }

    /// Reads a module. `folder` is where the files of its children lie, empty or with a slash at its end.
    fn read_module(
        &mut self,
        at: usize,
        tokens: &[&str],
        folder: &str,
        read: &dyn Fn(&str) -> Option<String>,
    ) {
        // For each open brace whether what is inside belongs to the module itself, as in a call of a macro.
        let mut open: Vec<bool> = Vec::new();
        let mut exported = false;
        let mut i = 0;
        while i < tokens.len() {
            let token = tokens[i];
            let next = tokens.get(i + 1).copied().unwrap_or_default();
            let before = if i > 0 { tokens[i - 1] } else { "" };
            let of_module = open.iter().all(|own| *own);
            match token {
                "#" if next == "[" || next == "!" => {
                    let end = attribute_end(tokens, i);
                    exported |= tokens[i..end].contains(&"macro_export");
                    i = if is_for_tests(&tokens[i..end]) { item_end(tokens, end) } else { end };
                    continue;
                }
                "use" if next != "<" => {
                    let end = position(tokens, i, ";");
                    let public = before == "pub" || before == ")";
                    add_uses(&tokens[i + 1..end], &[], public, &mut self.0[at].uses);
                    i = end;
                }
                "mod" if of_module && is_name(next) => {
                    i = self.read_child(at, tokens, i, folder, read);
                    continue;
                }
                "macro_rules" => {
                    let name = tokens[i + 2].to_owned();
                    let (file, owner) = (self.0[at].file.clone(), if exported { 0 } else { at });
                    self.0[owner].items.insert(name, file);
                    exported = false;
                    i += 2;
                }
                "{" => open.push(before == "!" && of_module),
                "}" => {
                    open.pop();
                }
                item if ITEMS.contains(&item) && before != "*" && is_name(next) && !ITEMS.contains(&next) => {
                    if of_module {
                        let file = self.0[at].file.clone();
                        self.0[at].items.insert(next.to_owned(), file);
                    }
                    i += 1;
                }
                name if is_name(name) => {
                    let path = path_from(tokens, i);
                    i += 2 * (path.len() - 1);
                    let whole = before != "::" && before != "." && (before != "$" || name == "crate");
                    // The name of a field or an argument stands for itself.
                    if whole && tokens.get(i + 1) != Some(&":") {
                        self.0[at].words.insert(name.to_owned());
                    }
                    if whole && path.len() > 1 {
                        self.0[at].paths.push(path);
                    }
                }
                _ => {}
            }
            i += 1;
        }
    }

    /// Reads a module that is declared at a token; its end.
    fn read_child(
        &mut self,
        parent: usize,
        tokens: &[&str],
        at: usize,
        folder: &str,
        read: &dyn Fn(&str) -> Option<String>,
    ) -> usize {
        let name = tokens[at + 1];
        let child = self.0.len();
        let below = format!("{folder}{name}/");
        let end = item_end(tokens, at);
        if tokens[at + 2] == "{" {
            let file = self.0[parent].file.clone();
            self.0.push(Module { file, parent, ..Module::default() });
            self.0[parent].children.insert(name.to_owned(), child);
            self.read_module(child, &tokens[at + 3..end - 1], &below, read);
            return end;
        }
        let files = [format!("{folder}{name}.rs"), format!("{below}mod.rs")];
        let found = files.into_iter().find_map(|file| read(&file).map(|text| (file, text)));
        let (file, text) = found.unwrap_or_else(|| panic!("the module {below} has a file"));
        self.0.push(Module { file, parent, ..Module::default() });
        self.0[parent].children.insert(name.to_owned(), child);
        self.read_module(child, &tokens_of(&text), &below, read);
        end
    }

    /// The files that import files.
    pub fn imports(&self) -> ImportGraph {
        let mut graph = ImportGraph::new();
        for (at, module) in self.0.iter().enumerate() {
            let own: Vec<&Use> = module.uses.iter().filter(|one| !self.only_passes_on(module, one)).collect();
            let mut found = BTreeSet::new();
            for path in own.iter().map(|one| &one.path).chain(&module.paths) {
                found.extend(self.resolve(at, path, &mut BTreeSet::new()));
            }
            for glob in own.iter().filter(|one| one.name == "*") {
                for target in self.modules_at(at, &glob.path, &mut BTreeSet::new()) {
                    for word in module.words.iter().filter(|word| !module.items.contains_key(*word)) {
                        found.extend(self.inside(target, std::slice::from_ref(word), &mut BTreeSet::new()));
                    }
                }
            }
            for (file, name) in found.into_iter().filter(|(file, _)| *file != module.file) {
                graph.entry(module.file.clone()).or_default().entry(file).or_default().insert(name);
            }
        }
        graph
    }

    /// Whether a module with modules below it makes a name public and has no use for it itself.
    fn only_passes_on(&self, module: &Module, one: &Use) -> bool {
        one.public && !module.children.is_empty() && !module.words.contains(&one.name)
    }

    /// The items that a path in a module leads to, with the files that define them; none for other crates' items.
    fn resolve(&self, at: usize, path: &[String], seen: &mut Seen) -> BTreeSet<(String, String)> {
        match path[0].as_str() {
            "crate" => self.inside(0, &path[1..], seen),
            "self" => self.inside(at, &path[1..], seen),
            "super" => self.inside(self.0[at].parent, &path[1..], seen),
            _ => self.inside(at, path, seen),
        }
    }

    /// The items that a path leads to from inside of a module.
    fn inside(&self, at: usize, path: &[String], seen: &mut Seen) -> BTreeSet<(String, String)> {
        let mut found = BTreeSet::new();
        if path.is_empty() || !seen.insert((at, path.to_vec())) {
            return found;
        }
        let (module, name, rest) = (&self.0[at], &path[0], &path[1..]);
        if name == "super" {
            return self.inside(module.parent, rest, seen);
        }
        if let Some(child) = module.children.get(name).filter(|_| !rest.is_empty()) {
            return self.inside(*child, rest, seen);
        }
        if let Some(file) = module.items.get(name) {
            found.insert((file.clone(), name.clone()));
        }
        for one in &module.uses {
            // `use a::a` is about the module `a`, or about another crate.
            let of_another_crate = one.path[0] == *name && !module.children.contains_key(name);
            if one.name == *name && !of_another_crate {
                let through: Vec<String> = one.path.iter().chain(rest).cloned().collect();
                found.extend(self.resolve(at, &through, seen));
            } else if one.name == "*" {
                for target in self.modules_at(at, &one.path, &mut BTreeSet::new()) {
                    found.extend(self.inside(target, path, seen));
                }
            }
        }
        found
    }

    /// The modules that a path in a module leads to.
    fn modules_at(&self, at: usize, path: &[String], seen: &mut Seen) -> BTreeSet<usize> {
        let mut open = BTreeSet::from([at]);
        for (i, name) in path.iter().enumerate() {
            let mut next = BTreeSet::new();
            for from in open {
                match name.as_str() {
                    "crate" => next.extend([0]),
                    "self" => next.extend([from]),
                    "super" => next.extend([self.0[from].parent]),
                    name => {
                        next.extend(self.0[from].children.get(name));
                        for one in self.0[from].uses.iter().filter(|one| one.name == name) {
                            if seen.insert((from, path[i..].to_vec())) {
                                next.extend(self.modules_at(from, &one.path, seen));
                            }
                        }
                    }
                }
            }
            open = next;
        }
        open
    }
}

/// What was followed already: modules, and paths in them.
type Seen = BTreeSet<(usize, Vec<String>)>;

fn is_name(token: &str) -> bool {
    token.starts_with(|c: char| c.is_alphabetic() || c == '_')
}

/// The names of the path that starts at a token.
fn path_from(tokens: &[&str], at: usize) -> Vec<String> {
    let mut path = vec![tokens[at].to_owned()];
    let mut i = at + 1;
    while tokens.get(i) == Some(&"::") && tokens.get(i + 1).is_some_and(|token| is_name(token)) {
        path.push(tokens[i + 1].to_owned());
        i += 2;
    }
    path
}

/// The first of a token from a position on; the end where there is none.
fn position(tokens: &[&str], from: usize, token: &str) -> usize {
    tokens[from..].iter().position(|t| *t == token).map_or(tokens.len(), |n| from + n)
}

/// The end of the attribute that starts at a token.
fn attribute_end(tokens: &[&str], at: usize) -> usize {
    closing(tokens, position(tokens, at, "["))
}

/// Behind the bracket that closes the one at a token.
fn closing(tokens: &[&str], at: usize) -> usize {
    let mut depth = 0;
    for (i, token) in tokens.iter().enumerate().skip(at) {
        match *token {
            "(" | "[" | "{" => depth += 1,
            ")" | "]" | "}" => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return i + 1;
        }
    }
    tokens.len()
}

/// Whether an attribute keeps what follows to the crate's own tests.
fn is_for_tests(attribute: &[&str]) -> bool {
    attribute.starts_with(&["#", "[", "cfg", "(", "test"])
        || attribute.starts_with(&["#", "[", "cfg", "(", "all", "(", "test"])
}

/// The end of what starts at a token and its attributes: an item, a field, a statement.
fn item_end(tokens: &[&str], at: usize) -> usize {
    let mut i = at;
    while i < tokens.len() {
        match tokens[i] {
            "#" => i = attribute_end(tokens, i),
            ";" => return i + 1,
            "{" => return closing(tokens, i),
            "(" | "[" => i = closing(tokens, i),
            // The end of what it stands in: a field or a branch was the last.
            "}" => return i,
            _ => i += 1,
        }
    }
    i
}

/// The names of a tree of a `use`, without the word itself and the semicolon.
fn add_uses(tree: &[&str], before: &[String], public: bool, uses: &mut Vec<Use>) {
    let tree = tree.strip_prefix(&["::"]).unwrap_or(tree);
    let brace = position(tree, 0, "{");
    let head = tree[..brace].split(|token| *token == "as").next().unwrap_or_default();
    let names = head.iter().filter(|token| **token != "::").map(|token| (*token).to_owned());
    let mut path: Vec<String> = before.iter().cloned().chain(names).collect();
    if brace == tree.len() {
        let alias = tree.last().filter(|_| head.len() < tree.len()).map(|name| (*name).to_owned());
        // `a::{self}` is `a`, and `a::*` all of it.
        let last = path.last().cloned().unwrap_or_default();
        if path.len() > 1 && (last == "self" || last == "*") {
            path.pop();
        }
        let name = if last == "*" { Some(last) } else { alias.or_else(|| path.last().cloned()) };
        uses.extend(name.map(|name| Use { name, path, public }));
        return;
    }
    let inner = &tree[brace + 1..closing(tree, brace) - 1];
    let (mut start, mut depth) = (0, 0);
    for (i, token) in inner.iter().chain([&","]).enumerate() {
        match *token {
            "{" => depth += 1,
            "}" => depth -= 1,
            "," if depth == 0 => {
                if i > start {
                    add_uses(&inner[start..i], &path, public, uses);
                }
                start = i + 1;
            }
            _ => {}
        }
    }
}
