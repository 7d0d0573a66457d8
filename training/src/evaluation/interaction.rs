//! Where imagined objects are before and after something touched them (the paper's pixel error around interactions).

use std::collections::{BTreeMap, BTreeSet};

use gatsbi_episodes::Episode;
use gatsbi_models::scene::Scene;
use tch::Tensor;

use super::decomposition::{found_objects, true_objects};

/// Label of an episode's first object.
const FIRST_LABEL: i64 = 2;

/// What touched what in an episode.
#[derive(Clone, Debug)]
pub struct Contacts {
    objects: usize,
    agent: Vec<u8>,   // [T, N]
    between: Vec<u8>, // [T, N, N]
}

impl Contacts {
    /// Those of an episode, where it says them.
    pub fn of(episode: &Episode) -> Option<Self> {
        let data = episode.data();
        let objects = episode.object_count()?;
        let between = data.contacts_objects.clone()?;
        let frames = episode.length();
        let agent = data.contacts_agent.clone().unwrap_or_else(|| vec![0; frames * objects]);
        Some(Self { objects, agent, between })
    }

    /// Labels of the objects that were touched after frame t - 1, up to frame t.
    fn touched(&self, t: usize) -> impl Iterator<Item = i64> {
        let n = self.objects;
        let among = move |object: usize| {
            let row = &self.between[(t * n + object) * n..][..n];
            self.agent[t * n + object] != 0 || row.iter().any(|flag| *flag != 0)
        };
        (0..n).filter(move |object| among(*object)).map(|object| object as i64 + FIRST_LABEL)
    }
}

/// The imagined objects of one episode that are followed by their identities.
#[derive(Debug)]
pub struct Followed {
    /// Identities by label, as matched at the last observed frame.
    identities: BTreeMap<i64, i64>,
    touched: BTreeSet<i64>,
}

/// Distances of followed objects from where they are, in pixels.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Distances {
    /// Of those that nothing has touched since the last observed frame.
    pub before: Vec<f64>,
    /// Of the others.
    pub after: Vec<f64>,
}

impl Followed {
    /// From `(label, identity)` pairs of the last observed frame.
    pub fn new(matches: &[(i64, i64)]) -> Self {
        Self { identities: matches.iter().copied().collect(), touched: BTreeSet::new() }
    }

    /// Distances at imagined frame `t` of row `row`, whose labels are `[H, W]`. Objects that are hidden, or that the model
    /// let go, have none.
    pub fn step(
        &mut self,
        t: usize,
        contacts: &Contacts,
        scene: &Scene,
        labels: &Tensor,
        row: i64,
    ) -> Distances {
        self.touched.extend(contacts.touched(t));
        let found: BTreeMap<i64, [f64; 2]> =
            found_objects(scene, row, labels.size()[0] as f64).into_iter().collect();
        let mut distances = Distances::default();
        for (label, [x, y]) in true_objects(labels) {
            let identity = self.identities.get(&label);
            if let Some([u, v]) = identity.and_then(|identity| found.get(identity)) {
                let of = if self.touched.contains(&label) {
                    &mut distances.after
                } else {
                    &mut distances.before
                };
                of.push((x - u).hypot(y - v));
            }
        }
        distances
    }
}

#[cfg(test)]
mod tests {
    use super::{
        super::samples::{labels, scene},
        *,
    };

    #[test]
    fn an_object_counts_as_touched_from_its_contact_on() {
        // Objects 0 and 1 touch at frame 1; the labels stay where they are.
        let contacts = Contacts {
            objects: 2,
            agent: vec![0; 6],
            between: vec![0, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0],
        };
        // Found 3 pixels to the right of object 0, and where object 1 is.
        let (scene, labels) = (scene([12.5, 41.5]), labels([8, 40]));
        let mut followed = Followed::new(&[(2, 7), (3, 9)]);
        let mut step = |t| followed.step(t, &contacts, &scene, &labels, 0);
        let near = |found: &[f64], expected: &[f64]| {
            assert_eq!(found.len(), expected.len());
            assert!(found.iter().zip(expected).all(|(x, y)| (x - y).abs() < 1e-3), "{found:?}");
        };
        let first = step(0);
        near(&first.before, &[3.0, 0.0]);
        near(&first.after, &[]);
        for t in [1, 2] {
            let later = step(t);
            near(&later.before, &[]);
            near(&later.after, &[3.0, 0.0]);
        }
    }
}
