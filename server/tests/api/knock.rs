//! Calls of any method of either API with any key, without knowing its messages: for tests of who gets in.

use bytes::{Buf as _, BufMut as _, Bytes};
use gatsbi_proto::v1::FILE_DESCRIPTOR_SET;
use gatsbi_server::access::{
    key::{KeyDigest, Role, new_secret},
    key_file::{Entry, written},
};
use prost::Message as _;
use prost_reflect::{
    DescriptorPool, DynamicMessage, Kind, MethodDescriptor, ReflectMessage as _, Value,
};
use tonic::{
    Code, Status,
    codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder},
    transport::Channel,
};
use tonic_types::StatusExt as _;

/// Messages as they are on the wire.
#[derive(Clone, Copy, Default)]
struct Raw;

impl Codec for Raw {
    type Encode = Bytes;
    type Decode = Bytes;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        *self
    }

    fn decoder(&mut self) -> Self {
        *self
    }
}

impl Encoder for Raw {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, message: Bytes, buffer: &mut EncodeBuf<'_>) -> Result<(), Status> {
        buffer.put(message);
        Ok(())
    }
}

impl Decoder for Raw {
    type Item = Bytes;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<Bytes>, Status> {
        Ok(Some(buffer.copy_to_bytes(buffer.remaining())))
    }
}

/// What came back: a status or a code, the reason if there is one, and what else was said.
#[derive(Clone, Debug, Eq, PartialEq)]
pub(crate) struct Answer {
    pub(crate) code: String,
    pub(crate) reason: String,
    pub(crate) told: Vec<u8>,
}

impl Answer {
    /// Whether a key was missing or not good enough.
    pub(crate) fn is_turned_away(&self) -> bool {
        ["NO_KEY", "WRONG_KEY", "EXPIRED_KEY", "ROLE_TOO_LOW"].contains(&self.reason.as_str())
    }

    /// The answer with another id in the place of one.
    pub(crate) fn with(&self, id: &str, other: &str) -> Self {
        let mut told = self.told.clone();
        for at in 0..told.len().saturating_sub(id.len() - 1) {
            if told[at..].starts_with(id.as_bytes()) {
                told[at..at + id.len()].copy_from_slice(other.as_bytes());
            }
        }
        Self { told, ..self.clone() }
    }
}

/// Every method of our services.
pub(crate) fn methods() -> Vec<MethodDescriptor> {
    let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET).unwrap();
    pool.services().flat_map(|service| service.methods().collect::<Vec<_>>()).collect()
}

/// `Service/Method`.
pub(crate) fn name(method: &MethodDescriptor) -> String {
    format!("{}/{}", method.parent_service().name(), method.name())
}

/// Things of a tenant that a request can name.
#[derive(Clone, Debug)]
pub(crate) struct Things {
    pub(crate) session: String,
    pub(crate) goal: String,
    pub(crate) handles: String,
    pub(crate) snapshot: Vec<u8>,
}

/// A request that names things wherever it can, and says nothing else.
pub(crate) fn request(method: &MethodDescriptor, things: &Things) -> Bytes {
    let mut message = DynamicMessage::new(method.input());
    name_things(&mut message, things);
    message.encode_to_vec().into()
}

fn name_things(message: &mut DynamicMessage, things: &Things) {
    for field in message.descriptor().fields() {
        let value = match (field.name(), field.kind()) {
            ("session_id", _) => Value::String(things.session.clone()),
            ("goal_id", _) => Value::String(things.goal.clone()),
            ("handles_id", _) => Value::String(things.handles.clone()),
            // In a start, the session is named instead.
            ("snapshot", Kind::Bytes) if field.containing_oneof().is_none() => {
                Value::Bytes(things.snapshot.clone().into())
            }
            ("start" | "starts" | "session", Kind::Message(inner)) => {
                let mut inner = DynamicMessage::new(inner);
                name_things(&mut inner, things);
                let value = Value::Message(inner);
                if field.is_list() { Value::List(vec![value]) } else { value }
            }
            _ => continue,
        };
        message.set_field(&field, value);
    }
}

/// Calls a gRPC method.
pub(crate) async fn grpc(
    channel: &Channel,
    method: &MethodDescriptor,
    message: Bytes,
    key: Option<&str>,
) -> Answer {
    let path = format!("/{}/{}", method.parent_service().full_name(), method.name());
    let mut request = tonic::Request::new(futures_util::stream::iter([message]));
    if let Some(key) = key {
        let bearer = format!("Bearer {key}").parse().unwrap();
        request.metadata_mut().insert("authorization", bearer);
    }
    let mut client = tonic::client::Grpc::new(channel.clone());
    client.ready().await.unwrap();
    let answered = async {
        let mut answers = client.streaming(request, path.parse().unwrap(), Raw).await?.into_inner();
        answers.message().await
    };
    match answered.await {
        Ok(told) => Answer {
            code: "Ok".to_owned(),
            reason: String::new(),
            told: told.unwrap_or_default().to_vec(),
        },
        Err(status) => {
            assert_ne!(status.code(), Code::Unknown, "{path}: {status:?}");
            let reason = status.get_error_details().error_info().map(|info| info.reason.clone());
            let told = [status.message().as_bytes(), status.details()].concat();
            Answer {
                code: format!("{:?}", status.code()),
                reason: reason.unwrap_or_default(),
                told,
            }
        }
    }
}

/// Calls a path.
pub(crate) async fn rest(request: reqwest::RequestBuilder, key: Option<&str>) -> Answer {
    let request = match key {
        Some(key) => request.bearer_auth(key),
        None => request,
    };
    let response = request.send().await.unwrap();
    let code = response.status().as_u16().to_string();
    // A feed does not end.
    let is_feed =
        response.headers().get("content-type").is_some_and(|it| it == "text/event-stream");
    let told = if is_feed { vec![] } else { response.bytes().await.unwrap().to_vec() };
    let problem: serde_json::Value = serde_json::from_slice(&told).unwrap_or_default();
    let reason = problem["reason"].as_str().unwrap_or_default().to_owned();
    Answer { code, reason, told }
}

/// A file of keys that is filled and then read.
pub(crate) struct KeyFile(pub(crate) tempfile::NamedTempFile);

impl KeyFile {
    pub(crate) fn new() -> Self {
        Self(tempfile::NamedTempFile::new().unwrap())
    }

    /// Adds a key.
    pub(crate) fn key(&mut self, tenant: &str, role: Role) -> String {
        self.key_until(tenant, role, None)
    }

    pub(crate) fn key_until(
        &mut self,
        tenant: &str,
        role: Role,
        expires: Option<std::time::SystemTime>,
    ) -> String {
        let secret = new_secret();
        let digest = KeyDigest::of(&secret);
        let tenant = tenant.to_owned();
        self.write(&written(&Entry { tenant, role, digest, name: None, expires }));
        secret
    }

    /// Takes a key out.
    pub(crate) fn revoke(&mut self, secret: &str) {
        use std::io::Seek as _;
        let digest = KeyDigest::of(secret).to_string();
        let text = std::fs::read_to_string(self.0.path()).unwrap();
        let entries = text.split("[[keys]]").filter(|entry| !entry.contains(&digest));
        let left = entries.collect::<Vec<_>>().join("[[keys]]");
        self.0.as_file().set_len(0).unwrap();
        self.0.rewind().unwrap();
        self.write(&left);
    }

    /// Gives a key another role.
    pub(crate) fn lower(&mut self, secret: &str, role: Role) {
        let digest = KeyDigest::of(secret);
        self.revoke(secret);
        let tenant = "lab".to_owned();
        self.write(&written(&Entry { tenant, role, digest, name: None, expires: None }));
    }

    pub(crate) fn write(&mut self, text: &str) {
        use std::io::Write as _;
        self.0.write_all(format!("\n{text}").as_bytes()).unwrap();
    }
}
