//! Our searches beside public ones: mbrl-lib's CEM and iCEM and pytorch-mppi's MPPI, as `tests/planners/record.py` saw
//! them run.
//!
//! Given the samples that they drew and what those cost, ours must come to the same distribution. Drawing for itself,
//! it must find plans as good as theirs. Where the libraries differ from the papers that ours follow, the difference is
//! taken out here, and named.

use std::iter::zip;

use serde::Deserialize;

use super::*;

const RECORD: &str = include_str!("../../../tests/planners/reference.json");
/// Of a mean or a deviation, in raw units. The libraries compute with 32 bits.
const TOLERANCE: f64 = 1e-5;

#[derive(Deserialize)]
struct Record {
    updates: Vec<Updates>,
    qualities: Vec<Quality>,
}

#[derive(Deserialize)]
struct Function {
    #[serde(rename = "function")]
    name: String,
    steps: usize,
    width: usize,
    low: f32,
    high: f32,
}

#[derive(Deserialize)]
struct Updates {
    #[serde(flatten)]
    function: Function,
    optimiser: String,
    #[serde(default)]
    momentum: f64,
    #[serde(default)]
    elites: usize,
    #[serde(default)]
    lambda: f64,
    iterations: Vec<Iteration>,
}

#[derive(Deserialize)]
struct Iteration {
    count: usize,
    samples: Vec<f32>,
    costs: Vec<f32>,
    mean_before: Vec<f32>,
    mean: Vec<f32>,
    #[serde(default)]
    std_before: Vec<f64>,
    #[serde(default)]
    std: Vec<f64>,
}

/// The least costs that searches with different seeds have found, in ascending order.
#[derive(Deserialize)]
struct Quality {
    #[serde(flatten)]
    function: Function,
    optimiser: String,
    least: Vec<f64>,
}

impl Function {
    fn space(&self) -> Space {
        let Self { steps, width, low, high, .. } = *self;
        Space { min: vec![low; width], max: vec![high; width], horizon: steps, repeat: 1 }
    }

    fn half(&self) -> f64 {
        f64::from(self.high - self.low) / 2.0
    }

    /// The cost of actions, as `record.py` has it.
    fn cost(&self, actions: &[f32]) -> f32 {
        match self.name.as_str() {
            "sphere" => actions.iter().map(|x| (x - 0.4).powi(2)).sum(),
            "rosenbrock" => {
                let pairs = zip(actions, &actions[1..]);
                pairs.map(|(x, y)| 100.0 * (y - x * x).powi(2) + (1.0 - x).powi(2)).sum()
            }
            "double_integrator" => {
                let (mut place, mut speed, mut cost) = (1.0f32, 0.0f32, 0.0f32);
                for force in actions {
                    speed += 0.3 * force;
                    place += 0.3 * speed;
                    cost += place * place + 0.1 * speed * speed + 0.05 * force * force;
                }
                cost
            }
            other => panic!("there is no function {other}"),
        }
    }
}

fn record() -> Record {
    serde_json::from_str(RECORD).unwrap()
}

fn ranks(costs: impl IntoIterator<Item = f32>) -> Vec<Rank> {
    costs.into_iter().map(|cost| Rank { violation: 0.0, cost }).collect()
}

/// The standard deviation of all costs, by which our temperature is measured.
fn deviation(costs: &[f32]) -> f64 {
    let (count, costs) = (costs.len() as f64, costs.iter().map(|cost| f64::from(*cost)));
    let mean = costs.clone().sum::<f64>() / count;
    (costs.map(|cost| (cost - mean).powi(2)).sum::<f64>() / count).sqrt()
}

/// Our optimiser with the settings of a recorded one.
fn ours(updates: &Updates, costs: &[f32]) -> Optimiser {
    let Updates { elites, momentum, lambda, iterations, .. } = updates;
    let (candidates, initial_std, min_std) = (iterations[0].count, 0.5, 0.0);
    let icem = Icem { beta: 2.0, keep: 0.3, decay: 1.25 };
    match updates.optimiser.as_str() {
        "mppi" => Optimiser::Mppi {
            candidates,
            iterations: iterations.len(),
            temperature: lambda / deviation(costs),
            std: 0.3,
            beta: 0.0,
        },
        name => Optimiser::Cem {
            candidates,
            iterations: iterations.len(),
            elites: *elites,
            initial_std,
            min_std,
            momentum: *momentum,
            icem: (name == "icem").then_some(icem),
        },
    }
}

#[test]
fn the_same_samples_lead_to_the_same_distribution() {
    let record = record();
    assert_eq!(record.updates.len(), 12);
    for updates in &record.updates {
        let Updates { function, optimiser, momentum, elites, iterations, .. } = updates;
        for (number, iteration) in iterations.iter().enumerate() {
            let space = function.space();
            let decided = |actions: &[f32]| space.decided(actions);
            let mut search = Search::new(space.clone(), ours(updates, &iteration.costs), 1, None);
            search.mean = decided(&iteration.mean_before);
            search.std = iteration.std_before.iter().map(|std| std / function.half()).collect();
            let samples = iteration.samples.chunks(function.steps * function.width);
            search.proposed = samples.map(decided).collect();
            assert_eq!(search.proposed.len(), iteration.count);
            search.learn(&ranks(iteration.costs.iter().copied()));

            let place = format!("{optimiser} on {}, iteration {number}", function.name);
            for (mean, expected) in zip(space.raw(&search.mean), &iteration.mean) {
                let off = f64::from((mean - expected).abs());
                assert!(off < TOLERANCE, "{place}: the mean {mean} is not {expected}");
            }
            // mbrl-lib's CEM divides the elites' squares by one less than their number; ours, as iCEM's authors do, by
            // their number.
            let count = *elites as f64;
            let sample = if optimiser == "cem" { (count / (count - 1.0)).sqrt() } else { 1.0 };
            for (at, expected) in iteration.std.iter().enumerate() {
                let before = momentum * iteration.std_before[at];
                let std = before + (search.std[at] * function.half() - before) * sample;
                let off = (std - expected).abs();
                assert!(off < TOLERANCE, "{place}: the deviation {std} is not {expected}");
            }
        }
    }
}

/// The optimiser that `record.py` ran over many seeds, as ours has it.
fn whole(name: &str, function: &Function) -> Optimiser {
    let cem = |initial_std, icem| Optimiser::Cem {
        candidates: 200,
        iterations: 8,
        elites: 20,
        initial_std,
        min_std: 0.0,
        momentum: 0.1,
        icem,
    };
    match name {
        // mbrl-lib begins with a deviation of 1 in raw units, or with a quarter of the range.
        "cem" => cem(1.0 / function.half(), None),
        "icem" => cem(0.5, Some(Icem { beta: 2.0, keep: 0.3, decay: 1.25 })),
        _ => Optimiser::Mppi {
            candidates: 200,
            iterations: 10,
            temperature: 0.1,
            std: 0.3,
            beta: 0.0,
        },
    }
}

/// The deviation of mbrl-lib's noise with a beta of 2, measured over 100,000 draws; it means to be 1, as ours is, but leaves the
/// lowest frequency out of what it scales by.
fn strength(optimiser: &str, steps: usize) -> f64 {
    match (optimiser, steps) {
        ("icem", 2) => 1.414,
        ("icem", 3) => 1.118,
        ("icem", 12) => 1.080,
        ("icem", other) => panic!("the noise of {other} steps was not measured"),
        _ => 1.0,
    }
}

/// The least costs that searches of ours find, in ascending order, with noise that is `strength` times as strong.
fn found(optimiser: Optimiser, function: &Function, seeds: usize, strength: f64) -> Vec<f64> {
    let least = |seed| {
        let mut search = Search::new(function.space(), optimiser, seed, None);
        while search.done() < search.iterations() {
            let told = search.std.clone();
            search.std.iter_mut().for_each(|std| *std *= strength);
            let (actions, candidates) = search.propose();
            search.std = told;
            let each = actions.chunks(actions.len() / candidates);
            search.learn(&ranks(each.map(|actions| function.cost(actions))));
        }
        f64::from(search.best().unwrap().rank.cost)
    };
    let mut found: Vec<f64> = (0..seeds as u64).map(least).collect();
    found.sort_by(f64::total_cmp);
    found
}

#[test]
fn plans_are_as_good_as_theirs() {
    for Quality { function, optimiser, least } in record().qualities {
        let place = format!("{optimiser} on {}", function.name);
        let found =
            |strength| found(whole(&optimiser, &function), &function, least.len(), strength);
        let ours = found(strength(&optimiser, function.steps));
        // How likely one of ours is better than one of theirs: of equals 0.5, with a standard error of 0.04.
        let better = ours.iter().map(|ours| least.iter().filter(|theirs| ours < theirs).count());
        let better = better.sum::<usize>() as f64 / (ours.len() * least.len()) as f64;
        // The least is 0.38, of iCEM on the double integrator: mbrl-lib also adds what it keeps to the candidates, of which ours
        // is a part, and its momentum mixes variances, not deviations.
        assert!(better > 0.35, "{place}: only {better} are better");
        // With our own noise half of ours are better than the worst tenth of theirs.
        let at = |sorted: &[f64], share: f64| sorted[(sorted.len() as f64 * share) as usize];
        let (ours, theirs) = (at(&found(1.0), 0.5), at(&least, 0.9));
        assert!(ours < theirs, "{place}: the median is {ours}, and theirs stay below {theirs}");
    }
}
