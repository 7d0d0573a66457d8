//! How much of the objects' motion is foreseen or followed: displacements since a frame beside the true ones, of objects
//! that did move.

use std::collections::BTreeMap;

use gatsbi_models::scene::Scene;
use tch::Tensor;

use super::decomposition::{found_objects, true_objects};

/// An object has moved when its centre is this far from where it was, in pixels.
const MOVED_PIXELS: f64 = 2.0;

type Point = [f64; 2];

/// The objects of one episode at the frame that displacements are measured from.
#[derive(Debug)]
pub struct Starts {
    /// Identity, found and true centre by label.
    objects: BTreeMap<i64, (i64, Point, Point)>,
}

/// Over objects that have moved: how many, and sums of distances in pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Motion {
    /// Objects that have moved.
    pub moved: usize,
    /// Those of them that still have their identity; the rest is about these.
    pub kept: usize,
    /// Between the believed displacement and the true one.
    pub error: f64,
    /// Between none and the true one.
    pub still: f64,
    /// Of the believed displacement, along the true one.
    pub way: f64,
}

impl Starts {
    /// Of row `row` with labels `[H, W]` and the `(label, identity)` pairs matched there.
    pub fn new(matches: &[(i64, i64)], scene: &Scene, labels: &Tensor, row: i64) -> Self {
        let (found, truth) = centres(scene, labels, row);
        let objects = matches.iter().filter_map(|(label, identity)| {
            Some((*label, (*identity, *found.get(identity)?, *truth.get(label)?)))
        });
        Self { objects: objects.collect() }
    }

    /// What has moved up to a later frame whose labels are `[H, W]`.
    pub fn step(&self, scene: &Scene, labels: &Tensor, row: i64) -> Motion {
        let (found, truth) = centres(scene, labels, row);
        let mut motion = Motion::default();
        for (label, (identity, found_then, truth_then)) in &self.objects {
            let Some(actual) = truth.get(label).map(|truth| minus(truth, truth_then)) else {
                continue;
            };
            let still = length(actual);
            if still < MOVED_PIXELS {
                continue;
            }
            motion.moved += 1;
            if let Some(believed) = found.get(identity).map(|found| minus(found, found_then)) {
                motion.kept += 1;
                motion.error += length(minus(&believed, &actual));
                motion.still += still;
                motion.way += (believed[0] * actual[0] + believed[1] * actual[1]) / still;
            }
        }
        motion
    }
}

/// Centres by identity and by label.
fn centres(
    scene: &Scene,
    labels: &Tensor,
    row: i64,
) -> (BTreeMap<i64, Point>, BTreeMap<i64, Point>) {
    let found = found_objects(scene, row, labels.size()[0] as f64);
    (found.into_iter().collect(), true_objects(labels).into_iter().collect())
}

fn minus(a: &Point, b: &Point) -> Point {
    [a[0] - b[0], a[1] - b[1]]
}

fn length([x, y]: Point) -> f64 {
    x.hypot(y)
}

#[cfg(test)]
mod tests {
    use super::{
        super::samples::{labels, scene},
        *,
    };

    #[test]
    fn displacements_are_compared_wherever_the_object_was_found() {
        // Object 7 was found one pixel beside its true place, which is column 9.5.
        let starts = Starts::new(&[(2, 7), (3, 9)], &scene([10.5, 41.5]), &labels([8, 40]), 0);
        // Label 2 moves by six pixels and is imagined to move by four; label 3 rests.
        let motion = starts.step(&scene([14.5, 47.5]), &labels([14, 40]), 0);
        assert_eq!((motion.moved, motion.kept), (1, 1));
        assert!((motion.error - 2.0).abs() < 1e-4, "{motion:?}");
        assert!((motion.still - 6.0).abs() < 1e-4, "{motion:?}");
        assert!((motion.way - 4.0).abs() < 1e-4, "{motion:?}");
        // Of an object whose identity is lost nothing but that is counted.
        let mut lost = scene([14.5, 47.5]);
        let table = lost.objects.as_mut().expect("a table");
        table.ids = Tensor::from_slice(&[8i64, 9]).view([1, 2]);
        let lost = starts.step(&lost, &labels([14, 40]), 0);
        assert_eq!(lost, Motion { moved: 1, ..Motion::default() });
    }
}
