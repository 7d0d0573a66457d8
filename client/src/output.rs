//! What comes back: arrays that own their numbers, PNG files and object tables, decoded once and checked.

use bytes::Bytes;
use gatsbi_proto::v1::{self, DataType, output_value};

use crate::{
    Object, Output,
    error::{Error, Result},
};

/// The outputs of a belief or of a part of a rollout.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Outputs(Vec<(Output, Value)>);

/// One output.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// Numbers.
    Array(Array),
    /// PNG files, where they were asked for.
    Png(Pngs),
    /// Objects of imagined steps.
    Tracks(Tracks),
}

/// Numbers with a shape, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    shape: Vec<usize>,
    numbers: Numbers,
}

/// The numbers of an [`Array`].
#[derive(Clone, Debug, PartialEq)]
pub enum Numbers {
    /// Images and masks: values in [0, 1] times 255.
    U8(Vec<u8>),
    /// Anything else; 16-bit floats are widened on arrival.
    F32(Vec<f32>),
    /// Identities.
    I64(Vec<i64>),
}

/// PNG files, row-major.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pngs {
    /// Axes before height and width.
    pub shape: Vec<usize>,
    /// As many files as the product of `shape`.
    pub files: Vec<Bytes>,
}

/// Objects of many imagined steps.
#[derive(Clone, Debug, PartialEq)]
pub struct Tracks {
    /// Identities, `[..., MAX]`; -1 in slots that were never filled.
    pub ids: Array,
    /// `(presence, x, y, width, height, depth)`, `[..., MAX, 6]`, units as in [`crate::Object`].
    pub values: Array,
}

impl Outputs {
    /// An output, if it was asked for and exists.
    pub fn get(&self, output: Output) -> Option<&Value> {
        self.0.iter().find(|(which, _)| *which == output).map(|(_, value)| value)
    }

    /// The numbers of an output.
    pub fn array(&self, output: Output) -> Option<&Array> {
        match self.get(output)? {
            Value::Array(array) => Some(array),
            _ => None,
        }
    }

    /// The PNG files of an output.
    pub fn png(&self, output: Output) -> Option<&Pngs> {
        match self.get(output)? {
            Value::Png(pngs) => Some(pngs),
            _ => None,
        }
    }

    /// Objects of imagined steps.
    pub fn tracks(&self) -> Option<&Tracks> {
        match self.get(Output::Objects)? {
            Value::Tracks(tracks) => Some(tracks),
            _ => None,
        }
    }

    /// All outputs.
    pub fn iter(&self) -> impl Iterator<Item = (Output, &Value)> {
        self.0.iter().map(|(output, value)| (*output, value))
    }

    pub(crate) fn push(&mut self, output: Output, value: Value) {
        self.0.push((output, value));
    }
}

impl Array {
    /// Numbers with a shape; nothing if they do not fill it.
    pub fn new(shape: Vec<usize>, numbers: Numbers) -> Option<Self> {
        fills(&shape, numbers.len()).then_some(Self { shape, numbers })
    }

    /// Size of each axis, outermost first.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The numbers.
    pub fn numbers(&self) -> &Numbers {
        &self.numbers
    }

    /// The numbers as floats: bytes as shares of 255, so that images and masks lie in [0, 1] in any encoding.
    pub fn to_f32(&self) -> Vec<f32> {
        match &self.numbers {
            Numbers::U8(bytes) => bytes.iter().map(|&byte| f32::from(byte) / 255.0).collect(),
            Numbers::F32(floats) => floats.clone(),
            Numbers::I64(integers) => integers.iter().map(|&integer| integer as f32).collect(),
        }
    }

    /// The part at `index` along the leading axes, with the others left. Panics if it is out of range, as indexing
    /// does.
    #[must_use]
    pub fn at(&self, index: &[usize]) -> Self {
        let range = range(&self.shape, index);
        let numbers = match &self.numbers {
            Numbers::U8(numbers) => Numbers::U8(numbers[range].to_vec()),
            Numbers::F32(numbers) => Numbers::F32(numbers[range].to_vec()),
            Numbers::I64(numbers) => Numbers::I64(numbers[range].to_vec()),
        };
        Self { shape: self.shape[index.len()..].to_vec(), numbers }
    }

    fn stack(leading: &[usize], parts: &[&Self]) -> Option<Self> {
        let first = *parts.first()?;
        let mut numbers = first.numbers.clone();
        for part in &parts[1..] {
            match (&mut numbers, &part.numbers) {
                _ if part.shape != first.shape => return None,
                (Numbers::U8(all), Numbers::U8(more)) => all.extend_from_slice(more),
                (Numbers::F32(all), Numbers::F32(more)) => all.extend_from_slice(more),
                (Numbers::I64(all), Numbers::I64(more)) => all.extend_from_slice(more),
                _ => return None,
            }
        }
        Self::new([leading, &first.shape].concat(), numbers)
    }
}

impl Value {
    /// The part at `index` along the leading axes. Panics if it is out of range, as indexing does.
    #[must_use]
    pub fn at(&self, index: &[usize]) -> Self {
        match self {
            Self::Array(array) => Self::Array(array.at(index)),
            Self::Png(Pngs { shape, files }) => {
                let range = range(shape, index);
                let shape = shape[index.len()..].to_vec();
                Self::Png(Pngs { shape, files: files[range].to_vec() })
            }
            Self::Tracks(Tracks { ids, values }) => {
                Self::Tracks(Tracks { ids: ids.at(index), values: values.at(index) })
            }
        }
    }

    /// Puts equally shaped parts together along new leading axes; nothing if they are not, or too few or many.
    pub(crate) fn stack(leading: &[usize], parts: &[Self]) -> Option<Self> {
        Some(match parts.first()? {
            Self::Array(_) => {
                let parts: Option<Vec<_>> = parts.iter().map(Self::as_array).collect();
                Self::Array(Array::stack(leading, &parts?)?)
            }
            Self::Png(first) => {
                let mut files = Vec::new();
                for part in parts {
                    let Self::Png(part) = part else { return None };
                    files.extend_from_slice(&part.files);
                }
                let shape = [leading, &first.shape].concat();
                fills(&shape, files.len()).then_some(Self::Png(Pngs { shape, files }))?
            }
            Self::Tracks(_) => {
                let (mut ids, mut values) = (Vec::new(), Vec::new());
                for part in parts {
                    let Self::Tracks(part) = part else { return None };
                    ids.push(&part.ids);
                    values.push(&part.values);
                }
                Self::Tracks(Tracks {
                    ids: Array::stack(leading, &ids)?,
                    values: Array::stack(leading, &values)?,
                })
            }
        })
    }

    /// Sizes of the two outermost axes.
    pub(crate) fn leading(&self) -> Option<[usize; 2]> {
        let shape = match self {
            Self::Array(array) => &array.shape,
            Self::Png(pngs) => &pngs.shape,
            Self::Tracks(tracks) if tracks.values.shape.starts_with(&tracks.ids.shape) => {
                &tracks.ids.shape
            }
            Self::Tracks(_) => return None,
        };
        shape.first_chunk().copied()
    }

    fn as_array(&self) -> Option<&Array> {
        match self {
            Self::Array(array) => Some(array),
            _ => None,
        }
    }
}

impl Tracks {
    /// The objects of one imagined step: every slot that holds or has held one. `index` goes along all axes before the
    /// slots, so `[sample, candidate, depth]` in a whole rollout. Pixels are NaN: no image was sent. Panics if `index`
    /// is out of range, as indexing does.
    pub fn objects(&self, index: &[usize]) -> Vec<Object> {
        let (ids, values) = (self.ids.at(index), self.values.at(index));
        let Numbers::I64(ids) = ids.numbers else { return Vec::new() };
        let values = values.to_f32();
        let (rows, _) = values.as_chunks::<6>();
        let object = |(slot, (id, row)): (usize, (&i64, &[f32; 6]))| {
            let [presence, x, y, width, height, depth] = *row;
            let (slot, pixel_x, pixel_y) = (slot as u32, f32::NAN, f32::NAN);
            let id = u64::try_from(*id).ok()?;
            Some(Object { id, slot, presence, x, y, width, height, depth, pixel_x, pixel_y })
        };
        ids.iter().zip(rows).enumerate().filter_map(object).collect()
    }
}

impl Numbers {
    /// How many there are.
    pub fn len(&self) -> usize {
        match self {
            Self::U8(numbers) => numbers.len(),
            Self::F32(numbers) => numbers.len(),
            Self::I64(numbers) => numbers.len(),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl TryFrom<Vec<v1::OutputValue>> for Outputs {
    type Error = Error;

    fn try_from(values: Vec<v1::OutputValue>) -> Result<Self> {
        values.into_iter().map(output).collect::<Result<_>>().map(Self)
    }
}

fn output(value: v1::OutputValue) -> Result<(Output, Value)> {
    let output = value.output();
    let value = match value.value {
        Some(output_value::Value::Tensor(tensor)) => Value::Array(tensor.try_into()?),
        Some(output_value::Value::Images(images)) => {
            let shape: Vec<usize> = images.shape.iter().map(|&axis| axis as usize).collect();
            if !fills(&shape, images.png.len()) {
                return Err(wrong(output, &format!("{} files for {shape:?}", images.png.len())));
            }
            Value::Png(Pngs { shape, files: images.png })
        }
        Some(output_value::Value::Tracks(tracks)) => match (tracks.ids, tracks.values) {
            (Some(ids), Some(values)) => {
                Value::Tracks(Tracks { ids: ids.try_into()?, values: values.try_into()? })
            }
            _ => return Err(wrong(output, "tracks without identities or values")),
        },
        None => return Err(wrong(output, "no value")),
    };
    Ok((output, value))
}

/// Whether so many elements fill a shape; its product may be more than a number can hold.
fn fills(shape: &[usize], elements: usize) -> bool {
    shape.iter().try_fold(1, |product: usize, &axis| product.checked_mul(axis)) == Some(elements)
}

/// Where the part at `index` along the leading axes of `shape` lies.
fn range(shape: &[usize], index: &[usize]) -> std::ops::Range<usize> {
    let (leading, rest) = shape.split_at(index.len());
    let offset = index.iter().zip(leading).fold(0, |offset, (&i, &axis)| {
        assert!(i < axis, "index {index:?} is out of {shape:?}");
        offset * axis + i
    });
    let length: usize = rest.iter().product();
    offset * length..(offset + 1) * length
}

fn wrong(output: Output, what: &str) -> Error {
    Error::Answer(format!("{what} in {}", output.as_str_name()))
}

impl TryFrom<v1::Tensor> for Array {
    type Error = Error;

    fn try_from(tensor: v1::Tensor) -> Result<Self> {
        let shape: Vec<usize> = tensor.shape.iter().map(|&axis| axis as usize).collect();
        let data = &tensor.data[..];
        let numbers = match tensor.dtype() {
            DataType::U8 => Some(Numbers::U8(data.to_vec())),
            DataType::F16 => {
                numbers(data, |bytes| half::f16::from_le_bytes(bytes).to_f32()).map(Numbers::F32)
            }
            DataType::F32 => numbers(data, f32::from_le_bytes).map(Numbers::F32),
            DataType::I64 => numbers(data, i64::from_le_bytes).map(Numbers::I64),
            DataType::Unspecified => None,
        };
        numbers.and_then(|numbers| Self::new(shape, numbers)).ok_or_else(|| {
            let what = format!(
                "{} bytes as {} {:?}",
                tensor.data.len(),
                tensor.dtype().as_str_name(),
                tensor.shape
            );
            Error::Answer(what)
        })
    }
}

fn numbers<T, const N: usize>(data: &[u8], number: impl Fn([u8; N]) -> T) -> Option<Vec<T>> {
    let (numbers, rest) = data.as_chunks::<N>();
    rest.is_empty().then(|| numbers.iter().map(|&bytes| number(bytes)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tensor(dtype: DataType, shape: &[u32], data: &[u8]) -> v1::Tensor {
        v1::Tensor {
            dtype: dtype as i32,
            shape: shape.to_vec(),
            data: data.to_vec().into(),
            values: Vec::new(),
        }
    }

    #[test]
    fn every_type_of_numbers_is_read() {
        let read = |tensor| Array::try_from(tensor).unwrap();
        let bytes = read(tensor(DataType::U8, &[2], &[0, 255]));
        assert_eq!(bytes.to_f32(), [0.0, 1.0]);
        let halves = [0.5, -2.0].map(|x| half::f16::from_f32(x).to_le_bytes()).concat();
        assert_eq!(read(tensor(DataType::F16, &[2], &halves)).to_f32(), [0.5, -2.0]);
        let floats = [0.1f32, 7.0].map(f32::to_le_bytes).concat();
        assert_eq!(read(tensor(DataType::F32, &[1, 2], &floats)).to_f32(), [0.1, 7.0]);
        let one = read(tensor(DataType::I64, &[], &(-1i64).to_le_bytes()));
        assert_eq!(one.numbers(), &Numbers::I64(vec![-1]));
    }

    #[test]
    fn numbers_that_do_not_fill_their_shape_are_refused() {
        for wrong in [
            tensor(DataType::F32, &[2], &[0; 7]),
            tensor(DataType::F32, &[3], &[0; 8]),
            tensor(DataType::U8, &[2, 2], &[0; 3]),
            tensor(DataType::U8, &[u32::MAX; 4], &[0; 3]),
            tensor(DataType::Unspecified, &[1], &[0]),
        ] {
            assert!(matches!(Array::try_from(wrong), Err(Error::Answer(_))));
        }
    }

    #[test]
    fn parts_are_taken_along_the_leading_axes() {
        let array = Array::new(vec![2, 3, 2], Numbers::U8((0..12).collect())).unwrap();
        let part = array.at(&[1, 2]);
        assert_eq!((part.shape(), part.numbers()), (&[2][..], &Numbers::U8(vec![10, 11])));
        assert_eq!(array.at(&[1]).shape(), [3, 2]);
        assert_eq!(array.at(&[]), array);
    }

    #[test]
    fn parts_put_together_are_the_whole() {
        let array = Array::new(vec![2, 3, 2], Numbers::U8((0..12).collect())).unwrap();
        let files: Vec<Bytes> = (0..6u8).map(|i| vec![i].into()).collect();
        let tracks = Tracks { ids: array.clone(), values: array.clone() };
        for whole in [
            Value::Array(array.clone()),
            Value::Png(Pngs { shape: vec![2, 3], files }),
            Value::Tracks(tracks),
        ] {
            let index = (0..2).flat_map(|i| (0..3).map(move |j| [i, j]));
            let mut parts: Vec<_> = index.map(|index| whole.at(&index)).collect();
            assert_eq!(Value::stack(&[2, 3], &parts), Some(whole));
            parts.pop();
            assert_eq!(Value::stack(&[2, 3], &parts), None);
        }
        let odd = [Value::Array(array.at(&[0])), Value::Array(array.at(&[0, 0]))];
        assert_eq!(Value::stack(&[2], &odd), None);
    }

    #[test]
    fn tracks_are_read_step_by_step() {
        let ids = Array::new(vec![2, 2], Numbers::I64(vec![7, -1, 7, 9])).unwrap();
        let numbers = (0..24u8).map(f32::from).collect();
        let values = Array::new(vec![2, 2, 6], Numbers::F32(numbers)).unwrap();
        let tracks = Tracks { ids, values };
        assert_eq!(tracks.objects(&[0]).len(), 1);
        let last = &tracks.objects(&[1])[1];
        assert_eq!((last.id, last.slot, last.presence, last.depth), (9, 1, 18.0, 23.0));
    }

    #[test]
    fn outputs_are_found_by_name() {
        let value = |output: Output, value| v1::OutputValue { output: output as i32, value };
        let mask = tensor(DataType::U8, &[1, 1], &[9]);
        let images = v1::Images { shape: vec![2], png: vec![Bytes::new(); 2] };
        let outputs = Outputs::try_from(vec![
            value(Output::AgentMask, Some(output_value::Value::Tensor(mask))),
            value(Output::SlotMasks, Some(output_value::Value::Images(images))),
        ])
        .unwrap();
        assert_eq!(outputs.array(Output::AgentMask).unwrap().shape(), [1, 1]);
        assert_eq!(outputs.png(Output::SlotMasks).unwrap().files.len(), 2);
        assert!(outputs.array(Output::Frame).is_none() && outputs.tracks().is_none());

        let images = v1::Images { shape: vec![3], png: vec![Bytes::new(); 2] };
        for wrong in [None, Some(output_value::Value::Images(images))] {
            assert!(Outputs::try_from(vec![value(Output::Frame, wrong)]).is_err());
        }
    }
}
