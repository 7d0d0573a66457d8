//! Rows of a batch that nobody asks for.
//!
//! A batch of a fixed size has rows that only fill it up. They hold copies of the first row that is asked for, so their
//! results are known already: the kernels of frozen models compute the others alone and copy that one's into them. The
//! rows that are asked for keep their bytes, because images do not touch each other in there.

use std::{cell::RefCell, ops::Range};

thread_local! {
    static ASKED: RefCell<Vec<bool>> = const { RefCell::new(Vec::new()) };
}

/// Runs `step` on a batch whose rows are asked for where `asked` says so, at least one of them. All other rows must be
/// copies of the first of these, and what comes out for them means nothing.
pub fn asking_for<T>(asked: &[bool], step: impl FnOnce() -> T) -> T {
    /// Whatever becomes of the step, later ones compute all of their rows.
    struct Everything;
    impl Drop for Everything {
        fn drop(&mut self) {
            ASKED.take();
        }
    }
    let _everything = Everything;
    ASKED.replace(asked.to_vec());
    step()
}

/// Images that are to be computed, and where the others are copied from.
pub(crate) struct Images {
    /// Neighbours that are to be computed, in order.
    pub(crate) runs: Vec<Range<usize>>,
    /// Images of a row that is not asked for, each with the one that it takes.
    pub(crate) copies: Vec<(Range<usize>, usize)>,
}

/// What is asked for of so many images, as many of each row of the batch one after another.
pub(crate) fn images(images: usize) -> Images {
    ASKED.with_borrow(|asked| {
        let first = asked.iter().position(|asked| *asked);
        let Some(first) = first.filter(|_| images.is_multiple_of(asked.len())) else {
            return Images { runs: std::iter::once(0..images).collect(), copies: Vec::new() };
        };
        let each = images / asked.len();
        let mut found = Images { runs: Vec::new(), copies: Vec::new() };
        for (row, asked) in asked.iter().enumerate() {
            let own = row * each..(row + 1) * each;
            match found.runs.last_mut() {
                _ if !asked => found.copies.push((own, first * each)),
                Some(run) if run.end == own.start => run.end = own.end,
                _ => found.runs.push(own),
            }
        }
        found
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_asked_for_is_computed() {
        let found = asking_for(&[false, true, true, false, true], || images(10));
        assert_eq!(found.runs, [2..6, 8..10]);
        assert_eq!(found.copies, [(0..2, 2), (6..8, 2)]);
        assert_eq!(images(10).runs[0], 0..10, "afterwards everything is");
        // What is the same for all rows is computed whole.
        assert_eq!(asking_for(&[true, false], || images(3)).runs[0], 0..3);
    }
}
