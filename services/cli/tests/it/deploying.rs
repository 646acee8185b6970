//! What `deploy/` lets a container or a service do, and what somebody who starts them has to set.

use crate::common::*;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

fn read(file: &str) -> String {
    let path: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy").join(file);
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The parts of a YAML text below a heading, by name: of lines indented by two, and what is indented further.
fn parts(yaml: &str, heading: &str) -> Vec<(String, String)> {
    let lines = yaml.lines().skip_while(|line| *line != heading).skip(1);
    let mut found: Vec<(String, String)> = Vec::new();
    for line in lines.take_while(|line| line.is_empty() || line.starts_with([' ', '#'])) {
        match line.strip_prefix("  ").filter(|rest| !rest.starts_with([' ', '#'])) {
            Some(name) => found.push((name.trim_end_matches(':').to_owned(), String::new())),
            None => found.last_mut().into_iter().for_each(|(_, text)| *text += &format!("{line}\n")),
        }
    }
    found
}

#[test]
fn every_container_is_confined_and_bounded() {
    for (file, count) in [("compose.yaml", 3), ("compose.farm.yaml", 6)] {
        is_confined_and_bounded(file, count);
    }
    let compose = read("compose.yaml");
    let services = parts(&compose, "services:");
    let batch = &services.iter().find(|(name, _)| name == "segwild").expect("the batch").1;
    assert!(
        batch.contains("networks: [inside]") && compose.contains("inside:\n    internal: true"),
        "{batch}"
    );
    assert!(read("Containerfile").lines().any(|line| line == "USER 1000"), "the image runs as root");
}

fn is_confined_and_bounded(file: &str, count: usize) {
    let compose = read(file);
    let confined: Vec<_> =
        parts(&compose, "x-confined: &confined").into_iter().map(|(line, _)| line).collect();
    for line in
        ["read_only: true", "cap_drop: [ALL]", "security_opt: [\"no-new-privileges:true\"]", "tmpfs: [/tmp]"]
    {
        assert!(confined.iter().any(|l| l == line), "`{line}` is missing: {confined:?}");
    }
    assert!(confined.iter().any(|l| l.starts_with("pids_limit: ")), "{confined:?}");
    let services = parts(&compose, "services:");
    assert_eq!(services.len(), count, "{services:?}");
    for (name, service) in &services {
        let has = |start: &str| service.lines().any(|line| line.trim_start().starts_with(start));
        assert!(has("<<: *confined"), "{name} is not confined");
        assert!(has("mem_limit: "), "{name} may take all memory");
        assert!(has("user: ") && !has("user: \"0\"") && !has("privileged"), "{name} runs as root");
        let undone =
            ["read_only: false", "cap_add", "security_opt", "pids_limit", "network_mode", "devices:"];
        assert!(!undone.iter().any(|line| has(line)), "{name} undoes what it is confined by");
        for port in service.lines().filter(|line| line.trim_start().starts_with("- \"") && line.contains(':'))
        {
            let inside =
                ["\"127.0.0.1:", "\"${ADDRESS:-127.0.0.1}:"].iter().any(|start| port.contains(start));
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
