//! Imports HDF5 files in robomimic's layout: `data/demo_0/obs/agentview_image`, `data/demo_0/actions`.
//!
//! A demonstration is an episode. The action of a row is the command given at its observation, which is our convention.
//! Chunked and gzip-compressed data sets are read, LZF is not.

use std::path::{Path, PathBuf};

use hdf5_reader::{Dataset, Datatype, Hdf5File, group::Group};

use crate::{
    EpisodeData, InvalidEpisode, Result, WriterOptions,
    exchange::{
        ImportOptions, ImportProblem, Imported, Skipped,
        import::{Recorded, convert},
        picture::{Frames, Picture},
    },
    schema::{MAX_COLUMN_BYTES, column},
};

/// Which data sets of a demonstration are taken.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Hdf5Source {
    /// The pictures in `obs`, `[T,H,W,3]` bytes; it may be left out where there is one such data set only.
    pub camera: Option<String>,
    /// A data set in `obs` with joint positions, if they are wanted.
    pub joints: Option<String>,
}

/// Converts file `path` to a new data set in `dir`, which appears only when all of it is there. `progress` is told the number
/// of episodes done and of all.
///
/// # Errors
/// [`crate::Error::Import`] names the file, the number of the demonstration and the data set; otherwise those of
/// [`crate::write_whole`].
pub fn import_hdf5(
    path: &Path,
    dir: &Path,
    source: &Hdf5Source,
    options: &ImportOptions,
    writer: WriterOptions,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Imported> {
    let file = File::open(path)?;
    let demos = file.demonstrations()?;
    let (first, camera) = file.describe(&demos, source)?;
    let actions = options
        .actions(&[], first.dimension)
        .map_err(|problem| problem.at(path, Some(demos[0].number), Some("actions")))?;
    let Some(period) = options.frame_period_seconds.or_else(|| file.period()) else {
        let (what, expected) = (
            "`env_kwargs.control_freq` in attribute `env_args`".into(),
            "it says the time between frames, or --frame-period does".into(),
        );
        return Err(ImportProblem::Missing { what, expected }.at(path, None, Some("data")));
    };
    let info = options.info("robomimic HDF5", path, period, actions, first.sides);
    let mut others = Vec::new();
    let manifest = convert(dir, info, writer, demos.len(), progress, |index| {
        let demo = &demos[index];
        let found = demo.group(&file.path, "obs")?;
        for name in names(&found, &file.path, demo.number)? {
            if name != camera && Some(&name) != source.joints.as_ref() && !others.contains(&name) {
                others.push(name);
            }
        }
        let id = options.first_id.map_or(demo.number, |first| first.saturating_add(index as u64));
        demo.read(&file.path, &camera, &first, source, options, id)
    })?;
    let why = "one camera and, by --joints, one data set of joint positions are imported";
    let mut skipped: Vec<_> =
        others.into_iter().map(|name| Skipped::new(format!("obs/{name}"), why)).collect();
    let rest = "next_obs, states, rewards, dones, masks";
    skipped.push(Skipped::new(rest, "there is no column for them"));
    Ok(Imported { manifest, skipped })
}

struct File {
    path: PathBuf,
    data: Group,
}

/// One demonstration.
struct Demo {
    name: String,
    number: u64,
    group: Group,
}

/// What the first demonstration says of all.
struct Shape {
    sides: (u32, u32),
    dimension: usize,
}

impl File {
    fn open(path: &Path) -> Result<Self> {
        // Its own error would not name the file.
        fs_err::metadata(path)?;
        let open = || Hdf5File::open(path)?.group("data");
        let data = open()
            .map_err(|e| ImportProblem::damaged("group `data`", e).at(path, None, Some("data")))?;
        Ok(Self { path: path.to_path_buf(), data })
    }

    /// In the order of their numbers: `demo_10` comes after `demo_9`.
    fn demonstrations(&self) -> Result<Vec<Demo>> {
        let groups = self.data.groups().map_err(|e| {
            ImportProblem::damaged("the list of demonstrations", e).at(
                &self.path,
                None,
                Some("data"),
            )
        })?;
        let mut demos: Vec<_> = groups
            .into_iter()
            .filter_map(|group| {
                let name = group.name().to_owned();
                let number = name.strip_prefix("demo_")?.parse().ok()?;
                Some(Demo { name, number, group })
            })
            .collect();
        demos.sort_by_key(|demo| demo.number);
        if demos.is_empty() {
            let (what, expected) =
                ("demonstration".into(), "expected groups demo_0 and so on".into());
            return Err(ImportProblem::Missing { what, expected }.at(
                &self.path,
                None,
                Some("data"),
            ));
        }
        Ok(demos)
    }

    fn describe(&self, demos: &[Demo], source: &Hdf5Source) -> Result<(Shape, String)> {
        let first = &demos[0];
        let obs = first.group(&self.path, "obs")?;
        let sets = obs.datasets().map_err(|e| first.damaged(&self.path, "obs", e))?;
        let is_picture = |set: &&Dataset| {
            set.shape().len() == 4
                && set.shape()[3] == 3
                && matches!(set.dtype(), Datatype::FixedPoint { size: 1, signed: false, .. })
        };
        let mut fitting = sets
            .iter()
            .filter(is_picture)
            .filter(|set| source.camera.as_ref().is_none_or(|camera| camera == set.name()));
        let (Some(camera), None) = (fitting.next(), fitting.next()) else {
            let there: Vec<_> =
                sets.iter().filter(is_picture).map(|set| set.name().to_owned()).collect();
            let what = "such camera, or no single one".into();
            let expected = match there.as_slice() {
                [] => "there is no data set of bytes [T, H, W, 3]".into(),
                there => format!("there are {}", there.join(", ")),
            };
            let asked = source.camera.as_deref().unwrap_or("obs");
            let problem = ImportProblem::Missing { what, expected };
            return Err(problem.at(&self.path, Some(first.number), Some(asked)));
        };
        let side = |axis: usize| u32::try_from(camera.shape()[axis]).unwrap_or(u32::MAX);
        let actions = first.set(&self.path, &first.group, "actions")?;
        let &[_, dimension] = actions.shape() else {
            return Err(first.layout(&self.path, "actions", &actions, "[T, A]"));
        };
        let shape = Shape { sides: (side(2), side(1)), dimension: dimension as usize };
        Ok((shape, camera.name().to_owned()))
    }

    /// Seconds between two frames, where the environment's arguments say them.
    fn period(&self) -> Option<f64> {
        let text = self.data.attribute("env_args").ok()?.read_string().ok()?;
        let arguments: serde_json::Value =
            serde_json::from_str(text.trim_end_matches('\0')).ok()?;
        let rate = arguments["env_kwargs"]["control_freq"].as_f64()?;
        (rate > 0.0).then(|| 1.0 / rate)
    }
}

impl Demo {
    fn read(
        &self,
        path: &Path,
        camera: &str,
        shape: &Shape,
        source: &Hdf5Source,
        options: &ImportOptions,
        episode_id: u64,
    ) -> Result<Recorded> {
        let obs = self.group(path, "obs")?;
        let pictures = self.set(path, &obs, camera)?;
        let (width, height) = shape.sides;
        let length = pictures.shape().first().copied().unwrap_or(0);
        if pictures.shape() != [length, height.into(), width.into(), 3] {
            let expected = format!("[T, {height}, {width}, 3] bytes");
            return Err(self.layout(path, camera, &pictures, &expected));
        }
        let bytes: Vec<u8> = match pictures.dtype() {
            Datatype::FixedPoint { size: 1, signed: false, .. } => self.array(path, &pictures)?,
            _ => return Err(self.layout(path, camera, &pictures, "bytes")),
        };
        let mut frames = Frames::new(shape.sides, options.size, options.fit);
        let frame_bytes = width as usize * height as usize * 3;
        for picture in bytes.chunks_exact(frame_bytes.max(1)) {
            Picture::raw(width, height, picture.to_vec())
                .and_then(|picture| frames.push(picture))
                .map_err(|problem| problem.at(path, Some(self.number), Some(camera)))?;
        }
        let actions = self.set(path, &self.group, "actions")?;
        if actions.shape() != [length, shape.dimension as u64] {
            let expected = format!("[{length}, {}]", shape.dimension);
            return Err(self.layout(path, "actions", &actions, &expected));
        }
        let joint_positions = match &source.joints {
            Some(joints) => {
                let set = self.set(path, &obs, joints)?;
                if set.shape().len() != 2 || set.shape()[0] != length {
                    let expected = format!("[{length}, J]");
                    return Err(self.layout(path, joints, &set, &expected));
                }
                Some(self.floats(path, &set)?)
            }
            None => None,
        };
        Ok(Recorded {
            path: path.to_path_buf(),
            row: Some(self.number),
            frames_from: format!("{}/obs/{camera}", self.name),
            actions_from: format!("{}/actions", self.name),
            data: EpisodeData {
                episode_id,
                length: u32::try_from(length).unwrap_or(u32::MAX),
                rgb: frames.rgb,
                actions: self.floats(path, &actions)?,
                joint_positions,
                ..EpisodeData::default()
            },
        })
    }

    /// Numbers of either precision, rounded to single.
    fn floats(&self, path: &Path, set: &Dataset) -> Result<Vec<f32>> {
        match set.dtype() {
            Datatype::FloatingPoint { size: 4, .. } => self.array(path, set),
            Datatype::FloatingPoint { size: 8, .. } => {
                let doubles: Vec<f64> = self.array(path, set)?;
                Ok(doubles.into_iter().map(|value| value as f32).collect())
            }
            _ => Err(self.layout(path, set.name(), set, "floats of 32 or 64 bits")),
        }
    }

    fn array<T: hdf5_reader::H5Type>(&self, path: &Path, set: &Dataset) -> Result<Vec<T>> {
        let bytes =
            set.shape().iter().fold(size_of::<T>() as u64, |n, &side| n.saturating_mul(side));
        if bytes > MAX_COLUMN_BYTES as u64 {
            let (bytes, limit) = (bytes as usize, MAX_COLUMN_BYTES);
            let problem = InvalidEpisode::TooLarge { column: column::RGB, bytes, limit };
            let problem = ImportProblem::from(problem);
            return Err(problem.at(path, Some(self.number), Some(set.name())));
        }
        let array = set.read_array::<T>().map_err(|e| self.damaged(path, set.name(), e))?;
        Ok(array.into_iter().collect())
    }

    fn group(&self, path: &Path, name: &str) -> Result<Group> {
        self.group.group(name).map_err(|e| self.damaged(path, name, e))
    }

    fn set(&self, path: &Path, group: &Group, name: &str) -> Result<Dataset> {
        group.dataset(name).map_err(|e| self.damaged(path, name, e))
    }

    fn damaged(&self, path: &Path, column: &str, e: hdf5_reader::error::Error) -> crate::Error {
        let problem = ImportProblem::damaged("a group or data set", e);
        problem.at(path, Some(self.number), Some(column))
    }

    fn layout(&self, path: &Path, column: &str, set: &Dataset, expected: &str) -> crate::Error {
        let found = format!("{:?} of {:?}", set.shape(), set.dtype());
        let expected = expected.into();
        let problem = ImportProblem::Layout { what: "the data set", found, expected };
        problem.at(path, Some(self.number), Some(column))
    }
}

fn names(group: &Group, path: &Path, number: u64) -> Result<Vec<String>> {
    let names = group.member_names().map_err(|e| {
        ImportProblem::damaged("a list of names", e).at(path, Some(number), Some("obs"))
    })?;
    Ok(names.1)
}
