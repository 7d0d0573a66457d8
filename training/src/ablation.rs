//! Ablations: variants of one recipe, each trained on the same data for the same steps and measured the same way.

use std::{ops::Range, path::Path};

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
const COLUMNS: [(&str, &str); 7] = [
    ("psnr_imagined", "PSNR, dB"),
    ("psnr_gain_over_copy_db", "above copy, dB"),
    ("agent_iou_imagined", "agent IoU"),
    ("object_recall_imagined", "recall"),
    ("object_precision_imagined", "precision"),
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
    /// Checkpoint whose weights each run starts from, as far as it has them.
    pub from: Option<&'a Path>,
    /// Where they compute.
    pub device: Device,
    /// Data that they are measured on.
    pub test: (&'a Dataset, Range<usize>),
    /// Steps that are imagined.
    pub horizon: usize,
}

impl Ablation<'_> {
    /// Trains a variant in `folder`, from where it stopped, and measures it.
    ///
    /// # Errors
    /// If the recipe has nothing for the variant to change, training fails, or files cannot be read or written.
    pub fn measure(&self, variant: Variant, folder: &Path) -> anyhow::Result<Report> {
        let recipe = variant.of(self.recipe, self.steps)?;
        let mut trainer =
            Trainer::open(recipe, self.clips, self.data, self.seed, folder, self.device)?;
        if let Some(from) = self.from {
            trainer.start_from(from)?;
        }
        trainer.run(self.clips, None)?;
        let world = GatsbiWorld::load(&trainer.checkpoint_path(), self.device)?;
        let protocol = Protocol { horizon: self.horizon, samples: 0, perceptual: None };
        let (dataset, range) = &self.test;
        let report = report(&world, dataset, range.clone(), protocol, |_| {})?;
        fs_err::write(folder.join("eval.json"), serde_json::to_string_pretty(&report)?)?;
        Ok(report)
    }
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
