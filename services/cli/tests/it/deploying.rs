//! What `deploy/` lets a container or a service do, and what somebody who starts them has to set.

#[path = "../../../../tests/support/yaml.rs"]
mod yaml;

use crate::common::*;
use crate::python::python;
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

fn path_of(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy").join(file)
}

fn read(file: &str) -> String {
    let path = path_of(file);
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// A file of compose, with what its anchors stand for.
fn compose_file(file: &str) -> Value {
    let read = yaml::documents(&read(file)).unwrap_or_else(|reason| panic!("{file}: {reason}"));
    read.into_iter().next().unwrap_or_else(|| panic!("{file} is empty"))
}

#[test]
fn every_container_is_confined_and_bounded() {
    for (file, count) in [("compose.yaml", 3), ("compose.farm.yaml", 6)] {
        is_confined_and_bounded(file, count);
    }
    let compose = compose_file("compose.yaml");
    assert_eq!(compose["services"]["segwild"]["networks"], json!(["inside"]));
    assert_eq!(compose["networks"]["inside"]["internal"], json!(true));
    let container = read("Containerfile");
    assert!(container.lines().any(|line| line == "USER 1000"), "the image runs as root");
    assert!(container.contains("install -d -m 1777 /work"), "a worker under RUN_AS cannot write its folder");
}

fn is_confined_and_bounded(file: &str, count: usize) {
    let compose = compose_file(file);
    let services = compose["services"].as_object().unwrap_or_else(|| panic!("{file} has no services"));
    assert_eq!(services.len(), count, "{services:?}");
    for (name, service) in services {
        // What a service sets itself counts, whatever it merges.
        for (part, value) in [
            ("read_only", json!(true)),
            ("cap_drop", json!(["ALL"])),
            ("security_opt", json!(["no-new-privileges:true"])),
            ("tmpfs", json!(["/tmp"])),
        ] {
            assert_eq!(service[part], value, "{file}, {name}: {part}");
        }
        assert!(service["pids_limit"].is_u64(), "{file}: {name} may start any number of processes");
        assert!(service["mem_limit"].is_string(), "{file}: {name} may take all memory");
        let user = service["user"].as_str();
        assert!(user.is_some_and(|user| user != "0" && user != "root"), "{file}: {name} runs as root");
        let undone = ["cap_add", "privileged", "network_mode", "devices"];
        assert!(
            undone.iter().all(|part| service.get(part).is_none()),
            "{name} undoes what it is confined by"
        );
        for port in service["ports"].as_array().into_iter().flatten() {
            let port = port.as_str().unwrap_or_else(|| panic!("{file}, {name}: {port} is no text"));
            let inside = ["127.0.0.1:", "${ADDRESS:-127.0.0.1}:"].iter().any(|start| port.starts_with(start));
            assert!(inside, "{name} is open to the network: {port}");
        }
    }
}

#[test]
fn no_image_floats() {
    let (compose, container) = (read("compose.yaml") + &read("compose.farm.yaml"), read("Containerfile"));
    // One that is built here has no digest before.
    let named = |line: &str| {
        line.trim().strip_prefix("image: ").filter(|image| *image != "segwild:latest").map(str::to_owned)
    };
    let by_default = |line: &str| {
        let (name, image) = line.strip_prefix("ARG ")?.split_once('=')?;
        name.ends_with("_IMAGE").then(|| image.to_owned())
    };
    let images: Vec<String> =
        compose.lines().filter_map(named).chain(container.lines().filter_map(by_default)).collect();
    assert_eq!(images.len(), 6, "{images:?}");
    for image in &images {
        let (tag, digest) = image.split_once("@sha256:").unwrap_or_else(|| panic!("{image} has no digest"));
        assert!(digest.len() == 64 && digest.bytes().all(|b| b.is_ascii_hexdigit()), "{image}");
        let version =
            tag.rsplit('/').next().and_then(|name| name.split_once(':')).map(|(_, version)| version);
        assert!(version.is_some_and(|version| version != "latest"), "{image} says no version");
    }
    for from in container.lines().filter_map(|line| line.strip_prefix("FROM ")) {
        assert!(from.starts_with("${") && from.contains("_IMAGE}"), "`FROM {from}` is no image named above");
    }
}

#[test]
fn grafana_asks_for_a_password_that_somebody_has_set() {
    let compose = read("compose.yaml");
    assert!(compose.contains("GF_SECURITY_ADMIN_PASSWORD: \"${GRAFANA_PASSWORD:?"), "it has a default");
    assert!(compose.contains("GF_AUTH_ANONYMOUS_ENABLED: \"false\""), "anybody may look");
    assert!(
        !compose.contains("GF_AUTH_ANONYMOUS_ORG_ROLE") && !compose.contains("GF_AUTH_DISABLE_LOGIN_FORM")
    );
}

/// Everything that compose demands stands on the operators' page, and nothing secret has a value in the repository.
#[test]
fn the_operators_page_says_what_has_to_be_set() {
    let page = read("../docs/guide/operate.md");
    for (file, page, all) in [
        ("compose.yaml", &page, &["DATA", "GRAFANA_PASSWORD", "PHOTOS"][..]),
        ("compose.farm.yaml", &read("../docs/guide/farm.md"), &["DATA"]),
    ] {
        let mut demanded = BTreeSet::new();
        for part in read(file).split("${").skip(1) {
            let name: String = part.chars().take_while(|c| c.is_ascii_uppercase() || *c == '_').collect();
            assert!(page.contains(&name), "{name} of {file} is not explained");
            if part[name.len()..].starts_with(":?") {
                demanded.insert(name);
            }
        }
        assert!(demanded.iter().eq(all), "{file}: {demanded:?}");
    }
    for word in ["MemoryMax", "LimitNOFILE", "--build-arg", "digest"] {
        assert!(page.contains(word), "{word} is not explained");
    }
}

#[test]
fn the_services_are_bounded_and_may_do_little() {
    for name in ["segwild-batch", "segwild-worker", "segwild-vision", "segwild-monitor"] {
        let unit = read(&format!("systemd/{name}@.service"));
        for line in [
            "MemoryMax=85%",
            "TasksMax=1024",
            "LimitNOFILE=4096",
            "OOMPolicy=continue",
            "NoNewPrivileges=true",
            "CapabilityBoundingSet=",
            "ProtectSystem=strict",
            "ProtectHome=read-only",
            "PrivateTmp=true",
            "PrivateDevices=true",
            "RestrictAddressFamilies=AF_INET AF_INET6 AF_UNIX",
            "SystemCallFilter=@system-service",
            "SystemCallFilter=~@privileged",
        ] {
            assert!(unit.lines().any(|l| l == line), "{name}: `{line}` is missing");
        }
        // A batch speaks to nobody; the others have a farm or clients, wherever these are.
        let closed = unit.lines().any(|l| l == "IPAddressDeny=any");
        assert_eq!(closed, name == "segwild-batch");
        let analyze = |args: &[&str]| Command::new("systemd-analyze").args(args).output();
        if !analyze(&["--version"]).is_ok_and(|o| o.status.success()) {
            println!("skipped: the_services_are_bounded_and_may_do_little: systemd-analyze is not installed");
            return;
        }
        let dir = folder();
        let file = dir.path().join(format!("{name}@x.service"));
        std::fs::write(&file, unit.replace("/usr/local/bin/segwild", "/bin/true")).expect("it writes");
        let file = show(&file);
        let verified = analyze(&["verify", &file]).expect("it runs");
        let stdout = text(&verified.stderr);
        assert!(!stdout.contains(name), "{stdout}");
        // From 0, safe, to 100: what systemd itself calls OK ends at 40.
        let secure =
            analyze(&["security", "--offline=true", "--no-pager", "--threshold=20", &file]).expect("it runs");
        assert!(secure.status.success(), "{}{}", text(&secure.stdout), text(&secure.stderr));
    }
}

#[test]
fn kubernetes_and_compose_files_pass_the_schemas_of_both() {
    let test = "kubernetes_and_compose_files_pass_the_schemas_of_both";
    let packages = "jsonschema, kubernetes_validate, yaml";
    let Some(mut python) = python(test, packages, ".ci/schemas.txt") else { return };
    let kubernetes = std::fs::read_dir(path_of("kubernetes")).expect("a folder").flatten();
    let mut files: Vec<PathBuf> = kubernetes.map(|entry| entry.path()).collect();
    files.extend(["compose.yaml", "compose.farm.yaml"].map(path_of));
    // Each with a mistake that a schema knows, beside the files as they are.
    let dir = folder();
    let mistakes = [
        ("kubernetes/scenes.yaml", ", status: \"True\"", "", "'status' is a required property"),
        ("kubernetes/pool.yaml", "sizeLimit:", "size:", "'size' was unexpected"),
        ("kubernetes/pool-hpa.yaml", "minReplicas: 1", "minReplicas: one", "'one' is not of type"),
        ("compose.farm.yaml", "pids_limit:", "pid_limit:", "'pid_limit' was unexpected"),
    ];
    let wrong = mistakes.map(|(file, right, wrong, _)| {
        let text = read(file);
        assert!(text.contains(right), "{file} has no `{right}`");
        let path = dir.path().join(file.replace('/', "-"));
        std::fs::write(&path, text.replace(right, wrong)).expect("it writes");
        path
    });
    python.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/schemas.py"));
    let output = python.args(&files).args(&wrong).output().expect("it starts");
    let (stdout, stderr) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{stderr}");
    let of = |file: &Path| {
        let start = format!("{}: ", show(file));
        stdout.lines().filter_map(|line| line.strip_prefix(&*start)).collect::<Vec<&str>>()
    };
    for file in &files {
        // KEDA's definitions are in no package: docs/guide/farm.md has the command that checks by them.
        let passes = |line: &&str| line.ends_with(": passes") || line.starts_with("ScaledObject ");
        let refused: Vec<&str> = of(file).into_iter().filter(|line| !passes(line)).collect();
        assert!(!of(file).is_empty() && refused.is_empty(), "{}: {refused:?}", file.display());
    }
    for ((.., words), file) in mistakes.iter().zip(&wrong) {
        assert!(of(file).iter().any(|line| line.contains(words)), "{words}: {stdout}");
    }
}
