"""The sizes and switches of a model, as the checkpoint's header states them."""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ActionConfig:
    dim: int
    hidden: int
    enhanced: int


@dataclass(frozen=True)
class EncoderConfig:
    channels: list[int]
    groups: list[int]
    first_kernel: int
    features: int


@dataclass(frozen=True)
class StageConfig:
    """One enlarging stage of a decoder."""

    factor: int
    channels: int
    groups: int


@dataclass(frozen=True)
class MaskDecoderConfig:
    inputs: int
    base: int
    base_groups: int
    stages: list[StageConfig]


@dataclass(frozen=True)
class CompEncoderConfig:
    channels: list[int]
    features: int


@dataclass(frozen=True)
class CompDecoderConfig:
    """`kind` is `broadcast` (with `width`, `final_kernel`) or `sub_pixel` (with `base_side`, `base`, `stages`)."""

    kind: str
    inputs: int
    width: int = 0
    final_kernel: int = 0
    base_side: int = 0
    base: int = 0
    stages: list[StageConfig] = dataclasses.field(default_factory=list)


@dataclass(frozen=True)
class MixtureConfig:
    slots: int
    z_mask: int
    z_comp: int
    hidden: int
    mlp: int
    mask_features: int
    delta: float
    comp_prior_action: bool
    encoder: EncoderConfig
    mask_decoder: MaskDecoderConfig
    comp_encoder: CompEncoderConfig
    comp_decoder: CompDecoderConfig
    comp_norm: str
    """`batch` or `group`."""
    init: str
    one_memory: bool = False
    """Whether the posterior shares the prior's memory."""


@dataclass(frozen=True)
class GammaConfig:
    """`kind` is `centred` or `printed`."""

    kind: str
    steepness: float = 0.0


@dataclass(frozen=True)
class DetectorConfig:
    keypoints: int
    filters: int
    convs_per_scale: int
    gamma: GammaConfig


@dataclass(frozen=True)
class ImageEncoderConfig:
    channels: list[int]
    blocks: int


@dataclass(frozen=True)
class GlimpseConfig:
    channels: list[int]
    groups: list[int]


@dataclass(frozen=True)
class UpdateConfig:
    """Bounds of what one step may change of an object."""

    proposal: tuple[float, float]
    shift: float
    scale: float
    what: float
    depth: float
    environment: float
    map_sigma: float


@dataclass(frozen=True)
class DiscoveryPrior:
    presence: float
    scale_mean: float
    scale_std: float
    shift_mean: float
    shift_std: float


@dataclass(frozen=True)
class GraphConfig:
    """`kind` is `fully_connected` or `knn`; `metric` is `distance` or `weight`; `aggregate` `attention` or `sum`."""

    kind: str
    k: int = 0
    metric: str = ""
    aggregate: str = ""


@dataclass(frozen=True)
class InteractionConfig:
    """`kind` is `inter1`, `inter2` or `inter3`."""

    kind: str
    outputs: int = 0
    celu: bool = False


@dataclass(frozen=True)
class ObjectConfig:
    grid: int
    max_objects: int
    z_what: int
    z_dyna: int
    hidden: int
    glimpse: int
    image_encoder: ImageEncoderConfig
    glimpse_encoder: GlimpseConfig
    glimpse_decoder: GlimpseConfig
    updates: UpdateConfig
    prior: DiscoveryPrior
    rejection: float | None
    aux_presence_kl: bool
    graph: GraphConfig
    interaction: InteractionConfig
    agent_history: str
    """`after` or `before`."""
    agent_feature: str
    """`current` or `next`."""

    @property
    def z_width(self) -> int:
        """Z: presence, depth, where, what, dynamics."""
        return 6 + self.z_what + self.z_dyna


@dataclass(frozen=True)
class TrackingConfig:
    discovery: str
    """`every_frame` or `first_frame`."""
    presence: str
    """`product` or `hold`."""
    ids: str
    """`monotone` or `original`."""
    scale_bounds: tuple[float, float] | None
    merge: float | None
    unlike: float | None = None
    """Distance between colours from which on they are of different objects."""
    handover: float | None = None
    """How far from where an object was lost it may be found."""


@dataclass(frozen=True)
class GatsbiConfig:
    image_size: int
    action: ActionConfig
    mixture: MixtureConfig
    detector: DetectorConfig | None
    objects: ObjectConfig
    tracking: TrackingConfig

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> GatsbiConfig:
        """Reads the `model` object of a header; an unknown or missing key is an error."""
        return _build(cls, data)


def _build(kind: Any, value: Any) -> Any:
    """`value`, decoded from JSON, as the type `kind`."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is list:
        return [_build(arguments[0], item) for item in value]
    if origin is tuple:
        return tuple(value)
    if type(None) in arguments:
        return None if value is None else _build(arguments[0], value)
    if not dataclasses.is_dataclass(kind):
        return value
    hints = typing.get_type_hints(kind)
    unknown = value.keys() - hints.keys()
    if unknown:
        raise ValueError(f"{kind.__name__} has no field {', '.join(sorted(unknown))}")
    return kind(**{name: _build(hints[name], item) for name, item in value.items()})
