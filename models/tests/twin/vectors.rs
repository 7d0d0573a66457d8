//! The twin's vectors: the file, the steps it describes, and its recorded noise.

use std::{
    collections::{BTreeSet, HashMap},
    fs,
    path::{Path, PathBuf},
};

use gatsbi_models::{
    checkpoint::Checkpoint,
    noise::{Noise, Site},
};
use safetensors::{Dtype, SafeTensors};
use serde::Deserialize;
use tch::{Device, Kind, Tensor};

/// Metadata key of a vectors file.
const METADATA_KEY: &str = "gatsbi.twin";

/// End of the name of a vectors file.
const SUFFIX: &str = ".vectors.safetensors";

/// The vectors files of a folder.
pub(crate) fn cases(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = fs::read_dir(folder)
        .unwrap_or_else(|error| panic!("{}: {error}", folder.display()))
        .map(|entry| entry.expect("the folder can be listed").path())
        .filter(|path| path.to_str().is_some_and(|path| path.ends_with(SUFFIX)))
        .collect();
    files.sort();
    assert!(!files.is_empty(), "{} holds no vectors", folder.display());
    files
}

/// What a vectors file says of itself.
#[derive(Deserialize)]
pub(crate) struct Case {
    pub(crate) checkpoint: String,
    pub(crate) steps: Vec<Step>,
    pub(crate) training: Vec<Step>,
    pub(crate) objective: Objective,
    pub(crate) batch: i64,
    pub(crate) limit: i64,
    pub(crate) gradient_limit: i64,
}

#[derive(Clone, Deserialize)]
pub(crate) struct Step {
    pub(crate) kind: StepKind,
    pub(crate) discover: Rows,
    pub(crate) noise: NoiseKind,
}

#[derive(Clone, Copy, Deserialize, Eq, PartialEq)]
#[serde(rename_all = "snake_case")]
pub(crate) enum StepKind {
    Observe,
    Imagine,
    Skip,
}

#[derive(Clone, Deserialize)]
#[serde(untagged)]
pub(crate) enum Rows {
    All(bool),
    Each(Vec<bool>),
}

#[derive(Clone, Copy, Deserialize, Eq, PartialEq)]
#[serde(rename_all = "snake_case")]
pub(crate) enum NoiseKind {
    Mean,
    Sample,
}

#[derive(Deserialize)]
pub(crate) struct Objective {
    pub(crate) kind: String,
    pub(crate) sigma: f64,
    pub(crate) alpha: f64,
}

/// A vectors file.
pub(crate) struct Vectors {
    pub(crate) name: String,
    folder: PathBuf,
    pub(crate) case: Case,
    tensors: HashMap<String, Tensor>,
}

/// The recorded noise of one step.
pub(crate) struct Recorded<'a> {
    pub(crate) vectors: &'a Vectors,
    pub(crate) prefix: &'a str,
    pub(crate) kind: NoiseKind,
}

impl Noise for Recorded<'_> {
    fn normal(&self, site: Site, shape: &[i64]) -> Tensor {
        self.recorded(site, shape, 0.0)
    }

    fn uniform(&self, site: Site, shape: &[i64]) -> Tensor {
        self.recorded(site, shape, 0.5)
    }
}

impl Recorded<'_> {
    fn recorded(&self, site: Site, shape: &[i64], mean: f64) -> Tensor {
        if self.kind == NoiseKind::Mean {
            return Tensor::full(shape, mean, (Kind::Float, Device::Cpu));
        }
        let noise = self.vectors.get(&format!("{}.noise.{}", self.prefix, site_name(site)));
        assert_eq!(noise.size(), shape, "noise of {site:?}");
        noise.shallow_clone()
    }
}

fn site_name(site: Site) -> &'static str {
    match site {
        Site::Mask => "mask",
        Site::Component => "component",
        Site::Dynamics => "dynamics",
        Site::Presence => "presence",
        Site::Depth => "depth",
        Site::Where => "where",
        Site::What => "what",
        Site::DiscoveryDynamics => "discovery_dynamics",
        Site::DiscoveryPresence => "discovery_presence",
        Site::DiscoveryDepth => "discovery_depth",
        Site::DiscoveryWhere => "discovery_where",
        Site::DiscoveryWhat => "discovery_what",
    }
}

impl Vectors {
    /// Reads a file.
    pub(crate) fn load(path: &Path) -> Self {
        let bytes = fs::read(path).expect("the file can be read");
        let (_, metadata) = SafeTensors::read_metadata(&bytes).expect("it is a safetensors file");
        let metadata = metadata.metadata().as_ref().expect("it has metadata");
        let tensors = SafeTensors::deserialize(&bytes).expect("it is whole");
        let read = |name: &str| {
            let view = tensors.tensor(name).expect("the name is in the file");
            let kind = match view.dtype() {
                Dtype::F32 => Kind::Float,
                Dtype::I64 => Kind::Int64,
                Dtype::U8 => Kind::Uint8,
                other => panic!("{name} is {other:?}"),
            };
            let shape: Vec<i64> = view.shape().iter().map(|size| *size as i64).collect();
            Tensor::from_data_size(view.data(), &shape, kind)
        };
        let file = path.file_name().and_then(|file| file.to_str()).expect("files have names");
        Self {
            name: file.trim_end_matches(SUFFIX).to_owned(),
            folder: path.parent().expect("files lie in folders").to_owned(),
            case: serde_json::from_str(&metadata[METADATA_KEY]).expect("it describes a case"),
            tensors: tensors
                .names()
                .into_iter()
                .map(|name| (name.to_owned(), read(name)))
                .collect(),
        }
    }

    /// The recorded tensor of this name.
    pub(crate) fn get(&self, name: &str) -> &Tensor {
        self.tensors.get(name).unwrap_or_else(|| panic!("{} has no {name}", self.name))
    }

    /// The checkpoint it was recorded on.
    pub(crate) fn checkpoint(&self) -> Checkpoint {
        let path = self.folder.join(&self.case.checkpoint);
        Checkpoint::load(&path, Device::Cpu).unwrap_or_else(|error| panic!("{error:?}"))
    }

    /// Everything recorded that is not an input, of the training pass or of the steps before it.
    pub(crate) fn results(&self, training: bool) -> BTreeSet<&str> {
        let is_input = |name: &str| {
            let quantity = quantity(name);
            quantity == "frame" || quantity == "action" || quantity.starts_with("noise.")
        };
        let names = self.tensors.keys().map(String::as_str);
        names.filter(|name| !is_input(name) && name.starts_with("train.") == training).collect()
    }
}

/// What a recorded name is about, without pass and step: `kl.mask` of `train.s0.kl.mask`.
pub(crate) fn quantity(name: &str) -> &str {
    let name = name.strip_prefix("train.").unwrap_or(name);
    match name.split_once('.') {
        Some((_, quantity)) => quantity,
        None => name,
    }
}

/// The tensor itself, or `limit` of its numbers, evenly spaced.
pub(crate) fn thin(tensor: &Tensor, limit: i64) -> Tensor {
    let size = tensor.numel() as i64;
    if size <= limit {
        return tensor.contiguous();
    }
    let indices: Vec<i64> = (0..limit).map(|i| i * size / limit).collect();
    tensor.flatten(0, -1).index_select(0, &Tensor::from_slice(&indices))
}
