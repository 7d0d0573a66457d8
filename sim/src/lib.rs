//! Simulated scenes: a robot arm that pushes or strikes objects on a tray, and elastic balls in a box.
//!
//! The scenes re-create those of the GATSBI paper (CVPR 2021), whose data sets are not published: ROLL, PUSH1, PUSH2 with
//! real Panda and Sawyer models in MuJoCo, and BALLS. Numbers measured on them do not compare with the paper's tables.
//! One object both makes the data sets and takes the actions of a planner, so what a model was trained on is what it acts
//! in. This crate knows neither torch nor the server, and nothing of the service links MuJoCo.
//!
//! Where to start:
//! - [`Scene`]: the scenes by name; [`Scene::open`] gives an [`Environment`] to reset, to step and to give a [`Goal`].
//! - [`Observation`]: a frame with its labels and the truth about it, a [`State`].
//! - [`generate()`](generate::generate): data sets in the format of [`gatsbi_episodes`], on several threads.
//! - [`look`]: contact sheets and statistics. [`serve`](mod@serve): a scene for a program in another language.
//! - [`Error`]: every failure.
//!
//! ```no_run
//! use gatsbi_sim::{Goal, Scene};
//!
//! # fn main() -> gatsbi_sim::Result<()> {
//! let mut scene = Scene::Push1.open(64)?;
//! let first = scene.reset(7)?;
//! let mut goal = Goal { objects: vec![None; first.state.objects.len()] };
//! goal.objects[0] = Some([0.5, 0.1]);
//! let picture = scene.set_goal(&goal)?.rgb;
//! let seen = scene.step(&[0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])?;
//! let metres = seen.state.goal_distance;
//! # Ok(())
//! # }
//! ```

pub mod generate;
pub mod look;
pub mod serve;

mod balls;
mod camera;
mod environment;
mod error;
mod recorder;
mod robot;
mod scene;
mod seeds;

pub use environment::{
    AGENT, BACKGROUND, Environment, FIRST_OBJECT, Goal, HandMove, ObjectState, Observation, State,
};
pub use error::{Error, Result};
pub use scene::{ActionSpec, Scene, SceneSpec};
pub use seeds::episode_seed;
