//! The bundled checkpoints do what their cards say: `push1-tiny` follows objects whose boxes lie beside them, and its beliefs
//! stay sound; `balls-tiny` finds and foresees balls.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

use std::path::Path;

use gatsbi_episodes::Dataset;
use gatsbi_models::{
    checkpoint::Checkpoint,
    gatsbi::{model::Observing, world::GatsbiWorld},
    noise::PhiloxNoise,
    scene::{Output, Outputs},
    world_model::WorldModel as _,
};
use gatsbi_training::{
    clips::Clips,
    evaluation::report::{Protocol, report},
};
use tch::{Device, Kind, Tensor};

/// How far boxes are moved, in pixels to the right and up: an object's side is five to seven.
const JOLT: [f32; 2] = [3.0, -2.0];

fn bundled(name: &str) -> Checkpoint {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/checkpoints");
    Checkpoint::load(&folder.join(format!("{name}.safetensors")), Device::Cpu).unwrap()
}

fn sample(name: &str) -> Dataset {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../episodes/samples");
    Dataset::open(folder.join(format!("{name}-heldout.parquet"))).unwrap()
}

fn heldout() -> Clips {
    let actions = bundled("push1-tiny").header.actions;
    Clips::read(&sample("push1"), 0..2, Some(&actions)).unwrap()
}

#[test]
fn a_belief_of_hundreds_of_frames_is_as_good_as_one_of_forty() {
    let world = GatsbiWorld::new(bundled("push1-tiny"));
    let clips = heldout();
    let length = clips.shortest();
    let batch = clips.beginnings(0..2, length, Device::Cpu);
    let rest = Tensor::from_slice(&world.spec().neutral_action());
    let rest = rest.unsqueeze(0).expand([2, -1], true);
    let noise = PhiloxNoise::mean(2, Device::Cpu);
    let wanted = Outputs::from_iter([Output::Frame, Output::Latents]);
    let mut state = world.initial_state(2);
    let mut errors = Vec::new();
    // There and back, so that each frame follows from the one before.
    let there: Vec<i64> = (0..length - 1).collect();
    let back: Vec<i64> = (1..length).rev().collect();
    for t in there.iter().chain(&back).cycle().take(400) {
        let frame = &batch.frames[*t as usize];
        let (next, scene) = world.observe(&state, Some(frame), &rest, &noise, wanted);
        state = next;
        let largest = scene.latents.unwrap().abs().max().double_value(&[]);
        assert!(largest < 100.0, "a latent is {largest} after {} frames", errors.len() + 1);
        errors.push((scene.frame.unwrap() - frame).square().mean(Kind::Float).double_value(&[]));
    }
    let mean = |errors: &[f64]| errors.iter().sum::<f64>() / errors.len() as f64;
    let (early, late) = (mean(&errors[..40]), mean(&errors[300..]));
    assert!(late < 1.6 * early, "the squared error grew from {early} to {late}");
}

#[test]
fn an_object_beside_its_box_is_caught_in_the_next_frame() {
    let _no_grad = tch::no_grad_guard();
    let (model, clips) = (bundled("push1-tiny").model, heldout());
    let batch = clips.beginnings(0..2, 5, Device::Cpu);
    let (noise, tracking) = (PhiloxNoise::mean(2, Device::Cpu), model.config().tracking);
    let half_side = model.config().image_size as f32 / 2.0;

    let mut state = model.initial_state(2);
    let (mut moved, mut left) = (0, Vec::new());
    for (frame, action) in batch.frames.iter().zip(&batch.actions) {
        let before = state.shallow_clone();
        let how = Observing::serving(tracking);
        let (after, seen) = model.observe(state, frame, action, &noise, how);
        state = after;
        let jolts = Tensor::from_slice(&JOLT.map(|pixels| pixels / half_side));
        let jolts = jolts.view([1, 1, 2]).expand([2, before.objects.z.size()[1], 2], false);
        let places = |z: &Tensor| model.objects().latents(z).place.narrow(-1, 2, 2);
        let [kept, caught] = [jolts.zeros_like(), jolts].map(|jolts| {
            let objects = before.objects.jolted(&jolts);
            let off = (places(&objects.z) - places(&before.objects.z) - &jolts).abs().max();
            assert!(off.double_value(&[]) < 1e-6, "boxes were not moved as told: {off}");
            let mixtures = (&before.mixture, &state.mixture);
            let step = (frame, action);
            model.follow(&objects, mixtures, &seen.mixture, step, &noise, &tracking)
        });
        // Both are in the order of presence, so objects are found again by their identities.
        let same = kept.ids.unsqueeze(2).eq_tensor(&caught.ids.unsqueeze(1));
        let apart = places(&kept.z).unsqueeze(2) - places(&caught.z).unsqueeze(1);
        let apart = apart.square().sum_dim_intlist(-1, false, Kind::Float).sqrt();
        let present = |z: &Tensor| model.objects().latents(z).pres.gt(0.5).squeeze_dim(-1);
        let both = present(&kept.z).unsqueeze(2).logical_and(&present(&caught.z).unsqueeze(1));
        let pairs = apart.masked_select(&same.logical_and(&both)) * f64::from(half_side);
        moved += present(&before.objects.z).sum(Kind::Int64).int64_value(&[]);
        left.extend(Vec::<f32>::try_from(pairs).unwrap());
    }
    assert!(left.len() as i64 * 10 >= moved * 8, "{} of {moved} are still followed", left.len());
    left.sort_by(f32::total_cmp);
    let median = left[left.len() / 2];
    assert!(median < 1.2, "boxes moved by 3.6 pixels are still {median} off: {left:?}");
}

#[test]
fn balls_are_found_and_foreseen() {
    let world = GatsbiWorld::new(bundled("balls-tiny"));
    let protocol = Protocol { horizon: 15, samples: 0, perceptual: None };
    let numbers = report(&world, &sample("balls6"), 0..1, protocol, |_| {}).unwrap().numbers;
    for name in ["object_recall", "object_precision"] {
        assert!(numbers[name] > 0.8, "{name} is {}", numbers[name]);
    }
    let gain = numbers["psnr_gain_over_copy_db"];
    assert!(gain > 1.0, "imagination is {gain} dB better than the last frame");
}

#[test]
fn an_arm_that_strikes_balls_is_foreseen_and_resting_balls_are_found() {
    let world = GatsbiWorld::new(bundled("roll-tiny"));
    let protocol = Protocol { horizon: 15, samples: 0, perceptual: None };
    let numbers = report(&world, &sample("roll"), 0..2, protocol, |_| {}).unwrap().numbers;
    for (name, least) in [
        ("agent_iou_observed", 0.6),
        ("agent_iou_imagined", 0.5),
        ("object_precision", 0.8),
        ("psnr_gain_over_copy_db", 2.0),
    ] {
        assert!(numbers[name] > least, "{name} is {}", numbers[name]);
    }
}
