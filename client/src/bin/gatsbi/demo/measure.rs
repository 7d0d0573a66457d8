//! What the model saw and how far its imagination is from what happened, in numbers.

use anyhow::Context as _;
use gatsbi_client::{Array, Numbers, Object, Output};
use serde_json::json;

use super::Story;
use crate::{
    print::{self, table},
    recording::Recording,
};

/// The future in which nothing moves.
const COPY: &str = "a copy of the last observed frame";

/// The agent and the objects in the last observed frame, beside the recording's labels where it has some.
pub(super) struct Found {
    step: u64,
    agent_slot: Option<u32>,
    /// Share of the image.
    agent_share: Option<f64>,
    /// Intersection over union with the label.
    agent_iou: Option<f64>,
    objects: Vec<Object>,
    /// Centres of the labelled objects that can be seen, in pixels.
    labelled: Option<Vec<(f64, f64)>>,
}

/// Errors of each imagined step, and how well each candidate's future fits the recorded one.
pub(super) struct Errors {
    pub(super) steps: Vec<StepErrors>,
    fits: Vec<Fit>,
}

/// How well a future fits the recorded one, as a mean over its steps.
struct Fit {
    /// What is done, in words.
    name: String,
    mse: f64,
    /// Intersection over union of the agent's mask and the recording's label.
    agent_iou: Option<f64>,
}

/// Mean squared errors of one step, over the pixels and colours of the frame in [0, 1].
#[derive(Clone, Copy, Debug)]
pub(super) struct StepErrors {
    /// Steps since the last observed frame.
    pub(super) depth: u32,
    /// Of the imagination under the recorded actions.
    pub(super) imagined: f64,
    /// Of taking the last observed frame for the future.
    pub(super) copied: f64,
}

impl Found {
    pub(super) fn of(story: &Story) -> Self {
        let last = &story.beliefs[story.beliefs.len() - 1];
        let mask = last.outputs.array(Output::AgentMask).map(Array::to_f32);
        let t = story.beliefs.len() - 1;
        let labels = labels(&story.recording, t);
        let agent_iou = mask
            .as_deref()
            .zip(labels)
            .map(|(mask, (labels, legend))| iou(mask, labels, legend.agent));
        Self {
            step: last.step,
            agent_slot: story.model.agent_slot,
            agent_share: mask
                .map(|mask| mask.iter().map(|&m| f64::from(m)).sum::<f64>() / mask.len() as f64),
            agent_iou,
            objects: last.present().copied().collect(),
            labelled: labels.map(|(labels, legend)| {
                centres(labels, story.recording.info.width as usize, legend.first_object)
            }),
        }
    }

    pub(super) fn described(&self) -> String {
        let mut text = match (self.agent_slot, self.agent_share) {
            (Some(slot), Some(share)) => {
                let iou = self.agent_iou.map_or_else(String::new, |iou| {
                    format!("; {iou:.2} intersection over union with the recording's label")
                });
                format!("agent     slot {slot}, {:.1} % of the image{iou}\n", share * 100.0)
            }
            _ => "agent     the model has none\n".to_owned(),
        };
        let labelled = self.labelled.as_ref().map_or_else(String::new, |labelled| {
            format!("; the recording's labels show {}", labelled.len())
        });
        text += &format!("objects   {} after step {}{labelled}\n", self.objects.len(), self.step);
        if !self.objects.is_empty() {
            text += "\n";
            text += &print::objects(&self.objects);
        }
        text
    }

    pub(super) fn record(&self) -> serde_json::Value {
        let objects: Vec<_> = self.objects.iter().flat_map(print::json).collect();
        json!({
            "step": self.step,
            "agent_slot": self.agent_slot,
            "agent_share": self.agent_share,
            "agent_iou": self.agent_iou,
            "objects": objects,
            "labelled_objects": self.labelled.as_ref().map(Vec::len),
        })
    }
}

impl Errors {
    pub(super) fn of(story: &Story) -> anyhow::Result<Self> {
        let last = story.beliefs.len() - 1;
        let episode = &story.recording.episode;
        let mut fits = Vec::new();
        for (number, candidate) in story.candidates.iter().enumerate() {
            let mse = mean(squared_errors(story, number)?);
            let name = candidate.name.clone();
            fits.push(Fit { name, mse, agent_iou: agent_ious(story, number).map(mean) });
        }
        let imagined = squared_errors(story, 0)?;
        let step = |(&depth, imagined): (&u32, f64)| {
            let copied = squared_error(episode.frame(last), episode.frame(last + depth as usize));
            StepErrors { depth, imagined, copied }
        };
        let steps: Vec<_> = story.rollout.depths.iter().zip(imagined).map(step).collect();
        let mse = mean(steps.iter().map(|step| step.copied).collect());
        fits.push(Fit { name: COPY.to_owned(), mse, agent_iou: copied_ious(story).map(mean) });
        Ok(Self { steps, fits })
    }

    pub(super) fn described(&self) -> String {
        let mut text = "\nerror against the recorded future, of the imagination under the recorded actions and of a \
                        copy of the last\nobserved frame (MSE over RGB in [0, 1]; PSNR in dB, higher is better)\n"
            .to_owned();
        let row = |name: String, imagined: f64, copied: f64| {
            let (ours, theirs) = (psnr(imagined), psnr(copied));
            let mut row = vec![name, format!("{imagined:.5}"), format!("{ours:.2}")];
            row.extend([
                format!("{copied:.5}"),
                format!("{theirs:.2}"),
                format!("{:+.2}", ours - theirs),
            ]);
            row
        };
        let mut rows: Vec<_> = self
            .steps
            .iter()
            .map(|step| row(step.depth.to_string(), step.imagined, step.copied))
            .collect();
        let imagined = mean(self.steps.iter().map(|step| step.imagined).collect());
        let copied = mean(self.steps.iter().map(|step| step.copied).collect());
        rows.push(row("mean".to_owned(), imagined, copied));
        text.push_str(&table(
            &["step", "imagined MSE", "PSNR", "copied MSE", "PSNR", "gain dB"],
            rows,
        ));
        text.push_str(
            "\nhow well each future fits the recorded one, as a mean over its steps: where the model has learned what \
             actions do,\nthe recorded ones fit best\n",
        );
        let labelled = self.fits.iter().any(|fit| fit.agent_iou.is_some());
        let iou =
            |fit: &Fit| fit.agent_iou.map_or_else(|| "-".to_owned(), |iou| format!("{iou:.2}"));
        let rows = self.fits.iter().map(|fit| {
            let mut row =
                vec![fit.name.clone(), format!("{:.5}", fit.mse), format!("{:.2}", psnr(fit.mse))];
            row.extend(labelled.then(|| iou(fit)));
            row
        });
        let titles = ["<future", "MSE", "PSNR", "agent's IoU"];
        text.push_str(&table(&titles[..if labelled { 4 } else { 3 }], rows));
        text
    }

    pub(super) fn record(&self) -> serde_json::Value {
        let step = |step: &StepErrors| {
            let StepErrors { depth, imagined, copied } = step;
            json!({
                "depth": depth,
                "imagined_mse": imagined,
                "imagined_psnr": psnr(*imagined),
                "copied_mse": copied,
                "copied_psnr": psnr(*copied),
            })
        };
        let fit = |fit: &Fit| {
            let Fit { name, mse, agent_iou } = fit;
            json!({ "name": name, "mse": mse, "psnr": psnr(*mse), "agent_iou": agent_iou })
        };
        json!({
            "steps": self.steps.iter().map(step).collect::<Vec<_>>(),
            "futures": self.fits.iter().map(fit).collect::<Vec<_>>(),
        })
    }
}

/// Peak signal-to-noise ratio in dB of a mean squared error of values in [0, 1].
pub(super) fn psnr(mse: f64) -> f64 {
    -10.0 * mse.log10()
}

/// Errors of a candidate's frames, step by step.
fn squared_errors(story: &Story, candidate: usize) -> anyhow::Result<Vec<f64>> {
    let frames = story.rollout.outputs.array(Output::Frame).context("no frames came")?;
    let last = story.beliefs.len() - 1;
    let error = |(at, &depth): (usize, &u32)| {
        let imagined = frames.at(&[0, candidate, at]);
        let Numbers::U8(imagined) = imagined.numbers() else { return None };
        Some(squared_error(imagined, story.recording.episode.frame(last + depth as usize)))
    };
    let errors: Option<_> = story.rollout.depths.iter().enumerate().map(error).collect();
    errors.context("frames came in another form than was asked for")
}

/// How far a candidate's agent is where the recording's is, step by step; nothing without agent or labels.
fn agent_ious(story: &Story, candidate: usize) -> Option<Vec<f64>> {
    let masks = story.rollout.outputs.array(Output::AgentMask)?;
    let last = story.beliefs.len() - 1;
    let iou = |(at, &depth): (usize, &u32)| {
        let (labels, legend) = labels(&story.recording, last + depth as usize)?;
        Some(self::iou(&masks.at(&[0, candidate, at]).to_f32(), labels, legend.agent))
    };
    story.rollout.depths.iter().enumerate().map(iou).collect()
}

/// The same of an agent that does not move, by the labels.
fn copied_ious(story: &Story) -> Option<Vec<f64>> {
    story.model.agent_slot?;
    let last = story.beliefs.len() - 1;
    let (now, legend) = labels(&story.recording, last)?;
    let now: Vec<f32> =
        now.iter().map(|label| f32::from(u8::from(*label == legend.agent))).collect();
    let iou = |&depth: &u32| {
        Some(self::iou(&now, labels(&story.recording, last + depth as usize)?.0, legend.agent))
    };
    story.rollout.depths.iter().map(iou).collect()
}

fn mean(numbers: Vec<f64>) -> f64 {
    let count = numbers.len();
    numbers.into_iter().sum::<f64>() / count as f64
}

fn squared_error(a: &[u8], b: &[u8]) -> f64 {
    let square = |(a, b): (&u8, &u8)| ((f64::from(*a) - f64::from(*b)) / 255.0).powi(2);
    a.iter().zip(b).map(square).sum::<f64>() / a.len() as f64
}

/// What a recording says is in frame `t`.
pub(super) fn labels(
    recording: &Recording,
    t: usize,
) -> Option<(&[u8], gatsbi_episodes::LabelLegend)> {
    Some((recording.episode.mask(t)?, recording.info.labels?))
}

fn iou(mask: &[f32], labels: &[u8], agent: u8) -> f64 {
    let count = |both: fn(bool, bool) -> bool| {
        mask.iter().zip(labels).filter(|(m, label)| both(**m > 0.5, **label == agent)).count()
    };
    let union = count(|a, b| a || b);
    if union == 0 { 1.0 } else { count(|a, b| a && b) as f64 / union as f64 }
}

/// Centres of the objects that have a pixel.
fn centres(labels: &[u8], width: usize, first_object: u8) -> Vec<(f64, f64)> {
    let centre = |object: u8| {
        let pixels = labels.iter().enumerate().filter(|(_, label)| **label == object);
        let (mut n, mut x, mut y) = (0usize, 0usize, 0usize);
        for (at, _) in pixels {
            (n, x, y) = (n + 1, x + at % width, y + at / width);
        }
        (n > 0).then(|| (x as f64 / n as f64, y as f64 / n as f64))
    };
    (first_object..=u8::MAX).filter_map(centre).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_those_of_values_between_0_and_1() {
        assert!((squared_error(&[0, 255], &[255, 255]) - 0.5).abs() < 1e-12);
        assert!((psnr(0.01) - 20.0).abs() < 1e-12);
    }

    #[test]
    fn the_agent_is_compared_with_its_label() {
        assert!((iou(&[0.9, 0.9, 0.1, 0.1], &[1, 0, 1, 2], 1) - 1.0 / 3.0).abs() < 1e-12);
        assert!((iou(&[0.0; 2], &[0; 2], 1) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn objects_that_cannot_be_seen_are_not_counted() {
        let labels = [0, 2, 1, 2, 0, 4];
        assert_eq!(centres(&labels, 3, 2), [(0.5, 0.5), (2.0, 1.0)]);
    }
}
