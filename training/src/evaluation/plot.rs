//! The report's metrics over imagined steps, as an SVG.

use std::path::Path;

use anyhow::anyhow;
use plotters::prelude::*;

use super::report::Report;

/// Metrics that are drawn where the report has them, with what their axis says.
const PANELS: [(&str, &str); 4] = [
    ("psnr", "PSNR, dB"),
    ("ssim", "SSIM"),
    ("cosine", "cosine similarity"),
    ("st_lpips", "ST-LPIPS (lower is better)"),
];

/// Width and height of a panel.
const PANEL: (u32, u32) = (420, 280);

/// Writes a panel per metric: the model beside copying the last observed frame.
///
/// # Errors
/// If the file cannot be written, or there is no imagined step.
pub fn write(path: &Path, report: &Report) -> anyhow::Result<()> {
    let first = report.per_step.first().ok_or_else(|| anyhow!("there is no imagined step"))?;
    let panels: Vec<_> = PANELS.iter().filter(|(name, _)| first.contains_key(*name)).collect();
    let size = (PANEL.0 * panels.len() as u32, PANEL.1);
    let sheet = SVGBackend::new(path, size).into_drawing_area();
    let failed = |error: &dyn std::fmt::Display| anyhow!("{}: {error}", path.display());
    sheet.fill(&WHITE).map_err(|error| failed(&error))?;
    for (area, (name, title)) in sheet.split_evenly((1, panels.len())).iter().zip(panels) {
        let line = |name: &str| -> Vec<(f64, f64)> {
            let values = report.per_step.iter().map(|step| step[name]);
            values.enumerate().map(|(step, value)| ((step + 1) as f64, value)).collect()
        };
        let lines = [
            ("model", line(name), &BLUE),
            ("copy of the last frame", line(&format!("{name}_copy")), &RED),
        ];
        let values = lines.iter().flat_map(|(_, line, _)| line.iter().map(|(_, value)| *value));
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
            (low.min(value), high.max(value))
        });
        let margin = ((high - low) * 0.05).max(1e-6);
        let steps = report.per_step.len() as f64;
        let mut chart = ChartBuilder::on(area)
            .caption(title, ("sans-serif", 16))
            .margin(10)
            .x_label_area_size(34)
            .y_label_area_size(48)
            .build_cartesian_2d(1.0..steps, low - margin..high + margin)
            .map_err(|error| failed(&error))?;
        let mut mesh = chart.configure_mesh();
        mesh.x_desc("imagined step").light_line_style(TRANSPARENT);
        mesh.draw().map_err(|error| failed(&error))?;
        for (label, points, colour) in lines {
            let series = LineSeries::new(points, colour);
            chart
                .draw_series(series)
                .map_err(|error| failed(&error))?
                .label(label)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour));
        }
        let mut legend = chart.configure_series_labels();
        legend.background_style(WHITE.mix(0.8)).border_style(BLACK.mix(0.3));
        legend.draw().map_err(|error| failed(&error))?;
    }
    sheet.present().map_err(|error| failed(&error))
}
