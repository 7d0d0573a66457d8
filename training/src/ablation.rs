//! Ablations: variants of one recipe, each trained on the same data for the same steps and measured the same way.

use std::{collections::BTreeSet, ops::Range, path::Path};

use gatsbi_episodes::Dataset;
use gatsbi_models::gatsbi::world::GatsbiWorld;
use tch::Device;

use crate::{
    clips::Clips,
    evaluation::report::{Protocol, Report, report},
    recipe::Recipe,
    trainer::Trainer,
    variant::Variant,
};

/// Columns of the table: a number of the report, and its heading.
const COLUMNS: [(&str, &str); 9] = [
    ("psnr_imagined", "PSNR, dB"),
    ("psnr_gain_over_copy_db", "above copy, dB"),
    ("agent_iou_imagined", "agent IoU"),
    ("object_recall_imagined", "recall"),
    ("object_precision_imagined", "precision"),
    ("moved_object_px_imagined", "moved objects, px"),
    ("moved_object_way_imagined", "share of way"),
    ("object_px_before_interaction", "px before contact"),
    ("object_px_after_interaction", "px after contact"),
];

/// What all variants have in common.
#[derive(Debug)]
pub struct Ablation<'a> {
    /// The recipe that they vary.
    pub recipe: &'a Recipe,
    /// Steps that each is trained for.
    pub steps: u64,
    /// What they are trained on, and its name.
    pub clips: &'a Clips,
    /// Name of the data.
    pub data: &'a str,
    /// Seed of each run.
    pub seed: u64,
    /// Checkpoint whose weights each run starts from, as far as it and all variants have them: none knows more than another.
    pub from: Option<&'a Path>,
    /// Where they compute.
    pub device: Device,
    /// Data that they are measured on.
    pub test: (&'a Dataset, Range<usize>),
    /// Steps that are imagined.
    pub horizon: usize,
}

impl Ablation<'_> {
    /// Trains each variant in a folder of `out` with its name, from where it stopped, and measures it. `told` is given what
    /// is measured so far.
    ///
    /// # Errors
    /// If the recipe has nothing for a variant to change, training fails, or files cannot be read or written.
    pub fn measure(
        &self,
        variants: &[Variant],
        out: &Path,
        mut told: impl FnMut(&[(Variant, Report)]) -> anyhow::Result<()>,
    ) -> anyhow::Result<Vec<(Variant, Report)>> {
        let open = |variant: &Variant| {
            let (recipe, folder) = (variant.of(self.recipe, self.steps)?, out.join(variant.name()));
            Trainer::open(recipe, self.clips, self.data, self.seed, &folder, self.device)
        };
        let mut trainers: Vec<Trainer> = variants.iter().map(open).collect::<Result<_, _>>()?;
        let common = common(&trainers);
        let mut measured = Vec::new();
        for (variant, trainer) in variants.iter().zip(&mut trainers) {
            if let Some(from) = self.from {
                trainer.start_from(from, |name| common.contains(name))?;
            }
            measured.push((*variant, self.measured(trainer, &out.join(variant.name()))?));
            told(&measured)?;
        }
        Ok(measured)
    }

    fn measured(&self, trainer: &mut Trainer, folder: &Path) -> anyhow::Result<Report> {
        trainer.run(self.clips, None)?;
        let world = GatsbiWorld::load(&trainer.checkpoint_path(), self.device)?;
        let protocol = Protocol { horizon: self.horizon, samples: 0, perceptual: None };
        let (dataset, range) = &self.test;
        let report = report(&world, dataset, range.clone(), protocol, |_| {})?;
        fs_err::write(folder.join("eval.json"), serde_json::to_string_pretty(&report)?)?;
        Ok(report)
    }
}

/// Names of the parameters that all runs have in the same shape.
fn common(trainers: &[Trainer]) -> BTreeSet<String> {
    let has = |trainer: &Trainer, name: &str, shape: &[i64]| {
        trainer.parameters().get(name).is_some_and(|tensor| tensor.size() == shape)
    };
    let first = trainers.first().into_iter().flat_map(|trainer| trainer.parameters().iter());
    first
        .filter(|(name, _, tensor)| trainers.iter().all(|other| has(other, name, &tensor.size())))
        .map(|(name, _, _)| name.to_owned())
        .collect()
}

/// The table of measured variants in Markdown: means with half the width of their 95 % intervals over episodes.
pub fn table(measured: &[(Variant, Report)]) -> String {
    let known = |name: &str| measured.iter().any(|(_, report)| report.numbers.contains_key(name));
    let columns: Vec<_> = COLUMNS.iter().filter(|(name, _)| known(name)).collect();
    let headings: Vec<&str> = columns.iter().map(|(_, heading)| *heading).collect();
    let mut lines = vec![
        format!("| variant | {} |", headings.join(" | ")),
        format!("|---|{}", "---|".repeat(columns.len())),
    ];
    for (variant, report) in measured {
        let cells: Vec<String> = columns
            .iter()
            .map(|(name, _)| {
                let number = |name: &str| report.numbers.get(name).copied().unwrap_or(f64::NAN);
                format!("{:.3} ± {:.3}", number(name), number(&format!("{name}_ci95")))
            })
            .collect();
        lines.push(format!("| {} | {} |", variant.name(), cells.join(" | ")));
    }
    lines.join("\n") + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_has_the_columns_that_were_measured() {
        let mut report = Report::default();
        report.numbers.insert("psnr_imagined".to_owned(), 21.25);
        report.numbers.insert("psnr_imagined_ci95".to_owned(), 0.5);
        let table = table(&[(Variant::Plain, Report::default()), (Variant::Knn3, report)]);
        assert_eq!(
            table,
            "| variant | PSNR, dB |\n|---|---|\n| plain | NaN ± NaN |\n| knn3 | 21.250 ± 0.500 |\n"
        );
    }
}
