//! The state of a run on disk: weights, moments, step and recipe, so that a stopped run goes on with the numbers
//! of an uninterrupted one.
//!
//! One safetensors file, written whole or not at all, beside the checkpoint that the same run keeps for users.

use std::{collections::HashMap, path::Path};

use anyhow::{Context as _, bail, ensure};
use gatsbi_models::{checkpoint::write_atomically, nn::ParamStore, world_model::ActionDimension};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};
use tch::{Device, Kind, Tensor};

use crate::{adam::Adam, recipe::Recipe};

const HEADER_KEY: &str = "gatsbi.training";

/// What identifies a run and how far it is.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Steps taken.
    pub step: u64,
    /// Seed of the run.
    pub seed: u64,
    /// Seconds spent so far.
    pub seconds: f64,
    /// Steps skipped because the loss was not finite.
    pub skipped: u64,
    /// Recipe of the run.
    pub recipe: Recipe,
    /// Name and SHA-256 or shape of the data, for telling another data set apart.
    pub data: String,
    /// How its actions are scaled.
    pub actions: Vec<ActionDimension>,
}

/// Writes weights, moments and progress.
pub fn save(
    path: &Path,
    stores: &[&ParamStore],
    adam: &Adam,
    progress: &Progress,
) -> anyhow::Result<()> {
    let mut tensors: Vec<(String, Tensor)> = Vec::new();
    for store in stores {
        tensors.extend(
            store.iter().map(|(name, _, tensor)| (format!("weight.{name}"), tensor.detach())),
        );
    }
    tensors.extend(adam.tensors());
    let encoded: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = tensors
        .into_iter()
        .map(|(name, tensor)| {
            let tensor = tensor.to_device(Device::Cpu).contiguous();
            let dtype = if tensor.kind() == Kind::Int64 { Dtype::I64 } else { Dtype::F32 };
            let mut bytes = vec![0; tensor.numel() * tensor.kind().elt_size_in_bytes()];
            tensor.copy_data_u8(&mut bytes, tensor.numel());
            (name, dtype, tensor.size().iter().map(|size| *size as usize).collect(), bytes)
        })
        .collect();
    let views = encoded.iter().map(|(name, dtype, shape, bytes)| {
        let view = TensorView::new(*dtype, shape.clone(), bytes);
        (name.as_str(), view.expect("the bytes were made for this shape"))
    });
    let header = HashMap::from([(HEADER_KEY.to_owned(), serde_json::to_string(progress)?)]);
    let bytes = safetensors::serialize(views, Some(header))?;
    write_atomically(path, &bytes).with_context(|| format!("{} cannot be written", path.display()))
}

/// Reads progress, and puts weights and moments where they belong.
pub fn load(path: &Path, stores: &[&ParamStore], adam: &mut Adam) -> anyhow::Result<Progress> {
    let bytes = fs_err::read(path)?;
    let broken = || format!("{} is not a whole training state", path.display());
    let (_, metadata) = SafeTensors::read_metadata(&bytes).with_context(broken)?;
    let tensors = SafeTensors::deserialize(&bytes).with_context(broken)?;
    let header = metadata.metadata().as_ref().and_then(|header| header.get(HEADER_KEY));
    let progress: Progress = serde_json::from_str(header.with_context(broken)?)?;
    let read = |name: &str| -> anyhow::Result<Tensor> {
        let view =
            tensors.tensor(name).with_context(|| format!("{} has no {name}", path.display()))?;
        let kind = match view.dtype() {
            Dtype::F32 => Kind::Float,
            Dtype::I64 => Kind::Int64,
            other => bail!("{name} of {} is {other:?}", path.display()),
        };
        let shape: Vec<i64> = view.shape().iter().map(|size| *size as i64).collect();
        Ok(Tensor::from_data_size(view.data(), &shape, kind))
    };
    let _no_grad = tch::no_grad_guard();
    for store in stores {
        for (name, _, parameter) in store.iter() {
            let saved = read(&format!("weight.{name}"))?;
            ensure!(
                saved.size() == parameter.size(),
                "{name} has another shape in {}",
                path.display()
            );
            parameter.shallow_clone().copy_(&saved);
        }
        let device = store.device();
        adam.restore(store, device, |name| {
            tensors.tensor(name).is_ok().then(|| read(name)).transpose()
        })?;
    }
    Ok(progress)
}
