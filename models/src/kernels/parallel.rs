//! Rows of a batch shared between threads.

use std::sync::{Mutex, PoisonError};

/// Runs `work` on runs of up to `size` images, given the number of the first one and the runs' part of `output`; as many
/// threads at once as libtorch is set to use. How images are shared out changes no number.
pub(super) fn for_runs(
    images: usize,
    size: usize,
    (output, image): (&mut [f32], usize),
    work: impl Fn(usize, &mut [f32]) + Sync,
) {
    let threads = (tch::get_num_threads().max(1) as usize).min(images);
    let size = size.min(images.div_ceil(threads.max(1)));
    let runs = output.chunks_mut((size * image).max(1)).enumerate();
    if threads <= 1 {
        return runs.for_each(|(run, output)| work(run * size, output));
    }
    let runs = Mutex::new(runs);
    std::thread::scope(|scope| {
        let work = || {
            loop {
                let next = runs.lock().unwrap_or_else(PoisonError::into_inner).next();
                let Some((run, output)) = next else { return };
                work(run * size, output);
            }
        };
        for _ in 1..threads {
            scope.spawn(work);
        }
        work();
    });
}

/// Runs `work` on each part of `size` numbers.
pub(super) fn for_each(output: &mut [f32], size: usize, work: impl Fn(usize, &mut [f32]) + Sync) {
    for_runs(output.len() / size, output.len().div_ceil(size), (output, size), |first, output| {
        for (i, part) in output.chunks_exact_mut(size).enumerate() {
            work(first + i, part);
        }
    });
}
