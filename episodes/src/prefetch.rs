//! Reads ahead in the background for training: whole episodes or random crops, shuffled anew each epoch.
//!
//! Sample number `i` is a pure function of the seed and `i`: epoch `i / len`, a permutation drawn from (seed, epoch), a crop
//! start drawn from (seed, epoch, episode). Thread `w` of `W` reads the samples `w, w+W, ...` into a bounded channel of its own
//! and the consumer takes from the channels in turn, so the order does not depend on the number of threads or their speed, and
//! training resumes at sample `i` by asking for it.

use std::{
    num::NonZeroUsize,
    sync::{
        Arc,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread::{Builder, JoinHandle},
};

use rand::{RngExt as _, SeedableRng as _, rngs::ChaCha8Rng, seq::SliceRandom as _};

use crate::{Clip, Dataset, Error, Result};

/// What to read and in which order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PrefetchOptions {
    /// Decides the order of the episodes and the crops.
    pub seed: u64,
    /// Whether each epoch has an order of its own; otherwise that of the data set.
    pub shuffle: bool,
    /// Frames of a random crop, one of each episode an epoch; `None` for whole episodes.
    pub crop: Option<NonZeroUsize>,
    /// How often each episode is seen; `None` for ever.
    pub epochs: Option<u64>,
    /// Number of the first sample: 0, or where an interrupted run goes on.
    pub first_sample: u64,
    /// Reading threads.
    pub threads: NonZeroUsize,
    /// Samples that each thread may be ahead of the consumer.
    pub depth: NonZeroUsize,
}

/// An iterator of clips that are read in the background. Dropping it ends its threads.
#[derive(Debug)]
pub struct Prefetch {
    /// Emptied on drop, so that the threads see that nobody listens.
    channels: Vec<Receiver<Result<Clip>>>,
    threads: Vec<JoinHandle<()>>,
    next: u64,
    end: u64,
}

impl Default for PrefetchOptions {
    /// Whole episodes in shuffled order for ever, one thread, four samples ahead.
    fn default() -> Self {
        Self {
            seed: 0,
            shuffle: true,
            crop: None,
            epochs: None,
            first_sample: 0,
            threads: NonZeroUsize::MIN,
            depth: NonZeroUsize::MIN.saturating_add(3),
        }
    }
}

impl Prefetch {
    /// Starts reading.
    ///
    /// # Errors
    /// [`Error::TooShort`] if an episode has fewer frames than a crop; [`Error::Thread`] if a thread cannot be started. What
    /// goes wrong while reading is an item of the iterator.
    pub fn start(dataset: &Arc<Dataset>, options: PrefetchOptions) -> Result<Self> {
        let lengths: Vec<usize> = dataset.summaries()?.iter().map(|e| e.length).collect();
        if let Some(crop) = options.crop.map(NonZeroUsize::get)
            && let Some(index) = lengths.iter().position(|&frames| frames < crop)
        {
            return Err(Error::TooShort { index, frames: lengths[index], crop });
        }
        let end = match options.epochs {
            _ if dataset.is_empty() => 0,
            Some(epochs) => epochs.saturating_mul(dataset.len() as u64),
            None => u64::MAX,
        };
        let mut prefetch =
            Self { channels: Vec::new(), threads: Vec::new(), next: options.first_sample, end };
        let lengths: Arc<[usize]> = lengths.into();
        for thread in 0..options.threads.get() {
            let (sender, receiver) = sync_channel(options.depth.get());
            let (dataset, lengths) = (Arc::clone(dataset), Arc::clone(&lengths));
            let samples = (options.first_sample.saturating_add(thread as u64)..end)
                .step_by(options.threads.get());
            let work = move || read_ahead(&dataset, &lengths, options, samples, &sender);
            let builder = Builder::new().name(format!("episodes-{thread}"));
            prefetch.threads.push(builder.spawn(work).map_err(Error::Thread)?);
            prefetch.channels.push(receiver);
        }
        Ok(prefetch)
    }

    /// Number of the sample that comes next: what [`PrefetchOptions::first_sample`] must be to go on from here.
    pub fn next_sample(&self) -> u64 {
        self.next
    }
}

impl Iterator for Prefetch {
    type Item = Result<Clip>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.next >= self.end {
            return None;
        }
        // Sample `next` is the turn of the thread that started as many samples after the first one, modulo the threads; rotating
        // the list keeps it in front.
        let received = self.channels[0].recv();
        self.channels.rotate_left(1);
        self.next += 1;
        Some(received.unwrap_or_else(|_| {
            let sample = self.next - 1;
            self.next = self.end;
            Err(Error::Prefetch { sample })
        }))
    }
}

impl Drop for Prefetch {
    fn drop(&mut self) {
        self.channels.clear();
        for thread in self.threads.drain(..) {
            // A panic of the thread was reported as the error of the sample it owed.
            thread.join().ok();
        }
    }
}

fn read_ahead(
    dataset: &Dataset,
    lengths: &[usize],
    options: PrefetchOptions,
    samples: impl Iterator<Item = u64>,
    sender: &SyncSender<Result<Clip>>,
) {
    let mut order = Order::new(lengths.len(), options);
    for sample in samples {
        let (epoch, index) = order.of(sample);
        if sender.send(read(dataset, lengths, options, epoch, index)).is_err() {
            return;
        }
    }
}

fn read(
    dataset: &Dataset,
    lengths: &[usize],
    options: PrefetchOptions,
    epoch: u64,
    index: usize,
) -> Result<Clip> {
    let episode = dataset.read(index)?;
    let Some(crop) = options.crop.map(NonZeroUsize::get) else { return Ok(Clip::whole(episode)) };
    let start = rng(options.seed, epoch, Some(index)).random_range(0..=lengths[index] - crop);
    Clip::cut(&episode, start, crop).map_err(|source| dataset.row_error(index, source))
}

/// The permutation of the epoch that a thread is in.
struct Order {
    options: PrefetchOptions,
    epoch: Option<u64>,
    indices: Vec<usize>,
}

impl Order {
    fn new(len: usize, options: PrefetchOptions) -> Self {
        Self { options, epoch: None, indices: (0..len).collect() }
    }

    /// Epoch and episode index of a sample.
    fn of(&mut self, sample: u64) -> (u64, usize) {
        let len = self.indices.len() as u64;
        let (epoch, position) = (sample / len, (sample % len) as usize);
        if self.options.shuffle && self.epoch != Some(epoch) {
            self.indices.sort_unstable();
            self.indices.shuffle(&mut rng(self.options.seed, epoch, None));
            self.epoch = Some(epoch);
        }
        (epoch, self.indices[position])
    }
}

/// A generator of its own for each purpose, so that no draw shifts another.
fn rng(seed: u64, epoch: u64, episode: Option<usize>) -> ChaCha8Rng {
    let mut key = [0; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..16].copy_from_slice(&epoch.to_le_bytes());
    if let Some(episode) = episode {
        key[16..24].copy_from_slice(&(episode as u64).to_le_bytes());
        key[24] = 1;
    }
    ChaCha8Rng::from_seed(key)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        DatasetWriter, WriterOptions,
        testing::{episode, info},
    };

    const LENGTHS: [u32; 7] = [6, 9, 7, 6, 12, 8, 10];

    fn dataset() -> (tempfile::TempDir, Arc<Dataset>) {
        let dir = tempfile::tempdir().unwrap();
        let options = WriterOptions { shard_bytes: 20_000, zstd_level: 1 };
        let mut writer = DatasetWriter::create(dir.path(), info(), options).unwrap();
        for (id, length) in (0..).zip(LENGTHS) {
            writer.write(&episode(id, length, 2)).unwrap();
        }
        writer.finish().unwrap();
        let dataset = Arc::new(Dataset::open(dir.path()).unwrap());
        (dir, dataset)
    }

    fn options(threads: usize, crop: usize) -> PrefetchOptions {
        let [threads, depth] = [threads, 2].map(|n| NonZeroUsize::new(n).unwrap());
        let crop = NonZeroUsize::new(crop);
        PrefetchOptions { seed: 7, epochs: Some(3), crop, threads, depth, ..Default::default() }
    }

    fn samples(dataset: &Arc<Dataset>, options: PrefetchOptions) -> Vec<(u64, usize, usize)> {
        let clips = Prefetch::start(dataset, options).unwrap();
        let clips = clips.map(|clip| clip.unwrap());
        clips.map(|clip| (clip.frames().id(), clip.start(), clip.frames().length())).collect()
    }

    #[test]
    fn the_order_depends_on_the_seed_alone() {
        let (_dir, dataset) = dataset();
        let expected = samples(&dataset, options(1, 4));
        for threads in [1, 2, 3, 8] {
            assert_eq!(samples(&dataset, options(threads, 4)), expected, "{threads} threads");
        }
        let other = PrefetchOptions { seed: 8, ..options(1, 4) };
        assert_ne!(samples(&dataset, other), expected);
    }

    #[test]
    fn each_epoch_sees_each_episode_once_in_an_order_of_its_own() {
        let (_dir, dataset) = dataset();
        let samples = samples(&dataset, options(2, 4));
        let epochs: Vec<Vec<_>> = samples.chunks(7).map(<[_]>::to_vec).collect();
        assert_eq!(epochs.len(), 3);
        for epoch in &epochs {
            let mut ids: Vec<_> = epoch.iter().map(|s| s.0).collect();
            ids.sort_unstable();
            assert_eq!(ids, [0, 1, 2, 3, 4, 5, 6]);
        }
        assert_ne!(epochs[0], epochs[1]);
        assert_ne!(epochs[1], epochs[2]);
    }

    #[test]
    fn without_shuffling_the_order_is_that_of_the_file() {
        let (_dir, dataset) = dataset();
        let in_order = PrefetchOptions { shuffle: false, epochs: Some(2), ..options(2, 0) };
        let expected: Vec<_> =
            (0..).zip(LENGTHS).map(|(id, length)| (id, 0, length as usize)).collect();
        assert_eq!(samples(&dataset, in_order), expected.repeat(2));
    }

    #[test]
    fn crops_reach_both_ends_and_carry_the_leading_action() {
        let (_dir, dataset) = dataset();
        let many = PrefetchOptions { epochs: Some(60), ..options(2, 6) };
        let mut seen = [[false; 7]; 7];
        for clip in Prefetch::start(&dataset, many).unwrap() {
            let clip = clip.unwrap();
            let (id, start) = (clip.frames().id(), clip.start());
            let episode = episode(id, LENGTHS[id as usize], 2);
            let before = start.checked_sub(1).map(|before| episode.action(before));
            assert_eq!(clip.leading_action(), before);
            for k in 0..6 {
                assert_eq!(clip.frames().frame(k), episode.frame(start + k));
            }
            seen[id as usize][start] = true;
        }
        for (starts, length) in seen.iter().zip(LENGTHS) {
            let possible = length as usize - 6 + 1;
            assert!(starts[..possible].iter().all(|&s| s), "{starts:?} of {length} frames");
        }
    }

    #[test]
    fn an_interrupted_run_goes_on_where_it_was() {
        let (_dir, dataset) = dataset();
        let all = samples(&dataset, options(1, 4));
        for threads in [1, 3] {
            let mut prefetch = Prefetch::start(&dataset, options(threads, 4)).unwrap();
            for _ in 0..10 {
                prefetch.next().unwrap().unwrap();
            }
            let first_sample = prefetch.next_sample();
            assert_eq!(first_sample, 10);
            let rest = PrefetchOptions { first_sample, ..options(threads, 4) };
            assert_eq!(samples(&dataset, rest), all[10..]);
        }
    }

    #[test]
    fn endless_epochs_end_with_the_consumer() {
        let (_dir, dataset) = dataset();
        let endless = PrefetchOptions { epochs: None, ..options(3, 4) };
        let mut prefetch = Prefetch::start(&dataset, endless).unwrap();
        for _ in 0..50 {
            prefetch.next().unwrap().unwrap();
        }
        // Joins the threads, which are blocked on full channels.
        drop(prefetch);
    }

    #[test]
    fn too_long_crops_are_refused_before_anything_is_read() {
        let (_dir, dataset) = dataset();
        let refused = Prefetch::start(&dataset, options(1, 7));
        assert!(
            matches!(refused, Err(Error::TooShort { index: 0, frames: 6, crop: 7 })),
            "{refused:?}"
        );
    }

    #[test]
    fn an_empty_data_set_yields_nothing() {
        let dir = tempfile::tempdir().unwrap();
        DatasetWriter::create(dir.path(), info(), WriterOptions::default()).unwrap();
        let dataset = Arc::new(Dataset::open(dir.path()).unwrap());
        let endless = PrefetchOptions { epochs: None, ..options(2, 4) };
        assert_eq!(samples(&dataset, endless), []);
    }
}
