//! Tensors of the wire: their bytes and numbers, checked against their shapes.

use std::borrow::Cow;

use bytes::Bytes;
use gatsbi_proto::v1::{DataType, Tensor};

use crate::{
    engine::commands::{NumberType, Value},
    error::Error,
};

/// The numbers of an F32 tensor, all finite; `field` is its path in the request.
///
/// # Errors
/// If it is of another type, has not as many numbers as its shape says, or one is not finite.
pub fn floats(tensor: &Tensor, field: &str) -> Result<Vec<f32>, Error> {
    if tensor.dtype() != DataType::F32 {
        let found = tensor.dtype().as_str_name();
        return Err(Error::invalid(format!("{field}.dtype"), found, "DATA_TYPE_F32"));
    }
    let numbers: Cow<'_, [f32]> = if tensor.values.is_empty() {
        let (numbers, _) = bytes_of(tensor, field, 4)?.as_chunks::<4>();
        numbers.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
    } else if !tensor.data.is_empty() {
        let expected = "either data or values";
        return Err(Error::invalid(format!("{field}.values"), "given beside data", expected));
    } else {
        let expected = count(tensor, field)?;
        if tensor.values.len() != expected {
            let field = format!("{field}.values");
            let found = format!("{} numbers", tensor.values.len());
            return Err(Error::invalid(field, found, format!("{expected} numbers")));
        }
        tensor.values.as_slice().into()
    };
    if let Some(at) = numbers.iter().position(|x| !x.is_finite()) {
        return Err(Error::invalid(format!("{field}.data[{at}]"), numbers[at], "a finite number"));
    }
    Ok(numbers.into_owned())
}

/// The numbers of a U8 tensor; `field` is its path in the request.
///
/// # Errors
/// If it has not as many as its shape says.
pub fn bytes<'a>(tensor: &'a Tensor, field: &str) -> Result<&'a [u8], Error> {
    Ok(bytes_of(tensor, field, 1)?)
}

/// An output of the engine as a tensor with the given axes before its own.
pub fn wire(value: Value, leading: &[u32]) -> Tensor {
    let dtype = match value.numbers {
        NumberType::U8 => DataType::U8,
        NumberType::F16 => DataType::F16,
        NumberType::F32 => DataType::F32,
        NumberType::I64 => DataType::I64,
    };
    let own = value.shape.iter().map(|size| *size as u32);
    let shape = leading.iter().copied().chain(own).collect();
    Tensor { dtype: dtype.into(), shape, data: value.data, values: Vec::new() }
}

/// Numbers as a tensor.
pub fn of_floats(shape: &[u32], numbers: &[f32]) -> Tensor {
    let data: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
    Tensor {
        dtype: DataType::F32.into(),
        shape: shape.to_vec(),
        data: data.into(),
        values: Vec::new(),
    }
}

fn bytes_of<'a>(tensor: &'a Tensor, field: &str, width: usize) -> Result<&'a Bytes, Error> {
    let expected = count(tensor, field)?.saturating_mul(width);
    if tensor.data.len() == expected {
        return Ok(&tensor.data);
    }
    let found = format!("{} bytes", tensor.data.len());
    let expected = format!("{expected} bytes for shape {:?}", tensor.shape);
    Err(Error::invalid(format!("{field}.data"), found, expected))
}

fn count(tensor: &Tensor, field: &str) -> Result<usize, Error> {
    let mut sizes = tensor.shape.iter().map(|size| *size as usize);
    let count = sizes.try_fold(1usize, usize::checked_mul);
    let too_many = || {
        let found = format!("{:?}", tensor.shape);
        Error::invalid(format!("{field}.shape"), found, "a shape of a message's size")
    };
    count.ok_or_else(too_many)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tensor(shape: &[u32], data: &[u8], values: &[f32]) -> Tensor {
        Tensor {
            dtype: DataType::F32.into(),
            shape: shape.to_vec(),
            data: Bytes::copy_from_slice(data),
            values: values.to_vec(),
        }
    }

    #[test]
    fn numbers_come_from_bytes_or_from_a_list() {
        let data = [1.0f32, -2.5].map(f32::to_le_bytes).concat();
        assert_eq!(floats(&tensor(&[1, 2], &data, &[]), "x").unwrap(), [1.0, -2.5]);
        assert_eq!(floats(&tensor(&[2], &[], &[1.0, -2.5]), "x").unwrap(), [1.0, -2.5]);
        assert!(floats(&tensor(&[2, 0], &[], &[]), "x").unwrap().is_empty());
    }

    #[test]
    fn what_does_not_fit_is_told_by_field() {
        let data = [1.0f32, f32::INFINITY].map(f32::to_le_bytes).concat();
        let field = |tensor: &Tensor| floats(tensor, "x").unwrap_err().fields()[0].field.clone();
        assert_eq!(field(&tensor(&[2], &data, &[])), "x.data[1]");
        assert_eq!(field(&tensor(&[3], &data, &[])), "x.data");
        assert_eq!(field(&tensor(&[3], &[], &[1.0])), "x.values");
        assert_eq!(field(&tensor(&[1], &data, &[1.0])), "x.values");
        assert_eq!(field(&tensor(&[u32::MAX; 4], &[], &[])), "x.shape");
        assert_eq!(field(&Tensor::default()), "x.dtype");
    }
}
