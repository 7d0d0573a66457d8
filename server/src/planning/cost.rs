//! Costs as data: a program of weighted terms and constraints, checked once.
//!
//! Positions and distances are in units of the image's half side, x rightwards and y downwards in [-1, 1].
//! What an imagined step measures is in [`super::measure`], what a rollout comes to in [`super::scores`].

use std::sync::Arc;

use gatsbi_models::scene::{Output, Outputs};

/// An object or the agent.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Subject {
    /// The object with this identity.
    Object(i64),
    /// The agent: the centre of its mask.
    Agent,
    /// Every object that is present.
    AllObjects,
}

/// An upright rectangle: left, top, right, bottom.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rect(pub [f32; 4]);

impl Rect {
    pub(super) fn area(self) -> f32 {
        let [left, top, right, bottom] = self.0;
        (right - left).max(0.0) * (bottom - top).max(0.0)
    }

    pub(super) fn distance_to(self, [x, y]: [f32; 2]) -> f32 {
        let [left, top, right, bottom] = self.0;
        let beyond = |at: f32, low: f32, high: f32| (low - at).max(at - high).max(0.0);
        beyond(x, left, right).hypot(beyond(y, top, bottom))
    }

    /// How far a point inside is from the nearest edge; 0 outside.
    pub(super) fn depth_of(self, [x, y]: [f32; 2]) -> f32 {
        let [left, top, right, bottom] = self.0;
        (x - left).min(right - x).min(y - top).min(bottom - y).max(0.0)
    }
}

/// What is measured.
#[derive(Clone, Debug, PartialEq)]
pub enum Measure {
    /// Distance to a point, beyond a tolerance.
    ToTarget {
        /// Who.
        subject: Subject,
        /// Where to.
        target: [f32; 2],
        /// Distances up to this are no cost.
        tolerance: f32,
        /// Whether it counts squared.
        squared: bool,
    },
    /// Difference of a distance from what it should be; the mean over pairs with [`Subject::AllObjects`].
    Between {
        /// One.
        a: Subject,
        /// The other.
        b: Subject,
        /// The distance that they should have.
        distance: f32,
        /// Whether the difference counts squared.
        squared: bool,
    },
    /// Distance to the nearest place where the subject may be.
    Region {
        /// Who.
        subject: Subject,
        /// The region.
        region: Rect,
        /// Whether it should stay out.
        keep_out: bool,
    },
    /// Share of the smaller one's bounding box that the other's covers.
    Overlap {
        /// One.
        a: Subject,
        /// The other.
        b: Subject,
    },
    /// Sum over dimensions of weighted squared actions.
    ActionMagnitude {
        /// Weight of each dimension, its scale included.
        weights: Vec<f32>,
    },
    /// Sum over dimensions of weighted squared changes.
    ActionSmoothness {
        /// Weight of each dimension, its scale included.
        weights: Vec<f32>,
        /// The action before the first, if it counts.
        previous: Option<Vec<f32>>,
    },
    /// Standard deviation of a position over samples.
    Spread {
        /// Who.
        subject: Subject,
    },
    /// Mean squared difference from an image; 1 where no pixel counts.
    GoalImage {
        /// `[H, W, 3]` in [0, 1].
        goal: Arc<[f32]>,
        /// Which pixels count.
        pixels: Pixels,
    },
    /// 1 - intersection over union with masks; their mean.
    GoalMasks {
        /// Whose mask should be which, `[H, W]` in [0, 1].
        goals: Vec<(Subject, Arc<[f32]>)>,
    },
}

/// Which pixels of a goal image count.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Pixels {
    /// All.
    All,
    /// Weighted by the predicted agent's mask.
    Agent,
    /// Weighted by the predicted objects' masks.
    Objects,
    /// Weighted by what is neither.
    Background,
}

impl Measure {
    /// Who is looked at.
    pub fn subjects(&self) -> Vec<Subject> {
        match self {
            Self::ToTarget { subject, .. }
            | Self::Region { subject, .. }
            | Self::Spread { subject } => vec![*subject],
            Self::Between { a, b, .. } | Self::Overlap { a, b } => vec![*a, *b],
            Self::GoalMasks { goals } => goals.iter().map(|(subject, _)| *subject).collect(),
            Self::ActionMagnitude { .. }
            | Self::ActionSmoothness { .. }
            | Self::GoalImage { .. } => vec![],
        }
    }

    /// Outputs of a step that it looks at.
    fn outputs(&self) -> Outputs {
        let positions = || {
            self.subjects().into_iter().map(|subject| match subject {
                Subject::Agent => Output::AgentMask,
                Subject::Object(_) | Subject::AllObjects => Output::Objects,
            })
        };
        match self {
            Self::GoalImage { pixels, .. } => {
                let masks: &[Output] = match pixels {
                    Pixels::All => &[],
                    Pixels::Agent => &[Output::AgentMask],
                    Pixels::Objects => &[Output::ObjectMasks],
                    Pixels::Background => &[Output::AgentMask, Output::ObjectMasks],
                };
                masks.iter().copied().chain([Output::Frame]).collect()
            }
            Self::GoalMasks { .. } if positions().any(|output| output == Output::Objects) => {
                positions().chain([Output::ObjectMasks]).collect()
            }
            _ => positions().collect(),
        }
    }
}

/// Which steps of a rollout count.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum When {
    /// All: their discounted mean.
    EveryStep,
    /// The last.
    LastStep,
    /// The one that costs least.
    BestStep,
}

/// A measure and the steps that count.
#[derive(Clone, Debug, PartialEq)]
pub struct Term {
    /// What is measured.
    pub measure: Measure,
    /// Which steps count.
    pub when: When,
}

/// How the samples of a candidate become one number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Risk {
    /// Their mean.
    Mean,
    /// The mean of this share of them, the worst, in (0, 1]; at least one.
    WorstShare(f32),
    /// The worst.
    Worst,
}

impl Risk {
    pub(super) fn of(self, mut values: Vec<f32>) -> f32 {
        values.sort_by(|a, b| b.total_cmp(a));
        let count = match self {
            Self::Mean => values.len(),
            Self::WorstShare(share) => {
                ((values.len() as f32 * share).round() as usize).clamp(1, values.len())
            }
            Self::Worst => 1,
        };
        values[..count].iter().sum::<f32>() / count as f32
    }
}

/// A cost program.
#[derive(Clone, Debug, PartialEq)]
pub struct Program {
    /// The terms and their weights.
    pub terms: Vec<(Term, f32)>,
    /// What must hold, and the most that each may measure.
    pub constraints: Vec<(Term, f32)>,
    /// Factor by which a step counts less than the one before, in (0, 1].
    pub discount: f32,
    /// How samples become one number.
    pub risk: Risk,
    /// Distance that stands for that of an object that is not present.
    pub missing: f32,
}

impl Program {
    pub(super) fn all(&self) -> impl Iterator<Item = &Term> {
        self.terms.iter().chain(&self.constraints).map(|(term, _)| term)
    }

    /// Outputs of a step that it looks at.
    pub fn outputs(&self) -> Outputs {
        self.all().map(|term| term.measure.outputs()).fold(Outputs::default(), Outputs::union)
    }
}
