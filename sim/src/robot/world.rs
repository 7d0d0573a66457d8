//! One compiled scene with its state: where objects and robot are, what touches what.

use std::rc::Rc;

use mujoco_rs::{
    prelude::{MjData, MjModel, MjtObjBase},
    wrappers::mj_auxiliary::MjVfs,
};
use nalgebra::{Matrix3, Vector3};
use rand::{Rng, RngExt as _, seq::SliceRandom as _};

use crate::{
    Error, Result,
    camera::Camera,
    environment::{AGENT, BACKGROUND, FIRST_OBJECT},
    robot::{
        catalogue::{Layout, Robot, Shape},
        mjcf,
    },
};

/// Joints of the arm; they have the first places of the state, the fingers the next two.
pub(crate) const ARM: usize = 7;
/// Joints of arm and gripper.
pub(crate) const JOINTS: usize = ARM + 2;

const SCENE_FILE: &str = "scene.xml";

/// What an object is.
#[derive(Clone, Debug)]
pub(crate) struct Object {
    pub(crate) shape: Shape,
    /// Half edge, or radius; a cylinder is as high as wide.
    pub(crate) half_size: f64,
    pub(crate) colour: [f64; 3],
}

/// The simulated scene of one episode.
#[derive(Clone, Debug)]
pub(crate) struct World {
    pub(crate) data: MjData<Rc<MjModel>>,
    /// Label of each geom.
    labels: Vec<u8>,
    /// Body of each object.
    bodies: Vec<usize>,
    /// Where the state of each object begins among the positions: x, y, z, quaternion.
    starts: Vec<usize>,
    /// The point between the fingertips.
    site: usize,
}

/// What touched what during a frame.
#[derive(Clone, Debug)]
pub(crate) struct Touches {
    pub(crate) agent: Vec<bool>,
    /// `[N,N]`
    pub(crate) objects: Vec<bool>,
}

/// The robot's files, as MuJoCo takes them.
pub(crate) fn assets(robot: Robot) -> Result<MjVfs> {
    let mut files = MjVfs::new();
    for (name, bytes) in robot.files() {
        files
            .add_from_buffer(name, bytes)
            .map_err(|source| Error::Asset { name: (*name).into(), source })?;
    }
    Ok(files)
}

/// Draws the objects of an episode: no two of a colour.
pub(crate) fn draw_objects(layout: &Layout, rng: &mut impl Rng) -> Vec<Object> {
    let kinds = &layout.objects;
    let count = rng.random_range(kinds.least..=kinds.most);
    let mut colours = kinds.colours.to_vec();
    colours.shuffle(rng);
    let [least, most] = kinds.half_size;
    let mut object = |colour| Object {
        shape: kinds.shapes[rng.random_range(0..kinds.shapes.len())],
        half_size: rng.random_range(least..=most),
        colour,
    };
    colours.into_iter().take(count).map(&mut object).collect()
}

impl World {
    /// Compiles the scene. The robot stands at zero and the objects lie in one place: set both.
    pub(crate) fn new(
        files: &mut MjVfs,
        layout: &Layout,
        objects: &[Object],
        camera: &Camera,
        size: u32,
    ) -> Result<Self> {
        let text = mjcf::scene(layout, objects, camera, size);
        let asset = |source| Error::Asset { name: SCENE_FILE.into(), source };
        files.add_from_buffer(SCENE_FILE, text.as_bytes()).map_err(asset)?;
        let model = MjModel::from_xml_vfs(SCENE_FILE, files);
        files.delete_file(SCENE_FILE).map_err(asset)?;
        let model = Rc::new(model.map_err(|source| Error::Model { source })?);

        let id = |kind, name: &str| model.name_to_id(kind, name).unwrap_or_default();
        let bodies: Vec<usize> =
            (0..objects.len()).map(|i| id(MjtObjBase::mjOBJ_BODY, &format!("object{i}"))).collect();
        let first_joints = bodies.iter().map(|&body| model.body_jntadr()[body] as usize);
        let starts = first_joints.map(|joint| model.jnt_qposadr()[joint] as usize).collect();
        let label = |&body: &i32| {
            let body = body as usize;
            match bodies.iter().position(|&object| object == body) {
                Some(object) => FIRST_OBJECT + object as u8,
                // What hangs on no joint never moves, be it of the robot.
                None if model.body_weldid()[body] == 0 => BACKGROUND,
                None => AGENT,
            }
        };
        let labels = model.geom_bodyid().iter().map(label).collect();
        let site = id(MjtObjBase::mjOBJ_SITE, "grip_site");
        Ok(Self { data: MjData::new(model), labels, bodies, starts, site })
    }

    /// Number of objects.
    pub(crate) fn objects(&self) -> usize {
        self.bodies.len()
    }

    /// Label of a geom.
    pub(crate) fn label(&self, geom: usize) -> u8 {
        self.labels[geom]
    }

    /// Centre of an object.
    pub(crate) fn position(&self, object: usize) -> [f64; 3] {
        self.data.xpos()[self.bodies[object]]
    }

    /// Orientation of an object, w, x, y, z.
    pub(crate) fn quaternion(&self, object: usize) -> [f64; 4] {
        self.data.xquat()[self.bodies[object]]
    }

    /// Puts an object somewhere. Call [`World::forward`] after the last one.
    pub(crate) fn place(&mut self, object: usize, position: [f64; 3], yaw: f64) {
        let start = self.starts[object];
        let pose = &mut self.data.qpos_mut()[start..start + 7];
        pose[..3].copy_from_slice(&position);
        pose[3..].copy_from_slice(&[(yaw / 2.0).cos(), 0.0, 0.0, (yaw / 2.0).sin()]);
    }

    /// Brings everything that is derived from the state up to date with it.
    pub(crate) fn forward(&mut self) {
        self.data.forward();
    }

    /// The point between the fingertips.
    pub(crate) fn hand(&self) -> Vector3<f64> {
        self.data.site_xpos()[self.site].into()
    }

    /// How the hand is turned.
    pub(crate) fn hand_axes(&self) -> Matrix3<f64> {
        Matrix3::from_row_slice(&self.data.site_xmat()[self.site])
    }

    /// The site between the fingertips.
    pub(crate) fn site(&self) -> usize {
        self.site
    }

    /// Positions of the arm's joints.
    pub(crate) fn arm(&self) -> [f64; ARM] {
        std::array::from_fn(|joint| self.data.qpos()[joint])
    }

    /// Adds what touches now.
    pub(crate) fn note_touches(&self, touches: &mut Touches) {
        let objects = self.objects();
        for contact in self.data.contact() {
            let [a, b] = contact.geom.map(|geom| self.labels[geom as usize]);
            let (a, b) = (a.min(b), a.max(b));
            if b < FIRST_OBJECT {
                continue;
            }
            let second = usize::from(b - FIRST_OBJECT);
            if a == AGENT {
                touches.agent[second] = true;
            } else if a >= FIRST_OBJECT {
                let first = usize::from(a - FIRST_OBJECT);
                touches.objects[first * objects + second] = true;
                touches.objects[second * objects + first] = true;
            }
        }
    }
}

impl Touches {
    pub(crate) fn none(objects: usize) -> Self {
        Self { agent: vec![false; objects], objects: vec![false; objects * objects] }
    }
}
