//! Importing numpy archives: the mapping of the arrays, and what is refused.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

use std::{
    io::{Seek as _, SeekFrom, Write as _},
    path::{Path, PathBuf},
};

use gatsbi_episodes::{
    ActionDimension, Dataset, Error, InvalidEpisode, LabelLegend, NpzImport, WriterOptions,
    import_npz,
};
use npyz::WriterBuilder as _;
use tempfile::TempDir;
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

/// Episodes.
const E: u64 = 3;
/// Frames.
const T: u64 = 4;
/// Height.
const H: u64 = 2;
/// Width.
const W: u64 = 5;
/// Action dimensions.
const A: u64 = 2;
/// Object slots.
const M: u64 = 3;

/// The arrays of an archive as `.npy` files.
struct Arrays(Vec<(&'static str, Vec<u8>)>);

fn npy<D: npyz::AutoSerialize + Copy>(shape: &[u64], values: &[D]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let options = npyz::WriteOptions::new().default_dtype().shape(shape);
    let mut writer = options.writer(&mut bytes).begin_nd().unwrap();
    writer.extend(values.iter().copied()).unwrap();
    writer.finish().unwrap();
    bytes
}

fn numbers<D>(shape: &[u64], number: impl Fn(u64) -> D) -> Vec<D> {
    (0..shape.iter().product()).map(number).collect()
}

/// Object `i` of an episode with `n` objects is somewhere, the other slots are NaN.
fn positions() -> Vec<f32> {
    numbers(&[E, T, M, 3], |i| {
        let (episode, slot) = (i / (T * M * 3), i / 3 % M);
        if slot < episode + 1 { i as f32 } else { f32::NAN }
    })
}

impl Arrays {
    /// Episode `e` has `e + 1` objects.
    fn valid() -> Self {
        let (rgb, lab, act) = ([E, T, H, W, 3], [E, T, H, W], [E, T, A]);
        Self(vec![
            ("rgb", npy::<u8>(&rgb, &numbers(&rgb, |i| (i % 251) as u8))),
            ("lab", npy::<u8>(&lab, &numbers(&lab, |i| (i % 3) as u8))),
            ("act", npy::<f32>(&act, &numbers(&act, |i| i as f32 / 8.0))),
            ("obj", npy::<f32>(&[E, T, M, 3], &positions())),
            ("n", npy::<i64>(&[E], &[1, 2, 3])),
        ])
    }

    fn with(mut self, name: &'static str, npy: Vec<u8>) -> Self {
        self.0.retain(|(other, _)| *other != name);
        self.0.push((name, npy));
        self
    }

    fn without(mut self, name: &str) -> Self {
        self.0.retain(|(other, _)| *other != name);
        self
    }

    fn write(self, path: &Path) {
        let mut zip = ZipWriter::new(fs_err::File::create(path).unwrap());
        for (name, npy) in self.0 {
            let options =
                SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
            zip.start_file(format!("{name}.npy"), options).unwrap();
            zip.write_all(&npy).unwrap();
        }
        zip.finish().unwrap();
    }

    fn import(self) -> Imported {
        let dir = tempfile::tempdir().unwrap();
        self.write(&dir.path().join("data.npz"));
        Imported::of(dir)
    }

    #[track_caller]
    fn error(self) -> Error {
        self.import().result.unwrap_err()
    }

    /// The array and the property that make the layout wrong.
    #[track_caller]
    fn layout_error(self) -> (&'static str, &'static str) {
        match self.error() {
            Error::NpzLayout { array, what, .. } => (array, what),
            other => panic!("{other:?}"),
        }
    }
}

struct Imported {
    dir: TempDir,
    result: Result<gatsbi_episodes::Manifest, Error>,
}

impl Imported {
    fn of(dir: TempDir) -> Self {
        let action = |name: &str| ActionDimension { name: name.into(), unit: "rad/s".into() };
        let import = NpzImport {
            name: "test".into(),
            frame_period_seconds: 0.2,
            actions: vec![action("first"), action("second")],
            generator: "a test".into(),
            first_id: 100,
        };
        let file = dir.path().join("data.npz");
        let mut calls = Vec::new();
        let out = dir.path().join("out");
        let result = import_npz(&file, &out, &import, WriterOptions::default(), |done, all| {
            calls.push((done, all));
        });
        if result.is_ok() {
            assert_eq!(calls, [(1, 3), (2, 3), (3, 3)]);
        } else {
            let left: Vec<PathBuf> =
                fs_err::read_dir(dir.path()).unwrap().map(|e| e.unwrap().path()).collect();
            assert_eq!(left, [file], "a failed import leaves nothing");
        }
        Self { dir, result }
    }

    #[track_caller]
    fn dataset(self) -> Dataset {
        self.result.unwrap();
        let dataset = Dataset::open(self.dir.path().join("out")).unwrap();
        dataset.verify().unwrap();
        dataset
    }
}

#[test]
fn arrays_become_columns() {
    let imported = Arrays::valid().import();
    let _dir = imported.dir.path().to_owned();
    let dir = imported.dir.path().join("out");
    imported.result.as_ref().unwrap();
    let dataset = Dataset::open(dir).unwrap();
    let info = dataset.info();
    assert_eq!((info.height, info.width, info.action_dimension()), (2, 5, 2));
    assert_eq!(info.labels, Some(LabelLegend::default()));
    let provenance = info.provenance.as_ref().unwrap();
    assert_eq!(
        (provenance.generator.as_str(), provenance.source.as_deref()),
        ("a test", Some("data.npz"))
    );
    assert_eq!(provenance.parameters["source_sha256"].as_str().unwrap().len(), 64);
    for (e, episode) in dataset.iter().enumerate() {
        let episode = episode.unwrap();
        let n = e + 1;
        assert_eq!((episode.id(), episode.length()), (100 + e as u64, T as usize));
        assert_eq!(episode.object_count(), Some(n));
        for t in 0..T as usize {
            let row = e * T as usize + t;
            let pixels = (H * W) as usize;
            let expected: Vec<u8> =
                (row * pixels * 3..(row + 1) * pixels * 3).map(|i| (i % 251) as u8).collect();
            assert_eq!(episode.frame(t), expected);
            let expected: Vec<u8> =
                (row * pixels..(row + 1) * pixels).map(|i| (i % 3) as u8).collect();
            assert_eq!(episode.mask(t).unwrap(), expected);
            let first = (row * A as usize) as f32 / 8.0;
            assert_eq!(episode.action(t), [first, first + 0.125]);
            for i in 0..n {
                let x = ((row * M as usize + i) * 3) as f32;
                assert_eq!(episode.object_position(t, i), Some([x, x + 1.0, x + 2.0]));
            }
        }
        assert_eq!(episode.data().object_positions.as_ref().unwrap().len(), T as usize * n * 3);
    }
}

#[test]
fn only_frames_and_actions_are_required() {
    let bare = Arrays::valid().without("lab").without("obj").without("n").import();
    let episode = bare.dataset();
    assert_eq!(episode.info().labels, None);
}

#[test]
fn without_counts_every_slot_is_an_object() {
    let imported = Arrays::valid().without("n").import();
    let dataset = Dataset::open(imported.dir.path().join("out")).unwrap();
    let episode = dataset.read(0).unwrap();
    assert_eq!(episode.object_count(), Some(3));
    assert!(episode.object_position(0, 0).is_some());
    assert_eq!(episode.object_position(0, 1), None);
}

#[test]
fn counts_may_be_of_32_bits() {
    let imported = Arrays::valid().with("n", npy::<i32>(&[E], &[1, 2, 3])).import();
    let dataset = Dataset::open(imported.dir.path().join("out")).unwrap();
    assert_eq!(dataset.read(2).unwrap().object_count(), Some(3));
}

#[test]
fn an_action_that_is_not_finite_is_located() {
    let mut actions = numbers(&[E, T, A], |i| i as f32);
    actions[(T * A + 2 * A + 1) as usize] = f32::NAN;
    match Arrays::valid().with("act", npy::<f32>(&[E, T, A], &actions)).error() {
        Error::NpzEpisode { path, array: "act", episode: 1, source } => {
            assert!(path.ends_with("data.npz"));
            assert!(matches!(
                source,
                InvalidEpisode::NonFinite { column: "actions", frame: 2, dimension: 1, .. }
            ));
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_label_without_an_object_is_located() {
    let mut labels = vec![0_u8; (E * T * H * W) as usize];
    labels[(H * W) as usize] = 3;
    match Arrays::valid().with("lab", npy::<u8>(&[E, T, H, W], &labels)).error() {
        Error::NpzEpisode { array: "lab", episode: 0, source, .. } => {
            assert_eq!(source, InvalidEpisode::UnknownLabel { frame: 1, label: 3, objects: 1 });
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn other_layouts_are_refused() {
    let valid = Arrays::valid;
    let floats = npy::<f64>(&[E, T, A], &[0.0; 24]);
    assert_eq!(valid().with("act", floats).layout_error(), ("act", "dtype"));
    let three = npy::<f32>(&[E, T, 3], &[0.0; 36]);
    assert_eq!(valid().with("act", three).layout_error(), ("act", "shape"));
    let gray = npy::<u8>(&[E, T, H, W], &[0; 120]);
    assert_eq!(valid().with("rgb", gray).layout_error(), ("rgb", "shape"));
    let fewer = npy::<u8>(&[E, T - 1, H, W], &[0; 90]);
    assert_eq!(valid().with("lab", fewer).layout_error(), ("lab", "shape"));
    let mut fortran = valid();
    let (_, rgb) = &mut fortran.0[0];
    let at = rgb.windows(5).position(|w| w == b"False").unwrap();
    rgb[at..at + 5].copy_from_slice(b"True ");
    assert_eq!(fortran.layout_error(), ("rgb", "order"));
    for counts in [[1, 2, 4], [1, -1, 3]] {
        let counts = npy::<i64>(&[E], &counts);
        assert_eq!(valid().with("n", counts).layout_error(), ("n", "a value of"));
    }
}

#[test]
fn a_missing_array_is_named() {
    for name in ["rgb", "act"] {
        match Arrays::valid().without(name).error() {
            Error::NpzArchive { array, .. } => assert_eq!(array, name),
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn an_array_that_ends_early_is_located() {
    let mut arrays = Arrays::valid();
    let (_, rgb) = &mut arrays.0[0];
    rgb.truncate(rgb.len() - 1);
    match arrays.error() {
        Error::NpzRead { array: "rgb", episode: Some(2), .. } => {}
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_header_that_claims_the_impossible_allocates_nothing() {
    let mut huge = Vec::new();
    let shape = [E, 90_000_000_000, H, W, 3];
    let options = npyz::WriteOptions::<u8>::new().default_dtype().shape(&shape);
    // Only the header is written.
    drop(options.writer(&mut huge).begin_nd().unwrap());
    match Arrays::valid().with("rgb", huge).error() {
        Error::NpzEpisode {
            array: "rgb",
            source: InvalidEpisode::TooLarge { column: "rgb", .. },
            ..
        } => {}
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_damaged_archive_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    fs_err::write(dir.path().join("data.npz"), "no archive").unwrap();
    match Imported::of(dir).result {
        Err(Error::NpzArchive { array: "rgb", .. }) => {}
        other => panic!("{other:?}"),
    }

    // One byte of the stored checksum of `rgb`: the data inflates, but is not what was packed.
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("data.npz");
    Arrays::valid().write(&path);
    let bytes = fs_err::read(&path).unwrap();
    let entry = bytes.windows(4).position(|w| w == b"PK\x01\x02").unwrap();
    let mut file = fs_err::OpenOptions::new().write(true).open(&path).unwrap();
    file.seek(SeekFrom::Start(entry as u64 + 16)).unwrap();
    file.write_all(&[bytes[entry + 16] ^ 1]).unwrap();
    drop(file);
    match Imported::of(dir).result {
        Err(Error::NpzRead { array: "rgb", episode: Some(2), .. }) => {}
        other => panic!("{other:?}"),
    }
}
