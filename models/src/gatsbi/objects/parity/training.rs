//! Case E: the training loss and its gradients.

use tch::{Kind, Tensor};

use super::{
    super::Discover, Checker, Quantity, Record, Recorded, full_record, gswm_config, load, scenery,
    video,
};
use crate::{
    config::Tracking,
    nn::{ParamKind, distributions::normal_log_density},
};

/// The bias behind a softmax: its gradient is zero but for rounding.
const ZERO_GRADIENT: [&str; 2] =
    ["prop_cond_weights_post.layers.2.bias", "prop_cond_weights_prior.layers.2.bias"];

#[test]
fn parity_case_e_train_gradients() {
    let Some(folder) = full_record() else { return };
    let record = Record::open(&folder, "case_e_train_grad");
    let config = gswm_config();
    let (module, store) = load(&config, &folder, true);
    let frames = video(&folder, "video_u8");
    let mut checker = Checker::new(&record);

    let mut state = module.initial_state(2);
    let mut elbo = Tensor::zeros([2], (Kind::Float, tch::Device::Cpu));
    for t in 0..3 {
        let frame = frames.select(1, t);
        let background = frame.zeros_like();
        let noise = Recorded::new(&record, t, "prop");
        let discover = if t == 1 { Discover::None } else { Discover::All };
        let scenery = scenery(&frame, &background);
        let (next, step) =
            module.observe(&state, &scenery, discover, &noise, &Tracking::original(), true);
        let kl = step.kl(&config.objects.prior, true).total();
        let image = module.render(&next.z).over(&background);
        let density = normal_log_density(&frame, &image, 0.2).flatten(1, -1);
        elbo = elbo + density.sum_dim_intlist(1, false, Kind::Float) - kl;
        state = next;
    }
    let loss = -elbo.mean(Kind::Float);
    checker.check("log.loss", &loss, Quantity::Information);
    loss.backward();

    let mut total = 0.0;
    for (name, kind, tensor) in store.iter() {
        // The record knows the stem by its second name.
        let name =
            if name == "img_encoder.enc.0.weight" { "img_encoder.conv1.weight" } else { name };
        let recorded = format!("fg_module.{name}");
        if kind == ParamKind::Buffer {
            checker.check(&format!("buffer_after.{recorded}"), tensor, Quantity::Value);
            continue;
        }
        let gradient = tensor.grad();
        if ZERO_GRADIENT.contains(&name) {
            assert!(
                gradient.abs().max().double_value(&[]) < 1e-4,
                "{name} should have no gradient"
            );
            continue;
        }
        let norm = gradient.norm();
        let expected = record.get(&format!("gradnorm.{recorded}"));
        checker.compare(&format!("gradient norm of {name}"), &norm, expected, Quantity::Gradient);
        total += norm.square().double_value(&[]);
        if let Some(expected) = record.find(&format!("grad.{recorded}")) {
            // Element by element, relative to one to three times the largest of the tensor.
            let scale = expected.abs().max();
            checker.compare(
                &format!("gradient of {name}"),
                &(&gradient / &scale + 2.0),
                &(expected / &scale + 2.0),
                Quantity::Gradient,
            );
        }
    }
    let total = Tensor::from(total.sqrt() as f32);
    checker.check("gradnorm_total", &total, Quantity::Gradient);
    checker.finish(230);
}
