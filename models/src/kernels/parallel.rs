//! Rows of a batch shared between threads.

use std::sync::{Mutex, PoisonError};

use crate::idle;

/// Runs `work` on runs of up to `size` images, given the number of the first one and the runs' part of `output`; as many
/// threads at once as libtorch is set to use. How images are shared out changes no number. Images of rows that are
/// [`idle`] are copied instead; returns how many were computed.
pub(super) fn for_runs(
    images: usize,
    size: usize,
    (output, image): (&mut [f32], usize),
    work: impl Fn(usize, &mut [f32]) + Sync,
) -> usize {
    let idle::Images { runs: asked, copies } = idle::images(images);
    let count: usize = asked.iter().map(ExactSizeIterator::len).sum();
    let threads = (tch::get_num_threads().max(1) as usize).min(count);
    let size = size.min(count.div_ceil(threads.max(1)));
    let (mut runs, mut rest, mut end) = (Vec::new(), &mut *output, 0);
    for run in asked {
        let _idle = rest.split_off_mut(..(run.start - end) * image);
        let own = rest.split_off_mut(..run.len() * image).unwrap_or_default();
        end = run.end;
        let starts = run.step_by(size.max(1));
        runs.extend(starts.zip(own.chunks_mut((size * image).max(1))));
    }
    share(threads, runs, &work);
    for (idle, from) in copies {
        let width = idle.len() * image;
        output.copy_within(from * image..from * image + width, idle.start * image);
    }
    count
}

fn share(
    threads: usize,
    runs: Vec<(usize, &mut [f32])>,
    work: &(impl Fn(usize, &mut [f32]) + Sync),
) {
    if threads <= 1 {
        return runs.into_iter().for_each(|(first, output)| work(first, output));
    }
    let runs = Mutex::new(runs.into_iter());
    std::thread::scope(|scope| {
        let work = || {
            loop {
                let next = runs.lock().unwrap_or_else(PoisonError::into_inner).next();
                let Some((first, output)) = next else { return };
                work(first, output);
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
