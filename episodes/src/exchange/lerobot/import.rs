//! Imports a LeRobotDataset v3: one camera, the action, and joints if asked for.

use std::path::{Path, PathBuf};

use super::{
    ACTION, BOOKKEEPING, Feature, Info, Sidecar, fill, read_json, rows::Table, video::Video,
};
use crate::{
    DatasetInfo, EpisodeData, Error, Result, WriterOptions,
    exchange::{
        ImportOptions, ImportProblem, Imported, Skipped,
        import::{Recorded, convert},
        picture::{Frames, Picture},
    },
};

/// Which features of a LeRobotDataset are taken.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LerobotSource {
    /// The image or video feature; it may be left out where there is one only.
    pub camera: Option<String>,
    /// The feature of actions; `action` by default.
    pub action: Option<String>,
    /// A feature that holds joint positions, if they are wanted.
    pub joints: Option<String>,
}

/// Converts folder `root` to a new data set in `dir`, which appears only when all of it is there. `progress` is told the
/// number of episodes done and of all.
///
/// # Errors
/// [`Error::Import`] names file, row and column; otherwise those of [`crate::write_whole`].
pub fn import_lerobot(
    root: &Path,
    dir: &Path,
    source: &LerobotSource,
    options: &ImportOptions,
    writer: WriterOptions,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Imported> {
    let info = Info::read(root)?;
    let sidecar = root.join("meta/gatsbi.json");
    let sidecar: Option<Sidecar> = if sidecar.exists() { Some(read_json(&sidecar)?) } else { None };
    let features = Features::choose(&info, root, source)?;
    let dataset = features.dataset(&info, root, options, sidecar.as_ref())?;
    let episodes = Location::all(root, &features)?;
    let ids = sidecar.map(|sidecar| sidecar.episode_ids).unwrap_or_default();
    let id_of = |index: usize, number: u64| match options.first_id {
        Some(first) => first.saturating_add(index as u64),
        None => ids.get(index).copied().unwrap_or(number),
    };
    let mut reader =
        Reader { root, info: &info, features: &features, options, table: None, video: None };
    let manifest = convert(dir, dataset, writer, episodes.len(), progress, |index| {
        let location = &episodes[index];
        reader.read(location, id_of(index, location.episode))
    })?;
    Ok(Imported { manifest, skipped: features.skipped(&info) })
}

/// The features that are taken.
struct Features {
    camera: String,
    is_video: bool,
    sides: (u32, u32),
    action: String,
    action_feature: Feature,
    joints: Option<String>,
}

/// Where an episode is.
struct Location {
    episode: u64,
    length: u64,
    /// Chunk and file of the table.
    data: (u64, u64),
    /// Chunk and file of the video, and the second at which the episode begins.
    video: Option<(u64, u64, f64)>,
}

/// The files that are open: episodes follow one another in them.
struct Reader<'a> {
    root: &'a Path,
    info: &'a Info,
    features: &'a Features,
    options: &'a ImportOptions,
    table: Option<Table>,
    video: Option<Video>,
}

// === impl Features ===

impl Features {
    fn choose(info: &Info, root: &Path, source: &LerobotSource) -> Result<Self> {
        let path = root.join("meta/info.json");
        let missing = |column: &str, what: &str, is: &dyn Fn(&Feature) -> bool| {
            let there: Vec<_> =
                info.features.iter().filter(|(_, f)| is(f)).map(|(key, _)| key.as_str()).collect();
            let expected = match there.as_slice() {
                [] => "the data set has none".to_owned(),
                there => format!("there are {}", there.join(", ")),
            };
            ImportProblem::Missing { what: what.into(), expected }.at(&path, None, Some(column))
        };
        let mut cameras = info.features.iter().filter(|(_, feature)| feature.is_picture());
        let camera = match &source.camera {
            Some(key) => info.features.get_key_value(key).filter(|(_, f)| f.is_picture()),
            None => cameras.next().filter(|_| cameras.next().is_none()),
        };
        let asked = source.camera.as_deref().unwrap_or("observation.images");
        let Some((camera, feature)) = camera else {
            let what = "such image or video feature, or no single one";
            return Err(missing(asked, what, &Feature::is_picture));
        };
        let Some(sides) = feature.sides() else {
            let (found, expected) = (format!("{:?}", feature.shape), "[H, W, 3]".into());
            let problem = ImportProblem::Layout { what: "the shape", found, expected };
            return Err(problem.at(&path, None, Some(camera)));
        };
        let vector = |key: &str, what: &str| {
            let feature = info.features.get(key).filter(|feature| feature.is_vector());
            feature.cloned().ok_or_else(|| missing(key, what, &Feature::is_vector))
        };
        let action = source.action.clone().unwrap_or_else(|| ACTION.into());
        let action_feature = vector(&action, "such feature of actions")?;
        if let Some(joints) = &source.joints {
            vector(joints, "such feature of joint positions")?;
        }
        Ok(Self {
            camera: camera.clone(),
            is_video: feature.dtype == "video",
            sides,
            action,
            action_feature,
            joints: source.joints.clone(),
        })
    }

    fn dataset(
        &self,
        info: &Info,
        root: &Path,
        options: &ImportOptions,
        sidecar: Option<&Sidecar>,
    ) -> Result<DatasetInfo> {
        let path = root.join("meta/info.json");
        let dimension = self.action_feature.shape[0] as usize;
        let own = self.action_feature.dimensions();
        let named = sidecar.map_or(own.as_slice(), |sidecar| &sidecar.dataset.actions);
        let actions = options
            .actions(named, dimension)
            .map_err(|problem| problem.at(&path, None, Some(&self.action)))?;
        let period = sidecar.map_or(1.0 / info.fps, |known| known.dataset.frame_period_seconds);
        let mut dataset = options.info("LeRobotDataset v3", root, period, actions, self.sides);
        if let (Some(known), None) = (sidecar, &options.name) {
            dataset.name.clone_from(&known.dataset.name);
        }
        Ok(dataset)
    }

    fn skipped(&self, info: &Info) -> Vec<Skipped> {
        let taken = [Some(&self.camera), Some(&self.action), self.joints.as_ref()];
        let others = info.features.iter().filter(|(key, _)| {
            !BOOKKEEPING.contains(&key.as_str()) && !taken.contains(&Some(*key))
        });
        let why = |feature: &Feature| {
            if feature.is_picture() {
                "one camera is imported; --camera names it"
            } else if feature.is_vector() {
                "there is no column for it; --joints takes one feature as joint positions"
            } else {
                "there is no column for it"
            }
        };
        let mut skipped: Vec<_> =
            others.map(|(key, feature)| Skipped::new(key.clone(), why(feature))).collect();
        skipped.push(Skipped::new("tasks", "there is no column for language"));
        skipped
    }
}

// === impl Location ===

impl Location {
    /// All episodes, in the order of the data set.
    fn all(root: &Path, features: &Features) -> Result<Vec<Self>> {
        let mut columns = ["episode_index", "length", "data/chunk_index", "data/file_index"]
            .map(String::from)
            .to_vec();
        if features.is_video {
            for part in ["chunk_index", "file_index", "from_timestamp"] {
                columns.push(format!("videos/{}/{part}", features.camera));
            }
        }
        let names: Vec<&str> = columns.iter().map(String::as_str).collect();
        let mut episodes = Vec::new();
        for path in tables(&root.join("meta/episodes"))? {
            let mut table = Table::open(&path, &names)?;
            while let Some(row) = table.next()? {
                let video = match names.get(4..7) {
                    Some(of) => Some((row.index(of[0])?, row.index(of[1])?, row.number(of[2])?)),
                    None => None,
                };
                episodes.push(Self {
                    episode: row.index(names[0])?,
                    length: row.index(names[1])?,
                    data: (row.index(names[2])?, row.index(names[3])?),
                    video,
                });
            }
        }
        Ok(episodes)
    }
}

/// The Parquet files below a folder, in the order of their names.
fn tables(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for chunk in fs_err::read_dir(folder)? {
        let chunk = chunk?.path();
        if chunk.is_dir() {
            for file in fs_err::read_dir(&chunk)? {
                found.push(file?.path());
            }
        }
    }
    found.retain(|path| path.extension().is_some_and(|extension| extension == "parquet"));
    found.sort();
    if found.is_empty() {
        let (what, expected) =
            ("table of episodes".into(), "expected chunk-000/file-000.parquet".into());
        return Err(ImportProblem::Missing { what, expected }.at(folder, None, None));
    }
    Ok(found)
}

// === impl Reader ===

impl Reader<'_> {
    fn read(&mut self, location: &Location, id: u64) -> Result<Recorded> {
        let Features { camera, is_video, sides, action, joints, .. } = self.features;
        let path = fill(self.root, &self.info.data_path, "", location.data.0, location.data.1);
        if self.table.as_ref().is_none_or(|table| table.path != path) {
            let mut columns = vec!["episode_index", "frame_index", action.as_str()];
            columns.extend((!is_video).then_some(camera.as_str()));
            columns.extend(joints.as_deref());
            self.table = Some(Table::open(&path, &columns)?);
        }
        let mut frames = Frames::new(*sides, self.options.size, self.options.fit);
        let (mut actions, mut positions) = (Vec::new(), Vec::new());
        let first = self.table.as_ref().map_or(0, |table| table.row);
        for t in 0..location.length {
            let Some(table) = &mut self.table else { break };
            let end = (table.path.clone(), table.row);
            let Some(row) = table.next()? else {
                let (found, expected) =
                    (format!("at frame {t}"), format!("{} frames", location.length));
                let what = "the end of the table";
                let problem = ImportProblem::Layout { what, found, expected };
                return Err(problem.at(&end.0, Some(end.1), Some("episode_index")));
            };
            for (column, expected) in [("episode_index", location.episode), ("frame_index", t)] {
                let found = row.index(column)?;
                if found != expected {
                    let (found, expected) = (found.to_string(), expected.to_string());
                    let problem = ImportProblem::Layout { what: "the number", found, expected };
                    return Err(row.problem(column, problem));
                }
            }
            let command = row.vector(action)?;
            let dimension = self.features.action_feature.shape[0] as usize;
            if command.len() != dimension {
                let (found, expected) = (command.len().to_string(), dimension.to_string());
                let what = "the number of values";
                return Err(row.problem(action, ImportProblem::Layout { what, found, expected }));
            }
            actions.extend(command);
            if let Some(joints) = joints {
                positions.extend(row.vector(joints)?);
            }
            if !is_video {
                let file = row.picture(camera, self.root)?;
                Picture::decode(&file)
                    .and_then(|picture| frames.push(picture))
                    .map_err(|problem| row.problem(camera, problem))?;
            }
        }
        if let Some(video) = location.video {
            self.decode(video, location.length, &mut frames)?;
        }
        let data = EpisodeData {
            episode_id: id,
            length: u32::try_from(location.length).unwrap_or(u32::MAX),
            rgb: frames.rgb,
            actions,
            joint_positions: joints.is_some().then_some(positions),
            ..EpisodeData::default()
        };
        Ok(Recorded {
            path,
            row: Some(first),
            frames_from: camera.clone(),
            actions_from: action.clone(),
            data,
        })
    }

    /// The frames of an episode from its video: those from its first second on, at the data set's rate.
    fn decode(
        &mut self,
        (chunk, file, from): (u64, u64, f64),
        length: u64,
        frames: &mut Frames,
    ) -> Result<()> {
        let camera = &self.features.camera;
        let template = self
            .info
            .video_path
            .as_deref()
            .unwrap_or("videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4");
        let path = fill(self.root, template, camera, chunk, file);
        let at = |number, problem: ImportProblem| -> Error {
            problem.at(&path, Some(number), Some(camera))
        };
        let first = (from * self.info.fps).round().max(0.0) as u64;
        for number in first..first.saturating_add(length) {
            let open = self.video.as_mut().filter(|video| video.path == path);
            let picture = match open {
                Some(video) => video.frame(number).map_err(|problem| at(number, problem))?,
                None => None,
            };
            let picture = if let Some(picture) = picture {
                picture
            } else {
                if !path.exists() {
                    let (what, expected) =
                        ("such file".into(), "the table of episodes names it".into());
                    return Err(at(number, ImportProblem::Missing { what, expected }));
                }
                let mut video = Video::open(&path).map_err(|problem| at(number, problem))?;
                let picture = video.frame(number).map_err(|problem| at(number, problem))?;
                self.video = Some(video);
                match picture {
                    Some(picture) => picture,
                    None => break,
                }
            };
            frames.push(picture).map_err(|problem| at(number, problem))?;
        }
        Ok(())
    }
}
