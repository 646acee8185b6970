//! What the files of `proto/` describe, with their comments.

use prost::Message;
use prost_types::{
    DescriptorProto, EnumDescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet,
};
use std::collections::{BTreeMap, HashMap};

/// The package of all messages.
const PACKAGE: &str = ".segwild.v1.";

/// Numbers of the lists of `descriptor.proto`: they lead to the comments.
const MESSAGES: i32 = 4;
const SERVICES: i32 = 6;
const FIELDS: i32 = 2;
const NESTED: i32 = 3;
const CALLS: i32 = 2;

/// Comments of a file by the paths of what they are about.
type Comments = HashMap<Vec<i32>, String>;

/// A message with its comments.
pub(super) struct MessageForm {
    pub descriptor: DescriptorProto,
    pub about: String,
    /// Comments of the fields.
    abouts: Vec<String>,
}

/// A call with its comment, and the names of its messages.
pub(super) struct CallForm {
    pub about: String,
    pub request: String,
    pub answer: String,
}

/// The messages, enumerations and calls by their names without the package.
#[derive(Default)]
pub(super) struct ProtoFiles {
    messages: BTreeMap<String, MessageForm>,
    enums: BTreeMap<String, EnumDescriptorProto>,
    calls: BTreeMap<String, CallForm>,
}

/// A name without the package.
pub(super) fn short(name: &str) -> &str {
    name.strip_prefix(PACKAGE).unwrap_or(name)
}

/// A path one step further.
fn below(path: &[i32], list: i32, index: usize) -> Vec<i32> {
    let mut path = path.to_vec();
    path.extend([list, index as i32]);
    path
}

fn comments(file: &FileDescriptorProto) -> Comments {
    let locations = file.source_code_info.iter().flat_map(|info| &info.location);
    let text = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    locations
        .map(|l| (l.path.clone(), text(l.leading_comments())))
        .filter(|(_, text)| !text.is_empty())
        .collect()
}

impl MessageForm {
    /// A field and its comment.
    pub fn field(&self, name: &str) -> (&FieldDescriptorProto, &str) {
        let found = self.descriptor.field.iter().zip(&self.abouts).find(|(field, _)| field.name() == name);
        found
            .map(|(field, about)| (field, about.as_str()))
            .expect("the table of requests names fields that are there")
    }

    /// Its fields with their comments.
    pub fn fields(&self) -> impl Iterator<Item = (&FieldDescriptorProto, &str)> {
        self.descriptor.field.iter().zip(self.abouts.iter().map(String::as_str))
    }

    /// The name of its choice, if it has one. A field that may be missing is a choice of its own to Protobuf.
    pub fn choice(&self) -> Option<&str> {
        let (field, _) = self.cases().next()?;
        Some(self.descriptor.oneof_decl.get(field.oneof_index() as usize)?.name())
    }

    /// The cases of its choice.
    pub fn cases(&self) -> impl Iterator<Item = (&FieldDescriptorProto, &str)> {
        self.fields().filter(|(field, _)| field.oneof_index.is_some() && !field.proto3_optional())
    }
}

impl ProtoFiles {
    /// Reads them, with the calls of one service.
    pub fn read(service: &str) -> ProtoFiles {
        let set = FileDescriptorSet::decode(segwild_proto::DESCRIPTORS).expect("the build wrote them");
        let mut files = ProtoFiles::default();
        for file in &set.file {
            let comments = comments(file);
            for (i, message) in file.message_type.iter().enumerate() {
                files.add(message.name(), message, &below(&[], MESSAGES, i), &comments);
            }
            for values in &file.enum_type {
                files.enums.insert(values.name().to_owned(), values.clone());
            }
            for (i, of_file) in file.service.iter().enumerate().filter(|(_, s)| s.name() == service) {
                for (k, call) in of_file.method.iter().enumerate() {
                    let about = comments.get(&below(&below(&[], SERVICES, i), CALLS, k)).cloned();
                    let form = CallForm {
                        about: about.unwrap_or_default(),
                        request: short(call.input_type()).to_owned(),
                        answer: short(call.output_type()).to_owned(),
                    };
                    files.calls.insert(call.name().to_owned(), form);
                }
            }
        }
        files
    }

    /// Adds a message and those inside it.
    fn add(&mut self, name: &str, message: &DescriptorProto, path: &[i32], comments: &Comments) {
        let about = |path: &[i32]| comments.get(path).cloned().unwrap_or_default();
        let abouts = (0..message.field.len()).map(|k| about(&below(path, FIELDS, k))).collect();
        for (k, inner) in message.nested_type.iter().enumerate() {
            self.add(&format!("{name}.{}", inner.name()), inner, &below(path, NESTED, k), comments);
        }
        let form = MessageForm { descriptor: message.clone(), about: about(path), abouts };
        self.messages.insert(name.to_owned(), form);
    }

    /// A message.
    pub fn message(&self, name: &str) -> &MessageForm {
        self.messages.get(name).expect("the descriptors are whole")
    }

    /// A call.
    pub fn call(&self, name: &str) -> &CallForm {
        self.calls.get(name).expect("the table of requests names calls that are there")
    }

    /// The names of all calls.
    #[cfg(test)]
    pub fn calls(&self) -> impl Iterator<Item = &str> {
        self.calls.keys().map(String::as_str)
    }

    /// The field of the values, where a field is a map.
    pub fn map_value(&self, field: &FieldDescriptorProto) -> Option<&FieldDescriptorProto> {
        let entry = &self.messages.get(short(field.type_name()))?.descriptor;
        entry.options.as_ref().filter(|options| options.map_entry())?;
        entry.field.get(1)
    }

    /// The values of an enumeration as JSON writes them.
    pub fn words(&self, name: &str) -> Vec<String> {
        let values = &self.enums.get(name).expect("the descriptors are whole").value;
        let prefix =
            values.first().and_then(|none| none.name().strip_suffix("UNSPECIFIED")).unwrap_or_default();
        let word = |name: &str| name.strip_prefix(prefix).unwrap_or(name).to_lowercase();
        values.iter().skip(1).map(|value| word(value.name())).collect()
    }
}
