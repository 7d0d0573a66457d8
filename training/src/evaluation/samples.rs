//! Scenes and labels of two objects, for tests.

use gatsbi_models::scene::{ObjectTable, Scene};
use tch::{Device, Kind, Tensor};

/// A scene with objects 7 and 9 at these columns of row 31.5.
pub(super) fn scene(columns: [f64; 2]) -> Scene {
    let x = |pixel: f64| (pixel + 0.5) * 2.0 / 64.0 - 1.0;
    let row = |pixel: f64| [1.0, x(pixel), x(31.5), 0.1, 0.1, 0.0];
    let values = columns.map(row).concat();
    Scene {
        objects: Some(ObjectTable {
            ids: Tensor::from_slice(&[7i64, 9]).view([1, 2]),
            values: Tensor::from_slice(&values).to_kind(Kind::Float).view([1, 2, 6]),
        }),
        ..Scene::default()
    }
}

/// Labels with objects 2 and 3 beginning at these columns.
pub(super) fn labels(left: [i64; 2]) -> Tensor {
    let labels = Tensor::zeros([64, 64], (Kind::Int64, Device::Cpu));
    for (label, left) in [2, 3].into_iter().zip(left) {
        let _ = labels.narrow(0, 30, 4).narrow(1, left, 4).fill_(label);
    }
    labels
}
