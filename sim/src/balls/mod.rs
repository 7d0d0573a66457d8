//! BALLS: elastic spheres in a closed box without gravity, seen from the front as a depth image. Nobody acts.
//!
//! Its physics is exact, event by event, and its pictures are computed ray by ray, so it needs neither MuJoCo nor OpenGL.

mod motion;
mod picture;

use rand::{RngExt as _, rngs::ChaCha8Rng};
use rand_distr::StandardNormal;

use crate::{
    Environment, Error, Goal, HandMove, ObjectState, Observation, Result, Scene, SceneSpec, State,
    balls::{motion::Motion, picture::View},
    seeds::{Stream, rng},
};

/// Half the box: to the right, away from the camera, up; metres.
const BOX: [f64; 3] = [1.0, 0.6, 1.0];
const FRAMES: usize = 100;
const PERIOD: f64 = 0.1;
/// Least and greatest speed, m/s.
const SPEED: [f64; 2] = [0.3, 0.9];
/// Between surfaces when an episode begins.
const GAP: f64 = 0.02;
/// Tries to place all balls anew, and each of them.
const LAYOUTS: usize = 100;
const PLACES: usize = 1000;

/// The scene with a number of balls.
#[derive(Debug)]
pub(crate) struct Balls {
    spec: SceneSpec,
    count: usize,
    view: View,
    episode: Option<(Motion, usize)>,
}

impl Balls {
    pub(crate) fn open(scene: Scene, count: usize, size: u32) -> Self {
        let spec = SceneSpec {
            scene: scene.name(),
            size,
            frames: FRAMES,
            frame_period_seconds: PERIOD,
            max_objects: count,
            actions: Vec::new(),
        };
        Self { spec, count, view: View::new(size), episode: None }
    }

    /// Least and greatest radius: fewer balls are larger, so that they meet often enough.
    fn radii(&self) -> [f64; 2] {
        match self.count {
            0..=3 => [0.20, 0.32],
            4..=6 => [0.14, 0.26],
            _ => [0.12, 0.22],
        }
    }

    fn begin(&self, rng: &mut ChaCha8Rng) -> Result<Motion> {
        let [least, most] = self.radii();
        let radii: Vec<f64> = (0..self.count).map(|_| rng.random_range(least..most)).collect();
        let positions = place(&radii, rng)?;
        let velocity = |_| {
            let direction: [f64; 3] = std::array::from_fn(|axis| {
                let normal: f64 = rng.sample(StandardNormal);
                normal * BOX[axis]
            });
            let length = direction.iter().map(|part| part * part).sum::<f64>().sqrt();
            let speed = rng.random_range(SPEED[0]..SPEED[1]);
            direction.map(|part| part / length * speed)
        };
        let velocities = (0..self.count).map(velocity).collect();
        Ok(Motion { positions, velocities, radii })
    }

    fn observe(&self, motion: &Motion, step: usize, met: Vec<bool>) -> Observation {
        let (rgb, mask) = self.view.of(motion);
        let object = |&position: &[f64; 3]| ObjectState {
            position,
            quaternion: [1.0, 0.0, 0.0, 0.0],
            pixel: self.view.project(position),
        };
        let state = State {
            step,
            objects: motion.positions.iter().map(object).collect(),
            contacts_objects: met,
            full: motion.numbers(),
            ..State::default()
        };
        Observation { rgb, mask, state }
    }
}

impl Environment for Balls {
    fn spec(&self) -> &SceneSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Result<Observation> {
        let motion = self.begin(&mut rng(seed, Stream::Scene))?;
        let seen = self.observe(&motion, 0, vec![false; self.count * self.count]);
        self.episode = Some((motion, 0));
        Ok(seen)
    }

    fn step(&mut self, action: &[f32]) -> Result<Observation> {
        let (mut motion, step) = self.episode.take().ok_or(Error::NotReset)?;
        if let Err(error) = self.spec.check(action) {
            self.episode = Some((motion, step));
            return Err(error);
        }
        let mut met = vec![false; self.count * self.count];
        for [a, b] in motion.advance(PERIOD) {
            met[a * self.count + b] = true;
            met[b * self.count + a] = true;
        }
        let seen = self.observe(&motion, step + 1, met);
        self.episode = Some((motion, step + 1));
        Ok(seen)
    }

    fn scripted_action(&mut self) -> Result<Vec<f32>> {
        self.episode.as_ref().map(|_| Vec::new()).ok_or(Error::NotReset)
    }

    fn set_goal(&mut self, _goal: &Goal) -> Result<Observation> {
        Err(Error::NobodyActs { scene: self.spec.scene })
    }

    fn futures(&mut self, _candidates: &[Vec<Vec<f32>>]) -> Result<Vec<Vec<Vec<ObjectState>>>> {
        Err(Error::NobodyActs { scene: self.spec.scene })
    }

    fn hand_moves(&mut self, _candidates: &[Vec<[f64; 2]>]) -> Result<Vec<Vec<HandMove>>> {
        Err(Error::NobodyActs { scene: self.spec.scene })
    }
}

/// Places in the box with room between the balls.
fn place(radii: &[f64], rng: &mut ChaCha8Rng) -> Result<Vec<[f64; 3]>> {
    'layout: for _ in 0..LAYOUTS {
        let mut places: Vec<[f64; 3]> = Vec::with_capacity(radii.len());
        for &radius in radii {
            let mut draw = || {
                BOX.map(|half| {
                    let reach = half - radius - GAP;
                    rng.random_range(-reach..reach)
                })
            };
            let is_free = |at: &[f64; 3]| {
                places.iter().zip(radii).all(|(place, other)| {
                    let squares = place.iter().zip(at).map(|(a, b)| (a - b).powi(2));
                    squares.sum::<f64>().sqrt() > radius + other + GAP
                })
            };
            let place = (0..PLACES).map(|_| draw()).find(is_free);
            let Some(place) = place else { continue 'layout };
            places.push(place);
        }
        return Ok(places);
    }
    Err(Error::NoRoom { what: "the balls" })
}
