//! One episode of a robot scene: how it begins, what an action does, what there is to know.

use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use rand::{RngExt as _, rngs::ChaCha8Rng};

use crate::{
    Error, Goal, ObjectState, Result, State,
    camera::Camera,
    robot::{
        arm::{Arm, Target, down},
        catalogue::{Control, Layout, MAX_DISPLACEMENT, MAX_ROTATION, Tray},
        sweep::{RIM_MARGIN, Sweeps},
        world::{JOINTS, Object, Touches, World},
    },
    seeds::{Stream, rng},
};

/// Tries to place all objects anew, and each of them; tries for the hand.
const LAYOUTS: usize = 100;
const PLACES: usize = 200;
/// Objects keep this far from the rim, and their surfaces from each other.
const TRAY_MARGIN: f64 = 0.06;
const GAP: f64 = 0.045;
/// The hand begins this far from all objects.
const HAND_CLEARANCE: f64 = 0.08;
/// How far above their resting place objects begin: what is in contact from the start jumps.
const DROP: f64 = 0.0005;
/// The hand is turned at most so far about the vertical when an episode begins, radians.
const YAW: f64 = 0.5;
/// Spread of its turns from frame to frame where an action can turn it.
const YAW_JITTER: f64 = 0.03;
/// The gripper is closed in one half of the episodes and so far open in the other.
const OPENING: f64 = 0.25;

/// The episode that is running.
#[derive(Debug)]
pub(crate) struct Episode {
    pub(crate) world: World,
    arm: Arm,
    script: Sweeps,
    /// Greatest half size of an object.
    half_size: f64,
    /// How the hand is turned about the vertical, for the script.
    yaw: f64,
    opening: f64,
    step: usize,
    goal: Goal,
}

impl Episode {
    /// Places objects and hand.
    pub(crate) fn begin(
        mut world: World,
        layout: &'static Layout,
        objects: &[Object],
        seed: u64,
        scene: &mut ChaCha8Rng,
    ) -> Result<Self> {
        let places = place_objects(&layout.tray, objects, scene)?;
        for (object, [x, y]) in places.iter().enumerate() {
            let yaw = scene.random_range(0.0..std::f64::consts::PI);
            world.place(object, [*x, *y, objects[object].half_size + DROP], yaw);
        }
        let [x, y] = place_hand(&layout.tray, &places, scene)?;
        let yaw = scene.random_range(-YAW..YAW);
        let opening = if scene.random() { OPENING } else { 0.0 };
        let target = Target {
            position: Vector3::new(x, y, layout.script.travel_height),
            rotation: down(yaw),
        };
        let arm = Arm::new(&mut world, layout, target, opening);
        world.forward();
        Ok(Self {
            world,
            arm,
            script: Sweeps::new(rng(seed, Stream::Script), &layout.script, &layout.tray),
            half_size: objects.iter().map(|object| object.half_size).fold(0.0, f64::max),
            yaw,
            opening,
            step: 0,
            goal: Goal::default(),
        })
    }

    /// Holds an action for a frame and tells what touched.
    pub(crate) fn hold(&mut self, layout: &Layout, action: &[f32]) -> Touches {
        let action: Vec<f64> = action.iter().copied().map(f64::from).collect();
        let mut touches = Touches::none(self.world.objects());
        self.arm.hold(&mut self.world, layout, &action, &mut touches);
        self.step += 1;
        touches
    }

    /// What the script does next.
    pub(crate) fn scripted_action(&mut self, layout: &Layout) -> Vec<f32> {
        let objects: Vec<_> =
            (0..self.world.objects()).map(|object| self.world.position(object)).collect();
        let mut next = |hand| self.script.next(hand, &objects, self.half_size, layout.period);
        match layout.control {
            Control::JointVelocity => {
                let hand = self.world.hand();
                let position = next(Vector3::new(hand.x, hand.y, layout.script.height));
                let target = Target { position, rotation: down(self.yaw) };
                let velocities = self.arm.velocities(self.world.arm(), layout, &target);
                velocities.iter().map(|&velocity| velocity as f32).collect()
            }
            Control::Gripper => {
                let hand = self.arm.target.position;
                let way = next(hand) - hand;
                let most = f64::from(MAX_ROTATION);
                let turn = self.script.jitter(YAW_JITTER).clamp(-most, most);
                [way.x, way.y, way.z, 0.0, 0.0, turn, self.opening]
                    .iter()
                    .map(|&value| value as f32)
                    .collect()
            }
        }
    }

    /// The world after each of these actions. This episode stays where it is.
    pub(crate) fn future(
        &self,
        layout: &Layout,
        actions: &[Vec<f32>],
    ) -> impl Iterator<Item = World> {
        let (mut world, mut arm) = (self.world.clone(), self.arm.clone());
        let mut touches = Touches::none(world.objects());
        actions.iter().map(move |action| {
            let action: Vec<f64> = action.iter().copied().map(f64::from).collect();
            arm.hold(&mut world, layout, &action, &mut touches);
            world.clone()
        })
    }

    /// The actions that displace the hand, and where it is after each.
    pub(crate) fn hand_moves(
        &mut self,
        layout: &Layout,
        displacements: &[[f64; 2]],
    ) -> Vec<(Vec<f32>, Vector3<f64>)> {
        let (mut arm, mut hand) = (self.world.arm(), self.world.hand());
        if layout.control == Control::Gripper {
            hand = self.arm.target.position;
        }
        let mut one = |&[x, y]: &[f64; 2]| {
            let [x, y] = layout.tray.clamp([hand.x + x, hand.y + y], RIM_MARGIN);
            let position = Vector3::new(x, y, layout.script.height);
            match layout.control {
                Control::JointVelocity => {
                    let target = Target { position, rotation: down(self.yaw) };
                    let velocities = self.arm.velocities(arm, layout, &target);
                    for (joint, velocity) in arm.iter_mut().zip(velocities.iter()) {
                        *joint += velocity * layout.period;
                    }
                    hand = self.arm.hand(arm);
                    (velocities.iter().map(|&velocity| velocity as f32).collect(), hand)
                }
                Control::Gripper => {
                    let most = f64::from(MAX_DISPLACEMENT);
                    let way = (position - hand).map(|part| part.clamp(-most, most));
                    hand += way;
                    let action = [way.x, way.y, way.z, 0.0, 0.0, 0.0, self.opening];
                    (action.iter().map(|&value| value as f32).collect(), hand)
                }
            }
        };
        displacements.iter().map(&mut one).collect()
    }

    /// Takes a goal and returns the world with the objects there.
    pub(crate) fn set_goal(&mut self, goal: &Goal, layout: &Layout) -> Result<World> {
        let (found, expected) = (goal.objects.len(), self.world.objects());
        if found != expected {
            return Err(Error::GoalLength { found, expected });
        }
        let mut shown = self.world.clone();
        for (object, goal) in goal.objects.iter().enumerate() {
            let Some([x, y]) = *goal else { continue };
            if !layout.tray.holds([x, y]) {
                return Err(Error::GoalPosition { object, x, y, bounds: layout.tray.to_string() });
            }
            let z = self.world.position(object)[2];
            shown.place(object, [x, y, z], 0.0);
        }
        shown.forward();
        self.goal = goal.clone();
        Ok(shown)
    }

    /// The truth about `world`, which is this episode's or a picture of its goal.
    pub(crate) fn state(
        &self,
        world: &World,
        camera: &Camera,
        size: u32,
        touches: Touches,
    ) -> State {
        let objects = objects(world, camera, size);
        let hand = world.hand();
        let turned = Rotation3::from_matrix_unchecked(world.hand_axes());
        let turned = UnitQuaternion::from_rotation_matrix(&turned);
        State {
            step: self.step,
            goal_distance: self.goal.distance(objects.iter().map(|object| object.position)),
            objects,
            ee_pose: Some([hand.x, hand.y, hand.z, turned.w, turned.i, turned.j, turned.k]),
            joint_positions: world.data.qpos()[..JOINTS].to_vec(),
            contacts_agent: touches.agent,
            contacts_objects: touches.objects,
            full: [world.data.qpos(), world.data.qvel()].concat(),
        }
    }
}

/// The objects of a world and where they appear.
pub(crate) fn objects(world: &World, camera: &Camera, size: u32) -> Vec<ObjectState> {
    let object = |object| {
        let position = world.position(object);
        ObjectState {
            position,
            quaternion: world.quaternion(object),
            pixel: camera.project(position.into(), size),
        }
    };
    (0..world.objects()).map(object).collect()
}

/// Places on the tray with room between the objects.
fn place_objects(tray: &Tray, objects: &[Object], rng: &mut ChaCha8Rng) -> Result<Vec<[f64; 2]>> {
    'layout: for _ in 0..LAYOUTS {
        let mut places: Vec<[f64; 2]> = Vec::with_capacity(objects.len());
        for object in objects {
            let is_free = |at: &[f64; 2]| {
                places.iter().all(|place| distance(*place, *at) > 2.0 * object.half_size + GAP)
            };
            let place = (0..PLACES).map(|_| tray.draw(TRAY_MARGIN, rng)).find(is_free);
            let Some(place) = place else { continue 'layout };
            places.push(place);
        }
        return Ok(places);
    }
    Err(Error::NoRoom { what: "the objects" })
}

/// A place for the hand, in the half of the tray that is nearer to the robot.
fn place_hand(tray: &Tray, objects: &[[f64; 2]], rng: &mut ChaCha8Rng) -> Result<[f64; 2]> {
    let near = Tray {
        centre: [tray.centre[0] - tray.half[0] / 2.0, tray.centre[1]],
        half: [tray.half[0] / 2.0, tray.half[1]],
        ..*tray
    };
    let is_free =
        |at: &[f64; 2]| objects.iter().all(|object| distance(*object, *at) > HAND_CLEARANCE);
    let place = (0..LAYOUTS * PLACES).map(|_| near.draw(RIM_MARGIN, rng)).find(is_free);
    place.ok_or(Error::NoRoom { what: "the gripper" })
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}
