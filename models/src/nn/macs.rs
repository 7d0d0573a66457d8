//! Counting multiply-accumulates of the layers, for cost predictions and roofline figures.

use std::cell::Cell;

thread_local! {
    static MACS: Cell<u64> = const { Cell::new(0) };
}

/// Runs `compute` and returns its result with the multiply-accumulates of all linear, convolutional and
/// recurrent layers it ran on this thread. Padding counts as computed; activations, norms, crops and
/// attention sums do not count.
pub fn count_macs<T>(compute: impl FnOnce() -> T) -> (T, u64) {
    let before = MACS.get();
    let result = compute();
    (result, MACS.get() - before)
}

pub(crate) fn add(macs: usize) {
    MACS.set(MACS.get() + macs as u64);
}
