//! The samples in the repository open, are whole and hold what their README says.

use std::path::Path;

use gatsbi_episodes::{Dataset, LabelLegend};

#[test]
fn the_sample_of_push1_is_what_its_readme_says() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("samples/push1-heldout.parquet");
    let dataset = Dataset::open(path).unwrap();
    let info = dataset.info();
    assert_eq!((info.name.as_str(), info.height, info.width), ("push1", 64, 64));
    assert_eq!((info.frame_period_seconds, info.labels), (0.2, Some(LabelLegend::default())));
    assert!(info.actions.iter().all(|action| action.unit == "rad/s"));
    assert_eq!(info.action_dimension(), 7);

    let summaries = dataset.summaries().unwrap();
    let ids: Vec<_> = summaries.iter().map(|episode| episode.id).collect();
    assert_eq!(ids, [294, 295, 296, 297, 298, 299]);
    let objects: Vec<_> = summaries.iter().map(|episode| episode.object_count).collect();
    assert_eq!(objects, [4, 5, 3, 5, 3, 5].map(Some));

    for episode in dataset.iter() {
        let episode = episode.unwrap();
        assert_eq!(episode.length(), 40);
        let labels = episode.data().mask.as_ref().unwrap();
        let agent: Vec<_> = labels.iter().filter(|&&label| label == 1).collect();
        let share = agent.len() as f64 / labels.len() as f64;
        assert!((0.05..0.25).contains(&share), "the arm fills {share} of episode {}", episode.id());
        for i in 0..episode.object_count().unwrap() {
            // The tray is 0.48 m by 0.56 m around x = 0.52 m; objects lie on it, a few centimetres high.
            let [x, y, z] = episode.object_position(0, i).unwrap();
            assert!((0.28..0.76).contains(&x) && (-0.28..0.28).contains(&y), "{x} {y}");
            assert!((0.02..0.05).contains(&z), "{z}");
        }
    }
}

#[test]
fn the_sample_of_balls_is_what_its_readme_says() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("samples/balls6-heldout.parquet");
    let dataset = Dataset::open(path).unwrap();
    let info = dataset.info();
    assert_eq!((info.name.as_str(), info.height, info.width), ("balls6", 64, 64));
    assert_eq!((info.frame_period_seconds, info.action_dimension()), (0.1, 0));

    let episode = dataset.read(0).unwrap();
    assert_eq!((episode.id(), episode.length(), episode.object_count()), (399, 100, Some(6)));
    let labels = episode.data().mask.as_ref().unwrap();
    assert!(labels.iter().all(|&label| label == 0 || (2..8).contains(&label)));
    assert!(episode.data().contacts_objects.as_ref().unwrap().contains(&1));
}

#[test]
fn the_sample_of_rolling_balls_is_what_its_readme_says() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("samples/roll-heldout.parquet");
    let dataset = Dataset::open(path).unwrap();
    let info = dataset.info();
    assert_eq!((info.name.as_str(), info.height, info.width), ("roll", 64, 64));
    assert_eq!((info.frame_period_seconds, info.action_dimension()), (0.15, 7));
    let mut counts = vec![];
    for (index, id) in [318, 319].into_iter().enumerate() {
        let episode = dataset.read(index).unwrap();
        assert_eq!((episode.id(), episode.length()), (id, 40));
        assert!(episode.data().contacts_agent.as_ref().unwrap().contains(&1));
        counts.push(episode.object_count().unwrap());
    }
    counts.sort_unstable();
    assert_eq!(counts, [2, 3]);
}
