//! The agreement table: how a quantity is compared, and what came of it.

use std::collections::{BTreeMap, BTreeSet};

use tch::{Kind, Tensor};

use super::vectors::{Vectors, quantity, thin};

/// Largest difference that counts as agreement: absolute for latents, memories and images, relative for sums
/// over many terms, relative to a parameter's largest gradient for gradients.
const TOLERANCE: f64 = 1e-4;

/// Where the twin found a gradient to be zero by mathematics, rounding may leave this fraction of the largest
/// gradient of all, times the tolerance.
const VANISHING: f64 = 1e-3;

/// Computed quantities by their recorded names.
pub(crate) type Tensors = BTreeMap<String, Tensor>;

/// What was compared with the vectors.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(crate) enum Form {
    /// Steps of the trainable model.
    Steps,
    /// Steps of the frozen model.
    Frozen,
    /// The training pass.
    Training,
}

/// One line of the table.
struct Row {
    /// Largest difference in each form that has the quantity.
    differences: [Option<f64>; 3],
    tolerance: f64,
}

/// The agreement of all cases.
#[derive(Default)]
pub(crate) struct Agreement {
    /// By case and quantity.
    rows: BTreeMap<(String, String), Row>,
    failures: Vec<String>,
}

impl Agreement {
    /// Compares everything recorded with everything computed; neither may have what the other lacks.
    pub(crate) fn compare(&mut self, form: Form, vectors: &Vectors, found: &Tensors) {
        let training = form == Form::Training;
        let recorded = vectors.results(training);
        let computed: BTreeSet<&str> = found.keys().map(String::as_str).collect();
        assert_eq!(recorded, computed, "{}: recorded and computed quantities", vectors.name);
        for name in recorded {
            if name == "train.gradients" {
                self.compare_gradients(vectors, &found[name]);
                continue;
            }
            let expected = vectors.get(name);
            let value = thin(&found[name], vectors.case.limit);
            assert_eq!(value.size(), expected.size(), "{}: shape of {name}", vectors.name);
            let measure = Measure::of(quantity(name));
            let difference = measure.difference(&value, expected);
            self.note(form, &vectors.name, quantity(name), difference, measure.tolerance(), name);
        }
    }

    /// Gradients parameter by parameter, each relative to its largest number.
    fn compare_gradients(&mut self, vectors: &Vectors, found: &Tensor) {
        let expected = vectors.get("train.gradients");
        assert_eq!(found.size(), expected.size(), "{}: number of gradients", vectors.name);
        let [found, expected] = [found, expected].map(|x| x.to_kind(Kind::Double));
        let zero = expected.abs().max().double_value(&[]) * VANISHING;
        let mut start = 0;
        for (name, tensor) in vectors.checkpoint().store.trainable() {
            let count = 2 + (tensor.numel() as i64).clamp(1, vectors.case.gradient_limit);
            let [found, expected] = [&found, &expected].map(|x| x.narrow(0, start, count));
            start += count;
            let positive = |x: f64| if x > 0.0 { x } else { zero };
            let norm = positive(expected.double_value(&[0]));
            let largest = positive(expected.double_value(&[1]));
            let apart = (&found - &expected).abs();
            let numbers = apart.narrow(0, 1, count - 1).max().double_value(&[]) / largest;
            let difference = numbers.max(apart.double_value(&[0]) / norm);
            let module = name.split('.').take(2).collect::<Vec<_>>().join(".");
            let (quantity, detail) = (format!("gradient {module}"), format!("gradient {name}"));
            self.note(Form::Training, &vectors.name, &quantity, difference, TOLERANCE, &detail);
        }
    }

    fn note(
        &mut self,
        form: Form,
        case: &str,
        quantity: &str,
        difference: f64,
        tolerance: f64,
        detail: &str,
    ) {
        let key = (case.to_owned(), quantity.to_owned());
        let row = self.rows.entry(key).or_insert(Row { differences: [None; 3], tolerance });
        let column = &mut row.differences[form as usize];
        // A NaN must not pass as a small number.
        if difference.is_nan() || column.is_none_or(|largest| difference > largest) {
            *column = Some(difference);
        }
        if difference.is_nan() || difference > tolerance {
            self.failures.push(format!("{case} ({form:?}): {detail} differs by {difference:.2e}"));
        }
    }

    /// Prints the table: the largest difference of each quantity in each form.
    #[expect(clippy::print_stdout, reason = "the table is what one runs the test to see")]
    pub(crate) fn print(&self) {
        println!(
            "{:<14} {:<52} {:>8} {:>8} {:>8} {:>9}",
            "case", "quantity", "steps", "frozen", "training", "tolerance"
        );
        for ((case, quantity), Row { differences, tolerance }) in &self.rows {
            let [steps, frozen, training] =
                differences.map(|column| column.map_or_else(String::new, |x| format!("{x:.1e}")));
            println!(
                "{case:<14} {quantity:<52} {steps:>8} {frozen:>8} {training:>8} {tolerance:>9.0e}"
            );
        }
    }

    /// Every comparison beyond its tolerance.
    pub(crate) fn failures(&self) -> &[String] {
        &self.failures
    }
}

/// How a quantity is compared.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Measure {
    /// Identities.
    Exact,
    /// Numbers of order one.
    Absolute,
    /// Sums over many terms, number by number.
    Relative,
}

impl Measure {
    fn of(quantity: &str) -> Self {
        const SUMS: [&str; 5] = ["kl.", "likelihood.", "residual_norm", "regression", "loss"];
        if ["objects.ids", "objects.next_id"].contains(&quantity) {
            Self::Exact
        } else if SUMS.iter().any(|sum| quantity.starts_with(sum)) {
            Self::Relative
        } else {
            Self::Absolute
        }
    }

    fn tolerance(self) -> f64 {
        if self == Self::Exact { 0.0 } else { TOLERANCE }
    }

    /// Largest difference of two tensors.
    fn difference(self, found: &Tensor, expected: &Tensor) -> f64 {
        let [found, expected] = [found, expected].map(|x| x.to_kind(Kind::Double));
        let difference = (found - &expected).abs();
        let difference = match self {
            Self::Exact | Self::Absolute => difference,
            Self::Relative => difference / expected.abs().clamp_min(1.0),
        };
        difference.max().double_value(&[])
    }
}
