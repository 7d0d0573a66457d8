//! Parity with numbers recorded from the official G-SWM model.
//!
//! The full record is found through `GATSBI_PARITY_DIR` (default: `../shared/parity` beside the repository);
//! where it is absent the tests fail, unless `GATSBI_PARITY=skip` says that it is meant to be. A part of it is
//! committed (`models/tests/parity/`) and checked everywhere.

mod generating;
mod tracking;
mod training;
mod units;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use tch::{Device, Kind, Tensor};

use super::{Agent, ObjectModule, Scenery};
use crate::{
    config::{GatsbiConfig, Graph, Interaction, presets},
    nn::ParamStore,
    noise::{Noise, Site},
};

/// What a recorded tensor is, which decides how closely it must be met.
#[derive(Clone, Copy, Debug)]
enum Quantity {
    /// Images and crops: 1e-4 absolute.
    Image,
    /// Everything else: 2e-5 absolute, frame by frame from the state that was recorded. 8.6e-6 was seen, with kernels for
    /// SSE4.2, AVX2 and AVX-512 on one thread and on two.
    Value,
    /// KLs, likelihoods, ELBOs: 1e-4 relative.
    Information,
    /// Gradient norms: 2e-3 relative.
    Gradient,
}

/// A recorded file: tensors by name.
struct Record {
    file: String,
    tensors: BTreeMap<String, Tensor>,
}

impl Record {
    fn open(folder: &Path, file: &str) -> Self {
        let path = folder.join(format!("{file}.safetensors"));
        let tensors = Tensor::read_safetensors(&path)
            .unwrap_or_else(|error| panic!("{} cannot be read: {error}", path.display()));
        Self { file: file.to_owned(), tensors: tensors.into_iter().collect() }
    }

    fn find(&self, name: &str) -> Option<&Tensor> {
        self.tensors.get(name)
    }

    fn get(&self, name: &str) -> &Tensor {
        self.find(name).unwrap_or_else(|| panic!("{} holds no tensor {name}", self.file))
    }

    /// Frame `t` of a tensor stacked over time.
    fn at(&self, name: &str, t: i64) -> Tensor {
        self.get(name).select(1, t)
    }
}

/// Compares with a record, remembers the largest differences, prints them at the end.
struct Checker<'a> {
    record: &'a Record,
    largest: BTreeMap<String, (f64, f64, usize)>,
}

impl<'a> Checker<'a> {
    fn new(record: &'a Record) -> Self {
        Self { record, largest: BTreeMap::new() }
    }

    /// Checks a tensor if the record has one of that name.
    fn check(&mut self, name: &str, actual: &Tensor, quantity: Quantity) {
        if let Some(expected) = self.record.find(name) {
            self.compare(name, actual, expected, quantity);
        }
    }

    fn compare(&mut self, name: &str, actual: &Tensor, expected: &Tensor, quantity: Quantity) {
        let file = &self.record.file;
        assert_eq!(actual.numel(), expected.numel(), "{file}: {name} has another size");
        let difference = (actual.reshape(expected.size()) - expected).abs();
        let (difference, tolerance) = match quantity {
            Quantity::Image => (difference, 1e-4),
            Quantity::Value => (difference, 2e-5),
            Quantity::Information => (difference / expected.abs().clamp_min(1.0), 1e-4),
            Quantity::Gradient => (difference / expected.abs().clamp_min(1e-6), 2e-3),
        };
        let difference = difference.max().double_value(&[]);
        assert!(
            difference <= tolerance,
            "{file}: {name} differs by {difference:e} > {tolerance:e}"
        );
        let entry = self.largest.entry(format!("{quantity:?}")).or_insert((0.0, tolerance, 0));
        entry.0 = entry.0.max(difference);
        entry.2 += 1;
    }

    fn check_ids(&mut self, name: &str, actual: &Tensor, expected: &Tensor) {
        assert_eq!(actual, expected, "{}: {name} differs", self.record.file);
        self.largest.entry("Integer".to_owned()).or_insert((0.0, 0.0, 0)).2 += 1;
    }

    /// Prints the table and checks that at least `count` comparisons were made.
    fn finish(self, count: usize) {
        let total: usize = self.largest.values().map(|(_, _, n)| n).sum();
        for (quantity, (difference, tolerance, n)) in &self.largest {
            println!(
                "parity {:<24} {quantity:<12} {n:>5} tensors  largest difference {difference:.1e}  tolerance {tolerance:.0e}",
                self.record.file
            );
        }
        assert!(total >= count, "only {total} comparisons were made, expected {count}");
    }
}

/// The folder of the full record; `None` if its absence is accepted.
fn full_record() -> Option<PathBuf> {
    let folder = std::env::var_os("GATSBI_PARITY_DIR").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/parity"),
        PathBuf::from,
    );
    let folder = folder.join("gswm");
    if folder.join("state_dict.safetensors").exists() {
        return Some(folder);
    }
    let skip = std::env::var("GATSBI_PARITY").is_ok_and(|value| value == "skip");
    assert!(
        skip,
        "no parity record at {}: set GATSBI_PARITY_DIR, or GATSBI_PARITY=skip to do without",
        folder.display()
    );
    println!("parity skipped: no record at {}", folder.display());
    None
}

/// The committed part of the record.
fn committed_record() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/parity")
}

/// G-SWM's `balls_interaction` configuration.
fn gswm_config() -> GatsbiConfig {
    let mut config = presets::balls();
    let objects = &mut config.objects;
    objects.max_objects = 10;
    objects.graph = Graph::FullyConnected;
    objects.interaction = Interaction::Inter1;
    objects.updates.proposal = (0.0, 0.2);
    objects.updates.scale = 0.1;
    objects.updates.shift = 0.2;
    config
}

/// A module with the recorded weights that `folder` has. With `all`, no parameter may be missing.
fn load(config: &GatsbiConfig, folder: &Path, all: bool) -> (ObjectModule, ParamStore) {
    let weights = Record::open(folder, "state_dict");
    let mut store = ParamStore::new(0, Device::Cpu);
    let module = store.build(|root| ObjectModule::new(root, config));
    let _no_grad = tch::no_grad_guard();
    let mut used = 0;
    for (name, _, tensor) in store.iter() {
        match weights.find(&format!("fg_module.{name}")) {
            Some(recorded) => {
                assert_eq!(tensor.size(), recorded.size(), "{name} has another shape");
                tensor.shallow_clone().copy_(recorded);
                used += 1;
            }
            None => assert!(!all, "the record has no weights for {name}"),
        }
    }
    if all {
        // The alias of the stem, two vectors that nothing reads, and batch counters.
        let unused = |name: &str| {
            name == "img_encoder.conv1.weight"
                || name.starts_with("prop_cond_init")
                || name.ends_with("num_batches_tracked")
        };
        let of_objects = weights.tensors.keys().filter_map(|name| name.strip_prefix("fg_module."));
        assert_eq!(of_objects.filter(|name| !unused(name)).count(), used);
    }
    (module, store)
}

/// Frames of one of the recorded videos as floats, `[2, 11, 3, 64, 64]`.
fn video(folder: &Path, name: &str) -> Tensor {
    Record::open(folder, "inputs").get(name).to_kind(Kind::Float) / 255.0
}

/// A scenery whose background is given.
fn scenery<'a>(frame: &'a Tensor, background: &'a Tensor) -> Scenery<'a> {
    let agent: Option<&'a Agent> = None;
    Scenery { frame, residual_mix: background, environment_mix: background, agent }
}

/// Noise that was recorded, or that of the mean where the record has none.
struct Recorded<'a> {
    record: &'a Record,
    tracked: String,
    discovered: String,
}

impl<'a> Recorded<'a> {
    /// Noise of step `t`, whose tracking phase is `prop` or `gen`.
    fn new(record: &'a Record, t: i64, phase: &str) -> Self {
        Self { record, tracked: format!("t{t}.{phase}"), discovered: format!("t{t}.disc") }
    }

    fn find(&self, site: Site) -> Option<Tensor> {
        let (phase, part) = match site {
            Site::Dynamics => (&self.tracked, "z_dyna"),
            Site::Presence => (&self.tracked, "z_pres"),
            Site::Depth => (&self.tracked, "z_depth"),
            Site::Where => (&self.tracked, "z_where"),
            Site::What => (&self.tracked, "z_what"),
            Site::DiscoveryDynamics => (&self.discovered, "z_dyna"),
            Site::DiscoveryPresence => (&self.discovered, "z_pres"),
            Site::DiscoveryDepth => (&self.discovered, "z_depth"),
            Site::DiscoveryWhere => (&self.discovered, "z_where"),
            Site::DiscoveryWhat => (&self.discovered, "z_what"),
            Site::Mask | Site::Component => {
                unreachable!("the object module draws no mixture noise")
            }
        };
        self.record.find(&format!("{phase}.noise.{part}")).map(Tensor::shallow_clone)
    }
}

impl Noise for Recorded<'_> {
    fn normal(&self, site: Site, shape: &[i64]) -> Tensor {
        self.find(site).unwrap_or_else(|| Tensor::zeros(shape, (Kind::Float, Device::Cpu)))
    }

    fn uniform(&self, site: Site, shape: &[i64]) -> Tensor {
        self.find(site).unwrap_or_else(|| Tensor::full(shape, 0.5, (Kind::Float, Device::Cpu)))
    }
}
