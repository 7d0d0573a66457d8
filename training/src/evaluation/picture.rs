//! Pictures of decomposition and imagination.

use std::path::Path;

use gatsbi_models::scene::Scene;
use tch::{Device, Kind, Tensor};

use super::Recorded;

/// Rows: truth, model, agent share, each slot's visible part, objects, background; columns: time; one block an
/// episode.
pub fn write(
    path: &Path,
    recorded: &Recorded,
    scenes: &[Scene],
    agent: Option<i64>,
    enlarge: i64,
) -> anyhow::Result<()> {
    let rows = recorded.frames[0].size()[0];
    let mut blocks = Vec::new();
    for row in 0..rows {
        let columns: Vec<Tensor> = scenes
            .iter()
            .zip(&recorded.frames)
            .map(|(scene, truth)| column(scene, &truth.get(row), row, agent))
            .collect();
        blocks.push(Tensor::cat(&columns, 2));
    }
    let sheet = Tensor::cat(&blocks, 1); // [3, H, W]
    let (_, height, width) = sheet.size3()?;
    let sheet =
        sheet.unsqueeze(0).upsample_nearest2d([height * enlarge, width * enlarge], None, None);
    write_png(path, &sheet.squeeze_dim(0))
}

/// Writes an image `[3, H, W]` in [0, 1].
pub fn write_png(path: &Path, image: &Tensor) -> anyhow::Result<()> {
    let (_, height, width) = image.size3()?;
    let bytes = (image.clamp(0.0, 1.0) * 255.0).round().to_kind(Kind::Uint8);
    let bytes = bytes.permute([1, 2, 0]).contiguous().to_device(Device::Cpu);
    let bytes: Vec<u8> = bytes.view(-1).try_into()?;
    image::save_buffer(path, &bytes, width as u32, height as u32, image::ColorType::Rgb8)?;
    Ok(())
}

fn column(scene: &Scene, truth: &Tensor, row: i64, agent: Option<i64>) -> Tensor {
    let frame = scene.frame.as_ref().expect("the frame was asked for").get(row);
    let slots = scene.slot_masks.as_ref().expect("slot masks were asked for").get(row);
    let objects = scene.object_masks.as_ref().expect("object masks were asked for").get(row);
    let gray = |mask: &Tensor| mask.unsqueeze(0).expand([3, -1, -1], false);
    let mut cells = vec![truth.shallow_clone(), frame.shallow_clone()];
    if let Some(agent) = agent {
        cells.push(&frame * gray(&slots.get(agent)) + (1.0 - gray(&slots.get(agent))) * 0.5);
    }
    for slot in 0..slots.size()[0] {
        cells.push(gray(&slots.get(slot)).shallow_clone());
    }
    cells.push(colours(&objects));
    if let Some(background) = &scene.background {
        cells.push(background.get(row));
    }
    Tensor::cat(&cells, 1)
}

/// Object shares in distinct colours.
fn colours(masks: &Tensor) -> Tensor {
    let palette: [[f32; 3]; 8] = [
        [1.0, 0.2, 0.2],
        [0.2, 1.0, 0.2],
        [0.3, 0.4, 1.0],
        [1.0, 1.0, 0.2],
        [1.0, 0.2, 1.0],
        [0.2, 1.0, 1.0],
        [1.0, 0.6, 0.2],
        [1.0, 1.0, 1.0],
    ];
    let count = masks.size()[0];
    let chosen: Vec<f32> = (0..count).flat_map(|i| palette[i as usize % 8]).collect();
    let chosen = Tensor::from_slice(&chosen).view([count, 3, 1, 1]).to_device(masks.device());
    (masks.unsqueeze(1) * chosen).sum_dim_intlist(0, false, Kind::Float)
}
