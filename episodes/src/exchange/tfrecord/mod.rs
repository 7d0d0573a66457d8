//! Imports TFRecords of `tf.train.Example`s, an episode each, as the BAIR robot pushing data set has them.
//!
//! Keys of an example are numbered by frame: `0/image_main/encoded`, `0/action`. A picture is a PNG or JPEG file, or the raw
//! bytes of a square. The action of a frame is the command given at it, our convention.

mod example;
mod records;

use std::path::{Path, PathBuf};

use self::{
    example::{Example, Values},
    records::Records,
};
use crate::{
    EpisodeData, Result, WriterOptions,
    exchange::{
        ImportOptions, ImportProblem, Imported, Skipped,
        import::{Recorded, convert},
        picture::{Frames, Picture},
    },
};

/// BAIR's rate: one frame in a tenth of a second.
const BAIR_PERIOD: f64 = 0.1;

/// Which features of an example are taken; `{}` stands for the number of the frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TfrecordSource {
    /// The pictures.
    pub frames: String,
    /// The commands.
    pub actions: String,
}

impl Default for TfrecordSource {
    /// BAIR's main camera and its action of four numbers.
    fn default() -> Self {
        Self { frames: "{}/image_main/encoded".into(), actions: "{}/action".into() }
    }
}

/// Converts a file, or all `.tfrecord` and `.tfrecords` files of a folder in the order of their names, to a new data set in
/// `dir`, which appears only when all of it is there. `progress` is told the number of episodes done and of all.
///
/// # Errors
/// [`crate::Error::Import`] names the file, the record and the key; otherwise those of [`crate::write_whole`].
pub fn import_tfrecord(
    path: &Path,
    dir: &Path,
    source: &TfrecordSource,
    options: &ImportOptions,
    writer: WriterOptions,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Imported> {
    let files = files(path)?;
    let mut episodes = 0;
    for file in &files {
        episodes += records::count(file)?;
    }
    let mut all = Source { files: files.into_iter(), open: None };
    let Some(first) = all.next()? else {
        let (what, expected) = ("record".into(), "an episode is a record".into());
        return Err(ImportProblem::Missing { what, expected }.at(path, None, None));
    };
    let sides = first.picture(source, 0)?.sides();
    let dimension = first.action(source, 0)?.len();
    let actions = options
        .actions(&[], dimension)
        .map_err(|problem| first.at(&key(&source.actions, 0), problem))?;
    let info = options.info("TFRecords", path, BAIR_PERIOD, actions, sides);
    let skipped = first.skipped(source);
    let mut first = Some(first);
    let manifest = convert(dir, info, writer, episodes, progress, |index| {
        let next = match first.take() {
            Some(first) => Some(first),
            None => all.next()?,
        };
        let Some(record) = next else {
            let (what, expected) = ("record".into(), format!("{episodes} were counted"));
            return Err(ImportProblem::Missing { what, expected }.at(
                path,
                Some(index as u64),
                None,
            ));
        };
        let id = options.first_id.unwrap_or(0).saturating_add(index as u64);
        record.recorded(source, sides, options, id)
    })?;
    Ok(Imported { manifest, skipped })
}

fn files(path: &Path) -> Result<Vec<PathBuf>> {
    if !path.is_dir() {
        return Ok(vec![path.to_path_buf()]);
    }
    let mut files = Vec::new();
    for entry in fs_err::read_dir(path)? {
        files.push(entry?.path());
    }
    let is_records = |path: &PathBuf| {
        path.extension()
            .is_some_and(|extension| extension == "tfrecord" || extension == "tfrecords")
    };
    files.retain(is_records);
    files.sort();
    Ok(files)
}

/// The records of all files.
struct Source {
    files: std::vec::IntoIter<PathBuf>,
    open: Option<Records>,
}

impl Source {
    fn next(&mut self) -> Result<Option<Record>> {
        loop {
            if let Some(records) = &mut self.open {
                let number = records.number;
                if let Some(bytes) = records.next()? {
                    let path = records.path.clone();
                    let example = Example::decode(&bytes).map_err(|e| {
                        ImportProblem::damaged("the example", e).at(&path, Some(number), None)
                    })?;
                    return Ok(Some(Record { path, number, example }));
                }
            }
            let Some(file) = self.files.next() else { return Ok(None) };
            self.open = Some(Records::open(&file)?);
        }
    }
}

/// One example, and where it is from.
struct Record {
    path: PathBuf,
    number: u64,
    example: Example,
}

impl Record {
    fn recorded(
        &self,
        source: &TfrecordSource,
        sides: (u32, u32),
        options: &ImportOptions,
        episode_id: u64,
    ) -> Result<Recorded> {
        let mut frames = Frames::new(sides, options.size, options.fit);
        let mut actions = Vec::new();
        let mut length = 0;
        while self.example.get(&key(&source.frames, length)).is_some() {
            let picture = self.picture(source, length)?;
            let at = |problem| self.at(&key(&source.frames, length), problem);
            frames.push(picture).map_err(at)?;
            actions.extend(self.action(source, length)?);
            length += 1;
        }
        Ok(Recorded {
            path: self.path.clone(),
            row: Some(self.number),
            frames_from: source.frames.clone(),
            actions_from: source.actions.clone(),
            data: EpisodeData {
                episode_id,
                length: length as u32,
                rgb: frames.rgb,
                actions,
                ..EpisodeData::default()
            },
        })
    }

    fn picture(&self, source: &TfrecordSource, frame: usize) -> Result<Picture> {
        let key = key(&source.frames, frame);
        let problem = match self.example.get(&key) {
            Some(Values::Bytes(files)) if files.len() == 1 => match picture(&files[0]) {
                Ok(picture) => return Ok(picture),
                Err(problem) => problem,
            },
            other => self.missing(other, "one picture"),
        };
        Err(self.at(&key, problem))
    }

    fn action(&self, source: &TfrecordSource, frame: usize) -> Result<Vec<f32>> {
        let key = key(&source.actions, frame);
        match self.example.get(&key) {
            Some(Values::Floats(numbers)) => Ok(numbers.clone()),
            other => Err(self.at(&key, self.missing(other, "a list of floats"))),
        }
    }

    fn missing(&self, found: Option<&Values>, expected: &str) -> ImportProblem {
        if let Some(values) = found {
            let (what, found) = ("the feature", values.described());
            return ImportProblem::Layout { what, found, expected: expected.into() };
        }
        let of_first = |key: &&String| key.starts_with("0/") || !key.contains('/');
        let keys: Vec<_> = self.example.keys().filter(of_first).map(String::as_str).collect();
        let expected = format!("there are {}", keys.join(", "));
        ImportProblem::Missing { what: "such feature".into(), expected }
    }

    fn at(&self, key: &str, problem: ImportProblem) -> crate::Error {
        problem.at(&self.path, Some(self.number), Some(key))
    }

    /// The other features of the first frame, with `{}` for its number.
    fn skipped(&self, source: &TfrecordSource) -> Vec<Skipped> {
        let template = |key: &String| match key.strip_prefix("0/") {
            Some(rest) => Some(format!("{{}}/{rest}")),
            None => (!key.starts_with(|c: char| c.is_ascii_digit())).then(|| key.clone()),
        };
        let mut others: Vec<_> = self.example.keys().filter_map(template).collect();
        others.retain(|key| *key != source.frames && *key != source.actions);
        others.sort();
        let why = "one camera and one action are imported; --frames and --actions name them";
        others.into_iter().map(|key| Skipped::new(key, why)).collect()
    }
}

fn key(template: &str, frame: usize) -> String {
    template.replace("{}", &frame.to_string())
}

/// A PNG or JPEG file, or the raw bytes of a square.
fn picture(bytes: &[u8]) -> Result<Picture, ImportProblem> {
    let side = (bytes.len() / 3).isqrt();
    if side > 0 && side * side * 3 == bytes.len() && image::guess_format(bytes).is_err() {
        return Picture::raw(side as u32, side as u32, bytes.to_vec());
    }
    Picture::decode(bytes)
}
