//! A belief as bytes, to be kept or carried elsewhere by clients.
//!
//! All numbers are little-endian: 8 bytes `gatsbi` and two zeros; the version as u32; SHA-256 of the checkpoint, 32
//! bytes; whether observing draws as u8; seed and next step as u64; width and height of the last image as u32 each;
//! numbers of floats and integers of the state as u32 each; the floats; the integers as i64; SHA-256 of all before.
//! Another checkpoint's belief means nothing, so the hash is part of it. Nothing is believed before it is checked.

use std::sync::Arc;

use bytes::{Buf as _, BufMut as _, Bytes, BytesMut};
use gatsbi_models::state::StateRow;
use sha2::{Digest as _, Sha256};

use super::session::{Draws, Position};
use crate::{engine::models::ModelEntry, error::Error};

const MAGIC: &[u8; 8] = b"gatsbi\0\0";
const VERSION: u32 = 1;
const DIGEST: usize = 32;
const HEADER: usize = MAGIC.len() + 4 + DIGEST + 1 + 8 + 8 + 4 + 4 + 4 + 4;

/// A snapshot whose form was checked, for a model that is yet to be found.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// SHA-256 of its checkpoint.
    checkpoint: [u8; DIGEST],
    draws: Draws,
    next_step: u64,
    image: (u32, u32),
    state: StateRow,
}

/// A session's belief as bytes.
pub fn write(position: &Position) -> Bytes {
    let Position { model, draws, next_step, state, image } = position;
    let StateRow { floats, ints } = state.as_ref();
    let mut bytes = BytesMut::with_capacity(HEADER + floats.len() * 4 + ints.len() * 8 + DIGEST);
    bytes.put_slice(MAGIC);
    bytes.put_u32_le(VERSION);
    bytes.put_slice(&digest_of(&model.spec.hash));
    bytes.put_u8(draws.sample.into());
    bytes.put_u64_le(draws.seed);
    bytes.put_u64_le(*next_step);
    bytes.put_u32_le(image.0);
    bytes.put_u32_le(image.1);
    bytes.put_u32_le(floats.len() as u32);
    bytes.put_u32_le(ints.len() as u32);
    for float in floats {
        bytes.put_f32_le(*float);
    }
    for int in ints {
        bytes.put_i64_le(*int);
    }
    let digest = Sha256::digest(&bytes);
    bytes.put_slice(&digest);
    bytes.freeze()
}

/// Reads a snapshot; `field` is its path in the request.
///
/// # Errors
/// If it is no snapshot, of another version, cut short, or altered.
pub fn read(bytes: &Bytes, field: &str) -> Result<Snapshot, Error> {
    let wrong = |found: String, expected: String| Err(Error::invalid(field, found, expected));
    if bytes.len() < MAGIC.len() || !bytes.starts_with(MAGIC) {
        let found = format!("{} bytes of something else", bytes.len());
        return wrong(found, "bytes that ExportSession gave".to_owned());
    }
    let mut rest = bytes.slice(MAGIC.len()..);
    let version = rest.try_get_u32_le().unwrap_or(VERSION);
    if version != VERSION {
        return wrong(format!("of version {version}"), format!("version {VERSION}"));
    }
    if bytes.len() < HEADER {
        return wrong(format!("{} bytes", bytes.len()), format!("at least {HEADER} bytes"));
    }
    let mut checkpoint = [0; DIGEST];
    rest.copy_to_slice(&mut checkpoint);
    let sample = rest.get_u8();
    let (seed, next_step) = (rest.get_u64_le(), rest.get_u64_le());
    let image = (rest.get_u32_le(), rest.get_u32_le());
    let (floats, ints) = (rest.get_u32_le() as usize, rest.get_u32_le() as usize);
    let expected = HEADER + floats * 4 + ints * 8 + DIGEST;
    if bytes.len() != expected {
        return wrong(format!("{} bytes", bytes.len()), format!("{expected} bytes"));
    }
    let (content, digest) = bytes.split_at(bytes.len() - DIGEST);
    if Sha256::digest(content).as_slice() != digest {
        return wrong("altered".to_owned(), "bytes as ExportSession gave them".to_owned());
    }
    let floats: Box<[f32]> = (0..floats).map(|_| rest.get_f32_le()).collect();
    let ints: Box<[i64]> = (0..ints).map(|_| rest.get_i64_le()).collect();
    if sample > 1 || floats.iter().any(|float| !float.is_finite()) {
        return wrong("a belief that no model has".to_owned(), "finite numbers".to_owned());
    }
    let draws = Draws { sample: sample == 1, seed };
    Ok(Snapshot { checkpoint, draws, next_step, image, state: StateRow { floats, ints } })
}

impl Snapshot {
    /// Whether it is of a model.
    pub fn is_of(&self, model: &ModelEntry) -> bool {
        self.checkpoint == digest_of(&model.spec.hash)
    }

    /// Hash of its checkpoint, hexadecimal.
    pub fn model_hash(&self) -> String {
        let number = |bytes: &[u8]| bytes.iter().fold(0u128, |n, byte| n << 8 | u128::from(*byte));
        let (first, second) = self.checkpoint.split_at(DIGEST / 2);
        format!("{:032x}{:032x}", number(first), number(second))
    }

    /// Where a session is that goes on from here on its model, which [`Self::is_of`] has told; `field` is the snapshot's path in the request.
    ///
    /// # Errors
    /// If the belief is none of the model's.
    pub fn position(&self, model: Arc<ModelEntry>, field: &str) -> Result<Position, Error> {
        let sizes = |row: &StateRow| (row.floats.len(), row.ints.len());
        let (found, expected) = (sizes(&self.state), sizes(&model.initial));
        if found != expected {
            let text = |(floats, ints)| format!("a belief of {floats} floats and {ints} integers");
            return Err(Error::invalid(field, text(found), text(expected)));
        }
        let Self { draws, next_step, image, ref state, .. } = *self;
        Ok(Position { model, draws, next_step, state: Arc::new(state.clone()), image })
    }
}

/// The bytes of a hash that is written in hexadecimal digits; a model without one has none.
fn digest_of(hash: &str) -> [u8; DIGEST] {
    let mut digest = [0; DIGEST];
    let digits: Vec<u8> = hash.chars().filter_map(|c| c.to_digit(16)).map(|d| d as u8).collect();
    for (byte, pair) in digest.iter_mut().zip(digits.as_chunks::<2>().0) {
        *byte = pair[0] << 4 | pair[1];
    }
    digest
}

#[cfg(test)]
mod tests {
    use super::{super::session::tests::at, *};
    use crate::engine::models::made_up;

    fn refused(bytes: &[u8]) -> String {
        let error = read(&Bytes::copy_from_slice(bytes), "snapshot").unwrap_err();
        let fields = error.fields();
        assert_eq!(fields[0].field, "snapshot");
        error.to_string()
    }

    #[test]
    fn what_was_written_is_read() {
        let position = at(5);
        let bytes = write(&position);
        assert_eq!(bytes.len(), HEADER + 4 * 4 + 2 * 8 + DIGEST);
        let snapshot = read(&bytes, "snapshot").unwrap();
        assert!(snapshot.is_of(&position.model));
        assert_eq!(snapshot.model_hash(), position.model.spec.hash);
        assert!(!snapshot.is_of(&made_up(&"0b".repeat(32), 4, 2)));
        let read = snapshot.position(Arc::clone(&position.model), "snapshot").unwrap();
        assert_eq!((read.next_step, read.draws, read.image), (5, position.draws, (4, 3)));
        assert_eq!(read.state, position.state);
        let other = snapshot.position(made_up(&"0a".repeat(32), 5, 2), "snapshot").unwrap_err();
        assert!(other.to_string().contains("5 floats and 2 integers"), "{other}");
    }

    #[test]
    fn every_byte_counts() {
        let bytes = write(&at(5));
        for at in 0..bytes.len() {
            for bit in [1u8, 0x80] {
                let mut altered = bytes.to_vec();
                altered[at] ^= bit;
                refused(&altered);
            }
        }
    }

    #[test]
    fn every_length_but_the_right_one_is_refused() {
        let bytes = write(&at(5));
        for length in 0..bytes.len() {
            refused(&bytes[..length]);
        }
        refused(&[&bytes[..], &[0]].concat());
    }

    #[test]
    fn what_is_wrong_is_said() {
        let bytes = write(&at(5)).to_vec();
        assert!(refused(b"PK").contains("2 bytes of something else"));
        assert!(refused(&bytes[..bytes.len() - 1]).contains(&format!("{} bytes", bytes.len())));
        let mut newer = bytes.clone();
        newer[8] = 9;
        assert!(refused(&newer).contains("of version 9, expected version 1"));
        let mut altered = bytes.clone();
        altered[HEADER] ^= 1;
        assert!(refused(&altered).contains("altered"));
        // A forged one: sums that fit, and numbers that are none.
        let end = bytes.len() - DIGEST;
        let mut forged = bytes[..end].to_vec();
        forged[HEADER..HEADER + 4].copy_from_slice(&f32::NAN.to_le_bytes());
        let digest = Sha256::digest(&forged);
        forged.extend_from_slice(&digest);
        assert!(refused(&forged).contains("finite"));
    }
}
