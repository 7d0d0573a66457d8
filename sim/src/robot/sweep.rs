//! The script of the robot scenes: pick an object, go behind it, push through it, and again.
//!
//! A push begins on the side of the object that is away from the tray's centre, more or less, and ends before the rim:
//! objects that are squeezed against the rim would jump out. On its way the hand does not go around objects, so it
//! touches others too.
//!
//! Where the layout says so, it plays instead: it pushes from any side, also past an object's middle, and wanders into
//! objects as a planner's candidates do. Or it goes around between fixed places, whatever lies there.

use std::{collections::VecDeque, f64::consts::TAU};

use nalgebra::{Vector2, Vector3};
use rand::{RngExt as _, rngs::ChaCha8Rng};
use rand_distr::StandardNormal;

use crate::robot::catalogue::{Aim, Script, Tray};

/// Tries for a push that keeps every rule.
const TRIES: usize = 200;
/// Distance from the object's centre at which a push begins.
const BEHIND: [f64; 2] = [0.09, 0.13];
/// Distance that a push keeps from all objects where it begins.
const CLEARANCE: f64 = 0.07;
/// The hand keeps this far from the rim.
pub(crate) const RIM_MARGIN: f64 = 0.035;
/// An object that is pushed keeps so many of its half sizes from the rim, besides.
const RIM_HALF_SIZES: f64 = 2.3;
/// In play, distance from the object's centre at which a push begins, whatever else lies there; how far beside the centre
/// it goes, at most.
const PLAY_BEHIND: [f64; 2] = [0.06, 0.12];
const PLAY_BESIDE: f64 = 0.03;
/// How often the hand wanders instead, for how many frames, the spread and the greatest of its moves along an axis in one,
/// metres, and by how much more of the spread it turns from frame to frame.
const WANDER_OFTEN: f64 = 0.75;
const WANDER_FRAMES: usize = 5;
const WANDER_SPREAD: f64 = 0.042;
const WANDER_MOST: f64 = 0.06;
const WANDER_TURN: f64 = 0.4;
/// It touches an object whose centre comes this near to its way; most ways do.
const WANDER_TOUCH: f64 = 0.045;
const WANDER_TRIES: usize = 20;
/// Spread of the direction around the one to the tray's centre, radians, and how it grows from try to try.
const SPREAD: [f64; 2] = [0.5, 0.02];
/// Between pushes the hand is faster by this much.
const APPROACH_FASTER: f64 = 1.3;
const RISE_FASTER: f64 = 1.2;

/// The script of one episode.
#[derive(Debug)]
pub(crate) struct Sweeps {
    rng: ChaCha8Rng,
    script: &'static Script,
    tray: &'static Tray,
    /// Where the hand goes, and how fast.
    ways: VecDeque<(Vector3<f64>, f64)>,
    /// The place of a cycle that comes next.
    turn: usize,
}

impl Sweeps {
    pub(crate) fn new(mut rng: ChaCha8Rng, script: &'static Script, tray: &'static Tray) -> Self {
        let turn = match &script.aim {
            Aim::Objects { .. } | Aim::Play { .. } => 0,
            Aim::Cycle { places, .. } => rng.random_range(0..places.len()),
        };
        Self { rng, script, tray, ways: VecDeque::new(), turn }
    }

    /// A number of the normal distribution with this spread.
    pub(crate) fn jitter(&mut self, spread: f64) -> f64 {
        let normal: f64 = self.rng.sample(StandardNormal);
        spread * normal
    }

    /// Where the hand is one period later.
    pub(crate) fn next(
        &mut self,
        mut hand: Vector3<f64>,
        objects: &[[f64; 3]],
        half_size: f64,
        period: f64,
    ) -> Vector3<f64> {
        let mut left = period;
        while left > 1e-9 {
            let Some(&(goal, speed)) = self.ways.front() else {
                match &self.script.aim {
                    Aim::Objects { sweep } => {
                        let push = |script: &mut Self, attempt| {
                            script.push(objects, half_size, *sweep, attempt)
                        };
                        self.plan(hand, push);
                    }
                    Aim::Play { .. } if self.rng.random_bool(WANDER_OFTEN) => {
                        self.wander(hand, objects, half_size, period);
                    }
                    Aim::Play { sweep } => {
                        self.plan(hand, |script, _| script.play(objects, half_size, *sweep));
                    }
                    Aim::Cycle { places, spread } => self.go_on(places, *spread),
                }
                continue;
            };
            let way = goal - hand;
            let distance = way.norm();
            if distance <= speed * left {
                hand = goal;
                left -= distance / speed;
                self.ways.pop_front();
            } else {
                hand += way / distance * (speed * left);
                left = 0.0;
            }
        }
        hand
    }

    /// To the next place of the cycle.
    fn go_on(&mut self, places: &[[f64; 2]], spread: f64) {
        let place = places[self.turn].map(|at| at + self.jitter(spread));
        let [x, y] = self.tray.clamp(place, RIM_MARGIN);
        let [slow, fast] = self.script.speed;
        let speed = self.rng.random_range(slow..fast);
        self.ways.push_back((Vector3::new(x, y, self.script.height), speed));
        self.turn = (self.turn + 1) % places.len();
    }

    /// To the start of a push and to its end; `push` is tried until there is one.
    fn plan(
        &mut self,
        hand: Vector3<f64>,
        mut push: impl FnMut(&mut Self, usize) -> Option<([f64; 2], [f64; 2])>,
    ) {
        let push = (0..TRIES).find_map(|attempt| push(self, attempt));
        let [slow, fast] = self.script.speed;
        let speed = self.rng.random_range(slow..fast);
        let (low, high) = (self.script.height, self.script.travel_height);
        let at = |place: [f64; 2], height| Vector3::new(place[0], place[1], height);
        if high > low {
            self.ways.push_back((Vector3::new(hand.x, hand.y, high), RISE_FASTER * speed));
        }
        if let Some((start, end)) = push {
            self.ways.push_back((at(start, high), APPROACH_FASTER * speed));
            self.ways.push_back((at(start, low), speed));
            self.ways.push_back((at(end, low), speed));
        } else {
            // It looks again from elsewhere.
            let elsewhere = self.tray.draw(RIM_MARGIN, &mut self.rng);
            self.ways.push_back((at(elsewhere, high), speed));
        }
    }

    /// Start and end of a push through a random object, if it keeps the rules.
    fn push(
        &mut self,
        objects: &[[f64; 3]],
        half_size: f64,
        [least, most]: [f64; 2],
        attempt: usize,
    ) -> Option<([f64; 2], [f64; 2])> {
        let flat = |at: &[f64; 3]| Vector2::new(at[0], at[1]);
        let clamp = |at: Vector2<f64>, margin| Vector2::from(self.tray.clamp(at.into(), margin));
        let object = flat(&objects[self.rng.random_range(0..objects.len())]);
        let inwards = Vector2::from(self.tray.centre) - object;
        let angle =
            inwards.y.atan2(inwards.x) + self.jitter(SPREAD[0] + SPREAD[1] * attempt as f64);
        let along = Vector2::new(angle.cos(), angle.sin());
        let behind = object - along * self.rng.random_range(BEHIND[0]..BEHIND[1]);
        let beyond = object + along * self.rng.random_range(least..most);
        let start = clamp(behind, RIM_MARGIN);
        let end = clamp(beyond, RIM_MARGIN + RIM_HALF_SIZES * half_size);
        let reachable = (start - behind).norm() < 0.01;
        let forwards = (end - object).dot(&along) > 0.0;
        let clear = objects.iter().all(|other| (flat(other) - start).norm() > CLEARANCE);
        (reachable && forwards && clear).then(|| (start.into(), end.into()))
    }

    /// Start and end of a push in any direction.
    fn play(
        &mut self,
        objects: &[[f64; 3]],
        half_size: f64,
        [least, most]: [f64; 2],
    ) -> Option<([f64; 2], [f64; 2])> {
        let [x, y, _] = objects[self.rng.random_range(0..objects.len())];
        let object = Vector2::new(x, y);
        let angle = self.rng.random_range(0.0..TAU);
        let along = Vector2::new(angle.cos(), angle.sin());
        let across = Vector2::new(-along.y, along.x);
        let middle = object + across * self.rng.random_range(-PLAY_BESIDE..PLAY_BESIDE);
        let start = middle - along * self.rng.random_range(PLAY_BEHIND[0]..PLAY_BEHIND[1]);
        let end = middle + along * self.rng.random_range(least..most);
        let reachable = start == Vector2::from(self.tray.clamp(start.into(), RIM_MARGIN));
        let end = self.tray.clamp(end.into(), RIM_MARGIN + RIM_HALF_SIZES * half_size);
        reachable.then(|| (start.into(), end))
    }

    /// Some frames of moves that turn slowly, preferably into an object.
    fn wander(&mut self, hand: Vector3<f64>, objects: &[[f64; 3]], half_size: f64, period: f64) {
        let mut way = vec![];
        for _ in 0..WANDER_TRIES {
            way = self.moves(hand.xy(), RIM_MARGIN + half_size);
            let touches = |object: &[f64; 3]| {
                way.iter().any(|at| (at - Vector2::new(object[0], object[1])).norm() < WANDER_TOUCH)
            };
            if objects.iter().any(touches) {
                break;
            }
        }
        let mut from = hand.xy();
        for at in way {
            let speed = ((at - from).norm() / period).max(self.script.speed[0]);
            self.ways.push_back((Vector3::new(at.x, at.y, self.script.height), speed));
            from = at;
        }
    }

    /// Where moves that turn slowly lead from a place.
    fn moves(&mut self, mut at: Vector2<f64>, margin: f64) -> Vec<Vector2<f64>> {
        let tray = self.tray;
        let mut draw = || Vector2::new(self.jitter(WANDER_SPREAD), self.jitter(WANDER_SPREAD));
        let mut step = draw();
        let mut one = || {
            at += step.map(|part| part.clamp(-WANDER_MOST, WANDER_MOST));
            at = Vector2::from(tray.clamp(at.into(), margin));
            step += draw() * WANDER_TURN;
            at
        };
        (0..WANDER_FRAMES).map(|_| one()).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use rand::SeedableRng as _;

    use super::*;
    use crate::{Scene, robot::catalogue::Layout};

    const OBJECTS: [[f64; 3]; 3] = [[0.45, 0.1, 0.03], [0.6, -0.12, 0.03], [0.5, -0.02, 0.03]];

    fn sweeps(scene: Scene, seed: u64) -> Sweeps {
        let layout = Layout::of(scene).unwrap();
        Sweeps::new(ChaCha8Rng::seed_from_u64(seed), &layout.script, &layout.tray)
    }

    #[test]
    fn the_hand_stays_in_the_tray_and_keeps_its_speed() {
        for (scene, period) in [(Scene::Push1, 0.2), (Scene::Push1Play, 0.2), (Scene::Push2, 0.1)] {
            let mut sweeps = sweeps(scene, 1);
            let (script, tray) = (sweeps.script, sweeps.tray);
            let mut hand = Vector3::new(0.5, 0.0, script.travel_height);
            for _ in 0..400 {
                let next = sweeps.next(hand, &OBJECTS, 0.035, period);
                let fastest = script.speed[1] * APPROACH_FASTER * period;
                assert!((next - hand).norm() <= fastest + 1e-9);
                assert!(tray.holds(next.xy().into()));
                assert!((script.height - 1e-9..=script.travel_height + 1e-9).contains(&next.z));
                hand = next;
            }
        }
    }

    #[test]
    fn a_push_goes_through_an_object_and_ends_before_the_rim() {
        let mut through = 0;
        for seed in 0..50 {
            let mut sweeps = sweeps(Scene::Push1, seed);
            let Aim::Objects { sweep } = sweeps.script.aim else { panic!() };
            sweeps.plan(Vector3::new(0.4, 0.0, 0.03), |script, attempt| {
                script.push(&OBJECTS, 0.035, sweep, attempt)
            });
            let (end, _) = *sweeps.ways.back().unwrap();
            let (start, _) = sweeps.ways[sweeps.ways.len() - 2];
            let margin = RIM_MARGIN + RIM_HALF_SIZES * 0.035;
            let (at, way) = (end.xy(), (end - start).xy());
            assert!((Vector2::from(sweeps.tray.clamp(at.into(), margin)) - at).norm() < 1e-12);
            let passes = |object: &[f64; 3]| {
                let to = Vector2::new(object[0], object[1]) - start.xy();
                let along = (to.dot(&way) / way.norm_squared()).clamp(0.0, 1.0);
                (to - along * way).norm() < 0.035
            };
            through += usize::from(OBJECTS.iter().any(passes));
        }
        assert!(through >= 48, "{through} of 50 pushes go through an object");
    }

    #[test]
    fn play_pushes_from_every_side() {
        let mut sweeps = sweeps(Scene::Push1Play, 3);
        let Aim::Play { sweep } = sweeps.script.aim else { panic!() };
        let object = [[0.52, 0.0, 0.03]];
        let mut sides = [0; 4];
        for _ in 0..400 {
            let Some((start, end)) = sweeps.play(&object, 0.035, sweep) else { continue };
            let way = Vector2::from(end) - Vector2::from(start);
            let quarter = (way.y.atan2(way.x) + PI) / FRAC_PI_2;
            sides[(quarter as usize).min(3)] += 1;
        }
        assert!(sides.iter().all(|&pushes| pushes > 60), "{sides:?}");
    }

    #[test]
    fn a_cycle_comes_back_to_its_places() {
        let mut sweeps = sweeps(Scene::RollCycle, 3);
        let Aim::Cycle { places, spread } = &sweeps.script.aim else { panic!() };
        let first = sweeps.turn;
        let mut hand = Vector3::new(0.5, 0.0, sweeps.script.height);
        let mut visits = vec![];
        while visits.len() < 40 {
            let turn = sweeps.turn;
            sweeps.go_on(places, *spread);
            let (goal, _) = *sweeps.ways.back().unwrap();
            visits.push((turn, goal));
        }
        for (number, (turn, goal)) in visits.iter().enumerate() {
            assert_eq!(*turn, (first + number) % 4);
            let miss = (goal.xy() - Vector2::from(places[*turn])).norm();
            assert!(miss < 6.0 * spread, "{miss}");
        }
        // The hand passes all of them, in order.
        for (_, goal) in &visits {
            let passes = (0..2000).any(|_| {
                hand = sweeps.next(hand, &OBJECTS, 0.04, 0.005);
                (hand - goal).norm() < 0.005
            });
            assert!(passes, "{goal}");
        }
    }
}
