//! Elastic spheres in a box, from collision to collision: times are solved for, not stepped over.

use nalgebra::Vector3;

use crate::balls::BOX;

/// The state of all balls. The mass of a ball is the cube of its radius.
#[derive(Clone, Debug)]
pub(super) struct Motion {
    pub(super) positions: Vec<[f64; 3]>,
    pub(super) velocities: Vec<[f64; 3]>,
    pub(super) radii: Vec<f64>,
}

/// What happens next.
#[derive(Clone, Copy, Debug)]
enum Event {
    /// A ball meets the wall across an axis.
    Wall { ball: usize, axis: usize },
    /// Two balls meet.
    Balls([usize; 2]),
}

impl Motion {
    /// Moves on by `seconds` and tells which balls met, in order.
    pub(super) fn advance(&mut self, seconds: f64) -> Vec<[usize; 2]> {
        let mut left = seconds;
        let mut met = Vec::new();
        while let Some((time, event)) = self.next().filter(|(time, _)| *time < left) {
            self.glide(time);
            left -= time;
            match event {
                Event::Wall { ball, axis } => self.velocities[ball][axis] *= -1.0,
                Event::Balls(pair) => {
                    self.bounce(pair);
                    met.push(pair);
                }
            }
        }
        self.glide(left);
        met
    }

    /// Everything that the future depends on.
    pub(super) fn numbers(&self) -> Vec<f64> {
        let vectors = self.positions.iter().chain(&self.velocities);
        vectors.flatten().chain(&self.radii).copied().collect()
    }

    fn next(&self) -> Option<(f64, Event)> {
        let balls = 0..self.radii.len();
        let walls = balls.clone().flat_map(|ball| {
            (0..3).map(move |axis| (self.until_wall(ball, axis), Event::Wall { ball, axis }))
        });
        let pairs = balls.clone().flat_map(|a| (a + 1..balls.end).map(move |b| [a, b]));
        let meetings = pairs.filter_map(|pair| Some((self.until_met(pair)?, Event::Balls(pair))));
        walls.chain(meetings).min_by(|(a, _), (b, _)| a.total_cmp(b))
    }

    fn until_wall(&self, ball: usize, axis: usize) -> f64 {
        let (position, velocity) = (self.positions[ball][axis], self.velocities[ball][axis]);
        let reach = BOX[axis] - self.radii[ball];
        if velocity == 0.0 {
            return f64::INFINITY;
        }
        // Rounding may have put the ball a hair into the wall.
        ((reach * velocity.signum() - position) / velocity).max(0.0)
    }

    /// Time until |p + v t| = r_a + r_b, for balls that approach each other.
    fn until_met(&self, [a, b]: [usize; 2]) -> Option<f64> {
        let apart = Vector3::from(self.positions[a]) - Vector3::from(self.positions[b]);
        let relative = Vector3::from(self.velocities[a]) - Vector3::from(self.velocities[b]);
        let approach = apart.dot(&relative);
        let speed = relative.norm_squared();
        let gap = apart.norm_squared() - (self.radii[a] + self.radii[b]).powi(2);
        let discriminant = approach * approach - speed * gap;
        (approach < 0.0 && discriminant > 0.0)
            .then(|| ((-approach - discriminant.sqrt()) / speed).max(0.0))
    }

    fn glide(&mut self, seconds: f64) {
        for (position, velocity) in self.positions.iter_mut().zip(&self.velocities) {
            for (at, speed) in position.iter_mut().zip(velocity) {
                *at += speed * seconds;
            }
        }
    }

    /// Exchanges momentum along the line between two balls, without loss of energy.
    fn bounce(&mut self, [a, b]: [usize; 2]) {
        let [p, q] = [a, b].map(|ball| Vector3::from(self.positions[ball]));
        let [v, w] = [a, b].map(|ball| Vector3::from(self.velocities[ball]));
        let [m, n] = [a, b].map(|ball| self.radii[ball].powi(3));
        let line = (p - q).normalize();
        let impulse = 2.0 * (v - w).dot(&line) / (1.0 / m + 1.0 / n);
        self.velocities[a] = (v - line * (impulse / m)).into();
        self.velocities[b] = (w + line * (impulse / n)).into();
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{
        Environment as _, Scene,
        balls::Balls,
        seeds::{Stream, rng},
    };

    fn energy(motion: &Motion) -> f64 {
        let one = |(v, r): (&[f64; 3], &f64)| r.powi(3) * Vector3::from(*v).norm_squared() / 2.0;
        motion.velocities.iter().zip(&motion.radii).map(one).sum()
    }

    fn begin(count: usize, seed: u64) -> Motion {
        Balls::open(Scene::Balls9, count, 16).begin(&mut rng(seed, Stream::Scene)).unwrap()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn energy_stays_and_nothing_overlaps(seed: u64, count in 2_usize..=9) {
            let mut motion = begin(count, seed);
            let before = energy(&motion);
            for _ in 0..100 {
                motion.advance(0.1);
                for (ball, position) in motion.positions.iter().enumerate() {
                    for (at, half) in position.iter().zip(BOX) {
                        prop_assert!(at.abs() <= half - motion.radii[ball] + 1e-9);
                    }
                    for other in 0..ball {
                        let apart = Vector3::from(*position) - Vector3::from(motion.positions[other]);
                        prop_assert!(apart.norm() >= motion.radii[ball] + motion.radii[other] - 1e-9);
                    }
                }
            }
            prop_assert!((energy(&motion) / before - 1.0).abs() < 1e-9);
        }

        #[test]
        fn frames_do_not_change_what_happens(seed: u64) {
            let mut coarse = begin(6, seed);
            let mut fine = coarse.clone();
            let met = coarse.advance(2.0);
            let met_finely: Vec<_> = (0..20).flat_map(|_| fine.advance(0.1)).collect();
            prop_assert_eq!(met, met_finely);
            for (a, b) in coarse.numbers().iter().zip(fine.numbers()) {
                prop_assert!((a - b).abs() < 1e-6, "{} {}", a, b);
            }
        }
    }

    #[test]
    fn a_head_on_collision_exchanges_velocities() {
        let mut motion = Motion {
            positions: vec![[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]],
            velocities: vec![[0.5, 0.0, 0.0], [0.0; 3]],
            radii: vec![0.2, 0.2],
        };
        // 0.6 m apart at 0.5 m/s.
        assert!(motion.advance(1.19).is_empty());
        assert_eq!(motion.advance(0.02), [[0, 1]]);
        assert_eq!(motion.velocities, [[0.0; 3], [0.5, 0.0, 0.0]]);
    }

    #[test]
    fn momentum_stays_in_a_collision_of_unequal_balls() {
        let mut motion = Motion {
            positions: vec![[-0.3, 0.0, 0.05], [0.3, 0.0, 0.0]],
            velocities: vec![[0.9, 0.1, 0.0], [-0.3, 0.0, 0.2]],
            radii: vec![0.14, 0.26],
        };
        let momentum = |motion: &Motion| -> Vector3<f64> {
            let parts = motion.velocities.iter().zip(&motion.radii);
            parts.map(|(v, r)| r.powi(3) * Vector3::from(*v)).sum()
        };
        let before = momentum(&motion);
        assert_eq!(motion.advance(0.3), [[0, 1]]);
        assert!((momentum(&motion) - before).norm() < 1e-15);
    }

    #[test]
    fn the_same_seed_makes_the_same_episode() {
        let mut balls = Balls::open(Scene::Balls3, 3, 16);
        let mut play = || {
            balls.reset(5).unwrap();
            (0..20).map(|_| balls.step(&[]).unwrap()).collect::<Vec<_>>()
        };
        assert_eq!(play(), play());
    }
}
