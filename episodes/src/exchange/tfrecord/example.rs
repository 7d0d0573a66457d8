//! `tf.train.Example`: features by name, each a list of bytes, floats or integers.

use std::collections::BTreeMap;

use prost::{DecodeError, Message as _};

/// One example.
#[derive(Debug)]
pub(super) struct Example(BTreeMap<String, Values>);

/// The values of a feature.
#[derive(Debug)]
pub(super) enum Values {
    Bytes(Vec<Vec<u8>>),
    Floats(Vec<f32>),
    Integers(usize),
}

impl Example {
    pub(super) fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let features = wire::Example::decode(bytes)?.features.unwrap_or_default().feature;
        let values = features.into_iter().filter_map(|(key, feature)| {
            let values = match feature.kind? {
                wire::Kind::Bytes(list) => Values::Bytes(list.value),
                wire::Kind::Floats(list) => Values::Floats(list.value),
                wire::Kind::Integers(list) => Values::Integers(list.value.len()),
            };
            Some((key, values))
        });
        Ok(Self(values.collect()))
    }

    pub(super) fn get(&self, key: &str) -> Option<&Values> {
        self.0.get(key)
    }

    pub(super) fn keys(&self) -> impl Iterator<Item = &String> {
        self.0.keys()
    }
}

impl Values {
    /// For messages.
    pub(super) fn described(&self) -> String {
        match self {
            Self::Bytes(list) => format!("a list of {} byte strings", list.len()),
            Self::Floats(list) => format!("a list of {} floats", list.len()),
            Self::Integers(count) => format!("a list of {count} integers"),
        }
    }
}

/// The messages of tensorflow/core/example, by their numbers.
mod wire {
    use std::collections::HashMap;

    #[derive(Clone, PartialEq, prost::Message)]
    pub(super) struct Example {
        #[prost(message, optional, tag = "1")]
        pub(super) features: Option<Features>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub(super) struct Features {
        #[prost(map = "string, message", tag = "1")]
        pub(super) feature: HashMap<String, Feature>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub(super) struct Feature {
        #[prost(oneof = "Kind", tags = "1, 2, 3")]
        pub(super) kind: Option<Kind>,
    }

    #[derive(Clone, PartialEq, prost::Oneof)]
    pub(super) enum Kind {
        #[prost(message, tag = "1")]
        Bytes(BytesList),
        #[prost(message, tag = "2")]
        Floats(FloatList),
        #[prost(message, tag = "3")]
        Integers(Int64List),
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub(super) struct BytesList {
        #[prost(bytes = "vec", repeated, tag = "1")]
        pub(super) value: Vec<Vec<u8>>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub(super) struct FloatList {
        #[prost(float, repeated, tag = "1")]
        pub(super) value: Vec<f32>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub(super) struct Int64List {
        #[prost(int64, repeated, tag = "1")]
        pub(super) value: Vec<i64>,
    }
}
