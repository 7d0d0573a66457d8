//! The scenes by name, and what each says of itself: picture size, time, actions.

use std::{fmt, str::FromStr};

use serde::Serialize;

use crate::{
    Environment, Error, Result,
    balls::Balls,
    robot::{RobotScene, catalogue::Layout},
};

/// A scene that can be opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Scene {
    /// A Panda pushes three to five cubes and cylinders with joint velocities.
    Push1,
    /// The same with an arm that plays: it pushes objects from every side, and wanders into them.
    Push1Play,
    /// A Panda strikes two to four nearly elastic balls that roll for long.
    Roll,
    /// The same with an arm that goes around between four places, whatever lies there.
    RollCycle,
    /// A Sawyer pushes five to seven cubes with displacements of its gripper.
    Push2,
    /// Three elastic spheres in a closed box, seen as a depth image; nobody acts.
    Balls3,
    /// The same with six.
    Balls6,
    /// The same with nine, smaller ones.
    Balls9,
}

/// What a scene says of itself.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneSpec {
    /// Its name.
    pub scene: &'static str,
    /// Height and width of a frame, pixels.
    pub size: u32,
    /// Frames of an episode.
    pub frames: usize,
    /// Seconds between two frames.
    pub frame_period_seconds: f64,
    /// Most objects that an episode can have.
    pub max_objects: usize,
    /// The dimensions of an action, in order; none where nobody acts.
    pub actions: Vec<ActionSpec>,
}

/// One dimension of an action.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ActionSpec {
    /// For example `panda_joint1`.
    pub name: String,
    /// For example `rad/s`.
    pub unit: &'static str,
    /// Smallest value that is accepted.
    pub low: f32,
    /// Largest.
    pub high: f32,
}

impl Scene {
    /// All scenes.
    pub const ALL: [Self; 8] = [
        Self::Push1,
        Self::Push1Play,
        Self::Roll,
        Self::RollCycle,
        Self::Push2,
        Self::Balls3,
        Self::Balls6,
        Self::Balls9,
    ];

    /// The name, as data sets and the command line use it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Push1 => "push1",
            Self::Push1Play => "push1-play",
            Self::Roll => "roll",
            Self::RollCycle => "roll-cycle",
            Self::Push2 => "push2",
            Self::Balls3 => "balls3",
            Self::Balls6 => "balls6",
            Self::Balls9 => "balls9",
        }
    }

    /// What computes its physics, with the version.
    pub fn physics(self) -> String {
        match Layout::of(self) {
            Some(_) => format!("MuJoCo {}", mujoco_rs::mujoco_version()),
            None => "exact collisions of spheres".into(),
        }
    }

    /// Opens the scene for frames of `size` by `size` pixels. It stays on the thread that opened it, because its
    /// OpenGL context does.
    ///
    /// # Errors
    /// [`Error::Size`], and [`Error::NoRenderer`] where EGL is missing.
    pub fn open(self, size: u32) -> Result<Box<dyn Environment>> {
        if !(16..=1024).contains(&size) {
            return Err(Error::Size { found: size });
        }
        if let Some(layout) = Layout::of(self) {
            return Ok(Box::new(RobotScene::open(self, layout, size)?));
        }
        let balls = match self {
            Self::Balls3 => 3,
            Self::Balls6 => 6,
            _ => 9,
        };
        Ok(Box::new(Balls::open(self, balls, size)))
    }
}

impl fmt::Display for Scene {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Scene {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let named = Self::ALL.into_iter().find(|scene| scene.name() == name);
        named.ok_or_else(|| Error::UnknownScene { name: name.into() })
    }
}

impl SceneSpec {
    /// Checks an action against its bounds.
    pub(crate) fn check(&self, action: &[f32]) -> Result<()> {
        let (found, expected) = (action.len(), self.actions.len());
        if found != expected {
            return Err(Error::ActionLength { scene: self.scene, found, expected });
        }
        for (&value, spec) in action.iter().zip(&self.actions) {
            // Written so that NaN is refused too.
            if !(spec.low..=spec.high).contains(&value) {
                return Err(Error::ActionValue {
                    name: spec.name.clone(),
                    unit: spec.unit,
                    value,
                    low: spec.low,
                    high: spec.high,
                });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_lead_back_to_scenes() {
        for scene in Scene::ALL {
            assert_eq!(scene.name().parse::<Scene>().unwrap(), scene);
        }
        let error = "push3".parse::<Scene>().unwrap_err().to_string();
        assert_eq!(
            error,
            "there is no scene `push3`; there are push1, push1-play, roll, roll-cycle, push2, balls3, balls6, balls9"
        );
    }

    #[test]
    fn actions_are_held_to_their_bounds() {
        let bound = |name: &str, high: f32| ActionSpec {
            name: name.into(),
            unit: "rad/s",
            low: -high,
            high,
        };
        let spec = SceneSpec {
            scene: "push1",
            size: 64,
            frames: 40,
            frame_period_seconds: 0.2,
            max_objects: 5,
            actions: vec![bound("shoulder", 2.0), bound("elbow", 1.0)],
        };
        spec.check(&[-2.0, 1.0]).unwrap();
        let short = spec.check(&[0.0]).unwrap_err().to_string();
        assert_eq!(short, "an action of push1 has 2 numbers, not 1");
        for value in [1.5, f32::NAN, f32::NEG_INFINITY] {
            let error = spec.check(&[0.0, value]).unwrap_err().to_string();
            assert_eq!(error, format!("`elbow` of the action is {value} rad/s, outside -1 to 1"));
        }
    }
}
