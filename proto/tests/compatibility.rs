//! The wire stays what it was: `proto/wire.txt` lists everything that clients may rely on, a line each.
//!
//! A line that goes missing or changes would break clients and fails. What is new fails too, until it is written down:
//! `GATSBI_UPDATE_WIRE=1` does that, and the review sees it.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

use std::collections::BTreeSet;

use gatsbi_proto::v1::FILE_DESCRIPTOR_SET;
use prost::Message as _;
use prost_types::{
    DescriptorProto, EnumDescriptorProto, FileDescriptorSet,
    field_descriptor_proto::{Label, Type},
};

const UPDATE: &str = "GATSBI_UPDATE_WIRE";

fn message(package: &str, message: &DescriptorProto, lines: &mut BTreeSet<String>) {
    let name = format!("{package}.{}", message.name());
    lines.insert(format!("message {name}"));
    for field in &message.field {
        let kind = match field.r#type() {
            Type::Message | Type::Enum => field.type_name().trim_start_matches('.').to_owned(),
            scalar => scalar.as_str_name().trim_start_matches("TYPE_").to_lowercase(),
        };
        let choice = field.oneof_index.filter(|_| !field.proto3_optional());
        let label = match (field.label(), field.proto3_optional(), choice) {
            (Label::Repeated, ..) => "repeated ".to_owned(),
            (_, true, _) => "optional ".to_owned(),
            (_, _, Some(at)) => format!("oneof {} ", message.oneof_decl[at as usize].name()),
            _ => String::new(),
        };
        let (field_name, number) = (field.name(), field.number());
        lines.insert(format!("field {name}.{field_name} = {number}: {label}{kind}"));
    }
    assert!(message.nested_type.is_empty() && message.enum_type.is_empty(), "{name} nests types");
}

fn enumeration(package: &str, kind: &EnumDescriptorProto, lines: &mut BTreeSet<String>) {
    let name = format!("{package}.{}", kind.name());
    for value in &kind.value {
        lines.insert(format!("value {name}.{} = {}", value.name(), value.number()));
    }
}

/// All that clients may rely on.
fn wire() -> BTreeSet<String> {
    let files = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).unwrap();
    let mut lines = BTreeSet::new();
    for file in files.file.iter().filter(|file| file.package() == "gatsbi.v1") {
        for described in &file.message_type {
            message(file.package(), described, &mut lines);
        }
        for described in &file.enum_type {
            enumeration(file.package(), described, &mut lines);
        }
        for service in &file.service {
            for method in &service.method {
                let of = |streams: bool| if streams { "stream " } else { "" };
                let (input, output) = (method.input_type(), method.output_type());
                lines.insert(format!(
                    "rpc {}.{}.{}({}{}) returns ({}{})",
                    file.package(),
                    service.name(),
                    method.name(),
                    of(method.client_streaming()),
                    input.trim_start_matches('.'),
                    of(method.server_streaming()),
                    output.trim_start_matches('.'),
                ));
            }
        }
    }
    lines
}

#[test]
fn what_clients_rely_on_is_still_there() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/wire.txt");
    let now = wire();
    if std::env::var_os(UPDATE).is_some() {
        let text: Vec<String> = now.iter().map(|line| format!("{line}\n")).collect();
        fs_err::write(path, text.concat()).unwrap();
    }
    let text = fs_err::read_to_string(path).unwrap();
    let before: BTreeSet<String> = text.lines().map(str::to_owned).collect();
    let gone: Vec<&String> = before.difference(&now).collect();
    assert!(gone.is_empty(), "this breaks clients: {gone:#?}");
    let new: Vec<&String> = now.difference(&before).collect();
    assert!(new.is_empty(), "{UPDATE}=1 writes down what is new: {new:#?}");
}

#[test]
fn names_are_as_they_should_be() {
    for line in wire() {
        let words: Vec<&str> = line.split([' ', ':', '(']).collect();
        let last = words[1].rsplit('.').next().unwrap();
        let snake = |text: &str| {
            text.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
        };
        let shouting = |text: &str| {
            text.chars().all(|c| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_')
        };
        match words[0] {
            "field" => assert!(snake(last), "{line}"),
            "value" => assert!(shouting(last), "{line}"),
            "rpc" => {
                let plain = line.replace("stream ", "");
                assert!(plain.contains(&format!("(gatsbi.v1.{last}Request)")), "{line}");
                assert!(plain.ends_with(&format!("(gatsbi.v1.{last}Response)")), "{line}");
            }
            _ => assert!(last.starts_with(|c: char| c.is_ascii_uppercase()), "{line}"),
        }
    }
}

#[test]
fn everything_is_explained() {
    let files = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).unwrap();
    for file in files.file.iter().filter(|file| file.package() == "gatsbi.v1") {
        let locations = &file.source_code_info.as_ref().unwrap().location;
        for location in locations {
            // Messages, their fields, enumerations, their values, services, their methods.
            let described = matches!(*location.path.as_slice(), [4..=6, _] | [4..=6, _, 2, _]);
            let comment = location.leading_comments.as_deref().unwrap_or_default();
            let at = (file.name(), location.span.first());
            assert!(!described || !comment.trim().is_empty(), "{at:?} has no comment");
        }
    }
}
