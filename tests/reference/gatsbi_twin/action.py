"""Action enhancement: a raw action to the vector that conditions the networks."""

from .config import ActionConfig
from .layers import Mlp


class ActionEnhancer(Mlp):
    """[B, A], scaled, to [B, enhanced]."""

    def __init__(self, config: ActionConfig) -> None:
        super().__init__([config.dim, config.hidden, config.hidden, config.enhanced])
