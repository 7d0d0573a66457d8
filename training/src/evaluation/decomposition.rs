//! Ground truth against decomposition: agent, background, objects.

use gatsbi_models::scene::Scene;
use tch::{Kind, Tensor};

/// Fewest visible pixels of an object that counts.
const VISIBLE_PIXELS: i64 = 12;

/// Farthest that a found object may be from a true one, in pixels.
const MATCH_PIXELS: f64 = 6.0;

/// Which entity each pixel belongs to: slots 0..K, then objects K.., `[B, H, W]` int64.
pub fn segmentation(scene: &Scene) -> Tensor {
    let slots = scene.slot_masks.as_ref().expect("slot masks were asked for");
    let objects = scene.object_masks.as_ref().expect("object masks were asked for");
    Tensor::cat(&[slots, objects], 1).argmax(1, false)
}

/// Intersection over union of two bool maps `[B, H, W]`, per row; NaN where both are empty.
pub fn iou(a: &Tensor, b: &Tensor) -> Vec<f64> {
    let count = |x: Tensor| x.to_kind(Kind::Float).sum_dim_intlist([1i64, 2].as_slice(), false, Kind::Float);
    let ratio = count(a.logical_and(b)) / count(a.logical_or(b));
    ratio.to_kind(Kind::Double).try_into().expect("one number per row")
}

/// Objects found in a frame against the true ones.
#[derive(Clone, Copy, Debug, Default)]
pub struct ObjectCounts {
    /// True objects with enough visible pixels.
    pub truth: usize,
    /// Objects with presence above 1/2.
    pub found: usize,
    /// Pairs within reach.
    pub matched: usize,
    /// Sum of their distances in pixels.
    pub distance: f64,
}

/// Matches the objects of row `row` one to one, nearest pairs first.
pub fn match_objects(scene: &Scene, labels: &Tensor, row: i64) -> (ObjectCounts, Vec<(i64, i64)>) {
    let table = scene.objects.as_ref().expect("objects were asked for");
    let values: Vec<Vec<f32>> = table.values.get(row).try_into().expect("a table of floats");
    let ids: Vec<i64> = table.ids.get(row).try_into().expect("a row of identities");
    let labels = labels.get(row);
    let side = labels.size()[0] as f64;
    let found: Vec<(i64, [f64; 2])> = values
        .iter()
        .zip(ids)
        .filter(|(object, _)| object[0] > 0.5)
        .map(|(object, id)| {
            let pixel = |x: f32| (f64::from(x) + 1.0) * side / 2.0 - 0.5;
            (id, [pixel(object[1]), pixel(object[2])])
        })
        .collect();
    let mut truth = Vec::new();
    for label in 2..=labels.max().int64_value(&[]) {
        let pixels = labels.eq(label).nonzero();
        if pixels.size()[0] >= VISIBLE_PIXELS {
            let centre: Vec<f64> = pixels
                .to_kind(Kind::Double)
                .mean_dim([0i64].as_slice(), false, Kind::Double)
                .try_into()
                .expect("row and column");
            truth.push((label, [centre[1], centre[0]]));
        }
    }
    let mut pairs = Vec::new();
    for (i, (_, a)) in found.iter().enumerate() {
        for (j, (_, b)) in truth.iter().enumerate() {
            let distance = (a[0] - b[0]).hypot(a[1] - b[1]);
            if distance <= MATCH_PIXELS {
                pairs.push((distance, i, j));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (mut used_found, mut used_truth) = (vec![false; found.len()], vec![false; truth.len()]);
    let mut counts =
        ObjectCounts { truth: truth.len(), found: found.len(), ..ObjectCounts::default() };
    let mut matches = Vec::new();
    for (distance, i, j) in pairs {
        if !used_found[i] && !used_truth[j] {
            (used_found[i], used_truth[j]) = (true, true);
            counts.matched += 1;
            counts.distance += distance;
            matches.push((truth[j].0, found[i].0));
        }
    }
    (counts, matches)
}
