//! Agreement with the twin: a second GATSBI, written in PyTorch from the specification alone (`tests/reference`).
//!
//! The twin's vectors are the judge. Every case in `tests/twin` beside this file, and in the folder that
//! `GATSBI_TWIN_DIR` names, holds inputs, noise and what the twin made of them; here the same checkpoint gets
//! the same inputs and noise, in its trainable and in its frozen form, and every recorded number is compared.
//! Run with `--nocapture` for the table.

#[path = "twin/agreement.rs"]
mod agreement;
#[path = "twin/vectors.rs"]
mod vectors;

use std::path::Path;

use gatsbi_models::{
    checkpoint::Checkpoint,
    gatsbi::{
        loss,
        mixture::Memory,
        model::{Gatsbi, GatsbiState, GatsbiStep, GradientStops, Observing},
        objects::Discover,
    },
    nn::ParamKind,
};
use tch::{Device, Kind, Tensor};

use agreement::{Agreement, Form, Tensors};
use vectors::{Objective, Recorded, Rows, Step, StepKind, Vectors, cases, thin};

#[test]
fn the_model_agrees_with_its_twin() {
    let mut files = cases(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/twin"));
    if let Some(folder) = std::env::var_os("GATSBI_TWIN_DIR") {
        files.extend(cases(Path::new(&folder)));
    }
    let mut agreement = Agreement::default();
    for file in files {
        let vectors = Vectors::load(&file);
        let checkpoint = vectors.checkpoint();
        agreement.compare(Form::Steps, &vectors, &vectors.run(&checkpoint.model));
        agreement.compare(Form::Training, &vectors, &vectors.train(&checkpoint));
        let mut frozen = vectors.checkpoint();
        let _no_grad = tch::no_grad_guard();
        frozen.store.stop_gradients();
        frozen.model.freeze();
        agreement.compare(Form::Frozen, &vectors, &vectors.run(&frozen.model));
    }
    agreement.print();
    let failures = agreement.failures();
    assert!(failures.is_empty(), "\n{}", failures.join("\n"));
}

impl Vectors {
    /// Makes one step; gives the state after it, what it gave and the observed frame.
    fn take(
        &self,
        model: &Gatsbi,
        prefix: &str,
        step: &Step,
        state: GatsbiState,
        train: bool,
    ) -> (GatsbiState, GatsbiStep, Option<Tensor>) {
        let action = self.get(&format!("{prefix}.action"));
        let noise = Recorded { vectors: self, prefix, kind: step.noise };
        let tracking = model.config().tracking;
        match step.kind {
            StepKind::Imagine => {
                let (state, step) = model.imagine(state, action, &noise, &tracking);
                (state, step, None)
            }
            StepKind::Skip => {
                let (state, step) = model.skip(state, action, &noise, &tracking);
                (state, step, None)
            }
            StepKind::Observe => {
                let discover = match &step.discover {
                    Rows::All(true) => Discover::All,
                    Rows::All(false) => Discover::None,
                    Rows::Each(rows) => Discover::Rows(Tensor::from_slice(rows)),
                };
                let how = Observing {
                    train,
                    priors: true,
                    objects: true,
                    discover,
                    tracking,
                    stops: GradientStops::default(),
                };
                let frame = self.get(&format!("{prefix}.frame")).to_kind(Kind::Float) / 255.0;
                let (state, step) = model.observe(state, &frame, action, &noise, how);
                (state, step, Some(frame))
            }
        }
    }

    /// What the model makes of the steps before the training pass.
    fn run(&self, model: &Gatsbi) -> Tensors {
        let _no_grad = tch::no_grad_guard();
        let mut results = Tensors::new();
        let mut state = model.initial_state(self.case.batch);
        for (t, step) in self.case.steps.iter().enumerate() {
            let first = state.first();
            let prefix = format!("s{t}");
            let (next, gives, frame) = self.take(model, &prefix, step, state, false);
            let mut values = outcome(model, &next, &gives);
            if let Some(frame) = frame {
                values.extend(self.terms(model, &first, &next, &gives, &frame));
            }
            results.extend(
                values.into_iter().map(|(name, value)| (format!("{prefix}.{name}"), value)),
            );
            state = next;
        }
        results
    }

    /// The training pass: terms, loss, gradients, running statistics.
    fn train(&self, checkpoint: &Checkpoint) -> Tensors {
        let model = &checkpoint.model;
        let mut results = Tensors::new();
        let mut state = model.initial_state(self.case.batch);
        let mut total = Tensor::zeros([self.case.batch], (Kind::Float, Device::Cpu));
        for (t, step) in self.case.training.iter().enumerate() {
            let first = state.first();
            let prefix = format!("train.s{t}");
            let (next, gives, frame) = self.take(model, &prefix, step, state, true);
            let frame = frame.expect("training observes");
            for (name, value) in self.terms(model, &first, &next, &gives, &frame) {
                if value.dim() > 1 {
                    continue;
                }
                match name.strip_prefix("likelihood.") {
                    Some(kind) if kind == self.case.objective.kind => total -= &value,
                    Some(_) => {}
                    None => total += &value,
                }
                results.insert(format!("{prefix}.{name}"), value.detach());
            }
            state = next;
        }
        let loss = total.mean(Kind::Float);
        loss.backward();
        let _no_grad = tch::no_grad_guard();
        results.insert("train.loss".to_owned(), loss.detach().view(1));
        let limit = self.case.gradient_limit;
        let gradients: Vec<Tensor> =
            checkpoint.store.trainable().map(|(_, tensor)| gradient(tensor, limit)).collect();
        results.insert("train.gradients".to_owned(), Tensor::cat(&gradients, 0));
        let statistics: Vec<Tensor> = checkpoint
            .store
            .iter()
            .filter(|(_, kind, _)| *kind == ParamKind::Buffer)
            .map(|(_, _, tensor)| tensor.flatten(0, -1))
            .collect();
        if !statistics.is_empty() {
            results.insert("train.statistics".to_owned(), Tensor::cat(&statistics, 0));
        }
        results
    }

    /// What compares a step with its frame: priors, KLs, likelihoods, keypoints.
    fn terms(
        &self,
        model: &Gatsbi,
        first: &Tensor,
        state: &GatsbiState,
        step: &GatsbiStep,
        frame: &Tensor,
    ) -> Vec<(String, Tensor)> {
        let Objective { sigma, alpha, .. } = self.case.objective;
        let (mixture, config) = (&step.mixture, model.config());
        let objects = step.objects.as_ref().expect("an observed step has objects");
        let (mask_prior, comp_prior) = mixture.priors.as_ref().expect("priors were asked for");
        let rendering = model.render(state);
        let fixed = loss::fixed_alpha_image(&rendering.foreground, &mixture.mu_mix, alpha);
        let composite = rendering.over(&mixture.mu_mix);
        let (kl_mask, kl_comp) = loss::mixture_kl(mixture);
        let prior = &config.objects.prior;
        let kl = objects.kl(prior, config.objects.aux_presence_kl);
        let mut terms = vec![
            ("prior.mask.mean", mask_prior.loc.shallow_clone()),
            ("prior.mask.std", mask_prior.scale.shallow_clone()),
            ("prior.comp.mean", comp_prior.loc.shallow_clone()),
            ("prior.comp.std", comp_prior.scale.shallow_clone()),
            ("objects.proposal", objects.proposal.shallow_clone()),
            ("kl.mask", kl_mask),
            ("kl.comp", kl_comp),
            ("kl.objects.pres", kl.pres),
            ("kl.objects.depth", kl.depth),
            ("kl.objects.where", kl.place),
            ("kl.objects.what", kl.what),
            ("kl.objects.dyna", kl.dyna),
            ("likelihood.gaussian", loss::gaussian_log_likelihood(frame, &composite, sigma)),
            (
                "likelihood.mixture",
                loss::mixture_log_likelihood(frame, &mixture.log_masks, &mixture.components, sigma),
            ),
            ("likelihood.fixed_alpha", loss::gaussian_log_likelihood(frame, &fixed, sigma)),
            ("residual_norm", loss::residual_norm(mixture, first)),
        ];
        if let Some(detector) = model.detector() {
            let keypoints = detector.forward(frame);
            let gamma = detector.gamma(&keypoints);
            if let Some(slot) = model.agent_slot() {
                let agent = mixture.log_masks.select(1, slot).exp();
                terms.push(("regression", loss::keypoint_regression(&gamma, &agent)));
            }
            terms.push(("keypoints.gamma", gamma));
            terms.push(("keypoints.heatmaps", keypoints.heatmaps));
            terms.push(("keypoints.points", keypoints.points));
        }
        terms.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }
}

/// State, latents and images after a step.
fn outcome(model: &Gatsbi, state: &GatsbiState, step: &GatsbiStep) -> Tensors {
    let (mixture, objects) = (&step.mixture, &state.objects);
    let rendering = model.render(state);
    // What an empty slot holds has no meaning.
    let filled = objects.ids.ge(0).unsqueeze(-1);
    let keep = |x: &Tensor| x * &filled;
    let copy = Tensor::shallow_clone;
    let mut results = vec![
        ("mixture.z_mask", copy(&state.mixture.z_mask)),
        ("mixture.z_comp", copy(&state.mixture.z_comp)),
        ("mixture.mask_raw.mean", copy(&mixture.mask_raw.loc)),
        ("mixture.mask_raw.std", copy(&mixture.mask_raw.scale)),
        ("mixture.comp_raw.mean", copy(&mixture.comp_raw.loc)),
        ("mixture.comp_raw.std", copy(&mixture.comp_raw.scale)),
        ("mixture.mask_residual", copy(&mixture.residuals.0)),
        ("mixture.comp_residual", copy(&mixture.residuals.1)),
        ("mixture.log_masks", copy(&mixture.log_masks)),
        ("mixture.components", copy(&mixture.components)),
        ("mixture.mu_mix", copy(&mixture.mu_mix)),
        ("objects.ids", copy(&objects.ids)),
        ("objects.next_id", copy(&objects.next_id)),
        ("objects.z", keep(&objects.z)),
        ("objects.post.h", keep(&objects.post.h)),
        ("objects.post.c", keep(&objects.post.c)),
        ("objects.prior.h", keep(&objects.prior.h)),
        ("objects.prior.c", keep(&objects.prior.c)),
        ("image.frame", rendering.over(&mixture.mu_mix)),
        ("image.foreground", rendering.foreground),
        ("image.alpha", rendering.alpha),
        ("image.object_masks", rendering.masks),
    ];
    let mut memory = |h, c, memory: &Memory| {
        results.extend([(h, copy(&memory.h)), (c, copy(&memory.c))]);
    };
    memory("mixture.mask_post.h", "mixture.mask_post.c", &state.mixture.mask_post);
    memory("mixture.mask_prior.h", "mixture.mask_prior.c", &state.mixture.mask_prior);
    memory("mixture.comp_post.h", "mixture.comp_post.c", &state.mixture.comp_post);
    memory("mixture.comp_prior.h", "mixture.comp_prior.c", &state.mixture.comp_prior);
    results.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}

/// Norm, largest magnitude, then the thinned numbers of a parameter's gradient.
fn gradient(parameter: &Tensor, limit: i64) -> Tensor {
    let gradient = parameter.grad();
    let gradient = if gradient.defined() { gradient } else { parameter.zeros_like() };
    if gradient.numel() == 0 {
        return Tensor::zeros([3], (Kind::Float, Device::Cpu));
    }
    let parts =
        [gradient.norm().view(1), gradient.abs().max().view(1), thin(&gradient, limit).view(-1)];
    Tensor::cat(&parts, 0)
}
