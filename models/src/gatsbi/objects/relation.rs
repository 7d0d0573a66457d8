//! How objects act on each other (object spec 2.8, 3.5 and 6.3).
//!
//! Both networks over ordered pairs start with a linear layer on `[u_i, ũ_j]`, where `ũ_j` is `u_j` with its
//! centre replaced by `shift_i - shift_j`. That layer splits into one term per receiver and one per sender
//! (object spec 8.3), so only the layers behind it run once per pair.

use tch::{Kind, Tensor};

use super::latents::{SHIFT, presence, shift};
use crate::{
    config::{Graph, KnnAggregate, KnnMetric, ObjectConfig},
    nn::{InitScheme, Mlp, Path, linear},
};

/// Keeps the normalisation of weights finite.
const EPS: f64 = 1e-4;

/// The three networks of one memory (posterior or prior).
#[derive(Debug)]
pub(crate) struct Relations {
    own: Mlp,
    effect: PairMlp,
    weight: PairMlp,
    graph: Graph,
}

/// Receivers' and senders' terms of the first layers of both pair networks.
struct PairTerms {
    effect: (Tensor, Tensor),
    weight: (Tensor, Tensor),
}

impl Relations {
    /// `which` is `post` or `prior`; `features` is the width of `u = [z, h]`.
    pub(crate) fn new(path: &Path<'_>, which: &str, config: &ObjectConfig, features: i64) -> Self {
        let hidden = config.hidden;
        let name = |net: &str| path.sub(format!("prop_cond_{net}_{which}"));
        let own = [features, hidden, hidden, hidden];
        Self {
            own: Mlp::new(&name("self"), &own, InitScheme::Framework),
            effect: PairMlp::new(&name("relational"), features, hidden, hidden),
            weight: PairMlp::new(&name("weights"), features, hidden, 1),
            graph: config.graph,
        }
    }

    /// What the other objects (and the object itself) do to each receiver.
    ///
    /// # Shapes
    /// `z [B, N, Z]`, `h [B, N, hidden]`; `rows [B, R]` picks the receivers (all N if absent); returns
    /// `[B, R, hidden]`.
    pub(crate) fn forward(&self, z: &Tensor, h: &Tensor, rows: Option<&Tensor>) -> Tensor {
        let features = Tensor::cat(&[z, h], -1); // u
        let all = Tensor::arange(z.size()[1], (Kind::Int64, z.device()));
        let all = all.unsqueeze(0).expand([z.size()[0], -1], false);
        let receivers = match rows {
            Some(rows) => gather_rows(&features, rows),
            None => features.shallow_clone(),
        };
        let rows = rows.unwrap_or(&all);
        let own = self.own.forward(&receivers);
        let terms = PairTerms {
            effect: self.effect.terms(&receivers, &features),
            weight: self.weight.terms(&receivers, &features),
        };
        let others = match self.graph {
            Graph::FullyConnected => self.fully_connected(&terms, z, rows),
            Graph::Knn { k, metric, aggregate } => {
                let k = k.min(z.size()[1] - 1);
                if k == 0 {
                    return own;
                }
                let neighbours = match metric {
                    KnnMetric::Distance => nearest(z, rows, k),
                    KnnMetric::Weight => {
                        let weights = self.presence_weights(&terms, z, rows);
                        // Below every weight, that of an absent object too: nobody is his own neighbour.
                        let others = weights.masked_fill(&itself(z, rows), -1.0);
                        let (_, by_weight) = others.sort_stable(true, -1, true);
                        by_weight.narrow(-1, 0, k)
                    }
                };
                self.among(&terms, z, &neighbours, aggregate)
            }
        };
        own + others
    }

    /// Attention over all senders, as in G-SWM: softmax first, then presence, then the diagonal removed.
    fn fully_connected(&self, terms: &PairTerms, z: &Tensor, rows: &Tensor) -> Tensor {
        let weights = normalised(&self.presence_weights(terms, z, rows)); // [B, R, N]
        let effects = self.effect.tail(&pairs(&terms.effect)); // [B, R, N, hidden]
        (effects * weights.unsqueeze(-1)).sum_dim_intlist(2, false, Kind::Float)
    }

    /// Softmax over all senders times their presence, zero for the receiver itself, `[B, R, N]`.
    fn presence_weights(&self, terms: &PairTerms, z: &Tensor, rows: &Tensor) -> Tensor {
        let logits = self.weight.tail(&pairs(&terms.weight)).squeeze_dim(-1);
        let weights = logits.softmax(-1, Kind::Float) * presence(z).transpose(1, 2);
        weights.masked_fill(&itself(z, rows), 0.0)
    }

    /// Effects of the given neighbours, `[B, R, k]`, on each receiver.
    fn among(
        &self,
        terms: &PairTerms,
        z: &Tensor,
        neighbours: &Tensor,
        aggregate: KnnAggregate,
    ) -> Tensor {
        let (batch, receivers, k) = neighbours.size3().expect("neighbours have three axes");
        let flat = neighbours.reshape([batch, receivers * k]);
        let sent = |x: &Tensor| gather_rows(x, &flat).view([batch, receivers, k, -1]);
        let layer = |(receiver, sender): &(Tensor, Tensor)| receiver.unsqueeze(2) + sent(sender);
        let effects = self.effect.tail(&layer(&terms.effect)); // [B, R, k, hidden]
        let present = sent(&presence(z)).squeeze_dim(-1); // [B, R, k]
        let weights = match aggregate {
            KnnAggregate::Sum => present,
            KnnAggregate::Attention => {
                let logits = self.weight.tail(&layer(&terms.weight)).squeeze_dim(-1);
                normalised(&(logits.softmax(-1, Kind::Float) * present))
            }
        };
        (effects * weights.unsqueeze(-1)).sum_dim_intlist(2, false, Kind::Float)
    }

    pub(crate) fn freeze(&mut self) {
        self.effect.freeze();
        self.weight.freeze();
    }
}

/// Weights of `[B, R, N]` divided by their sum over senders.
fn normalised(weights: &Tensor) -> Tensor {
    weights / (weights.sum_dim_intlist(-1, true, Kind::Float) + EPS)
}

/// First-layer outputs for every pair, `[B, R, N, hidden]`.
fn pairs((receivers, senders): &(Tensor, Tensor)) -> Tensor {
    receivers.unsqueeze(2) + senders.unsqueeze(1)
}

/// `[B, N, D]` at the rows `[B, R]` of each sample.
pub fn gather_rows(x: &Tensor, rows: &Tensor) -> Tensor {
    let (batch, count) = rows.size2().expect("row numbers have two axes");
    x.gather(1, &rows.unsqueeze(-1).expand([batch, count, x.size()[2]], false), false)
}

/// The k nearest others of each receiver by centre distance, absent ones last, ties by index, `[B, R, k]`.
fn nearest(z: &Tensor, rows: &Tensor, k: i64) -> Tensor {
    let _no_grad = tch::no_grad_guard();
    let centres = shift(z);
    let difference = gather_rows(&centres, rows).unsqueeze(2) - centres.unsqueeze(1);
    let distance = difference.square().sum_dim_intlist(-1, false, Kind::Float); // [B, R, N]
    let itself = itself(z, rows);
    let (_, by_distance) =
        distance.masked_fill(&itself, f64::INFINITY).sort_stable(true, -1, false);
    // The receiver is the farthest of all; counted as absent it stays so.
    let absent = presence(z).lt(0.5).transpose(1, 2).logical_or(&itself);
    let absent = absent.gather(-1, &by_distance, false).to_kind(Kind::Int64);
    let (_, present_first) = absent.sort_stable(true, -1, false);
    by_distance.gather(-1, &present_first, false).narrow(-1, 0, k)
}

/// Where the sender is the receiver itself, `[B, R, N]` bool.
fn itself(z: &Tensor, rows: &Tensor) -> Tensor {
    let columns = Tensor::arange(z.size()[1], (Kind::Int64, z.device()));
    rows.unsqueeze(-1).eq_tensor(&columns)
}

/// An MLP over ordered pairs whose first layer is split by receiver and sender.
#[derive(Debug)]
struct PairMlp {
    mlp: Mlp,
    features: i64,
    frozen: Option<(Tensor, Tensor)>,
}

impl PairMlp {
    fn new(path: &Path<'_>, features: i64, hidden: i64, outputs: i64) -> Self {
        let widths = [2 * features, hidden, hidden, outputs];
        Self { mlp: Mlp::new(path, &widths, InitScheme::Framework), features, frozen: None }
    }

    /// First-layer terms of receivers `[B, R, hidden]` (bias included) and senders `[B, N, hidden]`.
    fn terms(&self, receivers: &Tensor, senders: &Tensor) -> (Tensor, Tensor) {
        let fresh;
        let (receiver, sender) = if let Some(frozen) = &self.frozen {
            frozen
        } else {
            fresh = self.split();
            &fresh
        };
        let bias = &self.mlp.layers[0].bias;
        (linear(receivers, receiver, Some(bias)), linear(senders, sender, None))
    }

    fn tail(&self, first: &Tensor) -> Tensor {
        self.mlp.tail(first)
    }

    /// Weights on the receiver's and the sender's features, `[hidden, features]` each: the columns of
    /// `shift_i - shift_j` count once for the receiver and negatively for the sender.
    fn split(&self) -> (Tensor, Tensor) {
        let weight = &self.mlp.layers[0].weight;
        let receiver = weight.narrow(1, 0, self.features);
        let sender = weight.narrow(1, self.features, self.features);
        let tail = self.features - SHIFT - 2;
        let columns = |x: &Tensor| {
            (x.narrow(1, 0, SHIFT), x.narrow(1, SHIFT, 2), x.narrow(1, SHIFT + 2, tail))
        };
        let (before, own_shift, after) = columns(&receiver);
        let (other_before, difference, other_after) = columns(&sender);
        (
            Tensor::cat(&[before, own_shift + &difference, after], 1),
            Tensor::cat(&[other_before, -difference, other_after], 1),
        )
    }

    fn freeze(&mut self) {
        let _no_grad = tch::no_grad_guard();
        self.frozen = Some(self.split());
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::{config::presets, nn::ParamStore};

    fn example(graph: Graph) -> (Relations, Tensor, Tensor) {
        let mut config = presets::tiny().objects;
        config.graph = graph;
        let mut store = ParamStore::new(1, Device::Cpu);
        let features = 6 + config.z_what + config.z_dyna + config.hidden;
        let relations = store.build(|root| Relations::new(root, "post", &config, features));
        let mut noise = ParamStore::new(2, Device::Cpu);
        let init = crate::nn::Init::Normal { std: 0.5 };
        let (z, h) = noise.build(|root| {
            let z = root.weight("z", &[2, 5, features - config.hidden], init);
            (z, root.weight("h", &[2, 5, config.hidden], init))
        });
        let _no_grad = tch::no_grad_guard();
        let z = Tensor::cat(&[presence(&z).sigmoid(), z.narrow(-1, 1, z.size()[2] - 1)], -1);
        (relations, z, h.detach())
    }

    /// The formula of object spec 3.5, pair by pair.
    fn plain(relations: &Relations, z: &Tensor, h: &Tensor) -> Tensor {
        let (batch, count) = (z.size()[0], z.size()[1]);
        let u = Tensor::cat(&[z, h], -1);
        let own = u.unsqueeze(2).expand([batch, count, count, -1], false);
        let other = u.unsqueeze(1).expand([batch, count, count, -1], false).copy();
        let mut relative = other.narrow(-1, SHIFT, 2);
        relative.copy_(&(shift(z).unsqueeze(2) - shift(z).unsqueeze(1)));
        let pair = Tensor::cat(&[own, other], -1);
        let softmax = relations.weight.mlp.forward(&pair).softmax(2, Kind::Float);
        let eye = Tensor::eye(count, (Kind::Float, Device::Cpu)).view([1, count, count, 1]);
        let others: Tensor = 1.0 - eye;
        let weights = softmax * presence(z).unsqueeze(1) * others;
        let weights: Tensor = &weights / (weights.sum_dim_intlist(2, true, Kind::Float) + 1e-4);
        let effects = relations.effect.mlp.forward(&pair) * weights;
        relations.own.forward(&u) + effects.sum_dim_intlist(2, false, Kind::Float)
    }

    fn assert_close(a: &Tensor, b: &Tensor) {
        assert!((a - b).abs().max().double_value(&[]) < 2e-6);
    }

    #[test]
    fn split_first_layer_equals_the_plain_form() {
        let (mut relations, z, h) = example(Graph::FullyConnected);
        let _no_grad = tch::no_grad_guard();
        let expected = plain(&relations, &z, &h);
        assert_close(&relations.forward(&z, &h, None), &expected);
        relations.freeze();
        assert_close(&relations.forward(&z, &h, None), &expected);
        let rows = Tensor::from_slice(&[3i64, 0, 1, 4]).view([2, 2]);
        assert_close(&relations.forward(&z, &h, Some(&rows)), &gather_rows(&expected, &rows));
    }

    #[test]
    fn all_others_as_neighbours_nearly_is_fully_connected() {
        let knn = |metric| Graph::Knn { k: 4, metric, aggregate: KnnAggregate::Attention };
        for metric in [KnnMetric::Distance, KnnMetric::Weight] {
            let (relations, z, h) = example(knn(metric));
            let _no_grad = tch::no_grad_guard();
            let difference = relations.forward(&z, &h, None) - plain(&relations, &z, &h);
            // The softmax without the receiver itself only changes what 1e-4 weighs.
            assert!(difference.abs().max().double_value(&[]) < 1e-3);
        }
    }

    #[test]
    fn neighbours_are_the_nearest_present_others() {
        let x = |x: f32, present: f32| vec![present, 0.0, 0.1, 0.1, x, 0.0];
        let z = [x(0.0, 1.0), x(0.1, 0.0), x(0.5, 1.0), x(-0.2, 1.0)].concat();
        let z = Tensor::from_slice(&z).view([1, 4, 6]);
        let rows = Tensor::from_slice(&[0i64, 2]).view([1, 2]);
        let found: Vec<i64> = nearest(&z, &rows, 3).reshape(-1).try_into().unwrap();
        assert_eq!(found, [3, 2, 1, 0, 3, 1]);
    }
}
