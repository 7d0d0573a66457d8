//! The demo's pictures: what was observed, what it was split into, and what was imagined.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use gatsbi_client::{Array, Output};
use gatsbi_pictures::{
    enlarge,
    scene::{Scene, grey},
};
use image::RgbImage;

use super::{
    Story,
    measure::{Errors, labels, psnr},
};
use crate::picture::{
    ENLARGED, image,
    scene::{cut_out, labelled, scene},
    sheet::{self, Row, Sheet, Tile},
};

/// Imagined steps that the strip shows.
const COLUMNS: usize = 8;

/// Writes all pictures; returns their paths, in the order to look at them.
pub(super) fn write(story: &Story, errors: &Errors, folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let paths = ["1-overlay.png", "2-observed.png", "3-decomposed.png", "4-imagined.png"]
        .map(|name| folder.join(name));
    let last = story.beliefs.len() - 1;
    sheet::save(&observed(story, last)?.overlay(3 * ENLARGED), &paths[0])?;
    observed_sheet(story)?.save(&paths[1])?;
    decomposed_sheet(story)?.save(&paths[2])?;
    imagined_sheet(story, errors)?.save(&paths[3])?;
    Ok(paths.into())
}

/// Each observed frame: camera, rebuilt, agent, objects, overlay.
fn observed_sheet(story: &Story) -> anyhow::Result<Sheet> {
    let mut rows: Vec<Row> = [
        "camera: the frames that were sent",
        "rebuilt: the same frames as the model draws them",
        "agent: what the agent's mask cuts out of each frame",
        "objects: their masks, a colour each",
        "overlay: agent blue, objects in their colours, boxes with ids",
        "labels: what the recording says is there; its objects have a numbering of their own",
    ]
    .map(|heading| Row { heading: heading.to_owned(), tiles: Vec::new() })
    .into();
    for (t, belief) in story.beliefs.iter().enumerate() {
        let scene = observed(story, t)?;
        let frame = output(belief, Output::Frame)?;
        let rebuilt = image(frame).context("no RGB image came")?;
        let (width, height) = scene.picture.dimensions();
        let agent = match &scene.agent {
            Some(mask) => cut_out(&scene.picture, mask),
            None => RgbImage::new(width, height),
        };
        let pictures = [
            enlarge(&scene.picture, ENLARGED),
            enlarge(&rebuilt, ENLARGED),
            enlarge(&agent, ENLARGED),
            enlarge(&scene.objects_alone(), ENLARGED),
            scene.overlay(ENLARGED),
        ];
        let labels = labels(&story.recording, t)
            .map(|(labels, legend)| enlarge(&labelled((width, height), labels, legend), ENLARGED));
        let step = format!("step {}", belief.step);
        for (row, picture) in rows.iter_mut().zip(pictures.into_iter().chain(labels)) {
            row.tiles.push(Tile::new(picture, &[&step]));
        }
    }
    rows.retain(|row| !row.tiles.is_empty());
    Ok(Sheet { title: format!("{}: what it saw", story.model.name), rows })
}

/// The last observed frame, taken apart.
fn decomposed_sheet(story: &Story) -> anyhow::Result<Sheet> {
    let t = story.beliefs.len() - 1;
    let (belief, scene) = (&story.beliefs[t], observed(story, t)?);
    let size = scene.picture.dimensions();
    let tile =
        |picture: &RgbImage, caption: &[&str]| Tile::new(enlarge(picture, ENLARGED), caption);

    let rgb = |which| image(output(belief, which)?).context("no RGB image came");
    let whole = Row {
        heading: "the whole".to_owned(),
        tiles: vec![
            tile(&scene.picture, &["camera"]),
            tile(&rgb(Output::Frame)?, &["rebuilt by the model"]),
            tile(&rgb(Output::Background)?, &["background: without agent", "and objects"]),
            Tile::new(scene.overlay(ENLARGED), &["overlay"]),
        ],
    };
    let masks = output(belief, Output::SlotMasks)?;
    let slots = (0..masks.shape()[0]).map(|slot| {
        let is_agent = story.model.agent_slot == Some(slot as u32);
        let name = format!("slot {slot}{}", if is_agent { ": the agent" } else { "" });
        let mask = masks.at(&[slot]).to_f32();
        let share = 100.0 * mask.iter().sum::<f32>() / mask.len() as f32;
        tile(&grey(size, &mask), &[&name, &format!("{share:.1} % of the image")])
    });
    let slots = Row {
        heading: "mixture slots: white where a slot explains the pixel".to_owned(),
        tiles: slots.collect(),
    };
    let named = scene.objects.iter().filter_map(|(painted, mask)| {
        Some((belief.objects.iter().find(|object| object.id == painted.id)?, mask))
    });
    let objects = named.map(|(object, mask)| {
        let name = format!("object {} at {:.0}, {:.0}", object.id, object.pixel_x, object.pixel_y);
        let more = format!("presence {:.2}", object.presence);
        tile(&cut_out(&scene.picture, mask), &[&name, &more])
    });
    let mut rows = vec![whole, slots];
    let objects: Vec<Tile> = objects.collect();
    let heading = match objects.len() {
        0 => "objects: none".to_owned(),
        _ => "objects: what each mask cuts out of the frame; centres in pixels".to_owned(),
    };
    // As many tiles a row as there are slots, or all in one if they fit.
    for (number, tiles) in chunks(objects, 8).into_iter().enumerate() {
        let heading = if number == 0 { heading.clone() } else { String::new() };
        rows.push(Row { heading, tiles });
    }
    let title = format!("{}: step {} taken apart", story.model.name, belief.step);
    Ok(Sheet { title, rows })
}

/// The recorded future over the imagined ones.
fn imagined_sheet(story: &Story, errors: &Errors) -> anyhow::Result<Sheet> {
    let (last, episode) = (story.beliefs.len() - 1, &story.recording.episode);
    let columns = spaced(errors.steps.len(), COLUMNS);
    let step = |at: usize| {
        format!("step {} (+{})", last + errors.steps[at].depth as usize, errors.steps[at].depth)
    };
    let now = || -> anyhow::Result<Tile> {
        let caption = format!("step {last}: now");
        Ok(Tile::new(
            observed(story, last)?.boxed(&frame(story, last)?, ENLARGED),
            &[&caption, "the last frame seen"],
        ))
    };

    let mut recorded = Row {
        heading: "RECORDED: what really happened; PSNR of a copy of the last frame seen".to_owned(),
        tiles: vec![Tile::new(
            enlarge(&frame(story, last)?, ENLARGED),
            &[&format!("step {last}: now"), "the last frame seen"],
        )],
    };
    for &at in &columns {
        let recorded_frame = frame(story, last + errors.steps[at].depth as usize)?;
        let copy = format!("copy: {:.1} dB", psnr(errors.steps[at].copied));
        recorded.tiles.push(Tile::new(enlarge(&recorded_frame, ENLARGED), &[&step(at), &copy]));
    }
    let mut rows = vec![recorded];
    for (number, candidate) in story.candidates.iter().enumerate() {
        let compared = if number == 0 { "; PSNR against the recorded frames" } else { "" };
        let heading = format!("IMAGINED under {}{compared}", candidate.name);
        let mut row = Row { heading, tiles: vec![now()?] };
        for &at in &columns {
            let scene = imagined(story, number, at)?;
            let mut tile = Tile::new(scene.boxed(&scene.picture, ENLARGED), &[&step(at)]);
            if number == 0 {
                tile.caption.push(format!("{:.1} dB", psnr(errors.steps[at].imagined)));
            }
            row.tiles.push(tile);
        }
        rows.push(row);
    }
    let title = format!(
        "{}: what it imagines after {} frames of episode {}",
        story.model.name,
        story.beliefs.len(),
        episode.id()
    );
    Ok(Sheet { title, rows })
}

fn observed(story: &Story, t: usize) -> anyhow::Result<Scene> {
    let belief = &story.beliefs[t];
    let masks = output(belief, Output::ObjectMasks)?;
    let agent = belief.outputs.array(Output::AgentMask);
    Ok(scene(frame(story, t)?, agent, masks, &belief.objects))
}

fn imagined(story: &Story, candidate: usize, at: usize) -> anyhow::Result<Scene> {
    let outputs = &story.rollout.outputs;
    let part = |which| outputs.array(which).map(|array: &Array| array.at(&[0, candidate, at]));
    let frame = part(Output::Frame).as_ref().and_then(image).context("no imagined frame came")?;
    let masks = part(Output::ObjectMasks).context("no imagined object masks came")?;
    let tracks = outputs.tracks().context("no imagined objects came")?;
    let objects = tracks.objects(&[0, candidate, at]);
    Ok(scene(frame, part(Output::AgentMask).as_ref(), &masks, &objects))
}

/// The recorded frame `t`.
fn frame(story: &Story, t: usize) -> anyhow::Result<RgbImage> {
    let info = &story.recording.info;
    let pixels = story.recording.episode.frame(t).to_vec();
    RgbImage::from_raw(info.width, info.height, pixels).context("a frame of another size")
}

fn output(belief: &gatsbi_client::Belief, which: Output) -> anyhow::Result<&Array> {
    belief.outputs.array(which).with_context(|| format!("no {} came", which.as_str_name()))
}

/// Positions of at most `most` of `n` steps: close together at first, further apart later, the first and the last among
/// them.
fn spaced(n: usize, most: usize) -> Vec<usize> {
    let most = most.min(n);
    let mut positions: Vec<usize> = Vec::new();
    for column in 0..most {
        let share = column as f64 / (most.max(2) - 1) as f64;
        // At least one further than the one before, and leaving room for those to come.
        let wanted = (n as f64).powf(share).round() as usize - 1;
        let least = positions.last().map_or(0, |before| before + 1);
        positions.push(wanted.clamp(least, n - (most - column)));
    }
    positions
}

fn chunks<T>(items: Vec<T>, size: usize) -> Vec<Vec<T>> {
    let mut items = items.into_iter();
    let mut chunks = Vec::new();
    loop {
        let chunk: Vec<T> = items.by_ref().take(size).collect();
        if chunk.is_empty() && !chunks.is_empty() {
            return chunks;
        }
        let empty = chunk.is_empty();
        chunks.push(chunk);
        if empty {
            return chunks;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_denser_at_first_and_end_with_the_last_step() {
        let columns = spaced(35, 8);
        assert_eq!((columns.len(), columns[0], columns[7]), (8, 0, 34));
        assert!(columns.is_sorted_by(|a, b| a < b), "{columns:?}");
        assert!(columns[7] - columns[6] > columns[1] - columns[0], "{columns:?}");
        assert_eq!(spaced(3, 8), [0, 1, 2]);
        assert_eq!(spaced(1, 8), [0]);
    }
}
