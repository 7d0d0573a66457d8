//! Numbers that tell whether a scene does what it is meant to: contacts, paths, shares of the picture, holes in masks.

use gatsbi_episodes::{Dataset, Episode};
use serde::Serialize;

use crate::{
    AGENT, Error, FIRST_OBJECT, Result, Scene,
    robot::{catalogue::Layout, view::pinholes},
};

/// Pixels whose colours changed by more than this between two frames count as changed.
const CHANGE: u8 = 8;
/// An object moved in an episode if its path is longer than this, metres.
const MOVED: f64 = 0.03;
/// Fewer pixels than this are no object that could be measured.
const MEASURABLE: usize = 5;

/// What a data set shows. Fields are absent where the columns that they need are.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Statistics {
    /// Episodes.
    pub episodes: usize,
    /// Frames of all.
    pub frames: usize,
    /// Objects of an episode.
    pub objects: Option<Spread>,
    /// Share of the episodes in which the agent touches an object.
    pub episodes_with_contact: Option<f64>,
    /// Share of the frames before which it did.
    pub frames_with_contact: Option<f64>,
    /// Objects that it touches in an episode.
    pub objects_touched: Option<Spread>,
    /// Share of the episodes in which two objects touch.
    pub episodes_with_object_contact: Option<f64>,
    /// Frames of an episode before which two objects touched.
    pub frames_with_object_contact: Option<Spread>,
    /// Path of an object in an episode, metres.
    pub path: Option<Spread>,
    /// Share of the objects that moved in their episode.
    pub moved: Option<f64>,
    /// Height of the objects' centres, metres.
    pub object_height: Option<Spread>,
    /// Objects that left the tray, over all episodes; for scenes with one.
    pub left_tray: Option<usize>,
    /// Height of the hand, metres.
    pub hand_height: Option<Spread>,
    /// Speed of the hand, m/s.
    pub hand_speed: Option<Spread>,
    /// Share of the picture that the agent takes.
    pub agent_share: Option<Spread>,
    /// Width of an object, pixels.
    pub object_width: Option<Spread>,
    /// Height of an object in the picture, pixels.
    pub object_tall: Option<Spread>,
    /// Share of the objects and frames in which the object is seen.
    pub visible: Option<f64>,
    /// Background pixels of a frame that lie in the agent in small groups.
    pub pinholes: Option<f64>,
    /// Share of the pixels that change from frame to frame.
    pub changed: Option<f64>,
}

/// A quantity over many frames, objects or episodes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Least.
    pub min: f64,
    /// A tenth lies below.
    pub p10: f64,
    /// A tenth lies above.
    pub p90: f64,
    /// Greatest.
    pub max: f64,
}

impl Spread {
    fn of(mut values: Vec<f64>) -> Option<Self> {
        values.sort_by(f64::total_cmp);
        let (min, max) = (*values.first()?, *values.last()?);
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        Some(Self { mean, min, p10: at(0.1), p90: at(0.9), max })
    }
}

/// What is collected from episode to episode.
#[derive(Debug, Default)]
struct Collected {
    episodes: usize,
    frames: usize,
    objects: Vec<f64>,
    with_contact: Vec<f64>,
    frame_contact: Vec<f64>,
    touched: Vec<f64>,
    with_object_contact: Vec<f64>,
    object_contact_frames: Vec<f64>,
    path: Vec<f64>,
    object_height: Vec<f64>,
    left_tray: usize,
    hand_height: Vec<f64>,
    hand_speed: Vec<f64>,
    agent_share: Vec<f64>,
    width: Vec<f64>,
    tall: Vec<f64>,
    visible: Vec<f64>,
    pinholes: Vec<f64>,
    changed: Vec<f64>,
}

impl Statistics {
    /// Reads all of a data set; `progress` is told how many episodes are done.
    ///
    /// # Errors
    /// [`Error::Empty`], and those of reading.
    pub fn of(dataset: &Dataset, mut progress: impl FnMut(usize)) -> Result<Self> {
        if dataset.is_empty() {
            return Err(Error::Empty { path: dataset.path().into() });
        }
        let info = dataset.info();
        let layout = info.name.parse::<Scene>().ok().and_then(Layout::of);
        let picture = (info.width as usize, info.height as usize);
        let mut all = Collected::default();
        for (index, episode) in dataset.iter().enumerate() {
            let episode = episode?;
            all.add(&episode, info.frame_period_seconds, layout);
            all.add_picture(&episode, picture);
            progress(index + 1);
        }
        Ok(all.statistics(layout.is_some()))
    }
}

impl Collected {
    fn add(&mut self, episode: &Episode, period: f64, layout: Option<&Layout>) {
        let (frames, data) = (episode.length(), episode.data());
        self.episodes += 1;
        self.frames += frames;
        let Some(objects) = episode.object_count() else { return };
        self.objects.push(objects as f64);
        if let Some(contacts) = &data.contacts_agent {
            let touches = |object: usize| (0..frames).any(|t| contacts[t * objects + object] == 1);
            let touched = (0..objects).filter(|&object| touches(object)).count();
            self.touched.push(touched as f64);
            self.with_contact.push(f64::from(u8::from(touched > 0)));
            // Nothing can have touched before the first frame.
            let frames = contacts.chunks(objects.max(1)).skip(1);
            self.frame_contact.extend(frames.map(|frame| f64::from(u8::from(frame.contains(&1)))));
        }
        if let Some(contacts) = &data.contacts_objects {
            let frames = contacts.chunks((objects * objects).max(1));
            let touching = frames.filter(|frame| frame.contains(&1)).count();
            self.object_contact_frames.push(touching as f64);
            self.with_object_contact.push(f64::from(u8::from(touching > 0)));
        }
        for object in 0..objects {
            let places: Vec<[f64; 3]> = (0..frames)
                .filter_map(|t| episode.object_position(t, object))
                .map(|place| place.map(f64::from))
                .collect();
            self.path.push(places.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum());
            self.object_height.extend(places.iter().map(|place| place[2]));
            let outside = |layout: &Layout| {
                places.iter().any(|place| !layout.tray.holds([place[0], place[1]]))
            };
            self.left_tray += usize::from(layout.is_some_and(outside));
        }
        if let Some(poses) = &data.ee_pose {
            let hands: Vec<_> =
                poses.chunks(7).map(|pose| [pose[0], pose[1], pose[2]].map(f64::from)).collect();
            self.hand_height.extend(hands.iter().map(|hand| hand[2]));
            self.hand_speed
                .extend(hands.windows(2).map(|pair| distance(&pair[0], &pair[1]) / period));
        }
    }

    fn add_picture(&mut self, episode: &Episode, (width, height): (usize, usize)) {
        let pixels = (width * height) as f64;
        for t in 1..episode.length() {
            let (before, now) = (episode.frame(t - 1), episode.frame(t));
            let differs =
                |(a, b): (&[u8], &[u8])| a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > CHANGE);
            let changed = before.chunks(3).zip(now.chunks(3)).filter(|pair| differs(*pair)).count();
            self.changed.push(changed as f64 / pixels);
        }
        let objects = episode.object_count().unwrap_or_default();
        for mask in (0..episode.length()).filter_map(|t| episode.mask(t)) {
            let agent: u32 = mask.iter().map(|&label| u32::from(label == AGENT)).sum();
            self.agent_share.push(f64::from(agent) / pixels);
            self.pinholes.push(pinholes(mask, width).len() as f64);
            for object in 0..objects {
                let label = FIRST_OBJECT + object as u8;
                let seen: Vec<usize> = (0..mask.len()).filter(|&at| mask[at] == label).collect();
                self.visible.push(f64::from(u8::from(!seen.is_empty())));
                if seen.len() >= MEASURABLE {
                    self.width.push(extent(seen.iter().map(|at| at % width)));
                    self.tall.push(extent(seen.iter().map(|at| at / width)));
                }
            }
        }
    }

    fn statistics(self, has_tray: bool) -> Statistics {
        let mean = |values: Vec<f64>| Spread::of(values).map(|spread| spread.mean);
        let acts = self.agent_share.iter().any(|&share| share > 0.0);
        let moved = self.path.iter().map(|&path| f64::from(u8::from(path > MOVED))).collect();
        Statistics {
            episodes: self.episodes,
            frames: self.frames,
            objects: Spread::of(self.objects),
            episodes_with_contact: mean(self.with_contact),
            frames_with_contact: mean(self.frame_contact),
            objects_touched: Spread::of(self.touched),
            episodes_with_object_contact: mean(self.with_object_contact),
            frames_with_object_contact: Spread::of(self.object_contact_frames),
            moved: mean(moved),
            path: Spread::of(self.path),
            object_height: Spread::of(self.object_height),
            left_tray: has_tray.then_some(self.left_tray),
            hand_height: Spread::of(self.hand_height),
            hand_speed: Spread::of(self.hand_speed),
            agent_share: Spread::of(self.agent_share).filter(|_| acts),
            object_width: Spread::of(self.width),
            object_tall: Spread::of(self.tall),
            visible: mean(self.visible),
            pinholes: mean(self.pinholes).filter(|_| acts),
            changed: mean(self.changed),
        }
    }
}

fn distance(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

/// Places from the first to the last, both counted.
fn extent(places: impl Iterator<Item = usize> + Clone) -> f64 {
    let (first, last) = (places.clone().min(), places.max());
    first.zip(last).map_or(0.0, |(first, last)| (last - first + 1) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spread_knows_its_ends() {
        let spread = Spread::of((0..=10).rev().map(f64::from).collect()).unwrap();
        assert_eq!(spread, Spread { mean: 5.0, min: 0.0, p10: 1.0, p90: 9.0, max: 10.0 });
        assert_eq!(Spread::of(vec![]), None);
    }

    #[test]
    fn an_extent_counts_both_ends() {
        assert!((extent([7, 3, 5].into_iter()) - 5.0).abs() < f64::EPSILON);
    }
}
