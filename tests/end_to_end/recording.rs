//! A recorded episode as every client sends it, and what comes back in a form that can be compared.

use std::path::PathBuf;

use base64::{Engine as _, prelude::BASE64_STANDARD};
use gatsbi_client::{Belief, Image, Numbers, Object, Observation, Output};
use gatsbi_episodes::{Dataset, Episode};
use serde_json::{Value, json};

/// Width and height of its frames.
pub(crate) const SIZE: u32 = 64;

/// What a belief says, bit by bit: step, frame, objects.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Told {
    step: u64,
    frame: Vec<u8>,
    objects: Vec<Known>,
}

/// An object: identity and slot, then the bits of its numbers.
pub(crate) type Known = (u64, u64, [u32; 6]);

/// Names of an object's numbers.
const NUMBERS: [&str; 6] = ["presence", "x", "y", "width", "height", "depth"];

/// The file of the sample episodes.
pub(crate) fn file() -> PathBuf {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    root.join("../episodes/samples/push1-heldout.parquet").canonicalize().unwrap()
}

/// The first sample episode.
pub(crate) fn episode() -> Episode {
    Dataset::open(file()).unwrap().read(0).unwrap()
}

/// Frame `t` of an episode as an observation of the Rust client.
pub(crate) fn observation(episode: &Episode, t: usize) -> Observation {
    let image = Image::rgb(SIZE, SIZE, episode.frame(t).to_vec()).unwrap();
    Observation { step: t as u64, image: Some(image), action: action(episode, t) }
}

/// The same as the body of a request to the REST API, which asks for frame and objects.
pub(crate) fn document(episode: &Episode, t: usize) -> Value {
    json!({
        "observation": {
            "step": t,
            "image": { "pixels": {
                "dtype": "DATA_TYPE_U8",
                "shape": [SIZE, SIZE, 3],
                "data": BASE64_STANDARD.encode(episode.frame(t)),
            } },
            "action": action(episode, t),
        },
        "outputs": { "outputs": ["OUTPUT_FRAME", "OUTPUT_OBJECTS"], "encoding": "ENCODING_U8" },
    })
}

/// The action that led to frame `t`; nothing led to the first.
fn action(episode: &Episode, t: usize) -> Vec<f32> {
    t.checked_sub(1).map(|before| episode.action(before).to_vec()).unwrap_or_default()
}

impl From<&Belief> for Told {
    fn from(belief: &Belief) -> Self {
        let frame = belief.outputs.array(Output::Frame).unwrap();
        let Numbers::U8(frame) = frame.numbers() else { panic!("{frame:?}") };
        let objects = belief.objects.iter().map(known).collect();
        Self { step: belief.step, frame: frame.clone(), objects }
    }
}

impl From<&Value> for Told {
    /// Reads a belief of the REST API.
    fn from(belief: &Value) -> Self {
        let frame = &belief["outputs"][0];
        assert_eq!(frame["output"], "OUTPUT_FRAME", "{frame}");
        let frame = BASE64_STANDARD.decode(frame["tensor"]["data"].as_str().unwrap()).unwrap();
        Self { step: belief["step"].as_u64().unwrap(), frame, objects: all_known(belief) }
    }
}

impl Told {
    /// What the command line prints of it, which is without images.
    pub(crate) fn in_words(&self) -> (u64, &[Known]) {
        (self.step, &self.objects)
    }
}

/// An object of the Rust client.
pub(crate) fn known(object: &Object) -> Known {
    let Object { id, slot, presence, x, y, width, height, depth, .. } = *object;
    (id, slot.into(), [presence, x, y, width, height, depth].map(f32::to_bits))
}

/// The objects of a JSON document.
pub(crate) fn all_known(document: &Value) -> Vec<Known> {
    let known = |object: &Value| {
        let number = |name: &str| (object[name].as_f64().unwrap() as f32).to_bits();
        (object["id"].as_u64().unwrap(), object["slot"].as_u64().unwrap(), NUMBERS.map(number))
    };
    document["objects"].as_array().unwrap().iter().map(known).collect()
}
