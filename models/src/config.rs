//! Every size and switch of a GATSBI model, as data that travels in the checkpoint.
//!
//! Two configurations that differ in any field of [`GatsbiConfig`] are different models. [`presets`] holds the
//! sizes of the paper and the small one that a CPU can serve.

pub mod presets;
mod tracking;

use serde::{Deserialize, Serialize};

pub use self::tracking::{DiscoveryPolicy, IdRule, PresenceRule, Tracking};
pub use crate::nn::InitScheme;

/// A whole GATSBI model.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct GatsbiConfig {
    /// Height and width of a frame in pixels.
    pub image_size: i64,
    /// Action enhancement.
    pub action: ActionConfig,
    /// Mixture module: agent and background.
    pub mixture: MixtureConfig,
    /// Keypoint detector; absent in a model that serves without one.
    pub detector: Option<DetectorConfig>,
    /// Object module with the interactions.
    pub objects: ObjectConfig,
    /// How objects are tracked outside training.
    pub tracking: Tracking,
}

/// Action enhancement, `a_t` to the 32 numbers that condition the networks (mixture spec 2.1).
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ActionConfig {
    /// Dimension A of a raw action; 0 for scenes without an agent.
    pub dim: i64,
    /// Width of the two hidden layers.
    pub hidden: i64,
    /// Width of the enhanced action.
    pub enhanced: i64,
}

/// Sizes and rules of the mixture module (mixture spec 2).
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct MixtureConfig {
    /// Number K of slots.
    pub slots: i64,
    /// Width of a mask latent.
    pub z_mask: i64,
    /// Width of a component latent.
    pub z_comp: i64,
    /// Width of every recurrent state.
    pub hidden: i64,
    /// Width of hidden MLP layers.
    pub mlp: i64,
    /// Width of the mask features between the MLPs and the latents.
    pub mask_features: i64,
    /// Scale Δ of the residual update of latents.
    pub delta: f64,
    /// Whether the prior of a component sees the enhanced action directly.
    pub comp_prior_action: bool,
    /// Whether posterior and prior remember by the same networks (the integrated RNN of the paper's supplement), instead of
    /// by ones of their own.
    #[serde(default)]
    pub one_memory: bool,
    /// Encoder of frames and of `mu_mix`.
    pub encoder: EncoderConfig,
    /// Mask decoder.
    pub mask_decoder: MaskDecoderConfig,
    /// Component encoder.
    pub comp_encoder: CompEncoderConfig,
    /// Component decoder.
    pub comp_decoder: CompDecoderConfig,
    /// Normalisation of the component networks.
    pub comp_norm: CompNorm,
    /// How the networks of this module start.
    pub init: InitScheme,
}

/// Encoder of frames: strided convolutions, each with CELU and group norm, and a linear layer.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct EncoderConfig {
    /// Channels of the convolutions; each halves the image.
    pub channels: Vec<i64>,
    /// Groups of the group norm after each convolution.
    pub groups: Vec<i64>,
    /// Kernel of the first convolution; the others are 3x3.
    pub first_kernel: i64,
    /// Width of the encoding.
    pub features: i64,
}

/// Mask decoder: sub-pixel stages from 1x1 up, each with a 3x3 convolution behind it.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct MaskDecoderConfig {
    /// Width of the conditioned latent that is decoded.
    pub inputs: i64,
    /// Channels of the first 1x1 convolution.
    pub base: i64,
    /// Groups of its group norm.
    pub base_groups: i64,
    /// The enlarging stages. The product of their factors is the resolution of the logits, which are enlarged
    /// bilinearly to the frame where it is smaller.
    pub stages: Vec<SubPixelStage>,
}

/// One enlarging stage of a decoder.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct SubPixelStage {
    /// Enlargement.
    pub factor: i64,
    /// Channels after the stage.
    pub channels: i64,
    /// Groups of its group norms.
    pub groups: i64,
}

/// Component encoder: strided 3x3 convolutions with ELU and a linear layer.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CompEncoderConfig {
    /// Channels of the convolutions; each halves the image.
    pub channels: Vec<i64>,
    /// Width of the encoding.
    pub features: i64,
}

/// Component decoder.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields, rename_all = "snake_case", tag = "kind")]
pub enum CompDecoderConfig {
    /// Spatial broadcast onto an enlarged grid with coordinates, then unpadded convolutions (as printed).
    Broadcast {
        /// Width of the conditioned latent that is broadcast.
        inputs: i64,
        /// Channels of the three hidden convolutions.
        width: i64,
        /// Kernel of the last convolution, 3 as printed or 1 as in SPACE.
        final_kernel: i64,
    },
    /// A linear layer to a small image and sub-pixel stages up; learns a static background a hundred times
    /// sooner than a narrow broadcast decoder.
    SubPixel {
        /// Width of the conditioned latent that is decoded.
        inputs: i64,
        /// Side of the image that the linear layer makes.
        base_side: i64,
        /// Channels of that image.
        base: i64,
        /// The enlarging stages; the image is enlarged bilinearly to the frame where they end smaller.
        stages: Vec<SubPixelStage>,
    },
}

impl CompDecoderConfig {
    /// Width of the latent that is decoded.
    pub fn inputs(&self) -> i64 {
        match self {
            Self::Broadcast { inputs, .. } | Self::SubPixel { inputs, .. } => *inputs,
        }
    }
}

/// Normalisation of the component networks (decisions row 12).
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum CompNorm {
    /// Batch norm, as printed.
    Batch,
    /// Group norm with eight channels a group.
    Group,
}

/// Keypoint detector (mixture spec 2.6).
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct DetectorConfig {
    /// Number N of keypoints.
    pub keypoints: i64,
    /// Channels of the first scale; doubled at each of the two halvings.
    pub filters: i64,
    /// Extra convolutions per scale.
    pub convs_per_scale: i64,
    /// Form of the map from summed keypoint maps to gamma.
    pub gamma: GammaForm,
}

/// Form of the keypoint map (decisions row 11).
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields, rename_all = "snake_case", tag = "kind")]
pub enum GammaForm {
    /// `sigmoid(steepness (S - 1/2))` of the summed maps S.
    Centred {
        /// κ.
        steepness: f64,
    },
    /// `sigmoid(S)` as printed, which is at least 1/2 everywhere.
    Printed,
}

/// Sizes and rules of the object module (object spec 1 to 3 and 6).
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectConfig {
    /// Side G of the discovery grid.
    pub grid: i64,
    /// Slots kept after every step.
    pub max_objects: i64,
    /// Width of an appearance latent.
    pub z_what: i64,
    /// Width of a dynamics latent.
    pub z_dyna: i64,
    /// Width of encodings, hidden layers and recurrent states.
    pub hidden: i64,
    /// Side of a glimpse in pixels.
    pub glimpse: i64,
    /// Image encoder of discovery.
    pub image_encoder: ImageEncoderConfig,
    /// Encoder of object and environment glimpses.
    pub glimpse_encoder: GlimpseCodecConfig,
    /// Decoder of glimpses.
    pub glimpse_decoder: GlimpseCodecConfig,
    /// Bounds of what one step may change.
    pub updates: UpdateConfig,
    /// Constants of discovery's prior.
    pub prior: DiscoveryPrior,
    /// Intersection over union above which a discovered object is rejected; `None` turns rejection off.
    pub rejection: Option<f64>,
    /// Whether presence of propagated objects pays an auxiliary KL.
    pub aux_presence_kl: bool,
    /// Which objects see each other.
    pub graph: Graph,
    /// How environment and agent act on an object.
    pub interaction: Interaction,
    /// Which state of the agent the objects see.
    pub agent_history: AgentHistory,
    /// Which step's agent and environment an object's motion depends on.
    #[serde(default)]
    pub agent_feature: AgentFeature,
}

/// Residual image encoder.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ImageEncoderConfig {
    /// Channels of the stages; every stage after the first halves the image.
    pub channels: Vec<i64>,
    /// Basic blocks per stage.
    pub blocks: i64,
}

/// Stages of the glimpse encoder (halving) or decoder (doubling).
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct GlimpseCodecConfig {
    /// Channels after each stage with a group norm.
    pub channels: Vec<i64>,
    /// Groups of those group norms.
    pub groups: Vec<i64>,
}

/// Bounds of a step's change of an object (object spec 3.3).
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct UpdateConfig {
    /// Least and most that the proposal window is larger than the object, as fractions of the image.
    pub proposal: (f64, f64),
    /// Most that a centre moves, in [-1, 1] coordinates.
    pub shift: f64,
    /// Most that a size changes, as a fraction of the image.
    pub scale: f64,
    /// Most that an appearance value changes.
    pub what: f64,
    /// Factor on a depth offset.
    pub depth: f64,
    /// How much larger than the object the environment crop is, as a fraction of the image.
    pub environment: f64,
    /// Width of the propagation map's kernel, in [-1, 1] coordinates.
    pub map_sigma: f64,
}

/// Constants of discovery's prior (object spec 1.2).
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct DiscoveryPrior {
    /// Probability that a cell holds an object.
    pub presence: f64,
    /// Mean of the raw (before the sigmoid) scale.
    pub scale_mean: f64,
    /// Standard deviation of the raw scale.
    pub scale_std: f64,
    /// Mean of the raw (before the tanh) shift.
    pub shift_mean: f64,
    /// Standard deviation of the raw shift.
    pub shift_std: f64,
}

/// The interaction graph between objects (object spec 6.3).
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields, rename_all = "snake_case", tag = "kind")]
pub enum Graph {
    /// Every object sees every other, as in G-SWM.
    FullyConnected,
    /// Every object sees its k nearest neighbours.
    Knn {
        /// Neighbours per object; at most the number of other slots is used.
        k: i64,
        /// What is near.
        metric: KnnMetric,
        /// How the neighbours' effects add up.
        aggregate: KnnAggregate,
    },
}

/// What "nearest" means.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum KnnMetric {
    /// Smallest distance of centres; absent objects come last, ties go to the lower index.
    Distance,
    /// Largest attention weight (the printed formula, literally).
    Weight,
}

/// How the effects of neighbours add up.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum KnnAggregate {
    /// Attention over the neighbours times their presence, renormalised.
    Attention,
    /// Plain sum weighted by presence (the printed formula, literally).
    Sum,
}

/// How environment and agent act on an object (object spec 6.2 and 6.5).
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields, rename_all = "snake_case", tag = "kind")]
pub enum Interaction {
    /// The environment crop alone, as in G-SWM.
    Inter1,
    /// Environment crop and a local agent feature per object.
    Inter2 {
        /// Width of the merged vector.
        outputs: i64,
        /// CELU on the merged vector.
        celu: bool,
    },
    /// Environment crop and one global agent feature (the paper's choice).
    Inter3 {
        /// Width of the merged vector.
        outputs: i64,
        /// CELU on the merged vector.
        celu: bool,
    },
}

/// Which mask history of the agent slot the objects see (decisions row 1).
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum AgentHistory {
    /// The prior state after it absorbed the step's latent and `mu_mix`.
    After,
    /// The prior state before that.
    Before,
}

/// Which step's agent and environment move an object to where it is at step t (decisions row 13).
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum AgentFeature {
    /// Those of t - 1: an object remembers a step as soon as it is over (the original), and is pushed a step late.
    #[default]
    Current,
    /// Those of t, which step before the objects: an object remembers a step when the next one begins, beside its agent.
    Next,
}

impl GatsbiConfig {
    /// What is impossible about this configuration, in words; empty if it can be built.
    pub fn problems(&self) -> Vec<String> {
        let mut problems = Vec::new();
        let mut check = |holds: bool, problem: &str| {
            if !holds {
                problems.push(problem.to_owned());
            }
        };
        let Self { image_size, action, mixture, detector, objects, tracking } = self;
        let image = *image_size;
        let sane = |sizes: &[i64]| sizes.iter().all(|size| (1..=8192).contains(size));
        let divides = |channels: &[i64], groups: &[i64]| {
            channels.len() == groups.len()
                && sane(channels)
                && sane(groups)
                && channels.iter().zip(groups).all(|(channels, groups)| channels % groups == 0)
        };
        let halves = |stages: usize| stages < 12 && image % (1 << stages) == 0;
        check((8..=512).contains(&image), "image_size must lie in 8..=512");
        check((0..=1024).contains(&action.dim), "action.dim must lie in 0..=1024");
        check(sane(&[action.hidden, action.enhanced]), "action widths must lie in 1..=8192");
        check((2..=32).contains(&mixture.slots), "mixture.slots must lie in 2..=32");
        let widths =
            [mixture.z_mask, mixture.z_comp, mixture.hidden, mixture.mlp, mixture.mask_features];
        check(sane(&widths), "mixture widths must lie in 1..=8192");
        check(mixture.delta.is_finite(), "mixture.delta must be finite");
        let encoder = &mixture.encoder;
        check(
            divides(&encoder.channels, &encoder.groups)
                && sane(&[encoder.features])
                && encoder.first_kernel % 2 == 1
                && sane(&[encoder.first_kernel])
                && halves(encoder.channels.len()),
            "mixture.encoder: groups must divide channels one by one, stages must halve image_size",
        );
        let staged = |base: i64, stages: &[SubPixelStage]| {
            let fits = stages.iter().all(|stage| {
                sane(&[stage.factor, stage.channels, stage.groups])
                    && stage.channels % stage.groups == 0
            });
            let side = stages
                .iter()
                .try_fold(base, |side, stage| side.checked_mul(stage.factor))
                .unwrap_or(i64::MAX);
            fits && !stages.is_empty() && side <= image
        };
        let decoder = &mixture.mask_decoder;
        check(
            sane(&[decoder.inputs, decoder.base, decoder.base_groups])
                && decoder.base % decoder.base_groups == 0
                && staged(1, &decoder.stages),
            "mixture.mask_decoder: groups must divide channels, factors must not exceed image_size",
        );
        let comp_encoder = &mixture.comp_encoder;
        check(
            sane(&comp_encoder.channels)
                && sane(&[comp_encoder.features])
                && halves(comp_encoder.channels.len()),
            "mixture.comp_encoder: stages must halve image_size",
        );
        check(
            match &mixture.comp_decoder {
                CompDecoderConfig::Broadcast { inputs, width, final_kernel } => {
                    sane(&[*inputs, *width]) && [1, 3].contains(final_kernel)
                }
                CompDecoderConfig::SubPixel { inputs, base_side, base, stages } => {
                    sane(&[*inputs, *base_side, *base]) && staged(*base_side, stages)
                }
            },
            "mixture.comp_decoder: sizes must fit image_size, final_kernel is 1 or 3",
        );
        if let Some(detector) = detector {
            check(
                sane(&[detector.keypoints, detector.filters])
                    && detector.filters <= 512
                    && (0..=8).contains(&detector.convs_per_scale)
                    && image % 4 == 0,
                "detector: sizes must be positive and image_size a multiple of 4",
            );
        }
        check(
            sane(&[objects.z_what, objects.z_dyna, objects.hidden, objects.glimpse])
                && objects.hidden % 8 == 0,
            "object widths must lie in 1..=8192 and objects.hidden be a multiple of 8",
        );
        let cells = objects.grid.saturating_mul(objects.grid);
        check(
            sane(&[objects.grid, objects.max_objects]) && objects.max_objects <= cells,
            "objects.max_objects must not exceed the cells of the grid",
        );
        let stages = objects.image_encoder.channels.len();
        check(
            stages > 0
                && sane(&objects.image_encoder.channels)
                && (1..=16).contains(&objects.image_encoder.blocks)
                && halves(stages)
                && sane(&[objects.grid])
                && image % (objects.grid << stages) == 0
                && image >= objects.grid << stages,
            "objects.image_encoder: image_size must be a multiple of grid times 2^stages",
        );
        let (encoder, decoder) = (&objects.glimpse_encoder, &objects.glimpse_decoder);
        check(
            divides(&encoder.channels, &encoder.groups)
                && divides(&decoder.channels, &decoder.groups)
                && encoder.channels.len() < 12
                && objects.glimpse % (1 << encoder.channels.len()) == 0
                && (1..12).contains(&decoder.channels.len())
                && objects.glimpse == 2 << decoder.channels.len(),
            "glimpse codecs: groups must divide channels, stages must fit objects.glimpse",
        );
        if let Graph::Knn { k, .. } = objects.graph {
            check(sane(&[k]), "objects.graph.k must be positive");
        }
        match objects.interaction {
            Interaction::Inter1 => {}
            Interaction::Inter2 { outputs, .. } | Interaction::Inter3 { outputs, .. } => {
                check(sane(&[outputs]), "objects.interaction.outputs must be positive");
            }
        }
        let positive = |value: Option<f64>| value.is_none_or(|value| value > 0.0);
        check(
            positive(tracking.unlike)
                && positive(tracking.handover)
                && (tracking.handover.is_none() || tracking.unlike.is_some()),
            "tracking.unlike and tracking.handover must be positive, and handover needs unlike",
        );
        problems
    }
}

#[cfg(test)]
mod tests {
    use super::{presets, *};

    #[test]
    fn presets_are_possible_and_travel_as_json() {
        for name in presets::NAMES {
            let config = presets::preset(name).unwrap();
            assert_eq!(config.problems(), Vec::<String>::new(), "{name}");
            let json = serde_json::to_string(&config).unwrap();
            assert_eq!(serde_json::from_str::<GatsbiConfig>(&json).unwrap(), config);
        }
    }

    #[test]
    fn impossible_sizes_are_named() {
        let mut config = presets::tiny();
        config.objects.grid = 3;
        config.mixture.encoder.groups = vec![3, 4, 6];
        config.mixture.slots = 1;
        config.tracking.handover = Some(0.5);
        let problems = config.problems().join("; ");
        let words = ["mixture.slots", "mixture.encoder", "objects.image_encoder", "handover"];
        for word in words {
            assert!(problems.contains(word), "{problems}");
        }
    }
}
