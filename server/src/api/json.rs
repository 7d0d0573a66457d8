//! Messages as JSON: the proto3 mapping with the fields' own names, so that REST needs no second set of types.
//!
//! 64-bit integers are written as JSON numbers (and read as numbers or strings), bytes are base64, enum values
//! their full names. Unknown fields are refused: a misspelt option must not be ignored.

use std::sync::LazyLock;

use gatsbi_proto::v1::FILE_DESCRIPTOR_SET;
use prost::{Message, Name};
use prost_reflect::{
    DescriptorPool, DeserializeOptions, DynamicMessage, MessageDescriptor, SerializeOptions,
};

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
    fn what_is_misspelt_is_refused() {
        for text in [r#"{"sessionn": 1}"#, r#"{"seed": "x"}"#, "{", "{} {}", "[]"] {
            let error = decode::<v1::CreateSessionRequest>(text.as_bytes()).unwrap_err();
            assert!(matches!(error, Error::Malformed { .. }), "{text}: {error}");
        }
    }
}
