//! What an object is: the columns of its latent vector `z = [pres 1, depth 1, where 4, what, dyna]`
//! (object spec 1.1), and the attributes a step draws for it.

use tch::Tensor;

use crate::{
    config::UpdateConfig,
    nn::{InitScheme, Mlp, Normal, Path, distributions::positive},
    noise::{Noise, Site},
};

/// Column of the first shift (t_x) in `z`.
pub(super) const SHIFT: i64 = 4;

/// Where appearance begins in a latent vector, after presence, depth and place.
const WHAT: i64 = 6;

/// Columns of a latent vector.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layout {
    /// Width of the appearance.
    pub(crate) what: i64,
    /// Width of the dynamics latent.
    pub(crate) dyna: i64,
}

/// The parts of latent vectors `[..., Z]`, as views.
#[derive(Debug)]
pub struct Latents {
    /// Presence in [0, 1], `[..., 1]`.
    pub pres: Tensor,
    /// Depth, smaller is nearer, `[..., 1]`.
    pub depth: Tensor,
    /// `(s_x, s_y, t_x, t_y)`, `[..., 4]`.
    pub place: Tensor,
    /// Appearance, `[..., what]`.
    pub what: Tensor,
    /// Dynamics, `[..., dyna]`.
    pub dyna: Tensor,
}

impl Layout {
    /// Width Z of a latent vector.
    pub(crate) fn width(self) -> i64 {
        WHAT + self.what + self.dyna
    }

    /// The parts of `z`.
    pub(crate) fn split(self, z: &Tensor) -> Latents {
        Latents {
            pres: z.narrow(-1, 0, 1),
            depth: z.narrow(-1, 1, 1),
            place: place(z),
            what: z.narrow(-1, WHAT, self.what),
            dyna: z.narrow(-1, WHAT + self.what, self.dyna),
        }
    }
}

impl Latents {
    /// The whole vectors, `[..., Z]`.
    pub(crate) fn join(&self) -> Tensor {
        Tensor::cat(&[&self.pres, &self.depth, &self.place, &self.what, &self.dyna], -1)
    }
}

/// Presence of latent vectors, `[..., 1]`.
pub(crate) fn presence(z: &Tensor) -> Tensor {
    z.narrow(-1, 0, 1)
}

/// Latent vectors `z [B, N, Z]` with other presences `[B, N, 1]`.
pub(crate) fn with_presence(z: &Tensor, pres: &Tensor) -> Tensor {
    Tensor::cat(&[pres, &z.narrow(-1, 1, z.size()[2] - 1)], -1)
}

/// Latent vectors `z [B, N, Z]` without the objects in `which [B, N]`.
pub(crate) fn absent(z: &Tensor, which: &Tensor) -> Tensor {
    with_presence(z, &presence(z).masked_fill(&which.unsqueeze(-1), 0.0))
}

/// Latent vectors `z [..., Z]` that look, and move, as those in `other`.
pub(crate) fn looking_like(z: &Tensor, other: &Tensor) -> Tensor {
    let rest = other.size()[other.dim() - 1] - WHAT;
    Tensor::cat(&[z.narrow(-1, 0, WHAT), other.narrow(-1, WHAT, rest)], -1)
}

/// `z_where` of latent vectors, `[..., 4]`.
pub(crate) fn place(z: &Tensor) -> Tensor {
    z.narrow(-1, 2, 4)
}

/// Centres of latent vectors, `[..., 2]`.
pub(crate) fn shift(z: &Tensor) -> Tensor {
    z.narrow(-1, SHIFT, 2)
}

/// The attribute network `p(attributes | z_dyna)` (object spec 2.6), shared by propagation and generation.
#[derive(Debug)]
pub(crate) struct AttributeNet {
    mlp: Mlp,
    layout: Layout,
    updates: UpdateConfig,
}

/// Distributions of a step's attribute offsets and the gates on them.
#[derive(Debug)]
pub(crate) struct Attributes {
    /// Probability that the object is present in this frame, `[B, N, 1]`.
    pub(crate) presence: Tensor,
    /// Depth offset, `[B, N, 1]`.
    pub(crate) depth: Normal,
    /// Where offset, `[B, N, 4]`.
    pub(crate) place: Normal,
    /// What offset, `[B, N, what]`.
    pub(crate) what: Normal,
    /// Gates in (0, 1) of depth, where and what.
    pub(crate) gates: [Tensor; 3],
}

impl AttributeNet {
    pub(crate) fn new(
        path: &Path<'_>,
        hidden: i64,
        layout: Layout,
        updates: &UpdateConfig,
    ) -> Self {
        let outputs = 1 + 3 * (1 + 4 + layout.what);
        let widths = [layout.dyna, hidden, hidden, outputs];
        let mlp = Mlp::new(&path.sub("enc"), &widths, InitScheme::Framework);
        Self { mlp, layout, updates: updates.clone() }
    }

    pub(crate) fn forward(&self, z_dyna: &Tensor) -> Attributes {
        let outputs = self.mlp.forward(z_dyna);
        let mut column = 0;
        let mut take = |width: i64| {
            let part = outputs.narrow(-1, column, width);
            column += width;
            part
        };
        let presence = take(1).sigmoid();
        let mut normal = |width: i64| Normal { loc: take(width), scale: positive(&take(width)) };
        let (depth, place, what) = (normal(1), normal(4), normal(self.layout.what));
        let gates = [take(1).sigmoid(), take(4).sigmoid(), take(self.layout.what).sigmoid()];
        Attributes { presence, depth, place, what, gates }
    }

    /// Moves objects by offsets drawn from `attributes` (object spec 3.3, steps 6 to 8); presence is left as it
    /// was.
    pub(crate) fn update(
        &self,
        previous: &Latents,
        attributes: &Attributes,
        z_dyna: Tensor,
        noise: &dyn Noise,
    ) -> Latents {
        let updates = &self.updates;
        let draw = |normal: &Normal, site| normal.sample(&noise.normal(site, &normal.loc.size()));
        let [depth_gate, place_gate, what_gate] = &attributes.gates;
        let place_offset = place_gate * draw(&attributes.place, Site::Where).tanh();
        let what_offset = what_gate * draw(&attributes.what, Site::What).tanh();
        let depth_offset = depth_gate * draw(&attributes.depth, Site::Depth);
        let moved = Tensor::cat(
            &[
                place_offset.narrow(-1, 0, 2) * updates.scale,
                place_offset.narrow(-1, 2, 2) * updates.shift,
            ],
            -1,
        );
        Latents {
            pres: previous.pres.shallow_clone(),
            depth: &previous.depth + depth_offset * updates.depth,
            place: &previous.place + moved,
            what: &previous.what + what_offset * updates.what,
            dyna: z_dyna,
        }
    }
}
