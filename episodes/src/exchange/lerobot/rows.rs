//! The tables of a LeRobotDataset, read row by row.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use arrow_array::{
    Array, ArrayRef, RecordBatch, StructArray,
    cast::AsArray,
    types::{Float32Type, Float64Type, Int32Type, Int64Type},
};
use arrow_schema::DataType;
use parquet::arrow::{
    ProjectionMask,
    arrow_reader::{ArrowReaderOptions, ParquetRecordBatchReader, ParquetRecordBatchReaderBuilder},
};

use crate::{Result, exchange::ImportProblem, shard::guarded};

/// Rows decoded at once: pictures are large.
const BATCH: usize = 32;

/// Some columns of a table file, from the first row to the last.
pub(super) struct Table {
    pub(super) path: PathBuf,
    reader: ParquetRecordBatchReader,
    batch: RecordBatch,
    /// Row within the batch, and within the file.
    at: usize,
    pub(super) row: u64,
}

impl Table {
    /// Opens `path` for columns `wanted`, all of which must be there.
    pub(super) fn open(path: &Path, wanted: &[&str]) -> Result<Self> {
        let damaged = |e| ImportProblem::damaged("its Parquet footer", e).at(path, None, None);
        let file = fs_err::File::open(path)?.into_parts().0;
        let options = ArrowReaderOptions::new().with_skip_arrow_metadata(true);
        let builder =
            guarded(|| ParquetRecordBatchReaderBuilder::try_new_with_options(file, options))
                .map_err(damaged)?;
        let schema = builder.schema();
        if let Some(missing) = wanted.iter().find(|name| schema.field_with_name(name).is_err()) {
            let there: Vec<_> = schema.fields().iter().map(|f| f.name().as_str()).collect();
            let expected = format!("the table has {}", there.join(", "));
            let what = "such column".into();
            let problem = ImportProblem::Missing { what, expected };
            return Err(problem.at(path, None, Some(missing)));
        }
        let roots: Vec<usize> = (0..schema.fields().len())
            .filter(|&i| wanted.contains(&schema.field(i).name().as_str()))
            .collect();
        let mask = ProjectionMask::roots(builder.parquet_schema(), roots);
        let reader = guarded(|| builder.with_projection(mask).with_batch_size(BATCH).build())
            .map_err(damaged)?;
        let batch = RecordBatch::new_empty(Arc::new(arrow_schema::Schema::empty()));
        Ok(Self { path: path.to_path_buf(), reader, batch, at: 0, row: 0 })
    }

    /// The next row, `None` after the last.
    pub(super) fn next(&mut self) -> Result<Option<Row<'_>>> {
        while self.at == self.batch.num_rows() {
            let reader = &mut self.reader;
            let read = guarded(|| Ok(reader.next().transpose()?));
            let read = read.map_err(|e| {
                ImportProblem::damaged("its rows from here on", e).at(
                    &self.path,
                    Some(self.row),
                    None,
                )
            })?;
            let Some(batch) = read else { return Ok(None) };
            (self.batch, self.at) = (batch, 0);
        }
        let row = Row { path: &self.path, batch: &self.batch, at: self.at, place: self.row };
        self.at += 1;
        self.row += 1;
        Ok(Some(row))
    }
}

/// One row of a table.
#[derive(Clone, Copy)]
pub(super) struct Row<'a> {
    path: &'a Path,
    batch: &'a RecordBatch,
    at: usize,
    /// In the file.
    place: u64,
}

impl Row<'_> {
    /// A vector of numbers, rounded to single precision; a scalar is one of one.
    pub(super) fn vector(&self, column: &str) -> Result<Vec<f32>> {
        let array = self.column(column)?;
        numbers(array, self.at).ok_or_else(|| {
            self.wrong(column, array, "numbers, or lists of them, none of them null")
        })
    }

    /// A whole number that is not negative.
    pub(super) fn index(&self, column: &str) -> Result<u64> {
        let array = self.column(column)?;
        let value = match array.data_type() {
            _ if array.is_null(self.at) => None,
            DataType::Int64 => u64::try_from(array.as_primitive::<Int64Type>().value(self.at)).ok(),
            DataType::Int32 => u64::try_from(array.as_primitive::<Int32Type>().value(self.at)).ok(),
            _ => None,
        };
        value.ok_or_else(|| self.wrong(column, array, "a whole number that is not negative"))
    }

    /// A number.
    pub(super) fn number(&self, column: &str) -> Result<f64> {
        let array = self.column(column)?;
        let value = match array.data_type() {
            _ if array.is_null(self.at) => None,
            DataType::Float64 => Some(array.as_primitive::<Float64Type>().value(self.at)),
            DataType::Float32 => Some(array.as_primitive::<Float32Type>().value(self.at).into()),
            _ => None,
        };
        value.ok_or_else(|| self.wrong(column, array, "a number"))
    }

    /// The file of a picture, from the table or from the path that stands there.
    pub(super) fn picture(&self, column: &str, root: &Path) -> Result<Vec<u8>> {
        let array = self.column(column)?;
        let cell = array.as_any().downcast_ref::<StructArray>();
        let part = |name: &str| cell.and_then(|cell| cell.column_by_name(name));
        let bytes = part("bytes").and_then(|bytes| bytes.as_binary_opt::<i32>());
        if let Some(bytes) = bytes.filter(|bytes| bytes.is_valid(self.at)) {
            return Ok(bytes.value(self.at).to_vec());
        }
        let path = part("path").and_then(|path| path.as_string_opt::<i32>());
        match path.filter(|path| path.is_valid(self.at)) {
            Some(path) => Ok(fs_err::read(root.join(path.value(self.at)))?),
            None => {
                Err(self.wrong(column, array, "a structure of bytes and path, one of them set"))
            }
        }
    }

    pub(super) fn problem(&self, column: &str, problem: ImportProblem) -> crate::Error {
        problem.at(self.path, Some(self.place), Some(column))
    }

    fn column(&self, name: &str) -> Result<&ArrayRef> {
        self.batch.column_by_name(name).ok_or_else(|| {
            let (what, expected) = ("such column".into(), "the table was opened for it".into());
            self.problem(name, ImportProblem::Missing { what, expected })
        })
    }

    fn wrong(&self, column: &str, array: &ArrayRef, expected: &str) -> crate::Error {
        let kind = if array.is_null(self.at) { "a null of type" } else { "a value of type" };
        let found = format!("{kind} {}", array.data_type());
        let expected = expected.into();
        self.problem(column, ImportProblem::Layout { what: "the value", found, expected })
    }
}

fn numbers(array: &ArrayRef, row: usize) -> Option<Vec<f32>> {
    if array.is_null(row) {
        return None;
    }
    let Some(list) = array.as_list_opt::<i32>() else { return Some(vec![number(array, row)?]) };
    let items = list.value(row);
    (0..items.len()).map(|i| number(&items, i)).collect()
}

fn number(array: &ArrayRef, at: usize) -> Option<f32> {
    match array.data_type() {
        _ if array.is_null(at) => None,
        DataType::Float32 => Some(array.as_primitive::<Float32Type>().value(at)),
        DataType::Float64 => Some(array.as_primitive::<Float64Type>().value(at) as f32),
        DataType::Int64 => Some(array.as_primitive::<Int64Type>().value(at) as f32),
        DataType::Int32 => Some(array.as_primitive::<Int32Type>().value(at) as f32),
        DataType::Boolean => Some(f32::from(u8::from(array.as_boolean().value(at)))),
        _ => None,
    }
}
