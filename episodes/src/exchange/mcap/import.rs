//! Imports MCAP recordings, each an episode: one camera topic, one topic of commands.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use super::{DATASET_KEY, EPISODE_KEY, container::Messages, message::Kind};
use crate::{
    DatasetInfo, EpisodeData, Error, InvalidEpisode, Result, WriterOptions,
    exchange::{
        ImportOptions, ImportProblem, Imported, Skipped,
        import::{Recorded, convert},
        picture::Frames,
    },
    schema::{MAX_COLUMN_BYTES, column},
};

/// Which topics of a recording are taken.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct McapSource {
    /// The topic of pictures; it may be left out where there is one only.
    pub camera: Option<String>,
    /// The topic of commands; it may be left out where there is one only.
    pub action: Option<String>,
    /// The field of a command that holds its numbers: `values` of a JSON message, `velocity` of a JointState by default.
    pub field: Option<String>,
}

/// Converts a recording, or all `.mcap` files of a folder in the order of their names, to a new data set in `dir`, which
/// appears only when all of it is there. `progress` is told the number of episodes done and of all.
///
/// Action t is the last command logged from frame t on and before the next frame; where there is none, the one before it
/// still holds. Frames before the first command are left out. Frames are taken as they were logged: none is made up.
///
/// # Errors
/// [`Error::Import`] names file, number of the message and topic; otherwise those of [`crate::write_whole`].
pub fn import_mcap(
    path: &Path,
    dir: &Path,
    source: &McapSource,
    options: &ImportOptions,
    writer: WriterOptions,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Imported> {
    let files = files(path)?;
    let first = Log::read(&files[0], source, options, None)?;
    let dimension = first.actions.first().map_or(0, Vec::len);
    let known = first.dataset.as_ref();
    let named = known.map_or(&[] as &[_], |known| &known.actions);
    let at = |problem: ImportProblem| problem.at(&files[0], None, Some(&first.action_topic));
    let actions = options.actions(named, dimension).map_err(at)?;
    let measured = first.period();
    let period = known.map_or(measured, |known| Some(known.frame_period_seconds));
    let Some(period) = options.frame_period_seconds.or(period) else {
        let (what, expected) =
            ("time between frames".into(), "two frames or --frame-period".into());
        return Err(at(ImportProblem::Missing { what, expected }));
    };
    let mut info = options.info("MCAP", path, period, actions, first.sides);
    if let (Some(known), None) = (known, &options.name) {
        info.name.clone_from(&known.name);
    }
    let mut skipped = BTreeMap::new();
    let mut log = Some(first);
    let sides = log.as_ref().map(|log| log.sides);
    let manifest = convert(dir, info, writer, files.len(), progress, |index| {
        let log = match log.take() {
            Some(log) => log,
            None => Log::read(&files[index], source, options, sides)?,
        };
        log.count_skipped(period, &mut skipped);
        let number = options.first_id.map(|first| first.saturating_add(index as u64));
        let id = number.or(log.episode_id).unwrap_or(index as u64);
        Ok(log.recorded(id))
    })?;
    let skipped = skipped
        .into_iter()
        .map(|((what, why), count)| Skipped::new(format!("{what} ({count})"), why));
    Ok(Imported { manifest, skipped: skipped.collect() })
}

fn files(path: &Path) -> Result<Vec<PathBuf>> {
    if !path.is_dir() {
        return Ok(vec![path.to_path_buf()]);
    }
    let mut files = Vec::new();
    for entry in fs_err::read_dir(path)? {
        files.push(entry?.path());
    }
    files.retain(|file| file.extension().is_some_and(|extension| extension == "mcap"));
    files.sort();
    if files.is_empty() {
        let (what, expected) = (".mcap file".into(), "expected one for each episode".into());
        return Err(ImportProblem::Missing { what, expected }.at(path, None, None));
    }
    Ok(files)
}

/// The messages of one file that matter.
struct Log {
    path: PathBuf,
    camera_topic: String,
    action_topic: String,
    sides: (u32, u32),
    /// Times of the frames, and their pixels.
    times: Vec<u64>,
    frames: Frames,
    /// Times and numbers of the commands.
    action_times: Vec<u64>,
    actions: Vec<Vec<f32>>,
    dataset: Option<DatasetInfo>,
    episode_id: Option<u64>,
    /// Messages of other topics.
    others: BTreeMap<String, u64>,
}

/// What a topic holds.
struct Topic {
    schema: String,
    kind: Option<Kind>,
}

impl Log {
    fn read(
        path: &Path,
        source: &McapSource,
        options: &ImportOptions,
        sides: Option<(u32, u32)>,
    ) -> Result<Self> {
        let topics = topics(path)?;
        let camera = choose(path, &topics, source.camera.as_deref(), "camera", Kind::is_picture)?;
        let is_command = |kind: Kind| !kind.is_picture();
        let action = choose(path, &topics, source.action.as_deref(), "action", is_command)?;
        let mut log = Self {
            path: path.to_path_buf(),
            camera_topic: camera.0.clone(),
            action_topic: action.0.clone(),
            sides: sides.unwrap_or_default(),
            times: Vec::new(),
            frames: Frames::new(sides.unwrap_or_default(), options.size, options.fit),
            action_times: Vec::new(),
            actions: Vec::new(),
            dataset: None,
            episode_id: None,
            others: BTreeMap::new(),
        };
        for (number, message) in Messages::open(path)?.enumerate() {
            let number = number as u64;
            let message = message.map_err(|problem| problem.at(path, Some(number), None))?;
            let topic = message.channel.topic.as_str();
            let at = |problem: ImportProblem| problem.at(path, Some(number), Some(topic));
            if topic == camera.0 {
                let picture = camera.1.picture(&message.data).map_err(at)?;
                if log.times.is_empty() {
                    log.describe(&message.channel.metadata)?;
                    if sides.is_none() {
                        log.sides = picture.sides();
                        log.frames = Frames::new(log.sides, options.size, options.fit);
                    }
                }
                Self::in_order(log.times.last(), message.log_time).map_err(at)?;
                log.frames.push(picture).map_err(at)?;
                let (bytes, limit) = (log.frames.rgb.len(), MAX_COLUMN_BYTES);
                if bytes > limit {
                    let column = column::RGB;
                    return Err(at(InvalidEpisode::TooLarge { column, bytes, limit }.into()));
                }
                log.times.push(message.log_time);
            } else if topic == action.0 {
                let command =
                    action.1.command(&message.data, source.field.as_deref()).map_err(at)?;
                if let Some(first) = log.actions.first()
                    && first.len() != command.len()
                {
                    let (found, expected) = (command.len().to_string(), first.len().to_string());
                    let what = "the number of values";
                    return Err(at(ImportProblem::Layout { what, found, expected }));
                }
                Self::in_order(log.action_times.last(), message.log_time).map_err(at)?;
                log.action_times.push(message.log_time);
                log.actions.push(command);
            } else {
                *log.others.entry(topic.to_owned()).or_default() += 1;
            }
        }
        log.is_whole()?;
        Ok(log)
    }

    /// What a recording of ours says about itself.
    fn describe(&mut self, metadata: &BTreeMap<String, String>) -> Result<()> {
        if let Some(text) = metadata.get(DATASET_KEY) {
            let dataset = serde_json::from_str(text).map_err(|e| {
                let problem = ImportProblem::damaged("its description of the data set", e);
                problem.at(&self.path, None, Some(&self.camera_topic))
            })?;
            self.dataset = Some(dataset);
        }
        self.episode_id = metadata.get(EPISODE_KEY).and_then(|id| id.parse().ok());
        Ok(())
    }

    fn in_order(last: Option<&u64>, time: u64) -> Result<(), ImportProblem> {
        match last {
            Some(&last) if last > time => Err(ImportProblem::Layout {
                what: "the time",
                found: format!("{time} ns"),
                expected: format!("{last} ns or later: messages of a topic follow one another"),
            }),
            _ => Ok(()),
        }
    }

    fn is_whole(&self) -> Result<()> {
        for (count, topic) in
            [(self.times.len(), &self.camera_topic), (self.actions.len(), &self.action_topic)]
        {
            if count == 0 {
                let (what, expected) = ("message".into(), "an episode needs one".into());
                let problem = ImportProblem::Missing { what, expected };
                return Err(problem.at(&self.path, None, Some(topic)));
            }
        }
        Ok(())
    }

    /// Seconds between two frames in the middle of all such times.
    fn period(&self) -> Option<f64> {
        let mut steps: Vec<u64> = self.times.windows(2).map(|pair| pair[1] - pair[0]).collect();
        steps.sort_unstable();
        steps.get(steps.len() / 2).map(|&step| step as f64 / 1e9)
    }

    fn count_skipped(&self, period: f64, skipped: &mut BTreeMap<(String, &'static str), u64>) {
        let mut count = |what: &str, why, count: u64| {
            if count > 0 {
                *skipped.entry((what.to_owned(), why)).or_default() += count;
            }
        };
        for (topic, &messages) in &self.others {
            count(topic, "one topic of pictures and one of commands are imported", messages);
        }
        let early = self.first_frame() as u64;
        count("frames before the first command", "no action is known for them", early);
        let long = |pair: &&[u64]| (pair[1] - pair[0]) as f64 > 1.5e9 * period;
        let gaps = self.times.windows(2).filter(long).count() as u64;
        count(
            "gaps of more than one and a half periods",
            "frames are taken as they were logged",
            gaps,
        );
    }

    /// The first frame that a command follows or has come before.
    fn first_frame(&self) -> usize {
        let first = self.action_times.first().copied().unwrap_or(u64::MAX);
        let next = |t: usize| self.times.get(t + 1).copied().unwrap_or(u64::MAX);
        (0..self.times.len()).find(|&t| first < next(t)).unwrap_or(self.times.len())
    }

    fn recorded(self, episode_id: u64) -> Recorded {
        let first = self.first_frame();
        let length = self.times.len() - first;
        let frame_bytes = self.frames.rgb.len() / self.times.len();
        let mut rgb = self.frames.rgb;
        rgb.drain(..first * frame_bytes);
        let mut actions = Vec::new();
        for t in first..self.times.len() {
            let end = self.times.get(t + 1).copied().unwrap_or(u64::MAX);
            let held = self.action_times.partition_point(|&time| time < end);
            actions.extend(held.checked_sub(1).map(|at| &self.actions[at]).into_iter().flatten());
        }
        let data = EpisodeData {
            episode_id,
            length: u32::try_from(length).unwrap_or(u32::MAX),
            rgb,
            actions,
            ..EpisodeData::default()
        };
        let (frames_from, actions_from) = (self.camera_topic, self.action_topic);
        Recorded { path: self.path, row: None, frames_from, actions_from, data }
    }
}

/// The topics of a file, by reading it: an interrupted recording has no table of them.
fn topics(path: &Path) -> Result<BTreeMap<String, Topic>> {
    let mut topics = BTreeMap::new();
    for (number, message) in Messages::open(path)?.enumerate() {
        let message = message.map_err(|problem| problem.at(path, Some(number as u64), None))?;
        if !topics.contains_key(&message.channel.topic) {
            let schema = message.channel.schema.clone();
            let kind = Kind::of(&schema, &message.channel.encoding);
            topics.insert(message.channel.topic.clone(), Topic { schema, kind });
        }
    }
    Ok(topics)
}

fn choose(
    path: &Path,
    topics: &BTreeMap<String, Topic>,
    asked: Option<&str>,
    what: &str,
    is: impl Fn(Kind) -> bool,
) -> Result<(String, Kind), Error> {
    let fitting = topics
        .iter()
        .filter_map(|(topic, of)| of.kind.filter(|&kind| is(kind)).map(|kind| (topic, kind)));
    let fitting: Vec<_> = fitting.collect();
    // Where several would do, those of our own recordings go first.
    let usual = fitting.iter().find(|(topic, _)| topic.strip_prefix('/') == Some(what));
    let asked = asked.or(usual.map(|(topic, _)| topic.as_str()));
    let mut chosen = fitting.iter().filter(|(topic, _)| asked.is_none_or(|asked| asked == *topic));
    match (chosen.next(), chosen.next()) {
        (Some((topic, kind)), None) => Ok(((*topic).clone(), *kind)),
        (found, _) => {
            let there: Vec<_> =
                topics.iter().map(|(topic, of)| format!("{topic} ({})", of.schema)).collect();
            let expected = format!("the topics are {}", there.join(", "));
            let what = match found {
                Some(_) => format!("single {what} topic, name one"),
                None => format!("{what} topic of a message that is understood"),
            };
            Err(ImportProblem::Missing { what, expected }.at(path, None, asked))
        }
    }
}
