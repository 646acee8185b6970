//! What a release says of itself, as far as nothing has to be compiled: the packages of the program with their checksums,
//! the Debian package's control file, and the files that `.ci/release` names.

use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn read(file: &str) -> String {
    std::fs::read_to_string(root().join(file)).unwrap_or_else(|e| panic!("{file}: {e}"))
}

fn table(file: &str) -> toml::Table {
    read(file).parse::<toml::Table>().unwrap_or_else(|e| panic!("{file}: {e}"))
}

/// Runs a program in the repository's root.
fn run(program: &str, args: &[&str]) -> Output {
    let path = if program.contains('/') { root().join(program) } else { program.into() };
    Command::new(path)
        .args(args)
        .current_dir(root())
        .env("CARGO", env!("CARGO"))
        .output()
        .unwrap_or_else(|e| panic!("{program}: {e}"))
}

/// What a program prints that succeeds.
fn printed(program: &str, args: &[&str]) -> String {
    let output = run(program, args);
    assert!(output.status.success(), "{program} {args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("a text")
}

fn text<'a>(value: &'a Value, pointer: &str) -> &'a str {
    value.pointer(pointer).and_then(Value::as_str).unwrap_or_else(|| panic!("no {pointer} in {value}"))
}

/// The checksum of each package of Cargo.lock, by name and version; those of the workspace have none.
fn locked() -> BTreeMap<(String, String), Option<String>> {
    let lock = table("Cargo.lock");
    let packages = lock["package"].as_array().expect("packages");
    let field = |package: &toml::Value, name: &str| Some(package.get(name)?.as_str()?.to_owned());
    packages
        .iter()
        .map(|package| {
            let name = field(package, "name").expect("a name");
            ((name, field(package, "version").expect("a version")), field(package, "checksum"))
        })
        .collect()
}

#[test]
fn the_sbom_has_every_package_of_the_program_once_with_its_checksum() {
    let can = Command::new("python3").args(["-c", "import tomllib"]).output();
    if !can.is_ok_and(|output| output.status.success()) {
        eprintln!(
            "skipped: the_sbom_has_every_package_of_the_program_once_with_its_checksum: no python3 of 3.11 or later"
        );
        return;
    }
    let sbom = printed("python3", &[".ci/sbom.py", "x86_64-unknown-linux-gnu"]);
    let sbom: Value = serde_json::from_str(&sbom).expect("the SBOM is JSON");
    assert_eq!(sbom["bomFormat"], "CycloneDX");
    let program = text(&sbom, "/metadata/component/bom-ref");
    assert_eq!(text(&sbom, "/metadata/component/version"), env!("CARGO_PKG_VERSION"));

    let locked = locked();
    let (mut packages, mut scopes) = (BTreeSet::new(), BTreeMap::new());
    for component in sbom["components"].as_array().expect("components") {
        let (name, version) = (text(component, "/name"), text(component, "/version"));
        let checksum = &locked[&(name.to_owned(), version.to_owned())];
        let digest = component.pointer("/hashes/0/content").and_then(Value::as_str);
        assert_eq!(digest, checksum.as_deref(), "{name} {version}");
        assert_eq!(checksum.is_none(), name.starts_with("segwild-"), "{name} {version}");
        assert!(!text(component, "/licenses/0/expression").contains('/'), "{name} {version}");
        assert!(packages.insert(text(component, "/bom-ref")), "{name} {version} stands there twice");
        scopes.insert(name, text(component, "/scope"));
    }
    for (name, scope) in [
        ("libsqlite3-sys", "required"),
        ("ort-sys", "required"),
        ("segwild-studio", "required"),
        ("wgpu-hal", "required"),
        ("cc", "excluded"),
        ("prost-build", "excluded"),
        ("serde_derive", "excluded"),
    ] {
        assert_eq!(scopes.get(name), Some(&scope), "{name}");
    }
    // Those of tests, and those of other systems.
    for name in ["proptest", "segwild-tests", "windows"] {
        assert!(locked.keys().any(|(locked, _)| locked == name), "Cargo.lock has no {name}");
        assert!(!scopes.contains_key(name), "{name} is no part of the program");
    }
    for name in table("services/cli/Cargo.toml")["dependencies"].as_table().expect("dependencies").keys() {
        assert!(scopes.contains_key(name.as_str()), "{name} is missing");
    }

    // Each package is reached from the program, over what each says that it needs.
    let needs: BTreeMap<&str, &Value> = sbom["dependencies"]
        .as_array()
        .expect("dependencies")
        .iter()
        .map(|edge| (text(edge, "/ref"), &edge["dependsOn"]))
        .collect();
    let (mut reached, mut open) = (BTreeSet::new(), vec![program]);
    while let Some(next) = open.pop() {
        if reached.insert(next) {
            let inner = needs.get(next).unwrap_or_else(|| panic!("{next} has no list of what it needs"));
            open.extend(inner.as_array().expect("a list").iter().filter_map(Value::as_str));
        }
    }
    packages.insert(program);
    assert_eq!(reached, packages);
}

#[test]
fn the_debian_package_has_the_programs_version_and_the_user_of_its_units() {
    let control = printed(".ci/release", &["--control", "arm64", "1234"]);
    let field = |name: &str| {
        let found = control.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(": "));
        found.unwrap_or_else(|| panic!("no {name} in {control}"))
    };
    let version = env!("CARGO_PKG_VERSION");
    assert_eq!((field("Package"), field("Version")), ("segwild", version));
    assert_eq!((field("Architecture"), field("Installed-Size")), ("arm64", "1234"));
    // That of an address: whatever was to be filled in, is.
    assert_eq!(control.matches('@').count(), 1, "{control}");
    assert_eq!(printed(".ci/release", &["--version"]).trim(), version);
    let cited = read("CITATION.cff");
    assert!(
        cited.lines().any(|line| line == format!("version: {version}")),
        "CITATION.cff has another version"
    );

    let users = read(".ci/debian/sysusers.conf");
    let made: Vec<&str> = users.lines().filter(|line| line.starts_with("u ")).collect();
    assert_eq!(made, ["u segwild - \"segwild\" /var/lib/segwild"]);
    let mut units = 0;
    for unit in std::fs::read_dir(root().join("deploy/systemd")).expect("the units").flatten() {
        let unit = std::fs::read_to_string(unit.path()).expect("a unit");
        for line in ["User=segwild", "WorkingDirectory=/var/lib/segwild"] {
            assert!(unit.lines().any(|l| l == line), "{line} is missing in {unit}");
        }
        units += 1;
    }
    assert!(units >= 4, "{units}");
}

#[test]
fn a_release_refuses_what_it_cannot_build() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().to_str().expect("a path of letters");
    let cases: [(&[&str], &str); 6] = [
        (&[], "usage"),
        (&["--twice"], "usage"),
        (&["--once", out], "usage"),
        (&["--control", "sparc", "1"], "sparc"),
        (&[out, "x86_64-pc-windows-msvc"], "x86_64-pc-windows-msvc is none of"),
        (&["services"], "is not empty"),
    ];
    for (args, problem) in cases {
        let output = run(".ci/release", args);
        let words = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {words}");
        assert!(words.contains(problem), "{args:?}: {words}");
    }
}

/// Whether a folder has a file with this ending.
fn has_file(folder: &str, ending: &str) -> bool {
    let mut entries = std::fs::read_dir(root().join(folder)).expect("a folder").flatten();
    entries.any(|entry| entry.file_name().to_string_lossy().ends_with(ending))
}

#[test]
fn scripts_of_a_release_are_shell_and_name_files_that_are_there() {
    for (shell, script) in [("bash", ".ci/release"), ("sh", ".ci/debian/postinst")] {
        printed(shell, &["-n", script]);
    }
    let script = read(".ci/release");
    let mut named = BTreeSet::new();
    for part in ["$root", "$tree"].iter().flat_map(|folder| script.split(folder).skip(1)) {
        // `"$tree/FILE"` and `"$tree"/FILE`.
        let Some(rest) = part.strip_prefix("\"/").or_else(|| part.strip_prefix('/')) else { continue };
        let path = rest.split(|c: char| c.is_whitespace() || "\"';)".contains(c)).next().unwrap_or_default();
        if path.starts_with("target/") {
            continue;
        }
        match path.strip_prefix('{').and_then(|inner| inner.strip_suffix('}')) {
            Some(several) => named.extend(several.split(',')),
            None => drop(named.insert(path)),
        }
    }
    assert!(named.len() >= 10, "{named:?}");
    for path in named {
        let there = match path.split_once('*') {
            Some((folder, ending)) => has_file(folder, ending),
            None => root().join(path).is_file(),
        };
        assert!(there, ".ci/release names {path}");
    }
    // The compiler of a release is that of the container, and new enough for the workspace.
    let manifest = table("Cargo.toml");
    let oldest = manifest["workspace"]["package"]["rust-version"].as_str().expect("a version");
    assert!(
        read("deploy/Containerfile").contains(&format!("rust:{oldest}.")),
        "the container has another Rust"
    );
}
