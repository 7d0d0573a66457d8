//! Data of other formats, written by the formats' own packages (`fixtures/make.py`), become data sets; data sets become other
//! formats and come back byte by byte.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

use std::{
    error::Error as _,
    path::{Path, PathBuf},
};

use gatsbi_episodes::{
    Dataset, Episode, Error, Fit, Result, WriterOptions,
    exchange::{
        Hdf5Source, ImportOptions, ImportProblem, Imported, LerobotSource, McapSource, McapWriter,
        TfrecordSource, export_lerobot, export_mcap, import_hdf5, import_lerobot, import_mcap,
        import_tfrecord,
    },
};
use tempfile::TempDir;

const HEIGHT: usize = 6;
const WIDTH: usize = 8;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

fn sample() -> Dataset {
    Dataset::open(Path::new(env!("CARGO_MANIFEST_DIR")).join("samples/push1-heldout.parquet"))
        .unwrap()
}

/// The frame of the fixtures, see `make.py`.
fn frame(episode: usize, t: usize, camera: usize, height: usize, width: usize) -> Vec<u8> {
    let pixel = |x, y| [16 * x + t, 16 * y + episode, 40 * t + 8 * episode + camera];
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| pixel(x, y)));
    pixels.flatten().map(|value| (value % 256) as u8).collect()
}

fn action(episode: usize, t: usize, dimension: usize) -> Vec<f32> {
    (0..dimension).map(|d| (episode as f64 + t as f64 / 10.0 + d as f64 / 100.0) as f32).collect()
}

#[track_caller]
fn is_fixture(episode: &Episode, number: usize, length: usize, dimension: usize) {
    assert_eq!(episode.length(), length);
    for t in 0..length {
        assert_eq!(episode.frame(t), frame(number, t, 0, HEIGHT, WIDTH), "{number} {t}");
        assert_eq!(episode.action(t), action(number, t, dimension), "{number} {t}");
    }
}

/// What an import left behind: nothing, if it failed.
struct Done {
    dir: TempDir,
    result: Result<Imported>,
}

impl Done {
    fn by(import: impl FnOnce(&Path, WriterOptions) -> Result<Imported>) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let result = import(&dir.path().join("out"), WriterOptions::default());
        if result.is_err() {
            let left: Vec<_> = fs_err::read_dir(dir.path()).unwrap().collect();
            assert!(left.is_empty(), "a failed import leaves nothing: {left:?}");
        }
        Self { dir, result }
    }

    #[track_caller]
    fn dataset(&self) -> Dataset {
        if let Err(error) = &self.result {
            panic!("{error}: {:?}", error.source());
        }
        let dataset = Dataset::open(self.dir.path().join("out")).unwrap();
        dataset.verify().unwrap();
        dataset
    }

    fn skipped(&self) -> Vec<&str> {
        self.result.as_ref().unwrap().skipped.iter().map(|part| part.what.as_str()).collect()
    }

    /// The file's name, the row and the column of a failure, and what is wrong there.
    #[track_caller]
    fn problem(self) -> (String, Option<u64>, Option<String>, ImportProblem) {
        match self.result {
            Err(Error::Import { path, row, column, source }) => {
                let name = path.file_name().unwrap().to_string_lossy().into_owned();
                (name, row, column, source)
            }
            other => panic!("{other:?}"),
        }
    }
}

fn lerobot(root: &Path, source: &LerobotSource, options: &ImportOptions) -> Done {
    Done::by(|out, writer| import_lerobot(root, out, source, options, writer, &mut |_, _| ()))
}

fn mcap(path: &Path, source: &McapSource) -> Done {
    let options = ImportOptions::default();
    Done::by(|out, writer| import_mcap(path, out, source, &options, writer, &mut |_, _| ()))
}

fn hdf5(path: &Path, source: &Hdf5Source) -> Done {
    let options = ImportOptions::default();
    Done::by(|out, writer| import_hdf5(path, out, source, &options, writer, &mut |_, _| ()))
}

fn tfrecord(path: &Path, source: &TfrecordSource) -> Done {
    let options = ImportOptions::default();
    Done::by(|out, writer| import_tfrecord(path, out, source, &options, writer, &mut |_, _| ()))
}

fn top() -> LerobotSource {
    LerobotSource { camera: Some("observation.images.top".into()), ..LerobotSource::default() }
}

/// A folder with a copy of a fixture's files.
fn copy(name: &str) -> TempDir {
    fn copy_into(from: &Path, to: &Path) {
        fs_err::create_dir_all(to).unwrap();
        for entry in fs_err::read_dir(from).unwrap() {
            let entry = entry.unwrap().path();
            let to = to.join(entry.file_name().unwrap());
            if entry.is_dir() {
                copy_into(&entry, &to);
            } else {
                fs_err::copy(&entry, &to).unwrap();
            }
        }
    }
    let dir = tempfile::tempdir().unwrap();
    copy_into(&fixture(name), &dir.path().join("copy"));
    dir
}

fn cut(path: &Path, bytes: u64) {
    let file = fs_err::OpenOptions::new().write(true).open(path).unwrap();
    file.set_len(bytes).unwrap();
}

fn length(path: &Path) -> u64 {
    fs_err::metadata(path).unwrap().len()
}

#[test]
fn a_lerobot_data_set_is_imported() {
    let source = LerobotSource { joints: Some("observation.state".into()), ..top() };
    let done = lerobot(&fixture("lerobot"), &source, &ImportOptions::default());
    let dataset = done.dataset();
    let info = dataset.info();
    assert_eq!((info.frame_period_seconds, info.width, info.height), (0.2, 8, 6));
    let names: Vec<_> = info.actions.iter().map(|action| action.name.as_str()).collect();
    assert_eq!(names, ["pan", "tilt"]);
    for (number, length) in [4, 3].into_iter().enumerate() {
        let episode = dataset.read(number).unwrap();
        is_fixture(&episode, number, length, 2);
        let joints = episode.data().joint_positions.as_ref().unwrap();
        assert_eq!(joints[3..6], [number as f32, 1.0, 0.5]);
    }
    assert_eq!(done.skipped(), ["observation.images.wrist", "tasks"]);
}

#[test]
fn frames_are_fitted_if_asked() {
    let options = ImportOptions { size: Some(3), fit: Fit::CentreCrop, ..ImportOptions::default() };
    let done = lerobot(&fixture("lerobot"), &top(), &options);
    let dataset = done.dataset();
    assert_eq!((dataset.info().width, dataset.info().height), (3, 3));
    // Halved: blue is flat, red grows by 32 from the crop's first column on.
    let episode = dataset.read(0).unwrap();
    let (pixels, _) = episode.frame(1).as_chunks::<3>();
    assert!(pixels.iter().all(|[_, _, blue]| *blue == 40), "{pixels:?}");
    let steps: Vec<_> = pixels[..3].windows(2).map(|pair| pair[1][0] - pair[0][0]).collect();
    assert!(steps.iter().all(|step| (28..=36).contains(step)), "{pixels:?}");
}

#[test]
fn a_lerobot_round_trip_loses_nothing_of_what_it_has_a_place_for() {
    let (dataset, dir) = (sample(), tempfile::tempdir().unwrap());
    let root = dir.path().join("lerobot");
    let skipped = export_lerobot(&dataset, &root, &mut |_, _| ()).unwrap();
    assert!(skipped.iter().any(|part| part.what == "mask of 6 episodes"), "{skipped:?}");
    let has_joints = dataset.read(0).unwrap().data().joint_positions.is_some();
    let joints = has_joints.then(|| "observation.state".to_owned());
    let source = LerobotSource { joints, ..LerobotSource::default() };
    let done = lerobot(&root, &source, &ImportOptions::default());
    let back = done.dataset();
    assert_same(&dataset, &back, |data| data.joint_positions.clone());
    let again = export_lerobot(&dataset, &root, &mut |_, _| ());
    assert!(matches!(again, Err(Error::NotEmpty { .. })), "{again:?}");
}

#[test]
fn an_mcap_round_trip_loses_no_frame_and_no_action() {
    let (dataset, dir) = (sample(), tempfile::tempdir().unwrap());
    let folder = dir.path().join("mcap");
    export_mcap(&dataset, &folder, &mut |_, _| ()).unwrap();
    assert_eq!(fs_err::read_dir(&folder).unwrap().count(), 6);
    let done = mcap(&folder, &McapSource::default());
    let back = done.dataset();
    assert_same(&dataset, &back, |_| None);
}

#[track_caller]
fn assert_same(
    dataset: &Dataset,
    back: &Dataset,
    joints: impl Fn(&gatsbi_episodes::EpisodeData) -> Option<Vec<f32>>,
) {
    let (one, other) = (dataset.info(), back.info());
    assert_eq!((&one.name, &one.actions), (&other.name, &other.actions));
    assert_eq!(one.frame_period_seconds.to_bits(), other.frame_period_seconds.to_bits());
    assert_eq!(dataset.len(), back.len());
    for (one, other) in dataset.iter().zip(back.iter()) {
        let (one, other) = (one.unwrap().into_data(), other.unwrap().into_data());
        assert_eq!(one.episode_id, other.episode_id);
        assert_eq!(one.length, other.length);
        assert!(one.rgb == other.rgb, "pixels of episode {}", one.episode_id);
        let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&one.actions), bits(&other.actions));
        assert_eq!(joints(&one), other.joint_positions);
    }
}

#[test]
fn videos_need_a_decoder_and_say_so() {
    let program = std::env::var("GATSBI_FFMPEG").ok().or_else(|| Some("ffmpeg".into()));
    let is_there = program.is_some_and(|program| {
        std::process::Command::new(program).arg("-version").output().is_ok()
    });
    let done =
        lerobot(&fixture("lerobot-video"), &LerobotSource::default(), &ImportOptions::default());
    if is_there {
        let dataset = done.dataset();
        assert_eq!(dataset.len(), 2);
        for (number, length) in [4, 3].into_iter().enumerate() {
            let episode = dataset.read(number).unwrap();
            assert_eq!(episode.length(), length);
            for t in 0..length {
                let expected = [40 * t + 20, 100 * number + 20, 128];
                let (pixels, _) = episode.frame(t).as_chunks::<3>();
                for (found, expected) in pixels[16 * 32 + 16].iter().zip(expected) {
                    assert!(
                        usize::from(*found).abs_diff(expected) < 12,
                        "{number} {t}: {found} {expected}"
                    );
                }
            }
        }
    } else {
        let (file, row, column, problem) = done.problem();
        assert_eq!((file.as_str(), row), ("file-000.mp4", Some(0)));
        assert_eq!(column.as_deref(), Some("observation.images.top"));
        assert!(problem.to_string().contains("apt install ffmpeg"), "{problem}");
    }
}

#[test]
fn foxglove_pictures_and_late_commands_are_imported() {
    let source = McapSource { camera: Some("/camera".into()), ..McapSource::default() };
    let done = mcap(&fixture("commands.mcap"), &source);
    let dataset = done.dataset();
    assert!((dataset.info().frame_period_seconds - 0.1).abs() < 1e-9);
    let episode = dataset.read(0).unwrap();
    assert_eq!(episode.length(), 3);
    for (t, commanded) in [1, 1, 3].into_iter().enumerate() {
        assert_eq!(episode.frame(t), frame(0, t + 1, 0, HEIGHT, WIDTH));
        assert_eq!(episode.action(t), action(0, commanded, 2));
    }
    assert_eq!(done.skipped(), ["frames before the first command (1)"]);
}

#[test]
fn ros2_pictures_and_commands_are_imported() {
    for camera in ["/image", "/image/compressed"] {
        for (topic, field) in [("/command", None), ("/joint_states", Some("velocity"))] {
            let source = McapSource {
                camera: Some(camera.into()),
                action: Some(topic.into()),
                field: field.map(str::to_owned),
            };
            let done = mcap(&fixture("ros2.mcap"), &source);
            let dataset = done.dataset();
            is_fixture(&dataset.read(0).unwrap(), 0, 4, 2);
        }
    }
}

#[test]
fn cameras_are_told_apart_by_topic() {
    let (file, _, column, problem) =
        mcap(&fixture("foxglove.mcap"), &McapSource::default()).problem();
    assert_eq!((file.as_str(), column), ("foxglove.mcap", None));
    let text = problem.to_string();
    assert!(text.contains("single camera topic"), "{text}");
    assert!(text.contains("/wrist (foxglove.RawImage)"), "{text}");
    for (camera, other) in [("/top", "/wrist (4)"), ("/wrist", "/top (4)")] {
        let source = McapSource { camera: Some(camera.into()), ..McapSource::default() };
        let done = mcap(&fixture("foxglove.mcap"), &source);
        is_fixture(&done.dataset().read(0).unwrap(), 0, 4, 2);
        assert_eq!(done.skipped(), [other]);
    }
    let source = McapSource { action: Some("/top".into()), ..McapSource::default() };
    let (.., column, problem) = mcap(&fixture("commands.mcap"), &source).problem();
    assert_eq!(column.as_deref(), Some("/top"));
    assert!(problem.to_string().contains("/command (Command)"), "{problem}");
}

#[test]
fn a_recording_is_written_as_it_happens_or_not_at_all() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("live.mcap");
    let dataset = sample();
    let episode = dataset.read(1).unwrap();
    let record = || {
        let mut writer = McapWriter::create(&path, dataset.info(), None).unwrap();
        for t in 0..3 {
            let time = 1_700_000_000_000_000_000 + t as u64 * 200_000_000;
            writer.rgb(time, 64, 64, episode.frame(t)).unwrap();
            writer.action(time, episode.action(t)).unwrap();
        }
        writer
    };
    drop(record());
    assert_eq!(fs_err::read_dir(dir.path()).unwrap().count(), 0);
    record().finish().unwrap();
    let done = mcap(&path, &McapSource::default());
    let back = done.dataset();
    let back = back.read(0).unwrap();
    assert_eq!(back.length(), 3);
    assert_eq!((back.frame(2), back.action(2)), (episode.frame(2), episode.action(2)));
}

#[test]
fn a_cut_recording_is_refused_where_it_ends() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cut.mcap");
    fs_err::copy(fixture("ros2.mcap"), &path).unwrap();
    let source =
        McapSource { camera: Some("/image".into()), action: Some("/command".into()), field: None };
    for part in [4, 2] {
        cut(&path, length(&path) / part);
        let (file, row, _, problem) = mcap(&path, &source).problem();
        assert_eq!(file, "cut.mcap");
        assert!(row.is_some());
        let why = problem.source().unwrap().to_string();
        assert!(why.contains("before its end mark"), "{why}");
    }
    fs_err::write(&path, "no recording").unwrap();
    let (.., problem) = mcap(&path, &source).problem();
    assert!(matches!(problem, ImportProblem::Layout { what: "the beginning", .. }), "{problem:?}");
}

#[test]
fn robomimic_demonstrations_are_imported_in_their_order() {
    let source = Hdf5Source { joints: Some("robot0_joint_pos".into()), ..Hdf5Source::default() };
    let done = hdf5(&fixture("robomimic.hdf5"), &source);
    let dataset = done.dataset();
    assert!((dataset.info().frame_period_seconds - 0.05).abs() < 1e-12);
    for (number, length) in [4, 3].into_iter().enumerate() {
        let episode = dataset.read(number).unwrap();
        assert_eq!(episode.id(), [2, 10][number]);
        is_fixture(&episode, number, length, 7);
        assert_eq!(episode.data().joint_positions.as_ref().unwrap()[2..4], [number as f32, 1.0]);
    }
    assert!(done.skipped().iter().any(|what| what.contains("next_obs")), "{:?}", done.skipped());
}

#[test]
fn broken_hdf5_is_refused_by_data_set() {
    let source = Hdf5Source { camera: Some("wrist_image".into()), ..Hdf5Source::default() };
    let (file, row, column, problem) = hdf5(&fixture("robomimic.hdf5"), &source).problem();
    assert_eq!(
        (file.as_str(), row, column.as_deref()),
        ("robomimic.hdf5", Some(2), Some("wrist_image"))
    );
    assert!(problem.to_string().contains("there are agentview_image"), "{problem}");
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cut.hdf5");
    fs_err::copy(fixture("robomimic.hdf5"), &path).unwrap();
    let whole = length(&path);
    for part in [10, 4, 2, 1] {
        cut(&path, whole * part / 16);
        let (file, _, column, _) = hdf5(&path, &Hdf5Source::default()).problem();
        assert_eq!(file, "cut.hdf5");
        assert!(column.is_some());
    }
}

#[test]
fn bair_records_are_imported() {
    let done = tfrecord(&fixture("bair.tfrecord"), &TfrecordSource::default());
    let dataset = done.dataset();
    assert!((dataset.info().frame_period_seconds - 0.1).abs() < 1e-12);
    for (number, length) in [4, 3].into_iter().enumerate() {
        let episode = dataset.read(number).unwrap();
        assert_eq!(episode.length(), length);
        for t in 0..length {
            assert_eq!(episode.frame(t), frame(number, t, 0, 8, 8));
            assert_eq!(episode.action(t), action(number, t, 4));
        }
    }
    assert_eq!(done.skipped(), ["{}/endeffector_pos", "{}/image_aux1/encoded"]);
    let other =
        TfrecordSource { frames: "{}/image_aux1/encoded".into(), ..TfrecordSource::default() };
    let done = tfrecord(&fixture("bair.tfrecord"), &other);
    let dataset = done.dataset();
    assert_eq!(dataset.read(1).unwrap().frame(2), frame(1, 2, 1, HEIGHT, WIDTH));
}

#[test]
fn broken_records_are_refused_by_number_and_key() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("broken.tfrecord");
    let whole = fs_err::read(fixture("bair.tfrecord")).unwrap();
    fs_err::write(&path, &whole[..whole.len() - 3]).unwrap();
    let (file, row, ..) = tfrecord(&path, &TfrecordSource::default()).problem();
    assert_eq!((file.as_str(), row), ("broken.tfrecord", Some(1)));

    let mut flipped = whole.clone();
    let middle = flipped.len() - 40;
    flipped[middle] ^= 1;
    fs_err::write(&path, flipped).unwrap();
    let (_, row, _, problem) = tfrecord(&path, &TfrecordSource::default()).problem();
    assert_eq!(row, Some(1));
    assert!(problem.to_string().contains("checksum of its contents"), "{problem}");

    let source = TfrecordSource { actions: "{}/joints".into(), ..TfrecordSource::default() };
    let (_, row, column, problem) = tfrecord(&fixture("bair.tfrecord"), &source).problem();
    assert_eq!((row, column.as_deref()), (Some(0), Some("0/joints")));
    assert!(problem.to_string().contains("0/endeffector_pos"), "{problem}");
}

#[test]
fn broken_lerobot_data_sets_are_refused_by_row_and_column() {
    let options = ImportOptions::default();
    let (file, _, column, problem) =
        lerobot(&fixture("lerobot"), &LerobotSource::default(), &options).problem();
    assert_eq!((file.as_str(), column.as_deref()), ("info.json", Some("observation.images")));
    assert!(
        problem.to_string().contains("observation.images.top, observation.images.wrist"),
        "{problem}"
    );

    let none = tempfile::tempdir().unwrap();
    let (file, ..) = lerobot(none.path(), &top(), &options).problem();
    assert_eq!(file, "info.json");

    let old = copy("lerobot");
    let info = old.path().join("copy/meta/info.json");
    let text = fs_err::read_to_string(&info).unwrap().replace("v3.0", "v2.1");
    fs_err::write(&info, text).unwrap();
    let (.., problem) = lerobot(&old.path().join("copy"), &top(), &options).problem();
    assert!(problem.to_string().contains("v2.1"), "{problem}");

    let cut_short = copy("lerobot");
    let table = cut_short.path().join("copy/data/chunk-000/file-000.parquet");
    cut(&table, length(&table) - 20);
    let (file, ..) = lerobot(&cut_short.path().join("copy"), &top(), &options).problem();
    assert_eq!(file, "file-000.parquet");

    // One byte within the pixels of a PNG: its checksum finds it.
    let flipped = copy("lerobot");
    let table = flipped.path().join("copy/data/chunk-000/file-000.parquet");
    let mut bytes = fs_err::read(&table).unwrap();
    let at = bytes.windows(4).position(|window| window == b"IDAT").unwrap();
    bytes[at + 8] ^= 0xff;
    fs_err::write(&table, bytes).unwrap();
    let (file, row, column, _) = lerobot(&flipped.path().join("copy"), &top(), &options).problem();
    assert_eq!((file.as_str(), row), ("file-000.parquet", Some(0)));
    assert_eq!(column.as_deref(), Some("observation.images.top"));
}
