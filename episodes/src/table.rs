//! An episode as a row of an Arrow table and back: the only place that builds or reads Arrow arrays of episodes.

use std::sync::Arc;

use arrow_array::{
    Array, ArrayRef, BinaryArray, FixedSizeBinaryArray, LargeBinaryArray, ListArray, RecordBatch,
    UInt32Array, UInt64Array,
    builder::{FixedSizeBinaryBuilder, Float32Builder, ListBuilder},
    cast::AsArray,
    types::{Float32Type, UInt32Type, UInt64Type},
};
use arrow_schema::ArrowError;

use crate::{
    EpisodeData, InvalidEpisode,
    schema::{arrow_schema, column as c, float_item},
};

/// One row with all columns of the format.
pub(crate) fn encode(episode: &EpisodeData) -> Result<RecordBatch, ArrowError> {
    let columns: Vec<ArrayRef> = vec![
        Arc::new(UInt64Array::from(vec![episode.episode_id])),
        Arc::new(UInt32Array::from(vec![episode.length])),
        bytes(Some(&episode.rgb)),
        floats(Some(&episode.actions)),
        bytes(episode.mask.as_deref()),
        Arc::new(UInt32Array::from(vec![episode.object_count])),
        floats(episode.object_positions.as_deref()),
        floats(episode.object_pixels.as_deref()),
        floats(episode.object_poses.as_deref()),
        floats(episode.ee_pose.as_deref()),
        floats(episode.joint_positions.as_deref()),
        bytes(episode.contacts_agent.as_deref()),
        bytes(episode.contacts_objects.as_deref()),
        hash(episode.state_hash.as_ref())?,
        Arc::new(UInt64Array::from(vec![episode.seed])),
    ];
    RecordBatch::try_new(arrow_schema(), columns)
}

/// Row `row` of a batch whose column types were checked when its file was opened. Columns that are not there read as null.
pub(crate) fn decode(batch: &RecordBatch, row: usize) -> Result<EpisodeData, InvalidEpisode> {
    let rows = Rows(batch);
    Ok(EpisodeData {
        episode_id: rows.u64(c::EPISODE_ID, row).ok_or_else(|| null(c::EPISODE_ID))?,
        length: rows.u32(c::LENGTH, row).ok_or_else(|| null(c::LENGTH))?,
        rgb: rows.bytes(c::RGB, row).ok_or_else(|| null(c::RGB))?,
        actions: rows.floats(c::ACTIONS, row)?.ok_or_else(|| null(c::ACTIONS))?,
        mask: rows.bytes(c::MASK, row),
        object_count: rows.u32(c::OBJECT_COUNT, row),
        object_positions: rows.floats(c::OBJECT_POSITIONS, row)?,
        object_pixels: rows.floats(c::OBJECT_PIXELS, row)?,
        object_poses: rows.floats(c::OBJECT_POSES, row)?,
        ee_pose: rows.floats(c::EE_POSE, row)?,
        joint_positions: rows.floats(c::JOINT_POSITIONS, row)?,
        contacts_agent: rows.bytes(c::CONTACTS_AGENT, row),
        contacts_objects: rows.bytes(c::CONTACTS_OBJECTS, row),
        state_hash: rows.hash(c::STATE_HASH, row),
        seed: rows.u64(c::SEED, row),
    })
}

/// Typed access to the cells of a batch.
pub(crate) struct Rows<'a>(pub(crate) &'a RecordBatch);

impl<'a> Rows<'a> {
    pub(crate) fn u64(&self, column: &str, row: usize) -> Option<u64> {
        self.cell(column, row).map(|array| array.as_primitive::<UInt64Type>().value(row))
    }

    pub(crate) fn u32(&self, column: &str, row: usize) -> Option<u32> {
        self.cell(column, row).map(|array| array.as_primitive::<UInt32Type>().value(row))
    }

    pub(crate) fn floats(
        &self,
        column: &'static str,
        row: usize,
    ) -> Result<Option<Vec<f32>>, InvalidEpisode> {
        let Some(array) = self.cell(column, row) else { return Ok(None) };
        let list: &ListArray = array.as_list();
        let items = list.value(row);
        if items.null_count() > 0 {
            return Err(null(column));
        }
        Ok(Some(items.as_primitive::<Float32Type>().values().to_vec()))
    }

    fn bytes(&self, column: &str, row: usize) -> Option<Vec<u8>> {
        let array: &BinaryArray = self.cell(column, row)?.as_binary();
        Some(array.value(row).to_vec())
    }

    pub(crate) fn hash(&self, column: &str, row: usize) -> Option<[u8; 32]> {
        let array: &FixedSizeBinaryArray = self.cell(column, row)?.as_fixed_size_binary();
        array.value(row).try_into().ok()
    }

    fn cell(&self, column: &str, row: usize) -> Option<&'a ArrayRef> {
        self.0.column_by_name(column).filter(|array| array.is_valid(row))
    }
}

fn null(column: &'static str) -> InvalidEpisode {
    InvalidEpisode::Null { column }
}

fn bytes(value: Option<&[u8]>) -> ArrayRef {
    Arc::new(LargeBinaryArray::from(vec![value]))
}

fn floats(value: Option<&[f32]>) -> ArrayRef {
    let mut list = ListBuilder::new(Float32Builder::new()).with_field(float_item());
    list.values().append_slice(value.unwrap_or_default());
    list.append(value.is_some());
    Arc::new(list.finish())
}

fn hash(value: Option<&[u8; 32]>) -> Result<ArrayRef, ArrowError> {
    let mut cell = FixedSizeBinaryBuilder::new(32);
    match value {
        Some(value) => cell.append_value(value)?,
        None => cell.append_null(),
    }
    Ok(Arc::new(cell.finish()))
}
