//! Named parameters and how they start.
//!
//! Names are dotted paths (`objects.img_encoder.enc.0.weight`) and are the names in the checkpoint. Initial
//! values depend on the seed and the parameter's own name alone, never on the order of construction, so adding
//! a network leaves the start of all others as it was.

use std::{cell::RefCell, collections::BTreeMap};

use serde::{Deserialize, Serialize};
use tch::{Device, Kind, Tensor};

use crate::noise::{mix, normals, open_unit, philox4x32_10};

/// What a stored tensor is for.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum ParamKind {
    /// Learned by gradient descent.
    Trainable,
    /// Kept with the weights but not learned (running statistics).
    Buffer,
}

/// All parameters of a model by name, in name order.
#[derive(Debug)]
pub struct ParamStore {
    entries: BTreeMap<String, (ParamKind, Tensor)>,
    seed: u64,
    device: Device,
}

impl ParamStore {
    /// An empty store whose parameters will start from `seed`.
    pub fn new(seed: u64, device: Device) -> Self {
        Self { entries: BTreeMap::new(), seed, device }
    }

    /// Builds a module, handing it the root path of this store.
    pub fn build<M>(&mut self, build: impl FnOnce(&Path<'_>) -> M) -> M {
        let store = RefCell::new(self);
        build(&Path { store: &store, prefix: String::new() })
    }

    /// Names, kinds and tensors in name order.
    pub fn iter(&self) -> impl Iterator<Item = (&str, ParamKind, &Tensor)> {
        self.entries.iter().map(|(name, (kind, tensor))| (name.as_str(), *kind, tensor))
    }

    /// The trainable parameters in name order.
    pub fn trainable(&self) -> impl Iterator<Item = (&str, &Tensor)> {
        self.iter().filter(|(_, kind, _)| *kind == ParamKind::Trainable).map(|(n, _, t)| (n, t))
    }

    /// The tensor stored under `name`.
    pub fn get(&self, name: &str) -> Option<&Tensor> {
        self.entries.get(name).map(|(_, tensor)| tensor)
    }

    /// Number of stored values, buffers left out.
    pub fn trainable_count(&self) -> usize {
        self.trainable().map(|(_, tensor)| tensor.numel()).sum()
    }

    /// Takes over the values of all `wanted` parameters that `other` has under the same name in the same shape; returns the
    /// names of the others.
    pub fn take(&mut self, other: &Self, wanted: impl Fn(&str) -> bool) -> Vec<String> {
        let _no_grad = tch::no_grad_guard();
        let mut left = Vec::new();
        for (name, (_, tensor)) in &mut self.entries {
            match other.get(name) {
                Some(theirs) if theirs.size() == tensor.size() && wanted(name) => {
                    tensor.copy_(theirs);
                }
                _ => left.push(name.clone()),
            }
        }
        left
    }

    /// Stops gradients for every parameter.
    pub fn stop_gradients(&mut self) {
        for (_, tensor) in self.entries.values_mut() {
            *tensor = tensor.set_requires_grad(false);
        }
    }

    /// Where the parameters live.
    pub fn device(&self) -> Device {
        self.device
    }
}

/// How a parameter starts. `fan_in` is the product of all sizes but the first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Init {
    /// Every value the same.
    Constant(f64),
    /// Normal with mean 0.
    Normal {
        /// Standard deviation.
        std: f64,
    },
    /// Uniform in ± bound.
    Uniform {
        /// Half the width of the interval.
        bound: f64,
    },
    /// Orthogonal rows or columns (Saxe et al. 2014) for matrices; the trailing sizes count as one.
    Orthogonal {
        /// Factor on the orthogonal matrix.
        gain: f64,
    },
    /// He normal, `std = sqrt(2 / fan_in)`.
    HeNormal,
    /// He normal on the way back, `std = sqrt(2 / fan_out)`: residual-body convolutions.
    HeNormalFanOut,
}

/// Where in the tree of names the parameters of a module go.
#[derive(Debug)]
pub struct Path<'a> {
    store: &'a RefCell<&'a mut ParamStore>,
    prefix: String,
}

impl<'a> Path<'a> {
    /// The path one level down.
    #[must_use]
    pub fn sub(&self, name: impl std::fmt::Display) -> Path<'a> {
        Path { store: self.store, prefix: self.join(&name.to_string()) }
    }

    /// Creates a trainable parameter.
    pub fn weight(&self, name: &str, shape: &[i64], init: Init) -> Tensor {
        self.create(name, shape, init, ParamKind::Trainable)
    }

    /// Creates a buffer.
    pub fn buffer(&self, name: &str, shape: &[i64], value: f64) -> Tensor {
        self.create(name, shape, Init::Constant(value), ParamKind::Buffer)
    }

    /// Device of the store.
    pub fn device(&self) -> Device {
        self.store.borrow().device
    }

    fn join(&self, name: &str) -> String {
        if self.prefix.is_empty() { name.to_owned() } else { format!("{}.{name}", self.prefix) }
    }

    fn create(&self, name: &str, shape: &[i64], init: Init, kind: ParamKind) -> Tensor {
        let mut store = self.store.borrow_mut();
        let name = self.join(name);
        let key = name.bytes().fold(mix(store.seed), |hash, byte| mix(hash ^ u64::from(byte)));
        let tensor = initial(shape, init, key)
            .to_device(store.device)
            .set_requires_grad(kind == ParamKind::Trainable);
        let handle = tensor.shallow_clone();
        let previous = store.entries.insert(name, (kind, tensor));
        assert!(previous.is_none(), "two parameters share a name under {:?}", self.prefix);
        handle
    }
}

/// Which family of initial values a network starts from.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum InitScheme {
    /// Uniform in ± 1/sqrt(fan-in) for weights and biases, what deep-learning frameworks do by default.
    Framework,
    /// Orthogonal linear layers of gain 1.3, He-normal convolutions, zero biases, scale heads that start
    /// small. Keeps the signal alive through the mixture module's long chains of unnormalised layers.
    Orthogonal,
}

impl InitScheme {
    /// Initial weight and bias of a linear layer, the weight times `scale`.
    pub(crate) fn linear(self, fan_in: i64, scale: f64) -> (Init, Init) {
        match self {
            Self::Framework => {
                let bound = 1.0 / (fan_in.max(1) as f64).sqrt();
                (Init::Uniform { bound: bound * scale }, Init::Uniform { bound })
            }
            Self::Orthogonal => (Init::Orthogonal { gain: 1.3 * scale }, Init::Constant(0.0)),
        }
    }

    /// Initial weight and bias of a convolution.
    pub(crate) fn conv(self, fan_in: i64) -> (Init, Init) {
        match self {
            Self::Framework => self.linear(fan_in, 1.0),
            Self::Orthogonal => (Init::HeNormal, Init::Constant(0.0)),
        }
    }

    /// Factor on the weights and value of the biases of the scale half of a distribution head.
    pub(crate) fn scale_head(self) -> Option<(f64, f64)> {
        match self {
            Self::Framework => None,
            Self::Orthogonal => Some((0.1, -1.5)),
        }
    }
}

fn initial(shape: &[i64], init: Init, key: u64) -> Tensor {
    let fan = |dim: usize| (shape.iter().product::<i64>() / shape[dim].max(1)) as f64;
    match init {
        Init::Constant(value) => Tensor::full(shape, value, (Kind::Float, Device::Cpu)),
        Init::Normal { std } => normal(shape, key) * std,
        Init::Uniform { bound } => {
            let count = shape.iter().product::<i64>() as usize;
            let values: Vec<f32> = words(key)
                .map(|bits| (open_unit(bits) * 2.0 - 1.0) * bound as f32)
                .take(count)
                .collect();
            Tensor::from_slice(&values).view(shape)
        }
        Init::HeNormal => normal(shape, key) * (2.0 / fan(0)).sqrt(),
        Init::HeNormalFanOut => {
            let receptive = shape[2..].iter().product::<i64>();
            normal(shape, key) * (2.0 / (shape[0] * receptive) as f64).sqrt()
        }
        Init::Orthogonal { gain } => {
            let rows = shape[0];
            let columns = shape[1..].iter().product::<i64>();
            if rows == 0 || columns == 0 {
                return Tensor::zeros(shape, (Kind::Float, Device::Cpu));
            }
            let gaussian = normal(&[rows.max(columns), rows.min(columns)], key);
            let (q, r) = Tensor::linalg_qr(&gaussian, "reduced");
            // The sign makes the distribution uniform over orthogonal matrices.
            let q = q * r.diagonal(0, 0, 1).sign();
            let q = if rows >= columns { q } else { q.tr() };
            (q * gain).reshape(shape)
        }
    }
}

fn words(key: u64) -> impl Iterator<Item = u32> {
    let key = [key as u32, (key >> 32) as u32];
    (0u32..).flat_map(move |block| philox4x32_10([block, 0, 0, 0], key))
}

fn normal(shape: &[i64], key: u64) -> Tensor {
    let count = shape.iter().product::<i64>() as usize;
    let key = [key as u32, (key >> 32) as u32];
    let values: Vec<f32> = (0u32..)
        .flat_map(|block| normals(philox4x32_10([block, 0, 0, 0], key)))
        .take(count)
        .collect();
    Tensor::from_slice(&values).view(shape)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_start_depends_on_seed_and_name_alone() {
        let start = |seed: u64, names: &[&str]| {
            let mut store = ParamStore::new(seed, Device::Cpu);
            store.build(|root| {
                for name in names {
                    let _ = root.weight(name, &[4, 3], Init::HeNormal);
                }
            });
            store.get("b").unwrap().copy()
        };
        assert_eq!(start(1, &["a", "b"]), start(1, &["b"]));
        assert_ne!(start(1, &["b"]), start(2, &["b"]));
    }

    #[test]
    fn what_another_store_has_in_the_same_shape_is_taken_over() {
        let store = |seed: u64, entries: &[(&str, [i64; 2])]| {
            let mut store = ParamStore::new(seed, Device::Cpu);
            store.build(|root| {
                for (name, shape) in entries {
                    let _ = root.weight(name, shape, Init::HeNormal);
                }
            });
            store
        };
        let mut ours = store(1, &[("a", [4, 3]), ("b", [4, 3]), ("c", [2, 2])]);
        let theirs = store(2, &[("a", [4, 3]), ("b", [3, 3]), ("d", [2, 2])]);
        let kept = ours.get("b").unwrap().copy();
        assert_eq!(ours.take(&theirs, |name| name != "a"), ["a", "b", "c"]);
        assert_eq!(ours.take(&theirs, |_| true), ["b", "c"]);
        assert_eq!(ours.get("a"), theirs.get("a"));
        assert_eq!(ours.get("b"), Some(&kept));
        assert!(ours.get("a").unwrap().requires_grad());
    }

    #[test]
    fn orthogonal_is_orthogonal_both_ways() {
        for shape in [[8, 3], [3, 8]] {
            let matrix = initial(&shape, Init::Orthogonal { gain: 2.0 }, 5);
            let small = if shape[0] > shape[1] {
                matrix.tr().matmul(&matrix)
            } else {
                matrix.matmul(&matrix.tr())
            };
            let expected = Tensor::eye(3, (Kind::Float, Device::Cpu)) * 4.0;
            assert!((small - expected).abs().max().double_value(&[]) < 1e-5);
        }
    }
}
