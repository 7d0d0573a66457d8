//! Blocks that are being filled.
//!
//! Vectorised kernels treat the end of a tensor differently from its beginning, so size and lane together are what
//! makes a row's bytes independent of its neighbours: two rows that want the same lane go into different blocks, and
//! empty lanes are padded.

/// Rows that are computed together; position is lane, and at least one lane is taken.
pub type Block<T> = Vec<Option<T>>;

/// Blocks of one size, no more of them than a limit.
#[derive(Debug)]
pub(super) struct Blocks<T> {
    open: Vec<Block<T>>,
    /// Rows in each lane; they lie in the first blocks.
    taken: Vec<usize>,
    most: usize,
    /// Lanes that are taken in as many blocks as there may be.
    full: usize,
}

impl<T: Copy> Blocks<T> {
    pub(super) fn new(size: usize, most: usize) -> Self {
        Self { open: Vec::new(), taken: vec![0; size], most, full: 0 }
    }

    /// Rows of each block.
    pub(super) fn size(&self) -> usize {
        self.taken.len()
    }

    /// Blocks that are open.
    pub(super) fn count(&self) -> usize {
        self.open.len()
    }

    /// Changes the limit.
    pub(super) fn limit(&mut self, most: usize) {
        self.most = most;
        self.full = self.taken.iter().filter(|taken| **taken >= most).count();
    }

    /// Rows that blocks up to the limit hold.
    pub(super) fn capacity(&self) -> usize {
        self.taken.len().saturating_mul(self.most)
    }

    /// Whether no row can be placed.
    pub(super) fn is_full(&self) -> bool {
        self.full == self.taken.len()
    }

    /// Puts a row into the first block whose lane is free; false if there is none.
    pub(super) fn place(&mut self, lane: u64, row: T) -> bool {
        let lane = (lane % self.taken.len() as u64) as usize;
        let at = self.taken[lane];
        if at == self.open.len() {
            if at >= self.most {
                return false;
            }
            self.open.push(vec![None; self.taken.len()]);
        }
        self.open[at][lane] = Some(row);
        self.taken[lane] += 1;
        self.full += usize::from(self.taken[lane] == self.most);
        true
    }

    pub(super) fn into_open(self) -> Vec<Block<T>> {
        self.open
    }
}
