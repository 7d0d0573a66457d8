//! The scenes with a robot, simulated by MuJoCo: one environment for all three, told apart by a [`catalogue::Layout`].
//!
//! - [`catalogue`]: the numbers. [`mjcf`]: the scene as MuJoCo reads it. [`world`]: a compiled scene and its state.
//! - [`episode`]: how one begins, what it knows.
//! - [`arm`]: from actions to commands. [`sweep`]: the script that makes data sets. [`view`]: pictures.

pub(crate) mod catalogue;
pub(crate) mod view;

mod arm;
mod episode;
mod mjcf;
mod sweep;
mod world;

use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use nalgebra::Vector3;

use crate::{
    Environment, Error, Goal, HandMove, ObjectState, Observation, Result, Scene, SceneSpec,
    camera::Camera,
    robot::{
        catalogue::Layout,
        episode::Episode,
        view::View,
        world::{Touches, World},
    },
    seeds::{Stream, rng},
};

/// A robot scene.
pub(crate) struct RobotScene {
    layout: &'static Layout,
    spec: SceneSpec,
    camera: Camera,
    files: MjVfs,
    view: View,
    episode: Option<Episode>,
}

impl RobotScene {
    /// Opens the scene and its OpenGL context.
    pub(crate) fn open(scene: Scene, layout: &'static Layout, size: u32) -> Result<Self> {
        let place = &layout.camera;
        let camera = Camera::new(place.position, place.look_at, place.fovy);
        let mut files = world::assets(layout.robot)?;
        let world = World::new(&mut files, layout, &[], &camera, size)?;
        let view = View::open(camera, size, world.data.model())?;
        let spec = SceneSpec {
            scene: scene.name(),
            size,
            frames: layout.frames,
            frame_period_seconds: layout.period,
            max_objects: layout.objects.most,
            actions: layout.actions(),
        };
        Ok(Self { layout, spec, camera, files, view, episode: None })
    }
}

impl Environment for RobotScene {
    fn spec(&self) -> &SceneSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Result<Observation> {
        self.episode = None;
        let mut rng = rng(seed, Stream::Scene);
        let objects = world::draw_objects(self.layout, &mut rng);
        let size = self.spec.size;
        let world = World::new(&mut self.files, self.layout, &objects, &self.camera, size)?;
        self.episode = Some(Episode::begin(world, self.layout, &objects, seed, &mut rng)?);
        self.observe(Touches::none(objects.len()))
    }

    fn step(&mut self, action: &[f32]) -> Result<Observation> {
        let episode = self.episode.as_mut().ok_or(Error::NotReset)?;
        self.spec.check(action)?;
        let touches = episode.hold(self.layout, action);
        self.observe(touches)
    }

    fn scripted_action(&mut self) -> Result<Vec<f32>> {
        let episode = self.episode.as_mut().ok_or(Error::NotReset)?;
        Ok(episode.scripted_action(self.layout))
    }

    fn set_goal(&mut self, goal: &Goal) -> Result<Observation> {
        let episode = self.episode.as_mut().ok_or(Error::NotReset)?;
        let mut shown = episode.set_goal(goal, self.layout)?;
        let touches = Touches::none(shown.objects());
        let (rgb, mask) = self.view.of(&mut shown)?;
        let state = episode.state(&shown, &self.camera, self.spec.size, touches);
        Ok(Observation { rgb, mask, state })
    }

    fn futures(&mut self, candidates: &[Vec<Vec<f32>>]) -> Result<Vec<Vec<Vec<ObjectState>>>> {
        let episode = self.episode.as_ref().ok_or(Error::NotReset)?;
        candidates.iter().flatten().try_for_each(|action| self.spec.check(action))?;
        let (camera, size) = (&self.camera, self.spec.size);
        let future = |actions: &Vec<Vec<f32>>| {
            let worlds = episode.future(self.layout, actions);
            worlds.map(|world| episode::objects(&world, camera, size)).collect()
        };
        Ok(candidates.iter().map(future).collect())
    }

    fn hand_moves(&mut self, candidates: &[Vec<[f64; 2]>]) -> Result<Vec<Vec<HandMove>>> {
        let episode = self.episode.as_mut().ok_or(Error::NotReset)?;
        let (camera, size) = (&self.camera, self.spec.size);
        let mut moves = |displacements: &Vec<[f64; 2]>| -> Vec<HandMove> {
            let moves = episode.hand_moves(self.layout, displacements).into_iter();
            let seen = |(action, hand)| HandMove {
                action,
                position: Vector3::into(hand),
                pixel: camera.project(hand, size),
            };
            moves.map(seen).collect()
        };
        Ok(candidates.iter().map(&mut moves).collect())
    }
}

impl RobotScene {
    fn observe(&mut self, touches: Touches) -> Result<Observation> {
        let episode = self.episode.as_mut().ok_or(Error::NotReset)?;
        let (rgb, mask) = self.view.of(&mut episode.world)?;
        let state = episode.state(&episode.world, &self.camera, self.spec.size, touches);
        Ok(Observation { rgb, mask, state })
    }
}
