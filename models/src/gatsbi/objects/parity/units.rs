//! Single networks and formulas.

use std::path::Path;

use tch::{Kind, Tensor};

use super::{
    super::{
        ObjectModule,
        discovery::overlapped,
        latents::{Latents, Layout, place as place_of},
        render::render,
    },
    Checker, Quantity, Record, committed_record, full_record, gswm_config, load,
};
use crate::nn::{
    Normal,
    distributions::{kl_bernoulli, normal_log_density, relaxed_bernoulli},
    spatial_transformer::{crop, iou, place},
};

/// A module on a grid of 4 and one on a grid of 8 with the same weights, and the recorded units.
struct Units {
    coarse: ObjectModule,
    fine: ObjectModule,
    record: Record,
}

impl Units {
    fn open(folder: &Path, all: bool) -> Self {
        let mut fine = gswm_config();
        fine.objects.grid = 8;
        Self {
            coarse: load(&gswm_config(), folder, all).0,
            fine: load(&fine, folder, all).0,
            record: Record::open(folder, "units"),
        }
    }

    fn get(&self, name: &str) -> &Tensor {
        self.record.get(name)
    }

    /// The set of ten random objects: latent vectors and memories.
    fn ten(&self) -> (Tensor, Tensor, Tensor) {
        let part = |name: &str| self.get(&format!("z10.{name}")).shallow_clone();
        let latents = Latents {
            pres: part("z_pres"),
            depth: part("z_depth"),
            place: part("z_where"),
            what: part("z_what"),
            dyna: part("z_dyna"),
        };
        (latents.join(), part("h"), part("c"))
    }

    fn check_formulas(&self, checker: &mut Checker<'_>) {
        use Quantity::{Information, Value};
        for (tau, name) in [(1.0, "tau1"), (0.5, "tau0.5")] {
            let (p, u) = (self.get("relaxed_bernoulli.p"), self.get("relaxed_bernoulli.u"));
            let sample = relaxed_bernoulli(p, u, tau);
            checker.compare(name, &sample, self.get(&format!("relaxed_bernoulli.{name}")), Value);
        }
        for (q, name) in [(1e-10, "prior1e-10"), (0.1, "prior0.1")] {
            let kl = kl_bernoulli(self.get("kl_bern.p"), q);
            checker.compare(name, &kl, self.get(&format!("kl_bern.out_{name}")), Information);
        }
        let normal = || Normal {
            loc: self.get("kl_where.loc").shallow_clone(),
            scale: self.get("kl_where.scale").shallow_clone(),
        };
        checker.compare("kl_std", &normal().kl_to_standard(), self.get("kl_std.out"), Information);
        let prior = Tensor::from_slice(&[-1.5f32, -1.5, 0.0, 0.0]);
        let scale = Tensor::from_slice(&[0.1f32, 0.1, 1.0, 1.0]);
        let kl = normal().kl_to(&prior, &scale);
        checker.compare("kl_where", &kl, self.get("kl_where.out"), Information);
        for (sigma, name) in [(0.1, "sigma0.1"), (0.2, "sigma0.2")] {
            let density =
                normal_log_density(self.get("gauss_ll.x"), self.get("gauss_ll.recon"), sigma);
            let total = density.flatten(1, -1).sum_dim_intlist(1, false, Kind::Float);
            checker.compare(name, &total, self.get(&format!("gauss_ll.{name}")), Information);
        }
    }

    fn check_transformers(&self, checker: &mut Checker<'_>) {
        let boxes = self.get("st.z_where").unsqueeze(1);
        let glimpse = crop(self.get("st.image"), &boxes, 16);
        checker.compare("crop", &glimpse, self.get("st.fwd.out"), Quantity::Image);
        let image = place(&self.get("st.inv.glimpse").unsqueeze(1), &boxes, 64);
        checker.compare("place", &image, self.get("st.inv.out"), Quantity::Image);
        for (module, grid) in [(&self.coarse, "g4"), (&self.fine, "g8")] {
            let name = format!("offset_grid_{grid}");
            let centres = module.discovery.cell_centres(&boxes).tr();
            checker.compare(&name, &centres, self.get(&name), Quantity::Value);
            let raw = self.get(&format!("where_rel2abs_{grid}.in"));
            let expected = self.get(&format!("where_rel2abs_{grid}.out"));
            checker.compare(&name, &module.discovery.absolute(raw), expected, Quantity::Value);
        }
    }

    fn check_heads(&self, checker: &mut Checker<'_>) {
        use Quantity::Value;
        let propagation = &self.coarse.propagation;
        let mut normal = |name: &str, actual: &Normal| {
            for (part, actual) in [("loc", &actual.loc), ("scale", &actual.scale)] {
                checker.compare(name, actual, self.get(&format!("{name}_{part}")), Value);
            }
        };
        let input = self.get("latent_post_prop.in");
        normal(
            "latent_post_prop.z_dyna",
            &Normal::from_head(&propagation.dyna_post.forward(input)),
        );
        let vectors = self.get("vec128.in");
        normal("latent_prior_prop.z_dyna", &propagation.dynamics_prior(vectors));
        let cells = self.coarse.discovery.heads(self.get("disc_heads.in"));
        normal("latent_post_disc.z_dyna", &cells.dyna);
        normal("post_disc.z_depth", &cells.depth);
        normal("post_disc.z_where", &cells.raw_place);
        normal("post_disc.z_what", &cells.what);
        checker.check("post_disc.z_pres_prob", &cells.presence, Value);
        let attributes = propagation.attributes.forward(vectors);
        super::tracking::check_attributes(checker, "att_prior", &attributes);
        let proposal = propagation.proposal.forward(vectors);
        checker.compare("pred_proposal", &proposal, self.get("pred_proposal.out"), Value);
    }

    fn check_glimpses(&self, checker: &mut Checker<'_>) {
        let input = self.get("glimpse_enc.in");
        let encoded = self.coarse.propagation.proposal_encoder.forward(input);
        let expected = self.get("proposal_encoder.out");
        checker.compare("proposal encoder", &encoded, expected, Quantity::Value);
        let encoded = self.coarse.surroundings.encoder.forward(input);
        let expected = self.get("bg_attention_encoder.out");
        checker.compare("environment encoder", &encoded, expected, Quantity::Value);
        let decoded = self.coarse.decoder.forward(&self.get("glimpse_decoder.in").unsqueeze(1));
        let (colour, alpha) = (decoded.narrow(2, 0, 3), decoded.narrow(2, 3, 1));
        checker.check("glimpse_decoder.o_att", &colour, Quantity::Image);
        checker.check("glimpse_decoder.alpha_att", &alpha, Quantity::Image);
    }

    fn check_relations(&self, checker: &mut Checker<'_>) {
        use Quantity::Value;
        let (z, h, c) = self.ten();
        let memory = || super::super::Memory { h: h.shallow_clone(), c: c.shallow_clone() };
        let background = self.get("temporal.bg");
        let environment = self.coarse.surroundings.environment(background, &place_of(&z));
        checker.compare("environment", &environment, self.get("temporal.bg_enc"), Value);
        for (which, network) in [("post", &self.coarse.post), ("prior", &self.coarse.prior)] {
            let relations = network.relations.forward(&z, &h, None);
            checker.check(&format!("relation.{which}.out"), &relations, Value);
            let after = network.advance(&z, &memory(), &environment, None);
            checker.check(&format!("temporal.{which}.h"), &after.h, Value);
            checker.check(&format!("temporal.{which}.c"), &after.c, Value);
        }
        let alone =
            self.coarse.post.relations.forward(&z.narrow(1, 0, 1), &h.narrow(1, 0, 1), None);
        checker.check("relation_n1.post.out", &alone, Value);
        let map = self.coarse.discovery.propagation_map(&z);
        checker.compare("map", &map, self.get("prop_map_g4.out"), Value);
        let map = self.fine.discovery.propagation_map(&z);
        checker.compare("fine map", &map, self.get("prop_map_g8.out"), Value);
    }

    fn check_sets(&self, checker: &mut Checker<'_>) {
        let boxes = |name: &str| self.get(&format!("rejection.z_where_{name}"));
        let overlap = iou(boxes("disc"), boxes("prop"));
        checker.compare("iou", &overlap, self.get("rejection.iou"), Quantity::Value);
        let known = Tensor::cat(
            &[
                self.get("rejection.z_pres_prop"),
                &boxes("prop").zeros_like().narrow(-1, 0, 1),
                boxes("prop"),
            ],
            -1,
        );
        for threshold in [0.8, 0.3] {
            let presence = self.get("rejection.z_pres_disc");
            let kept = presence
                .masked_fill(&overlapped(boxes("disc"), &known, threshold).any_dim(-1, true), 0.0);
            let expected = self.get(&format!("rejection.z_pres_out_thr{threshold}"));
            checker.compare("rejection", &kept, expected, Quantity::Value);
        }
        let (_, order) = self.get("select.z_pres_in").squeeze_dim(-1).sort_stable(true, 1, true);
        let ids = self.get("select.ids_in").gather(1, &order.narrow(1, 0, 10), false);
        checker.check_ids("select", &ids, self.get("select.ids_out"));
    }

    fn check_rendering(&self, checker: &mut Checker<'_>) {
        use Quantity::Image;
        let (z, _, _) = self.ten();
        let layout = Layout { what: 64, dyna: 128 };
        let rendering = render(&self.coarse.decoder, &z, layout, 64);
        checker.check("render.fg", &rendering.foreground, Image);
        checker.check("render.alpha_map", &rendering.alpha, Image);
        let importance = self.get("render.importance") * self.get("render.alpha_full");
        checker.compare("masks", &rendering.masks, &importance, Image);
        let image = rendering.over(self.get("temporal.bg"));
        checker.check("render.recon_over_bg", &image, Image);
    }

    fn check_image_encoder(&self, checker: &mut Checker<'_>) {
        let input = self.get("img_encoder.in");
        for (module, grid) in [(&self.coarse, "g4"), (&self.fine, "g8")] {
            let encoder = &module.discovery.image_encoder;
            let output = encoder.forward(input, false);
            checker.check(&format!("img_encoder.out_{grid}"), &output, Quantity::Value);
        }
        let stem = self.coarse.discovery.image_encoder.stem(input, false);
        let channels = Tensor::arange_start_step(0, 64, 8, (Kind::Int64, tch::Device::Cpu));
        let stem = stem.index_select(1, &channels);
        checker.check("img_encoder.stem_every8thchannel", &stem, Quantity::Value);
    }

    fn check_all(&self, checker: &mut Checker<'_>) {
        self.check_formulas(checker);
        self.check_transformers(checker);
        self.check_heads(checker);
        self.check_glimpses(checker);
        self.check_relations(checker);
        self.check_sets(checker);
        self.check_rendering(checker);
    }
}

#[test]
fn parity_units() {
    let Some(folder) = full_record() else { return };
    let _no_grad = tch::no_grad_guard();
    let units = Units::open(&folder, true);
    let mut checker = Checker::new(&units.record);
    units.check_all(&mut checker);
    units.check_image_encoder(&mut checker);
    checker.finish(60);
}

#[test]
fn parity_committed_units() {
    let _no_grad = tch::no_grad_guard();
    let units = Units::open(&committed_record(), false);
    let mut checker = Checker::new(&units.record);
    units.check_all(&mut checker);
    checker.finish(57);
}
