//! Whatever is written comes back bit for bit, for any shape and any choice of optional columns.

use gatsbi_episodes::{
    ActionDimension, Clip, Dataset, DatasetInfo, DatasetWriter, Episode, EpisodeData, LabelLegend,
    WriterOptions,
};
use proptest::{collection::vec, option, prelude::*};

fn info(height: u32, width: u32, actions: usize, labelled: bool) -> DatasetInfo {
    let action = |i| ActionDimension { name: format!("joint{i}"), unit: "rad/s".into() };
    DatasetInfo {
        name: "round trip".into(),
        height,
        width,
        channels: 3,
        frame_period_seconds: 1.0 / 30.0,
        actions: (0..actions).map(action).collect(),
        labels: labelled.then(LabelLegend::default),
        provenance: None,
    }
}

fn finite() -> impl Strategy<Value = f32> {
    any::<f32>().prop_filter("finite", |value| value.is_finite())
}

/// Finite, or one of the many NaNs, whose bits must survive too.
fn finite_or_nan() -> impl Strategy<Value = f32> {
    any::<u32>().prop_map(f32::from_bits).prop_filter("not infinite", |value| !value.is_infinite())
}

prop_compose! {
    fn episode(info: DatasetInfo)(length in 1_usize..6, objects in 0_usize..4)(
        length in Just(length as u32),
        episode_id in any::<u64>(),
        rgb in vec(any::<u8>(), length * info.frame_bytes()),
        actions in vec(finite(), length * info.action_dimension()),
        mask in option::of(vec(0..2 + objects as u8, length * info.pixels())),
        object_count in Just(Some(objects as u32)),
        object_positions in option::of(vec(finite_or_nan(), length * objects * 3)),
        object_pixels in option::of(vec(finite_or_nan(), length * objects * 2)),
        object_poses in option::of(vec(finite_or_nan(), length * objects * 4)),
        ee_pose in option::of(vec(finite(), length * 7)),
        joint_positions in option::of(vec(finite(), length * 3)),
        contacts_agent in option::of(vec(0_u8..2, length * objects)),
        contacts_objects in option::of(vec(0_u8..2, length * objects * objects)),
        state_hash in option::of(any::<[u8; 32]>()),
        seed in option::of(any::<u64>()),
    ) -> EpisodeData {
        EpisodeData {
            episode_id, length, rgb, actions, mask, object_count, object_positions, object_pixels, object_poses, ee_pose,
            joint_positions, contacts_agent, contacts_objects, state_hash, seed,
        }
    }
}

fn dataset() -> impl Strategy<Value = (DatasetInfo, Vec<EpisodeData>, usize)> {
    (1..5_u32, 1..5_u32, 1..4_usize, any::<bool>()).prop_flat_map(|(h, w, a, labelled)| {
        let info = info(h, w, a, labelled);
        let episodes = vec(episode(info.clone()), 1..5).prop_map(|mut episodes| {
            episodes.sort_by_key(|episode| episode.episode_id);
            episodes.dedup_by_key(|episode| episode.episode_id);
            episodes
        });
        (Just(info), episodes, 1..20_000_usize)
    })
}

fn bits(values: Option<&Vec<f32>>) -> Option<Vec<u32>> {
    values.map(|values| values.iter().map(|value| value.to_bits()).collect())
}

/// All columns, floats as bits: NaN is no equal of itself.
fn comparable(e: &EpisodeData) -> impl PartialEq + std::fmt::Debug + use<> {
    let floats = [
        Some(&e.actions),
        e.object_positions.as_ref(),
        e.object_pixels.as_ref(),
        e.object_poses.as_ref(),
        e.ee_pose.as_ref(),
        e.joint_positions.as_ref(),
    ];
    let numbers = (e.episode_id, e.length, e.object_count, e.state_hash, e.seed);
    let bytes =
        (e.rgb.clone(), e.mask.clone(), e.contacts_agent.clone(), e.contacts_objects.clone());
    (numbers, bytes, floats.map(bits))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    #[test]
    fn what_is_written_is_read((info, episodes, shard_bytes) in dataset()) {
        let dir = tempfile::tempdir().unwrap();
        let options = WriterOptions { shard_bytes, ..WriterOptions::default() };
        let mut writer = DatasetWriter::create(dir.path(), info.clone(), options).unwrap();
        for data in &episodes {
            writer.write(&Episode::new(data.clone(), &info).unwrap()).unwrap();
        }
        let manifest = writer.finish().unwrap();
        let frames: u64 = episodes.iter().map(|episode| u64::from(episode.length)).sum();
        prop_assert_eq!((manifest.episodes, manifest.frames), (episodes.len() as u64, frames));

        let dataset = Dataset::open(dir.path()).unwrap();
        prop_assert_eq!(dataset.info(), &info);
        prop_assert_eq!(dataset.len(), episodes.len());
        for (read, written) in dataset.iter().zip(&episodes) {
            prop_assert_eq!(comparable(read.unwrap().data()), comparable(written));
        }
        dataset.verify().unwrap();
    }

    #[test]
    fn a_clip_is_the_episode_shifted_by_one_action(
        (data, start, length) in episode(info(2, 3, 2, true)).prop_flat_map(|data| {
            let frames = data.length as usize;
            (Just(data), 0..frames).prop_flat_map(move |(data, start)| (Just(data), Just(start), 1..=frames - start))
        })
    ) {
        let episode = Episode::new(data, &info(2, 3, 2, true)).unwrap();
        let clip = Clip::cut(&episode, start, length).unwrap();
        let before = clip.actions_before();
        prop_assert_eq!(before.len(), length * 2);
        for k in 0..length {
            prop_assert_eq!(clip.frames().frame(k), episode.frame(start + k));
            prop_assert_eq!(clip.frames().mask(k), episode.mask(start + k));
            let expected = (start + k).checked_sub(1).map_or(&[0.0, 0.0][..], |t| episode.action(t));
            prop_assert_eq!(&before[k * 2..][..2], expected);
        }
        prop_assert_eq!(clip.leading_action().is_none(), start == 0);
    }
}
