//! The REST API as an OpenAPI 3.1 document, made from the messages and their comments.
//!
//! What paths there are is said in [`operations`] and [`showings`]; what travels on them are the messages of the wire,
//! whose schemas come from [`schemas`], and what is made for people to look at. The document is checked in (`server/openapi.json`), so that every change of the API is seen.

mod operations;
mod requirements;
mod schemas;
mod showings;

use std::sync::LazyLock;

use gatsbi_proto::v1::FILE_DESCRIPTOR_SET;
use prost::Message as _;
use prost_types::FileDescriptorSet;
use serde_json::{Value as Json, json};

use self::{
    operations::{Body, OPERATIONS, Operation},
    schemas::{Schemas, reference},
    showings::SHOWINGS,
};

/// The document.
pub static DOCUMENT: LazyLock<Json> = LazyLock::new(|| {
    let files = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET);
    document(&files.expect("the descriptors are those of this build"))
});

const JSON: &str = "application/json";
const LINES: &str = "application/x-ndjson";
const OCTETS: &str = "application/octet-stream";
const PROBLEM: &str = "application/problem+json";
const PROTOBUF: &str = "application/x-protobuf";

fn document(files: &FileDescriptorSet) -> Json {
    let mut schemas = Schemas::new(files);
    let mut paths = serde_json::Map::new();
    for operation in OPERATIONS {
        let described = describe(operation, &mut schemas);
        let path = paths.entry(operation.path).or_insert_with(|| json!({}));
        path[operation.method] = described;
    }
    for showing in SHOWINGS {
        let path = paths.entry(showing.path).or_insert_with(|| json!({}));
        path[showing.method] = showings::describe(showing);
    }
    let mut components = schemas.into_components();
    components["ProblemDetails"] = problem();
    json!({
        "openapi": "3.1.0",
        "info": {
            "title": "gatsbi",
            "version": "v1",
            "summary": "World models for robot agents: observe, imagine, compare.",
            "description": "The same use cases as the gRPC package gatsbi.v1, with its messages as JSON: fields have \
                the names of the messages, 64-bit integers are numbers, bytes are base64, enum values their full \
                names, and unknown fields are refused. Every path also understands and, asked for by Accept, gives \
                application/x-protobuf. Where the server has no keys, the header \
                Gatsbi-Tenant names who shares it with others.",
            "license": { "name": "Apache-2.0 OR MIT", "identifier": "Apache-2.0 OR MIT" },
        },
        "paths": paths,
        // Where the server was started with keys; without them none is needed.
        "security": [{}, { "key": [] }],
        "components": {
            "schemas": components,
            "securitySchemes": { "key": {
                "type": "http",
                "scheme": "bearer",
                "description": "A key that the operator made: Authorization: Bearer KEY.",
            } },
        },
    })
}

fn describe(operation: &Operation, schemas: &mut Schemas<'_>) -> Json {
    let (service, method) = operation.rpc;
    let rpc = schemas.rpc(service, method);
    let mut described = json!({
        "operationId": operation.id,
        "tags": [service],
        "summary": rpc.summary,
        "parameters": parameters(operation),
        "responses": {
            operation.status: {
                "description": schemas.comment(&rpc.output),
                "content": answer(operation, &rpc.output),
            },
            "default": problem_answer(),
        },
    });
    let message = || {
        let mut message = reference(&rpc.input);
        requirements::add(&mut message, requirements::body(operation.id));
        message
    };
    let content = match operation.body {
        Body::None => return described,
        Body::Message => json!({ JSON: { "schema": message() }, PROTOBUF: {} }),
        Body::Observation => json!({
            JSON: { "schema": message() },
            PROTOBUF: {},
            "multipart/form-data": { "schema": requirements::form() },
        }),
        Body::Snapshot => json!({ JSON: { "schema": message() }, PROTOBUF: {}, OCTETS: {} }),
        Body::Lines => {
            json!({ LINES: { "schema": lines(&message()) }, JSON: { "schema": message() } })
        }
    };
    described["requestBody"] = request_body(&rpc.input, &content);
    described
}

fn answer(operation: &Operation, output: &str) -> Json {
    let message = reference(output);
    match (operation.rpc.1, operation.body) {
        ("Imagine", _) => {
            let chunk = reference(".gatsbi.v1.RolloutChunk");
            let whole = json!({
                "type": "object",
                "properties": { "chunks": { "type": "array", "items": chunk } },
            });
            // What goes wrong on the way is the last line.
            let line = json!({ "anyOf": [message, problem_line()] });
            json!({ LINES: { "schema": lines(&line) }, JSON: { "schema": whole } })
        }
        (_, Body::Lines) => {
            let line = json!({ "anyOf": [message, problem_line()] });
            json!({ LINES: { "schema": lines(&line) } })
        }
        ("ExportSession", _) => {
            json!({ JSON: { "schema": message }, PROTOBUF: {}, OCTETS: {} })
        }
        _ => json!({ JSON: { "schema": message }, PROTOBUF: {} }),
    }
}

/// A body, which may be left out where the message may be empty.
fn request_body(message: &str, content: &Json) -> Json {
    let name = message.rsplit('.').next().unwrap_or_default();
    json!({ "content": content, "required": requirements::needs_anything(name) })
}

/// Lines, as an array of what each of them is: so `OpenAPI` 3.2 reads schemas of sequential media types.
fn lines(line: &Json) -> Json {
    json!({ "type": "array", "items": line })
}

/// The last line of an answer that ends too early.
fn problem_line() -> Json {
    json!({
        "type": "object",
        "required": ["problem"],
        "properties": { "problem": { "$ref": "#/components/schemas/ProblemDetails" } },
    })
}

fn parameters(operation: &Operation) -> Vec<Json> {
    path_parameters(operation.path).chain(query_parameters(operation.query)).collect()
}

fn path_parameters(path: &'static str) -> impl Iterator<Item = Json> {
    path.split('/').filter_map(|part| part.strip_prefix('{')).map(|part| {
        let name = part.trim_end_matches('}');
        let schema = match name {
            "id" => json!({ "type": "string", "pattern": "^[0-9a-f]{32}$" }),
            _ => json!({ "type": "string" }),
        };
        json!({ "name": name, "in": "path", "required": true, "schema": schema })
    })
}

fn query_parameters(query: &[(&str, &str, &str)]) -> impl Iterator<Item = Json> {
    query.iter().map(|(name, kind, about)| {
        let schema = requirements::parameter(name, kind);
        json!({ "name": name, "in": "query", "description": about, "schema": schema })
    })
}

fn problem_answer() -> Json {
    json!({
        "description": "What is wrong, in which field, and what was expected.",
        "content": { PROBLEM: { "schema": { "$ref": "#/components/schemas/ProblemDetails" } } },
    })
}

/// The document of an error (RFC 9457).
fn problem() -> Json {
    let text = |about: &str| json!({ "type": "string", "description": about });
    json!({
        "type": "object",
        "description": "What went wrong (RFC 9457).",
        "required": ["type", "title", "status", "detail", "reason"],
        "properties": {
            "type": text("A URN of the reason."),
            "title": text("The HTTP status in words."),
            "status": { "type": "integer", "description": "The HTTP status." },
            "detail": text("One sentence for people."),
            "reason": text("Stable name of the problem, such as STEP_GAP."),
            "fields": {
                "type": "array",
                "description": "The fields at fault.",
                "items": { "$ref": "#/components/schemas/FieldProblem" },
            },
            "expected_step": { "type": "integer", "description": "With STEP_GAP, the next step." },
            "retry_after_millis": {
                "type": "integer",
                "description": "When trying again may help: after how many milliseconds.",
            },
        },
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// Set, it writes what the test compares with.
    const UPDATE: &str = "GATSBI_UPDATE_OPENAPI";

    #[test]
    fn the_document_is_as_checked_in() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/openapi.json");
        let made = format!("{:#}\n", *DOCUMENT);
        if std::env::var_os(UPDATE).is_some() {
            fs_err::write(path, &made).unwrap();
        }
        let checked_in = fs_err::read_to_string(path).unwrap();
        assert!(made == checked_in, "the REST API has changed; {UPDATE}=1 writes {path} anew");
    }

    #[test]
    fn every_method_has_a_path_or_none_for_a_reason() {
        let files = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).unwrap();
        let mut methods = BTreeSet::new();
        for service in files.file.iter().flat_map(|file| &file.service) {
            if service.name() != "AdminService" {
                methods.extend(service.method.iter().map(|method| method.name().to_owned()));
            }
        }
        let names: BTreeSet<&str> = OPERATIONS.iter().map(|operation| operation.id).collect();
        assert_eq!(names.len(), OPERATIONS.len(), "names are unique");
        let described: BTreeSet<String> =
            OPERATIONS.iter().map(|operation| operation.rpc.1.to_owned()).collect();
        // A control loop needs a stream both ways, and handles are for programs.
        let missing: Vec<&String> = methods.difference(&described).collect();
        assert_eq!(missing, ["CloseHandles", "ObserveStream", "OpenHandles", "StepHandles"]);
        assert!(described.is_subset(&methods));
    }

    #[test]
    fn every_oneof_and_every_required_field_is_one_of_the_messages() {
        let components = DOCUMENT["components"]["schemas"].as_object().unwrap();
        for (name, schema) in components {
            let properties = schema["properties"].as_object();
            for required in schema["required"].as_array().into_iter().flatten() {
                assert!(properties.unwrap().contains_key(required.as_str().unwrap()), "{name}");
            }
            let (choices, needed) =
                (schema["oneOf"].as_array(), requirements::needs_a_choice(name));
            assert!(!needed || choices.is_some(), "{name}");
        }
        assert_eq!(components["Subject"]["oneOf"].as_array().unwrap().len(), 3);
        assert_eq!(components["WarmStart"]["oneOf"].as_array().unwrap().len(), 3, "or nothing");
    }

    #[test]
    fn every_reference_leads_somewhere() {
        fn references(json: &Json, found: &mut BTreeSet<String>) {
            match json {
                Json::Object(map) => {
                    if let Some(Json::String(reference)) = map.get("$ref") {
                        found.insert(reference.clone());
                    }
                    map.values().for_each(|value| references(value, found));
                }
                Json::Array(items) => items.iter().for_each(|item| references(item, found)),
                _ => {}
            }
        }
        let mut found = BTreeSet::new();
        references(&DOCUMENT, &mut found);
        assert!(found.len() > 40, "{}", found.len());
        for reference in found {
            let pointer = reference.strip_prefix('#').unwrap();
            let schema = DOCUMENT.pointer(pointer).unwrap_or_else(|| panic!("{reference}"));
            assert!(schema["description"].as_str().is_some_and(|text| !text.is_empty()));
        }
    }
}
