//! How far samples of a candidate disagree: standard deviations of the frame and of object positions over them.
//!
//! Samples arrive in any order, and the answer must not depend on it. So numbers are summed as integers, multiples of
//! 2^-16, whose sums are exact.

use std::collections::BTreeMap;

use gatsbi_models::{
    scene::{Output, Outputs},
    world_model::ModelSpec,
};
use gatsbi_proto::v1::{self, output_value::Value as Wire};

use crate::engine::commands::{Chunk, NumberType, Value};

/// One over the unit in which is summed.
const SCALE: f32 = 65_536.0;

/// Positions lie nearer to the image than this, in halves of its side.
const FAR: f32 = 64.0;

/// Columns of the object table, of which x and y are the second and third.
const COLUMNS: usize = 6;

/// Sums over the samples that have arrived.
#[derive(Debug)]
pub(super) struct Spread {
    samples: u32,
    sums: BTreeMap<(u32, u32), Sums>,
}

#[derive(Debug, Default)]
struct Sums {
    samples: u32,
    frame: Moments,
    objects: Moments,
    height: usize,
}

/// Sums of numbers and of their squares.
#[derive(Debug, Default)]
struct Moments {
    first: Vec<i64>,
    second: Vec<u64>,
}

/// Bytes of the sums of one candidate at one depth, and of what they become.
pub(super) fn spread_bytes(outputs: Outputs, spec: &ModelSpec) -> u64 {
    let pixels = (spec.image_size * spec.image_size) as u64;
    let bytes = |output: Output| match output {
        Output::Frame => pixels * (3 * 16 + 4),
        _ => spec.max_objects as u64 * 2 * (16 + 4),
    };
    outputs.iter().map(bytes).sum()
}

impl Spread {
    pub(super) fn new(samples: u32) -> Self {
        Self { samples, sums: BTreeMap::new() }
    }

    /// Adds the rows of a chunk; returns what is complete, by candidate and depth.
    pub(super) fn add(&mut self, chunk: &Chunk) -> Vec<(u32, u32, Vec<v1::OutputValue>)> {
        let mut complete = Vec::new();
        if chunk.spread.is_empty() {
            return complete;
        }
        for row in 0..chunk.candidates {
            let at = (chunk.first_candidate + row, chunk.depth);
            let sums = self.sums.entry(at).or_default();
            for value in &chunk.spread {
                let bytes = value.data.len() / chunk.candidates as usize;
                sums.add(value, &value.data[row as usize * bytes..][..bytes]);
            }
            sums.samples += 1;
            if sums.samples == self.samples {
                let outputs = self.sums.remove(&at).map(|sums| sums.outputs()).unwrap_or_default();
                complete.push((at.0, at.1, outputs));
            }
        }
        complete
    }
}

impl Sums {
    fn add(&mut self, value: &Value, row: &[u8]) {
        let (numbers, _) = row.as_chunks::<4>();
        let numbers = numbers.iter().map(|bytes| f32::from_le_bytes(*bytes));
        match (value.output, value.numbers) {
            (Output::Frame, _) => {
                self.height = value.shape[0];
                self.frame.add(numbers.map(|x| x.clamp(0.0, 1.0)));
            }
            (Output::Objects, NumberType::F32) => {
                let places =
                    numbers.enumerate().filter(|(at, _)| (1..=2).contains(&(at % COLUMNS)));
                self.objects.add(places.map(|(_, x)| x.clamp(-FAR, FAR)));
            }
            _ => {}
        }
    }

    fn outputs(&self) -> Vec<v1::OutputValue> {
        let mut outputs = Vec::new();
        let mut output = |output: v1::Output, shape: [usize; 2], numbers: &[f32]| {
            let tensor = v1::Tensor {
                dtype: v1::DataType::F32.into(),
                shape: shape.map(|size| size as u32).to_vec(),
                data: numbers.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>().into(),
                values: Vec::new(),
            };
            // Of one candidate and one depth.
            let tensor = v1::Tensor { shape: [vec![1, 1], tensor.shape].concat(), ..tensor };
            let value = Some(Wire::Tensor(tensor));
            outputs.push(v1::OutputValue { output: output.into(), value });
        };
        let frame = self.frame.deviations(self.samples);
        if !frame.is_empty() {
            let (colours, _) = frame.as_chunks::<3>();
            let pixels: Vec<f32> =
                colours.iter().map(|colour| (colour.iter().sum::<f64>() / 3.0) as f32).collect();
            output(v1::Output::Spread, [self.height, pixels.len() / self.height], &pixels);
        }
        let objects = self.objects.deviations(self.samples);
        if !objects.is_empty() {
            let objects: Vec<f32> = objects.iter().map(|x| *x as f32).collect();
            output(v1::Output::ObjectSpread, [objects.len() / 2, 2], &objects);
        }
        outputs
    }
}

impl Moments {
    fn add(&mut self, numbers: impl Iterator<Item = f32>) {
        for (at, number) in numbers.enumerate() {
            let number = (number * SCALE).round() as i64;
            if at == self.first.len() {
                self.first.push(0);
                self.second.push(0);
            }
            self.first[at] += number;
            self.second[at] += number.unsigned_abs().pow(2);
        }
    }

    /// Standard deviations over `count` samples.
    fn deviations(&self, count: u32) -> Vec<f64> {
        let count = u128::from(count);
        let deviation = |(first, second): (&i64, &u64)| {
            let square = u128::from(first.unsigned_abs()).pow(2);
            let variance = count * u128::from(*second) - square;
            (variance as f64).sqrt() / count as f64 / f64::from(SCALE)
        };
        self.first.iter().zip(&self.second).map(deviation).collect()
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;
    use crate::engine::commands::Spent;

    fn chunk(candidates: u32, frames: &[f32], objects: &[f32]) -> Chunk {
        let value = |output: Output, shape: Vec<usize>, numbers: &[f32]| {
            let data: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
            Value { output, numbers: NumberType::F32, shape, data: Bytes::from(data) }
        };
        Chunk {
            sample: 0,
            first_candidate: 4,
            candidates,
            depth: 2,
            values: Vec::new(),
            spread: vec![
                value(Output::Frame, vec![1, 2, 3], frames),
                value(Output::Objects, vec![1, 6], objects),
            ],
            states: Vec::new(),
            last: false,
            spent: Spent::default(),
        }
    }

    fn numbers(value: &v1::OutputValue) -> (Vec<u32>, Vec<f32>) {
        let Some(Wire::Tensor(tensor)) = &value.value else { panic!("{value:?}") };
        let (numbers, _) = tensor.data.as_chunks::<4>();
        let numbers = numbers.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        (tensor.shape.clone(), numbers)
    }

    #[test]
    fn deviations_are_those_of_the_samples_in_any_order() {
        let samples = [
            chunk(1, &[0.0, 0.5, 1.0, 0.25, 0.25, 0.25], &[1.0, -2.0, 0.5, 0.0, 0.0, 9.0]),
            chunk(1, &[1.0, 0.5, 1.0, 0.75, 0.25, 0.25], &[1.0, 2.0, 0.5, 0.0, 0.0, 7.0]),
            chunk(1, &[0.5, 0.5, 1.0, 0.5, 0.25, 0.25], &[0.0, 3.0, 0.5, 0.0, 0.0, 8.0]),
        ];
        let mut answers = Vec::new();
        for order in [[0, 1, 2], [2, 0, 1], [1, 2, 0]] {
            let mut spread = Spread::new(3);
            assert!(spread.add(&samples[order[0]]).is_empty());
            assert!(spread.add(&samples[order[1]]).is_empty());
            let complete = spread.add(&samples[order[2]]);
            let [(4, 2, outputs)] = complete.as_slice() else { panic!("{complete:?}") };
            answers.push(outputs.iter().map(numbers).collect::<Vec<_>>());
            assert!(spread.sums.is_empty());
        }
        assert!(answers[0] == answers[1] && answers[0] == answers[2]);
        let [(frame_shape, frame), (object_shape, objects)] = answers[0].as_slice() else {
            panic!("{answers:?}")
        };
        assert_eq!((frame_shape, object_shape), (&vec![1, 1, 1, 2], &vec![1, 1, 1, 2]));
        // Red of the first pixel is 0, 1, 1/2; of the second 1/4, 3/4, 1/2; x is -2, 2, 3.
        let expected = [(1.0f32 / 6.0).sqrt() / 3.0, (1.0f32 / 24.0).sqrt() / 3.0];
        for (found, expected) in frame.iter().zip(expected) {
            assert!((found - expected).abs() < 1e-5, "{found} {expected}");
        }
        assert!((objects[0] - (14.0f32 / 3.0).sqrt()).abs() < 1e-4 && objects[1].abs() < 1e-6);
    }

    #[test]
    fn candidates_are_apart() {
        let mut spread = Spread::new(2);
        let (black, white) = ([0.0; 6], [1.0; 6]);
        let none = [0.0; 12];
        assert!(spread.add(&chunk(2, &[black, black].concat(), &none)).is_empty());
        let complete = spread.add(&chunk(2, &[white, black].concat(), &none));
        let frame = |at: usize| numbers(&complete[at].2[0]).1[0];
        assert_eq!((complete[0].0, frame(0)), (4, 0.5));
        assert_eq!((complete[1].0, frame(1)), (5, 0.0));
    }
}
