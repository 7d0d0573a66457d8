//! The bundled checkpoint follows objects whose boxes lie beside them.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

use std::path::Path;

use gatsbi_episodes::Dataset;
use gatsbi_models::{
    checkpoint::Checkpoint,
    gatsbi::{
        model::{GradientStops, Observing},
        objects::Discover,
    },
    noise::PhiloxNoise,
};
use gatsbi_training::clips::Clips;
use tch::{Device, Kind, Tensor};

/// How far boxes are moved, in pixels to the right and up: an object's side is five to seven.
const JOLT: [f32; 2] = [3.0, -2.0];

#[test]
fn an_object_beside_its_box_is_caught_in_the_next_frame() {
    let _no_grad = tch::no_grad_guard();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let checkpoint = root.join("models/checkpoints/push1-tiny.safetensors");
    let model = Checkpoint::load(&checkpoint, Device::Cpu).unwrap().model;
    let sample = Dataset::open(root.join("episodes/samples/push1-heldout.parquet")).unwrap();
    let clips = Clips::read(&sample, 0..2).unwrap();
    let batch = clips.beginnings(0..2, 5, Device::Cpu);
    let (noise, tracking) = (PhiloxNoise::mean(2, Device::Cpu), model.config().tracking);
    let half_side = model.config().image_size as f32 / 2.0;

    let mut state = model.initial_state(2);
    let (mut moved, mut left) = (0, Vec::new());
    for (frame, action) in batch.frames.iter().zip(&batch.actions) {
        let before = state.shallow_clone();
        let how = Observing {
            train: false,
            priors: false,
            objects: true,
            discover: Discover::All,
            tracking,
            stops: GradientStops::default(),
        };
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
