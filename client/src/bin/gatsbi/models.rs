//! `gatsbi models` and `gatsbi model NAME`.

use gatsbi_client::{Model, proto};
use serde_json::json;

use crate::{
    Shared,
    print::{self, pairs, print, print_json, table},
};

pub(crate) async fn list(shared: &Shared) -> anyhow::Result<()> {
    let models = shared.client().await?.models().await?;
    if shared.json {
        let models: Vec<_> = models.iter().map(print::json).collect::<Result<_, _>>()?;
        return print_json(&json!({ "models": models }));
    }
    let titles = [
        "<name",
        "image",
        "action",
        "slots",
        "agent",
        "objects",
        "<trained",
        "<device",
        "<checkpoint",
    ];
    let rows = models.iter().map(|model| {
        vec![
            model.name.clone(),
            format!("{0}x{0}", model.image_size),
            model.actions.len().to_string(),
            model.slots.to_string(),
            model.agent_slot.map_or_else(|| "-".into(), |slot| slot.to_string()),
            model.max_objects.to_string(),
            trained(model),
            model.device.clone(),
            short(&model.hash).to_owned(),
        ]
    });
    print(&table(&titles, rows))
}

pub(crate) async fn show(shared: &Shared, name: &str) -> anyhow::Result<()> {
    let model = shared.client().await?.model(name).await?;
    if shared.json {
        return print_json(&print::json(&model)?);
    }
    print(&described(&model))
}

/// How far a model was trained, in words.
pub(crate) fn trained(model: &Model) -> String {
    match model.trained_steps {
        0 => "untrained".to_owned(),
        steps => format!("{steps} steps"),
    }
}

/// The first digits of a hash, enough to tell checkpoints apart.
pub(crate) fn short(hash: &str) -> &str {
    hash.get(..12).unwrap_or(hash)
}

fn described(model: &Model) -> String {
    let size = model.image_size;
    let fitting = match model.preprocess() {
        proto::Preprocess::CentreCrop => "cropped to a square and scaled",
        proto::Preprocess::Stretch => "stretched",
        proto::Preprocess::Unspecified => "fitted",
    };
    let or_none = |number: Option<u32>| number.map_or_else(|| "none".into(), |n| n.to_string());
    let period = model.frame_period_seconds.map_or_else(|| "unknown".into(), |s| format!("{s} s"));
    let mut text = pairs([
        ("name", model.name.clone()),
        ("checkpoint", model.hash.clone()),
        ("trained", trained(model)),
        ("device", model.device.clone()),
        ("images", format!("{size}x{size}, others are {fitting}")),
        ("frame period", period),
        ("slots", model.slots.to_string()),
        ("agent slot", or_none(model.agent_slot)),
        ("object slots", model.max_objects.to_string()),
        ("keypoints", or_none(model.keypoints)),
        ("belief", format!("{} bytes", model.state_bytes)),
    ]);
    if let Some(limits) = &model.limits {
        text.push_str(&pairs([(
            "a request",
            format!(
                "at most {} candidates, {} steps, {} samples, {} rows, {} MiB of outputs",
                limits.max_candidates,
                limits.max_horizon,
                limits.max_samples,
                limits.max_rows,
                limits.max_output_bytes >> 20
            ),
        )]));
    }
    let actions = model.actions.iter().enumerate().map(|(i, action)| {
        let unit = if action.unit.is_empty() { "-" } else { &action.unit };
        let (offset, scale) = (format!("{:.4}", action.offset), format!("{:.4}", action.scale));
        vec![i.to_string(), action.name.clone(), unit.to_owned(), offset, scale]
    });
    text.push('\n');
    text.push_str(&table(&["action", "<name", "<unit", "offset", "scale"], actions));
    if !model.card.is_empty() {
        text.push('\n');
        text.push_str(model.card.trim_end());
        text.push('\n');
    }
    text
}
