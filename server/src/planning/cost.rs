//! Costs as data: a program of weighted terms and constraints, checked once, then measured at each imagined step.
//!
//! Positions and distances are in units of the image's half side, x rightwards and y downwards in [-1, 1].

use std::sync::Arc;

use gatsbi_models::scene::{Output, Outputs};

/// Columns of the object table: presence, x, y, width, height, depth.
const COLUMNS: usize = 6;

/// A presence above this is an object that is there.
const PRESENT: f32 = 0.5;

/// A pixel whose mask is above this belongs to the agent's bounding box.
const INSIDE: f32 = 0.5;

/// An object or the agent.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Subject {
    /// The object with this identity.
    Object(i64),
    /// The agent: the centre of its mask.
    Agent,
    /// Every object that is present.
    AllObjects,
}

/// An upright rectangle: left, top, right, bottom.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rect(pub [f32; 4]);

impl Rect {
    fn area(self) -> f32 {
        let [left, top, right, bottom] = self.0;
        (right - left).max(0.0) * (bottom - top).max(0.0)
    }

    fn distance_to(self, [x, y]: [f32; 2]) -> f32 {
        let [left, top, right, bottom] = self.0;
        let beyond = |at: f32, low: f32, high: f32| (low - at).max(at - high).max(0.0);
        beyond(x, left, right).hypot(beyond(y, top, bottom))
    }

    /// How far a point inside is from the nearest edge; 0 outside.
    fn depth_of(self, [x, y]: [f32; 2]) -> f32 {
        let [left, top, right, bottom] = self.0;
        (x - left).min(right - x).min(y - top).min(bottom - y).max(0.0)
    }
}

/// What is measured.
#[derive(Clone, Debug, PartialEq)]
pub enum Measure {
    /// Distance to a point, beyond a tolerance.
    ToTarget {
        /// Who.
        subject: Subject,
        /// Where to.
        target: [f32; 2],
        /// Distances up to this are no cost.
        tolerance: f32,
        /// Whether it counts squared.
        squared: bool,
    },
    /// Difference of a distance from what it should be; the mean over pairs with [`Subject::AllObjects`].
    Between {
        /// One.
        a: Subject,
        /// The other.
        b: Subject,
        /// The distance that they should have.
        distance: f32,
        /// Whether the difference counts squared.
        squared: bool,
    },
    /// Distance to the nearest place where the subject may be.
    Region {
        /// Who.
        subject: Subject,
        /// The region.
        region: Rect,
        /// Whether it should stay out.
        keep_out: bool,
    },
    /// Share of the smaller one's bounding box that the other's covers.
    Overlap {
        /// One.
        a: Subject,
        /// The other.
        b: Subject,
    },
    /// Sum over dimensions of weighted squared actions.
    ActionMagnitude {
        /// Weight of each dimension, its scale included.
        weights: Vec<f32>,
    },
    /// Sum over dimensions of weighted squared changes.
    ActionSmoothness {
        /// Weight of each dimension, its scale included.
        weights: Vec<f32>,
        /// The action before the first, if it counts.
        previous: Option<Vec<f32>>,
    },
    /// Standard deviation of a position over samples.
    Spread {
        /// Who.
        subject: Subject,
    },
    /// Mean squared difference from an image; 1 where no pixel counts.
    GoalImage {
        /// `[H, W, 3]` in [0, 1].
        goal: Arc<[f32]>,
        /// Which pixels count.
        pixels: Pixels,
    },
    /// 1 - intersection over union with masks; their mean.
    GoalMasks {
        /// Whose mask should be which, `[H, W]` in [0, 1].
        goals: Vec<(Subject, Arc<[f32]>)>,
    },
}

/// Which pixels of a goal image count.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Pixels {
    /// All.
    All,
    /// Weighted by the predicted agent's mask.
    Agent,
    /// Weighted by the predicted objects' masks.
    Objects,
    /// Weighted by what is neither.
    Background,
}

impl Measure {
    /// Who is looked at.
    pub fn subjects(&self) -> Vec<Subject> {
        match self {
            Self::ToTarget { subject, .. }
            | Self::Region { subject, .. }
            | Self::Spread { subject } => vec![*subject],
            Self::Between { a, b, .. } | Self::Overlap { a, b } => vec![*a, *b],
            Self::GoalMasks { goals } => goals.iter().map(|(subject, _)| *subject).collect(),
            Self::ActionMagnitude { .. }
            | Self::ActionSmoothness { .. }
            | Self::GoalImage { .. } => vec![],
        }
    }

    /// Outputs of a step that it looks at.
    fn outputs(&self) -> Outputs {
        let positions = || {
            self.subjects().into_iter().map(|subject| match subject {
                Subject::Agent => Output::AgentMask,
                Subject::Object(_) | Subject::AllObjects => Output::Objects,
            })
        };
        match self {
            Self::GoalImage { pixels, .. } => {
                let masks: &[Output] = match pixels {
                    Pixels::All => &[],
                    Pixels::Agent => &[Output::AgentMask],
                    Pixels::Objects => &[Output::ObjectMasks],
                    Pixels::Background => &[Output::AgentMask, Output::ObjectMasks],
                };
                masks.iter().copied().chain([Output::Frame]).collect()
            }
            Self::GoalMasks { .. } if positions().any(|output| output == Output::Objects) => {
                positions().chain([Output::ObjectMasks]).collect()
            }
            _ => positions().collect(),
        }
    }
}

/// Which steps of a rollout count.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum When {
    /// All: their discounted mean.
    EveryStep,
    /// The last.
    LastStep,
    /// The one that costs least.
    BestStep,
}

/// A measure and the steps that count.
#[derive(Clone, Debug, PartialEq)]
pub struct Term {
    /// What is measured.
    pub measure: Measure,
    /// Which steps count.
    pub when: When,
}

/// How the samples of a candidate become one number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Risk {
    /// Their mean.
    Mean,
    /// The mean of this share of them, the worst, in (0, 1]; at least one.
    WorstShare(f32),
    /// The worst.
    Worst,
}

impl Risk {
    fn of(self, mut values: Vec<f32>) -> f32 {
        values.sort_by(|a, b| b.total_cmp(a));
        let count = match self {
            Self::Mean => values.len(),
            Self::WorstShare(share) => {
                ((values.len() as f32 * share).round() as usize).clamp(1, values.len())
            }
            Self::Worst => 1,
        };
        values[..count].iter().sum::<f32>() / count as f32
    }
}

/// A cost program.
#[derive(Clone, Debug, PartialEq)]
pub struct Program {
    /// The terms and their weights.
    pub terms: Vec<(Term, f32)>,
    /// What must hold, and the most that each may measure.
    pub constraints: Vec<(Term, f32)>,
    /// Factor by which a step counts less than the one before, in (0, 1].
    pub discount: f32,
    /// How samples become one number.
    pub risk: Risk,
    /// Distance that stands for that of an object that is not present.
    pub missing: f32,
}

impl Program {
    fn all(&self) -> impl Iterator<Item = &Term> {
        self.terms.iter().chain(&self.constraints).map(|(term, _)| term)
    }

    /// Outputs of a step that it looks at.
    pub fn outputs(&self) -> Outputs {
        self.all().map(|term| term.measure.outputs()).fold(Outputs::default(), Outputs::union)
    }
}

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
    fn object(&self, slot: usize) -> Option<Seen> {
        let [presence, x, y, width, height, _] =
            *self.table[slot * COLUMNS..][..COLUMNS].first_chunk::<COLUMNS>()?;
        // Sizes are fractions of the image, whose side is 2.
        let bounds = Rect([x - width, y - height, x + width, y + height]);
        (presence > PRESENT).then_some(Seen { centre: [x, y], bounds })
    }

    fn slot(&self, id: i64) -> Option<usize> {
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

fn mean(values: impl IntoIterator<Item = f32>) -> Option<f32> {
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
fn at_step(measure: &Measure, step: Step<'_>, missing: f32) -> f32 {
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
fn of_actions(measure: &Measure, actions: &[f32], depth: usize) -> Option<f32> {
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

/// A rollout's size.
#[derive(Clone, Copy, Debug)]
pub struct Size {
    /// Candidates N.
    pub candidates: usize,
    /// Samples S of each.
    pub samples: usize,
    /// Steps H.
    pub horizon: usize,
    /// Object slots of a step.
    pub slots: usize,
}

/// What was measured of a rollout so far. Steps may come in any order.
#[derive(Debug)]
pub struct Measured<'a> {
    program: &'a Program,
    size: Size,
    /// By term: `[N, S, H]`.
    values: Vec<Vec<f32>>,
    /// By term, of spreads: positions `[N, S, H, parts]`, not a number where it is not present.
    places: Vec<Vec<[f32; 2]>>,
}

/// What candidates cost.
#[derive(Clone, Debug, PartialEq)]
pub struct Scores {
    /// `[N]`.
    pub costs: Vec<f32>,
    /// By how much constraints are violated, `[N]`.
    pub violations: Vec<f32>,
    /// Costs `[N, S]`.
    pub by_sample: Vec<f32>,
    /// Before weighting, the mean over samples, `[N, terms]`.
    pub by_term: Vec<f32>,
}

impl<'a> Measured<'a> {
    /// Nothing yet.
    pub fn new(program: &'a Program, size: Size) -> Self {
        let steps = size.candidates * size.samples * size.horizon;
        let parts = |term: &Term| match term.measure {
            Measure::Spread { subject } => parts(subject, size.slots),
            _ => 0,
        };
        Self {
            program,
            size,
            values: program.all().map(|_| vec![0.0; steps]).collect(),
            places: program.all().map(|term| vec![[f32::NAN; 2]; steps * parts(term)]).collect(),
        }
    }

    /// Takes the step of a candidate's sample at a depth, from 0.
    pub fn add(&mut self, (candidate, sample, depth): (usize, usize, usize), step: Step<'_>) {
        let Size { samples, horizon, slots, .. } = self.size;
        let at = (candidate * samples + sample) * horizon + depth;
        for (number, term) in self.program.all().enumerate() {
            let Measure::Spread { subject } = term.measure else {
                self.values[number][at] = at_step(&term.measure, step, self.program.missing);
                continue;
            };
            let parts = parts(subject, slots);
            let places = &mut self.places[number][at * parts..][..parts];
            for (place, part) in places.iter_mut().zip(0..) {
                let seen = match subject {
                    Subject::Agent => step.agent,
                    Subject::Object(id) => step.slot(id).and_then(|slot| step.object(slot)),
                    Subject::AllObjects => step.object(part),
                };
                *place = seen.map_or([f32::NAN; 2], |seen| seen.centre);
            }
        }
    }

    /// What the candidates with these actions, `[N, H, A]` in raw units, cost.
    pub fn scores(mut self, actions: &[f32]) -> Scores {
        let Size { candidates, samples, horizon, .. } = self.size;
        let width = actions.len() / candidates;
        for (number, term) in self.program.all().enumerate() {
            for candidate in 0..candidates {
                for depth in 0..horizon {
                    let actions = &actions[candidate * width..][..width];
                    let shared = match &term.measure {
                        Measure::Spread { subject } => {
                            Some(self.spread(number, *subject, (candidate, depth)))
                        }
                        measure => of_actions(measure, actions, depth),
                    };
                    let Some(shared) = shared else { continue };
                    for sample in 0..samples {
                        self.values[number][(candidate * samples + sample) * horizon + depth] =
                            shared;
                    }
                }
            }
        }
        let terms = self.program.terms.len();
        let mut scores =
            Scores { costs: vec![], violations: vec![], by_sample: vec![], by_term: vec![] };
        for candidate in 0..candidates {
            let rows = || candidate * samples..(candidate + 1) * samples;
            let steps =
                |number: usize, row: usize| &self.values[number][row * horizon..][..horizon];
            let term = |number: usize, row: usize| {
                over_steps(
                    steps(number, row),
                    self.program.terms[number].0.when,
                    self.program.discount,
                )
            };
            let costs: Vec<f32> = rows()
                .map(|row| {
                    let terms = self.program.terms.iter().enumerate();
                    terms.map(|(number, (_, weight))| weight * term(number, row)).sum()
                })
                .collect();
            let violations: Vec<f32> = rows()
                .map(|row| {
                    let constraints = self.program.constraints.iter().enumerate();
                    constraints
                        .map(|(number, (term, most))| {
                            (worst(steps(terms + number, row), term.when) - most).max(0.0)
                        })
                        .sum()
                })
                .collect();
            scores.by_sample.extend(&costs);
            scores.by_term.extend(
                (0..terms).map(|number| mean(rows().map(|row| term(number, row))).unwrap_or(0.0)),
            );
            scores.costs.push(self.program.risk.of(costs));
            scores.violations.push(self.program.risk.of(violations));
        }
        scores
    }

    /// Standard deviation of a position over the samples where it is present, the mean over parts that are present.
    fn spread(&self, number: usize, subject: Subject, (candidate, depth): (usize, usize)) -> f32 {
        let Size { samples, horizon, slots, .. } = self.size;
        let parts = parts(subject, slots);
        let deviations = (0..parts).filter_map(|part| {
            let places: Vec<[f32; 2]> = (0..samples)
                .map(|sample| ((candidate * samples + sample) * horizon + depth) * parts + part)
                .map(|at| self.places[number][at])
                .filter(|place| !place[0].is_nan())
                .collect();
            let centre = [0, 1].map(|axis| mean(places.iter().map(|place| place[axis])));
            let [Some(x), Some(y)] = centre else { return None };
            mean(places.iter().map(|place| (place[0] - x).powi(2) + (place[1] - y).powi(2)))
                .map(f32::sqrt)
        });
        mean(deviations).unwrap_or(0.0)
    }
}

/// Positions that the spread of a subject is made of.
fn parts(subject: Subject, slots: usize) -> usize {
    if subject == Subject::AllObjects { slots } else { 1 }
}

fn over_steps(steps: &[f32], when: When, discount: f32) -> f32 {
    match when {
        When::EveryStep => {
            let (mut sum, mut total, mut factor) = (0.0, 0.0, 1.0);
            for value in steps {
                sum += factor * value;
                total += factor;
                factor *= discount;
            }
            sum / total
        }
        When::LastStep => steps.last().copied().unwrap_or(0.0),
        When::BestStep => steps.iter().copied().fold(f32::INFINITY, f32::min),
    }
}

/// What a constraint is held against.
fn worst(steps: &[f32], when: When) -> f32 {
    match when {
        When::EveryStep => steps.iter().copied().fold(f32::NEG_INFINITY, f32::max),
        When::LastStep | When::BestStep => over_steps(steps, when, 1.0),
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

    fn program(terms: Vec<(Measure, When, f32)>) -> Program {
        let terms = terms.into_iter();
        Program {
            terms: terms.map(|(measure, when, weight)| (Term { measure, when }, weight)).collect(),
            constraints: vec![],
            discount: 1.0,
            risk: Risk::Mean,
            missing: 2.0,
        }
    }

    fn place(subject: Subject) -> Measure {
        Measure::ToTarget { subject, target: [0.0, 0.0], tolerance: 0.0, squared: false }
    }

    /// One object on its way along x, by row and step.
    fn scores(program: &Program, x: &[&[f32]], candidates: usize, actions: &[f32]) -> Scores {
        let (samples, horizon) = (x.len() / candidates, x[0].len());
        let mut measured = Measured::new(program, Size { candidates, samples, horizon, slots: 1 });
        for (row, steps) in x.iter().enumerate() {
            for (depth, x) in steps.iter().enumerate() {
                let table = [1.0, *x, 0.0, 0.1, 0.1, 0.0];
                let step =
                    Step { ids: &[4], table: &table, agent: None, pictures: Pictures::default() };
                measured.add((row / samples, row % samples, depth), step);
            }
        }
        measured.scores(actions)
    }

    #[test]
    fn steps_count_as_told() {
        let of = |when| {
            let program =
                Program { discount: 0.5, ..program(vec![(place(Subject::Object(4)), when, 2.0)]) };
            scores(&program, &[&[0.8, 0.2, 0.4]], 1, &[0.0; 3])
        };
        let mean = (0.8 + 0.1 + 0.1) / 1.75;
        near(of(When::EveryStep).costs[0], 2.0 * mean);
        near(of(When::EveryStep).by_term[0], mean);
        near(of(When::LastStep).costs[0], 0.8);
        near(of(When::BestStep).costs[0], 0.4);
    }

    #[test]
    fn samples_become_one_number_by_risk() {
        let x: [&[f32]; 4] = [&[0.1], &[0.9], &[0.3], &[0.5]];
        let of = |risk| {
            let program =
                Program { risk, ..program(vec![(place(Subject::Object(4)), When::LastStep, 1.0)]) };
            scores(&program, &x, 1, &[0.0])
        };
        near(of(Risk::Mean).costs[0], 0.45);
        near(of(Risk::Worst).costs[0], 0.9);
        near(of(Risk::WorstShare(0.5)).costs[0], 0.7);
        near(of(Risk::WorstShare(0.01)).costs[0], 0.9);
        assert_eq!(of(Risk::Mean).by_sample, [0.1, 0.9, 0.3, 0.5]);
    }

    #[test]
    fn spread_is_over_samples_of_one_candidate() {
        let program =
            program(vec![(Measure::Spread { subject: Subject::AllObjects }, When::EveryStep, 1.0)]);
        let scores = scores(&program, &[&[0.1], &[0.5], &[0.3], &[0.3]], 2, &[0.0, 0.0]);
        near(scores.costs[0], 0.2);
        near(scores.costs[1], 0.0);
    }

    #[test]
    fn actions_cost_by_size_and_change() {
        let weights = vec![1.0, 0.25];
        let program = program(vec![
            (Measure::ActionMagnitude { weights: weights.clone() }, When::EveryStep, 1.0),
            (
                Measure::ActionSmoothness { weights, previous: Some(vec![0.0, 0.0]) },
                When::EveryStep,
                10.0,
            ),
        ]);
        let scores = scores(&program, &[&[0.0, 0.0]], 1, &[1.0, 2.0, 3.0, 2.0]);
        // Sizes 1 + 1 and 9 + 1; changes 1 + 1 and 4.
        assert_eq!(scores.by_term, [6.0, 3.0]);
        near(scores.costs[0], 36.0);
    }

    #[test]
    fn constraints_are_held_at_every_step() {
        let constraint = (Term { measure: place(Subject::Object(4)), when: When::EveryStep }, 0.5);
        let program = Program {
            constraints: vec![constraint],
            ..program(vec![(place(Subject::Object(4)), When::LastStep, 1.0)])
        };
        let scores = scores(&program, &[&[0.9, 0.1], &[0.5, 0.4]], 2, &[0.0; 4]);
        near(scores.violations[0], 0.4);
        near(scores.violations[1], 0.0);
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
