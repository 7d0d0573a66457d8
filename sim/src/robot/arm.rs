//! The arm: postures for a pose of the hand, and the commands that an action stands for.

use std::rc::Rc;

use mujoco_rs::prelude::{MjData, MjModel};
use nalgebra::{Matrix3, Rotation3, SMatrix, SVector, Vector3, Vector6};

use crate::robot::{
    catalogue::{Control, Layout, MAX_JOINT_VELOCITY, Tray},
    world::{ARM, Touches, World},
};

type Joints = SVector<f64, ARM>;
type Jacobian = SMatrix<f64, 6, ARM>;

/// Rounds of inverse kinematics for a first posture, for the next frame, and for a part of a frame.
pub(crate) const ROUNDS_FIRST: usize = 200;
pub(crate) const ROUNDS_FRAME: usize = 12;
const ROUNDS_PART: usize = 3;
/// Parts of a frame in which the gripper's way is followed.
const PARTS: usize = 5;
/// Largest joint velocity on the gripper's way, rad/s.
const MAX_FOLLOWING: f64 = 3.0;
/// The hand stays this far above the table and this far below.
const HEIGHTS: [f64; 2] = [0.015, 0.35];
/// Largest turn of a joint in one round, radians.
const LARGEST_TURN: f64 = 0.3;
/// Pull towards the home posture where the pose leaves it free.
const LEANING: f64 = 0.1;
const DAMPING: f64 = 1e-4;
/// Joints stay this far from their limits, radians.
const LIMIT_MARGIN: f64 = 0.02;

/// The arm's kinematics and what it is commanded to do.
#[derive(Clone, Debug)]
pub(crate) struct Arm {
    /// For postures that are tried out.
    scratch: MjData<Rc<MjModel>>,
    site: usize,
    home: Joints,
    limits: [(f64, f64); ARM],
    /// Where the gripper shall be, for the control that displaces it.
    pub(crate) target: Target,
}

/// A pose of the hand.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Target {
    pub(crate) position: Vector3<f64>,
    pub(crate) rotation: Rotation3<f64>,
}

/// The hand pointing down, turned about the vertical.
pub(crate) fn down(yaw: f64) -> Rotation3<f64> {
    let upside_down = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0));
    Rotation3::from_axis_angle(&Vector3::z_axis(), yaw)
        * Rotation3::from_matrix_unchecked(upside_down)
}

impl Arm {
    /// Brings the arm into a posture with the hand at `target` and the fingers opened so far.
    pub(crate) fn new(world: &mut World, layout: &Layout, target: Target, opening: f64) -> Self {
        let model = world.data.model_clone();
        let range = |joint: usize| {
            let [low, high] = model.jnt_range()[joint];
            (low + LIMIT_MARGIN, high - LIMIT_MARGIN)
        };
        let mut arm = Self {
            limits: std::array::from_fn(range),
            scratch: MjData::new(model),
            site: world.site(),
            home: Joints::from(layout.robot.home()),
            target,
        };
        let posture = arm.posture(arm.home.into(), &target, ROUNDS_FIRST);
        let fingers = layout.robot.fingers(opening);
        world.data.qpos_mut()[..ARM].copy_from_slice(&posture);
        world.data.qpos_mut()[ARM..ARM + 2].copy_from_slice(&fingers);
        command_fingers(world, fingers);
        arm
    }

    /// Joint positions that bring the hand to `target`, found from `start` by damped least squares; what the pose
    /// leaves free goes towards the home posture.
    pub(crate) fn posture(
        &mut self,
        start: [f64; ARM],
        target: &Target,
        rounds: usize,
    ) -> [f64; ARM] {
        let mut joints = Joints::from(start);
        for _ in 0..rounds {
            self.scratch.qpos_mut()[..ARM].copy_from_slice(joints.as_slice());
            self.scratch.kinematics();
            self.scratch.com_pos();
            let error = self.error(target);
            let jacobian = self.jacobian();
            let normal = jacobian * jacobian.transpose() + DAMPING * SMatrix::identity();
            let Some(normal) = normal.cholesky() else { break };
            let leaning = LEANING * (self.home - joints);
            let turn = leaning + jacobian.transpose() * normal.solve(&(error - jacobian * leaning));
            joints += turn * (LARGEST_TURN / turn.amax()).min(1.0);
            for (joint, (low, high)) in joints.iter_mut().zip(self.limits) {
                *joint = joint.clamp(low, high);
            }
        }
        joints.into()
    }

    /// Holds an action for a frame. Adds what touches on the way.
    pub(crate) fn hold(
        &mut self,
        world: &mut World,
        layout: &Layout,
        action: &[f64],
        touches: &mut Touches,
    ) {
        match layout.control {
            Control::JointVelocity => {
                world.data.ctrl_mut()[..ARM].copy_from_slice(action);
                run(world, layout.steps(), touches);
            }
            Control::Gripper => {
                command_fingers(world, layout.robot.fingers(action[6]));
                let next = self.target.moved(action, &layout.tray);
                let (way, part) =
                    (next.position - self.target.position, layout.period / PARTS as f64);
                let turn = next.rotation * self.target.rotation.inverse();
                for i in 1..=PARTS {
                    let along = i as f64 / PARTS as f64;
                    let target = Target {
                        position: self.target.position + along * way,
                        rotation: turn.powf(along) * self.target.rotation,
                    };
                    let from = world.arm();
                    let to = self.posture(from, &target, ROUNDS_PART);
                    for joint in 0..ARM {
                        let velocity = (to[joint] - from[joint]) / part;
                        world.data.ctrl_mut()[joint] =
                            velocity.clamp(-MAX_FOLLOWING, MAX_FOLLOWING);
                    }
                    run(world, layout.steps() / PARTS, touches);
                }
                self.target = next;
            }
        }
    }

    /// The joint velocities that bring the hand to `target` within a frame, slowed down together where one would be too
    /// fast: cut off one by one they would bend the way, down through the table for instance.
    pub(crate) fn velocities(
        &mut self,
        from: [f64; ARM],
        layout: &Layout,
        target: &Target,
    ) -> Joints {
        let to = self.posture(from, target, ROUNDS_FRAME);
        let velocities = (Joints::from(to) - Joints::from(from)) / layout.period;
        // A hair less than the bound, because the action is rounded to f32.
        let most = f64::from(MAX_JOINT_VELOCITY) * (1.0 - 1e-6);
        velocities * (most / velocities.amax()).min(1.0)
    }

    /// Where the hand is in a posture.
    pub(crate) fn hand(&mut self, posture: [f64; ARM]) -> Vector3<f64> {
        self.scratch.qpos_mut()[..ARM].copy_from_slice(&posture);
        self.scratch.kinematics();
        self.scratch.site_xpos()[self.site].into()
    }

    /// Position and rotation that are lacking.
    fn error(&self, target: &Target) -> Vector6<f64> {
        let position = Vector3::from(self.scratch.site_xpos()[self.site]);
        let axes = Matrix3::from_row_slice(&self.scratch.site_xmat()[self.site]);
        let lacking = target.rotation.matrix() * axes.transpose();
        let translation = target.position - position;
        let rotation = 0.5
            * Vector3::new(
                lacking[(2, 1)] - lacking[(1, 2)],
                lacking[(0, 2)] - lacking[(2, 0)],
                lacking[(1, 0)] - lacking[(0, 1)],
            );
        Vector6::from_iterator(translation.iter().chain(&rotation).copied())
    }

    /// How the hand moves and turns with each joint.
    fn jacobian(&self) -> Jacobian {
        let (translation, rotation) = self.scratch.jac_site(true, true, self.site);
        let columns = translation.len() / 3;
        Jacobian::from_fn(|row, joint| match row {
            0..3 => translation[row * columns + joint],
            _ => rotation[(row - 3) * columns + joint],
        })
    }
}

impl Target {
    /// The target after an action of [`Control::Gripper`]. It stays above the tray, however long somebody pushes it.
    fn moved(&self, action: &[f64], tray: &Tray) -> Self {
        let position = self.position + Vector3::new(action[0], action[1], action[2]);
        let [x, y] = tray.clamp([position.x, position.y], 0.0);
        let z = position.z.clamp(HEIGHTS[0], HEIGHTS[1]);
        let turn = Rotation3::from_scaled_axis(Vector3::new(action[3], action[4], action[5]));
        let mut rotation = turn * self.rotation;
        rotation.renormalize();
        Self { position: Vector3::new(x, y, z), rotation }
    }
}

/// Closes or opens the fingers: the actuators are found by the joint that they move.
fn command_fingers(world: &mut World, fingers: [f64; 2]) {
    let model = world.data.model_clone();
    for (actuator, [joint, _]) in model.actuator_trnid().iter().enumerate().skip(ARM) {
        world.data.ctrl_mut()[actuator] = fingers[*joint as usize - ARM];
    }
}

fn run(world: &mut World, steps: usize, touches: &mut Touches) {
    for _ in 0..steps {
        world.data.step();
        world.note_touches(touches);
    }
    // A step ends with the state alone: what is seen and touched there is still that of its beginning.
    world.forward();
    world.note_touches(touches);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Scene, camera::Camera, robot::world};

    /// An arm in a scene without objects.
    fn arm(scene: Scene) -> (Arm, World, &'static Layout) {
        let layout = Layout::of(scene).unwrap();
        let camera = Camera::new([1.0, 0.0, 1.0], [0.0; 3], 40.0);
        let mut files = world::assets(layout.robot).unwrap();
        let mut world = World::new(&mut files, layout, &[], &camera, 16).unwrap();
        let [x, y] = layout.tray.centre;
        let target = Target { position: Vector3::new(x, y, 0.1), rotation: down(0.0) };
        let arm = Arm::new(&mut world, layout, target, 0.0);
        world.forward();
        (arm, world, layout)
    }

    #[test]
    fn the_hand_reaches_every_corner_of_the_tray() {
        for scene in [Scene::Push1, Scene::Push2] {
            let (mut arm, mut world, layout) = arm(scene);
            let home = layout.robot.home();
            for (x, y) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0), (0.0, 0.0)] {
                let [centre_x, centre_y] = layout.tray.centre;
                let [half_x, half_y] = layout.tray.half;
                let position =
                    Vector3::new(centre_x + 0.85 * x * half_x, centre_y + 0.85 * y * half_y, 0.03);
                let target = Target { position, rotation: down(0.4) };
                let posture = arm.posture(home, &target, ROUNDS_FIRST);
                world.data.qpos_mut()[..ARM].copy_from_slice(&posture);
                world.forward();
                let off = (world.hand() - position).norm();
                assert!(off < 0.002, "{scene}: {off} m off at {position}");
                let turned = Rotation3::from_matrix_unchecked(world.hand_axes());
                let angle = turned.angle_to(&target.rotation);
                assert!(angle < 0.02, "{scene}: {angle} rad off at {position}");
            }
        }
    }

    #[test]
    fn velocities_are_slowed_down_together() {
        let (mut arm, world, layout) = arm(Scene::Push1);
        let far = Target { position: Vector3::new(0.6, 0.25, 0.03), rotation: down(0.5) };
        let velocities = arm.velocities(world.arm(), layout, &far);
        let most = f64::from(MAX_JOINT_VELOCITY);
        assert!((velocities.amax() - most).abs() < 1e-5, "{velocities}");
        let to = arm.posture(world.arm(), &far, ROUNDS_FRAME);
        let way = Joints::from(to) - Joints::from(world.arm());
        assert!(velocities.normalize().dot(&way.normalize()) > 1.0 - 1e-12);
    }

    #[test]
    fn a_target_stays_above_the_tray() {
        let (arm, _, layout) = arm(Scene::Push2);
        let mut target = arm.target;
        for _ in 0..50 {
            target = target.moved(&[0.05, -0.05, -0.05, 0.0, 0.0, 0.1, 0.0], &layout.tray);
        }
        let [x, y] = [0.66 + 0.25, -0.32];
        assert!((target.position - Vector3::new(x, y, HEIGHTS[0])).norm() < 1e-9);
        // Five radians about the vertical.
        assert!(
            (target.rotation.matrix() - down(5.0).matrix()).norm() < 1e-9,
            "{}",
            target.rotation
        );
    }
}
