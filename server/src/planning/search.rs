//! Searching for actions: random shooting, CEM, iCEM and MPPI as state machines that propose candidates and learn from
//! their costs. Nothing here knows what is searched.
//!
//! Actions are searched in units where the limits of every dimension are -1 and 1.

#[cfg(test)]
mod reference;

use std::cmp::Ordering;

use super::noise::Draws;

/// What actions may be, and for how long they are held.
#[derive(Clone, Debug)]
pub struct Space {
    /// Least values, raw units, `[A]`.
    pub min: Vec<f32>,
    /// Greatest values, raw units, `[A]`; each more than its least.
    pub max: Vec<f32>,
    /// Steps H, 1 or more.
    pub horizon: usize,
    /// Steps for which an action is held, 1 to H.
    pub repeat: usize,
}

impl Space {
    /// Actions that are decided on.
    fn decisions(&self) -> usize {
        self.horizon.div_ceil(self.repeat)
    }

    fn width(&self) -> usize {
        self.min.len()
    }

    /// Raw units, `[H, A]`, of decisions `[decisions, A]`.
    fn raw(&self, decisions: &[f64]) -> Vec<f32> {
        let width = self.width();
        let value = |t: usize, a: usize| {
            let (min, max) = (self.min[a], self.max[a]);
            let at = decisions[t / self.repeat * width + a] as f32;
            // Rounding may not leave the limits.
            (min + (max - min) * (at + 1.0) / 2.0).clamp(min, max)
        };
        (0..self.horizon)
            .flat_map(|t| (0..width).map(move |a| (t, a)))
            .map(|(t, a)| value(t, a))
            .collect()
    }

    /// Decisions of actions `[H, A]` in raw units: the first of those that are held together.
    fn decided(&self, actions: &[f32]) -> Vec<f64> {
        let width = self.width();
        let value = |d: usize, a: usize| {
            let (min, max) = (f64::from(self.min[a]), f64::from(self.max[a]));
            let raw = f64::from(actions[d * self.repeat * width + a]);
            ((raw - min) / (max - min) * 2.0 - 1.0).clamp(-1.0, 1.0)
        };
        (0..self.decisions())
            .flat_map(|d| (0..width).map(move |a| (d, a)))
            .map(|(d, a)| value(d, a))
            .collect()
    }

    /// Standard deviations in raw units, `[H, A]`.
    fn raw_std(&self, std: &[f64]) -> Vec<f32> {
        let width = self.width();
        let value = |t: usize, a: usize| {
            std[t / self.repeat * width + a] as f32 * (self.max[a] - self.min[a]) / 2.0
        };
        (0..self.horizon)
            .flat_map(|t| (0..width).map(move |a| (t, a)))
            .map(|(t, a)| value(t, a))
            .collect()
    }
}

/// How to search.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Optimiser {
    /// Uniform candidates, the best one wins.
    RandomShooting {
        /// Candidates.
        candidates: usize,
    },
    /// Cross-entropy method (Rubinstein & Kroese 2004); with `icem` the sample-efficient one.
    Cem {
        /// Candidates of an iteration.
        candidates: usize,
        /// Iterations.
        iterations: usize,
        /// Candidates that the Gaussian is fitted to.
        elites: usize,
        /// Standard deviation at the start, as a fraction of half the range.
        initial_std: f64,
        /// Standard deviation that it does not fall below.
        min_std: f64,
        /// Weight of the old distribution in a fit.
        momentum: f64,
        /// What iCEM adds.
        icem: Option<Icem>,
    },
    /// Model-predictive path integral control (Williams et al. 2017).
    Mppi {
        /// Candidates of an iteration.
        candidates: usize,
        /// Iterations.
        iterations: usize,
        /// Temperature, relative to the standard deviation of the costs.
        temperature: f64,
        /// Standard deviation of the noise, as a fraction of half the range.
        std: f64,
        /// Exponent of its spectrum.
        beta: f64,
    },
}

/// What iCEM adds to CEM (Pinneri et al. 2020).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Icem {
    /// Exponent of the noise spectrum along time.
    pub beta: f64,
    /// Share of the elites that enter the next iteration.
    pub keep: f64,
    /// Factor by which candidates become fewer.
    pub decay: f64,
}

/// What a candidate is worth: those that violate nothing rank before all that do, then the cheaper one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rank {
    /// By how much it violates the constraints, 0 or more.
    pub violation: f32,
    /// Its cost.
    pub cost: f32,
}

impl Rank {
    /// The better one first.
    pub fn order(&self, other: &Self) -> Ordering {
        let violation = self.violation.total_cmp(&other.violation);
        violation.then(self.cost.total_cmp(&other.cost))
    }
}

/// The best candidate so far.
#[derive(Clone, Debug)]
pub struct Best {
    /// Actions in raw units, `[H, A]`.
    pub actions: Vec<f32>,
    /// What it is worth.
    pub rank: Rank,
}

/// A search under way.
#[derive(Debug)]
pub struct Search {
    space: Space,
    optimiser: Optimiser,
    seed: u64,
    iteration: usize,
    mean: Vec<f64>,
    std: Vec<f64>,
    kept: Vec<Vec<f64>>,
    proposed: Vec<Vec<f64>>,
    best: Option<(Vec<f64>, Rank)>,
}

impl Search {
    /// A search that begins around `start`, actions `[H, A]` in raw units, or around the middle of the limits.
    pub fn new(space: Space, optimiser: Optimiser, seed: u64, start: Option<&[f32]>) -> Self {
        let size = space.decisions() * space.width();
        let mean = start.map_or_else(|| vec![0.0; size], |start| space.decided(start));
        let std = match optimiser {
            // That of a uniform distribution.
            Optimiser::RandomShooting { .. } => 1.0 / 3f64.sqrt(),
            Optimiser::Cem { initial_std, .. } => initial_std,
            Optimiser::Mppi { std, .. } => std,
        };
        // What it starts from is a candidate of its own.
        let kept = start.map(|_| mean.clone()).into_iter().collect();
        let (proposed, best) = (Vec::new(), None);
        Self {
            space,
            optimiser,
            seed,
            iteration: 0,
            mean,
            std: vec![std; size],
            kept,
            proposed,
            best,
        }
    }

    /// Iterations that it takes; that of MPPI's resulting mean included.
    pub fn iterations(&self) -> usize {
        match self.optimiser {
            Optimiser::RandomShooting { .. } => 1,
            Optimiser::Cem { iterations, .. } => iterations,
            Optimiser::Mppi { iterations, .. } => iterations + 1,
        }
    }

    /// Iterations done.
    pub fn done(&self) -> usize {
        self.iteration
    }

    /// The best candidate so far; nothing before the first iteration.
    pub fn best(&self) -> Option<Best> {
        let (decisions, rank) = self.best.as_ref()?;
        Some(Best { actions: self.space.raw(decisions), rank: *rank })
    }

    /// Standard deviation of the search in raw units, `[H, A]`.
    pub fn std(&self) -> Vec<f32> {
        self.space.raw_std(&self.std)
    }

    /// The candidates of the next iteration, `[N, H, A]` in raw units, and N.
    pub fn propose(&mut self) -> (Vec<f32>, usize) {
        let draws = Draws { seed: self.seed, iteration: self.iteration as u32 };
        let mut proposed = std::mem::take(&mut self.kept);
        let last = self.iteration + 1 == self.iterations();
        match self.optimiser {
            Optimiser::RandomShooting { candidates } => {
                let from = proposed.len();
                proposed.extend((from..candidates).map(|n| self.uniform(draws, n)));
            }
            Optimiser::Cem { candidates, elites, icem, .. } => {
                let fewer = icem.map_or(1.0, |icem| icem.decay.powi(self.iteration as i32));
                let fewest = (2 * elites).min(candidates);
                let count = ((candidates as f64 / fewer) as usize).max(fewest);
                if icem.is_some() && last && self.iteration > 0 {
                    proposed.push(self.mean.clone());
                }
                let beta = icem.map_or(0.0, |icem| icem.beta);
                let from = proposed.len();
                proposed.extend((from..count).map(|n| self.around(draws, n, beta)));
            }
            Optimiser::Mppi { .. } if last => proposed = vec![self.mean.clone()],
            Optimiser::Mppi { candidates, beta, .. } => {
                // Around the mean, which is a candidate too.
                proposed = vec![self.mean.clone()];
                proposed.extend((1..candidates).map(|n| self.around(draws, n, beta)));
            }
        }
        let actions = proposed.iter().flat_map(|decisions| self.space.raw(decisions)).collect();
        self.proposed = proposed;
        (actions, self.proposed.len())
    }

    fn uniform(&self, draws: Draws, candidate: usize) -> Vec<f64> {
        let width = self.space.width();
        let value = |at: usize| {
            let (decision, dimension) = (at / width, at % width);
            draws.uniform(candidate as u32, dimension as u32, decision as u32) * 2.0 - 1.0
        };
        (0..self.mean.len()).map(value).collect()
    }

    fn around(&self, draws: Draws, candidate: usize, beta: f64) -> Vec<f64> {
        let (width, decisions) = (self.space.width(), self.space.decisions());
        let mut values = vec![0.0; width * decisions];
        for dimension in 0..width {
            let noise = draws.coloured(candidate as u32, dimension as u32, decisions, beta);
            for (decision, noise) in noise.into_iter().enumerate() {
                let at = decision * width + dimension;
                values[at] = (self.mean[at] + self.std[at] * noise).clamp(-1.0, 1.0);
            }
        }
        values
    }

    /// Takes what the proposed candidates are worth, in their order.
    ///
    /// # Panics
    /// If they are not as many as were proposed.
    pub fn learn(&mut self, ranks: &[Rank]) {
        let proposed = std::mem::take(&mut self.proposed);
        assert_eq!(ranks.len(), proposed.len(), "every candidate has a rank");
        self.iteration += 1;
        let mut order: Vec<usize> = (0..ranks.len()).collect();
        order.sort_by(|a, b| ranks[*a].order(&ranks[*b]));
        let first = order[0];
        let better = |best: &Rank| ranks[first].order(best) == Ordering::Less;
        if self.best.as_ref().is_none_or(|(_, best)| better(best)) {
            self.best = Some((proposed[first].clone(), ranks[first]));
        }
        match self.optimiser {
            Optimiser::RandomShooting { .. } => {}
            Optimiser::Cem { elites, min_std, momentum, icem, .. } => {
                let elites: Vec<&Vec<f64>> =
                    order.iter().take(elites).map(|at| &proposed[*at]).collect();
                self.fit(&elites, min_std, momentum);
                let keep = icem.map_or(0.0, |icem| icem.keep);
                let keep = (elites.len() as f64 * keep).round() as usize;
                self.kept = elites.into_iter().take(keep).cloned().collect();
            }
            Optimiser::Mppi { temperature, .. } => {
                if self.iteration < self.iterations() {
                    self.average(&proposed, ranks, temperature);
                }
            }
        }
    }

    fn fit(&mut self, elites: &[&Vec<f64>], min_std: f64, momentum: f64) {
        let count = elites.len() as f64;
        for at in 0..self.mean.len() {
            let mean = elites.iter().map(|x| x[at]).sum::<f64>() / count;
            let square = elites.iter().map(|x| (x[at] - mean).powi(2)).sum::<f64>() / count;
            self.mean[at] = momentum * self.mean[at] + (1.0 - momentum) * mean;
            let std = momentum * self.std[at] + (1.0 - momentum) * square.sqrt();
            self.std[at] = std.max(min_std);
        }
    }

    /// The mean moves to the average of the candidates, weighted by exp(-cost / temperature). While some violate
    /// nothing, the others have no weight; while all do, the violation is what costs.
    fn average(&mut self, proposed: &[Vec<f64>], ranks: &[Rank], temperature: f64) {
        let some_hold = ranks.iter().any(|rank| rank.violation == 0.0);
        let costs: Vec<f64> = ranks
            .iter()
            .map(|rank| match rank {
                Rank { violation, .. } if !some_hold => f64::from(*violation),
                Rank { violation, .. } if *violation > 0.0 => f64::INFINITY,
                Rank { cost, .. } => f64::from(*cost),
            })
            .collect();
        let finite: Vec<f64> = costs.iter().copied().filter(|cost| cost.is_finite()).collect();
        let mean = finite.iter().sum::<f64>() / finite.len() as f64;
        let square = finite.iter().map(|cost| (cost - mean).powi(2)).sum::<f64>();
        let spread = (square / finite.len() as f64).sqrt();
        let least = finite.iter().copied().fold(f64::INFINITY, f64::min);
        // Where all cost the same, all weigh the same.
        let scale = if spread > 0.0 { temperature * spread } else { 1.0 };
        let weights: Vec<f64> = costs.iter().map(|cost| (-(cost - least) / scale).exp()).collect();
        let total: f64 = weights.iter().sum();
        for at in 0..self.mean.len() {
            let sum: f64 = weights.iter().zip(proposed).map(|(weight, x)| weight * x[at]).sum();
            self.mean[at] = sum / total;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn space(horizon: usize, repeat: usize) -> Space {
        Space { min: vec![-2.0, 0.0], max: vec![2.0, 10.0], horizon, repeat }
    }

    fn cem(icem: Option<Icem>) -> Optimiser {
        Optimiser::Cem {
            candidates: 200,
            iterations: 20,
            elites: 20,
            initial_std: 0.5,
            min_std: 0.0,
            momentum: 0.1,
            icem,
        }
    }

    const ICEM: Icem = Icem { beta: 1.0, keep: 0.3, decay: 1.1 };

    fn mppi(iterations: usize) -> Optimiser {
        Optimiser::Mppi { candidates: 256, iterations, temperature: 0.1, std: 0.15, beta: 0.0 }
    }

    /// Runs a search; the cost of a candidate is a function of its actions `[H, A]`.
    fn run(search: &mut Search, cost: impl Fn(&[f32]) -> Rank) -> Best {
        while search.done() < search.iterations() {
            let (actions, candidates) = search.propose();
            let ranks: Vec<Rank> = actions.chunks(actions.len() / candidates).map(&cost).collect();
            search.learn(&ranks);
        }
        search.best().expect("it has iterations")
    }

    fn free(cost: f32) -> Rank {
        Rank { violation: 0.0, cost }
    }

    /// A bowl with its bottom at (1, 7) at each step.
    fn bowl(actions: &[f32]) -> f32 {
        actions
            .as_chunks::<2>()
            .0
            .iter()
            .map(|[x, y]| (x - 1.0).powi(2) + ((y - 7.0) / 2.5).powi(2))
            .sum()
    }

    #[test]
    fn all_that_learn_reach_the_bottom_of_a_bowl() {
        for (optimiser, reached) in [(cem(None), 1e-3), (cem(Some(ICEM)), 1e-2), (mppi(30), 0.1)] {
            let best = run(&mut Search::new(space(3, 1), optimiser, 5, None), |x| free(bowl(x)));
            assert!(best.rank.cost < reached, "{optimiser:?} reached {best:?}");
        }
        let random = Optimiser::RandomShooting { candidates: 500 };
        let best = run(&mut Search::new(space(3, 1), random, 5, None), |x| free(bowl(x)));
        assert!(best.rank.cost < 3.0, "{best:?}");
    }

    #[test]
    fn a_curved_valley_is_followed() {
        // Rosenbrock's function over (x, y / 5 - 1), least at (1, 1).
        let valley = |actions: &[f32]| {
            let (x, y) = (actions[0], actions[1] / 5.0 - 1.0);
            free((1.0 - x).powi(2) + 100.0 * (y - x * x).powi(2))
        };
        for mut optimiser in [cem(None), cem(Some(ICEM))] {
            // A valley narrower than the search is wide makes it stop early, unless it keeps some width.
            let Optimiser::Cem { min_std, iterations, .. } = &mut optimiser else { unreachable!() };
            (*min_std, *iterations) = (0.1, 60);
            let best = run(&mut Search::new(space(1, 1), optimiser, 1, None), valley);
            assert!(best.rank.cost < 0.05, "{optimiser:?} reached {best:?}");
        }
    }

    #[test]
    fn actions_stay_within_limits_and_are_held() {
        let optimiser = cem(Some(Icem { beta: 2.0, keep: 0.5, decay: 1.5 }));
        let mut search = Search::new(space(5, 2), optimiser, 3, None);
        let (actions, candidates) = search.propose();
        assert_eq!((candidates, actions.len()), (200, 200 * 5 * 2));
        for candidate in actions.as_chunks::<10>().0 {
            let steps = candidate.as_chunks::<2>().0;
            for (step, held) in [(0, 1), (2, 3)] {
                assert_eq!(steps[step].map(f32::to_bits), steps[held].map(f32::to_bits));
            }
            assert!(steps.iter().all(|[x, y]| x.abs() <= 2.0 && (0.0..=10.0).contains(y)));
        }
        search.learn(&vec![free(0.0); candidates]);
        assert_eq!(search.propose().1, 133, "fewer by the decay");
    }

    #[test]
    fn what_violates_ranks_behind() {
        // The bowl's bottom is forbidden: x may be 0 at most.
        let fenced = |actions: &[f32]| {
            let violation = actions.as_chunks::<2>().0.iter().map(|[x, _]| x.max(0.0)).sum();
            Rank { violation, cost: bowl(actions) }
        };
        for optimiser in [cem(None), cem(Some(ICEM)), mppi(30)] {
            let best = run(&mut Search::new(space(2, 1), optimiser, 9, None), fenced);
            let at = best.actions[0];
            assert!(best.rank.violation == 0.0 && (-0.4..=0.0).contains(&at), "{best:?}");
        }
    }

    #[test]
    fn a_warm_start_is_never_lost() {
        let start = [1.0, 7.0, 1.0, 7.0];
        for optimiser in [cem(Some(ICEM)), mppi(1), Optimiser::RandomShooting { candidates: 4 }] {
            let mut search = Search::new(space(2, 1), optimiser, 2, Some(&start));
            let best = run(&mut search, |x| free(bowl(x)));
            assert!(best.rank.cost < 1e-6, "{optimiser:?} reached {best:?}");
        }
    }

    #[test]
    fn mppi_averages_by_the_exponential_of_costs() {
        let optimiser =
            Optimiser::Mppi { candidates: 3, iterations: 1, temperature: 0.5, std: 0.2, beta: 0.0 };
        let mut search = Search::new(space(1, 1), optimiser, 4, None);
        let (actions, _) = search.propose();
        let costs = [1.0f32, 2.0, 4.0];
        search.learn(&costs.map(free));
        let spread = (14.0f64 / 9.0).sqrt();
        let weights = costs.map(|cost| (-(f64::from(cost) - 1.0) / (0.5 * spread)).exp());
        let (mean, _) = search.propose();
        for a in 0..2 {
            let sum: f64 = (0..3).map(|n| weights[n] * f64::from(actions[n * 2 + a])).sum::<f64>();
            let expected = sum / weights.iter().sum::<f64>();
            assert!((f64::from(mean[a]) - expected).abs() < 1e-5, "{mean:?}");
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_plan() {
        let plan = |seed| {
            run(&mut Search::new(space(3, 1), cem(Some(ICEM)), seed, None), |x| free(bowl(x)))
                .actions
        };
        assert_eq!(plan(1), plan(1));
        assert_ne!(plan(1), plan(2));
    }
}
