//! The mixture module: agent and background as K slots, each a mask and an image (mixture spec 2 and 3).
//!
//! Read [`Mixture::observe`] first: it is the table of mixture spec 3 line by line. [`Mixture::imagine`] is its
//! second column, [`Mixture::skip`] an imagined step that also feeds the posterior's memory.

mod comp_decoder;
mod comp_path;
mod encoder;
mod mask_decoder;
mod mask_path;
mod residual;

use tch::{Device, Kind, Tensor};

use self::{
    comp_decoder::CompDecoder,
    comp_path::{CompPath, Components},
    encoder::FrameEncoder,
    mask_decoder::{MaskDecoder, stick_breaking},
    mask_path::{Drive, MaskPath, Masks},
};
use crate::{
    config::MixtureConfig,
    kernels,
    nn::{LearnedState, LstmBank, Normal, Path},
    noise::{Noise, Site},
};

/// Hidden and cell state of one LSTM family, `[B, K, hidden]` each.
#[derive(Debug)]
pub struct Memory {
    /// Hidden state.
    pub h: Tensor,
    /// Cell state.
    pub c: Tensor,
}

impl Memory {
    /// Another handle on the same tensors.
    #[must_use]
    pub fn shallow_clone(&self) -> Self {
        Self { h: self.h.shallow_clone(), c: self.c.shallow_clone() }
    }

    /// `other` where `rows`, which broadcasts to the memory, is true.
    #[must_use]
    pub fn replaced(&self, rows: &Tensor, other: &Self) -> Self {
        Self { h: other.h.where_self(rows, &self.h), c: other.c.where_self(rows, &self.c) }
    }
}

/// The recurrent state of the mixture, before the next frame.
#[derive(Debug)]
pub struct MixtureState {
    /// Mask latents of the last step, `[B, K, z_mask]`.
    pub z_mask: Tensor,
    /// Component latents of the last step, `[B, K, z_comp]`.
    pub z_comp: Tensor,
    /// Posterior memory of the masks.
    pub mask_post: Memory,
    /// Prior memory of the masks.
    pub mask_prior: Memory,
    /// Posterior memory of the components.
    pub comp_post: Memory,
    /// Prior memory of the components.
    pub comp_prior: Memory,
}

impl MixtureState {
    /// Another handle on the same tensors.
    #[must_use]
    pub fn shallow_clone(&self) -> Self {
        Self {
            z_mask: self.z_mask.shallow_clone(),
            z_comp: self.z_comp.shallow_clone(),
            mask_post: self.mask_post.shallow_clone(),
            mask_prior: self.mask_prior.shallow_clone(),
            comp_post: self.comp_post.shallow_clone(),
            comp_prior: self.comp_prior.shallow_clone(),
        }
    }

    /// `other` in the rows `[B]` that are true.
    pub(crate) fn replaced(&self, rows: &Tensor, other: &Self) -> Self {
        let rows = rows.view([-1, 1, 1]);
        let memory = |own: &Memory, other: &Memory| own.replaced(&rows, other);
        Self {
            z_mask: other.z_mask.where_self(&rows, &self.z_mask),
            z_comp: other.z_comp.where_self(&rows, &self.z_comp),
            mask_post: memory(&self.mask_post, &other.mask_post),
            mask_prior: memory(&self.mask_prior, &other.mask_prior),
            comp_post: memory(&self.comp_post, &other.comp_post),
            comp_prior: memory(&self.comp_prior, &other.comp_prior),
        }
    }
}

/// What one step of the mixture gives.
#[derive(Debug)]
pub struct MixtureStep {
    /// Log masks, `[B, K, 1, H, W]`; masks sum to one over slots.
    pub log_masks: Tensor,
    /// Component images in [0, 1], `[B, K, 3, H, W]`.
    pub components: Tensor,
    /// `mu_mix = Σ_k π_k o_k`, `[B, 3, H, W]`.
    pub mu_mix: Tensor,
    /// Distribution the mask latents were drawn from, before the residual update, `[B, K, z_mask]`.
    pub mask_raw: Normal,
    /// Distribution the component latents were drawn from, `[B, K, z_comp]`.
    pub comp_raw: Normal,
    /// Residuals `Δ MLP_res` of masks `[B, K, z_mask]` and components `[B, K, z_comp]`; meaningless on a row's
    /// first frame.
    pub residuals: (Tensor, Tensor),
    /// Priors of mask and component latents under the drawn latents; present if asked for while observing.
    pub priors: Option<(Normal, Normal)>,
}

/// Which memories a step updates.
#[derive(Clone, Copy, Eq, PartialEq)]
enum Families {
    Both,
    Prior,
}

/// LSTMs of one memory, and where it starts.
type Family = (LstmBank, LearnedState);

/// The mixture module.
#[derive(Debug)]
pub struct Mixture {
    encoder: FrameEncoder,
    masks: MaskPath,
    mask_decoder: MaskDecoder,
    comps: CompPath,
    comp_decoder: CompDecoder,
    /// Absent where the posterior shares the prior's memory.
    mask_post: Option<Family>,
    mask_prior: Family,
    comp_post: Option<Family>,
    comp_prior: Family,
    z_mask_start: Tensor,
    z_comp_start: Tensor,
    z_mask: i64,
    z_comp: i64,
    /// Frozen on a CPU.
    kernels: bool,
}

impl Mixture {
    /// Creates the parameters under `path`; `action` is the width of the enhanced action.
    pub fn new(path: &Path<'_>, config: &MixtureConfig, action: i64, image_size: i64) -> Self {
        let (slots, hidden) = (config.slots, config.hidden);
        let family = |name: &str, z| {
            let path = path.sub("memory").sub(name);
            let bank = LstmBank::new(&path, slots, z + config.encoder.features, hidden);
            (bank, LearnedState::new(&path.sub("start"), &[slots, hidden], config.init))
        };
        let post = |name: &str, z| (!config.one_memory).then(|| family(name, z));
        let start = |name: &str, z| path.weight(name, &[slots, z], LearnedState::init(config.init));
        let encoder = &path.sub("encoder");
        Self {
            encoder: FrameEncoder::new(encoder, &config.encoder, image_size, config.init),
            masks: MaskPath::new(&path.sub("mask"), config, action),
            mask_decoder: MaskDecoder::new(&path.sub("mask_decoder"), config, action, image_size),
            comps: CompPath::new(&path.sub("comp"), config, action, image_size),
            comp_decoder: CompDecoder::new(&path.sub("comp_decoder"), config, action, image_size),
            mask_post: post("mask_post", config.z_mask),
            mask_prior: family("mask_prior", config.z_mask),
            comp_post: post("comp_post", config.z_comp),
            comp_prior: family("comp_prior", config.z_comp),
            z_mask_start: start("z_mask_start", config.z_mask),
            z_comp_start: start("z_comp_start", config.z_comp),
            z_mask: config.z_mask,
            z_comp: config.z_comp,
            kernels: false,
        }
    }

    /// The learned state before any frame.
    pub fn initial_state(&self, batch: i64) -> MixtureState {
        let memory = |(_, start): &Family| {
            let (h, c) = start.expand(batch);
            Memory { h, c }
        };
        let post = |post: &Option<Family>, prior| memory(post.as_ref().unwrap_or(prior));
        let latent = |start: &Tensor| start.unsqueeze(0).expand([batch, -1, -1], false);
        MixtureState {
            z_mask: latent(&self.z_mask_start),
            z_comp: latent(&self.z_comp_start),
            mask_post: post(&self.mask_post, &self.mask_prior),
            mask_prior: memory(&self.mask_prior),
            comp_post: post(&self.comp_post, &self.comp_prior),
            comp_prior: memory(&self.comp_prior),
        }
    }

    /// Absorbs a frame: latents from the posterior, all four memories updated.
    ///
    /// # Shapes
    /// `frame [B, 3, H, W]` in [0, 1], `action [B, ā]` (the enhanced action that led to the frame),
    /// `first [B]` bool. With `priors` the prior's distributions under the drawn latents are computed too.
    #[expect(clippy::too_many_arguments, reason = "inputs of the step, flags of training")]
    pub fn observe(
        &self,
        state: &MixtureState,
        frame: &Tensor,
        action: &Tensor,
        first: &Tensor,
        noise: &dyn Noise,
        priors: bool,
        train: bool,
    ) -> (MixtureState, MixtureStep) {
        let first = first.view([-1, 1, 1]);
        let encoding = self.encoder.forward(frame);
        let masks = self.masks.posterior(
            &encoding,
            &state.mask_post.h,
            action,
            &state.z_mask,
            &first,
            &noise.normal(Site::Mask, &shape(state, self.z_mask)),
        );
        let log_masks = self.log_masks(&masks.z, action);
        let comps = self.comps.posterior(
            frame,
            &log_masks,
            &state.comp_post.h,
            action,
            &state.z_comp,
            &first,
            &noise.normal(Site::Component, &shape(state, self.z_comp)),
            train,
        );
        let priors = priors.then(|| {
            let (z, h) = (&state.z_mask, &state.mask_prior.h);
            let mask = self.masks.prior(z, h, action, &Drive::Given(&masks.z)).raw;
            let (z, h) = (&state.z_comp, &state.comp_prior.h);
            (mask, self.comps.prior_distribution(&masks.z, z, h, action))
        });
        let (next, step) =
            self.finish(state, masks, log_masks, comps, action, Families::Both, train);
        (next, MixtureStep { priors, ..step })
    }

    /// Predicts a frame: latents from the prior, only the prior's memories updated.
    ///
    /// # Shapes
    /// As in [`Mixture::observe`].
    pub fn imagine(
        &self,
        state: &MixtureState,
        action: &Tensor,
        first: &Tensor,
        noise: &dyn Noise,
    ) -> (MixtureState, MixtureStep) {
        self.predict(state, action, first, noise, Families::Prior)
    }

    /// Passes over a frame that never came: latents from the prior, all four memories fed with them.
    pub fn skip(
        &self,
        state: &MixtureState,
        action: &Tensor,
        first: &Tensor,
        noise: &dyn Noise,
    ) -> (MixtureState, MixtureStep) {
        self.predict(state, action, first, noise, Families::Both)
    }

    /// Makes the exact inference forms; gradients must be off from here on.
    pub fn freeze(&mut self) {
        self.kernels = self.z_mask_start.device() == Device::Cpu;
        self.encoder.freeze();
        self.mask_decoder.freeze();
        self.comps.freeze();
        self.comp_decoder.freeze();
    }

    /// Log masks of mask latents, `[B, K, 1, H, W]`.
    fn log_masks(&self, z: &Tensor, action: &Tensor) -> Tensor {
        let logits = self.mask_decoder.forward(z, action);
        if self.kernels { kernels::break_sticks(&logits) } else { stick_breaking(&logits) }
    }

    fn predict(
        &self,
        state: &MixtureState,
        action: &Tensor,
        first: &Tensor,
        noise: &dyn Noise,
        families: Families,
    ) -> (MixtureState, MixtureStep) {
        let first = &first.view([-1, 1, 1]);
        let mask_noise = &noise.normal(Site::Mask, &shape(state, self.z_mask));
        let drive = Drive::Sample { noise: mask_noise, first };
        let masks = self.masks.prior(&state.z_mask, &state.mask_prior.h, action, &drive);
        let log_masks = self.log_masks(&masks.z, action);
        let comp_noise = noise.normal(Site::Component, &shape(state, self.z_comp));
        let h_prior = &state.comp_prior.h;
        let comps = self.comps.prior(&masks.z, &state.z_comp, h_prior, action, first, &comp_noise);
        self.finish(state, masks, log_masks, comps, action, families, false)
    }

    /// Lines 11 to 15: decode, mix, encode the mixture, remember.
    #[expect(clippy::too_many_arguments, reason = "the results of the lines before")]
    fn finish(
        &self,
        state: &MixtureState,
        masks: Masks,
        log_masks: Tensor,
        comps: Components,
        action: &Tensor,
        families: Families,
        train: bool,
    ) -> (MixtureState, MixtureStep) {
        let components = self.comp_decoder.forward(&comps.z, action, train);
        let mix = if self.kernels { kernels::mix } else { mix };
        let mu_mix = mix(&log_masks, &components);
        let encoding = self.encoder.forward(&mu_mix).unsqueeze(1); // [B, 1, e]
        let encodings = encoding.expand([-1, masks.z.size()[1], -1], false);
        let inputs = |z: &Tensor| Tensor::cat(&[z, &encodings], -1);
        let advance = |(bank, _): &Family, input: &Tensor, memory: &Memory| {
            let (h, c) = bank.forward(input, (&memory.h, &memory.c));
            Memory { h, c }
        };
        let post = |post: &Option<Family>, input: &Tensor, memory: &Memory, prior: &Memory| match (
            post, families,
        ) {
            (None, _) => prior.shallow_clone(),
            (Some(family), Families::Both) => advance(family, input, memory),
            (Some(_), Families::Prior) => memory.shallow_clone(),
        };
        let (mask_input, comp_input) = (inputs(&masks.z), inputs(&comps.z));
        let mask_prior = advance(&self.mask_prior, &mask_input, &state.mask_prior);
        let comp_prior = advance(&self.comp_prior, &comp_input, &state.comp_prior);
        let next = MixtureState {
            mask_post: post(&self.mask_post, &mask_input, &state.mask_post, &mask_prior),
            comp_post: post(&self.comp_post, &comp_input, &state.comp_post, &comp_prior),
            mask_prior,
            comp_prior,
            z_mask: masks.z,
            z_comp: comps.z,
        };
        let mask_residual = masks.residual.expect("latents that were drawn have a residual");
        let step = MixtureStep {
            log_masks,
            components,
            mu_mix,
            mask_raw: masks.raw,
            comp_raw: comps.raw,
            residuals: (mask_residual, comps.residual),
            priors: None,
        };
        (next, step)
    }
}

/// `mu_mix = Σ_k π_k o_k`.
///
/// # Shapes
/// Log masks `[B, K, 1, H, W]` and images `[B, K, 3, H, W]`; returns `[B, 3, H, W]`.
fn mix(log_masks: &Tensor, components: &Tensor) -> Tensor {
    (log_masks.exp() * components).sum_dim_intlist(1, false, Kind::Float)
}

/// `[B, K, width]` of a state's slots.
fn shape(state: &MixtureState, width: i64) -> [i64; 3] {
    let size = state.z_mask.size();
    [size[0], size[1], width]
}

#[cfg(test)]
mod tests {
    use tch::{Device, Kind, Tensor};

    use super::Mixture;
    use crate::{config::presets, nn::ParamStore, noise::PhiloxNoise};

    #[test]
    fn one_memory_serves_posterior_and_prior() {
        for one_memory in [true, false] {
            let mut config = presets::tiny();
            config.mixture.one_memory = one_memory;
            let mut store = ParamStore::new(3, Device::Cpu);
            let mixture = store.build(|root| {
                let path = root.sub("mixture");
                Mixture::new(&path, &config.mixture, config.action.enhanced, config.image_size)
            });
            let _no_grad = tch::no_grad_guard();
            let options = (Kind::Float, Device::Cpu);
            let (frame, action) =
                (Tensor::rand([1, 3, 64, 64], options), Tensor::zeros([1, 16], options));
            let (noise, first) = (PhiloxNoise::mean(1, Device::Cpu), Tensor::from_slice(&[true]));
            let state = mixture.initial_state(1);
            let (seen, _) = mixture.observe(&state, &frame, &action, &first, &noise, false, false);
            let (imagined, _) = mixture.imagine(&seen, &action, &first.logical_not(), &noise);
            let same = |a: &Tensor, b: &Tensor| a.equal(b);
            for state in [&state, &seen, &imagined] {
                assert_eq!(same(&state.mask_post.h, &state.mask_prior.h), one_memory);
                assert_eq!(same(&state.comp_post.c, &state.comp_prior.c), one_memory);
            }
            // A posterior with a memory of its own is not told of what is only imagined.
            assert_eq!(same(&imagined.mask_post.h, &seen.mask_post.h), !one_memory);
        }
    }
}
