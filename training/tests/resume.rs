//! A run that is stopped and resumed gives the numbers of one that was not.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

use std::path::Path;

use gatsbi_episodes::Dataset;
use gatsbi_models::checkpoint::{Checkpoint, Header};
use gatsbi_training::{clips::Clips, recipe::Recipe, trainer::Trainer};
use tch::{Device, Tensor};

const STEPS: u64 = 6;

/// Every stage in six steps: background prefit, remembered dynamics, mixture, objects alone, all together, with keypoints.
const RECIPE: &str = r#"
name = "resumed"
model = "tiny"
steps = 6
batch = 2
length = [[0, 2], [5, 3]]
learning_rate = [[0, 1e-3], [4, 5e-4]]
clip = 1.0
picture_every = 0
save_every = 2
prefit = { steps = 2, learning_rate = 1e-3 }

[dynamics]
until = 2
batch = 3
length = [[0, 3]]
place = 1.0
what = 1.0
kl = 0.1

[mixture]
start = 0
sigma = 0.1
likelihood = [[0, 1.0], [4, 0.5]]
kl = [[2, 0.0], [6, 1.0]]
residual = 0.01
noise = 1.0

[objects]
start = 3
alone_until = 4
rate = 2.0
scale_bounds = [0.04, 0.3]
sigma = 0.1
composite = 1.0
joint = 0.5
kl = 1.0
discovery_dropout = 0.5
scale_mean = -2.0

[regression]
keypoints = 1.0
motion = 1.0
foreground = 1.0
objects = 1.0

[keypoints]
end = 5
separation = 20.0
sparsity = 0.002
kl = 0.001
networks = { recurrent = 16, latent = 4, mlp = 16, samples = 2 }
"#;

/// The same without an agent, and so without keypoints.
fn without_agent() -> String {
    let (without_keypoints, _) = RECIPE.split_once("[keypoints]").unwrap();
    without_keypoints.replace("model = \"tiny\"", "model = \"balls-tiny\"")
}

/// What a run in `folder` that stops at each of `stops` ends with.
fn trained(
    recipe: &str,
    clips: &Clips,
    folder: &Path,
    stops: &[u64],
) -> (Header, Vec<(String, Tensor)>) {
    let recipe: Recipe = toml::from_str(recipe).unwrap();
    for &stop in stops {
        let mut trainer =
            Trainer::open(recipe.clone(), clips, "sample", 7, folder, Device::Cpu).unwrap();
        trainer.run(clips, Some(stop)).unwrap();
        assert_eq!(trainer.step(), stop);
    }
    let checkpoint = Checkpoint::load(&folder.join("checkpoint.safetensors"), Device::Cpu).unwrap();
    let weights = checkpoint.store.iter();
    let weights = weights.map(|(name, _, weight)| (name.to_owned(), weight.detach())).collect();
    (checkpoint.header, weights)
}

fn check(recipe: &str, sample: &str) {
    tch::set_num_threads(1);
    let samples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../episodes/samples");
    let dataset = Dataset::open(samples.join(sample)).unwrap();
    let clips = Clips::read(&dataset, 0..dataset.len().min(2), None).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let run = |name: &str, stops: &[u64]| trained(recipe, &clips, &folder.path().join(name), stops);
    let once = run("once", &[STEPS]);
    let resumed = run("resumed", &[1, 3, 4, STEPS]);
    assert!(once == resumed, "the resumed run ended with other weights");
    let other = run("other", &[STEPS - 1]);
    assert!(once != other, "the last step changed nothing");
}

#[test]
fn a_run_that_goes_on_from_a_checkpoint_takes_actions_as_it_does() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let dataset = Dataset::open(folder.join("../episodes/samples/push1-heldout.parquet")).unwrap();
    let from = folder.join("../models/checkpoints/push1-tiny.safetensors");
    let theirs = Checkpoint::load(&from, Device::Cpu).unwrap().header.actions;
    let recipe: Recipe = toml::from_str(RECIPE).unwrap();
    let open = |clips: &Clips, name: &str| {
        let out = tempfile::tempdir().unwrap();
        let mut trainer =
            Trainer::open(recipe.clone(), clips, name, 7, out.path(), Device::Cpu).unwrap();
        trainer.start_from(&from, |_| true)
    };
    let own = Clips::read(&dataset, 0..2, None).unwrap();
    let refused = open(&own, "own").unwrap_err().to_string();
    assert!(refused.contains("actions are not scaled as"), "{refused}");
    let told = Clips::read(&dataset, 0..2, Some(&theirs)).unwrap();
    assert_eq!(told.actions, theirs);
    open(&told, "told").unwrap();

    let mut others = theirs;
    others[0].name = "wheel".into();
    let refused = Clips::read(&dataset, 0..2, Some(&others)).unwrap_err().to_string();
    assert!(refused.contains("expected those of the checkpoint: wheel"), "{refused}");
}

#[test]
fn a_resumed_run_ends_where_an_uninterrupted_one_does() {
    check(RECIPE, "push1-heldout.parquet");
}

#[test]
fn so_does_one_in_scenes_without_an_agent() {
    check(&without_agent(), "balls6-heldout.parquet");
}
