//! Messages as JSON: the proto3 mapping with the fields' own names, so that REST needs no second set of types.
//!
//! 64-bit integers are written as JSON numbers (and read as numbers or strings), bytes are base64, enum values
//! their full names. Unknown fields are refused: a misspelt option must not be ignored.

use std::sync::LazyLock;

use gatsbi_proto::v1::FILE_DESCRIPTOR_SET;
use prost::{Message, Name};
use prost_reflect::{
    DescriptorPool, DeserializeOptions, DynamicMessage, MessageDescriptor, SerializeOptions, Value,
};
use serde_json::Value as Json;

use crate::error::Error;

static POOL: LazyLock<DescriptorPool> = LazyLock::new(|| {
    DescriptorPool::decode(FILE_DESCRIPTOR_SET).expect("the descriptors are those of this build")
});

/// Reads a message; no bytes at all are the empty message.
///
/// # Errors
/// If the text is no JSON, or not such a message.
pub fn decode<M: Message + Name + Default>(text: &[u8]) -> Result<M, Error> {
    if text.is_empty() {
        return Ok(M::default());
    }
    let malformed = |reason: String| Error::Malformed { message: M::NAME.to_owned(), reason };
    let mut json = serde_json::Deserializer::from_slice(text);
    let options = DeserializeOptions::new().deny_unknown_fields(true);
    let message = DynamicMessage::deserialize_with_options(descriptor::<M>(), &mut json, &options)
        .map_err(|error| malformed(error.to_string()))?;
    json.end().map_err(|error| malformed(error.to_string()))?;
    if holds_greatest(&message) {
        let json = serde_json::from_slice(text).map_err(|error| malformed(error.to_string()))?;
        if let Some(field) = rounded(&message, &json) {
            return Err(malformed(format!("{field} is more than {}", u64::MAX)));
        }
    }
    message.transcode_to().map_err(|error| malformed(error.to_string()))
}

/// Writes a message, fields with default values too.
pub fn encode<M: Message + Name>(message: &M) -> Vec<u8> {
    let mut dynamic = DynamicMessage::new(descriptor::<M>());
    dynamic.transcode_from(message).expect("the descriptor is that of the message");
    let options = SerializeOptions::new()
        .stringify_64_bit_integers(false)
        .use_proto_field_name(true)
        .skip_default_fields(false);
    let mut text = Vec::new();
    let mut json = serde_json::Serializer::new(&mut text);
    dynamic
        .serialize_with_options(&mut json, &options)
        .expect("messages have a JSON form, and memory can be written");
    text
}

/// Whether a number is the greatest that 64 bits hold, as greater ones become when they are read.
fn holds_greatest(message: &DynamicMessage) -> bool {
    let greatest = |value: &Value| match value {
        Value::U64(number) => *number == u64::MAX,
        Value::Message(message) => holds_greatest(message),
        _ => false,
    };
    message.fields().any(|(_, value)| match value {
        Value::List(values) => values.iter().any(greatest),
        value => greatest(value),
    })
}

/// The first field whose number is not what the text says, because it was greater than 64 bits hold.
fn rounded(message: &DynamicMessage, text: &Json) -> Option<String> {
    let wrong = |value: &Value, text: &Json, name: &str| match value {
        Value::U64(u64::MAX) if text.is_f64() => Some(name.to_owned()),
        Value::Message(message) => rounded(message, text).map(|inner| format!("{name}.{inner}")),
        _ => None,
    };
    message.fields().find_map(|(field, value)| {
        let text = text.get(field.name()).or_else(|| text.get(field.json_name()))?;
        let name = field.name();
        match value {
            Value::List(values) => values
                .iter()
                .zip(text.as_array()?)
                .find_map(|(value, text)| wrong(value, text, name)),
            value => wrong(value, text, name),
        }
    })
}

fn descriptor<M: Name>() -> MessageDescriptor {
    POOL.get_message_by_name(&M::full_name()).expect("all messages are in the descriptor set")
}

#[cfg(test)]
mod tests {
    use gatsbi_proto::v1;

    use super::*;

    #[test]
    fn requests_may_be_written_by_hand() {
        let text = br#"{"session_id": "a", "observation": {"step": 3, "action": [0.5, 1]},
            "outputs": {"outputs": ["OUTPUT_FRAME"], "encoding": "ENCODING_PNG"}}"#;
        let request: v1::ObserveRequest = decode(text).unwrap();
        let observation = request.observation.unwrap();
        assert_eq!((observation.step, observation.action), (Some(3), vec![0.5, 1.0]));
        assert_eq!(request.outputs.unwrap().outputs, [i32::from(v1::Output::Frame)]);
        let empty = v1::CreateSessionRequest::default();
        assert_eq!(decode::<v1::CreateSessionRequest>(b"").unwrap(), empty);
    }

    #[test]
    fn answers_can_be_read_by_any_json_reader() {
        let session = v1::Session { id: "a".into(), seed: 1 << 52, ..Default::default() };
        let value: serde_json::Value = serde_json::from_slice(&encode(&session)).unwrap();
        assert_eq!(value["seed"], 1u64 << 52);
        assert_eq!(value["next_step"], 0);
        assert_eq!(decode::<v1::Session>(&encode(&session)).unwrap(), session);
    }

    #[test]
    fn numbers_beyond_64_bits_are_refused() {
        let read = |seed: &str| {
            let text = format!(r#"{{"sampling": {{"seed": {seed}}}}}"#);
            decode::<v1::ImagineRequest>(text.as_bytes())
        };
        for good in ["18446744073709551615", "\"18446744073709551615\"", "1e19"] {
            assert!(read(good).is_ok(), "{good}");
        }
        for bad in ["18446744073709551616", "18446744073709552001", "1.8446744073709552e19", "2e19"]
        {
            assert!(matches!(read(bad), Err(Error::Malformed { .. })), "{bad}");
        }
        let reason = read("18446744073709551616").unwrap_err().to_string();
        assert!(reason.ends_with("sampling.seed is more than 18446744073709551615"), "{reason}");
    }

    #[test]
    fn what_is_misspelt_is_refused() {
        for text in [r#"{"sessionn": 1}"#, r#"{"seed": "x"}"#, "{", "{} {}", "[]"] {
            let error = decode::<v1::CreateSessionRequest>(text.as_bytes()).unwrap_err();
            assert!(matches!(error, Error::Malformed { .. }), "{text}: {error}");
        }
    }
}
