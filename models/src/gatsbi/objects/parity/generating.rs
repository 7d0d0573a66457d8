//! Cases C and D: imagined steps.

use std::path::Path;

use tch::Tensor;

use super::{
    super::{
        Discover, Memory, ObjectModule, ObjectState, latents::presence, relation::gather_rows,
    },
    Checker, Quantity, Record, Recorded, committed_record, full_record, gswm_config, load, scenery,
    tracking::{check_attributes, check_latents},
    video,
};
use crate::{config::Tracking, noise::PhiloxNoise};

/// Checks one imagined step and returns the state after it.
fn check_imagined(
    checker: &mut Checker<'_>,
    module: &ObjectModule,
    before: &ObjectState,
    background: &Tensor,
    noise: &dyn crate::noise::Noise,
    t: i64,
) -> ObjectState {
    let state = module.imagine(before, background, None, noise, &Tracking::original());
    let phase = format!("t{t}.gen");
    let dyna = module.propagation.dynamics_prior(&before.prior.h);
    checker.check(&format!("{phase}.z_dyna_prior_loc"), &dyna.loc, Quantity::Value);
    checker.check(&format!("{phase}.z_dyna_prior_scale"), &dyna.scale, Quantity::Value);
    let latents = module.layout.split(&state.z);
    let attributes = module.propagation.attributes.forward(&latents.dyna);
    check_attributes(checker, &phase, &attributes);
    check_latents(checker, &phase, &latents);
    let crop = module.surroundings.crop(background, &latents.place);
    checker.check(&format!("{phase}.bg_glimpse"), &crop, Quantity::Image);
    let recorded_place = checker.record.get(&format!("{phase}.z_where"));
    let environment = module.surroundings.environment(background, recorded_place);
    checker.check(&format!("{phase}.bg_enc"), &environment, Quantity::Value);
    let relations = module.prior.relations.forward(&state.z, &before.prior.h, None);
    checker.check(&format!("{phase}.prior.prop_cond"), &relations, Quantity::Value);
    checker.check(&format!("{phase}.h_prior"), &state.prior.h, Quantity::Value);
    checker.check(&format!("{phase}.c_prior"), &state.prior.c, Quantity::Value);
    let rendering = module.render(&state.z);
    let phase = format!("t{t}.render");
    checker.check(&format!("{phase}.fg"), &rendering.foreground, Quantity::Image);
    checker.check(&format!("{phase}.alpha_map"), &rendering.alpha, Quantity::Image);
    checker.check(&format!("{phase}.recon"), &rendering.over(background), Quantity::Image);
    state
}

/// The state at the end of case B, as far as imagining reads it.
fn end_of_case_b(module: &ObjectModule, record: &Record) -> ObjectState {
    let parts = ["z_pres", "z_depth", "z_where", "z_what", "z_dyna"];
    let z = Tensor::cat(&parts.map(|part| record.at(&format!("log.{part}"), 5)), -1);
    let stored = |name: &str| record.get(&format!("t5.comb.{name}")).shallow_clone();
    let prior = Memory { h: stored("h_prior"), c: stored("c_prior") };
    ObjectState { z, prior, ..module.initial_state(2) }
}

/// Case D: five steps from the end of case B over the given backgrounds.
fn check_rollout(folder: &Path, file: &str, all: bool, minimum: usize) {
    let _no_grad = tch::no_grad_guard();
    let record = Record::open(folder, file);
    let (mut module, _store) = load(&gswm_config(), folder, all);
    module.freeze();
    let background = video(folder, "bg_u8");
    let mut state = end_of_case_b(&module, &Record::open(folder, "case_b_track_given_bg"));
    let mut checker = Checker::new(&record);
    for t in 6..11 {
        let noise = Recorded::new(&record, t, "gen");
        let background = background.select(1, t);
        state = check_imagined(&mut checker, &module, &state, &background, &noise, t);
    }
    checker.finish(minimum);
}

#[test]
fn parity_case_c_generate_mean() {
    let Some(folder) = full_record() else { return };
    let _no_grad = tch::no_grad_guard();
    let record = Record::open(&folder, "case_c_generate_mean");
    let (module, _store) = load(&gswm_config(), &folder, true);
    let frames = video(&folder, "video_u8");
    let mut checker = Checker::new(&record);
    let mut state = module.initial_state(2);
    for t in 0..11 {
        let frame = frames.select(1, t);
        let background = frame.zeros_like();
        if t < 6 {
            let noise = Recorded::new(&record, t, "prop");
            let scenery = scenery(&frame, &background);
            let discover = if t == 0 { Discover::All } else { Discover::None };
            let tracking = Tracking::original();
            state = module.observe(&state, &scenery, discover, &noise, &tracking, false).0;
        } else {
            let noise = PhiloxNoise::mean(2, tch::Device::Cpu);
            state = check_imagined(&mut checker, &module, &state, &background, &noise, t);
            state = sorted(state);
        }
        let latents = module.layout.split(&state.z);
        for (name, actual) in [
            ("z_pres", &latents.pres),
            ("z_depth", &latents.depth),
            ("z_where", &latents.place),
            ("z_what", &latents.what),
            ("z_dyna", &latents.dyna),
        ] {
            let expected = record.at(&format!("log.{name}"), t);
            checker.compare(&format!("t{t} log.{name}"), actual, &expected, Quantity::Value);
        }
        checker.check_ids(&format!("t{t} ids"), &state.ids, &record.at("log.ids", t));
        checker.check(&format!("t{t}.comb.h_prior"), &state.prior.h, Quantity::Value);
        checker.check(&format!("t{t}.comb.c_prior"), &state.prior.c, Quantity::Value);
        let rendering = module.render(&state.z);
        let log = |name: &str| record.at(&format!("log.{name}"), t);
        checker.compare("log.fg", &rendering.foreground, &log("fg"), Quantity::Image);
        checker.compare("log.alpha_map", &rendering.alpha, &log("alpha_map"), Quantity::Image);
    }
    checker.finish(150);
}

/// The official procedure sorts by presence after imagined steps too.
fn sorted(state: ObjectState) -> ObjectState {
    let (_, order) = presence(&state.z).squeeze_dim(-1).sort_stable(true, 1, true);
    let pick = |x: &Tensor| gather_rows(x, &order);
    let memory = |memory: &Memory| Memory { h: pick(&memory.h), c: pick(&memory.c) };
    ObjectState {
        z: pick(&state.z),
        post: memory(&state.post),
        prior: memory(&state.prior),
        ids: state.ids.gather(1, &order, false),
        next_id: state.next_id,
    }
}

#[test]
fn parity_case_d_rollout_mean() {
    let Some(folder) = full_record() else { return };
    check_rollout(&folder, "case_d_rollout_mean", true, 100);
}

#[test]
fn parity_case_d_rollout_sample() {
    let Some(folder) = full_record() else { return };
    check_rollout(&folder, "case_d_rollout_sample", true, 100);
}

#[test]
fn parity_committed_case_d_rollout_mean() {
    check_rollout(&committed_record(), "case_d_rollout_mean", false, 100);
}

#[test]
fn mean_noise_is_what_the_record_lacks() {
    let noise = PhiloxNoise::mean(2, tch::Device::Cpu);
    let drawn = crate::noise::Noise::normal(&noise, crate::noise::Site::Depth, &[2, 3, 1]);
    assert_eq!(drawn.count_nonzero(None::<i64>).int64_value(&[]), 0);
}
