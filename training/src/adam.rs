//! Adam (Kingma & Ba 2015) whose whole state can be saved: resuming gives the numbers of an uninterrupted run.

use std::collections::BTreeMap;

use gatsbi_models::nn::ParamStore;
use tch::{Device, Kind, Tensor};

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPS: f64 = 1e-8;

/// Moments of one parameter and the steps it took.
#[derive(Debug)]
pub struct Moments {
    first: Tensor,
    second: Tensor,
    steps: i64,
}

/// The optimiser; parameters that get no gradient, or one of zeros, are left alone, moments and all: a gradient
/// that was cleared cannot be told from one that never was.
#[derive(Debug, Default)]
pub struct Adam {
    moments: BTreeMap<String, Moments>,
}

impl Adam {
    /// All state by name: `adam.first.NAME`, `adam.second.NAME`, `adam.steps.NAME`.
    pub fn tensors(&self) -> Vec<(String, Tensor)> {
        self.moments
            .iter()
            .flat_map(|(name, moments)| {
                [
                    (format!("adam.first.{name}"), moments.first.shallow_clone()),
                    (format!("adam.second.{name}"), moments.second.shallow_clone()),
                    (format!("adam.steps.{name}"), Tensor::from(moments.steps)),
                ]
            })
            .collect()
    }

    /// Takes the state of the parameters of `store` from `find`, which knows the names of [`Adam::tensors`].
    ///
    /// # Errors
    /// Those of `find`.
    pub fn restore<E>(
        &mut self,
        store: &ParamStore,
        device: Device,
        find: impl Fn(&str) -> Result<Option<Tensor>, E>,
    ) -> Result<(), E> {
        for (name, _) in store.trainable() {
            let part = |part: &str| find(&format!("adam.{part}.{name}"));
            if let (Some(first), Some(second), Some(steps)) =
                (part("first")?, part("second")?, part("steps")?)
            {
                let moments = Moments {
                    first: first.to_device(device),
                    second: second.to_device(device),
                    steps: steps.int64_value(&[]),
                };
                self.moments.insert(name.to_owned(), moments);
            }
        }
        Ok(())
    }

    /// Scales the gradients to a global norm of at most `clip` and takes a step with the learning rate of each
    /// parameter's name. Gradients are cleared.
    ///
    /// Returns the norm before clipping; if it is not finite, nothing is changed but the gradients.
    pub fn step(&mut self, stores: &[&ParamStore], rate: impl Fn(&str) -> f64, clip: f64) -> f64 {
        let _no_grad = tch::no_grad_guard();
        let with_gradient: Vec<(&str, &Tensor, Tensor)> = stores
            .iter()
            .flat_map(|store| store.trainable())
            .map(|(name, parameter)| (name, parameter, parameter.grad()))
            .filter(|(_, _, gradient)| gradient.defined())
            .collect();
        let squares: Vec<Tensor> = with_gradient
            .iter()
            .map(|(_, _, gradient)| gradient.square().sum(Kind::Float))
            .collect();
        let squares = Tensor::stack(&squares, 0).to_kind(Kind::Double);
        let squares: Vec<f64> = squares.try_into().expect("one number per parameter");
        let norm = squares.iter().sum::<f64>().sqrt();
        if norm.is_finite() {
            let factor = (clip / (norm + 1e-6)).min(1.0);
            let moved = with_gradient.iter().zip(&squares).filter(|(_, square)| **square > 0.0);
            for ((name, parameter, gradient), _) in moved {
                let moments = self.moments.entry((*name).to_owned()).or_insert_with(|| Moments {
                    first: parameter.zeros_like(),
                    second: parameter.zeros_like(),
                    steps: 0,
                });
                moments.step(parameter, &(gradient * factor), rate(name));
            }
        }
        for (_, parameter, _) in with_gradient {
            parameter.shallow_clone().zero_grad();
        }
        norm
    }
}

/// Lets exactly those parameters learn whose names `learns` accepts; the others cost no backward pass.
pub fn select(stores: &[&ParamStore], learns: impl Fn(&str) -> bool) {
    for (name, parameter) in stores.iter().flat_map(|store| store.trainable()) {
        let _ = parameter.set_requires_grad(learns(name));
    }
}

impl Moments {
    fn step(&mut self, parameter: &Tensor, gradient: &Tensor, rate: f64) {
        self.steps += 1;
        let _ = self.first.g_mul_scalar_(BETA1);
        let _ = self.first.g_add_(&(gradient * (1.0 - BETA1)));
        let _ = self.second.g_mul_scalar_(BETA2);
        let _ = self.second.g_add_(&(gradient.square() * (1.0 - BETA2)));
        let bias1 = 1.0 - BETA1.powi(self.steps as i32);
        let bias2 = (1.0 - BETA2.powi(self.steps as i32)).sqrt();
        let denominator = self.second.sqrt() / bias2 + EPS;
        let _ = parameter.shallow_clone().g_sub_(&(&self.first / denominator * (rate / bias1)));
    }
}
