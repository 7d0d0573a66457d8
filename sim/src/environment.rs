//! What every scene can do: begin an episode, take an action, pursue a goal. The generator of data sets and the
//! closed loops of planners drive the same object.

use serde::{Deserialize, Serialize};

use crate::{Result, SceneSpec};

/// Label of what never moves.
pub const BACKGROUND: u8 = 0;
/// Label of the robot's moving links and gripper.
pub const AGENT: u8 = 1;
/// Label of the first object.
pub const FIRST_OBJECT: u8 = 2;

/// A scene to act in. The same seed and actions give the same states, bit for bit, on the same kind of processor.
pub trait Environment {
    /// What the scene says of itself.
    fn spec(&self) -> &SceneSpec;

    /// Begins the episode of this seed, and forgets the goal.
    fn reset(&mut self, seed: u64) -> Result<Observation>;

    /// Holds `action` for one frame period. There is no last step; a data set stops at [`SceneSpec::frames`].
    ///
    /// # Errors
    /// [`crate::Error::ActionLength`] or [`crate::Error::ActionValue`]: nothing has moved.
    fn step(&mut self, action: &[f32]) -> Result<Observation>;

    /// The action that the episode's script would take now: the purposeful movements of the data sets.
    fn scripted_action(&mut self) -> Result<Vec<f32>>;

    /// Sets the goal and returns the frame as it would look with the objects there and all else as it is. From then
    /// on states tell the distance.
    fn set_goal(&mut self, goal: &Goal) -> Result<Observation>;

    /// What would come of other actions: the objects after each action of each candidate. The scene itself stays as
    /// it is, so a planner can search in the truth instead of a model of it.
    ///
    /// # Errors
    /// [`crate::Error::NobodyActs`], and those of [`Environment::step`].
    fn futures(&mut self, candidates: &[Vec<Vec<f32>>]) -> Result<Vec<Vec<Vec<ObjectState>>>>;

    /// The actions that move the hand over the table, as the robot's own controller knows them: candidates of
    /// displacements along the world's x and y in metres, one a frame. Nothing that is in the way is considered, and
    /// the hand stays on the tray.
    ///
    /// # Errors
    /// [`crate::Error::NobodyActs`].
    fn hand_moves(&mut self, candidates: &[Vec<[f64; 2]>]) -> Result<Vec<Vec<HandMove>>>;
}

/// An action that moves the hand.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HandMove {
    /// The action.
    pub action: Vec<f32>,
    /// The point between the fingertips after it, metres.
    pub position: [f64; 3],
    /// That point in the picture, as in [`ObjectState::pixel`].
    pub pixel: [f64; 2],
}

/// Where objects shall be.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Goal {
    /// World x and y of each object in metres; nothing for an object that may be anywhere.
    pub objects: Vec<Option<[f64; 2]>>,
}

/// What there is to see, and the truth about it.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// `[H,W,3]`
    pub rgb: Vec<u8>,
    /// `[H,W]`: 0 background, 1 agent, 2 + i object i. Links that never move are background.
    pub mask: Vec<u8>,
    /// The truth.
    pub state: State,
}

/// The truth about a scene at one frame. Lengths in metres in the world frame, quaternions as w, x, y, z.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct State {
    /// Frames since the reset.
    pub step: usize,
    /// The objects in the order of their labels.
    pub objects: Vec<ObjectState>,
    /// `[7]`: position of the point between the fingertips, then its quaternion. Nothing where nobody acts.
    pub ee_pose: Option<[f64; 7]>,
    /// `[J]` radians, metres where the joint slides. Empty where nobody acts.
    pub joint_positions: Vec<f64>,
    /// `[N]` whether the agent touched the object after the previous frame, up to this one.
    pub contacts_agent: Vec<bool>,
    /// `[N,N]` the same between objects.
    pub contacts_objects: Vec<bool>,
    /// Largest distance between an object and its goal; nothing without a goal.
    pub goal_distance: Option<f64>,
    /// Everything that the next state depends on: positions and velocities as the simulator holds them.
    #[serde(skip)]
    pub full: Vec<f64>,
}

/// One object.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ObjectState {
    /// Centre.
    pub position: [f64; 3],
    /// Orientation.
    pub quaternion: [f64; 4],
    /// The centre in the picture: x right, y down, 0 is the centre of the first pixel.
    pub pixel: [f64; 2],
}

impl Goal {
    /// Largest distance of an object from its goal; nothing if the goal leaves all of them free.
    pub(crate) fn distance(&self, positions: impl Iterator<Item = [f64; 3]>) -> Option<f64> {
        let distances = self.objects.iter().zip(positions).filter_map(|(goal, position)| {
            goal.map(|[x, y]| (position[0] - x).hypot(position[1] - y))
        });
        distances.reduce(f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_farthest_object_counts_and_free_ones_do_not() {
        let positions = [[0.0, 0.0, 0.1], [1.0, 1.0, 0.1], [5.0, 5.0, 0.1]];
        let goal = Goal { objects: vec![Some([0.3, 0.4]), Some([1.0, 1.1]), None] };
        assert!((goal.distance(positions.into_iter()).unwrap() - 0.5).abs() < 1e-12);
        assert_eq!(Goal { objects: vec![None; 3] }.distance(positions.into_iter()), None);
    }
}
