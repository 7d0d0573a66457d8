//! Small episodes for the unit tests of this crate.

use crate::{ActionDimension, DatasetInfo, Episode, EpisodeData, LabelLegend};

/// 4x3 pixels, two action dimensions.
pub(crate) fn info() -> DatasetInfo {
    let action = |name: &str| ActionDimension { name: name.into(), unit: "m".into() };
    DatasetInfo {
        name: "test".into(),
        height: 3,
        width: 4,
        channels: 3,
        frame_period_seconds: 0.1,
        actions: vec![action("x"), action("y")],
        labels: Some(LabelLegend::default()),
        provenance: None,
    }
}

/// Different bytes for every id, frame and pixel; every column filled.
pub(crate) fn data(episode_id: u64, length: u32, objects: u32) -> EpisodeData {
    let info = info();
    let (t, n) = (length as usize, objects as usize);
    let bytes = |count: usize, modulus: usize| -> Vec<u8> {
        (0..count).map(|i| ((i * 7 + episode_id as usize * 31) % modulus) as u8).collect()
    };
    let floats = |count: usize, scale: f32| -> Vec<f32> {
        (0..count).map(|i| (i as f32 + episode_id as f32 * 100.0) * scale).collect()
    };
    EpisodeData {
        episode_id,
        length,
        rgb: bytes(t * info.frame_bytes(), 251),
        actions: floats(t * 2, 0.01),
        mask: Some(bytes(t * info.pixels(), 2 + n)),
        object_count: Some(objects),
        object_positions: Some(floats(t * n * 3, 0.1)),
        object_pixels: Some(floats(t * n * 2, 0.5)),
        object_poses: Some(floats(t * n * 4, 0.2)),
        ee_pose: Some(floats(t * 7, 0.3)),
        joint_positions: Some(floats(t * 7, 0.4)),
        contacts_agent: Some(bytes(t * n, 2)),
        contacts_objects: Some(bytes(t * n * n, 2)),
        state_hash: Some([episode_id as u8; 32]),
        seed: Some(episode_id * 1000),
    }
}

pub(crate) fn episode(episode_id: u64, length: u32, objects: u32) -> Episode {
    Episode::new(data(episode_id, length, objects), &info()).expect("valid")
}
