//! Propagation: known objects into the next frame, with the frame (posterior) or without it (generation)
//! (object spec 3.3 and 3.10).

use tch::Tensor;

use super::{
    glimpse::GlimpseEncoder,
    latents::{AttributeNet, Attributes, Latents, Layout},
};
use crate::{
    config::{ObjectConfig, PresenceRule, Tracking},
    nn::{
        InitScheme, Mlp, Normal, Path,
        distributions::{kl_bernoulli, relaxed_bernoulli},
    },
    noise::{Noise, Site},
};

use super::ObjectKl;

/// Networks of propagation.
#[derive(Debug)]
pub(crate) struct Propagation {
    pub(super) proposal: Mlp,
    pub(super) proposal_encoder: GlimpseEncoder,
    pub(super) dyna_post: Mlp,
    dyna_prior: Mlp,
    pub(super) attributes: AttributeNet,
    layout: Layout,
    proposal_update: (f64, f64),
}

/// Objects carried into a frame with its help.
#[derive(Debug)]
pub(crate) struct Propagated {
    /// New latents, `[B, N, Z]`.
    pub(crate) z: Tensor,
    /// Windows the objects were looked for in, `[B, N, 4]`.
    pub(crate) proposal: Tensor,
    /// Posterior of the dynamics latents, `[B, N, dyna]`.
    pub(crate) dyna: Normal,
    /// Prior of the dynamics latents, from the prior memory before this step.
    pub(crate) dyna_prior: Normal,
    /// Distributions of the attribute offsets.
    pub(crate) attributes: Attributes,
}

impl Propagation {
    pub(crate) fn new(path: &Path<'_>, config: &ObjectConfig, layout: Layout) -> Self {
        let hidden = config.hidden;
        let mlp = |name: &str, inputs, outputs| {
            Mlp::new(&path.sub(name), &[inputs, hidden, hidden, outputs], InitScheme::Framework)
        };
        let attributes = path.sub("pres_depth_where_what_prior");
        Self {
            proposal: Mlp::new(
                &path.sub("pred_proposal").sub("net").sub("mod"),
                &[hidden, hidden, hidden, 2],
                InitScheme::Framework,
            ),
            proposal_encoder: GlimpseEncoder::new(&path.sub("proposal_encoder"), config),
            dyna_post: mlp("latent_post_prop.enc", 2 * hidden, 2 * layout.dyna),
            dyna_prior: mlp("latent_prior_prop.enc", hidden, 2 * layout.dyna),
            attributes: AttributeNet::new(&attributes, hidden, layout, &config.updates),
            layout,
            proposal_update: config.updates.proposal,
        }
    }

    /// # Shapes
    /// `z [B, N, Z]`, `h_post` and `h_prior [B, N, hidden]`, `frame [B, 3, H, W]`.
    pub(crate) fn posterior(
        &self,
        z: &Tensor,
        h_post: &Tensor,
        h_prior: &Tensor,
        frame: &Tensor,
        noise: &dyn Noise,
        tracking: &Tracking,
    ) -> Propagated {
        let previous = self.layout.split(z);
        let proposal = self.proposal(&previous, h_post);
        let glimpses = self.proposal_encoder.crop(frame, &proposal);
        let encoding = self.proposal_encoder.forward(&glimpses);
        let dyna =
            Normal::from_head(&self.dyna_post.forward(&Tensor::cat(&[&encoding, h_post], -1)));
        let z_dyna = dyna.sample(&noise.normal(Site::Dynamics, &dyna.loc.size()));
        let attributes = self.attributes.forward(&z_dyna);
        let mut next = self.attributes.update(&previous, &attributes, z_dyna, noise);
        let uniform = noise.uniform(Site::Presence, &attributes.presence.size());
        let own = relaxed_bernoulli(&attributes.presence, &uniform, 1.0);
        next.pres = match tracking.presence {
            PresenceRule::Product => &previous.pres * own,
            PresenceRule::Hold => {
                let held = own.gt(0.5).logical_and(&previous.pres.gt(0.5));
                own.ones_like().where_self(&held, &(&previous.pres * &own))
            }
        };
        bound_scale(&mut next, tracking);
        Propagated {
            z: next.join(),
            proposal,
            dyna,
            dyna_prior: self.dynamics_prior(h_prior),
            attributes,
        }
    }

    /// Objects carried on without a frame, `[B, N, Z]`; presence stays as it was.
    pub(crate) fn generate(
        &self,
        z: &Tensor,
        h_prior: &Tensor,
        noise: &dyn Noise,
        tracking: &Tracking,
    ) -> Tensor {
        let dyna = self.dynamics_prior(h_prior);
        let z_dyna = dyna.sample(&noise.normal(Site::Dynamics, &dyna.loc.size()));
        let attributes = self.attributes.forward(&z_dyna);
        let previous = self.layout.split(z);
        let mut next = self.attributes.update(&previous, &attributes, z_dyna, noise);
        bound_scale(&mut next, tracking);
        next.join()
    }

    pub(crate) fn freeze(&mut self) {
        self.proposal_encoder.freeze();
    }

    /// The prior of the dynamics latents given the prior memory.
    pub(crate) fn dynamics_prior(&self, h_prior: &Tensor) -> Normal {
        Normal::from_head(&self.dyna_prior.forward(h_prior))
    }

    fn proposal(&self, previous: &Latents, h_post: &Tensor) -> Tensor {
        let (min, max) = self.proposal_update;
        let enlarge = self.proposal.forward(h_post).sigmoid() * (max - min) + min;
        let scale = previous.place.narrow(-1, 0, 2) + enlarge;
        Tensor::cat(&[scale, previous.place.narrow(-1, 2, 2)], -1)
    }
}

impl Propagated {
    /// KL terms per row (object spec 3.3, step 10) of slots that are `filled [B, N, 1]`, 1 or 0.
    pub(crate) fn kl(&self, filled: &Tensor, presence_prior: Option<f64>) -> ObjectKl {
        let dyna = super::sum_per_row(&(self.dyna.kl(&self.dyna_prior) * filled));
        let pres = match presence_prior {
            Some(prior) => {
                super::sum_per_row(&(kl_bernoulli(&self.attributes.presence, prior) * filled))
            }
            None => dyna.zeros_like(),
        };
        let zero = || dyna.zeros_like();
        ObjectKl { pres, depth: zero(), place: zero(), what: zero(), dyna }
    }
}

fn bound_scale(latents: &mut Latents, tracking: &Tracking) {
    if let Some((low, high)) = tracking.scale_bounds {
        let scale = latents.place.narrow(-1, 0, 2).clamp(low, high);
        latents.place = Tensor::cat(&[scale, latents.place.narrow(-1, 2, 2)], -1);
    }
}
