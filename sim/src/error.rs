//! What can go wrong with a scene, a data set of it, or the library under it.
//!
//! Messages state their own part only: print the chain of sources to see the cause.

use std::path::PathBuf;

use mujoco_rs::prelude::{MjModelError, MjVfsError, RendererError};

use crate::Scene;

/// The result of this crate's operations.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// A failed operation.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No scene has this name.
    #[error("there is no scene `{name}`; there are {}", Scene::ALL.map(Scene::name).join(", "))]
    UnknownScene {
        /// What was asked for.
        name: String,
    },
    /// Frames of this size are not made.
    #[error("frames are 16 to 1024 pixels wide and high, not {found}")]
    Size {
        /// What was asked for.
        found: u32,
    },
    /// A step, a goal or an action of the script was asked for before the first reset.
    #[error("the scene was not reset yet")]
    NotReset,
    /// An action of another length.
    #[error("an action of {scene} has {expected} numbers, not {found}")]
    ActionLength {
        /// The scene.
        scene: &'static str,
        /// Numbers that were given.
        found: usize,
        /// Numbers that it has.
        expected: usize,
    },
    /// A number of an action that is out of bounds or no number.
    #[error("`{name}` of the action is {value} {unit}, outside {low} to {high}")]
    ActionValue {
        /// Name of the dimension.
        name: String,
        /// Its unit.
        unit: &'static str,
        /// What was given.
        value: f32,
        /// Smallest value.
        low: f32,
        /// Largest.
        high: f32,
    },
    /// A goal or candidates of actions in a scene where nobody acts.
    #[error("nobody acts in {scene}, so it takes neither goals nor candidates")]
    NobodyActs {
        /// The scene.
        scene: &'static str,
    },
    /// A goal for other objects than there are.
    #[error("the goal is for {found} objects, and the scene has {expected}")]
    GoalLength {
        /// Objects of the goal.
        found: usize,
        /// Objects of the scene.
        expected: usize,
    },
    /// A goal outside the tray.
    #[error("the goal puts object {object} at {x}, {y} m, outside the tray ({bounds})")]
    GoalPosition {
        /// Which object.
        object: usize,
        /// World x, metres.
        x: f64,
        /// World y, metres.
        y: f64,
        /// Where the tray is.
        bounds: String,
    },
    /// OpenGL cannot be had without a display.
    #[error(
        "frames cannot be rendered without EGL: install it (on Debian and Ubuntu: apt install \
         libegl1 libgl1-mesa-dri)"
    )]
    NoRenderer {
        /// What the renderer said.
        source: RendererError,
    },
    /// A frame was not rendered.
    #[error("a frame could not be rendered")]
    Render {
        /// What the renderer said.
        source: RendererError,
    },
    /// MuJoCo does not accept the scene.
    #[error("MuJoCo cannot compile the scene")]
    Model {
        /// What it said.
        source: MjModelError,
    },
    /// MuJoCo does not accept the robot's files.
    #[error("MuJoCo cannot take the file {name}")]
    Asset {
        /// The file.
        name: String,
        /// What it said.
        source: MjVfsError,
    },
    /// No free place was found for an object or for the gripper.
    #[error("there is no room on the tray for {what}")]
    NoRoom {
        /// For what.
        what: &'static str,
    },
    /// The folder holds another data set than the one that was asked for.
    #[error("{path} holds another data set: its {what} is {found}, not {expected}")]
    OtherDataset {
        /// The folder.
        path: PathBuf,
        /// Which part differs.
        what: String,
        /// What is there.
        found: String,
        /// What was asked for.
        expected: String,
    },
    /// The data set has no episodes to look at.
    #[error("{path} holds no episodes")]
    Empty {
        /// The data set.
        path: PathBuf,
    },
    /// A thread that made episodes died.
    #[error("a thread that makes episodes panicked")]
    Panicked,
    /// Reading or writing episodes failed.
    #[error(transparent)]
    Episodes(#[from] gatsbi_episodes::Error),
    /// What was made is no valid episode.
    #[error("episode {index} is not valid")]
    Episode {
        /// Its index.
        index: u64,
        /// What is wrong with it.
        source: gatsbi_episodes::InvalidEpisode,
    },
    /// The operating system refused; its message names the operation and the path.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// A picture could not be written.
    #[error("{path} could not be written")]
    Picture {
        /// The picture.
        path: PathBuf,
        /// Why.
        source: image::ImageError,
    },
}
