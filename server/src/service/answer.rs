//! Outputs of the engine to messages of the wire.

use gatsbi_models::{scene::Output, world_model::Preprocess};
use gatsbi_proto::v1::{self, output_value};

use super::fields::output_name;
use crate::{
    engine::commands::{NumberType, Spent, Value},
    media, tensor,
};

/// Outputs with the given axes before their own; the object table becomes tracks.
pub(super) fn outputs(values: Vec<Value>, leading: &[u32], png: bool) -> Vec<v1::OutputValue> {
    let mut outputs = Vec::new();
    let mut tracks = v1::ObjectTracks::default();
    for value in values {
        let output = value.output;
        let value = match (output, value.numbers) {
            (Output::Objects, NumberType::I64) => {
                tracks.ids = Some(tensor::wire(value, leading));
                continue;
            }
            (Output::Objects, _) => {
                tracks.values = Some(tensor::wire(value, leading));
                continue;
            }
            (_, NumberType::U8) if png => output_value::Value::Images(images(&value, leading)),
            _ => output_value::Value::Tensor(tensor::wire(value, leading)),
        };
        outputs.push(v1::OutputValue { output: output_name(output).into(), value: Some(value) });
    }
    if tracks.ids.is_some() {
        let value = Some(output_value::Value::Tracks(tracks));
        outputs.push(v1::OutputValue { output: v1::Output::Objects.into(), value });
    }
    outputs
}

/// The objects of one row: every slot that holds or has held one.
pub(super) fn objects(
    values: &[Value],
    sent: (u32, u32),
    preprocess: Preprocess,
) -> Vec<v1::Object> {
    let table = |numbers: NumberType| {
        values.iter().find(|value| value.output == Output::Objects && value.numbers == numbers)
    };
    let (Some(ids), Some(rows)) = (table(NumberType::I64), table(NumberType::F32)) else {
        return Vec::new();
    };
    let (ids, _) = ids.data.as_chunks::<8>();
    let (rows, _) = rows.data.as_chunks::<24>();
    let object = |(slot, (id, row)): (usize, (&[u8; 8], &[u8; 24]))| {
        let id = u64::try_from(i64::from_le_bytes(*id)).ok()?;
        let number = |at: usize| {
            f32::from_le_bytes([row[4 * at], row[4 * at + 1], row[4 * at + 2], row[4 * at + 3]])
        };
        let (x, y) = (number(1), number(2));
        let (pixel_x, pixel_y) = media::sent_pixel((x, y), sent, preprocess);
        Some(v1::Object {
            id,
            slot: slot as u32,
            presence: number(0),
            x,
            y,
            width: number(3),
            height: number(4),
            depth: number(5),
            pixel_x,
            pixel_y,
        })
    };
    ids.iter().zip(rows).enumerate().filter_map(object).collect()
}

/// Where time went; what else it took to encode is added.
pub(super) fn timing(spent: Spent, encode: std::time::Duration) -> v1::Timing {
    let micros = |time: std::time::Duration| u32::try_from(time.as_micros()).unwrap_or(u32::MAX);
    v1::Timing {
        queue_micros: micros(spent.queue),
        compute_micros: micros(spent.compute),
        encode_micros: micros(spent.encode + encode),
    }
}

/// Pictures as PNG files: the last axes are height and width, and colours where there are any.
fn images(value: &Value, leading: &[u32]) -> v1::Images {
    let channels = match value.output {
        Output::Frame | Output::Background => 3,
        _ => 1,
    };
    let axes = value.shape.len() - if channels == 3 { 3 } else { 2 };
    let (before, picture) = value.shape.split_at(axes);
    let size = (picture[1] as u32, picture[0] as u32);
    let bytes = picture.iter().product();
    let png = value.data.chunks_exact(bytes).map(|pixels| media::png(pixels, size, channels));
    let shape = leading.iter().copied().chain(before.iter().map(|size| *size as u32)).collect();
    v1::Images { shape, png: png.collect() }
}
