//! A frame as a model sees it, held in as few bytes as hold it exactly: sessions keep one each.

use std::sync::Arc;

/// Colours by row and column, `[3, H, W]` in [0, 1].
#[derive(Clone, Debug, PartialEq)]
pub enum Frame {
    /// In 255ths, as pictures come.
    Bytes(Arc<[u8]>),
    /// As numbers, where a client sent such.
    Floats(Arc<[f32]>),
}

impl Frame {
    /// Its numbers in order.
    pub fn floats(&self) -> Vec<f32> {
        let mut numbers = Vec::new();
        self.append_to(&mut numbers);
        numbers
    }

    /// Puts its numbers after others.
    pub fn append_to(&self, numbers: &mut Vec<f32>) {
        match self {
            Self::Bytes(bytes) => numbers.extend(bytes.iter().map(|byte| f32::from(*byte) / 255.0)),
            Self::Floats(floats) => numbers.extend_from_slice(floats),
        }
    }

    /// Bytes of memory.
    pub fn bytes(&self) -> usize {
        match self {
            Self::Bytes(bytes) => bytes.len(),
            Self::Floats(floats) => size_of_val(&**floats),
        }
    }
}
