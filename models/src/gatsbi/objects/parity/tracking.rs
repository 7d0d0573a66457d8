//! Cases A, B and G: tracking with discovery.

use tch::{Kind, Tensor};

use super::{
    super::{
        Discover, Memory, ObjectModule, ObjectState, ObjectStep,
        latents::{Latents, place},
    },
    Checker, Quantity, Record, Recorded, full_record, gswm_config, load, scenery, video,
};
use crate::{
    config::Tracking,
    nn::{
        distributions::normal_log_density,
        spatial_transformer::{crop, iou},
    },
};

/// One tracked video: what to feed and when to discover.
struct Track<'a> {
    module: &'a ObjectModule,
    record: &'a Record,
    frames: Tensor,
    background: Tensor,
    discovery: &'a [bool],
}

impl Track<'_> {
    fn run(&self, checker: &mut Checker<'_>) {
        let config = gswm_config();
        let tracking = Tracking::original();
        let mut state = self.module.initial_state(2);
        let mut elbo = (Tensor::from(0.0), Tensor::from(0.0));
        for t in 0..self.discovery.len() as i64 {
            let (frame, background) = (self.frames.select(1, t), self.background.select(1, t));
            let noise = Recorded::new(self.record, t, "prop");
            let scenery = scenery(&frame, &background);
            let discover = if self.discovery[t as usize] { Discover::All } else { Discover::None };
            let (next, step) =
                self.module.observe(&state, &scenery, discover, &noise, &tracking, false);
            if t > 0 {
                self.check_propagated(checker, t, &step, &state, &frame, &background);
            }
            self.check_discovered(checker, t, &step, &frame, &background);
            let kl = step.kl(&config.objects.prior, true);
            let log = |name: &str| self.record.at(&format!("log.{name}"), t);
            for (name, actual) in [
                ("kl_pres", &kl.pres),
                ("kl_depth", &kl.depth),
                ("kl_where", &kl.place),
                ("kl_what", &kl.what),
                ("kl_dyna", &kl.dyna),
                ("kl_fg", &kl.total()),
            ] {
                checker.compare(&format!("t{t} {name}"), actual, &log(name), Quantity::Information);
            }
            let proposal = step.proposal;
            checker.compare("log.proposal", &proposal, &log("proposal"), Quantity::Value);
            let image = self.check_kept(checker, t, &next, &background);
            state = self.recorded(t, next);
            let density = normal_log_density(&frame, &image, 0.2);
            let likelihood = density.flatten(1, -1).sum_dim_intlist(1, false, Kind::Float);
            elbo = (elbo.0 + likelihood, elbo.1 + kl.total());
        }
        checker.check("log.loglikelihood", &elbo.0, Quantity::Information);
        checker.check("log.elbo", &(&elbo.0 - &elbo.1), Quantity::Information);
    }

    /// The state after frame `t` as it was recorded, as far as it was. Ours has been compared with it; carried on, its
    /// rounding would add up with that of the next frames.
    fn recorded(&self, t: i64, ours: ObjectState) -> ObjectState {
        let log = |name: &str| self.record.at(&format!("log.{name}"), t);
        let latents = Latents {
            pres: log("z_pres"),
            depth: log("z_depth"),
            place: log("z_where"),
            what: log("z_what"),
            dyna: log("z_dyna"),
        };
        let memory = |which: &str, ours: Memory| {
            let part = |part: &str| self.record.find(&format!("t{t}.comb.{part}_{which}"));
            match (part("h"), part("c")) {
                (Some(h), Some(c)) => Memory { h: h.shallow_clone(), c: c.shallow_clone() },
                _ => ours,
            }
        };
        let (post, prior) = (memory("post", ours.post), memory("prior", ours.prior));
        ObjectState { z: latents.join(), post, prior, ..ours }
    }

    fn check_propagated(
        &self,
        checker: &mut Checker<'_>,
        t: i64,
        step: &ObjectStep,
        before: &ObjectState,
        frame: &Tensor,
        background: &Tensor,
    ) {
        let propagated = &step.propagated;
        let name = |part: &str| format!("t{t}.prop.{part}");
        let propagation = &self.module.propagation;
        let raw = propagation.proposal.forward(&before.post.h);
        checker.check(&name("proposal_offset_raw"), &raw, Quantity::Value);
        checker.check(&name("proposal"), &propagated.proposal, Quantity::Value);
        let glimpse = crop(frame, &propagated.proposal, 16);
        checker.check(&name("proposal_glimpse"), &glimpse, Quantity::Image);
        // Rounding of a box moves its crop, so the encoder is judged on the recorded box.
        let window = self.record.get(&name("proposal"));
        let encoding = propagation.proposal_encoder.forward(&crop(frame, window, 16));
        checker.check(&name("proposal_enc"), &encoding, Quantity::Value);
        for (which, normal) in
            [("z_dyna_post", &propagated.dyna), ("z_dyna_prior", &propagated.dyna_prior)]
        {
            checker.check(&name(&format!("{which}_loc")), &normal.loc, Quantity::Value);
            checker.check(&name(&format!("{which}_scale")), &normal.scale, Quantity::Value);
        }
        check_attributes(checker, &format!("t{t}.prop"), &propagated.attributes);
        check_latents(checker, &format!("t{t}.prop"), &self.module.layout.split(&propagated.z));
        let scenery = scenery(frame, background);
        let memories = [&before.post, &before.prior];
        check_memories(
            checker,
            self.module,
            &format!("t{t}.prop"),
            &propagated.z,
            memories,
            &scenery,
        );
    }

    fn check_discovered(
        &self,
        checker: &mut Checker<'_>,
        t: i64,
        step: &ObjectStep,
        frame: &Tensor,
        background: &Tensor,
    ) {
        let Some(discovered) = &step.discovered else { return };
        let name = |part: &str| format!("t{t}.disc.{part}");
        let discovery = &self.module.discovery;
        let input = Tensor::cat(&[frame, &(frame - background)], 1);
        let features = discovery.image_encoder.forward(&input, false);
        checker.check(&name("img_enc"), &features, Quantity::Value);
        let map = discovery.propagation_map(&step.propagated.z);
        checker.check(&name("prop_map"), &map, Quantity::Value);
        let posterior = &discovered.posterior;
        checker.check(&name("z_pres_prob"), &posterior.presence, Quantity::Value);
        for (part, normal) in [
            ("z_dyna_post", &posterior.dyna),
            ("z_depth", &posterior.depth),
            ("z_where", &posterior.raw_place),
            ("z_what", &posterior.what),
        ] {
            checker.check(&name(&format!("{part}_loc")), &normal.loc, Quantity::Value);
            checker.check(&name(&format!("{part}_scale")), &normal.scale, Quantity::Value);
        }
        checker.check(&name("z_pres_before_rejection"), &discovered.presence, Quantity::Value);
        if t > 0 {
            let overlap = iou(&discovered.place(), &place(&step.propagated.z));
            checker.check(&name("iou"), &overlap, Quantity::Value);
        }
        let latents = self.module.layout.split(&discovered.z);
        let rejected = latents.pres.eq(0.0).to_kind(Kind::Int64);
        checker.check_ids(&name("rejected"), &rejected, self.record.get(&name("rejected")));
        check_latents(checker, &format!("t{t}.disc"), &latents);
        let cells = discovered.z.size()[1];
        let fresh = [&self.module.post.initial(2, cells), &self.module.prior.initial(2, cells)];
        let scenery = scenery(frame, background);
        check_memories(checker, self.module, &format!("t{t}.disc"), &discovered.z, fresh, &scenery);
    }

    /// Checks the kept set and its rendering; returns the image.
    fn check_kept(
        &self,
        checker: &mut Checker<'_>,
        t: i64,
        state: &ObjectState,
        background: &Tensor,
    ) -> Tensor {
        let log = |name: &str| self.record.at(&format!("log.{name}"), t);
        if self.record.find("log.ids").is_some() {
            checker.check_ids(&format!("t{t} ids"), &state.ids, &log("ids"));
        }
        let latents = self.module.layout.split(&state.z);
        for (name, actual) in [
            ("z_pres", &latents.pres),
            ("z_depth", &latents.depth),
            ("z_where", &latents.place),
            ("z_what", &latents.what),
            ("z_dyna", &latents.dyna),
        ] {
            checker.compare(&format!("t{t} log.{name}"), actual, &log(name), Quantity::Value);
        }
        for (which, memory) in [("post", &state.post), ("prior", &state.prior)] {
            checker.check(&format!("t{t}.comb.h_{which}"), &memory.h, Quantity::Value);
            checker.check(&format!("t{t}.comb.c_{which}"), &memory.c, Quantity::Value);
        }
        let rendering = self.module.render(&state.z);
        let image = rendering.over(background);
        checker.compare("log.fg", &rendering.foreground, &log("fg"), Quantity::Image);
        checker.compare("log.alpha_map", &rendering.alpha, &log("alpha_map"), Quantity::Image);
        if self.record.find("log.recon").is_some() {
            checker.compare("log.recon", &image, &log("recon"), Quantity::Image);
        }
        let glimpses = self.module.decoder.forward(&latents.what).flatten(0, 1);
        let (colour, alpha) = (glimpses.narrow(1, 0, 3), glimpses.narrow(1, 3, 1));
        checker.check(&format!("t{t}.render.o_att"), &colour, Quantity::Image);
        checker.check(&format!("t{t}.render.alpha_att"), &alpha, Quantity::Image);
        image
    }
}

pub(super) fn check_attributes(
    checker: &mut Checker<'_>,
    phase: &str,
    attributes: &super::super::latents::Attributes,
) {
    checker.check(&format!("{phase}.z_pres_prob"), &attributes.presence, Quantity::Value);
    let parts = [
        ("z_depth", &attributes.depth),
        ("z_where", &attributes.place),
        ("z_what", &attributes.what),
    ];
    for ((part, normal), gate) in parts.into_iter().zip(&attributes.gates) {
        checker.check(&format!("{phase}.{part}_loc"), &normal.loc, Quantity::Value);
        checker.check(&format!("{phase}.{part}_scale"), &normal.scale, Quantity::Value);
        checker.check(&format!("{phase}.{part}_gate"), gate, Quantity::Value);
    }
}

pub(super) fn check_latents(checker: &mut Checker<'_>, phase: &str, latents: &Latents) {
    for (part, actual) in [
        ("z_pres", &latents.pres),
        ("z_depth", &latents.depth),
        ("z_where", &latents.place),
        ("z_what", &latents.what),
        ("z_dyna", &latents.dyna),
    ] {
        checker.check(&format!("{phase}.{part}"), actual, Quantity::Value);
    }
}

/// Checks relations, surroundings and memories of a whole set of objects.
fn check_memories(
    checker: &mut Checker<'_>,
    module: &ObjectModule,
    phase: &str,
    z: &Tensor,
    before: [&super::super::Memory; 2],
    scenery: &super::Scenery<'_>,
) {
    let background = scenery.environment_mix;
    let crop = module.surroundings.crop(background, &place(z));
    checker.check(&format!("{phase}.bg_glimpse"), &crop, Quantity::Image);
    let recorded_place = checker.record.find(&format!("{phase}.z_where"));
    let environment =
        recorded_place.map(|place| module.surroundings.environment(background, place));
    if let Some(environment) = environment {
        checker.check(&format!("{phase}.bg_enc"), &environment, Quantity::Value);
    }
    let after = module.remember(z, before, scenery, None);
    let networks = [&module.post, &module.prior];
    for (i, which) in ["post", "prior"].into_iter().enumerate() {
        let relations = networks[i].relations.forward(z, &before[i].h, None);
        checker.check(&format!("{phase}.{which}.prop_cond"), &relations, Quantity::Value);
        checker.check(&format!("{phase}.h_{which}"), &after[i].h, Quantity::Value);
        checker.check(&format!("{phase}.c_{which}"), &after[i].c, Quantity::Value);
    }
}

#[test]
fn parity_case_a_track() {
    let Some(folder) = full_record() else { return };
    let _no_grad = tch::no_grad_guard();
    let record = Record::open(&folder, "case_a_track");
    let (mut module, _store) = load(&gswm_config(), &folder, true);
    module.freeze();
    let frames = video(&folder, "video_u8");
    let background = frames.zeros_like();
    let mut checker = Checker::new(&record);
    Track { module: &module, record: &record, frames, background, discovery: &[true; 6] }
        .run(&mut checker);
    checker.finish(400);
}

#[test]
fn parity_case_b_track_given_background() {
    let Some(folder) = full_record() else { return };
    let _no_grad = tch::no_grad_guard();
    let record = Record::open(&folder, "case_b_track_given_bg");
    let mut config = gswm_config();
    config.objects.rejection = Some(0.3);
    let (module, _store) = load(&config, &folder, true);
    let mut checker = Checker::new(&record);
    Track {
        module: &module,
        record: &record,
        frames: video(&folder, "video_bg_u8"),
        background: video(&folder, "bg_u8"),
        discovery: &[true, false, true, true, false, true],
    }
    .run(&mut checker);
    checker.finish(375);
}

#[test]
fn parity_case_g_track_grid_8() {
    let Some(folder) = full_record() else { return };
    let _no_grad = tch::no_grad_guard();
    let record = Record::open(&folder, "case_g_track_g8_max12");
    let mut config = gswm_config();
    config.objects.grid = 8;
    config.objects.max_objects = 12;
    let (module, _store) = load(&config, &folder, true);
    let mut checker = Checker::new(&record);
    Track {
        module: &module,
        record: &record,
        frames: video(&folder, "video_bg_u8"),
        background: video(&folder, "bg_u8"),
        discovery: &[true; 3],
    }
    .run(&mut checker);
    checker.finish(150);
}
