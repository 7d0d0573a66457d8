//! The whole model through its public surface: contract, checkpoints, sizes and costs.

use gatsbi_models::{
    checkpoint::{
        AgentSlot, Checkpoint, CheckpointError, FirstAction, Header, Precision, Provenance,
    },
    config::{GatsbiConfig, Graph, Interaction, KnnAggregate, KnnMetric, Tracking, presets},
    gatsbi::{
        loss,
        model::{Gatsbi, GradientStops, Observing},
        objects::Discover,
        world::GatsbiWorld,
    },
    idle::asking_for,
    nn::count_macs,
    noise::{PhiloxNoise, RowNoise},
    scene::{Output, Outputs},
    state::State,
    world_model::{ActionDimension, Preprocess, WorldModel},
};
use tch::{Device, Kind, Tensor};

fn header(config: GatsbiConfig) -> Header {
    let agent = config.objects.interaction != Interaction::Inter1;
    Header {
        name: "untrained".to_owned(),
        agent_slot: agent.then_some(AgentSlot { index: 0, score: None }),
        actions: (0..config.action.dim)
            .map(|i| ActionDimension {
                name: format!("joint {i}"),
                unit: "rad/s".to_owned(),
                offset: 0.0,
                scale: 0.5,
            })
            .collect(),
        preprocess: Preprocess::Stretch,
        frame_period: Some(0.2),
        first_action: FirstAction::Neutral,
        provenance: Provenance { seed: 5, ..Provenance::default() },
        model: config,
    }
}

fn world(config: GatsbiConfig) -> GatsbiWorld {
    GatsbiWorld::new(Checkpoint::untrained(header(config), Device::Cpu))
}

fn wave(shape: &[i64], phase: f64) -> Tensor {
    let count = shape.iter().product::<i64>();
    let line = Tensor::arange(count, (Kind::Float, Device::Cpu));
    ((line * 0.013 + phase).sin() * 0.5 + 0.5).view(shape)
}

fn samples(rows: &[(u64, u64)]) -> PhiloxNoise {
    let rows =
        rows.iter().map(|&(seed, step)| RowNoise::Sample { seed, sample: 0, step }).collect();
    PhiloxNoise::new(rows, Device::Cpu)
}

fn largest_difference(a: &Tensor, b: &Tensor) -> f64 {
    (a - b).abs().max().double_value(&[])
}

/// Observes two frames, then imagines one step.
fn run(world: &GatsbiWorld, rows: &[(f64, u64)]) -> (State, Tensor) {
    let batch = rows.len() as i64;
    let everything = Outputs::from_iter(Output::ALL);
    let mut state = world.initial_state(batch);
    for t in 0..2u64 {
        let frames: Vec<Tensor> =
            rows.iter().map(|(phase, _)| wave(&[3, 64, 64], phase + t as f64)).collect();
        let actions: Vec<Tensor> =
            rows.iter().map(|(phase, _)| wave(&[7], phase * 3.0 + t as f64)).collect();
        let noise = samples(&rows.iter().map(|&(_, seed)| (seed, t)).collect::<Vec<_>>());
        let (frame, action) = (Tensor::stack(&frames, 0), Tensor::stack(&actions, 0));
        state = world.observe(&state, Some(&frame), &action, &noise, everything).0;
    }
    let noise = samples(&rows.iter().map(|&(_, seed)| (seed, 2)).collect::<Vec<_>>());
    let actions: Vec<Tensor> = rows.iter().map(|(phase, _)| wave(&[7], *phase)).collect();
    let (state, scene) = world.imagine(&state, &Tensor::stack(&actions, 0), &noise, everything);
    (state, scene.frame.expect("the frame was asked for"))
}

#[test]
fn rows_do_not_depend_on_each_other() {
    let world = world(presets::tiny());
    let (together, frames) = run(&world, &[(0.0, 1), (0.7, 2), (1.9, 3)]);
    let (alone, frame) = run(&world, &[(0.7, 2)]);
    let floats = largest_difference(&together.floats.get(1), &alone.floats.get(0));
    assert!(floats < 1e-4, "{floats}");
    assert_eq!(together.ints.get(1), alone.ints.get(0));
    assert!(largest_difference(&frames.get(1), &frame.get(0)) < 1e-4);
}

#[test]
fn what_was_computed_before_changes_nothing() {
    tch::set_num_threads(1);
    for config in [presets::tiny(), presets::push1()] {
        let world = world(config);
        let _no_grad = tch::no_grad_guard();
        let rows = [(0.0, 1), (0.7, 2), (1.9, 3)];
        let (fresh, _) = run(&world, &rows);
        let _one = run(&world, &rows[..1]);
        assert_eq!(run(&world, &rows).0.floats, fresh.floats);
    }
}

#[test]
fn rows_that_nobody_asks_for_change_no_other() {
    // libtorch's products of matrices are the same bytes for the same number of threads.
    tch::set_num_threads(1);
    for config in [presets::tiny(), presets::push1()] {
        let world = world(config);
        let _no_grad = tch::no_grad_guard();
        let rows = [(0.7, 2), (0.7, 2), (1.9, 3), (0.7, 2), (2.3, 4)];
        let ((all, frames), macs) = count_macs(|| run(&world, &rows));
        let asked = [false, true, true, false, true];
        let ((some, less), fewer) = count_macs(|| asking_for(&asked, || run(&world, &rows)));
        assert!(fewer < macs * 8 / 10, "{fewer} of {macs}");
        for row in [1, 2, 4] {
            for (all, some) in
                [(&all.floats, &some.floats), (&all.ints, &some.ints), (&frames, &less)]
            {
                assert_eq!(all.get(row), some.get(row));
            }
        }
    }
}

#[test]
fn shares_of_the_image_sum_to_one() {
    let world = world(presets::tiny());
    let wanted = Outputs::from_iter([Output::SlotMasks, Output::ObjectMasks]);
    let frame = wave(&[2, 3, 64, 64], 0.3);
    let action = Tensor::zeros([2, 7], (Kind::Float, Device::Cpu));
    let noise = samples(&[(1, 0), (2, 0)]);
    let (_, scene) = world.observe(&world.initial_state(2), Some(&frame), &action, &noise, wanted);
    assert!(scene.frame.is_none() && scene.objects.is_none(), "only what was asked for");
    let total = scene.slot_masks.unwrap().sum_dim_intlist(1, false, Kind::Float)
        + scene.object_masks.unwrap().sum_dim_intlist(1, false, Kind::Float);
    assert!((total - 1.0).abs().max().double_value(&[]) < 1e-5);
}

#[test]
fn imagining_leaves_no_trace_and_a_missing_frame_is_passed_over() {
    let world = world(presets::tiny());
    let (state, _) = run(&world, &[(0.2, 1), (0.4, 9)]);
    let before = state.to_rows();
    let action = wave(&[2, 7], 0.0);
    let noise = PhiloxNoise::mean(2, Device::Cpu);
    let objects = Outputs::from_iter([Output::Objects]);
    let (imagined, _) = world.imagine(&state, &action, &noise, objects);
    let (skipped, _) = world.observe(&state, None, &action, &noise, objects);
    assert_eq!(before, state.to_rows());
    let fields = world.layout().fields();
    let mut start = 0;
    for field in fields.iter().filter(|field| field.name != "step") {
        let width = field.shape.iter().product::<i64>();
        if field.kind == gatsbi_models::state::FieldKind::Float {
            let part = |state: &State| state.floats.narrow(1, start, width);
            let same = largest_difference(&part(&imagined), &part(&skipped)) < 1e-6;
            let posterior = field.name.contains("post");
            assert_eq!(same, !posterior, "{}", field.name);
            start += width;
        }
    }
}

#[test]
fn state_rows_survive_the_host() {
    let world = world(presets::tiny());
    let (state, _) = run(&world, &[(0.0, 1), (0.7, 2)]);
    let rows = state.to_rows();
    let back = State::from_rows(&rows, Device::Cpu);
    assert_eq!(back.floats, state.floats);
    assert_eq!(back.ints, state.ints);
    assert_eq!(rows[0].floats.len() as i64, world.layout().floats());
    assert!(world.layout().row_bytes() < 65_536);
    let swapped = state.gather(&Tensor::from_slice(&[1i64, 0])).to_rows();
    assert_eq!((&swapped[0], &swapped[1]), (&rows[1], &rows[0]));
}

#[test]
fn identities_last_and_never_repeat() {
    let world = world(presets::tiny());
    let action = Tensor::zeros([1, 7], (Kind::Float, Device::Cpu));
    let mut state = world.initial_state(1);
    let mut seen = std::collections::BTreeMap::new();
    for t in 0..6u64 {
        let frame = wave(&[1, 3, 64, 64], t as f64 * 2.1);
        let wanted = Outputs::from_iter([Output::Objects]);
        let (next, scene) =
            world.observe(&state, Some(&frame), &action, &samples(&[(4, t)]), wanted);
        let ids: Vec<i64> = scene.objects.unwrap().ids.view(-1).try_into().unwrap();
        let unique: std::collections::BTreeSet<i64> = ids.iter().copied().collect();
        assert_eq!(unique.len(), ids.len(), "an identity appears twice in a frame");
        for id in ids {
            let last: &mut u64 = seen.entry(id).or_insert(t);
            assert!(*last + 1 >= t, "identity {id} came back");
            *last = t;
        }
        state = next;
    }
    assert!(seen.len() > 7, "the example should lose and find objects");
}

#[test]
fn freezing_changes_nothing() {
    for config in [presets::tiny(), presets::push1(), inter2()] {
        let frozen = world(config.clone());
        let plain = Checkpoint::untrained(header(config), Device::Cpu).model;
        let _no_grad = tch::no_grad_guard();
        let frame = wave(&[2, 3, 64, 64], 0.1);
        let action = wave(&[2, 7], 0.4);
        let noise = samples(&[(1, 0), (2, 0)]);
        let wanted = Outputs::from_iter([Output::Frame, Output::Latents]);
        let (state, scene) =
            frozen.observe(&frozen.initial_state(2), Some(&frame), &action, &noise, wanted);
        let how = Observing {
            train: false,
            priors: false,
            objects: true,
            discover: Discover::All,
            tracking: Tracking::serving(),
            stops: GradientStops::default(),
        };
        let scaled = action / 0.5;
        let (plain_state, step) =
            plain.observe(plain.initial_state(2), &frame, &scaled, &noise, how);
        let image = plain.render(&plain_state).over(&step.mixture.mu_mix);
        assert!(largest_difference(&image, &scene.frame.unwrap()) < 1e-4);
        drop(state);
    }
}

fn inter2() -> GatsbiConfig {
    let mut config = presets::tiny();
    config.objects.interaction = Interaction::Inter2 { outputs: 32, celu: true };
    config.objects.graph =
        Graph::Knn { k: 2, metric: KnnMetric::Weight, aggregate: KnnAggregate::Sum };
    config
}

#[test]
fn gradients_reach_every_parameter() {
    for config in [presets::tiny(), inter2()] {
        let (model, store) = Gatsbi::untrained(&config, Some(0), 3, Device::Cpu);
        let mut state = model.initial_state(2);
        let mut total = Tensor::from(0.0f32);
        for t in 0..3u64 {
            let frame = wave(&[2, 3, 64, 64], t as f64);
            let action = wave(&[2, 7], t as f64 + 0.5);
            let first = state.first();
            let how = Observing {
                train: true,
                priors: true,
                objects: true,
                discover: Discover::All,
                tracking: Tracking::original(),
                stops: GradientStops { agent: false, ..GradientStops::default() },
            };
            let noise = samples(&[(1, t), (2, t)]);
            let (next, step) = model.observe(state, &frame, &action, &noise, how);
            let rendering = model.render(&next);
            let image = rendering.over(&step.mixture.mu_mix);
            let (masks, comps) = loss::mixture_kl(&step.mixture);
            let objects = step.objects.as_ref().unwrap();
            let objects = objects.kl(&config.objects.prior, true).total();
            let keypoints = model.detector().unwrap().forward(&frame);
            let gamma = model.detector().unwrap().gamma(&keypoints);
            let agent = step.mixture.log_masks.select(1, 0).exp();
            total = total - loss::gaussian_log_likelihood(&frame, &image, 0.1)
                + masks
                + comps
                + objects
                + loss::residual_norm(&step.mixture, &first)
                + loss::keypoint_regression(&gamma, &agent);
            state = next;
        }
        total.mean(Kind::Float).backward();
        for (name, parameter) in store.trainable() {
            let gradient = parameter.grad();
            // A hard choice of neighbours by weight passes no gradient to what weighs them.
            if config == inter2() && name.contains("prop_cond_weights") {
                continue;
            }
            assert!(gradient.defined(), "{name} gets no gradient");
            assert_eq!(gradient.isfinite().all().int64_value(&[]), 1, "{name}");
        }
    }
}

#[test]
fn balls_need_no_agent() {
    let world = world(presets::balls());
    let frame = wave(&[1, 3, 64, 64], 0.1);
    let action = Tensor::zeros([1, 0], (Kind::Float, Device::Cpu));
    let noise = PhiloxNoise::mean(1, Device::Cpu);
    let wanted = Outputs::from_iter([Output::Frame, Output::AgentMask, Output::Background]);
    let (state, scene) =
        world.observe(&world.initial_state(1), Some(&frame), &action, &noise, wanted);
    assert!(scene.agent_mask.is_none() && scene.background.is_some());
    let (_, scene) = world.imagine(&state, &action, &noise, wanted);
    assert_eq!(scene.frame.unwrap().isfinite().all().int64_value(&[]), 1);
}

#[test]
fn checkpoints_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    let original = Checkpoint::untrained(header(presets::tiny()), Device::Cpu);
    for (precision, tolerance) in [(Precision::Single, 0.0), (Precision::Half, 2e-3)] {
        let path = folder.path().join("model.safetensors");
        original.save(&path, precision).unwrap();
        let loaded = Checkpoint::load(&path, Device::Cpu).unwrap();
        assert_eq!(loaded.header, original.header);
        assert_eq!(loaded.hash.len(), 64);
        loaded.save(&path, precision).unwrap();
        let again = Checkpoint::load(&path, Device::Cpu).unwrap();
        assert_eq!(again.hash, loaded.hash, "the same weights are the same file");
        for (name, _, tensor) in original.store.iter() {
            let difference = largest_difference(tensor, loaded.store.get(name).unwrap());
            assert!(difference <= tolerance, "{name} {difference}");
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file stays");
    }
}

#[test]
fn bad_checkpoints_are_refused_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    Checkpoint::untrained(header(presets::tiny()), Device::Cpu)
        .save(&path, Precision::Half)
        .unwrap();
    let good = std::fs::read(&path).unwrap();
    let check = |bytes: &[u8], expected: fn(&CheckpointError) -> bool| {
        std::fs::write(&path, bytes).unwrap();
        let error = Checkpoint::load(&path, Device::Cpu).unwrap_err();
        assert!(expected(&error), "{error:?}");
        assert!(error.to_string().contains("model.safetensors"), "{error}");
    };
    let replace = |from: &str, to: &str| {
        assert_eq!(from.len(), to.len());
        let at = good.windows(from.len()).position(|window| window == from.as_bytes()).unwrap();
        let mut bytes = good.clone();
        bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
        bytes
    };
    check(&good[..good.len() - 9], |e| matches!(e, CheckpointError::Damaged { .. }));
    check(&good[..40], |e| matches!(e, CheckpointError::Damaged { .. }));
    check(b"not a checkpoint at all", |e| matches!(e, CheckpointError::Damaged { .. }));
    check(
        &replace("gatsbi.checkpoint\":\"1\"", "gatsbi.checkpoint\":\"9\""),
        |e| matches!(e, CheckpointError::Newer { found, .. } if found == "9"),
    );
    check(&replace("gatsbi.checkpoint", "somebody.elses.it"), |e| {
        matches!(e, CheckpointError::Foreign { .. })
    });
    check(&replace("preprocess", "preprocezz"), |e| matches!(e, CheckpointError::Header { .. }));
    check(&replace("\\\"z_dyna\\\":64", "\\\"z_dyna\\\":48"), |e| {
        matches!(e, CheckpointError::Shape { found, expected, .. }
            if found.len() == expected.len())
    });
    check(
        &replace("\\\"slots\\\":3", "\\\"slots\\\":0"),
        |e| matches!(e, CheckpointError::Config { problems, .. } if problems.contains("slots")),
    );
    check(
        &replace("\"objects.h_init_post\"", "\"objects.h_init_pist\""),
        |e| matches!(e, CheckpointError::Missing { name, .. } if name == "objects.h_init_post"),
    );
    let mut infinite = good.clone();
    let end = infinite.len();
    infinite[end - 2..].copy_from_slice(&[0x00, 0x7c]); // half-precision infinity
    check(&infinite, |e| matches!(e, CheckpointError::NotFinite { .. }));
    std::fs::remove_file(&path).unwrap();
    let error = Checkpoint::load(&path, Device::Cpu).unwrap_err();
    assert!(matches!(error, CheckpointError::Read { .. }));
}

/// Multiply-accumulates in millions of one observed and one imagined step at batch 1.
fn cost(config: &GatsbiConfig) -> [f64; 2] {
    let world = world(config.clone());
    let dim = config.action.dim;
    let action = Tensor::zeros([1, dim], (Kind::Float, Device::Cpu));
    let frame = wave(&[1, 3, 64, 64], 0.1);
    let noise = PhiloxNoise::mean(1, Device::Cpu);
    let wanted = Outputs::from_iter([Output::Frame]);
    let ((state, _), observed) = count_macs(|| {
        world.observe(&world.initial_state(1), Some(&frame), &action, &noise, wanted)
    });
    let (_, imagined) = count_macs(|| world.imagine(&state, &action, &noise, wanted));
    [observed, imagined].map(|macs| macs as f64 / 1e6)
}

#[test]
fn sizes_and_costs_of_the_presets() {
    println!("preset   mixture    objects  detector   observed  imagined (MMAC)");
    for name in presets::NAMES {
        let config = presets::preset(name).unwrap();
        let checkpoint = Checkpoint::untrained(header(config.clone()), Device::Cpu);
        let count = |prefix: &str| -> usize {
            let trainable = checkpoint.store.trainable();
            trainable.filter(|(name, _)| name.starts_with(prefix)).map(|(_, t)| t.numel()).sum()
        };
        let mixture = count("mixture.") + count("action.");
        let (objects, detector) = (count("objects."), count("detector."));
        let [observed, imagined] = cost(&config);
        println!(
            "{name:<8} {mixture:>8} {objects:>9} {detector:>9} {observed:>10.1} {imagined:>9.1}"
        );
        match name {
            // Mixture spec 2.5, object spec 2.12 without the unused constants, mixture spec 2.6.
            "push1" => {
                assert_eq!(mixture, 8_130_820);
                assert!((480_000..490_000).contains(&detector));
            }
            "tiny" => {
                assert!(mixture + objects + detector <= 3_000_000);
                assert!(observed < 60.0 && imagined < 35.0);
            }
            _ => {}
        }
    }
}
