//! A training run: prefit, steps, pictures, checkpoints; stopped and resumed at will.

use std::{
    path::{Path, PathBuf},
    time::Instant,
};

use anyhow::{Context as _, bail, ensure};
use gatsbi_models::{
    checkpoint::{self, AgentSlot, Checkpoint, Header, Precision, Provenance},
    config::{GatsbiConfig, MixtureConfig, ObjectConfig, presets},
    gatsbi::{
        keypoint::KeypointLearning,
        model::{Gatsbi, GradientStops, Observing},
        objects::Discover,
        world::GatsbiWorld,
    },
    nn::ParamStore,
    noise::PhiloxNoise,
    world_model::WorldModel as _,
};
use tch::{Device, Kind};

use crate::{
    adam::{self, Adam},
    agent_slot::Vote,
    clips::{Batch, Clips},
    dynamics::{self, Remembered},
    evaluation::{self, CONDITIONING, Draw, Recorded},
    journal::Journal,
    objective::{Moment, noise, objective, training_tracking},
    recipe::Recipe,
    saved::{self, Progress},
    untrained,
};

/// Steps in a row without a finite loss after which a run gives up.
const MAX_SKIPPED_IN_A_ROW: u64 = 5;

/// Batches whose statistics replace the running ones before a checkpoint is written for users.
const RECALIBRATION_BATCHES: u64 = 30;

/// Batches whose frames vote for the agent's slot.
const VOTING_BATCHES: u64 = 20;

/// Episodes between lines that tell how far remembering is.
const REMEMBERED_TOLD_EVERY: usize = 160;

/// Optimiser steps of the prefit draw from steps of their own, far from those of the run.
const PREFIT_STEPS: u64 = 1 << 40;

/// A run in progress.
#[derive(Debug)]
pub struct Trainer {
    recipe: Recipe,
    device: Device,
    folder: PathBuf,
    checkpoint: Checkpoint,
    learning: Option<KeypointLearning>,
    learning_store: ParamStore,
    adam: Adam,
    progress: Progress,
    /// What the run started from, if it has learned what the run has not: it then remembers what dynamics are learned from.
    seeing: Option<Gatsbi>,
    /// Names of the parameters that what the run started from has not.
    untrained: Vec<String>,
}

impl Trainer {
    /// Opens the run in `folder`: where it stopped, or from untrained weights. `data` names the data set.
    ///
    /// # Errors
    /// If the recipe names an unknown architecture, or the folder holds a run of another recipe, seed or data.
    pub fn open(
        recipe: Recipe,
        clips: &Clips,
        data: &str,
        seed: u64,
        folder: &Path,
        device: Device,
    ) -> anyhow::Result<Self> {
        fs_err::create_dir_all(folder)?;
        let mut model = presets::preset(&recipe.model)
            .with_context(|| format!("there is no architecture preset {}", recipe.model))?;
        ensure!(
            recipe.longest() <= clips.shortest() as u64,
            "the recipe's sequences have up to {} frames, the shortest episode {}",
            recipe.longest(),
            clips.shortest()
        );
        ensure!(
            recipe.dynamics.is_none() || clips.shortest() > dynamics::SHORTEST,
            "dynamics are learned from episodes of more than {} frames, the shortest has {}",
            dynamics::SHORTEST,
            clips.shortest()
        );
        model.action.dim = clips.actions.len() as i64;
        recipe.variant.apply(&mut model);
        if let Some(objects) = &recipe.objects {
            let tracking = &mut model.tracking;
            tracking.scale_bounds = objects.scale_bounds.or(tracking.scale_bounds);
            tracking.merge = objects.merge;
            tracking.unlike = objects.unlike;
            tracking.handover = objects.handover;
        }
        let mut header = untrained::header(&recipe.name, model, clips.actions.clone(), seed);
        header.frame_period = Some(clips.frame_period);
        let checkpoint = Checkpoint::untrained(header, device);
        let mut learning_store = ParamStore::new(seed, device);
        let config = checkpoint.model.config();
        let learning = match (&recipe.keypoints, &config.detector) {
            (Some(keypoints), Some(detector)) => Some(learning_store.build(|root| {
                let path = root.sub("keypoints");
                let action = config.action.enhanced;
                KeypointLearning::new(&path, detector, &keypoints.networks, action)
            })),
            (Some(_), None) => bail!("the recipe trains keypoints, {} has none", recipe.model),
            _ => None,
        };
        let mut trainer = Self {
            progress: Progress {
                step: 0,
                seed,
                seconds: 0.0,
                skipped: 0,
                recipe: recipe.clone(),
                data: data.to_owned(),
                actions: clips.actions.clone(),
            },
            recipe,
            device,
            folder: folder.to_path_buf(),
            checkpoint,
            learning,
            learning_store,
            adam: Adam::default(),
            seeing: None,
            untrained: Vec::new(),
        };
        trainer.resume()?;
        Ok(trainer)
    }

    /// Starts from the weights of a checkpoint, if the run has not begun. An architecture that differs from the checkpoint's
    /// in how objects meet each other and the agent, or in its memories, takes what both have and is `wanted`; the rest
    /// starts untrained.
    ///
    /// # Errors
    /// If the checkpoint cannot be read or its architecture differs in anything else.
    pub fn start_from(&mut self, path: &Path, wanted: impl Fn(&str) -> bool) -> anyhow::Result<()> {
        if self.progress.step > 0 {
            return Ok(());
        }
        let loaded = Checkpoint::load(path, self.device)?;
        let ours = &self.checkpoint.header.model;
        let theirs = GatsbiConfig {
            objects: ObjectConfig {
                // Neither decides what parameters there are.
                agent_feature: ours.objects.agent_feature,
                rejection: ours.objects.rejection,
                // These do.
                interaction: ours.objects.interaction,
                graph: ours.objects.graph,
                ..loaded.header.model.objects.clone()
            },
            mixture: MixtureConfig {
                one_memory: ours.mixture.one_memory,
                ..loaded.header.model.mixture.clone()
            },
            tracking: ours.tracking,
            ..loaded.header.model.clone()
        };
        ensure!(theirs == *ours, "{} has another architecture", path.display());
        ensure!(
            loaded.header.actions == self.checkpoint.header.actions,
            "the episodes' actions are not scaled as {} takes them",
            path.display()
        );
        self.recipe.prefit = None;
        let header = self.checkpoint.header.clone();
        let header = Header { agent_slot: loaded.header.agent_slot, ..header };
        self.checkpoint = Checkpoint::untrained(header, self.device);
        self.untrained = self.checkpoint.store.take(&loaded.store, wanted);
        self.seeing = (!self.untrained.is_empty()).then_some(loaded.model);
        Ok(())
    }

    /// Parameters of the model.
    pub fn parameters(&self) -> &ParamStore {
        &self.checkpoint.store
    }

    /// Steps taken.
    pub fn step(&self) -> u64 {
        self.progress.step
    }

    /// Trains up to `until` or the end of the recipe.
    ///
    /// # Errors
    /// If files cannot be written or the loss stays infinite.
    pub fn run(&mut self, clips: &Clips, until: Option<u64>) -> anyhow::Result<()> {
        let end = until.map_or(self.recipe.steps, |until| until.min(self.recipe.steps));
        let mut journal = Journal::start(&self.folder, self.progress.step, self.recipe.steps)?;
        if self.progress.step == 0 {
            journal.say(&format!("differences up to {:.3} count as shadow", clips.shadow));
            if !self.untrained.is_empty() {
                journal.say(&format!("start untrained: {}", self.untrained.join(", ")));
            }
            self.prefit(clips, &journal);
        }
        let mut skipped_in_a_row = 0;
        let mut remembered = None;
        while self.progress.step < end {
            let started = Instant::now();
            let moment = self.moment();
            if remembered.is_none() && self.recipe.dynamics_alone(moment.step).is_some() {
                remembered = Some(self.remembered(clips, &journal)?);
            }
            let stores = [&self.checkpoint.store, &self.learning_store];
            let rate = |name: &str| self.recipe.rate_of(name, moment.step);
            let (model, device) = (&self.checkpoint.model, self.device);
            let dynamics = self.recipe.dynamics_alone(moment.step);
            let (rows, length, objective) =
                if let Some((recipe, remembered)) = dynamics.zip(remembered.as_ref()) {
                    adam::select(&stores, |name| rate(name) > 0.0);
                    let objective = dynamics::objective(model, remembered, recipe, moment, device);
                    (recipe.batch, recipe.length.at(moment.step), objective)
                } else {
                    let length = self.recipe.length.at(moment.step);
                    let batch = self.batch(clips, moment.step, length as i64);
                    adam::select(&stores, |name| rate(name) > 0.0);
                    let learning = self.learning.as_ref();
                    let objective = objective(model, learning, &self.recipe, &batch, moment);
                    (self.recipe.batch, length, objective)
                };
            let loss = objective.loss.double_value(&[]);
            let mut norm = f64::NAN;
            if loss.is_finite() {
                objective.loss.backward();
                norm = self.adam.step(&stores, rate, self.recipe.clip);
            }
            self.progress.step += 1;
            if norm.is_finite() {
                skipped_in_a_row = 0;
                let terms = objective.terms.iter();
                let numbers = terms.map(|(name, value)| (*name, value.double_value(&[]) / length));
                let all = [("loss", loss / length), ("norm", norm)].into_iter().chain(numbers);
                journal.step(self.progress.step, length * rows as f64, all)?;
            } else {
                self.progress.skipped += 1;
                skipped_in_a_row += 1;
                journal.say(&format!("step {}: no finite loss, skipped", self.progress.step));
                ensure!(
                    skipped_in_a_row < MAX_SKIPPED_IN_A_ROW,
                    "{skipped_in_a_row} steps in a row had no finite loss: lower the learning \
                     rate and go on from the last checkpoint"
                );
            }
            self.progress.seconds += started.elapsed().as_secs_f64();
            if self.progress.step == self.recipe.steps {
                self.recalibrate(clips);
                self.check_agent_slot(clips, &journal);
            }
            let every = |steps: u64| steps > 0 && self.progress.step.is_multiple_of(steps);
            if every(self.recipe.save_every) || self.progress.step == end {
                self.save()?;
                if self.recipe.dynamics_alone(self.progress.step).is_none() {
                    remembered = None;
                    self.forget();
                }
            }
            if every(self.recipe.picture_every) || self.progress.step == end {
                self.picture(clips, &mut journal)?;
            }
        }
        Ok(())
    }

    /// Where users find the result.
    pub fn checkpoint_path(&self) -> PathBuf {
        self.folder.join("checkpoint.safetensors")
    }

    fn state_path(&self) -> PathBuf {
        self.folder.join("state.safetensors")
    }

    fn remembered_path(&self) -> PathBuf {
        self.folder.join("remembered.safetensors")
    }

    /// What the model made of the data before its dynamics learned; that a resumed run cannot see again.
    fn remembered(&mut self, clips: &Clips, journal: &Journal) -> anyhow::Result<Remembered> {
        let path = self.remembered_path();
        if path.exists() {
            return Remembered::read(&path, clips);
        }
        let told = |seen| {
            if seen % REMEMBERED_TOLD_EVERY == 0 {
                journal.say(&format!("{seen} of {} episodes are remembered", clips.len()));
            }
        };
        let seeing = self.seeing.take();
        let model = seeing.as_ref().unwrap_or(&self.checkpoint.model);
        let tracking = self.checkpoint.header.model.tracking;
        let remembered = Remembered::by(model, tracking, clips, self.device, told);
        remembered.write(&path)?;
        Ok(remembered)
    }

    /// Removes what no run that goes on from the saved state needs.
    fn forget(&self) {
        fs_err::remove_file(self.remembered_path()).ok();
    }

    fn moment(&self) -> Moment {
        Moment { seed: self.progress.seed, step: self.progress.step }
    }

    fn batch(&self, clips: &Clips, step: u64, length: i64) -> Batch {
        clips.batch(self.progress.seed, step, self.recipe.batch, length, self.device)
    }

    fn resume(&mut self) -> anyhow::Result<()> {
        let path = self.state_path();
        if !path.exists() {
            return Ok(());
        }
        let stores = [&self.checkpoint.store, &self.learning_store];
        let saved = saved::load(&path, &stores, &mut self.adam)?;
        let Progress { seed, data, recipe, .. } = &saved;
        ensure!(*seed == self.progress.seed, "{} has seed {seed}", path.display());
        ensure!(*data == self.progress.data, "{} is a run on {data}", path.display());
        ensure!(
            saved.actions == self.progress.actions,
            "{} scales actions otherwise; a run that was begun with --from goes on with it",
            path.display()
        );
        ensure!(
            (&recipe.model, recipe.variant, recipe.batch)
                == (&self.recipe.model, self.recipe.variant, self.recipe.batch),
            "{} is a run of another recipe",
            path.display()
        );
        self.progress = Progress { recipe: self.recipe.clone(), ..saved };
        Ok(())
    }

    /// Fits the last slot's component to the data's background through its own posterior.
    fn prefit(&self, clips: &Clips, journal: &Journal) {
        let Some(prefit) = self.recipe.prefit else { return };
        let model = &self.checkpoint.model;
        let last = model.config().mixture.slots - 1;
        let background = clips.background.to_device(self.device).unsqueeze(0);
        let rows = self.recipe.batch;
        // The encoders must not learn to ignore the frame, which a constant target would teach them.
        let stores = [&self.checkpoint.store];
        adam::select(&stores, |name| name.starts_with("mixture.comp_decoder"));
        let mut adam = Adam::default();
        for step in PREFIT_STEPS..PREFIT_STEPS + prefit.steps {
            let batch = self.batch(clips, step, 1);
            let how = slots_alone(true);
            let noise = noise(Moment { step, ..self.moment() }, 0, rows, self.device);
            let state = model.initial_state(rows);
            let (_, seen) = model.observe(state, &batch.frames[0], &batch.actions[0], &noise, how);
            let error = (seen.mixture.components.select(1, last) - &background).square();
            let loss = error.sum(Kind::Float) / rows as f64;
            loss.backward();
            adam.step(&stores, |_| prefit.learning_rate, self.recipe.clip * 10.0);
            if step + 1 == PREFIT_STEPS + prefit.steps {
                let error = loss.double_value(&[]) / background.numel() as f64;
                journal.say(&format!("background prefit: mean squared error {error:.5}"));
            }
        }
    }

    /// Replaces running statistics by those of the present weights.
    fn recalibrate(&self, clips: &Clips) {
        let _no_grad = tch::no_grad_guard();
        for i in 0..RECALIBRATION_BATCHES {
            let step = 2 * PREFIT_STEPS + i;
            let length = self.recipe.length.at(self.progress.step) as i64;
            let batch = self.batch(clips, step, length);
            let recipe = &self.recipe;
            // The objective runs every network in training mode, which is what moves the statistics.
            let recipe = Recipe { keypoints: None, ..recipe.clone() };
            let moment = Moment { step, ..self.moment() };
            objective(&self.checkpoint.model, None, &recipe, &batch, moment);
        }
    }

    /// Measures how well the agent slot's mask agrees with the map that led it, and says so if another slot's agrees
    /// clearly better.
    fn check_agent_slot(&mut self, clips: &Clips, journal: &Journal) {
        let Some(slot) = self.checkpoint.model.agent_slot() else { return };
        let vote = self.vote(clips);
        journal.say(&format!("agreement with the map of the agent: {vote}"));
        if let Some(other) = vote.contradicts(slot as usize) {
            journal.say(&format!("the agent is slot {slot}, but slot {other} agrees better"));
        }
        let score = Some(vote.agreement(slot as usize));
        self.checkpoint.header.agent_slot = Some(AgentSlot { index: slot, score });
    }

    fn vote(&self, clips: &Clips) -> Vote {
        let _no_grad = tch::no_grad_guard();
        let model = &self.checkpoint.model;
        let mut vote = Vote::new(model.config().mixture.slots as usize);
        let detector = model.detector().filter(|_| self.recipe.keypoints.is_some());
        for i in 0..VOTING_BATCHES {
            let step = 3 * PREFIT_STEPS + i;
            let batch = self.batch(clips, step, self.recipe.length.at(0) as i64);
            let rows = batch.frames[0].size()[0];
            let noise = PhiloxNoise::mean(rows, self.device);
            let mut state = model.initial_state(rows);
            for (t, frame) in batch.frames.iter().enumerate() {
                let (next, seen) =
                    model.observe(state, frame, &batch.actions[t], &noise, slots_alone(false));
                state = next;
                let gamma = detector.map(|detector| detector.gamma(&detector.forward(frame)));
                let masks = seen.mixture.log_masks.exp().squeeze_dim(2);
                vote.add(&masks, gamma.as_ref().unwrap_or(&batch.motion[t]));
            }
        }
        vote
    }

    fn save(&self) -> anyhow::Result<()> {
        let stores = [&self.checkpoint.store, &self.learning_store];
        saved::save(&self.state_path(), &stores, &self.adam, &self.progress)
    }

    /// Writes the checkpoint that users see.
    fn export(&self) -> anyhow::Result<()> {
        let header = Header {
            provenance: Provenance {
                data: self.progress.data.clone(),
                seed: self.progress.seed,
                steps: self.progress.step,
                preset: self.recipe.name.clone(),
                notes: String::new(),
            },
            ..self.checkpoint.header.clone()
        };
        let path = self.checkpoint_path();
        checkpoint::save(&self.checkpoint.store, &header, &path, Precision::Single)?;
        Ok(())
    }

    fn picture(&self, clips: &Clips, journal: &mut Journal) -> anyhow::Result<()> {
        self.export()?;
        let world = GatsbiWorld::load(&self.checkpoint_path(), self.device)?;
        let recorded: Recorded = clips.recorded(&[0, clips.len() / 2], 20, self.device);
        let scenes = evaluation::rollout(
            &world,
            &recorded,
            CONDITIONING,
            &recorded.actions,
            Draw::Mean,
            evaluation::wanted(),
        );
        let path = self.folder.join(format!("step-{:07}.png", self.progress.step));
        let agent = world.spec().agent_slot;
        evaluation::picture::write(&path, &recorded, &scenes, agent, 1)?;
        let png = fs_err::read(&path)?;
        let size = image::image_dimensions(&path)?;
        journal.events().picture(self.progress.step, "rollout", &png, [size.1, size.0])?;
        Ok(())
    }
}

/// Slots are observed without objects and without priors.
fn slots_alone(train: bool) -> Observing {
    Observing {
        train,
        priors: false,
        objects: false,
        discover: Discover::None,
        tracking: training_tracking(None),
        stops: GradientStops::default(),
    }
}
