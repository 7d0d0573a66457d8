//! What is sent: observations, actions, and which outputs are wanted. Sizes are checked here, where they are made;
//! what depends on the model (image size, action dimension, limits) the server checks.

use std::time::Duration;

use bytes::Bytes;
use gatsbi_proto::v1::{self, DataType, image::Content};

use crate::{
    Encoding, Output,
    error::{Error, Result},
};

/// What a robot saw and did in one step.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// Number of the step, from 0: as many as the session has observed before. It is what makes repeating safe.
    pub step: u64,
    /// What the camera saw; nothing for a dropped frame, over which the belief advances by the model's prediction.
    pub image: Option<Image>,
    /// The action that led to the image, in the model's raw units. It may be empty in step 0 alone.
    pub action: Vec<f32>,
}

/// A colour image. One of another size than the model's is fitted by the server.
#[derive(Clone, Debug, PartialEq)]
pub struct Image(v1::Image);

impl Image {
    /// A PNG, JPEG or WebP file as it is.
    pub fn file(bytes: impl Into<Bytes>) -> Self {
        Self(v1::Image { content: Some(Content::Encoded(bytes.into())) })
    }

    /// Raw pixels: red, green and blue of each, row by row from the top, `[height, width, 3]`.
    ///
    /// # Errors
    /// [`Error::Input`] if `pixels` is not `3 * width * height` bytes long.
    pub fn rgb(width: u32, height: u32, pixels: impl Into<Bytes>) -> Result<Self> {
        let data = pixels.into();
        if data.len() as u64 != 3 * u64::from(width) * u64::from(height) {
            let expected = format!("3 * {width} * {height} bytes");
            return Err(Error::input("pixels", format!("{} bytes", data.len()), expected));
        }
        let tensor = v1::Tensor {
            dtype: DataType::U8 as i32,
            shape: vec![height, width, 3],
            data,
            values: Vec::new(),
        };
        Ok(Self(v1::Image { content: Some(Content::Pixels(tensor)) }))
    }
}

impl From<Observation> for v1::Observation {
    fn from(Observation { step, image, action }: Observation) -> Self {
        Self { step: Some(step), image: image.map(|image| image.0), action }
    }
}

/// Which outputs are wanted, in which form. What is not asked for is neither computed nor sent.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Selection {
    outputs: Vec<Output>,
    encoding: Encoding,
    every_k: Option<u32>,
    last_only: bool,
}

impl Selection {
    /// These outputs, images and masks as 32-bit floats.
    pub fn of(outputs: impl IntoIterator<Item = Output>) -> Self {
        Self { outputs: outputs.into_iter().collect(), ..Self::default() }
    }

    /// Images and masks in this form.
    #[must_use]
    pub fn encoding(mut self, encoding: Encoding) -> Self {
        self.encoding = encoding;
        self
    }

    /// Of rollouts only: depths k, 2k, 3k... instead of all.
    #[must_use]
    pub fn every(mut self, k: u32) -> Self {
        self.every_k = Some(k);
        self
    }

    /// Of rollouts only: the last depth instead of all.
    #[must_use]
    pub fn last_only(mut self) -> Self {
        self.last_only = true;
        self
    }

    /// Which depths of a rollout over `horizon` steps give outputs.
    pub(crate) fn depths(&self, horizon: usize) -> Vec<u32> {
        let (horizon, k) = (horizon as u32, self.every_k.unwrap_or(1).max(1));
        if self.last_only { vec![horizon] } else { (k..=horizon).step_by(k as usize).collect() }
    }
}

impl From<Selection> for v1::OutputSelection {
    fn from(Selection { outputs, encoding, every_k, last_only }: Selection) -> Self {
        let outputs = outputs.into_iter().map(|output| output as i32).collect();
        Self { outputs, encoding: encoding as i32, every_k, last_only }
    }
}

/// Candidate action sequences, raw units, `[candidates, horizon, dimension]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Actions {
    shape: [usize; 3],
    values: Vec<f32>,
}

impl Actions {
    /// Takes the numbers of all candidates, one after the other, step by step.
    ///
    /// # Errors
    /// [`Error::Input`] if there are not `candidates * horizon * dimension` numbers, or none.
    pub fn new(shape: [usize; 3], values: Vec<f32>) -> Result<Self> {
        let [n, h, a] = shape;
        let expected = n.checked_mul(h).and_then(|rows| rows.checked_mul(a));
        if values.is_empty() || expected != Some(values.len()) {
            let expected = format!("{n} candidates x {h} steps x {a} numbers");
            return Err(Error::input("actions", format!("{} numbers", values.len()), expected));
        }
        if u32::try_from(n.max(h).max(a)).is_err() {
            return Err(Error::input("actions", format!("{shape:?}"), "axes below 2^32"));
        }
        Ok(Self { shape, values })
    }

    /// Takes candidates as lists of steps.
    ///
    /// # Errors
    /// [`Error::Input`] if there is no candidate, a candidate has another number of steps than the first, or a step
    /// another number of dimensions.
    pub fn nested(candidates: &[Vec<Vec<f32>>]) -> Result<Self> {
        let horizon = candidates.first().map_or(0, Vec::len);
        let dimension = candidates.iter().flatten().next().map_or(0, Vec::len);
        for (n, candidate) in candidates.iter().enumerate() {
            if candidate.len() != horizon {
                let value = format!("{} steps in candidate {n}", candidate.len());
                return Err(Error::input(
                    "actions",
                    value,
                    format!("{horizon} steps as in the first"),
                ));
            }
            if let Some(h) = candidate.iter().position(|step| step.len() != dimension) {
                let value = format!("{} numbers in step {h} of candidate {n}", candidate[h].len());
                return Err(Error::input("actions", value, format!("{dimension} as in the first")));
            }
        }
        let values = candidates.iter().flatten().flatten().copied().collect();
        Self::new([candidates.len(), horizon, dimension], values)
    }

    /// Candidates N.
    pub fn candidates(&self) -> usize {
        self.shape[0]
    }

    /// Horizon H, in steps.
    pub fn horizon(&self) -> usize {
        self.shape[1]
    }

    /// The numbers, `[N, H, A]` row-major.
    pub fn values(&self) -> &[f32] {
        &self.values
    }
}

impl From<Actions> for v1::Tensor {
    fn from(Actions { shape, values }: Actions) -> Self {
        Self {
            dtype: DataType::F32 as i32,
            shape: shape.map(|axis| axis as u32).to_vec(),
            data: values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>().into(),
            values: Vec::new(),
        }
    }
}

/// How futures are drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Sampling {
    /// Every distribution gives its mean.
    #[default]
    Mean,
    /// Drawn.
    Sample {
        /// Seed; drawn by the server, and told in the answer, if absent.
        seed: Option<u64>,
        /// Futures of each candidate, 1 or more.
        samples: u32,
        /// Whether each candidate draws its own random numbers. Shared ones compare candidates more fairly.
        independent_candidates: bool,
    },
}

impl Sampling {
    /// Futures of each candidate.
    pub fn samples(self) -> u32 {
        match self {
            Self::Mean => 1,
            Self::Sample { samples, .. } => samples,
        }
    }
}

impl From<Sampling> for v1::Sampling {
    fn from(sampling: Sampling) -> Self {
        match sampling {
            Sampling::Mean => Self { mode: v1::Mode::Mean as i32, ..Self::default() },
            Sampling::Sample { seed, samples, independent_candidates } => Self {
                mode: v1::Mode::Sample as i32,
                seed,
                samples: Some(samples),
                independent_candidates,
            },
        }
    }
}

/// Asks what will happen if.
#[derive(Clone, Debug, PartialEq)]
pub struct Imagination {
    /// What is done.
    pub actions: Actions,
    /// How futures are drawn.
    pub sampling: Sampling,
    /// What of them is wanted; at least one output.
    pub outputs: Selection,
    /// Refused if the session's last observed step is another one; absent: whatever it is.
    pub at_step: Option<u64>,
    /// Within which time the whole answer is of use.
    pub timeout: Option<Duration>,
}

impl Imagination {
    /// The mean futures under `actions`.
    pub fn of(actions: Actions, outputs: Selection) -> Self {
        Self { actions, sampling: Sampling::Mean, outputs, at_step: None, timeout: None }
    }

    pub(crate) fn into_request(self, session_id: String) -> v1::ImagineRequest {
        v1::ImagineRequest {
            session_id,
            at_step: self.at_step,
            actions: Some(self.actions.into()),
            sampling: Some(self.sampling.into()),
            outputs: Some(self.outputs.into()),
            costs: None,
            timeout_millis: self.timeout.map(millis),
        }
    }
}

/// A duration in the form of the wire, where 0 is not allowed.
pub(crate) fn millis(duration: Duration) -> u32 {
    u32::try_from(duration.as_millis()).unwrap_or(u32::MAX).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_must_fill_the_image() {
        let image = Image::rgb(2, 1, vec![0; 6]).unwrap();
        let Some(Content::Pixels(tensor)) = image.0.content else { panic!("no pixels") };
        assert_eq!(tensor.shape, [1, 2, 3]);
        let error = Image::rgb(2, 2, vec![0; 6]).unwrap_err();
        assert_eq!(error.to_string(), "pixels is 6 bytes, expected 3 * 2 * 2 bytes");
    }

    #[test]
    fn actions_are_laid_out_candidate_by_candidate() {
        let actions =
            Actions::nested(&[vec![vec![1.0, 2.0], vec![3.0, 4.0]], vec![vec![5.0, 6.0]; 2]])
                .unwrap();
        assert_eq!(actions.values(), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 5.0, 6.0]);
        let tensor = v1::Tensor::from(actions);
        assert_eq!(tensor.shape, [2, 2, 2]);
        assert_eq!(tensor.data[4..8], 2.0f32.to_le_bytes());
    }

    #[test]
    fn ragged_or_empty_actions_are_refused() {
        #[track_caller]
        fn check(candidates: &[Vec<Vec<f32>>], expected: &str) {
            assert_eq!(Actions::nested(candidates).unwrap_err().to_string(), expected);
        }
        let step = vec![0.0; 7];
        check(
            &[vec![step.clone(); 3], vec![step.clone(); 2]],
            "actions is 2 steps in candidate 1, expected 3 steps as in the first",
        );
        check(
            &[vec![step.clone(), vec![0.0; 6]]],
            "actions is 6 numbers in step 1 of candidate 0, expected 7 as in the first",
        );
        check(&[], "actions is 0 numbers, expected 0 candidates x 0 steps x 0 numbers");
        check(&[vec![]], "actions is 0 numbers, expected 1 candidates x 0 steps x 0 numbers");
        assert!(Actions::new([usize::MAX, 2, 2], vec![0.0; 4]).is_err());
    }

    #[test]
    fn a_selection_says_which_depths_it_gives() {
        let all = Selection::of([Output::Objects]);
        assert_eq!(all.depths(3), [1, 2, 3]);
        assert_eq!(all.clone().every(4).depths(15), [4, 8, 12]);
        assert_eq!(all.last_only().depths(15), [15]);
    }

    #[test]
    fn a_time_limit_is_never_nothing() {
        assert_eq!(millis(Duration::from_micros(3)), 1);
        assert_eq!(millis(Duration::from_millis(250)), 250);
        assert_eq!(millis(Duration::MAX), u32::MAX);
    }
}
