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
    let count = |x: Tensor| {
        x.to_kind(Kind::Float).sum_dim_intlist([1i64, 2].as_slice(), false, Kind::Float)
    };
    let ratio = count(a.logical_and(b)) / count(a.logical_or(b));
    ratio.to_kind(Kind::Double).try_into().expect("one number per row")
}

/// The segmentation of row `row` with all background slots as one, `[H, W]` int64.
pub fn entities(segmentation: &Tensor, is_background: &Tensor, row: i64) -> Tensor {
    segmentation.get(row).masked_fill(&is_background.get(row), -1)
}

/// Adjusted Rand index of two segmentations `[H, W]` (Hubert & Arabie 1985): 1 for equal partitions, 0 for
/// what chance gives, NaN if nothing else is possible.
pub fn adjusted_rand_index(a: &Tensor, b: &Tensor) -> f64 {
    let classes = |x: &Tensor| -> Vec<i64> {
        x.flatten(0, -1).unique_dim(0, true, false, false).0.try_into().expect("integers")
    };
    let pairs = |n: f64| n * (n - 1.0) / 2.0;
    let count = |x: &Tensor| x.sum(Kind::Int64).int64_value(&[]) as f64;
    let (mut together, mut in_a, mut in_b) = (0.0, 0.0, 0.0);
    let classes_b = classes(b);
    for class_a in classes(a) {
        let mask = a.eq(class_a);
        in_a += pairs(count(&mask));
        for class_b in &classes_b {
            together += pairs(count(&mask.logical_and(&b.eq(*class_b))));
        }
    }
    for class_b in &classes_b {
        in_b += pairs(count(&b.eq(*class_b)));
    }
    let expected = in_a * in_b / pairs(a.numel() as f64);
    let most = f64::midpoint(in_a, in_b);
    // NaN where both partitions have one part, or only parts of one pixel: chance cannot do worse.
    (together - expected) / (most - expected)
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

/// Identities and centres, in pixels, of the objects of row `row` whose presence is above 1/2. `side` is the image's.
pub fn found_objects(scene: &Scene, row: i64, side: f64) -> Vec<(i64, [f64; 2])> {
    let table = scene.objects.as_ref().expect("objects were asked for");
    let values: Vec<Vec<f32>> = table.values.get(row).try_into().expect("a table of floats");
    let ids: Vec<i64> = table.ids.get(row).try_into().expect("a row of identities");
    let pixel = |x: f32| (f64::from(x) + 1.0) * side / 2.0 - 0.5;
    values
        .iter()
        .zip(ids)
        .filter(|(object, _)| object[0] > 0.5)
        .map(|(object, id)| (id, [pixel(object[1]), pixel(object[2])]))
        .collect()
}

/// Labels and centres, in pixels, of the true objects in labels `[H, W]` that are visible enough.
pub fn true_objects(labels: &Tensor) -> Vec<(i64, [f64; 2])> {
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
    truth
}

/// Matches the objects of row `row` one to one, nearest pairs first.
pub fn match_objects(scene: &Scene, labels: &Tensor, row: i64) -> (ObjectCounts, Vec<(i64, i64)>) {
    let labels = labels.get(row);
    let found = found_objects(scene, row, labels.size()[0] as f64);
    let truth = true_objects(&labels);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rand_index_knows_equal_and_independent_partitions() {
        let a = Tensor::from_slice(&[0i64, 0, 1, 1, 2, 2]).view([2, 3]);
        let renamed = Tensor::from_slice(&[5i64, 5, 3, 3, 9, 9]).view([2, 3]);
        assert!((adjusted_rand_index(&a, &renamed) - 1.0).abs() < 1e-12);
        let rows = Tensor::from_slice(&[0i64, 0, 1, 1]).view([2, 2]);
        let columns = Tensor::from_slice(&[0i64, 1, 0, 1]).view([2, 2]);
        assert!((adjusted_rand_index(&rows, &columns) + 0.5).abs() < 1e-12);
    }

    #[test]
    fn empty_and_full_overlap() {
        let a = Tensor::from_slice(&[true, true, false, false]).view([1, 2, 2]);
        let b = Tensor::from_slice(&[true, false, false, false]).view([1, 2, 2]);
        assert!((iou(&a, &b)[0] - 0.5).abs() < 1e-12);
        assert!(
            iou(&a.logical_and(&a.logical_not()), &b.logical_and(&b.logical_not()))[0].is_nan()
        );
    }
}
