//! What an imagined step measures: where things are, and how far that is from what a term asks for.

use super::cost::{Measure, Pixels, Rect, Subject};

/// Columns of the object table: presence, x, y, width, height, depth.
const COLUMNS: usize = 6;

/// A presence above this is an object that is there.
const PRESENT: f32 = 0.5;

/// A pixel whose mask is above this belongs to the agent's bounding box.
const INSIDE: f32 = 0.5;

/// An imagined step of one row.
#[derive(Clone, Copy, Debug)]
pub struct Step<'a> {
    /// Identities of the slots; negative where there never was an object.
    pub ids: &'a [i64],
    /// `[slots, 6]`: presence, x, y, width, height, depth.
    pub table: &'a [f32],
    /// The agent, if it was looked for and is seen.
    pub agent: Option<Seen>,
    /// What was looked for of its pictures.
    pub pictures: Pictures<'a>,
}

/// Pictures of an imagined step, values in [0, 1] times 255; empty where nothing looks at them.
#[derive(Clone, Copy, Debug, Default)]
pub struct Pictures<'a> {
    /// `[H, W, 3]`.
    pub frame: &'a [u8],
    /// `[H, W]`.
    pub agent: &'a [u8],
    /// `[slots, H, W]`.
    pub objects: &'a [u8],
}

impl Pictures<'_> {
    /// What all objects cover together.
    fn covered(&self, pixels: usize) -> Vec<f32> {
        let mut covered = vec![0.0; pixels];
        for mask in self.objects.chunks_exact(pixels) {
            for (sum, share) in covered.iter_mut().zip(mask) {
                *sum += f32::from(*share) / 255.0;
            }
        }
        covered
    }
}

/// Where something is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// Its centre.
    pub centre: [f32; 2],
    /// What bounds it.
    pub bounds: Rect,
}

impl Seen {
    /// Where a mask `[side, side]` is; nothing if it covers less than a pixel.
    pub fn of_mask(mask: &[f32], side: usize) -> Option<Self> {
        let half = side as f32 / 2.0;
        let (mut sum, mut centre) = (0.0f64, [0.0f64; 2]);
        let mut bounds = [f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY];
        for (at, share) in mask.iter().enumerate() {
            let (x, y) = ((at % side) as f32, (at / side) as f32);
            sum += f64::from(*share);
            centre[0] += f64::from(*share * (x + 0.5));
            centre[1] += f64::from(*share * (y + 0.5));
            if *share > INSIDE {
                bounds = [
                    bounds[0].min(x),
                    bounds[1].min(y),
                    bounds[2].max(x + 1.0),
                    bounds[3].max(y + 1.0),
                ];
            }
        }
        let centre = centre.map(|at| (at / sum) as f32 / half - 1.0);
        // Where nothing is clearly inside, it is a point.
        let bounds = if bounds[0] < bounds[2] {
            bounds.map(|at| at / half - 1.0)
        } else {
            [centre[0], centre[1], centre[0], centre[1]]
        };
        (sum >= 1.0).then_some(Self { centre, bounds: Rect(bounds) })
    }
}

impl Step<'_> {
    pub(super) fn object(&self, slot: usize) -> Option<Seen> {
        let [presence, x, y, width, height, _] =
            *self.table[slot * COLUMNS..][..COLUMNS].first_chunk::<COLUMNS>()?;
        // Sizes are fractions of the image, whose side is 2.
        let bounds = Rect([x - width, y - height, x + width, y + height]);
        (presence > PRESENT).then_some(Seen { centre: [x, y], bounds })
    }

    pub(super) fn slot(&self, id: i64) -> Option<usize> {
        self.ids.iter().position(|known| *known == id)
    }

    /// Where a subject is; those of its parts that are present.
    fn seen(&self, subject: Subject) -> Vec<(Subject, Seen)> {
        let object = |slot: usize| {
            let id = self.ids[slot];
            (id >= 0).then(|| Some((Subject::Object(id), self.object(slot)?))).flatten()
        };
        match subject {
            Subject::Agent => self.agent.map(|seen| (subject, seen)).into_iter().collect(),
            Subject::Object(id) => self.slot(id).and_then(object).into_iter().collect(),
            Subject::AllObjects => (0..self.ids.len()).filter_map(object).collect(),
        }
    }
}

/// Mean squared difference of a frame from a goal, over pixels that are weighted.
fn from_goal(goal: &[f32], pixels: Pixels, pictures: Pictures<'_>) -> f32 {
    let count = goal.len() / 3;
    let agent = || pictures.agent.iter().map(|x| f32::from(*x) / 255.0).collect::<Vec<_>>();
    let weights = match pixels {
        Pixels::All => vec![1.0; count],
        Pixels::Agent => agent(),
        Pixels::Objects => pictures.covered(count),
        Pixels::Background => {
            let covered = pictures.covered(count);
            let share = |(agent, objects): (f32, f32)| (1.0 - agent - objects).max(0.0);
            agent().into_iter().zip(covered).map(share).collect()
        }
    };
    let (goal, _) = goal.as_chunks::<3>();
    let (frame, _) = pictures.frame.as_chunks::<3>();
    let (mut sum, mut total) = (0.0f64, 0.0f64);
    for ((wanted, found), weight) in goal.iter().zip(frame).zip(weights) {
        let square = |(x, y): (&f32, &u8)| (x - f32::from(*y) / 255.0).powi(2);
        let difference: f32 = wanted.iter().zip(found).map(square).sum();
        sum += f64::from(weight * difference / 3.0);
        total += f64::from(weight);
    }
    // Less than a pixel is nothing.
    if total < 1.0 { 1.0 } else { (sum / total) as f32 }
}

/// 1 - intersection over union of masks in [0, 1].
fn apart(goal: &[f32], mask: impl Iterator<Item = f32>) -> f32 {
    let (both, either) = goal.iter().zip(mask).fold((0.0f64, 0.0f64), |(both, either), (x, y)| {
        (both + f64::from(x.min(y)), either + f64::from(x.max(y)))
    });
    if either > 0.0 { (1.0 - both / either) as f32 } else { 0.0 }
}

pub(super) fn mean(values: impl IntoIterator<Item = f32>) -> Option<f32> {
    let (sum, count) = values.into_iter().fold((0.0, 0u32), |(sum, n), x| (sum + x, n + 1));
    (count > 0).then(|| sum / count as f32)
}

fn power(x: f32, squared: bool) -> f32 {
    if squared { x * x } else { x }
}

/// Area that rectangles cover together.
fn covered(rects: &[Rect]) -> f32 {
    let edges = |axis: usize| {
        let mut edges: Vec<f32> = rects.iter().flat_map(|Rect(r)| [r[axis], r[axis + 2]]).collect();
        edges.sort_by(f32::total_cmp);
        edges
    };
    let (xs, ys) = (edges(0), edges(1));
    let mut area = 0.0;
    for x in xs.array_windows::<2>() {
        for y in ys.array_windows::<2>() {
            let inside =
                |Rect(r): &Rect| r[0] <= x[0] && x[1] <= r[2] && r[1] <= y[0] && y[1] <= r[3];
            if rects.iter().any(inside) {
                area += (x[1] - x[0]) * (y[1] - y[0]);
            }
        }
    }
    area
}

fn overlap(a: &[Rect], b: &[Rect]) -> f32 {
    let (of_a, of_b) = (covered(a), covered(b));
    let smaller = of_a.min(of_b);
    if smaller <= 0.0 {
        return 0.0;
    }
    ((of_a + of_b - covered(&[a, b].concat())) / smaller).clamp(0.0, 1.0)
}

/// What is measured at a step of one row; spreads are measured over rows and give nothing here.
pub(super) fn at_step(measure: &Measure, step: Step<'_>, missing: f32) -> f32 {
    let absent = |distance: Option<f32>| distance.unwrap_or(missing);
    match measure {
        Measure::ToTarget { subject, target, tolerance, squared } => {
            let distance = |[x, y]: [f32; 2]| (x - target[0]).hypot(y - target[1]);
            let beyond = |distance: f32| power((distance - tolerance).max(0.0), *squared);
            let all = step.seen(*subject);
            mean(all.iter().map(|(_, seen)| beyond(distance(seen.centre))))
                .unwrap_or_else(|| beyond(missing))
        }
        Measure::Between { a, b, distance, squared } => {
            let (left, right) = (step.seen(*a), step.seen(*b));
            let pairs = left.iter().flat_map(|one| right.iter().map(move |other| (one, other)));
            let found = pairs.filter(|(one, other)| one.0 != other.0).map(|(one, other)| {
                let ([x, y], [u, v]) = (one.1.centre, other.1.centre);
                power(((x - u).hypot(y - v) - distance).abs(), *squared)
            });
            mean(found).unwrap_or_else(|| power((missing - distance).abs(), *squared))
        }
        Measure::Region { subject, region, keep_out } => {
            let all = step.seen(*subject);
            let found = mean(all.iter().map(|(_, seen)| {
                if *keep_out {
                    region.depth_of(seen.centre)
                } else {
                    region.distance_to(seen.centre)
                }
            }));
            // What is not there is inside of nothing.
            if *keep_out { found.unwrap_or(0.0) } else { absent(found) }
        }
        Measure::Overlap { a, b } => {
            let (left, right) = (step.seen(*a), step.seen(*b));
            let without = |these: &[(Subject, Seen)], other: Subject| -> Vec<Rect> {
                let others = these.iter().filter(|(subject, _)| *subject != other);
                others.map(|(_, seen)| seen.bounds).filter(|rect| rect.area() > 0.0).collect()
            };
            overlap(&without(&left, *b), &without(&right, *a))
        }
        Measure::GoalImage { goal, pixels } => from_goal(goal, *pixels, step.pictures),
        Measure::GoalMasks { goals } => {
            let distances = goals.iter().map(|(subject, goal)| {
                let part = |mask: &[u8]| apart(goal, mask.iter().map(|x| f32::from(*x) / 255.0));
                match subject {
                    Subject::Agent => part(step.pictures.agent),
                    Subject::AllObjects => {
                        apart(goal, step.pictures.covered(goal.len()).into_iter())
                    }
                    Subject::Object(id) => step.slot(*id).map_or(1.0, |slot| {
                        part(&step.pictures.objects[slot * goal.len()..][..goal.len()])
                    }),
                }
            });
            mean(distances).unwrap_or(0.0)
        }
        Measure::ActionMagnitude { .. }
        | Measure::ActionSmoothness { .. }
        | Measure::Spread { .. } => 0.0,
    }
}

/// What is measured of actions `[H, A]` at a depth, from 0.
pub(super) fn of_actions(measure: &Measure, actions: &[f32], depth: usize) -> Option<f32> {
    let weighted = |weights: &[f32], difference: &dyn Fn(usize) -> f32| {
        weights.iter().enumerate().map(|(a, weight)| weight * difference(a).powi(2)).sum()
    };
    match measure {
        Measure::ActionMagnitude { weights } => {
            let action = &actions[depth * weights.len()..];
            Some(weighted(weights, &|a| action[a]))
        }
        Measure::ActionSmoothness { weights, previous } => {
            let action = &actions[depth * weights.len()..];
            let before = match (depth, previous) {
                (0, None) => return Some(0.0),
                (0, Some(previous)) => previous,
                _ => &actions[(depth - 1) * weights.len()..],
            };
            Some(weighted(weights, &|a| action[a] - before[a]))
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const IDS: [i64; 3] = [4, 9, -1];

    /// Object 4 at (0, 0), 0.4 wide; object 9 at (0.3, 0.4), 0.8 wide, present or not.
    fn table(second: f32) -> Vec<f32> {
        let one = [1.0, 0.0, 0.0, 0.2, 0.2, 0.0];
        let other = [second, 0.3, 0.4, 0.4, 0.4, 0.0];
        [one, other, [0.9; 6]].concat()
    }

    fn measured(measure: &Measure, second: f32) -> f32 {
        let agent = Some(Seen { centre: [-1.0, 0.0], bounds: Rect([-1.2, -0.2, -0.8, 0.2]) });
        at_step(
            measure,
            Step { ids: &IDS, table: &table(second), agent, pictures: Pictures::default() },
            2.0,
        )
    }

    #[track_caller]
    fn near(found: f32, expected: f32) {
        assert!((found - expected).abs() < 1e-5, "{found}, expected {expected}");
    }

    #[test]
    fn distances_to_targets() {
        let to = |subject, tolerance, squared| Measure::ToTarget {
            subject,
            target: [0.0, 0.0],
            tolerance,
            squared,
        };
        near(measured(&to(Subject::Object(9), 0.0, false), 1.0), 0.5);
        near(measured(&to(Subject::Object(9), 0.1, true), 1.0), 0.16);
        near(measured(&to(Subject::Object(9), 0.0, false), 0.2), 2.0);
        near(measured(&to(Subject::Agent, 0.0, false), 1.0), 1.0);
        near(measured(&to(Subject::AllObjects, 0.0, false), 1.0), 0.25);
        near(measured(&to(Subject::AllObjects, 0.0, false), 0.0), 0.0);
    }

    #[test]
    fn distances_between() {
        let between = |a, b, distance| Measure::Between { a, b, distance, squared: false };
        near(measured(&between(Subject::Object(4), Subject::Object(9), 0.2), 1.0), 0.3);
        near(measured(&between(Subject::Object(4), Subject::Object(9), 0.2), 0.0), 1.8);
        near(measured(&between(Subject::AllObjects, Subject::AllObjects, 0.0), 1.0), 0.5);
        let agent = f32::midpoint(1.0, 1.3f32.hypot(0.4));
        near(measured(&between(Subject::Agent, Subject::AllObjects, 0.0), 1.0), agent);
    }

    #[test]
    fn regions() {
        let region = |subject, keep_out| Measure::Region {
            subject,
            region: Rect([-0.5, -0.5, 0.1, 0.1]),
            keep_out,
        };
        near(measured(&region(Subject::Object(4), false), 1.0), 0.0);
        near(measured(&region(Subject::Object(4), true), 1.0), 0.1);
        near(measured(&region(Subject::Object(9), false), 1.0), 0.2f32.hypot(0.3));
        near(measured(&region(Subject::Object(9), true), 1.0), 0.0);
        near(measured(&region(Subject::Object(9), false), 0.0), 2.0);
        near(measured(&region(Subject::Object(9), true), 0.0), 0.0);
    }

    #[test]
    fn overlaps_are_shares_of_the_smaller_box() {
        // Boxes [-0.2, 0.2]² and [-0.1, 0.7] x [0, 0.8] share 0.3 x 0.2.
        let overlap = |a, b| measured(&Measure::Overlap { a, b }, 1.0);
        near(overlap(Subject::Object(4), Subject::Object(9)), 0.06 / 0.16);
        near(overlap(Subject::Object(9), Subject::AllObjects), 0.06 / 0.16);
        near(overlap(Subject::Agent, Subject::AllObjects), 0.0);
        near(covered(&[Rect([0.0, 0.0, 2.0, 2.0]), Rect([1.0, 1.0, 3.0, 3.0])]), 7.0);
    }

    #[test]
    fn goals_are_compared_where_they_count() {
        let pictures = Pictures {
            frame: &[0, 0, 0, 255, 255, 255],
            agent: &[255, 0],
            objects: &[0, 255, 0, 0, 0, 0],
        };
        let of = |measure: &Measure| {
            at_step(measure, Step { ids: &IDS, table: &table(1.0), agent: None, pictures }, 2.0)
        };
        let image = |pixels| Measure::GoalImage { goal: [0.5; 6].into(), pixels };
        near(of(&image(Pixels::All)), 0.25);
        let black = |pixels| Measure::GoalImage { goal: [0.0; 6].into(), pixels };
        near(of(&black(Pixels::Agent)), 0.0);
        near(of(&black(Pixels::Objects)), 1.0);
        near(of(&black(Pixels::Background)), 1.0);
        let masks =
            |subject, goal: [f32; 2]| Measure::GoalMasks { goals: vec![(subject, goal.into())] };
        near(of(&masks(Subject::Agent, [1.0, 0.0])), 0.0);
        near(of(&masks(Subject::Agent, [1.0, 1.0])), 0.5);
        near(of(&masks(Subject::Object(4), [0.0, 1.0])), 0.0);
        near(of(&masks(Subject::Object(9), [0.0, 1.0])), 1.0);
        near(of(&masks(Subject::AllObjects, [0.0, 0.5])), 0.5);
    }

    #[test]
    fn a_mask_is_where_its_weight_is() {
        let mut mask = vec![0.0; 16];
        mask[4 + 1] = 1.0;
        mask[4 + 2] = 1.0;
        let seen = Seen::of_mask(&mask, 4).expect("two pixels");
        assert_eq!((seen.centre, seen.bounds), ([0.0, -0.25], Rect([-0.5, -0.5, 0.5, 0.0])));
        assert_eq!(Seen::of_mask(&[0.05; 16], 4), None);
    }
}
