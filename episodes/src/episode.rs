//! One episode in memory: owned buffers that were checked once, when the [`Episode`] was made.
//!
//! An [`EpisodeData`] is the row as it is, open for anyone to fill; [`Episode::new`] checks it against the data set's
//! description and from then on it can only be read. Nothing here knows files; [`crate::Dataset`] reads episodes,
//! [`crate::DatasetWriter`] writes them. Crops with their aligned actions are in [`crate::Clip`].

use crate::{
    DatasetInfo, InvalidEpisode,
    schema::{LabelLegend, MAX_COLUMN_BYTES, column},
};

/// The columns of one row, see [`crate::schema`] for shapes and units. Nothing is checked here.
#[derive(Clone, Debug, Default)]
pub struct EpisodeData {
    /// Unique within the data set.
    pub episode_id: u64,
    /// `T`, frames.
    pub length: u32,
    /// `[T,H,W,C]`
    pub rgb: Vec<u8>,
    /// `[T,A]`
    pub actions: Vec<f32>,
    /// `[T,H,W]` labels
    pub mask: Option<Vec<u8>>,
    /// `N`
    pub object_count: Option<u32>,
    /// `[T,N,3]` metres, NaN = not in the scene
    pub object_positions: Option<Vec<f32>>,
    /// `[T,N,2]` pixels, NaN = not in the scene
    pub object_pixels: Option<Vec<f32>>,
    /// `[T,N,4]` quaternions, NaN = not in the scene
    pub object_poses: Option<Vec<f32>>,
    /// `[T,7]` metres and quaternion
    pub ee_pose: Option<Vec<f32>>,
    /// `[T,J]` radians or metres
    pub joint_positions: Option<Vec<f32>>,
    /// `[T,N]` 0 or 1
    pub contacts_agent: Option<Vec<u8>>,
    /// `[T,N,N]` 0 or 1
    pub contacts_objects: Option<Vec<u8>>,
    /// Hash of the simulator's states.
    pub state_hash: Option<[u8; 32]>,
    /// The generator's seed.
    pub seed: Option<u64>,
}

/// A checked episode of at least one frame.
#[derive(Clone, Debug)]
pub struct Episode {
    data: EpisodeData,
    frame_bytes: usize,
    pixels: usize,
    action_dimension: usize,
}

impl Episode {
    /// Checks `data` against the description of its data set.
    ///
    /// # Errors
    /// The first violation: no frames, a column of another length than its shape says, a number that is not finite (NaN is
    /// legal in the `object_*` columns, where it means absent), a label or contact flag without meaning.
    pub fn new(data: EpisodeData, info: &DatasetInfo) -> Result<Self, InvalidEpisode> {
        data.check(info)?;
        let (frame_bytes, pixels) = (info.frame_bytes(), info.pixels());
        Ok(Self { data, frame_bytes, pixels, action_dimension: info.action_dimension() })
    }

    /// Unique within the data set.
    pub fn id(&self) -> u64 {
        self.data.episode_id
    }

    /// The same episode under another id.
    #[must_use]
    pub fn numbered(mut self, id: u64) -> Self {
        self.data.episode_id = id;
        self
    }

    /// `T`, the number of frames, at least 1.
    pub fn length(&self) -> usize {
        self.data.length as usize
    }

    /// Pixels of frame `t`, `[H,W,C]`. Panics if `t >= T`, as indexing does.
    pub fn frame(&self, t: usize) -> &[u8] {
        at(&self.data.rgb, t, self.frame_bytes)
    }

    /// Labels of frame `t`, `[H,W]`. Panics if `t >= T`, as indexing does.
    pub fn mask(&self, t: usize) -> Option<&[u8]> {
        self.data.mask.as_deref().map(|mask| at(mask, t, self.pixels))
    }

    /// The command held between frame `t` and frame `t+1`, `[A]`. Panics if `t >= T`, as indexing does.
    pub fn action(&self, t: usize) -> &[f32] {
        at(&self.data.actions, t, self.action_dimension)
    }

    /// Number of objects, where it is recorded.
    pub fn object_count(&self) -> Option<usize> {
        self.data.object_count.map(|n| n as usize)
    }

    /// Position of object `i` in frame `t` in metres; `None` where positions are not recorded or the object is not in the
    /// scene. Panics if `t >= T` or `i >= N`, as indexing does.
    pub fn object_position(&self, t: usize, i: usize) -> Option<[f32; 3]> {
        let positions = self.data.object_positions.as_deref()?;
        let objects = self.data.object_count? as usize;
        let &[x, y, z] = at(at(positions, t, objects * 3), i, 3) else { return None };
        (!(x.is_nan() || y.is_nan() || z.is_nan())).then_some([x, y, z])
    }

    /// All columns.
    pub fn data(&self) -> &EpisodeData {
        &self.data
    }

    /// Gives the buffers back.
    pub fn into_data(self) -> EpisodeData {
        self.data
    }

    /// Frames `start..start + length` with everything that belongs to them.
    pub(crate) fn slice(&self, start: usize, length: usize) -> Result<Self, InvalidEpisode> {
        let frames = self.length();
        let end = start.saturating_add(length);
        if length == 0 || end > frames {
            return Err(InvalidEpisode::Range { start, end, frames });
        }
        let data = &self.data;
        let data = EpisodeData {
            episode_id: data.episode_id,
            length: length as u32,
            rgb: cut(&data.rgb, frames, start, length),
            actions: cut(&data.actions, frames, start, length),
            mask: data.mask.as_deref().map(|v| cut(v, frames, start, length)),
            object_count: data.object_count,
            object_positions: data
                .object_positions
                .as_deref()
                .map(|v| cut(v, frames, start, length)),
            object_pixels: data.object_pixels.as_deref().map(|v| cut(v, frames, start, length)),
            object_poses: data.object_poses.as_deref().map(|v| cut(v, frames, start, length)),
            ee_pose: data.ee_pose.as_deref().map(|v| cut(v, frames, start, length)),
            joint_positions: data.joint_positions.as_deref().map(|v| cut(v, frames, start, length)),
            contacts_agent: data.contacts_agent.as_deref().map(|v| cut(v, frames, start, length)),
            contacts_objects: data
                .contacts_objects
                .as_deref()
                .map(|v| cut(v, frames, start, length)),
            // The hash is one of the whole episode's states.
            state_hash: data.state_hash.filter(|_| length == frames),
            seed: data.seed,
        };
        Ok(Self { data, ..*self })
    }
}

impl EpisodeData {
    /// The checks of [`Episode::new`].
    pub(crate) fn check(&self, info: &DatasetInfo) -> Result<(), InvalidEpisode> {
        if self.length == 0 {
            return Err(InvalidEpisode::Empty);
        }
        let frames = self.length as usize;
        let legend = info.labels.unwrap_or_default();
        if let Some(found) = self.object_count.filter(|&n| n > legend.max_objects()) {
            return Err(InvalidEpisode::TooManyObjects { found, limit: legend.max_objects() });
        }
        let objects = |column| match self.object_count {
            Some(n) => Ok(n as usize),
            None => Err(InvalidEpisode::NoObjectCount { column }),
        };

        let actions = info.action_dimension();
        has_length(column::RGB, &self.rgb, frames * info.frame_bytes(), "T*H*W*C")?;
        has_length(column::ACTIONS, &self.actions, frames * actions, "T*A")?;
        is_finite(column::ACTIONS, &self.actions, actions)?;
        if let Some(mask) = &self.mask {
            has_length(column::MASK, mask, frames * info.pixels(), "T*H*W")?;
            if info.labels.is_some() {
                is_labelled(mask, info.pixels(), legend, self.object_count)?;
            }
        }
        for (name, values, width, formula) in [
            (column::OBJECT_POSITIONS, &self.object_positions, 3, "T*N*3"),
            (column::OBJECT_PIXELS, &self.object_pixels, 2, "T*N*2"),
            (column::OBJECT_POSES, &self.object_poses, 4, "T*N*4"),
        ] {
            if let Some(values) = values {
                let width = objects(name)? * width;
                has_length(name, values, frames * width, formula)?;
                no_infinity(name, values, width)?;
            }
        }
        if let Some(pose) = &self.ee_pose {
            has_length(column::EE_POSE, pose, frames * 7, "T*7")?;
            is_finite(column::EE_POSE, pose, 7)?;
        }
        if let Some(joints) = &self.joint_positions {
            let width = (joints.len() / frames).max(1);
            has_length(column::JOINT_POSITIONS, joints, frames * width, "T*J")?;
            is_finite(column::JOINT_POSITIONS, joints, width)?;
        }
        if let Some(flags) = &self.contacts_agent {
            let width = objects(column::CONTACTS_AGENT)?;
            has_length(column::CONTACTS_AGENT, flags, frames * width, "T*N")?;
            is_flag(column::CONTACTS_AGENT, flags, width)?;
        }
        if let Some(flags) = &self.contacts_objects {
            let width = objects(column::CONTACTS_OBJECTS)?.pow(2);
            has_length(column::CONTACTS_OBJECTS, flags, frames * width, "T*N*N")?;
            is_flag(column::CONTACTS_OBJECTS, flags, width)?;
        }
        Ok(())
    }
}

fn at<T>(values: &[T], index: usize, width: usize) -> &[T] {
    &values[index * width..][..width]
}

fn cut<T: Copy>(values: &[T], frames: usize, start: usize, length: usize) -> Vec<T> {
    let width = values.len() / frames;
    values[start * width..][..length * width].to_vec()
}

fn has_length<T>(
    column: &'static str,
    values: &[T],
    expected: usize,
    formula: &'static str,
) -> Result<(), InvalidEpisode> {
    let found = values.len();
    if found != expected {
        return Err(InvalidEpisode::Length { column, found, expected, formula });
    }
    let bytes = size_of_val(values);
    if bytes > MAX_COLUMN_BYTES {
        return Err(InvalidEpisode::TooLarge { column, bytes, limit: MAX_COLUMN_BYTES });
    }
    Ok(())
}

fn is_finite(column: &'static str, values: &[f32], width: usize) -> Result<(), InvalidEpisode> {
    none_is(column, values, width, |v| !v.is_finite())
}

fn no_infinity(column: &'static str, values: &[f32], width: usize) -> Result<(), InvalidEpisode> {
    none_is(column, values, width, f32::is_infinite)
}

fn none_is(
    column: &'static str,
    values: &[f32],
    width: usize,
    bad: impl Fn(f32) -> bool,
) -> Result<(), InvalidEpisode> {
    match values.iter().position(|&v| bad(v)) {
        None => Ok(()),
        Some(i) => Err(InvalidEpisode::NonFinite {
            column,
            frame: i / width,
            dimension: i % width,
            value: values[i],
        }),
    }
}

fn is_flag(column: &'static str, flags: &[u8], width: usize) -> Result<(), InvalidEpisode> {
    match flags.iter().position(|&flag| flag > 1) {
        None => Ok(()),
        Some(i) => Err(InvalidEpisode::ContactFlag { column, frame: i / width, value: flags[i] }),
    }
}

fn is_labelled(
    mask: &[u8],
    pixels: usize,
    legend: LabelLegend,
    object_count: Option<u32>,
) -> Result<(), InvalidEpisode> {
    let objects = object_count.unwrap_or(legend.max_objects());
    let mut known = [false; 256];
    known[usize::from(legend.background)] = true;
    known[usize::from(legend.agent)] = true;
    known[usize::from(legend.first_object)..][..objects as usize].fill(true);
    match mask.iter().position(|&label| !known[usize::from(label)]) {
        None => Ok(()),
        Some(i) => Err(InvalidEpisode::UnknownLabel { frame: i / pixels, label: mask[i], objects }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{data, info};

    #[track_caller]
    fn rejects(change: impl FnOnce(&mut EpisodeData), expected: &InvalidEpisode) {
        let mut data = data(3, 4, 2);
        change(&mut data);
        let found = Episode::new(data, &info()).unwrap_err();
        // Compared as text because a NaN is no equal of itself.
        assert_eq!(format!("{found:?}"), format!("{expected:?}"));
    }

    #[track_caller]
    fn rejects_length(change: impl FnOnce(&mut EpisodeData), name: &str) {
        let mut data = data(3, 4, 2);
        change(&mut data);
        match Episode::new(data, &info()).unwrap_err() {
            InvalidEpisode::Length { column, .. } => assert_eq!(column, name),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn accessors_return_the_right_bytes() {
        let data = data(3, 4, 2);
        let episode = Episode::new(data.clone(), &info()).unwrap();
        let info = info();
        assert_eq!((episode.id(), episode.length(), episode.object_count()), (3, 4, Some(2)));
        for t in 0..4 {
            let (f, p) = (info.frame_bytes(), info.pixels());
            assert_eq!(episode.frame(t), &data.rgb[t * f..(t + 1) * f]);
            assert_eq!(episode.mask(t).unwrap(), &data.mask.as_ref().unwrap()[t * p..(t + 1) * p]);
            assert_eq!(episode.action(t), &data.actions[t * 2..(t + 1) * 2]);
        }
        let positions = data.object_positions.as_ref().unwrap();
        assert_eq!(episode.object_position(1, 1).unwrap().as_slice(), &positions[9..12]);
    }

    #[test]
    fn an_absent_object_has_no_position() {
        let mut data = data(3, 4, 2);
        data.object_positions.as_mut().unwrap()[3..6].fill(f32::NAN);
        let episode = Episode::new(data, &info()).unwrap();
        assert_eq!(episode.object_position(0, 1), None);
        assert!(episode.object_position(0, 0).is_some());
    }

    #[test]
    fn wrong_lengths_are_rejected() {
        rejects(|d| d.length = 0, &InvalidEpisode::Empty);
        let (found, expected) = (7, 8);
        let actions = InvalidEpisode::Length { column: "actions", found, expected, formula: "T*A" };
        rejects(|d| d.actions.truncate(7), &actions);
        rejects_length(|d| d.length = 5, "rgb");
        rejects_length(|d| d.rgb.push(0), "rgb");
        rejects_length(|d| d.mask = Some(vec![]), "mask");
        rejects_length(|d| d.object_count = Some(3), "object_positions");
        rejects_length(|d| d.object_pixels = Some(vec![0.0; 15]), "object_pixels");
        rejects_length(|d| d.object_poses = Some(vec![0.0; 31]), "object_poses");
        rejects_length(|d| d.ee_pose = Some(vec![0.0; 27]), "ee_pose");
        rejects_length(|d| d.joint_positions = Some(vec![0.0; 9]), "joint_positions");
        rejects_length(|d| d.joint_positions = Some(vec![]), "joint_positions");
        rejects_length(|d| d.contacts_agent = Some(vec![0; 4]), "contacts_agent");
        rejects_length(|d| d.contacts_objects = Some(vec![0; 8]), "contacts_objects");
    }

    #[test]
    fn wrong_values_are_rejected() {
        let non_finite = |column, frame, dimension, value| InvalidEpisode::NonFinite {
            column,
            frame,
            dimension,
            value,
        };
        rejects(|d| d.actions[5] = f32::NAN, &non_finite("actions", 2, 1, f32::NAN));
        rejects(|d| d.actions[2] = f32::INFINITY, &non_finite("actions", 1, 0, f32::INFINITY));
        let far = f32::NEG_INFINITY;
        rejects(
            |d| d.object_positions.as_mut().unwrap()[7] = far,
            &non_finite("object_positions", 1, 1, far),
        );
        rejects(
            |d| d.ee_pose.as_mut().unwrap()[8] = f32::NAN,
            &non_finite("ee_pose", 1, 1, f32::NAN),
        );
        rejects(
            |d| d.mask.as_mut().unwrap()[25] = 4,
            &InvalidEpisode::UnknownLabel { frame: 2, label: 4, objects: 2 },
        );
        rejects(
            |d| d.contacts_agent = Some(vec![0, 1, 0, 0, 0, 2, 0, 0]),
            &InvalidEpisode::ContactFlag { column: "contacts_agent", frame: 2, value: 2 },
        );
        rejects(
            |d| d.object_count = None,
            &InvalidEpisode::NoObjectCount { column: "object_positions" },
        );
        rejects(
            |d| d.object_count = Some(255),
            &InvalidEpisode::TooManyObjects { found: 255, limit: 254 },
        );
    }

    #[test]
    fn a_column_beyond_the_format_is_refused() {
        let mut info = info();
        (info.height, info.width) = (1, 3);
        // Zeroed memory costs nothing until it is touched.
        let (length, rgb) = (1 << 27, vec![0; 9 << 27]);
        let refused = EpisodeData { length, rgb, ..EpisodeData::default() }.check(&info);
        assert!(
            matches!(refused, Err(InvalidEpisode::TooLarge { column: "rgb", .. })),
            "{refused:?}"
        );
    }
}
