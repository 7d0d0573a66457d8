//! The training objective of a batch of sequences (mixture spec 5, object spec 3.8 and 6.8).

use gatsbi_models::{
    config::{DiscoveryPolicy, IdRule, PresenceRule, Tracking},
    gatsbi::{
        keypoint::{KeypointLearning, Keypoints},
        loss,
        mixture::MixtureStep,
        model::{Gatsbi, GatsbiState, GradientStops, Observing},
        objects::{Discover, ObjectState, ObjectStep, Placed, Rendering},
    },
    noise::{Noise, PhiloxNoise, RowNoise, Site, philox4x32_10},
};
use tch::{Device, Kind, Tensor};

use crate::{
    clips::Batch,
    recipe::{KeypointRecipe, MixtureRecipe, ObjectRecipe, Ramp, Recipe, RegressionRecipe},
    variant::Variant,
};

/// Where a run is: everything random about a step is a function of this.
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    /// Seed of the run.
    pub seed: u64,
    /// Optimiser step.
    pub step: u64,
}

/// Loss of a batch: mean over sequences, summed over time.
#[derive(Debug)]
pub struct Objective {
    /// What is minimised.
    pub loss: Tensor,
    /// Its terms by name, unweighted and detached, summed over time.
    pub terms: Vec<(&'static str, Tensor)>,
}

/// Weighted terms on their way to a loss.
#[derive(Default)]
pub(crate) struct Terms {
    entries: Vec<(&'static str, Tensor, f64)>,
}

impl Terms {
    /// Adds a term of `[B]`.
    pub(crate) fn add(&mut self, name: &'static str, value: Tensor, weight: f64) {
        match self.entries.iter_mut().find(|(known, _, _)| *known == name) {
            Some((_, sum, _)) => *sum = &*sum + value,
            None => self.entries.push((name, value, weight)),
        }
    }

    pub(crate) fn finish(self, like: &Tensor) -> Objective {
        let mut loss = Tensor::zeros([1], (Kind::Float, like.device()));
        let mut terms = Vec::new();
        for (name, value, weight) in self.entries {
            let mean = value.mean(Kind::Float);
            terms.push((name, mean.detach()));
            if weight != 0.0 {
                loss += mean * weight;
            }
        }
        Objective { loss: loss.sum(Kind::Float), terms }
    }
}

/// How objects are tracked in training: presence is the original product, and new objects come as told; bounds and merging
/// are those of the recipe.
pub fn training_tracking(objects: Option<&ObjectRecipe>) -> Tracking {
    Tracking {
        discovery: DiscoveryPolicy::EveryFrame,
        presence: PresenceRule::Product,
        ids: IdRule::Monotone,
        scale_bounds: objects.and_then(|objects| objects.scale_bounds),
        merge: objects.and_then(|objects| objects.merge),
        unlike: objects.and_then(|objects| objects.unlike),
        handover: None,
    }
}

/// Noise of frame `t` of a step.
pub fn noise(moment: Moment, t: usize, batch: i64, device: Device) -> PhiloxNoise {
    let rows = (0..batch)
        .map(|row| RowNoise::Sample {
            seed: moment.seed,
            sample: row as u32,
            step: moment.step << 8 | t as u64,
        })
        .collect();
    PhiloxNoise::new(rows, device)
}

/// Noise whose part for the mixture's latents is scaled.
struct DampedNoise {
    noise: PhiloxNoise,
    factor: f64,
}

impl Noise for DampedNoise {
    fn normal(&self, site: Site, shape: &[i64]) -> Tensor {
        let noise = self.noise.normal(site, shape);
        match site {
            Site::Mask | Site::Component => noise * self.factor,
            _ => noise,
        }
    }

    fn uniform(&self, site: Site, shape: &[i64]) -> Tensor {
        self.noise.uniform(site, shape)
    }
}

/// The loss of a batch.
pub fn objective(
    model: &Gatsbi,
    learning: Option<&KeypointLearning>,
    recipe: &Recipe,
    batch: &Batch,
    moment: Moment,
) -> Objective {
    let step = moment.step;
    let mut terms = Terms::default();
    let keypoints = recipe.keypoints.as_ref().filter(|keypoints| step < keypoints.end);
    let gamma = match (keypoints, learning, model.detector()) {
        (Some(weights), Some(learning), Some(detector)) => {
            let found: Vec<Keypoints> =
                batch.frames.iter().map(|frame| detector.forward(frame)).collect();
            let actions = batch.actions.iter().map(|action| model.enhance(action));
            let actions: Vec<Tensor> = match recipe.variant {
                Variant::KeypointsApart => actions.map(|action| action.detach()).collect(),
                _ => actions.collect(),
            };
            add_keypoints(&mut terms, learning, weights, (batch, &actions), &found, moment);
            Some(found.iter().map(|found| detector.gamma(found)).collect::<Vec<_>>())
        }
        _ => None,
    };
    if step >= recipe.mixture.start {
        add_scene(&mut terms, model, recipe, batch, gamma.as_deref(), moment);
    }
    terms.finish(&batch.frames[0])
}

fn add_keypoints(
    terms: &mut Terms,
    learning: &KeypointLearning,
    weights: &KeypointRecipe,
    (batch, actions): (&Batch, &[Tensor]),
    found: &[Keypoints],
    moment: Moment,
) {
    let rows = batch.frames[0].size()[0];
    let device = batch.frames[0].device();
    let networks = &weights.networks;
    // Keypoints draw from a stream of their own.
    let moment = Moment { seed: !moment.seed, ..moment };
    let noise: Vec<Tensor> = (0..batch.frames.len())
        .map(|t| {
            let shape = [rows, networks.samples, networks.latent];
            noise(moment, t, rows, device).normal(Site::Mask, &shape).transpose(0, 1)
        })
        .collect();
    let losses = learning.losses(&batch.frames, found, actions, &noise);
    let per_row = |x: Tensor| x.expand([rows], false);
    terms.add("kp_image", per_row(losses.image), 1.0);
    terms.add("kp_separation", per_row(losses.separation), weights.separation);
    terms.add("kp_sparsity", per_row(losses.sparsity), weights.sparsity);
    terms.add("kp_dynamics", per_row(losses.dynamics), 1.0);
    terms.add("kp_kl", per_row(losses.kl), weights.kl.at(moment.step));
}

/// Mixture and objects over the sequence.
fn add_scene(
    terms: &mut Terms,
    model: &Gatsbi,
    recipe: &Recipe,
    batch: &Batch,
    gamma: Option<&[Tensor]>,
    moment: Moment,
) {
    let rows = batch.frames[0].size()[0];
    let device = batch.frames[0].device();
    let objects = recipe.objects.as_ref().filter(|objects| moment.step >= objects.start);
    let alone = recipe.objects_alone(moment.step);
    let tracking = training_tracking(objects);
    let observed = batch.frames.len() - recipe.imagined.at(moment.step) as usize;
    let mut state = model.initial_state(rows);
    // What is believed of the frames that are imagined when they are seen.
    let mut seeing = None;
    for (t, frame) in batch.frames.iter().enumerate() {
        let first = state.first();
        if t == observed && objects.is_some_and(|objects| objects.foresight.at(moment.step) > 0.0) {
            seeing = Some(state.shallow_clone());
        }
        let dropout = objects.map_or(0.0, |objects| objects.discovery_dropout.at(moment.step));
        let discover =
            if t > 0 && dropped(moment, t, dropout) { Discover::None } else { Discover::All };
        let how = Observing {
            train: true,
            priors: !alone,
            objects: objects.is_some(),
            discover,
            tracking,
            stops: GradientStops::default(),
        };
        let noise = DampedNoise {
            noise: noise(moment, t, rows, device),
            factor: recipe.mixture.noise.at(moment.step),
        };
        let before = state.shallow_clone();
        let (next, seen) = if t < observed {
            model.observe(state, frame, &batch.actions[t], &noise, how)
        } else {
            model.imagine(state, &batch.actions[t], &noise, &tracking)
        };
        state = next;
        let phase = if t < observed { Phase::Observed } else { Phase::Imagined };
        if !alone {
            add_mixture(terms, &recipe.mixture, &seen.mixture, frame, moment.step, phase);
            if phase == Phase::Observed {
                add_mixture_kl(terms, &recipe.mixture, &seen.mixture, &first, moment.step);
            }
        }
        seeing = seeing.map(|believed| {
            let _no_grad = tch::no_grad_guard();
            let how = Observing::serving(model.config().tracking);
            model.observe(believed, frame, &batch.actions[t], &noise, how).0
        });
        let rendering = objects.map(|_| model.render(&state));
        let maps = Maps {
            gamma: gamma.map(|gamma| &gamma[t]),
            motion: &batch.motion[t],
            foreground: &batch.foreground[t],
        };
        let agent = model.agent_slot().map(|slot| seen.mixture.log_masks.select(1, slot).exp());
        let alpha = rendering.as_ref().map(|rendering| &rendering.alpha);
        add_regression(terms, &recipe.regression, &maps, agent.as_ref(), alpha, moment.step);
        if let (Some(objects), Some(rendering)) = (objects, &rendering) {
            add_composite(terms, objects, rendering, &seen.mixture, frame, moment.step, phase);
            let found = (t > 0 && objects.leads_to_found(moment.step)).then(|| {
                let _no_grad = tch::no_grad_guard();
                let found = model.objects().detect(frame, &seen.mixture.mu_mix);
                model.objects().placed(&found)
            });
            let known = (&state.objects, seeing.as_ref().map(|believed| &believed.objects));
            add_places(terms, model, objects, known, found.as_ref(), moment.step);
            let weight = objects.catching.at(moment.step);
            if let Some(found) = found.filter(|_| weight > 0.0 && phase == Phase::Observed) {
                let jolts = jolts(&before, moment, t, pixels(model));
                let caught = model.follow(
                    &before.objects.jolted(&jolts),
                    (&before.mixture, &state.mixture),
                    &seen.mixture,
                    (frame, &batch.actions[t]),
                    &noise,
                    &tracking,
                );
                let caught = model.objects().placed(&caught.z);
                add_following(terms, "catching", (&caught, &found), weight, pixels(model));
            }
            if let Some(found) = &seen.objects {
                add_objects_kl(terms, model, objects, found, moment.step);
            }
        }
    }
}

/// Whether a frame was shown to the model or left to its priors; terms of both are told apart in the journal.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Phase {
    Observed,
    Imagined,
}

impl Phase {
    fn name(self, observed: &'static str, imagined: &'static str) -> &'static str {
        match self {
            Self::Observed => observed,
            Self::Imagined => imagined,
        }
    }
}

/// Maps of a frame that masks are led to, `[B, 1, H, W]` in [0, 1].
struct Maps<'a> {
    gamma: Option<&'a Tensor>,
    motion: &'a Tensor,
    foreground: &'a Tensor,
}

/// Leads the agent's mask and the objects' alpha. They share the foreground: each is led to what the other
/// leaves, and does not push the other.
fn add_regression(
    terms: &mut Terms,
    recipe: &RegressionRecipe,
    maps: &Maps<'_>,
    agent: Option<&Tensor>,
    alpha: Option<&Tensor>,
    step: u64,
) {
    let rest = |other: Option<&Tensor>| match other {
        Some(mask) => maps.foreground * (1.0 - mask.detach()),
        None => maps.foreground.shallow_clone(),
    };
    if let Some(agent) = agent.filter(|agent| agent.requires_grad()) {
        let mut lead = |name, map: &Tensor, weight: &Ramp| {
            terms.add(name, loss::keypoint_regression(map, agent), weight.at(step));
        };
        if let Some(gamma) = maps.gamma {
            lead("to_keypoints", gamma, &recipe.keypoints);
        }
        lead("to_motion", maps.motion, &recipe.motion);
        lead("to_foreground", &rest(alpha), &recipe.foreground);
    }
    if let Some(alpha) = alpha {
        let to_objects = loss::keypoint_regression(&rest(agent), alpha);
        terms.add("to_objects", to_objects, recipe.objects.at(step));
    }
}

fn add_mixture(
    terms: &mut Terms,
    recipe: &MixtureRecipe,
    mixture: &MixtureStep,
    frame: &Tensor,
    step: u64,
    phase: Phase,
) {
    let weight = recipe.likelihood.at(step);
    if weight > 0.0 {
        let (masks, components) = (&mixture.log_masks, &mixture.components);
        let likelihood = loss::mixture_log_likelihood(frame, masks, components, recipe.sigma);
        terms.add(phase.name("nll_mixture", "nll_mixture_imagined"), -likelihood, weight);
    }
}

fn add_mixture_kl(
    terms: &mut Terms,
    recipe: &MixtureRecipe,
    mixture: &MixtureStep,
    first: &Tensor,
    step: u64,
) {
    let (mask, comp) = loss::mixture_kl(mixture);
    let kl = recipe.kl.at(step);
    terms.add("kl_mask", mask, kl);
    terms.add("kl_comp", comp, kl);
    terms.add("residual", loss::residual_norm(mixture, first), recipe.residual);
}

fn add_composite(
    terms: &mut Terms,
    recipe: &ObjectRecipe,
    rendering: &Rendering,
    mixture: &MixtureStep,
    frame: &Tensor,
    step: u64,
    phase: Phase,
) {
    let window = recipe.fixed_alpha.filter(|window| step < window.end);
    let weight = recipe.composite.at(step);
    if weight > 0.0 {
        let image = match window {
            Some(window) => {
                loss::fixed_alpha_image(&rendering.foreground, &mixture.mu_mix, window.value)
            }
            None => rendering.over(&mixture.mu_mix),
        };
        let likelihood = loss::gaussian_log_likelihood(frame, &image, recipe.sigma);
        terms.add(phase.name("nll", "nll_imagined"), -likelihood, weight);
    }
    let weight = recipe.joint.at(step);
    if weight > 0.0 {
        let alpha = match window {
            Some(window) => rendering.alpha.full_like(window.value),
            None => rendering.alpha.shallow_clone(),
        };
        let likelihood = loss::joint_log_likelihood(
            frame,
            &rendering.colour(),
            &alpha,
            &mixture.log_masks,
            &mixture.components,
            recipe.sigma,
        );
        terms.add(phase.name("nll_joint", "nll_joint_imagined"), -likelihood, weight);
    }
    let alpha = rendering.alpha.mean_dim([1i64, 2, 3].as_slice(), false, Kind::Float);
    terms.add("alpha", alpha, 0.0);
}

/// How near discovery must find an object to draw it, in pixels: as far as one is pushed in a frame.
const FOLLOWING_REACH: f64 = 9.0;

/// Distance from which on places that are missed count linearly, in pixels: less than half a push.
pub(crate) const LENIENT: f64 = 3.0;

/// Largest standard deviation of how far boxes are moved off their objects to be caught again, in pixels. It is drawn for
/// each, so that most lie near and some as far as the fastest pushes.
const JOLT: f64 = 8.0;

/// Pixels in half a side of the image, the unit of places.
pub(crate) fn pixels(model: &Gatsbi) -> f64 {
    model.config().image_size as f64 / 2.0
}

/// Leads objects to what discovery `found`, imagined ones to how and where they are `believed` to be when the frames are
/// seen, and what is drawn of objects to the centres of their boxes.
fn add_places(
    terms: &mut Terms,
    model: &Gatsbi,
    recipe: &ObjectRecipe,
    (known, believed): (&ObjectState, Option<&ObjectState>),
    found: Option<&Placed>,
    step: u64,
) {
    let centring = recipe.centring.at(step);
    if centring == 0.0 && found.is_none() && believed.is_none() {
        return;
    }
    let pixels = pixels(model);
    let objects = model.objects().placed(&known.z);
    let squared = pixels.powi(2);
    terms.add("centring", loss::centring(&objects) * squared, centring);
    if let Some(found) = found {
        add_following(terms, "following", (&objects, found), recipe.following.at(step), pixels);
    }
    if let Some(believed) = believed {
        let seen = model.objects().placed(&believed.z);
        let (imagined, seen) = ((&objects, &known.ids), (&seen, &believed.ids));
        let distance = loss::foresight(imagined, seen, LENIENT / pixels) * squared;
        terms.add("foresight", distance, recipe.foresight.at(step));
        terms.add("lasting", loss::lasting(imagined, seen), recipe.lasting.at(step));
    }
}

/// Leads objects to what was found near them.
fn add_following(
    terms: &mut Terms,
    name: &'static str,
    (objects, found): (&Placed, &Placed),
    weight: f64,
    pixels: f64,
) {
    let (reach, scale) = (FOLLOWING_REACH / pixels, LENIENT / pixels);
    terms.add(name, loss::following(objects, found, reach, scale) * pixels.powi(2), weight);
}

/// How far boxes are moved off their objects before frame `t`, `[B, N, 2]`.
fn jolts(state: &GatsbiState, moment: Moment, t: usize, pixels: f64) -> Tensor {
    let size = state.objects.z.size();
    // From a stream of their own, as keypoints are.
    let moment = Moment { seed: moment.seed.rotate_left(32) ^ 0x6a6f_6c74, ..moment };
    let noise = noise(moment, t, size[0], state.objects.z.device());
    let spread = noise.uniform(Site::Presence, &[size[0], size[1], 1]).square() * (JOLT / pixels);
    noise.normal(Site::Where, &[size[0], size[1], 2]) * spread
}

fn add_objects_kl(
    terms: &mut Terms,
    model: &Gatsbi,
    recipe: &ObjectRecipe,
    found: &ObjectStep,
    step: u64,
) {
    let config = &model.config().objects;
    let mut prior = config.prior.clone();
    prior.scale_mean = recipe.scale_mean.at(step);
    let kl = found.kl(&prior, config.aux_presence_kl);
    let weight = recipe.kl.at(step);
    terms.add("kl_pres", kl.pres, weight);
    terms.add("kl_where", kl.place, weight);
    terms.add("kl_depth", kl.depth, weight);
    terms.add("kl_what", kl.what, weight);
    terms.add("kl_dyna", kl.dyna, weight);
}

/// Whether discovery is dropped at frame `t`, for the whole batch.
fn dropped(moment: Moment, t: usize, probability: f64) -> bool {
    let key = [moment.seed as u32, (moment.seed >> 32) as u32];
    let step = moment.step;
    let counter = [t as u32, 0x6472_6f70, step as u32, (step >> 32) as u32];
    f64::from(philox4x32_10(counter, key)[0]) < probability * f64::from(u32::MAX)
}
