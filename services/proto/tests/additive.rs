//! Messages change by additions only: what the last release had is still there, under its number and of its type.
//!
//! `proto/released.txt` has one line for each field, value and call. At a release, `SEGWILD_RELEASE=1 cargo test -p segwild-proto`
//! writes it again.

use prost::Message;
use prost_types::{DescriptorProto, EnumDescriptorProto, FileDescriptorProto, FileDescriptorSet};
use std::collections::BTreeSet;
use std::path::PathBuf;

/// A line for each field, value and call.
fn lines(files: &FileDescriptorSet) -> BTreeSet<String> {
    let mut lines = BTreeSet::new();
    for file in &files.file {
        let FileDescriptorProto { message_type, enum_type, service, .. } = file;
        for message in message_type {
            of_message(file.package(), message, &mut lines);
        }
        for values in enum_type {
            of_enum(file.package(), values, &mut lines);
        }
        for service in service {
            for call in &service.method {
                let streamed = |is: bool| if is { "stream " } else { "" };
                lines.insert(format!(
                    "call {}.{}.{}: {}{} -> {}{}",
                    file.package(),
                    service.name(),
                    call.name(),
                    streamed(call.client_streaming()),
                    call.input_type(),
                    streamed(call.server_streaming()),
                    call.output_type()
                ));
            }
        }
    }
    lines
}

fn of_message(scope: &str, message: &DescriptorProto, lines: &mut BTreeSet<String>) {
    let name = format!("{scope}.{}", message.name());
    for field in &message.field {
        let choice = field.oneof_index.map_or("", |_| " of a choice");
        lines.insert(format!(
            "field {name} {}: {} {:?} {:?} {}{choice}",
            field.number(),
            field.name(),
            field.label(),
            field.r#type(),
            field.type_name()
        ));
    }
    for nested in &message.nested_type {
        of_message(&name, nested, lines);
    }
    for values in &message.enum_type {
        of_enum(&name, values, lines);
    }
}

fn of_enum(scope: &str, values: &EnumDescriptorProto, lines: &mut BTreeSet<String>) {
    for value in &values.value {
        lines.insert(format!("value {scope}.{} {}: {}", values.name(), value.number(), value.name()));
    }
}

fn released() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../proto/released.txt")
}

fn descriptors() -> FileDescriptorSet {
    FileDescriptorSet::decode(segwild_proto::DESCRIPTORS).expect("the build wrote them")
}

#[test]
fn what_was_released_is_still_there() {
    let now = lines(&descriptors());
    if std::env::var_os("SEGWILD_RELEASE").is_some() {
        let text: String = now.iter().map(|line| format!("{}\n", line.trim_end())).collect();
        std::fs::write(released(), text).expect("proto/ is writable");
    }
    let now: BTreeSet<&str> = now.iter().map(|line| line.trim_end()).collect();
    let text = std::fs::read_to_string(released()).expect("it is in the repository");
    assert!(text.lines().count() > 20, "it has lost its lines");
    let lost: Vec<&str> = text.lines().filter(|line| !now.contains(line)).collect();
    assert!(lost.is_empty(), "clients of the last release need these: {lost:#?}");
}

#[test]
fn a_field_that_is_renumbered_retyped_or_removed_is_noticed() {
    let all = lines(&descriptors());
    let changed = |change: fn(&mut DescriptorProto)| {
        let mut set = descriptors();
        let message = set.file.iter_mut().flat_map(|f| &mut f.message_type).find(|m| m.name() == "Mask");
        change(message.expect("there are masks"));
        all.difference(&lines(&set)).count()
    };
    assert_eq!(changed(|m| m.field[0].number = Some(9)), 1);
    assert_eq!(changed(|m| m.field[0].set_type(prost_types::field_descriptor_proto::Type::String)), 1);
    assert_eq!(changed(|m| drop(m.field.pop())), 1);
    assert_eq!(changed(|m| m.field.push(Default::default())), 0, "an addition is none");
}
