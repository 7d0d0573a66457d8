"""What comes back: frozen dataclasses with numpy arrays. `H`, `W`, `K`, `MAX` are those of the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Mapping

import numpy as np
import numpy.typing as npt

from gatsbi_client._proto.gatsbi.v1.planning_service_pb2 import Cem, Icem, Mppi, RandomShooting

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]
Optimiser = RandomShooting | Cem | Icem | Mppi

OutputName = Literal[
    "frame", "agent_mask", "slot_masks", "object_masks", "background", "objects", "latents", "surprise",
    "log_likelihood", "keypoints", "spread", "object_spread",
]
"""One thing that can be asked for; shapes of one step of one row:
`frame`, `background` `[H, W, 3]`; `agent_mask`, `spread` `[H, W]`; `slot_masks` `[K, H, W]`;
`object_masks` `[MAX, H, W]`; `latents` `[D]`; `keypoints` `[N, 3]`; `object_spread` `[MAX, 2]`;
`surprise` and `log_likelihood` (nats) are single numbers.
Imagined `objects` come as two arrays: `object_ids` int64 `[MAX]` (-1: never filled) and `objects` float32
`[MAX, 6]`: presence in [0, 1], x rightwards and y downwards in [-1, 1], width, height (fractions of the image),
depth (smaller is nearer)."""
EncodingName = Literal["f32", "f16", "u8"]
"""How images and masks are sent: floats in [0, 1], or bytes 0 to 255."""


@dataclass(frozen=True)
class ActionDimension:
    """One number of an action; the network sees `(raw - offset) / scale`."""

    name: str
    unit: str
    offset: float
    scale: float


@dataclass(frozen=True)
class Model:
    """What a model takes and gives."""

    name: str
    hash: str
    """SHA-256 of its checkpoint, hexadecimal."""
    image_size: int
    """Height and width of its images in pixels; others are fitted."""
    actions: tuple[ActionDimension, ...]
    slots: int
    agent_slot: int | None
    max_objects: int
    latents: int
    trained_steps: int
    device: str
    card: str
    max_candidates: int
    max_horizon: int
    max_samples: int


@dataclass(frozen=True)
class SessionInfo:
    """A session as the server described it."""

    id: str
    label: str
    model: str
    model_hash: str
    next_step: int
    seed: int
    bytes: int
    oldest_step: int | None
    """The earliest step it can rewind to."""


@dataclass(frozen=True)
class TrackedObject:
    """One object of a belief. `x`, `y` in [-1, 1], `width`, `height` as fractions of the model's image."""

    id: int
    slot: int
    presence: float
    x: float
    y: float
    width: float
    height: float
    depth: float
    pixel_x: float
    pixel_y: float


@dataclass(frozen=True)
class Belief:
    """What a session believes after a step. `outputs` has no leading axes."""

    session_id: str
    step: int
    model_hash: str
    predicted: bool
    """The step came without an image."""
    repeated: bool
    """The stored answer to an equal request."""
    outputs: Mapping[str, Array]
    objects: tuple[TrackedObject, ...]

    def present(self, at_least: float = 0.5) -> tuple[TrackedObject, ...]:
        """Objects whose presence is at least that."""
        return tuple(each for each in self.objects if each.presence >= at_least)


@dataclass(frozen=True)
class Chunk:
    """A part of a rollout; `outputs` are `[candidates, depths, ...]`."""

    at_step: int
    model_hash: str
    seed: int
    sample: int
    first_candidate: int
    candidates: int
    depths: tuple[int, ...]
    outputs: Mapping[str, Array]
    last: bool
    over_samples: bool


@dataclass(frozen=True)
class Rollout:
    """A whole rollout. `outputs` are `[S, N, depths, ...]`; `spread` and `object_spread` `[N, depths, ...]`."""

    at_step: int
    model_hash: str
    seed: int
    depths: tuple[int, ...]
    outputs: Mapping[str, Array]


@dataclass(frozen=True)
class Scores:
    """Costs of candidates; smaller is better."""

    at_step: int
    model_hash: str
    seed: int
    costs: Floats
    """`[N]`."""
    violations: Floats | None
    """`[N]`, 0 where no constraint is violated; None without constraints."""
    by_sample: Floats | None
    """`[N, S]`, if asked for."""
    by_term: Floats | None
    """`[N, terms]` before weighting, if asked for."""
    best: int

    def total(self, per_violation: float = 1e3) -> Floats:
        """Costs `[N]` for searches that know no constraints: what violates them pays for it."""
        return self.costs if self.violations is None else self.costs + per_violation * self.violations


@dataclass(frozen=True)
class Plan:
    """The best actions found, raw units `[H, A]`."""

    at_step: int
    model_hash: str
    seed: int
    actions: Floats
    cost: float
    violation: float
    std: Floats
    """Standard deviation of the search at its end, raw units `[H, A]`."""
    best_costs: tuple[float, ...]
    iterations: int
    candidates: int
    out_of_time: bool
    """The budget ended the search."""
    outputs: Mapping[str, Array]
    """`[1, depths, ...]`."""
    depths: tuple[int, ...]


PartName = Literal["all_objects", "each_object", "agent"]
"""A part of a scene that has a mask."""


@dataclass(frozen=True)
class Goal:
    """A goal that the server keeps."""

    id: str
    label: str
    model: str
    has_image: bool


@dataclass(frozen=True)
class HandlesInfo:
    """Rows that are stepped from outside."""

    id: str
    rows: int
    model_hash: str
    seed: int


@dataclass(frozen=True)
class HandlesStep:
    """Rows after a step; `outputs` are `[rows, ...]`."""

    step: int
    model_hash: str
    outputs: Mapping[str, Array]


@dataclass(frozen=True)
class Prediction:
    """One request of a batch. Give `start` a session's id (str) or a snapshot (bytes)."""

    key: int
    start: str | bytes
    actions: npt.ArrayLike
    """Raw units, `[N, H, A]` or `[H, A]`."""
    samples: int | None = None
    seed: int | None = None
    at_step: int | None = None
    """Fails if the session's last step is another one."""


@dataclass(frozen=True)
class PredictionPart:
    """A part of the answer to one prediction: a chunk, or why it ended."""

    key: int
    chunk: Chunk | None
    error: Exception | None

    @property
    def last(self) -> bool:
        """Nothing more comes for this key."""
        return self.chunk is None or self.chunk.last
