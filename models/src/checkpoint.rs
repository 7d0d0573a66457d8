//! Checkpoints: one safetensors file with the weights and, in its metadata, everything needed to use them.
//!
//! Every name, shape and dtype is checked on loading, and a file is written whole or not at all. Parameters may
//! be stored as 16-bit floats; they are 32-bit in memory.

use std::{
    collections::{BTreeMap, HashMap},
    io::Write as _,
    path::{Path, PathBuf},
};

use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use tch::{Device, Kind, Tensor};

use crate::{
    config::GatsbiConfig,
    gatsbi::model::Gatsbi,
    nn::ParamStore,
    world_model::{ActionDimension, ModelSpec, Preprocess},
};

/// Marks the file as ours; the key's value is the format version.
const FORMAT_KEY: &str = "gatsbi.checkpoint";

/// Metadata key of the [`Header`].
const HEADER_KEY: &str = "gatsbi.header";

/// The format version this code writes, and the newest it reads.
const VERSION: u32 = 1;

/// Everything a checkpoint says besides its weights.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// Name of the model, such as `push1-tiny`.
    pub name: String,
    /// Sizes and switches.
    pub model: GatsbiConfig,
    /// The slot whose mask is the agent's; absent in scenes without one.
    pub agent_slot: Option<AgentSlot>,
    /// Dimensions of an action.
    pub actions: Vec<ActionDimension>,
    /// How frames of another size are fitted.
    pub preprocess: Preprocess,
    /// Seconds between frames.
    pub frame_period: Option<f64>,
    /// What stands for the action before the first frame.
    pub first_action: FirstAction,
    /// Where the weights come from.
    pub provenance: Provenance,
}

/// Which slot is the agent, and how that was found out.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct AgentSlot {
    /// Slot, from 0.
    pub index: i64,
    /// Pooled intersection over union of its mask with the keypoint map, if it was measured.
    pub score: Option<f64>,
}

/// What stands for the action before a session's first frame (decisions row 14).
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FirstAction {
    /// Zero network input, seen in training.
    Neutral,
    /// The action of the first frame itself (the paper's offline convention).
    Repeat,
}

/// Where weights come from.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// Data set, empty if untrained.
    pub data: String,
    /// Seed of initial values and training.
    pub seed: u64,
    /// Optimiser steps.
    pub steps: u64,
    /// Preset of the trainer, empty if untrained.
    pub preset: String,
    /// Anything a user of the weights should know.
    pub notes: String,
}

/// A loaded checkpoint: a trainable model, its parameters and its header.
#[derive(Debug)]
pub struct Checkpoint {
    /// The model.
    pub model: Gatsbi,
    /// Its parameters.
    pub store: ParamStore,
    /// Everything else.
    pub header: Header,
    /// SHA-256 of the file, hexadecimal.
    pub hash: String,
}

/// How parameters are stored.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Precision {
    /// 32-bit floats.
    Single,
    /// 16-bit floats.
    Half,
}

/// Why a checkpoint cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file cannot be opened or read.
    #[error("checkpoint {path} cannot be read")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// The bytes are not a whole safetensors file.
    #[error("checkpoint {path} is not a whole safetensors file: truncated or damaged")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: safetensors::SafeTensorError,
    },
    /// A safetensors file of somebody else.
    #[error(
        "checkpoint {path} is a safetensors file, but not a gatsbi checkpoint (no {FORMAT_KEY} in its metadata)"
    )]
    Foreign {
        /// The file.
        path: PathBuf,
    },
    /// Written by a newer version.
    #[error("checkpoint {path} has format version {found}, this program reads up to {VERSION}")]
    Newer {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: String,
    },
    /// The header does not parse.
    #[error("the header of checkpoint {path} cannot be understood")]
    Header {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: serde_json::Error,
    },
    /// The header contradicts itself.
    #[error("the header of checkpoint {path} is invalid: {problems}")]
    Config {
        /// The file.
        path: PathBuf,
        /// What is wrong, all of it.
        problems: String,
    },
    /// A parameter is missing.
    #[error("checkpoint {path} has no tensor {name}")]
    Missing {
        /// The file.
        path: PathBuf,
        /// The parameter.
        name: String,
    },
    /// A parameter has another shape.
    #[error(
        "tensor {name} of checkpoint {path} has shape {found:?}, the configuration asks for {expected:?}"
    )]
    Shape {
        /// The file.
        path: PathBuf,
        /// The parameter.
        name: String,
        /// Shape in the file.
        found: Vec<usize>,
        /// Shape that the configuration implies.
        expected: Vec<i64>,
    },
    /// A parameter is not stored as a float.
    #[error("tensor {name} of checkpoint {path} is {found:?}, expected F32 or F16")]
    Dtype {
        /// The file.
        path: PathBuf,
        /// The parameter.
        name: String,
        /// Dtype in the file.
        found: Dtype,
    },
    /// A parameter holds NaN or infinity.
    #[error("tensor {name} of checkpoint {path} holds values that are not finite")]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The parameter.
        name: String,
    },
    /// A tensor that the configuration has no use for.
    #[error("checkpoint {path} has a tensor {name} that the configuration does not know")]
    Unexpected {
        /// The file.
        path: PathBuf,
        /// The tensor.
        name: String,
    },
    /// The file cannot be written.
    #[error("checkpoint {path} cannot be written")]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
}

impl Checkpoint {
    /// Reads a checkpoint.
    ///
    /// # Errors
    /// If it is not a whole, finite checkpoint of a known version whose tensors are exactly those that its
    /// configuration implies.
    pub fn load(path: &Path, device: Device) -> Result<Self, CheckpointError> {
        let owned = || path.to_path_buf();
        let bytes =
            fs_err::read(path).map_err(|source| CheckpointError::Read { path: owned(), source })?;
        let damaged = |source| CheckpointError::Damaged { path: owned(), source };
        let (_, metadata) = SafeTensors::read_metadata(&bytes).map_err(damaged)?;
        let tensors = SafeTensors::deserialize(&bytes).map_err(damaged)?;
        let header = read_header(path, metadata.metadata().as_ref())?;
        let agent_slot = header.agent_slot.as_ref().map(|slot| slot.index);
        let (model, store) = Gatsbi::untrained(&header.model, agent_slot, 0, device);
        fill(path, &store, &tensors)?;
        Ok(Self { model, store, header, hash: hex(&Sha256::digest(&bytes)) })
    }

    /// A model with untrained weights.
    pub fn untrained(header: Header, device: Device) -> Self {
        let agent_slot = header.agent_slot.as_ref().map(|slot| slot.index);
        let seed = header.provenance.seed;
        let (model, store) = Gatsbi::untrained(&header.model, agent_slot, seed, device);
        Self { model, store, header, hash: String::new() }
    }

    /// Writes the checkpoint to `path`, which holds either the old or the new file at any time.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn save(&self, path: &Path, precision: Precision) -> Result<(), CheckpointError> {
        save(&self.store, &self.header, path, precision)
    }

    /// What the model takes and gives.
    pub fn spec(&self) -> ModelSpec {
        let Header {
            name, model, agent_slot, actions, preprocess, frame_period, provenance, ..
        } = self.header.clone();
        let object = 6 + model.objects.z_what + model.objects.z_dyna;
        let slot = model.mixture.z_mask + model.mixture.z_comp;
        ModelSpec {
            name,
            hash: self.hash.clone(),
            image_size: model.image_size,
            preprocess,
            frame_period,
            actions,
            slots: model.mixture.slots,
            agent_slot: agent_slot.map(|slot| slot.index),
            max_objects: model.objects.max_objects,
            keypoints: model.detector.as_ref().map(|detector| detector.keypoints),
            latents: model.mixture.slots * slot + model.objects.max_objects * object,
            trained_steps: provenance.steps,
            provenance: serde_json::to_string(&provenance).expect("plain data serialises"),
        }
    }
}

/// Writes the parameters of `store` under `header` to `path`, atomically.
///
/// # Errors
/// If the file cannot be written.
pub fn save(
    store: &ParamStore,
    header: &Header,
    path: &Path,
    precision: Precision,
) -> Result<(), CheckpointError> {
    let (kind, dtype) = match precision {
        Precision::Single => (Kind::Float, Dtype::F32),
        Precision::Half => (Kind::Half, Dtype::F16),
    };
    let parameters: Vec<(&str, Vec<usize>, Vec<u8>)> = store
        .iter()
        .map(|(name, _, tensor)| {
            let shape = tensor.size().iter().map(|size| *size as usize).collect();
            (name, shape, bytes_of(&tensor.detach().to_device(Device::Cpu).to_kind(kind)))
        })
        .collect();
    let views = parameters.iter().map(|(name, shape, bytes)| {
        let view = TensorView::new(dtype, shape.clone(), bytes);
        (*name, view.expect("the bytes were made for this shape"))
    });
    let header = serde_json::to_string(header).expect("plain data serialises");
    let metadata = HashMap::from([
        (FORMAT_KEY.to_owned(), VERSION.to_string()),
        (HEADER_KEY.to_owned(), header),
    ]);
    let mut bytes =
        safetensors::serialize(views, Some(metadata)).expect("names and shapes are valid");
    put_in_order(&mut bytes);
    write_atomically(path, &bytes)
        .map_err(|source| CheckpointError::Write { path: path.to_path_buf(), source })
}

/// Sorts the table of contents of a safetensors file. The library keeps metadata in a hash map, and the same
/// weights are to be the same bytes, hence have the same hash.
fn put_in_order(bytes: &mut [u8]) {
    let (length, rest) = bytes.split_at_mut(8);
    let length = u64::from_le_bytes(length.try_into().expect("eight bytes"));
    let table = &mut rest[..length as usize];
    let entries: BTreeMap<String, BTreeMap<String, serde_json::Value>> =
        serde_json::from_slice(table).expect("the library writes valid JSON");
    let ordered = serde_json::to_vec(&entries).expect("plain data serialises");
    table[..ordered.len()].copy_from_slice(&ordered);
}

/// Writes a file beside `path`, makes it durable, and moves it there.
///
/// # Errors
/// Of the file system.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(".part");
    let temporary = PathBuf::from(temporary);
    let result = (|| {
        let mut file = fs_err::File::create(&temporary)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs_err::rename(&temporary, path)?;
        // The directory entry has to be durable too.
        match path.parent().filter(|parent| !parent.as_os_str().is_empty()) {
            Some(parent) => fs_err::File::open(parent)?.sync_all(),
            None => fs_err::File::open(".")?.sync_all(),
        }
    })();
    if result.is_err() {
        // Best effort: the error that matters is the first one.
        fs_err::remove_file(&temporary).ok();
    }
    result
}

fn read_header(
    path: &Path,
    metadata: Option<&HashMap<String, String>>,
) -> Result<Header, CheckpointError> {
    let foreign = || CheckpointError::Foreign { path: path.to_path_buf() };
    let metadata = metadata.ok_or_else(foreign)?;
    let version = metadata.get(FORMAT_KEY).ok_or_else(foreign)?;
    if version.parse::<u32>().is_ok_and(|version| version > VERSION) {
        let found = version.clone();
        return Err(CheckpointError::Newer { path: path.to_path_buf(), found });
    }
    let header = metadata.get(HEADER_KEY).ok_or_else(foreign)?;
    let header: Header = serde_json::from_str(header)
        .map_err(|source| CheckpointError::Header { path: path.to_path_buf(), source })?;
    let problems = problems(&header);
    if problems.is_empty() {
        return Ok(header);
    }
    Err(CheckpointError::Config { path: path.to_path_buf(), problems: problems.join("; ") })
}

/// What contradicts itself in a header.
fn problems(header: &Header) -> Vec<String> {
    let model = &header.model;
    let mut problems = model.problems();
    if header.actions.len() as i64 != model.action.dim {
        problems.push(format!(
            "actions names {} dimensions, model.action.dim is {}",
            header.actions.len(),
            model.action.dim
        ));
    }
    for dimension in &header.actions {
        let usable = dimension.scale.is_finite() && dimension.scale > 0.0;
        if !usable || !dimension.offset.is_finite() {
            problems.push(format!("the scaling of action {} is not usable", dimension.name));
        }
    }
    match &header.agent_slot {
        Some(slot) if !(0..model.mixture.slots).contains(&slot.index) => {
            problems.push(format!("agent_slot {} is not a slot", slot.index));
        }
        None if model.objects.interaction != crate::config::Interaction::Inter1 => {
            problems.push("agent_slot is missing, but the interaction needs an agent".to_owned());
        }
        _ => {}
    }
    problems
}

fn fill(path: &Path, store: &ParamStore, tensors: &SafeTensors<'_>) -> Result<(), CheckpointError> {
    let _no_grad = tch::no_grad_guard();
    for (name, _, parameter) in store.iter() {
        let (path, name) = (path.to_path_buf(), name.to_owned());
        let Ok(stored) = tensors.tensor(&name) else {
            return Err(CheckpointError::Missing { path, name });
        };
        let expected = parameter.size();
        if !stored.shape().iter().map(|size| *size as i64).eq(expected.iter().copied()) {
            let found = stored.shape().to_vec();
            return Err(CheckpointError::Shape { path, name, found, expected });
        }
        let kind = match stored.dtype() {
            Dtype::F32 => Kind::Float,
            Dtype::F16 => Kind::Half,
            found => return Err(CheckpointError::Dtype { path, name, found }),
        };
        let stored = Tensor::from_data_size(stored.data(), &expected, kind).to_kind(Kind::Float);
        if stored.isfinite().all().int64_value(&[]) == 0 {
            return Err(CheckpointError::NotFinite { path, name });
        }
        parameter.shallow_clone().copy_(&stored);
    }
    match tensors.names().into_iter().find(|name| store.get(name).is_none()) {
        Some(name) => {
            Err(CheckpointError::Unexpected { path: path.to_path_buf(), name: name.to_owned() })
        }
        None => Ok(()),
    }
}

/// The bytes of a CPU tensor, row-major.
fn bytes_of(tensor: &Tensor) -> Vec<u8> {
    let tensor = tensor.contiguous();
    let mut bytes = vec![0; tensor.numel() * tensor.kind().elt_size_in_bytes()];
    tensor.copy_data_u8(&mut bytes, tensor.numel());
    bytes
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"))
}
