//! What the candidates of a rollout cost, from what their steps measured.

use super::{
    cost::{Measure, Program, Subject, Term, When},
    measure::{Step, at_step, mean, of_actions},
};

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
    use crate::planning::{cost::Risk, measure::Pictures};

    #[track_caller]
    fn near(found: f32, expected: f32) {
        assert!((found - expected).abs() < 1e-5, "{found}, expected {expected}");
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
}
