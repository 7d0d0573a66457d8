//! A recipe: everything that decides a training run but the data, as one TOML file.
//!
//! Those of the paper's data sets and of `tiny` are in `training/recipes` and known by their names.

use std::path::Path;

use anyhow::{Context as _, ensure};
use gatsbi_models::gatsbi::keypoint::KeypointLearningConfig;
use serde::{Deserialize, Serialize};

use crate::{dynamics::HORIZON, variant::Variant};

/// Recipes that are known by name.
const NAMED: [(&str, &str); 22] = [
    ("roll", include_str!("../recipes/roll.toml")),
    ("push1", include_str!("../recipes/push1.toml")),
    ("push2", include_str!("../recipes/push2.toml")),
    ("bair", include_str!("../recipes/bair.toml")),
    ("balls", include_str!("../recipes/balls.toml")),
    ("tiny", include_str!("../recipes/tiny.toml")),
    ("tiny-refine", include_str!("../recipes/tiny-refine.toml")),
    ("tiny-objects", include_str!("../recipes/tiny-objects.toml")),
    ("tiny-finish", include_str!("../recipes/tiny-finish.toml")),
    ("tiny-long", include_str!("../recipes/tiny-long.toml")),
    ("tiny-catching", include_str!("../recipes/tiny-catching.toml")),
    ("tiny-sight", include_str!("../recipes/tiny-sight.toml")),
    ("tiny-following", include_str!("../recipes/tiny-following.toml")),
    ("tiny-dynamics", include_str!("../recipes/tiny-dynamics.toml")),
    ("tiny-foresight", include_str!("../recipes/tiny-foresight.toml")),
    ("push1-tiny", include_str!("../recipes/push1-tiny.toml")),
    ("roll-tiny", include_str!("../recipes/roll-tiny.toml")),
    ("roll-tiny-following", include_str!("../recipes/roll-tiny-following.toml")),
    ("roll-tiny-dynamics", include_str!("../recipes/roll-tiny-dynamics.toml")),
    ("balls-tiny", include_str!("../recipes/balls-tiny.toml")),
    ("balls-tiny-following", include_str!("../recipes/balls-tiny-following.toml")),
    ("balls-tiny-dynamics", include_str!("../recipes/balls-tiny-dynamics.toml")),
];

/// Parts of the names of parameters that objects are imagined with; the surroundings (the last three) are also there for
/// following.
const IMAGINING: [&str; 9] = [
    "latent_prior_prop",
    "self_prior",
    "relational_prior",
    "weights_prior",
    "rnn_prior",
    "init_prior",
    "bg_attention_encoder",
    "objects.ambient",
    "objects.agent",
];

/// How a model is trained.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Name of the resulting checkpoint.
    pub name: String,
    /// Architecture preset.
    pub model: String,
    /// What is different about that architecture, for ablations.
    #[serde(default)]
    pub variant: Variant,
    /// Optimiser steps.
    pub steps: u64,
    /// Sequences per step.
    pub batch: i64,
    /// Frames per sequence, from the given step on.
    pub length: Staircase,
    /// Frames at the end of a sequence that are imagined instead of observed, from the given step on. KL terms teach
    /// priors one step ahead; this teaches what they become when they follow each other.
    #[serde(default)]
    pub imagined: Staircase,
    /// Learning rate, from the given step on.
    pub learning_rate: Staircase,
    /// Largest global norm of a gradient.
    pub clip: f64,
    /// Background fit before the first step.
    pub prefit: Option<Prefit>,
    /// Mixture module.
    pub mixture: MixtureRecipe,
    /// Object module; none are trained without it.
    pub objects: Option<ObjectRecipe>,
    /// What tells which pixels are the agent's.
    pub regression: RegressionRecipe,
    /// Keypoint module; none is trained without it.
    pub keypoints: Option<KeypointRecipe>,
    /// First steps in which nothing but what is imagined of objects learns.
    pub dynamics: Option<DynamicsRecipe>,
    /// Steps between pictures.
    pub picture_every: u64,
    /// Steps between checkpoints.
    pub save_every: u64,
}

impl Recipe {
    /// The recipe of that name, or in that file.
    ///
    /// # Errors
    /// If there is none, or it cannot be used.
    pub fn load(name_or_file: &str) -> anyhow::Result<Self> {
        if let Some((name, text)) = NAMED.iter().find(|(name, _)| *name == name_or_file) {
            return Self::parse(text).with_context(|| format!("recipe {name}"));
        }
        let names = NAMED.map(|(name, _)| name).join(", ");
        let text = fs_err::read_to_string(Path::new(name_or_file))
            .with_context(|| format!("a recipe is a file or one of {names}"))?;
        Self::parse(&text).with_context(|| format!("recipe {name_or_file}"))
    }

    fn parse(text: &str) -> anyhow::Result<Self> {
        let recipe: Self = toml::from_str(text)?;
        ensure!(recipe.steps > 0, "steps is 0, expected at least 1");
        ensure!(recipe.batch > 0, "batch is {}, expected at least 1", recipe.batch);
        let everywhere = [("length", &recipe.length), ("learning_rate", &recipe.learning_rate)];
        for (field, staircase) in everywhere.into_iter().chain([("imagined", &recipe.imagined)]) {
            ensure!(
                staircase.0.is_sorted_by(|(a, _), (b, _)| a < b),
                "the steps of {field} do not increase"
            );
        }
        for (field, staircase) in everywhere {
            ensure!(
                staircase.0.first().is_some_and(|(step, _)| *step == 0),
                "{field} does not begin with step 0"
            );
            ensure!(
                staircase.0.iter().all(|(_, value)| *value > 0.0),
                "{field} has a value that is not positive"
            );
        }
        for (step, _) in recipe.imagined.0.iter().chain(&recipe.length.0) {
            let [imagined, length] = [&recipe.imagined, &recipe.length].map(|of| of.at(*step));
            ensure!(
                imagined < length,
                "{imagined} of {length} frames are imagined from step {step} on, expected one \
                 observed at least"
            );
        }
        for (step, length) in recipe.dynamics.iter().flat_map(|dynamics| &dynamics.length.0) {
            ensure!(
                (1.0..=HORIZON as f64).contains(length),
                "dynamics.length is {length} from step {step} on, expected 1 to {HORIZON}"
            );
        }
        Ok(recipe)
    }

    /// The longest sequences.
    pub fn longest(&self) -> u64 {
        self.length.0.iter().map(|(_, length)| *length as u64).max().unwrap_or(0)
    }

    /// Whether nothing but the objects learns at `step`.
    pub fn objects_alone(&self, step: u64) -> bool {
        self.objects
            .as_ref()
            .is_some_and(|objects| (objects.start..objects.alone_until).contains(&step))
    }

    /// How dynamics are learned at `step`, if nothing else is.
    pub fn dynamics_alone(&self, step: u64) -> Option<&DynamicsRecipe> {
        self.dynamics.as_ref().filter(|dynamics| step < dynamics.until)
    }

    /// Learning rate of the parameter called `name` at `step`; 0 if it rests.
    pub fn rate_of(&self, name: &str, step: u64) -> f64 {
        let rate = self.learning_rate.at(step);
        match &self.objects {
            _ if self.dynamics_alone(step).is_some() => {
                let imagines = IMAGINING.iter().any(|part| name.contains(part));
                if imagines { rate } else { 0.0 }
            }
            Some(objects) if name.starts_with("objects.") => rate * objects.rate.at(step),
            _ if self.objects_alone(step) => 0.0,
            _ => rate,
        }
    }
}

/// Terms of the keypoint module (mixture spec 4).
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct KeypointRecipe {
    /// First step without keypoint losses.
    pub end: u64,
    /// Weight of the separation of trajectories.
    pub separation: f64,
    /// Weight of the sparsity of heatmaps.
    pub sparsity: f64,
    /// Weight of the dynamics' KL.
    pub kl: Ramp,
    /// Sizes of the networks.
    pub networks: KeypointLearningConfig,
}

/// The objects' dynamics, learned from what the model remembers of its data ([`crate::dynamics`]).
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct DynamicsRecipe {
    /// First step without.
    pub until: u64,
    /// Sequences per step.
    pub batch: i64,
    /// Frames that each foresees, from the given step on; [`crate::dynamics::HORIZON`] at most.
    pub length: Staircase,
    /// Weight, in nats a squared pixel, of the distance between boxes that are imagined and the remembered ones.
    pub place: Ramp,
    /// Weight, in nats, of the squared distance between their appearances.
    pub what: Ramp,
    /// Weight of the KL of the dynamics latents.
    pub kl: Ramp,
}

/// The last slot's component is fitted to the data's background through its own posterior.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Prefit {
    /// Optimiser steps.
    pub steps: u64,
    /// Learning rate.
    pub learning_rate: f64,
}

/// Terms of the mixture module.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct MixtureRecipe {
    /// First step with the mixture.
    pub start: u64,
    /// Standard deviation of the log-sum-exp likelihood.
    pub sigma: f64,
    /// Weight of that likelihood.
    pub likelihood: Ramp,
    /// Weight of the KLs.
    pub kl: Ramp,
    /// Weight of the residual norms.
    pub residual: f64,
    /// Factor on the noise of the latents. Starting from 0 lets the latents say something before noise drowns
    /// it.
    pub noise: Ramp,
}

/// Terms of the object module.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectRecipe {
    /// First step with objects.
    pub start: u64,
    /// Up to this step nothing but the objects learns.
    pub alone_until: u64,
    /// Factor on the learning rate of the object module.
    pub rate: Ramp,
    /// Bounds of a box's side as a fraction of the image. Without them a few faint boxes grow over the whole
    /// image and correct the background's colours, instead of being objects.
    pub scale_bounds: Option<(f64, f64)>,
    /// Overlap above which two boxes are one object ([`gatsbi_models::config::Tracking::merge`]).
    pub merge: Option<f64>,
    /// Difference of colours above which they are two ([`gatsbi_models::config::Tracking::unlike`]).
    pub unlike: Option<f64>,
    /// How far served objects keep their identities when they are found anew
    /// ([`gatsbi_models::config::Tracking::handover`]).
    pub handover: Option<f64>,
    /// Standard deviation of both likelihoods below.
    pub sigma: f64,
    /// Weight of the Gaussian likelihood of the composite image.
    pub composite: Ramp,
    /// Weight of the likelihood in which objects and slots compete for pixels.
    pub joint: Ramp,
    /// Weight of the KLs.
    pub kl: Ramp,
    /// Constant alpha of the composite and the step it ends.
    pub fixed_alpha: Option<FixedAlpha>,
    /// Probability of discovering nothing at a frame after the first. While it is small, an object that moves is let go
    /// and found anew, and nothing learns to follow it.
    pub discovery_dropout: Ramp,
    /// Weight, in nats a squared pixel, of the distance between an object that was followed or imagined and what
    /// discovery finds near it in the frame. Discovery learns positions in a tenth of the time that following needs to
    /// learn them from the likelihood.
    #[serde(default)]
    pub following: Ramp,
    /// Weight of the same distance of objects that were followed from boxes that lay beside them: what lags behind in one
    /// frame is to be caught in the next. Pushes alone are too rare to teach that.
    #[serde(default)]
    pub catching: Ramp,
    /// Weight, in nats a squared pixel, of the distance between an object that is imagined and where it is followed to when
    /// the frames are seen. It reaches as far as objects are pushed; what is found near where one is imagined does not.
    #[serde(default)]
    pub foresight: Ramp,
    /// Weight, in nats, of the squared difference between what is drawn of an object that is imagined and when the frames
    /// are seen, mean over pixels.
    #[serde(default)]
    pub lasting: Ramp,
    /// Weight, in nats a squared pixel, of the distance between what is drawn of an object and the centre of its box:
    /// nothing else holds a box to its object once following leads what is drawn.
    #[serde(default)]
    pub centring: Ramp,
    /// Mean of the raw scale in the discovery prior.
    pub scale_mean: Ramp,
}

impl ObjectRecipe {
    /// Whether anything is led to what discovery finds at `step`.
    pub(crate) fn leads_to_found(&self, step: u64) -> bool {
        [&self.following, &self.catching].into_iter().any(|weight| weight.at(step) > 0.0)
    }
}

/// The fixed-alpha window.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct FixedAlpha {
    /// The constant.
    pub value: f64,
    /// First step without it.
    pub end: u64,
}

/// Onto which maps masks are regressed, and with which weights of the squared difference.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RegressionRecipe {
    /// The agent's mask onto the keypoint map (the paper's).
    pub keypoints: Ramp,
    /// The agent's mask onto the motion map: what differs from the data's background and from the episode's median. It
    /// leads where keypoints learn too slowly; it contains moving objects too.
    pub motion: Ramp,
    /// The agent's mask onto the foreground map, what differs from the data's background, without the objects' alpha.
    /// It knows the agent better than motion does as soon as objects are known.
    pub foreground: Ramp,
    /// The objects' alpha onto the foreground map without the agent's mask. It leads the boxes to objects before
    /// glimpses can be drawn well enough to be worth their place.
    pub objects: Ramp,
}

/// A number that is linear between given steps and constant outside.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Ramp {
    /// The same at every step.
    Constant(f64),
    /// `[step, value]` pairs by increasing step.
    Points(Vec<(u64, f64)>),
}

impl Default for Ramp {
    fn default() -> Self {
        Self::Constant(0.0)
    }
}

impl Ramp {
    /// The value at `step`.
    pub fn at(&self, step: u64) -> f64 {
        match self {
            Self::Constant(value) => *value,
            Self::Points(points) => {
                let after = points.partition_point(|(at, _)| *at <= step);
                match (after.checked_sub(1).map(|i| points[i]), points.get(after)) {
                    (Some((from, low)), Some(&(to, high))) => {
                        low + (high - low) * (step - from) as f64 / (to - from) as f64
                    }
                    (Some((_, value)), None) | (None, Some(&(_, value))) => value,
                    (None, None) => 0.0,
                }
            }
        }
    }
}

/// A number that changes at given steps: `[step, value]` pairs by increasing step.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
pub struct Staircase(Vec<(u64, f64)>);

impl Staircase {
    /// The value at `step`; 0 before the first one.
    pub fn at(&self, step: u64) -> f64 {
        let after = self.0.partition_point(|(at, _)| *at <= step);
        after.checked_sub(1).map_or(0.0, |last| self.0[last].1)
    }
}

#[cfg(test)]
mod tests {
    use gatsbi_models::config::presets;

    use super::*;

    #[test]
    fn the_named_recipes_can_be_used() {
        for (name, _) in NAMED {
            let recipe = Recipe::load(name).unwrap();
            assert!(presets::preset(&recipe.model).is_some(), "{name}");
        }
    }

    #[test]
    fn numbers_follow_their_steps() {
        let ramp = Ramp::Points(vec![(10, 1.0), (20, 2.0)]);
        for (step, value) in [(0, 1.0), (10, 1.0), (15, 1.5), (20, 2.0), (99, 2.0)] {
            assert!((ramp.at(step) - value).abs() < 1e-12, "{step}");
        }
        let stairs = Staircase(vec![(0, 5.0), (20, 7.0)]);
        for (step, value) in [(0, 5.0), (19, 5.0), (20, 7.0)] {
            assert!((stairs.at(step) - value).abs() < 1e-12, "{step}");
        }
    }

    #[test]
    fn a_recipe_that_cannot_be_used_is_refused() {
        let tiny = NAMED[5].1;
        let wrong = [
            (tiny.replace("batch = ", "batch = 0 # "), "batch is 0"),
            (
                tiny.replace("length = ", "length = [[5, 4]] # "),
                "length does not begin with step 0",
            ),
            (tiny.replace("clip = ", "clap = "), "unknown field `clap`"),
            (
                tiny.replace("imagined = ", "imagined = [[0, 3]] # "),
                "3 of 3 frames are imagined from step 0 on",
            ),
            (
                format!(
                    "{tiny}\n[dynamics]\nuntil = 5\nbatch = 2\nlength = [[0, 4], [3, 16]]\n\
                     place = 1.0\nwhat = 1.0\nkl = 1.0\n"
                ),
                "dynamics.length is 16 from step 3 on, expected 1 to 15",
            ),
        ];
        for (text, expected) in wrong {
            let error = format!("{:#}", Recipe::parse(&text).unwrap_err());
            assert!(error.contains(expected), "{error}");
        }
        let error = format!("{:#}", Recipe::load("no-such-recipe").unwrap_err());
        let names =
            "tiny-long, tiny-catching, tiny-sight, tiny-following, tiny-dynamics, tiny-foresight";
        assert!(error.contains(names), "{error}");
    }
}
