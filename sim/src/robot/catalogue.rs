//! The three robot scenes in numbers: tray, objects, camera, look, control, and how the script moves.
//!
//! They are re-creations of ROLL, PUSH1 and PUSH2 of the GATSBI paper (CVPR 2021), which describes them in words only.
//! Lengths are metres, times seconds, the world's origin is the robot's base on the table.

use std::fmt;

use rand::{Rng, RngExt as _};

use crate::{ActionSpec, Scene};

/// Everything that tells one robot scene from another.
#[derive(Debug)]
pub(crate) struct Layout {
    pub(crate) robot: Robot,
    pub(crate) frames: usize,
    /// Between two frames.
    pub(crate) period: f64,
    /// Of the physics.
    pub(crate) timestep: f64,
    pub(crate) tray: Tray,
    pub(crate) objects: Objects,
    pub(crate) camera: CameraPlace,
    pub(crate) look: Look,
    pub(crate) control: Control,
    pub(crate) script: Script,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Robot {
    /// Franka Panda with its hand.
    Panda,
    /// Sawyer with the Rethink gripper.
    Sawyer,
}

/// The part of the table that the rim encloses.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tray {
    pub(crate) centre: [f64; 2],
    /// Half its size.
    pub(crate) half: [f64; 2],
    pub(crate) rim_height: f64,
    pub(crate) friction: f64,
}

#[derive(Debug)]
pub(crate) struct Objects {
    pub(crate) least: usize,
    pub(crate) most: usize,
    pub(crate) shapes: &'static [Shape],
    /// Least and greatest half edge, or radius.
    pub(crate) half_size: [f64; 2],
    /// kg/m3
    pub(crate) density: f64,
    /// Contacts nearly without loss, and without friction that would stop a spin.
    pub(crate) elastic: bool,
    pub(crate) colours: &'static [[f64; 3]],
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Shape {
    Cube,
    /// As high as wide.
    Cylinder,
    Ball,
}

#[derive(Debug)]
pub(crate) struct CameraPlace {
    pub(crate) position: [f64; 3],
    pub(crate) look_at: [f64; 3],
    /// Degrees.
    pub(crate) fovy: f64,
}

#[derive(Debug)]
pub(crate) struct Look {
    pub(crate) table: [f64; 3],
    pub(crate) rim: [f64; 3],
    pub(crate) floor: [f64; 3],
}

/// What an action is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Control {
    /// Seven joint velocities.
    JointVelocity,
    /// Displacement of the gripper, its rotation about the world's axes, and how far it is open.
    Gripper,
}

/// How the script moves.
#[derive(Debug)]
pub(crate) struct Script {
    /// Of the fingertips while they push.
    pub(crate) height: f64,
    /// On the way to the next object.
    pub(crate) travel_height: f64,
    /// Least and greatest speed of a push, m/s.
    pub(crate) speed: [f64; 2],
    /// What it goes for.
    pub(crate) aim: Aim,
}

/// What the script goes for.
#[derive(Debug)]
pub(crate) enum Aim {
    /// A random object. A push goes on behind its centre so far, least and most.
    Objects { sweep: [f64; 2] },
    /// A random object, from any side and not always through its middle; or it wanders, preferably into one.
    Play { sweep: [f64; 2] },
    /// These places of the tray one after the other, each missed by a little (the spread, metres), from a random one on.
    Cycle { places: [[f64; 2]; 4], spread: f64 },
}

/// Largest joint velocity, rad/s: that of the real Panda's slower joints.
pub(crate) const MAX_JOINT_VELOCITY: f32 = 2.1;
/// Largest displacement of the gripper along an axis in one frame, metres.
pub(crate) const MAX_DISPLACEMENT: f32 = 0.06;
/// Largest rotation of the gripper about an axis in one frame, radians.
pub(crate) const MAX_ROTATION: f32 = 0.2;

const COLOURS: [[f64; 3]; 8] = [
    [0.85, 0.12, 0.10],
    [0.10, 0.65, 0.20],
    [0.12, 0.25, 0.85],
    [0.95, 0.80, 0.10],
    [0.55, 0.15, 0.70],
    [0.95, 0.45, 0.05],
    [0.10, 0.70, 0.80],
    [0.95, 0.40, 0.65],
];

const PUSH1: Layout = Layout {
    robot: Robot::Panda,
    frames: 40,
    period: 0.2,
    timestep: 0.004,
    tray: Tray { centre: [0.52, 0.0], half: [0.24, 0.28], rim_height: 0.04, friction: 0.12 },
    objects: Objects {
        least: 3,
        most: 5,
        shapes: &[Shape::Cube, Shape::Cylinder],
        half_size: [0.03, 0.038],
        density: 200.0,
        elastic: false,
        colours: COLOURS.split_at(6).0,
    },
    camera: CameraPlace { position: [1.16, 0.0, 0.92], look_at: [0.47, 0.0, 0.04], fovy: 39.0 },
    look: Look { table: [0.75, 0.7, 0.62], rim: [0.35, 0.27, 0.2], floor: [0.42, 0.42, 0.45] },
    control: Control::JointVelocity,
    script: Script {
        height: 0.03,
        travel_height: 0.03,
        speed: [0.16, 0.34],
        aim: Aim::Objects { sweep: [0.08, 0.18] },
    },
};

/// All that a hand may do to objects, not only what moves them well.
static PUSH1_PLAY: Layout = Layout {
    script: Script { speed: [0.05, 0.36], aim: Aim::Play { sweep: [0.0, 0.16] }, ..PUSH1.script },
    ..PUSH1
};

const ROLL: Layout = Layout {
    robot: Robot::Panda,
    frames: 40,
    period: 0.15,
    timestep: 0.002,
    tray: Tray { centre: [0.52, 0.0], half: [0.25, 0.30], rim_height: 0.06, friction: 0.01 },
    objects: Objects {
        least: 2,
        most: 4,
        shapes: &[Shape::Ball],
        half_size: [0.04, 0.04],
        density: 400.0,
        elastic: true,
        colours: COLOURS.split_at(6).0,
    },
    camera: CameraPlace { position: [1.20, 0.0, 0.96], look_at: [0.47, 0.0, 0.03], fovy: 40.0 },
    look: Look { table: [0.12, 0.38, 0.27], rim: [0.38, 0.2, 0.1], floor: [0.25, 0.25, 0.3] },
    control: Control::JointVelocity,
    script: Script {
        height: 0.035,
        travel_height: 0.035,
        speed: [0.20, 0.42],
        aim: Aim::Objects { sweep: [0.02, 0.06] },
    },
};

/// Two loops that cross in the middle of the tray.
static ROLL_CYCLE: Layout = Layout {
    script: Script {
        speed: [0.30, 0.34],
        aim: Aim::Cycle {
            places: [[0.40, -0.17], [0.64, 0.17], [0.40, 0.17], [0.64, -0.17]],
            spread: 0.01,
        },
        ..ROLL.script
    },
    ..ROLL
};

static PUSH2: Layout = Layout {
    robot: Robot::Sawyer,
    frames: 84,
    period: 0.1,
    timestep: 0.004,
    tray: Tray { centre: [0.66, 0.0], half: [0.25, 0.32], rim_height: 0.04, friction: 0.15 },
    objects: Objects {
        least: 5,
        most: 7,
        shapes: &[Shape::Cube],
        half_size: [0.03, 0.036],
        density: 250.0,
        elastic: false,
        colours: &COLOURS,
    },
    camera: CameraPlace { position: [1.36, 0.0, 0.95], look_at: [0.60, 0.0, 0.04], fovy: 41.0 },
    look: Look { table: [0.55, 0.57, 0.6], rim: [0.25, 0.27, 0.3], floor: [0.6, 0.58, 0.55] },
    control: Control::Gripper,
    script: Script {
        height: 0.03,
        travel_height: 0.105,
        speed: [0.22, 0.42],
        aim: Aim::Objects { sweep: [0.06, 0.20] },
    },
};

impl Layout {
    /// The layout of a scene with a robot; those without one are made elsewhere.
    pub(crate) fn of(scene: Scene) -> Option<&'static Self> {
        match scene {
            Scene::Push1 => Some(&PUSH1),
            Scene::Push1Play => Some(&PUSH1_PLAY),
            Scene::Roll => Some(&ROLL),
            Scene::RollCycle => Some(&ROLL_CYCLE),
            Scene::Push2 => Some(&PUSH2),
            Scene::Balls3 | Scene::Balls6 | Scene::Balls9 => None,
        }
    }

    /// Steps of the physics in a frame.
    pub(crate) fn steps(&self) -> usize {
        (self.period / self.timestep).round() as usize
    }

    /// The dimensions of an action.
    pub(crate) fn actions(&self) -> Vec<ActionSpec> {
        let both = |name, unit, high: f32| ActionSpec { name, unit, low: -high, high };
        let moves = |name: &str| both(name.into(), "m", MAX_DISPLACEMENT);
        let turns = |name: &str| both(name.into(), "rad", MAX_ROTATION);
        let joint = |joint| both(format!("panda_joint{joint}"), "rad/s", MAX_JOINT_VELOCITY);
        let opening =
            || ActionSpec { name: "gripper_opening".into(), unit: "1", low: 0.0, high: 1.0 };
        match self.control {
            Control::JointVelocity => (1..=7).map(joint).collect(),
            Control::Gripper => ["gripper_dx", "gripper_dy", "gripper_dz"]
                .map(moves)
                .into_iter()
                .chain(["gripper_rx", "gripper_ry", "gripper_rz"].map(turns))
                .chain([opening()])
                .collect(),
        }
    }
}

impl Tray {
    /// The nearest point that is `margin` or more away from the rim.
    pub(crate) fn clamp(&self, [x, y]: [f64; 2], margin: f64) -> [f64; 2] {
        let clamp = |value: f64, axis: usize| {
            let reach = self.half[axis] - margin;
            value.clamp(self.centre[axis] - reach, self.centre[axis] + reach)
        };
        [clamp(x, 0), clamp(y, 1)]
    }

    /// A random point, `margin` or more away from the rim.
    pub(crate) fn draw(&self, margin: f64, rng: &mut impl Rng) -> [f64; 2] {
        std::array::from_fn(|axis| {
            let reach = self.half[axis] - margin;
            self.centre[axis] + rng.random_range(-reach..reach)
        })
    }

    /// Whether a point is on the tray.
    pub(crate) fn holds(&self, point: [f64; 2]) -> bool {
        (0..2).all(|axis| (point[axis] - self.centre[axis]).abs() <= self.half[axis])
    }
}

impl fmt::Display for Tray {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x, y] = self.centre;
        let [half_x, half_y] = self.half;
        let (low, high) = ([x - half_x, y - half_y], [x + half_x, y + half_y]);
        write!(f, "x {:.2} to {:.2} m, y {:.2} to {:.2} m", low[0], high[0], low[1], high[1])
    }
}

impl Robot {
    /// The posture that inverse kinematics starts from and leans to, radians.
    pub(crate) fn home(self) -> [f64; 7] {
        match self {
            Self::Panda => [0.0, 0.2, 0.0, -2.1, 0.0, 2.3, 0.785],
            Self::Sawyer => [0.0, -0.6, 0.0, 1.6, 0.0, 0.6, -1.6],
        }
    }

    /// Places of the two fingers, and so the commands to them, in the order of joints: 0 is closed, 1 open.
    pub(crate) fn fingers(self, opening: f64) -> [f64; 2] {
        match self {
            Self::Panda => [0.04 * opening, -0.04 * opening],
            Self::Sawyer => {
                let left = -0.0115 + 0.032_333 * opening;
                [left, -left]
            }
        }
    }

    /// The model and its meshes: file names and contents, one of them `NAME.xml`.
    pub(crate) fn files(self) -> &'static [(&'static str, &'static [u8])] {
        match self {
            Self::Panda => include!(concat!(env!("OUT_DIR"), "/panda.rs")),
            Self::Sawyer => include!(concat!(env!("OUT_DIR"), "/sawyer.rs")),
        }
    }

    /// The file among them that describes the robot.
    pub(crate) fn model(self) -> &'static str {
        match self {
            Self::Panda => "panda.xml",
            Self::Sawyer => "sawyer.xml",
        }
    }
}
