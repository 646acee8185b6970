//! The OpenAPI page: its paths are the router's own table, its messages those of `proto/segwild/v1/session.proto`.
//!
//! How JSON differs from Protobuf's own form of it is written at the top of that file.

use crate::routes::{API, ApiAnswer, ApiMethod, ApiRoute, ROOT};
use descriptors::{MessageForm, ProtoFiles};
use prost_types::FieldDescriptorProto;
use prost_types::field_descriptor_proto::{Label, Type};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

mod descriptors;

/// The service whose calls the requests are.
const SERVICE: &str = "Session";

/// Messages that JSON writes as arrays, and the schema of a number in them.
const ARRAYS: [(&str, &str); 2] = [("Pair", "number"), ("Rgb", "integer")];

/// The name of a `oneof` whose cases are keys of their values.
const BY_KEY: &str = "case";

/// Schemas of messages, made as they are needed.
struct Schemas<'a> {
    files: &'a ProtoFiles,
    made: BTreeMap<String, Value>,
    /// Whether the messages are parts of requests: what is missing there has its default.
    requests: bool,
}

/// All requests of the server as an OpenAPI document.
pub fn openapi() -> Value {
    let files = ProtoFiles::read(SERVICE);
    let mut schemas = Schemas { files: &files, made: BTreeMap::new(), requests: true };
    // Requests first: a message of both is a request's, which requires less.
    let bodies: Vec<Option<Value>> = API.iter().map(|route| schemas.body(route)).collect();
    schemas.requests = false;
    let mut paths: BTreeMap<String, Map<String, Value>> = BTreeMap::new();
    for (route, body) in API.iter().zip(bodies) {
        let method = if route.method == ApiMethod::Get { "get" } else { "post" };
        let operation = schemas.operation(route, body);
        paths.entry(format!("{ROOT}{}", route.path)).or_default().insert(method.into(), operation);
    }
    let error = json!({
        "type": "object",
        "description": "Why a request is refused.",
        "properties": { "error": { "type": "string", "description": "A sentence." } },
        "required": ["error"],
    });
    schemas.made.insert("Refusal".into(), error);
    json!({
        "openapi": "3.1.0",
        "info": {
            "title": "segwild studio",
            "version": env!("CARGO_PKG_VERSION"),
            "description": "All that the page of `segwild serve` does. The same port answers the same calls as gRPC: \
                            proto/segwild/v1/session.proto. This file is generated: `segwild doctor --openapi`.",
        },
        "servers": [{ "url": "http://127.0.0.1:7777" }],
        "security": [{ "token": [] }],
        "paths": paths,
        "components": {
            "securitySchemes": {
                "token": {
                    "type": "http",
                    "scheme": "bearer",
                    "description": "The token of the address that `segwild serve` prints.",
                },
            },
            "schemas": schemas.made,
        },
    })
}

/// Names of the fields of a request that are in its path.
fn in_path(path: &str) -> Vec<&str> {
    path.split('{').skip(1).filter_map(|part| part.split('}').next()).collect()
}

/// Whether a request waits for the session of a run.
fn waits(route: &ApiRoute) -> bool {
    route.path.starts_with("/runs/{run}") && !route.path.contains("/train")
}

fn described(mut schema: Value, about: &str) -> Value {
    if let (Value::Object(schema), false) = (&mut schema, about.is_empty()) {
        schema.insert("description".into(), about.into());
    }
    schema
}

fn nullable(schema: Value) -> Value {
    json!({ "anyOf": [schema, { "type": "null" }] })
}

impl Schemas<'_> {
    /// What a request's body holds: what is neither in its path nor in its query.
    fn body(&mut self, route: &ApiRoute) -> Option<Value> {
        let name = &self.files.call(route.call).request;
        let path = in_path(route.path);
        let message = self.files.message(name);
        let rest = message.descriptor.field.iter().any(|field| !path.contains(&field.name()));
        if route.method == ApiMethod::Get || !rest {
            return None;
        }
        let schema = self.form(message, &path);
        self.made.insert(name.clone(), schema);
        Some(json!({
            "required": true,
            "content": { "application/json": { "schema": reference(name) } },
        }))
    }

    fn operation(&mut self, route: &ApiRoute, body: Option<Value>) -> Value {
        let call = self.files.call(route.call);
        let message = self.files.message(&call.request);
        let path = in_path(route.path);
        let parameter = |name: &&str| {
            let (field, about) = message.field(name);
            json!({
                "name": name,
                "in": if path.contains(name) { "path" } else { "query" },
                "required": path.contains(name),
                "description": about,
                "schema": scalar(field),
            })
        };
        let parameters: Vec<Value> = path.iter().chain(route.query).map(parameter).collect();
        let mut responses = json!({
            "200": { "description": "The answer.", "content": self.content(route) },
            "default": {
                "description": "A refusal. 400: the request makes no sense; 401 and 403: the client has no access; 404: there is \
                                no such thing; 409: the request does not fit the present objects; 429: too many requests, and \
                                `Retry-After` has the seconds to wait; 503: it cannot be opened or read now.",
                "content": { "application/json": { "schema": reference("Refusal") } },
            },
        });
        if waits(route) {
            let entry = self.message("RunEntry");
            responses["202"] = json!({
                "description": "The run is being loaded or trained: the same request is answered later.",
                "content": { "application/json": { "schema": entry } },
            });
        }
        // Several requests of one call differ in the last part of their paths.
        let several = API.iter().filter(|other| other.call == route.call).count() > 1;
        let last = route.path.rsplit('/').next().filter(|_| several);
        let mut operation = json!({
            "operationId": last.map_or(route.call.to_owned(), |last| format!("{}_{last}", route.call)),
            "summary": call.about,
            "parameters": parameters,
            "responses": responses,
        });
        if let Some(body) = body {
            operation["requestBody"] = body;
        }
        operation
    }

    /// What a request is answered with.
    fn content(&mut self, route: &ApiRoute) -> Value {
        let name = &self.files.call(route.call).answer;
        match route.answer {
            ApiAnswer::Message => json!({ "application/json": { "schema": self.message(name) } }),
            ApiAnswer::Field(field) => {
                let (field, about) = self.files.message(name).field(field);
                json!({ "application/json": { "schema": self.field(field, about) } })
            }
            ApiAnswer::Events => {
                self.message(name);
                let about = format!("Events named `state`; the data of each is a {name} as JSON.");
                json!({ "text/event-stream": { "schema": { "type": "string", "description": about } } })
            }
            ApiAnswer::File(media) => {
                json!({ media: { "schema": { "type": "string", "format": "binary" } } })
            }
        }
    }

    /// A message by its name; its schema is made if it is not there.
    fn message(&mut self, name: &str) -> Value {
        if !self.made.contains_key(name) {
            let files = self.files;
            let schema = self.form(files.message(name), &[]);
            self.made.insert(name.into(), schema);
        }
        reference(name)
    }

    /// The schema of a message without some of its fields.
    fn form(&mut self, message: &MessageForm, without: &[&str]) -> Value {
        let fields = &message.descriptor.field;
        if let Some((_, number)) = ARRAYS.iter().find(|(name, _)| *name == message.descriptor.name()) {
            let (items, n) = (json!({ "type": number }), fields.len());
            let array = json!({ "type": "array", "items": items, "minItems": n, "maxItems": n });
            return described(array, &message.about);
        }
        if let Some(choice) = message.choice() {
            let cases: Vec<Value> =
                message.cases().map(|(field, about)| self.case(choice, field, about)).collect();
            return described(json!({ "oneOf": cases }), &message.about);
        }
        let mut properties = Map::new();
        let mut required = Vec::new();
        for (field, about) in message.fields().filter(|(field, _)| !without.contains(&field.name())) {
            properties.insert(field.name().into(), self.field(field, about));
            if !self.requests && !field.proto3_optional() {
                required.push(field.name());
            }
        }
        let mut schema = json!({ "type": "object", "properties": properties });
        if !required.is_empty() {
            schema["required"] = json!(required);
        }
        described(schema, &message.about)
    }

    /// One case of a choice: a word beside its fields, or a key before its value.
    fn case(&mut self, choice: &str, field: &FieldDescriptorProto, about: &str) -> Value {
        let name = field.name();
        if choice != BY_KEY {
            let word = json!({
                "type": "object",
                "properties": { choice: { "const": name } },
                "required": [choice],
            });
            return described(json!({ "allOf": [self.one(field), word] }), about);
        }
        let empty =
            field.r#type() == Type::Message && self.files.message(type_of(field)).descriptor.field.is_empty();
        let schema = match empty {
            true => json!({ "const": name }),
            false => json!({
                "type": "object",
                "properties": { name: self.one(field) },
                "required": [name],
            }),
        };
        described(schema, about)
    }

    fn field(&mut self, field: &FieldDescriptorProto, about: &str) -> Value {
        let schema = match self.files.map_value(field) {
            Some(value) => json!({ "type": "object", "additionalProperties": self.one(value) }),
            None if field.label() == Label::Repeated => json!({ "type": "array", "items": self.one(field) }),
            None if field.proto3_optional() => nullable(self.one(field)),
            None => self.one(field),
        };
        described(schema, about)
    }

    /// One value of a field.
    fn one(&mut self, field: &FieldDescriptorProto) -> Value {
        match field.r#type() {
            Type::Message => self.message(type_of(field)),
            Type::Enum => json!({ "type": "string", "enum": self.files.words(type_of(field)) }),
            _ => scalar(field),
        }
    }
}

/// The name of a field's message or enumeration, without the package.
fn type_of(field: &FieldDescriptorProto) -> &str {
    descriptors::short(field.type_name())
}

fn reference(name: &str) -> Value {
    json!({ "$ref": format!("#/components/schemas/{name}") })
}

/// The schema of a field that is no message.
fn scalar(field: &FieldDescriptorProto) -> Value {
    match field.r#type() {
        Type::Double | Type::Float => json!({ "type": "number" }),
        Type::Bool => json!({ "type": "boolean" }),
        Type::String | Type::Bytes => json!({ "type": "string" }),
        Type::Uint32 | Type::Uint64 => json!({ "type": "integer", "minimum": 0 }),
        _ => json!({ "type": "integer" }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    /// Calls `visit` with a value and all values inside it.
    fn walk(value: &Value, visit: &mut impl FnMut(&Value)) {
        visit(value);
        match value {
            Value::Object(map) => map.values().for_each(|inner| walk(inner, visit)),
            Value::Array(all) => all.iter().for_each(|inner| walk(inner, visit)),
            _ => {}
        }
    }

    #[test]
    fn every_call_is_a_request_and_every_request_a_call() {
        let files = ProtoFiles::read(SERVICE);
        let calls: BTreeSet<&str> = files.calls().collect();
        let requests: BTreeSet<&str> = API.iter().map(|route| route.call).collect();
        assert_eq!(requests, calls);
    }

    #[test]
    fn every_reference_leads_to_a_schema_and_every_schema_is_described() {
        let page = openapi();
        let schemas = page["components"]["schemas"].as_object().unwrap();
        let mut references = 0;
        walk(&page, &mut |value: &Value| {
            let Some(name) = value.get("$ref").and_then(Value::as_str) else { return };
            assert!(schemas.contains_key(name.strip_prefix("#/components/schemas/").unwrap()), "{name}");
            references += 1;
        });
        assert!(references > 50, "{references}");
        for (name, schema) in schemas {
            assert!(schema["description"].is_string(), "{name}");
            for (field, property) in schema["properties"].as_object().into_iter().flatten() {
                assert!(property["description"].is_string(), "{name}.{field}");
            }
        }
    }

    #[test]
    fn choices_are_words_beside_their_fields_or_keys_before_their_values() {
        let page = openapi();
        let case = |schema: &str, n: usize| page["components"]["schemas"][schema]["oneOf"][n].clone();
        assert_eq!(case("ActRequest", 0)["allOf"][1]["properties"]["do"]["const"], "prompt");
        assert_eq!(case("ActRequest", 0)["allOf"][0]["$ref"], "#/components/schemas/ActRequest.Prompt");
        assert_eq!(case("AnswerStep", 0)["const"], "tree");
        assert_eq!(case("AnswerStep", 2)["properties"]["photos"]["type"], "integer");
        let how = &page["components"]["schemas"]["ActRequest.Combine"]["properties"]["how"]["enum"];
        assert_eq!(*how, json!(["add", "subtract", "intersect"]));
    }
}
