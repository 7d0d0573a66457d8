//! Data sets: the same whatever the threads, whole when interrupted, and never two in one folder.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

use std::{num::NonZeroUsize, path::Path};

use gatsbi_episodes::{Dataset, EpisodeSummary};
use gatsbi_sim::{
    Error, Scene, episode_seed,
    generate::{Generation, generate},
    look::{SheetOptions, Statistics, sheet},
};

fn generation(scene: Scene, episodes: u64, threads: usize) -> Generation {
    let threads = NonZeroUsize::new(threads).unwrap();
    Generation { scene, episodes, seed: 7, size: 16, threads, shard_bytes: 8 << 20 }
}

fn make(generation: Generation, out: &Path) -> Vec<EpisodeSummary> {
    generate(&generation, out, |_, _| {}).unwrap();
    Dataset::open(out).unwrap().summaries().unwrap()
}

fn bytes(folder: &Path) -> Vec<u8> {
    fs_err::read(folder.join("episodes-00000.parquet")).unwrap()
}

#[test]
fn threads_change_nothing() {
    let folder = tempfile::tempdir().unwrap();
    for scene in [Scene::Push1, Scene::Balls6] {
        let [one, two] = [1, 2].map(|threads| {
            let out = folder.path().join(format!("{scene}-{threads}"));
            make(generation(scene, 3, threads), &out);
            bytes(&out)
        });
        assert!(one == two, "{scene}: one thread and two made different files");
    }
}

#[test]
fn an_interrupted_run_goes_on_where_it_stopped() {
    let folder = tempfile::tempdir().unwrap();
    let [whole, parts] = ["whole", "parts"].map(|name| folder.path().join(name));
    let expected = make(generation(Scene::Balls3, 4, 2), &whole);
    make(generation(Scene::Balls3, 2, 2), &parts);
    // What a killed run leaves behind.
    fs_err::write(parts.join(".episodes-00001.parquet.partial"), b"half").unwrap();
    let mut told = Vec::new();
    generate(&generation(Scene::Balls3, 4, 1), &parts, |done, all| told.push((done, all))).unwrap();
    assert_eq!(told, [(2, 4), (3, 4), (4, 4)]);
    let found = Dataset::open(&parts).unwrap();
    found.verify().unwrap();
    assert_eq!(found.summaries().unwrap(), expected);
    assert_eq!(expected[3].seed, Some(episode_seed(7, 3)));
    assert_ne!(expected[2].state_hash, expected[3].state_hash);
}

#[test]
fn a_folder_with_another_data_set_is_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    make(generation(Scene::Balls3, 1, 1), folder.path());
    let before = bytes(folder.path());
    let other = [
        (Generation { seed: 8, ..generation(Scene::Balls3, 2, 1) }, "seed is 7, not 8"),
        (Generation { size: 32, ..generation(Scene::Balls3, 2, 1) }, "height is 16, not 32"),
        (generation(Scene::Balls6, 2, 1), "name is \"balls3\", not \"balls6\""),
    ];
    for (generation, sentence) in other {
        let error = generate(&generation, folder.path(), |_, _| {}).unwrap_err();
        assert!(matches!(error, Error::OtherDataset { .. }), "{error}");
        assert!(error.to_string().ends_with(sentence), "{error}");
    }
    assert!(bytes(folder.path()) == before);
}

#[test]
fn statistics_and_sheet_tell_what_is_there() {
    let folder = tempfile::tempdir().unwrap();
    let size = Generation { size: 64, ..generation(Scene::Push1, 2, 1) };
    make(size, folder.path());
    let dataset = Dataset::open(folder.path()).unwrap();
    let statistics = Statistics::of(&dataset, |_| {}).unwrap();
    assert_eq!((statistics.episodes, statistics.frames), (2, 80));
    assert_eq!(statistics.left_tray, Some(0));
    assert_eq!(statistics.pinholes, Some(0.0));
    assert_eq!(statistics.episodes_with_contact, Some(1.0));
    let share = statistics.agent_share.unwrap();
    assert!(share.min > 0.03 && share.max < 0.25, "{share:?}");
    let width = statistics.object_width.unwrap().mean;
    assert!((5.0..9.0).contains(&width), "{width}");
    let hand = statistics.hand_height.unwrap();
    assert!(hand.min > 0.025 && hand.max < 0.04, "{hand:?}");

    let options = SheetOptions { episodes: 2, frames: 5, scale: 2 };
    let picture = sheet(&dataset, options).unwrap();
    assert_eq!(picture.dimensions(), (2 * 5 * 64, 2 * 4 * 64));
    // The first tile is the first frame.
    let frame = dataset.read(0).unwrap().frame(0)[..3].to_vec();
    assert_eq!(picture.get_pixel(1, 1).0, *frame);

    let empty = tempfile::tempdir().unwrap();
    make(generation(Scene::Balls3, 0, 1), empty.path());
    let nothing = Statistics::of(&Dataset::open(empty.path()).unwrap(), |_| {});
    assert!(matches!(nothing, Err(Error::Empty { .. })));
}
