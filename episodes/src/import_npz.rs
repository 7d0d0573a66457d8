//! Imports a numpy archive (`.npz`) of equally long episodes.
//!
//! | array | dtype and shape | becomes |
//! |---|---|---|
//! | `rgb` | `u1 [E,T,H,W,3]` | `rgb` |
//! | `act` | `f4 [E,T,A]` | `actions`: the command between frame `t` and `t+1` |
//! | `lab`, optional | `u1 [E,T,H,W]` | `mask`: 0 background, 1 agent, 2 + i object i |
//! | `obj`, optional | `f4 [E,T,M,3]` | `object_positions`: the first `n` of the `M` slots, metres, NaN = not in the scene |
//! | `n`, optional | `i8` or `i4 [E]` | `object_count`; without it all `M` slots count |
//!
//! The arrays are inflated side by side, one episode at a time, so memory does not grow with the archive: each is read through
//! an archive handle of its own. `npyz` is used for the headers because the array-at-a-time readers hold whole arrays.

use std::{
    io::{self, Read},
    path::{Path, PathBuf},
};

use npyz::{NpyHeader, Order};
use zip::ZipArchive;

use crate::{
    ActionDimension, DatasetInfo, Episode, EpisodeData, Error, InvalidEpisode, LabelLegend,
    Manifest, Provenance, Result, WriterOptions,
    schema::{MAX_COLUMN_BYTES, column},
    shard::sha256_of,
    write_whole,
};

/// What an archive does not say about itself.
#[derive(Clone, Debug, PartialEq)]
pub struct NpzImport {
    /// Name of the data set.
    pub name: String,
    /// Seconds between two frames.
    pub frame_period_seconds: f64,
    /// One for each of the `A` action dimensions.
    pub actions: Vec<ActionDimension>,
    /// Program, simulator or robot that made the data.
    pub generator: String,
    /// Id of the first episode; the others count on from it.
    pub first_id: u64,
}

/// Converts archive `file` to a new data set in `dir`, which appears only when all of it is there. `progress` is told the
/// number of episodes done and of all.
///
/// # Errors
/// The `Npz*` variants of [`Error`] name the file, the array and the episode; otherwise those of [`write_whole`].
pub fn import_npz(
    file: &Path,
    dir: &Path,
    import: &NpzImport,
    options: WriterOptions,
    mut progress: impl FnMut(usize, usize),
) -> Result<Manifest> {
    let mut archives = Archives {
        rgb: open(file, "rgb")?,
        act: open(file, "act")?,
        lab: open(file, "lab")?,
        obj: open(file, "obj")?,
        n: open(file, "n")?,
    };
    let mut arrays = Arrays::open(file, &mut archives, import.actions.len())?;
    let info = arrays.info(file, import)?;
    write_whole(dir, info, options, |writer| {
        for episode in 0..arrays.episodes {
            let data = arrays.next(import.first_id, episode)?;
            let data = Episode::new(data, writer.info()).map_err(|source| Error::NpzEpisode {
                path: file.to_path_buf(),
                array: array_of(&source),
                episode,
                source,
            })?;
            writer.write(&data)?;
            progress(episode + 1, arrays.episodes);
        }
        arrays.finish()
    })
}

type Archive = ZipArchive<fs_err::File>;
type Source<'a> = Box<dyn Read + 'a>;

/// One handle for each array: an archive can be read in one place at a time.
struct Archives {
    rgb: Archive,
    act: Archive,
    lab: Archive,
    obj: Archive,
    n: Archive,
}

/// The arrays, each read up to the same episode.
struct Arrays<'a> {
    episodes: usize,
    rgb: Npy<'a>,
    act: Npy<'a>,
    lab: Option<Npy<'a>>,
    obj: Option<Npy<'a>>,
    n: Option<Npy<'a>>,
}

/// One array, read along its first axis.
struct Npy<'a> {
    path: PathBuf,
    name: &'static str,
    dtype: String,
    shape: Vec<u64>,
    /// Bytes of one entry of the first axis.
    block: usize,
    data: Source<'a>,
}

fn open(path: &Path, array: &'static str) -> Result<Archive> {
    ZipArchive::new(fs_err::File::open(path)?).map_err(|source| Error::NpzArchive {
        path: path.to_path_buf(),
        array,
        source,
    })
}

fn array_of(source: &InvalidEpisode) -> &'static str {
    match source.column() {
        Some(column::ACTIONS) => "act",
        Some(column::MASK) => "lab",
        Some(column::OBJECT_POSITIONS) => "obj",
        Some(column::OBJECT_COUNT) => "n",
        _ => "rgb",
    }
}

// === impl Arrays ===

impl<'a> Arrays<'a> {
    fn open(path: &Path, archives: &'a mut Archives, actions: usize) -> Result<Self> {
        let Archives { rgb, act, lab, obj, n } = archives;
        let rgb = Npy::open(path, rgb, "rgb", &["|u1"], &[None, None, None, None, Some(3)])?;
        let [episodes, frames, height, width] = [0, 1, 2, 3].map(|axis| Some(rgb.shape[axis]));
        let actions = Some(actions as u64);
        let act = Npy::open(path, act, "act", &["<f4"], &[episodes, frames, actions])?;
        let mask = [episodes, frames, height, width];
        let lab = Npy::open_optional(path, lab, "lab", &["|u1"], &mask)?;
        let positions = [episodes, frames, None, Some(3)];
        let obj = Npy::open_optional(path, obj, "obj", &["<f4"], &positions)?;
        let n = Npy::open_optional(path, n, "n", &["<i8", "<i4"], &[episodes])?;
        Ok(Self { episodes: rgb.shape[0] as usize, rgb, act, lab, obj, n })
    }

    fn info(&self, file: &Path, import: &NpzImport) -> Result<DatasetInfo> {
        let side = |axis: usize| u32::try_from(self.rgb.shape[axis]).unwrap_or(u32::MAX);
        let provenance = Provenance {
            generator: import.generator.clone(),
            version: None,
            source: file.file_name().map(|name| name.to_string_lossy().into_owned()),
            parameters: [("source_sha256".to_owned(), sha256_of(file)?.into())].into(),
        };
        Ok(DatasetInfo {
            name: import.name.clone(),
            height: side(2),
            width: side(3),
            channels: 3,
            frame_period_seconds: import.frame_period_seconds,
            actions: import.actions.clone(),
            labels: self.lab.is_some().then(LabelLegend::default),
            provenance: Some(provenance),
        })
    }

    fn next(&mut self, first_id: u64, episode: usize) -> Result<EpisodeData> {
        let slots = self.obj.as_ref().map(|obj| obj.shape[2]);
        let object_count = match &mut self.n {
            Some(n) => Some(n.count(episode, slots)?),
            None => slots.map(|slots| u32::try_from(slots).unwrap_or(u32::MAX)),
        };
        let object_positions = match &mut self.obj {
            Some(obj) => {
                let (slots, used) = (obj.shape[2] as usize, object_count.unwrap_or(0) as usize);
                let all = obj.floats(episode)?;
                Some(all.chunks(slots.max(1) * 3).flat_map(|t| &t[..used * 3]).copied().collect())
            }
            None => None,
        };
        Ok(EpisodeData {
            episode_id: first_id.saturating_add(episode as u64),
            length: u32::try_from(self.rgb.shape[1]).unwrap_or(u32::MAX),
            rgb: self.rgb.bytes(episode)?,
            actions: self.act.floats(episode)?,
            mask: self.lab.as_mut().map(|lab| lab.bytes(episode)).transpose()?,
            object_count,
            object_positions,
            ..EpisodeData::default()
        })
    }

    /// Reads to the end of each array, where the archive's checksums are compared.
    fn finish(&mut self) -> Result<()> {
        let Self { rgb, act, lab, obj, n, episodes } = self;
        let optional = [lab, obj, n].into_iter().filter_map(Option::as_mut);
        for array in [rgb, act].into_iter().chain(optional) {
            io::copy(&mut array.data, &mut io::sink())
                .map_err(|source| array.error(episodes.checked_sub(1), source))?;
        }
        Ok(())
    }
}

// === impl Npy ===

impl<'a> Npy<'a> {
    fn open_optional(
        path: &Path,
        archive: &'a mut Archive,
        name: &'static str,
        dtypes: &[&str],
        axes: &[Option<u64>],
    ) -> Result<Option<Self>> {
        if archive.index_for_name(&format!("{name}.npy")).is_none() {
            return Ok(None);
        }
        Self::open(path, archive, name, dtypes, axes).map(Some)
    }

    /// Reads the header and checks it: one of `dtypes`, C order, and the extents of `axes` where they are known.
    fn open(
        path: &Path,
        archive: &'a mut Archive,
        name: &'static str,
        dtypes: &[&str],
        axes: &[Option<u64>],
    ) -> Result<Self> {
        let mut data = archive.by_name(&format!("{name}.npy")).map_err(|source| {
            Error::NpzArchive { path: path.to_path_buf(), array: name, source }
        })?;
        let header = NpyHeader::from_reader(&mut data).map_err(|source| {
            let path = path.to_path_buf();
            Error::NpzRead { path, array: name, episode: None, source }
        })?;
        let layout = |what, found: String, expected: String| {
            let path = path.to_path_buf();
            Err(Error::NpzLayout { path, array: name, what, found, expected })
        };
        let dtype = header.dtype().descr().trim_matches('\'').to_owned();
        if !dtypes.contains(&dtype.as_str()) {
            return layout("dtype", dtype, dtypes.join(" or "));
        }
        if header.order() != Order::C && header.shape().len() > 1 {
            return layout("order", "Fortran".into(), "C".into());
        }
        let shape = header.shape().to_vec();
        let fits = |(&found, axis): (&u64, &Option<u64>)| axis.is_none_or(|axis| axis == found);
        if shape.len() != axes.len() || !shape.iter().zip(axes).all(fits) {
            let axes = axes.iter().map(|axis| axis.map_or_else(|| "_".into(), |n| n.to_string()));
            let expected = axes.collect::<Vec<String>>().join(", ");
            return layout("shape", format!("{shape:?}"), format!("[{expected}]"));
        }
        // The header may claim anything: nothing is allocated before its size is known to be sane.
        let width = header.dtype().num_bytes().unwrap_or(1) as u64;
        let block = shape[1..].iter().fold(width, |bytes, &n| bytes.saturating_mul(n));
        if block > MAX_COLUMN_BYTES as u64 {
            let (bytes, limit) = (block as usize, MAX_COLUMN_BYTES);
            let source = InvalidEpisode::TooLarge { column: column_of(name), bytes, limit };
            let path = path.to_path_buf();
            return Err(Error::NpzEpisode { path, array: name, episode: 0, source });
        }
        let (path, block) = (path.to_path_buf(), block as usize);
        Ok(Self { path, name, dtype, shape, block, data: Box::new(data) })
    }

    fn bytes(&mut self, episode: usize) -> Result<Vec<u8>> {
        let mut bytes = vec![0; self.block];
        self.data.read_exact(&mut bytes).map_err(|source| self.error(Some(episode), source))?;
        Ok(bytes)
    }

    fn floats(&mut self, episode: usize) -> Result<Vec<f32>> {
        let bytes = self.bytes(episode)?;
        Ok(bytes.as_chunks().0.iter().map(|&four| f32::from_le_bytes(four)).collect())
    }

    /// The entry of an array of object counts.
    fn count(&mut self, episode: usize, slots: Option<u64>) -> Result<u32> {
        let bytes = self.bytes(episode)?;
        let count = match *bytes.as_slice() {
            [a, b, c, d] => i32::from_le_bytes([a, b, c, d]).into(),
            ref eight => i64::from_le_bytes(eight.try_into().unwrap_or_default()),
        };
        let limit = slots.unwrap_or(u32::MAX.into());
        u32::try_from(count).ok().filter(|&n| u64::from(n) <= limit).ok_or_else(|| {
            Error::NpzLayout {
                path: self.path.clone(),
                array: self.name,
                what: "a value of",
                found: format!("{count} in episode {episode}"),
                expected: format!("0 to {limit} ({})", self.dtype),
            }
        })
    }

    fn error(&self, episode: Option<usize>, source: io::Error) -> Error {
        Error::NpzRead { path: self.path.clone(), array: self.name, episode, source }
    }
}

fn column_of(array: &str) -> &'static str {
    match array {
        "act" => column::ACTIONS,
        "lab" => column::MASK,
        "obj" => column::OBJECT_POSITIONS,
        "n" => column::OBJECT_COUNT,
        _ => column::RGB,
    }
}
