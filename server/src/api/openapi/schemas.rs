//! JSON Schemas of the messages, as the proto3 JSON mapping writes them, with the comments of their files.

use std::collections::BTreeMap;

use prost_types::{
    DescriptorProto, EnumValueDescriptorProto, FieldDescriptorProto, FileDescriptorProto,
    FileDescriptorSet,
    field_descriptor_proto::{Label, Type},
};
use serde_json::{Value as Json, json};

use super::requirements::{self, add};

/// The package whose messages are described.
const PACKAGE: &str = ".gatsbi.v1.";

/// What base64 looks like, for readers that do not know `contentEncoding`; padding may be left out.
const BASE64: &str = "^(?:[A-Za-z0-9+/]{4})*(?:[A-Za-z0-9+/]{2}={0,2}|[A-Za-z0-9+/]{3}=?)?$";

/// Field numbers of descriptors, of which paths of comments consist.
const MESSAGE: i32 = 4;
const ENUM: i32 = 5;
const SERVICE: i32 = 6;
const FIELD_OR_VALUE: i32 = 2;

/// The messages of the package.
pub(super) struct Schemas<'a> {
    files: &'a FileDescriptorSet,
    /// Comments by file and path.
    comments: BTreeMap<(usize, Vec<i32>), String>,
}

/// A method of a service.
pub(super) struct Rpc {
    pub(super) summary: String,
    pub(super) input: String,
    pub(super) output: String,
}

/// A reference to the schema of a message or an enumeration.
pub(super) fn reference(full_name: &str) -> Json {
    match full_name {
        ".google.protobuf.Duration" => json!({
            "type": "string",
            "pattern": r"^[0-9]{1,9}(\.[0-9]{1,9})?s$",
        }),
        ".google.protobuf.Timestamp" => json!({ "type": "string", "format": "date-time" }),
        _ => {
            let name = full_name.trim_start_matches(PACKAGE);
            json!({ "$ref": format!("#/components/schemas/{name}") })
        }
    }
}

impl<'a> Schemas<'a> {
    pub(super) fn new(files: &'a FileDescriptorSet) -> Self {
        let mut comments = BTreeMap::new();
        for (at, file) in files.file.iter().enumerate() {
            for location in file.source_code_info.iter().flat_map(|info| &info.location) {
                if let Some(comment) = &location.leading_comments {
                    comments.insert((at, location.path.clone()), in_one_line(comment));
                }
            }
        }
        Self { files, comments }
    }

    /// A method by name.
    pub(super) fn rpc(&self, service: &str, method: &str) -> Rpc {
        for (at, file) in self.ours() {
            for (service_at, described) in file.service.iter().enumerate() {
                if described.name() != service {
                    continue;
                }
                let found = described.method.iter().position(|known| known.name() == method);
                let method_at = found.expect("operations name methods of their services");
                let path = vec![SERVICE, service_at as i32, FIELD_OR_VALUE, method_at as i32];
                let summary = self.comments.get(&(at, path)).cloned().unwrap_or_default();
                // Where it is found on REST is said by the document itself.
                let summary = summary.split(" REST:").next().unwrap_or_default().to_owned();
                let method = &described.method[method_at];
                let (input, output) = (method.input_type(), method.output_type());
                return Rpc { summary, input: input.to_owned(), output: output.to_owned() };
            }
        }
        unreachable!("operations name services of the package")
    }

    /// What is said about a message or an enumeration.
    pub(super) fn comment(&self, full_name: &str) -> String {
        let name = full_name.trim_start_matches(PACKAGE);
        for (at, file) in self.ours() {
            let message = file.message_type.iter().position(|known| known.name() == name);
            let kind = file.enum_type.iter().position(|known| known.name() == name);
            let path = match (message, kind) {
                (Some(message), _) => vec![MESSAGE, message as i32],
                (None, Some(kind)) => vec![ENUM, kind as i32],
                (None, None) => continue,
            };
            return self.comments.get(&(at, path)).cloned().unwrap_or_default();
        }
        String::new()
    }

    /// The schemas of all messages and enumerations that travel on REST.
    pub(super) fn into_components(self) -> Json {
        let mut components = serde_json::Map::new();
        for (at, file) in self.ours() {
            if file.service.iter().any(|service| service.name() == "AdminService") {
                continue;
            }
            for (message_at, message) in file.message_type.iter().enumerate() {
                let path = vec![MESSAGE, message_at as i32];
                components.insert(message.name().to_owned(), self.message(at, &path, message));
            }
            for (enum_at, kind) in file.enum_type.iter().enumerate() {
                let names: Vec<&str> =
                    kind.value.iter().map(EnumValueDescriptorProto::name).collect();
                let about = |value_at: usize| {
                    let path = vec![ENUM, enum_at as i32, FIELD_OR_VALUE, value_at as i32];
                    self.comments.get(&(at, path)).map_or("", String::as_str)
                };
                let values: Vec<String> = names
                    .iter()
                    .enumerate()
                    .map(|(value_at, name)| format!("- {name}: {}", about(value_at)))
                    .collect();
                let comment = self.comment(&format!("{PACKAGE}{}", kind.name()));
                let description = format!("{comment}\n\n{}", values.join("\n"));
                let schema = json!({ "type": "string", "enum": names, "description": description });
                components.insert(kind.name().to_owned(), schema);
            }
        }
        Json::Object(components)
    }

    fn message(&self, at: usize, path: &[i32], message: &DescriptorProto) -> Json {
        let required = requirements::required(message.name());
        let mut properties = serde_json::Map::new();
        for (field_at, field) in message.field.iter().enumerate() {
            let path = [path, &[FIELD_OR_VALUE, field_at as i32]].concat();
            let schema = self::field(field);
            let mut schema =
                if required.contains(&field.name()) { schema } else { or_null(schema) };
            add(&mut schema, requirements::field(message.name(), field.name()));
            if let Some(comment) = self.comments.get(&(at, path)) {
                schema["description"] = json!(comment);
            }
            properties.insert(field.name().to_owned(), schema);
        }
        let mut schema = json!({
            "type": "object",
            "description": self.comments.get(&(at, path.to_vec())).map_or("", String::as_str),
            "properties": properties,
            "additionalProperties": false,
        });
        if !required.is_empty() {
            schema["required"] = json!(required);
        }
        if let Some(choice) = choice(message) {
            schema["oneOf"] = choice;
        }
        add(&mut schema, requirements::whole(message.name()));
        schema
    }

    /// The files of the package.
    fn ours(&self) -> impl Iterator<Item = (usize, &'a FileDescriptorProto)> + use<'a> {
        let package = PACKAGE.trim_matches('.');
        self.files.file.iter().enumerate().filter(move |(_, file)| file.package() == package)
    }
}

/// The members of a oneof, of which a message has one at most: the others are absent or null.
fn choice(message: &DescriptorProto) -> Option<Json> {
    let members: Vec<&FieldDescriptorProto> = message
        .field
        .iter()
        .filter(|field| field.oneof_index.is_some() && !field.proto3_optional())
        .collect();
    if members.is_empty() {
        return None;
    }
    let only = |chosen: Option<&str>| {
        let null = members.iter().map(|member| (member.name(), json!({ "type": "null" })));
        let mut properties: BTreeMap<&str, Json> = null.collect();
        let Some(chosen) = chosen else { return json!({ "properties": properties }) };
        properties.insert(chosen, json!({ "not": { "type": "null" } }));
        json!({ "required": [chosen], "properties": properties })
    };
    let mut choices: Vec<Json> = members.iter().map(|member| only(Some(member.name()))).collect();
    if !requirements::needs_a_choice(message.name()) {
        choices.push(only(None));
    }
    Some(json!(choices))
}

/// The schema of a field.
fn field(field: &FieldDescriptorProto) -> Json {
    let one = match field.r#type() {
        Type::Message | Type::Enum => reference(field.type_name()),
        Type::Double => json!({ "type": "number", "format": "double" }),
        Type::Float => {
            json!({ "type": "number", "format": "float", "minimum": f32::MIN, "maximum": f32::MAX })
        }
        Type::Int32 => {
            json!({ "type": "integer", "format": "int32", "minimum": i32::MIN, "maximum": i32::MAX })
        }
        Type::Uint32 => {
            json!({ "type": "integer", "format": "uint32", "minimum": 0, "maximum": u32::MAX })
        }
        Type::Uint64 => {
            json!({ "type": "integer", "format": "uint64", "minimum": 0, "maximum": u64::MAX })
        }
        Type::Bool => json!({ "type": "boolean" }),
        Type::Bytes => {
            json!({ "type": "string", "contentEncoding": "base64", "pattern": BASE64 })
        }
        Type::String => json!({ "type": "string" }),
        other => unreachable!("no message has a field of type {other:?}"),
    };
    match field.label() {
        Label::Repeated => json!({ "type": "array", "items": one }),
        _ => one,
    }
}

/// The schema of a field, which may be null instead of absent.
fn or_null(mut schema: Json) -> Json {
    match schema["type"].take() {
        Json::String(kind) => {
            schema["type"] = json!([kind, "null"]);
            schema
        }
        _ => json!({ "anyOf": [{ "$ref": schema["$ref"] }, { "type": "null" }] }),
    }
}

/// A comment without its line breaks.
fn in_one_line(comment: &str) -> String {
    comment.lines().map(str::trim).collect::<Vec<_>>().join(" ").trim().to_owned()
}
