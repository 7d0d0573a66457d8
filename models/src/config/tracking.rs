//! How sessions find, keep and tell apart their objects.

use serde::{Deserialize, Serialize};

/// Rules of tracking objects that change no parameter (decisions rows 7 to 9).
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Tracking {
    /// When an observed frame may bring new objects.
    pub discovery: DiscoveryPolicy,
    /// How presence lasts.
    pub presence: PresenceRule,
    /// How objects are numbered.
    pub ids: IdRule,
    /// Bounds that keep the size of a box, as a fraction of the image, sensible in sessions and rollouts far
    /// longer than any training sequence.
    pub scale_bounds: Option<(f64, f64)>,
    /// Intersection over union above which two tracked boxes count as one object, of which the one known longer is kept;
    /// `None` keeps both.
    #[serde(default)]
    pub merge: Option<f64>,
    /// Distance between colours, in [0, 1] each, above which boxes are of different objects however much they overlap: they are
    /// not merged, and what is found there is not rejected. `None` looks at boxes alone.
    #[serde(default)]
    pub unlike: Option<f64>,
    /// How far from where it was an object keeps its identity when it is found anew, in units of the image's half side: if the
    /// frame does not show its colour where it is thought to be, what is found in its colour is the same object, and where
    /// nothing is it is kept in mind. `None` leaves identities to propagation. Needs `unlike`.
    #[serde(default)]
    pub handover: Option<f64>,
}

impl Tracking {
    /// What a live server wants: late arrivals are found, presence does not fade, identities never repeat.
    pub fn serving() -> Self {
        Self {
            discovery: DiscoveryPolicy::EveryFrame,
            presence: PresenceRule::Hold,
            ids: IdRule::Monotone,
            scale_bounds: Some((0.01, 1.5)),
            merge: None,
            unlike: None,
            handover: None,
        }
    }

    /// The rules of G-SWM, for parity and the paper's metrics.
    pub fn original() -> Self {
        Self {
            discovery: DiscoveryPolicy::FirstFrame,
            presence: PresenceRule::Product,
            ids: IdRule::Original,
            scale_bounds: None,
            merge: None,
            unlike: None,
            handover: None,
        }
    }
}

/// When an observed frame may bring new objects.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DiscoveryPolicy {
    /// At every observed frame.
    EveryFrame,
    /// Only at the first frame of a session.
    FirstFrame,
}

/// How the presence of a tracked object develops.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PresenceRule {
    /// The running product of per-frame presences, which fades in long sessions.
    Product,
    /// Back to 1 while the object was present (above 1/2) and this frame's own presence says so too.
    Hold,
}

/// How objects are numbered.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum IdRule {
    /// A counter per session that never goes back.
    Monotone,
    /// One more than the largest number kept, which can give a number twice.
    Original,
}
