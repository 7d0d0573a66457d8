//! The states of rows that are on their way through rollouts, kept where the model computes.
//!
//! A row enters when it starts, from the belief that its rollout pinned, and stays on the device until it is done.
//! Which slot belongs to whom is the scheduler's knowledge.

use std::sync::Arc;

use gatsbi_models::state::{State, StateLayout, StateRow};
use tch::{Device, Kind, Tensor};

/// Rows of states by slot.
#[derive(Debug)]
pub(super) struct Arena {
    rows: State,
}

impl Arena {
    /// An arena of `slots` rows.
    pub(super) fn new(layout: &StateLayout, slots: usize, device: Device) -> Self {
        let rows = |width: i64, kind: Kind| Tensor::zeros([slots as i64, width], (kind, device));
        Self {
            rows: State {
                floats: rows(layout.floats(), Kind::Float),
                ints: rows(layout.ints(), Kind::Int64),
            },
        }
    }

    /// Puts a host row into each of `slots`. Rows that many share, as the candidates of a rollout do, are brought to
    /// the device once.
    pub(super) fn enter(&mut self, slots: &[u32], rows: &[&Arc<StateRow>]) {
        let mut distinct: Vec<&Arc<StateRow>> = Vec::new();
        let which = rows.iter().map(|row| {
            // Sharing rows are neighbours.
            if !distinct.last().is_some_and(|last| Arc::ptr_eq(last, row)) {
                distinct.push(row);
            }
            distinct.len() as i64 - 1
        });
        let which: Vec<i64> = which.collect();
        let device = self.rows.floats.device();
        let distinct = State::from_rows(distinct.into_iter().map(AsRef::as_ref), device);
        self.put(slots, &distinct.gather(&Tensor::from_slice(&which).to_device(device)));
    }

    /// The rows in `slots`, in this order; a slot may appear more than once.
    pub(super) fn take(&self, slots: &[u32]) -> State {
        self.rows.gather(&self.index(slots))
    }

    /// Puts the rows of a batch into `slots`, one each.
    pub(super) fn put(&mut self, slots: &[u32], rows: &State) {
        let index = self.index(slots);
        let _ = self.rows.floats.index_copy_(0, &index, &rows.floats);
        let _ = self.rows.ints.index_copy_(0, &index, &rows.ints);
    }

    fn index(&self, slots: &[u32]) -> Tensor {
        let slots: Vec<i64> = slots.iter().map(|slot| i64::from(*slot)).collect();
        Tensor::from_slice(&slots).to_device(self.rows.floats.device())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_found_where_they_were_put() {
        let row = |x: f32| StateRow { floats: [x, -x].into(), ints: [x as i64].into() };
        let together = State::from_rows([&row(1.0), &row(2.0)], Device::Cpu);
        let mut arena = Arena {
            rows: State::from_rows([&row(0.0), &row(0.0), &row(0.0), &row(0.0)], Device::Cpu),
        };
        arena.put(&[3, 1], &together);
        let (five, six) = (Arc::new(row(5.0)), Arc::new(row(6.0)));
        arena.enter(&[0, 2], &[&five, &five]);
        assert_eq!(arena.take(&[0, 1, 2, 3, 1]).to_rows(), [5.0, 2.0, 5.0, 1.0, 2.0].map(row));
        arena.enter(&[3, 0, 2], &[&six, &five, &six]);
        assert_eq!(arena.take(&[0, 1, 2, 3]).to_rows(), [5.0, 2.0, 6.0, 6.0].map(row));
    }
}
