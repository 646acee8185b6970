//! Every file of `deploy/` is read: its format, what its kind has to have, its command lines by the program's own, and its exit
//! codes by the page of exit codes.

#[path = "../../../../tests/support/yaml.rs"]
mod yaml;

use super::program;
use crate::exit;
use clap::error::ErrorKind;
use segwild_farm::ErrorClass;
use segwild_monitor::metrics::Metric;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Where the service units have the program.
const INSTALLED: &str = "/usr/local/bin/segwild ";

/// What variables of scripts and units hold, where it is no free text.
const VARIABLES: [(&str, &str); 2] =
    [("SEGWILD_FARM", "nats://queue:4222/night"), ("needs", "cores=8,memory=28.8")];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// The files of `deploy/`, by their paths in it.
fn files() -> BTreeMap<String, String> {
    let top = root().join("deploy");
    let (mut found, mut open) = (BTreeMap::new(), vec![top.clone()]);
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(&folder).expect("a folder").flatten() {
            let path = entry.path();
            if path.is_dir() {
                open.push(path);
                continue;
            }
            let name = path.strip_prefix(&top).expect("inside").display().to_string().replace('\\', "/");
            found.insert(name, std::fs::read_to_string(&path).expect("a text"));
        }
    }
    found
}

fn documents(name: &str, text: &str) -> Vec<Value> {
    yaml::documents(text).unwrap_or_else(|reason| panic!("deploy/{name}: {reason}"))
}

/// The objects of Kubernetes, each with its file.
fn objects() -> Vec<(String, Value)> {
    let texts = files().into_iter().filter(|(name, _)| name.starts_with("kubernetes/"));
    texts
        .flat_map(|(name, text)| {
            let read = documents(&name, &text);
            read.into_iter().map(move |object| (name.clone(), object))
        })
        .collect()
}

/// What stands at a path; missing things are named.
fn at<'a>(name: &str, value: &'a Value, pointer: &str) -> &'a Value {
    value.pointer(pointer).unwrap_or_else(|| panic!("{name}: {pointer} is missing in {value}"))
}

fn text_at(name: &str, value: &Value, pointer: &str) -> String {
    at(name, value, pointer).as_str().unwrap_or_else(|| panic!("{name}: {pointer} is no text")).to_owned()
}

fn list_at<'a>(name: &str, value: &'a Value, pointer: &str) -> &'a Vec<Value> {
    at(name, value, pointer).as_array().unwrap_or_else(|| panic!("{name}: {pointer} is no list"))
}

fn words_of(list: &[Value]) -> Vec<String> {
    list.iter().map(|word| word.as_str().expect("a text").to_owned()).collect()
}

/// The metric names of an expression.
fn metrics_in(expression: &str) -> BTreeSet<&str> {
    let word = |c: char| !(c.is_ascii_alphanumeric() || c == '_');
    expression.split(word).filter(|word| word.starts_with("segwild_")).collect()
}

fn has_only_known_metrics(name: &str, expression: &str) {
    let known = |metric: &str| {
        let own = |stem: &str| Metric::ALL.iter().any(|m| m.name() == stem);
        own(metric)
            || ["_bucket", "_sum", "_count"].iter().any(|end| metric.strip_suffix(end).is_some_and(own))
    };
    let metrics = metrics_in(expression);
    // `up` is Prometheus' own.
    assert!(!metrics.is_empty() || expression.starts_with("up{"), "{name}: `{expression}` has no metric");
    for metric in metrics {
        assert!(known(metric), "{name}: there is no metric {metric}");
    }
}

#[test]
fn every_file_of_deploy_has_a_format_that_is_read() {
    let (mut checked, mut rules) = (0, 0);
    for (name, text) in files() {
        let ending = name.rsplit('.').next().unwrap_or_default();
        match ending {
            "yaml" | "yml" => assert!(!documents(&name, &text).is_empty(), "{name} is empty"),
            "json" => drop(serde_json::from_str::<Value>(&text).unwrap_or_else(|e| panic!("{name}: {e}"))),
            "sbatch" => assert!(text.starts_with("#!/bin/bash\n") && text.contains("\n#SBATCH "), "{name}"),
            "service" => {
                for section in ["[Unit]", "[Service]", "[Install]"] {
                    assert_eq!(text.lines().filter(|line| *line == section).count(), 1, "{name}: {section}");
                }
                let setting = |line: &&str| !line.is_empty() && !line.starts_with(['#', '[']);
                let wrong = text.lines().filter(setting).find(|line| !line.contains('='));
                assert_eq!(wrong, None, "{name}");
            }
            "conf" => assert_eq!(text.matches('{').count(), text.matches('}').count(), "{name}"),
            _ => assert!(
                ["Containerfile", "carry"].contains(&&*name),
                "{name} has a format that no test reads"
            ),
        }
        checked += 1;
        if name.starts_with("prometheus/alerts.") && !name.contains("test") {
            for group in list_at(&name, &documents(&name, &text)[0], "/groups") {
                for rule in list_at(&name, group, "/rules") {
                    has_only_known_metrics(&name, &text_at(&name, rule, "/expr"));
                    for part in
                        ["/alert", "/labels/severity", "/annotations/summary", "/annotations/description"]
                    {
                        text_at(&name, rule, part);
                    }
                    rules += 1;
                }
            }
        }
    }
    assert!(checked > 20 && rules > 10, "{checked} files, {rules} rules");
}

/// The template of an object's pods, if it has some.
fn pods(object: &Value) -> Option<&Value> {
    object.pointer("/spec/template")
}

fn has_what_pods_need(name: &str, object: &Value, template: &Value) {
    assert_eq!(at(name, template, "/spec/automountServiceAccountToken"), &Value::Bool(false), "{name}");
    for (part, value) in [
        ("runAsNonRoot", Value::Bool(true)),
        ("seccompProfile", serde_json::json!({ "type": "RuntimeDefault" })),
    ] {
        assert_eq!(at(name, template, &format!("/spec/securityContext/{part}")), &value, "{name}: {part}");
    }
    let volumes: BTreeSet<String> = list_at(name, template, "/spec/volumes")
        .iter()
        .map(|volume| text_at(name, volume, "/name"))
        .collect();
    let mut mounted = BTreeSet::new();
    for container in list_at(name, template, "/spec/containers") {
        text_at(name, container, "/name");
        text_at(name, container, "/image");
        at(name, container, "/resources/requests/cpu");
        at(name, container, "/resources/limits/memory");
        for (part, value) in [("allowPrivilegeEscalation", false), ("readOnlyRootFilesystem", true)] {
            let set = at(name, container, &format!("/securityContext/{part}"));
            assert_eq!(set, &Value::Bool(value), "{name}: {part}");
        }
        assert_eq!(
            at(name, container, "/securityContext/capabilities/drop"),
            &serde_json::json!(["ALL"]),
            "{name}"
        );
        for mount in list_at(name, container, "/volumeMounts") {
            assert!(text_at(name, mount, "/mountPath").starts_with('/'), "{name}");
            mounted.insert(text_at(name, mount, "/name"));
        }
    }
    assert_eq!(mounted, volumes, "{name}: volumes are mounted, and mounts have volumes");
    if let Some(selector) = object.pointer("/spec/selector/matchLabels") {
        let labels = at(name, template, "/metadata/labels");
        for (label, value) in selector.as_object().expect("labels") {
            assert_eq!(labels.get(label), Some(value), "{name}: its pods do not have its label {label}");
        }
    }
}

#[test]
fn objects_of_kubernetes_have_what_their_kinds_need() {
    let objects = objects();
    let has_a_target = |name: &str, kind: &str, wanted: &str| {
        let target = objects.iter().find(|(_, o)| o["kind"] == kind && o["metadata"]["name"] == wanted);
        let (file, target) = target.unwrap_or_else(|| panic!("{name}: there is no {kind} {wanted}"));
        // Who applies the file again would undo what scales it.
        assert!(target.pointer("/spec/replicas").is_none(), "{file} sets the replicas that {name} sets");
    };
    let mut kinds = BTreeSet::new();
    for (name, object) in &objects {
        let name = name.as_str();
        let (kind, version) = (text_at(name, object, "/kind"), text_at(name, object, "/apiVersion"));
        text_at(name, object, "/metadata/name");
        let expected = match kind.as_str() {
            "Deployment" => {
                at(name, object, "/spec/selector/matchLabels");
                pods(object).unwrap_or_else(|| panic!("{name} has no pods"));
                "apps/v1"
            }
            "Job" => {
                jobs_end_as_each_exit_code_says(name, object);
                "batch/v1"
            }
            "Service" => {
                let selector = at(name, object, "/spec/selector");
                let selects = |other: &(String, Value)| {
                    pods(&other.1).is_some_and(|pods| pods.pointer("/metadata/labels") == Some(selector))
                };
                assert!(objects.iter().any(selects), "{name}: the service selects nothing");
                for port in list_at(name, object, "/spec/ports") {
                    at(name, port, "/port");
                }
                "v1"
            }
            "PersistentVolumeClaim" => {
                list_at(name, object, "/spec/accessModes");
                text_at(name, object, "/spec/resources/requests/storage");
                "v1"
            }
            "ScaledObject" => {
                has_a_target(name, "Deployment", &text_at(name, object, "/spec/scaleTargetRef/name"));
                assert!(
                    at(name, object, "/spec/minReplicaCount").as_u64()
                        < at(name, object, "/spec/maxReplicaCount").as_u64()
                );
                for trigger in list_at(name, object, "/spec/triggers") {
                    assert_eq!(text_at(name, trigger, "/type"), "prometheus", "{name}");
                    has_only_known_metrics(name, &text_at(name, trigger, "/metadata/query"));
                    for part in ["serverAddress", "threshold"] {
                        text_at(name, trigger, &format!("/metadata/{part}"));
                    }
                }
                "keda.sh/v1alpha1"
            }
            "HorizontalPodAutoscaler" => {
                let target = at(name, object, "/spec/scaleTargetRef");
                has_a_target(name, &text_at(name, target, "/kind"), &text_at(name, target, "/name"));
                assert!(
                    at(name, object, "/spec/minReplicas").as_u64()
                        < at(name, object, "/spec/maxReplicas").as_u64()
                );
                for metric in list_at(name, object, "/spec/metrics") {
                    has_only_known_metrics(name, &text_at(name, metric, "/external/metric/name"));
                    text_at(name, metric, "/external/target/averageValue");
                }
                "autoscaling/v2"
            }
            other => panic!("{name}: no test knows what a {other} needs"),
        };
        assert_eq!(version, expected, "{name}");
        if let Some(template) = pods(object) {
            has_what_pods_need(name, object, template);
        }
        kinds.insert(kind);
    }
    for kind in ["Deployment", "Job", "Service", "ScaledObject", "HorizontalPodAutoscaler"] {
        assert!(kinds.contains(kind), "there is no {kind} in deploy/kubernetes");
    }
}

/// Whether another attempt after this code would end in the same way.
fn is_fatal(code: u8) -> bool {
    exit::class(Some(code.into())) == ErrorClass::Fatal
}

/// Whether this code counts as no attempt.
fn costs_nothing(code: u8) -> bool {
    code == exit::INTERRUPTED || exit::class(Some(code.into())) == ErrorClass::Shortage
}

fn jobs_end_as_each_exit_code_says(name: &str, job: &Value) {
    // Kubernetes takes exit codes into account only where it does not start a container again by itself.
    assert_eq!(text_at(name, job, "/spec/template/spec/restartPolicy"), "Never", "{name}");
    let indexed = job.pointer("/spec/completionMode").is_some_and(|mode| mode == "Indexed");
    let limit = if indexed { "/spec/backoffLimitPerIndex" } else { "/spec/backoffLimit" };
    assert!(at(name, job, limit).is_u64(), "{name}");
    if indexed {
        let completions = at(name, job, "/spec/completions").as_u64();
        assert!(
            completions.is_some() && at(name, job, "/spec/maxFailedIndexes").as_u64() <= completions,
            "{name}"
        );
    }
    let (mut disruptions, mut ends, mut free) = (false, BTreeSet::new(), BTreeSet::new());
    for rule in list_at(name, job, "/spec/podFailurePolicy/rules") {
        let action = text_at(name, rule, "/action");
        if let Some(conditions) = rule.pointer("/onPodConditions") {
            disruptions |= action == "Ignore" && conditions[0]["type"] == "DisruptionTarget";
            continue;
        }
        assert_eq!(text_at(name, rule, "/onExitCodes/operator"), "In", "{name}");
        let exits = list_at(name, rule, "/onExitCodes/values").iter();
        let exits: Vec<u8> =
            exits.map(|code| code.as_u64().and_then(|code| code.try_into().ok()).expect("a code")).collect();
        // As Kubernetes wants them.
        assert!(exits.is_sorted() && !exits.contains(&0) && !exits.is_empty(), "{name}: {exits:?}");
        let known = match action.as_str() {
            "Ignore" => {
                free.extend(exits.iter().copied());
                exits.iter().all(|code| costs_nothing(*code))
            }
            // A command line that makes no sense is that of every pod; photos are those of one index.
            "FailJob" => {
                ends.extend(exits.iter().copied());
                exits == [exit::USAGE]
            }
            "FailIndex" => {
                ends.extend(exits.iter().copied());
                indexed && exits.iter().all(|code| is_fatal(*code))
            }
            other => panic!("{name}: {other}"),
        };
        assert!(known, "{name}: {action} does not fit {exits:?}");
    }
    assert!(disruptions, "{name}: an eviction costs an attempt");
    assert_eq!(free, BTreeSet::from([exit::SHORTAGE, exit::INTERRUPTED]), "{name}: these cost no attempt");
    let all =
        if indexed { BTreeSet::from([exit::USAGE, exit::INPUT]) } else { BTreeSet::from([exit::USAGE]) };
    assert_eq!(ends, all, "{name}: these are not tried again");
}

/// The codes of a line of a service unit.
fn unit_exits(unit: &str, setting: &str) -> Vec<u8> {
    let line = unit.lines().find_map(|line| line.strip_prefix(setting)?.strip_prefix('='));
    line.unwrap_or_default().split(' ').filter_map(|code| code.parse().ok()).collect()
}

#[test]
fn each_exit_code_of_deploy_stands_on_the_page() {
    let page = std::fs::read_to_string(root().join("docs/reference/exit-codes.md")).expect("the page");
    let cells = |line: &str| line.split('|').map(|cell| cell.trim().to_owned()).collect::<Vec<_>>();
    let rows = page.lines().map(cells).filter(|cells| cells.len() > 6);
    let rows: BTreeMap<u8, (String, String)> = rows
        .filter_map(|cells| {
            Some((cells[1].parse().ok()?, (cells[2].trim_matches('`').to_owned(), cells[5].clone())))
        })
        .collect();
    let constants = [
        ("OK", exit::OK),
        ("FAILED", exit::FAILED),
        ("USAGE", exit::USAGE),
        ("INPUT", exit::INPUT),
        ("INCOMPLETE", exit::INCOMPLETE),
        ("NOTHING", exit::NOTHING),
        ("FOLDER", exit::FOLDER),
        ("WORSE", exit::WORSE),
        ("SHORTAGE", exit::SHORTAGE),
        ("INTERRUPTED", exit::INTERRUPTED),
    ];
    assert_eq!(rows.len(), constants.len(), "{rows:?}");
    for (name, code) in constants {
        let (named, batch) = &rows[&code];
        assert_eq!(named, name);
        assert_eq!(batch == "gives up", is_fatal(code), "{name}: {batch}");
        assert_eq!(
            batch.contains("no attempt"),
            costs_nothing(code) && code != exit::INTERRUPTED,
            "{name}: {batch}"
        );
    }
    let mut units = 0;
    for (name, text) in files() {
        if name.ends_with(".service") {
            units += 1;
            let never = unit_exits(&text, "RestartPreventExitStatus");
            // A batch with dead letters (4) does not get better by another start; a service has no photos of its own.
            let batch = |code: u8| name.contains("batch") && code == exit::INCOMPLETE;
            assert!(
                never.contains(&exit::USAGE) && never.iter().all(|c| is_fatal(*c) || batch(*c)),
                "{name}: {never:?}"
            );
            assert_eq!(unit_exits(&text, "SuccessExitStatus"), [exit::INTERRUPTED], "{name}");
        }
        if name == "slurm/scenes.sbatch" {
            let pattern =
                text.lines().find_map(|line| line.trim().strip_suffix(')').filter(|l| l.contains(" | ")));
            let exits = pattern
                .expect("codes that are requeued")
                .split(" | ")
                .map(|code| code.parse().expect("a code"));
            assert_eq!(exits.collect::<Vec<u8>>(), [exit::SHORTAGE, exit::INTERRUPTED], "{name}");
        }
    }
    assert!(units >= 4, "{units}");
}

/// The words of a shell command, with what its variables hold. Those without quotes may be empty, and are left out.
fn shell_words(line: &str) -> Vec<String> {
    let line = line.trim().trim_end_matches('&').trim();
    line.split(' ').filter(|word| !word.starts_with("${")).map(|word| held(word.trim_matches('"'))).collect()
}

/// A word in which each variable is replaced by its default, by what it is known to hold, or by its own name.
fn held(word: &str) -> String {
    let Some((before, rest)) = word.split_once('$') else { return word.to_owned() };
    let (name, after) = match rest.strip_prefix(['{', '(']) {
        Some(inner) => inner.split_once(['}', ')']).unwrap_or((inner, "")),
        None => {
            let end = rest.find(|c: char| !(c.is_ascii_alphanumeric() || c == '_')).unwrap_or(rest.len());
            rest.split_at(end)
        }
    };
    let (name, default) = name.split_once(":-").unwrap_or((name, ""));
    let known = VARIABLES.iter().find(|(variable, _)| *variable == name).map(|(_, value)| *value);
    let value = known.unwrap_or(if default.is_empty() { name } else { default });
    format!("{before}{value}{}", held(after))
}

/// The command lines of a file that are run, without the program's name.
fn run_in(name: &str, text: &str) -> Vec<Vec<String>> {
    let mut found = Vec::new();
    if name.starts_with("kubernetes/") {
        for template in documents(name, text).iter().filter_map(pods) {
            for container in list_at(name, template, "/spec/containers") {
                found.push(words_of(list_at(name, container, "/args")));
            }
        }
    } else if name.starts_with("compose") {
        let services = documents(name, text)[0]["services"].as_object().cloned().unwrap_or_default();
        for service in services.values().filter(|service| service.get("build").is_some()) {
            found.extend(service["command"].as_array().map(|words| words_of(words)));
        }
    } else if name == "Containerfile" {
        let command = text.lines().find_map(|line| line.strip_prefix("CMD ")).expect("a command");
        found.push(serde_json::from_str(command).expect("a list of words"));
    } else if name.ends_with(".service") {
        let command = text.lines().find_map(|line| line.strip_prefix("ExecStart=")?.strip_prefix(INSTALLED));
        let command = command.unwrap_or_else(|| panic!("{name} starts nothing"));
        // As the comment at its top shows them.
        let flags =
            text.split_once("'FLAGS=").and_then(|(_, rest)| rest.split_once('\'')).map_or("", |(f, _)| f);
        found.push(shell_words(&command.replace("%i", "night").replace("$FLAGS", flags)));
    } else if name.ends_with(".sbatch") {
        let commands = text.lines().filter_map(|line| line.trim().strip_prefix("segwild "));
        found.extend(commands.map(shell_words));
    } else if name == "carry" {
        let commands = text.lines().filter_map(|line| line.split_once("$here/segwild\" "));
        found.extend(commands.map(|(_, line)| shell_words(&line.replace("\"$@\"", ""))));
    }
    found
}

/// The command lines that comments and messages of a file name, in backquotes.
fn named_in(text: &str) -> Vec<Vec<String>> {
    let quoted = text.lines().flat_map(|line| line.split('`').skip(1).step_by(2));
    let commands = quoted.filter_map(|part| {
        part.split_once("segwild ")
            .filter(|(before, _)| before.trim().is_empty() || before.ends_with("run --rm "))
    });
    commands.map(|(_, command)| command.split_whitespace().map(str::to_owned).collect()).collect()
}

#[test]
fn every_command_line_of_deploy_is_one_of_the_program() {
    let (mut run, mut named) = (0, 0);
    for (name, text) in files() {
        for words in run_in(&name, &text) {
            let line: Vec<String> = std::iter::once("segwild".to_owned()).chain(words).collect();
            if let Err(error) = program().try_get_matches_from(&line) {
                panic!("deploy/{name}: `{}`: {error}", line.join(" "));
            }
            run += 1;
        }
        for words in named_in(&text) {
            let line: Vec<String> = std::iter::once("segwild".to_owned()).chain(words).collect();
            if let Err(error) = program().try_get_matches_from(&line) {
                // What is named without its arguments is named all the same.
                let named_alone = error.kind() == ErrorKind::MissingRequiredArgument;
                assert!(named_alone, "deploy/{name}: `{}`: {error}", line.join(" "));
            }
            named += 1;
        }
    }
    assert!(run >= 14 && named >= 5, "{run} are run, {named} are named");
}

#[test]
fn yaml_is_read_as_it_is_meant_and_what_is_unknown_is_refused() {
    let text = "# a comment\na: &x\n  b: [1, \"two, #2\", { c: 'it''s' }] # another\n  d: it's # this\ne:\n- f: 0440\n  g:\n    - *x\n\
                h: { <<: 1 }\ni:\n  <<: *x\n  d: \"\\\"o\"\nj: |\n  k: v # text\n   more\n---\nl: -1.5\n";
    let read = yaml::documents(text).expect("it is YAML");
    let x = serde_json::json!({ "b": [1, "two, #2", { "c": "it's" }], "d": "it's" });
    assert_eq!(read[0]["a"], x);
    assert_eq!(read[0]["e"], serde_json::json!([{ "f": "0440", "g": [x] }]));
    assert_eq!((&read[0]["i"]["b"], &read[0]["i"]["d"]), (&x["b"], &"\"o".into()));
    assert_eq!(read[0]["j"], "k: v # text\n more");
    assert_eq!(read[1], serde_json::json!({ "l": -1.5 }));
    for (text, reason) in [
        ("a: 1\n a: 2", "line 2: `a: 2` is indented too far"),
        ("a: 1\na: 2", "twice"),
        ("a: {b: 1", "missing"),
        ("a: \"b", "not closed"),
        ("a: *b", "&b"),
        ("a: b: c", "quotes"),
        ("a\n", "no key"),
        ("a:\n\tb: 1", "tab"),
        ("- a\nb: 1", "belongs to nothing"),
    ] {
        let refused = yaml::documents(text).expect_err(text);
        assert!(refused.contains(reason), "{text}: {refused}");
    }
}
