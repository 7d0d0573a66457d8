//! The messages that are understood: pictures and commands, of Foxglove and of ROS 2.

use base64::{Engine as _, prelude::BASE64_STANDARD};
use serde_json::Value;

use super::cdr::Cdr;
use crate::exchange::{ImportProblem, picture::Picture};

pub(super) const COMPRESSED_IMAGE: &str = "foxglove.CompressedImage";
const RAW_IMAGE: &str = "foxglove.RawImage";

/// `foxglove.CompressedImage`
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct CompressedImage {
    #[prost(message, optional, tag = "1")]
    pub(super) timestamp: Option<prost_types::Timestamp>,
    #[prost(string, tag = "4")]
    pub(super) frame_id: String,
    #[prost(bytes = "vec", tag = "2")]
    pub(super) data: Vec<u8>,
    #[prost(string, tag = "3")]
    pub(super) format: String,
}

/// `foxglove.RawImage`
#[derive(Clone, PartialEq, prost::Message)]
struct RawImage {
    #[prost(fixed32, tag = "2")]
    width: u32,
    #[prost(fixed32, tag = "3")]
    height: u32,
    #[prost(string, tag = "4")]
    encoding: String,
    #[prost(fixed32, tag = "5")]
    step: u32,
    #[prost(bytes = "vec", tag = "6")]
    data: Vec<u8>,
}

/// How messages of a topic are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Compressed(Coding),
    Raw(Coding),
    /// JSON with a list of numbers.
    Json,
    Multi32,
    Multi64,
    JointState,
    Twist,
    TwistStamped,
}

/// How fields become bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Coding {
    Protobuf,
    Json,
    Cdr,
}

impl Kind {
    /// The kind of a schema, if it is one that is understood.
    pub(super) fn of(schema: &str, encoding: &str) -> Option<Self> {
        let coding = match encoding {
            "protobuf" => Coding::Protobuf,
            "json" => Coding::Json,
            "cdr" => Coding::Cdr,
            _ => return None,
        };
        match (schema, coding) {
            (COMPRESSED_IMAGE, Coding::Protobuf | Coding::Json)
            | ("sensor_msgs/msg/CompressedImage", Coding::Cdr) => Some(Self::Compressed(coding)),
            (RAW_IMAGE, Coding::Protobuf | Coding::Json)
            | ("sensor_msgs/msg/Image", Coding::Cdr) => Some(Self::Raw(coding)),
            ("std_msgs/msg/Float32MultiArray", Coding::Cdr) => Some(Self::Multi32),
            ("std_msgs/msg/Float64MultiArray", Coding::Cdr) => Some(Self::Multi64),
            ("sensor_msgs/msg/JointState", Coding::Cdr) => Some(Self::JointState),
            ("geometry_msgs/msg/Twist", Coding::Cdr) => Some(Self::Twist),
            ("geometry_msgs/msg/TwistStamped", Coding::Cdr) => Some(Self::TwistStamped),
            (_, Coding::Json) => Some(Self::Json),
            _ => None,
        }
    }

    pub(super) fn is_picture(self) -> bool {
        matches!(self, Self::Compressed(_) | Self::Raw(_))
    }

    /// The picture of a message.
    pub(super) fn picture(self, data: &[u8]) -> Result<Picture, ImportProblem> {
        match self {
            Self::Compressed(coding) => Picture::decode(&compressed(coding, data)?),
            Self::Raw(coding) => raw(coding, data)?.picture(),
            _ => Err(broken("it is no picture")),
        }
    }

    /// The numbers of a command; `field` names them where a message has several.
    pub(super) fn command(
        self,
        data: &[u8],
        field: Option<&str>,
    ) -> Result<Vec<f32>, ImportProblem> {
        if self == Self::Json {
            return json_numbers(&json(data)?, field.unwrap_or("values"));
        }
        let cdr = Cdr::new(data);
        let numbers = cdr.and_then(|mut cdr| match self {
            Self::Multi32 => {
                multi_layout(&mut cdr)?;
                cdr.sequence(Cdr::f32)
            }
            Self::Multi64 => {
                multi_layout(&mut cdr)?;
                Some(single(&cdr.sequence(Cdr::f64)?))
            }
            Self::JointState => {
                cdr.header()?;
                cdr.sequence(|cdr| cdr.string().map(|_| ()))?;
                let mut lists = [vec![], vec![], vec![]];
                for list in &mut lists {
                    *list = cdr.sequence(Cdr::f64)?;
                }
                let [position, velocity, effort] = &lists;
                Some(single(match field.unwrap_or("velocity") {
                    "position" => position,
                    "velocity" => velocity,
                    "effort" => effort,
                    _ => return None,
                }))
            }
            Self::Twist | Self::TwistStamped => {
                if self == Self::TwistStamped {
                    cdr.header()?;
                }
                (0..6).map(|_| cdr.f64().map(|value| value as f32)).collect()
            }
            _ => None,
        });
        numbers.ok_or_else(|| {
            broken("it is too short, of another encoding, or has no such field (JointState: position, velocity, effort)")
        })
    }
}

impl RawImage {
    fn picture(&self) -> Result<Picture, ImportProblem> {
        // Where each of red, green and blue stands in a pixel, and how many bytes that has.
        let (places, pixel) = match self.encoding.as_str() {
            "rgb8" | "8UC3" => ([0, 1, 2], 3),
            "bgr8" => ([2, 1, 0], 3),
            "rgba8" => ([0, 1, 2], 4),
            "bgra8" => ([2, 1, 0], 4),
            "mono8" | "8UC1" => ([0, 0, 0], 1),
            other => {
                let (found, expected) =
                    (other.to_owned(), "rgb8, bgr8, rgba8, bgra8 or mono8".into());
                return Err(ImportProblem::Layout { what: "the encoding", found, expected });
            }
        };
        let (width, height, step) = (self.width as usize, self.height as usize, self.step as usize);
        let fits = width.checked_mul(pixel).is_some_and(|row| row <= step)
            && step.checked_mul(height).is_some_and(|bytes| bytes <= self.data.len());
        if !fits || step == 0 {
            let found = format!("{} bytes for {width}x{height} pixels", self.data.len());
            let expected = format!("{step} bytes a row");
            return Err(ImportProblem::Layout { what: "a picture", found, expected });
        }
        let rows = self.data.chunks_exact(step).take(height);
        let pixels = rows.flat_map(|row| row[..width * pixel].chunks_exact(pixel));
        let rgb = pixels.flat_map(|pixel| places.map(|place| pixel[place])).collect();
        Picture::raw(self.width, self.height, rgb)
    }
}

fn compressed(coding: Coding, data: &[u8]) -> Result<Vec<u8>, ImportProblem> {
    match coding {
        Coding::Protobuf => Ok(decode::<CompressedImage>(data)?.data),
        Coding::Json => json_bytes(&json(data)?),
        Coding::Cdr => {
            let read = || {
                let mut cdr = Cdr::new(data)?;
                cdr.header()?;
                cdr.string()?;
                cdr.bytes().map(<[u8]>::to_vec)
            };
            read().ok_or_else(|| broken("it is too short or of another encoding"))
        }
    }
}

fn raw(coding: Coding, data: &[u8]) -> Result<RawImage, ImportProblem> {
    match coding {
        Coding::Protobuf => decode(data),
        Coding::Json => {
            let json = json(data)?;
            let number = |name: &str| {
                let number = json[name].as_u64().and_then(|number| u32::try_from(number).ok());
                number.ok_or_else(|| broken(&format!("`{name}` is no whole number")))
            };
            let encoding = json["encoding"].as_str().unwrap_or_default().to_owned();
            let (width, height, step) = (number("width")?, number("height")?, number("step")?);
            Ok(RawImage { width, height, encoding, step, data: json_bytes(&json)? })
        }
        Coding::Cdr => {
            let read = || {
                let mut cdr = Cdr::new(data)?;
                cdr.header()?;
                let (height, width) = (cdr.u32()?, cdr.u32()?);
                let encoding = cdr.string()?.to_owned();
                cdr.u8()?;
                let step = cdr.u32()?;
                Some(RawImage { width, height, encoding, step, data: cdr.bytes()?.to_vec() })
            };
            read().ok_or_else(|| broken("it is too short or of another encoding"))
        }
    }
}

fn decode<M: prost::Message + Default>(data: &[u8]) -> Result<M, ImportProblem> {
    M::decode(data).map_err(|e| ImportProblem::damaged("a message", e))
}

fn json(data: &[u8]) -> Result<Value, ImportProblem> {
    serde_json::from_slice(data).map_err(|e| ImportProblem::damaged("a message", e))
}

fn json_bytes(json: &Value) -> Result<Vec<u8>, ImportProblem> {
    let text = json["data"].as_str().ok_or_else(|| broken("`data` is no text"))?;
    BASE64_STANDARD.decode(text).map_err(|e| ImportProblem::damaged("`data` of a message", e))
}

fn json_numbers(json: &Value, field: &str) -> Result<Vec<f32>, ImportProblem> {
    let list = json[field].as_array();
    let numbers = list.and_then(|list| {
        list.iter().map(|number| number.as_f64().map(|number| number as f32)).collect()
    });
    numbers.ok_or_else(|| broken(&format!("`{field}` is no list of numbers")))
}

/// `std_msgs/MultiArrayLayout`, which is not looked at: numbers are taken in their order.
fn multi_layout(cdr: &mut Cdr<'_>) -> Option<()> {
    cdr.sequence(|cdr| {
        cdr.string()?;
        cdr.u32()?;
        cdr.u32()
    })?;
    cdr.u32().map(|_| ())
}

fn single(numbers: &[f64]) -> Vec<f32> {
    numbers.iter().map(|&number| number as f32).collect()
}

fn broken(why: &str) -> ImportProblem {
    ImportProblem::damaged("a message", why.to_owned())
}
