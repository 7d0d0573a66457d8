//! Named sizes: the paper's data sets and `tiny`.

use super::{
    ActionConfig, AgentFeature, AgentHistory, CompDecoderConfig, CompEncoderConfig, CompNorm,
    DetectorConfig, DiscoveryPrior, EncoderConfig, GammaForm, GatsbiConfig, GlimpseCodecConfig,
    Graph, ImageEncoderConfig, InitScheme, Interaction, KnnAggregate, KnnMetric, MaskDecoderConfig,
    MixtureConfig, ObjectConfig, SubPixelStage, Tracking, UpdateConfig,
};

/// Names that [`preset`] knows.
pub const NAMES: [&str; 7] = ["roll", "push1", "push2", "bair", "balls", "tiny", "balls-tiny"];

/// The preset called `name`.
pub fn preset(name: &str) -> Option<GatsbiConfig> {
    match name {
        "roll" => Some(roll()),
        "push1" => Some(push1()),
        "push2" => Some(push2()),
        "bair" => Some(bair()),
        "balls" => Some(balls()),
        "tiny" => Some(tiny()),
        "balls-tiny" => Some(balls_tiny()),
        _ => None,
    }
}

/// Paper sizes for ROLL: Panda striking balls.
pub fn roll() -> GatsbiConfig {
    paper(PaperSizes { slots: 3, action: 7, delta: 2.0, grid: 4, max_objects: 7 })
}

/// Paper sizes for PUSH1: Panda pushing under joint velocities.
pub fn push1() -> GatsbiConfig {
    roll()
}

/// Paper sizes for PUSH2: Sawyer pushing under end-effector displacements.
pub fn push2() -> GatsbiConfig {
    paper(PaperSizes { slots: 3, action: 7, delta: 1.0, grid: 4, max_objects: 7 })
}

/// Paper sizes for BAIR: real Sawyer pushing.
pub fn bair() -> GatsbiConfig {
    let mut config =
        paper(PaperSizes { slots: 4, action: 3, delta: 2.0, grid: 8, max_objects: 12 });
    config.objects.graph = knn(5);
    config.objects.prior.scale_mean = -1.75;
    config
}

/// Paper sizes for BALLS: elastic balls without an agent.
pub fn balls() -> GatsbiConfig {
    let mut config = paper(PaperSizes { slots: 3, action: 0, delta: 2.0, grid: 4, max_objects: 7 });
    config.detector = None;
    config.objects.interaction = Interaction::Inter1;
    config
}

/// Small enough to train and serve on a CPU; PUSH1's shapes (decisions row 15).
pub fn tiny() -> GatsbiConfig {
    let stage = |factor, channels, groups| SubPixelStage { factor, channels, groups };
    GatsbiConfig {
        image_size: 64,
        action: ActionConfig { dim: 7, hidden: 32, enhanced: 16 },
        mixture: MixtureConfig {
            slots: 3,
            z_mask: 16,
            z_comp: 32,
            hidden: 64,
            mlp: 64,
            mask_features: 32,
            delta: 1.0,
            comp_prior_action: false,
            one_memory: false,
            encoder: EncoderConfig {
                channels: vec![16, 32, 48, 64],
                groups: vec![2, 4, 6, 8],
                first_kernel: 5,
                features: 64,
            },
            mask_decoder: MaskDecoderConfig {
                inputs: 16,
                base: 64,
                base_groups: 8,
                stages: vec![stage(4, 64, 8), stage(2, 32, 4), stage(4, 16, 4)],
            },
            comp_encoder: CompEncoderConfig { channels: vec![16, 16, 32], features: 64 },
            comp_decoder: CompDecoderConfig::SubPixel {
                inputs: 32,
                base_side: 4,
                base: 32,
                stages: vec![stage(2, 32, 4), stage(2, 20, 4), stage(2, 12, 4)],
            },
            comp_norm: CompNorm::Batch,
            init: InitScheme::Orthogonal,
        },
        detector: Some(DetectorConfig {
            keypoints: 12,
            filters: 8,
            convs_per_scale: 1,
            gamma: GammaForm::Centred { steepness: 8.0 },
        }),
        objects: ObjectConfig {
            z_what: 32,
            z_dyna: 64,
            hidden: 64,
            image_encoder: ImageEncoderConfig { channels: vec![16, 32, 64], blocks: 1 },
            glimpse_encoder: GlimpseCodecConfig {
                channels: vec![8, 16, 32, 64],
                groups: vec![1, 1, 2, 4],
            },
            glimpse_decoder: GlimpseCodecConfig {
                channels: vec![32, 16, 8],
                groups: vec![2, 1, 1],
            },
            // Detectors drop second boxes at 0.3 to 0.5 by convention, but boxes are close around objects: what overlaps less is
            // often the same object, moved and about to be followed.
            rejection: Some(0.1),
            // An action moves the hand and what it pushes in the same step.
            agent_feature: AgentFeature::Next,
            ..objects(4, 7)
        },
        tracking: Tracking::serving(),
    }
}

/// BALLS with the sizes of [`tiny`].
pub fn balls_tiny() -> GatsbiConfig {
    let mut config = tiny();
    config.action.dim = 0;
    config.detector = None;
    // The box is one thing; two is the fewest.
    config.mixture.slots = 2;
    config.objects.interaction = Interaction::Inter1;
    // A cell finds one object, and balls are close together: a cell of 8 pixels seldom holds the centres of two.
    config.objects.grid = 8;
    // Balls pass in front of each other, and move little in a frame: what overlaps a known one less is another.
    config.objects.rejection = Some(0.5);
    config
}

/// What differs between the paper's data sets (mixture spec 1.3).
#[derive(Clone, Copy)]
struct PaperSizes {
    slots: i64,
    action: i64,
    delta: f64,
    grid: i64,
    max_objects: i64,
}

fn paper(sizes: PaperSizes) -> GatsbiConfig {
    let stage = |factor, channels, groups| SubPixelStage { factor, channels, groups };
    let PaperSizes { slots, action, delta, grid, max_objects } = sizes;
    GatsbiConfig {
        image_size: 64,
        action: ActionConfig { dim: action, hidden: 64, enhanced: 32 },
        mixture: MixtureConfig {
            slots,
            z_mask: 32,
            z_comp: 64,
            hidden: 128,
            mlp: 128,
            mask_features: 64,
            delta,
            comp_prior_action: false,
            one_memory: false,
            encoder: EncoderConfig {
                channels: vec![64, 128, 256, 512],
                groups: vec![4, 8, 16, 32],
                first_kernel: 7,
                features: 128,
            },
            mask_decoder: MaskDecoderConfig {
                inputs: 32,
                base: 256,
                base_groups: 16,
                stages: vec![
                    stage(4, 256, 16),
                    stage(2, 128, 16),
                    stage(4, 64, 8),
                    stage(2, 16, 4),
                ],
            },
            comp_encoder: CompEncoderConfig { channels: vec![32, 32, 64], features: 128 },
            comp_decoder: CompDecoderConfig::Broadcast { inputs: 64, width: 32, final_kernel: 3 },
            comp_norm: CompNorm::Batch,
            init: InitScheme::Orthogonal,
        },
        detector: Some(DetectorConfig {
            keypoints: 32,
            filters: 32,
            convs_per_scale: 2,
            gamma: GammaForm::Centred { steepness: 8.0 },
        }),
        objects: objects(grid, max_objects),
        tracking: Tracking::serving(),
    }
}

/// The object module at G-SWM's sizes with the constants recommended for robot scenes (object spec 6.9).
fn objects(grid: i64, max_objects: i64) -> ObjectConfig {
    ObjectConfig {
        grid,
        max_objects,
        z_what: 64,
        z_dyna: 128,
        hidden: 128,
        glimpse: 16,
        image_encoder: ImageEncoderConfig { channels: vec![64, 128, 256], blocks: 2 },
        glimpse_encoder: GlimpseCodecConfig {
            channels: vec![16, 32, 64, 128],
            groups: vec![1, 2, 4, 8],
        },
        glimpse_decoder: GlimpseCodecConfig { channels: vec![64, 32, 16], groups: vec![4, 2, 1] },
        updates: UpdateConfig {
            proposal: (0.1, 0.3),
            shift: 0.6,
            scale: 0.3,
            what: 0.2,
            depth: 1.0,
            environment: 0.25,
            map_sigma: 0.1,
        },
        prior: DiscoveryPrior {
            presence: 1e-10,
            scale_mean: -1.5,
            scale_std: 0.1,
            shift_mean: 0.0,
            shift_std: 1.0,
        },
        rejection: Some(0.8),
        aux_presence_kl: true,
        graph: knn(3),
        interaction: Interaction::Inter3 { outputs: 32, celu: false },
        agent_history: AgentHistory::After,
        agent_feature: AgentFeature::Current,
    }
}

fn knn(k: i64) -> Graph {
    Graph::Knn { k, metric: KnnMetric::Distance, aggregate: KnnAggregate::Attention }
}
