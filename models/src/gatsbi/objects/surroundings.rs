//! How background and agent act on objects: the environment crop of `mu_mix`, the agent's feature, and the
//! ambient vector that merges them (object spec 6.2 and 6.5).

use tch::Tensor;

use super::{glimpse::GlimpseEncoder, latents::place};
use crate::{
    config::{GatsbiConfig, Interaction},
    nn::{Activation, InitScheme, Mlp, Path},
};

/// The agent as objects see it: `u^r = [z^r, h^r]` and its action.
#[derive(Debug)]
pub struct Agent {
    /// `z^r`, mask latent of the agent slot, `[B, z_mask]`.
    pub latent: Tensor,
    /// `h^r`, prior mask memory of the agent slot, `[B, hidden]`.
    pub history: Tensor,
    /// Enhanced action of the step, `[B, ā]`.
    pub action: Tensor,
}

/// Networks of the surroundings.
#[derive(Debug)]
pub(crate) struct Surroundings {
    pub(super) encoder: GlimpseEncoder,
    agent: Option<AgentEffect>,
    margin: f64,
}

/// How the agent acts, merged with the environment crop.
#[derive(Debug)]
struct AgentEffect {
    reach: Reach,
    merge: Mlp,
    celu: bool,
}

#[derive(Debug)]
enum Reach {
    /// One feature for all objects (INTER3).
    Global(Mlp),
    /// A weighted feature per object (INTER2).
    Local { pair: Mlp, weight: Mlp, output: Mlp },
}

impl Surroundings {
    pub(crate) fn new(path: &Path<'_>, config: &GatsbiConfig) -> Self {
        let objects = &config.objects;
        let hidden = objects.hidden;
        let scheme = InitScheme::Framework;
        let agent_width = config.mixture.z_mask + config.mixture.hidden;
        let mlp = |name: &str, widths: &[i64]| Mlp::new(&path.sub(name), widths, scheme);
        let merge = |outputs: i64| mlp("ambient", &[2 * hidden, hidden, hidden, outputs]);
        let agent = match objects.interaction {
            Interaction::Inter1 => None,
            Interaction::Inter2 { outputs, celu } => {
                let features = 6 + objects.z_what + objects.z_dyna + hidden;
                let position = config.action.enhanced + config.mixture.hidden + 4 + hidden;
                let reach = Reach::Local {
                    pair: mlp("agent_pair", &[agent_width + features, hidden, hidden, hidden]),
                    weight: mlp("agent_weight", &[position, hidden, hidden, 1]),
                    output: mlp("agent_output", &[hidden, hidden, hidden]),
                };
                Some(AgentEffect { reach, merge: merge(outputs), celu })
            }
            Interaction::Inter3 { outputs, celu } => {
                let reach = Reach::Global(mlp("agent", &[agent_width, hidden, hidden]));
                Some(AgentEffect { reach, merge: merge(outputs), celu })
            }
        };
        Self {
            encoder: GlimpseEncoder::new(&path.sub("bg_attention_encoder"), objects),
            agent,
            margin: objects.updates.environment,
        }
    }

    /// Width of what [`Surroundings::effect`] returns.
    pub(crate) fn width(config: &GatsbiConfig) -> i64 {
        match config.objects.interaction {
            Interaction::Inter1 => config.objects.hidden,
            Interaction::Inter2 { outputs, .. } | Interaction::Inter3 { outputs, .. } => outputs,
        }
    }

    pub(crate) fn freeze(&mut self) {
        self.encoder.freeze();
    }

    /// The crop of `mu_mix [B, 3, H, W]` around objects at `z_where [B, N, 4]`, `[B, N, 3, s, s]`.
    pub(crate) fn crop(&self, mu_mix: &Tensor, z_where: &Tensor) -> Tensor {
        let scale = z_where.narrow(-1, 0, 2) + self.margin;
        let window = Tensor::cat(&[scale, z_where.narrow(-1, 2, 2)], -1);
        self.encoder.crop(mu_mix, &window)
    }

    /// The encoded environment e^s of objects at `z_where [B, N, 4]`, `[B, N, hidden]`; the same for both
    /// memories.
    pub(crate) fn environment(&self, mu_mix: &Tensor, z_where: &Tensor) -> Tensor {
        self.encoder.forward(&self.crop(mu_mix, z_where))
    }

    /// What environment and agent do to each object.
    ///
    /// # Shapes
    /// `environment [B, N, hidden]`, `z [B, N, Z]`, `h [B, N, hidden]` (the memory asked for); returns
    /// `[B, N, width]`.
    pub(crate) fn effect(
        &self,
        environment: &Tensor,
        agent: Option<&Agent>,
        z: &Tensor,
        h: &Tensor,
    ) -> Tensor {
        let Some(effect) = &self.agent else { return environment.shallow_clone() };
        let agent = agent.expect("a model with INTER2 or INTER3 has an agent");
        let objects = z.size()[1];
        let per_object = |x: &Tensor| x.unsqueeze(1).expand([-1, objects, -1], false);
        let agent_effect = match &effect.reach {
            Reach::Global(mlp) => {
                per_object(&mlp.forward(&Tensor::cat(&[&agent.latent, &agent.history], -1)))
            }
            Reach::Local { pair, weight, output } => {
                let (latent, history) = (per_object(&agent.latent), per_object(&agent.history));
                let pair = pair.forward(&Tensor::cat(&[&latent, &history, z, h], -1));
                let position = [&per_object(&agent.action), &history, &place(z), h];
                let weight = weight.forward(&Tensor::cat(&position, -1)).sigmoid();
                output.forward(&(pair * weight))
            }
        };
        let merged = effect.merge.forward(&Tensor::cat(&[environment, &agent_effect], -1));
        if effect.celu { Activation::Celu.apply(&merged) } else { merged }
    }
}
