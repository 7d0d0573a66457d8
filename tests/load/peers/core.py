"""The model's twin with the states of its sessions: what every peer server has behind it.

Frames and actions of a batch of sessions go in, their tables of objects come out. `GATSBI_CHECKPOINT` names the weights,
`GATSBI_THREADS` how many threads a step may use. Weights and images are channels-last, which is faster in batches.
"""

from __future__ import annotations

import os
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gatsbi_twin import checkpoint, noise

Body = bytes | memoryview


class Core:
    """Sessions by name, and the model."""

    def __init__(self) -> None:
        torch.set_num_threads(int(os.environ.get("GATSBI_THREADS", "1")))
        loaded = checkpoint.load(Path(os.environ["GATSBI_CHECKPOINT"]))
        actions = loaded.header["actions"]
        self.model = loaded.model.to(memory_format=torch.channels_last)
        self.offset = torch.tensor([action["offset"] for action in actions])
        self.scale = torch.tensor([action["scale"] for action in actions])
        self.generator = torch.Generator().manual_seed(0)
        self.states: dict[str, Any] = {}

    @torch.inference_mode()
    def observe(self, sessions: list[str], bodies: list[Body]) -> list[bytes]:
        """One step of each session; a body is `[3, H, W]` bytes and the action as 32-bit floats."""
        batch, side = len(sessions), self.model.config.image_size
        pixels = 3 * side * side
        raw = np.stack([np.frombuffer(body, np.uint8, pixels) for body in bodies])
        frame = torch.from_numpy(raw).view(batch, 3, side, side).float() / 255
        frame = frame.contiguous(memory_format=torch.channels_last)
        action = np.stack([np.frombuffer(body, np.float32, len(self.scale), pixels) for body in bodies])
        action = (torch.from_numpy(action) - self.offset) / self.scale
        fresh = self.model.initial_state(1)
        state = join([self.states.get(session, fresh) for session in sessions])
        draws = noise.sample(self.model.config, batch, self.generator)
        state, _ = self.model.observe(state, frame, action, draws)
        for row, session in enumerate(sessions):
            self.states[session] = pick(state, row)
        # Presence, depth and where, as they lie in the latent vector.
        objects = torch.cat([state.objects.ids[..., None].float(), state.objects.z[..., :6]], -1).numpy()
        return [row.tobytes() for row in objects]

    def forget(self, session: str) -> None:
        """Ends a session."""
        self.states.pop(session, None)


def join(parts: list[Any]) -> Any:
    """The batch of some states."""
    first = parts[0]
    if isinstance(first, torch.Tensor):
        return torch.cat(parts)
    if isinstance(first, dict):
        return {key: join([part[key] for part in parts]) for key in first}
    if isinstance(first, tuple):
        return tuple(join(list(items)) for items in zip(*parts, strict=True))
    if is_dataclass(first):
        names = [field.name for field in fields(first)]
        return type(first)(**{name: join([getattr(part, name) for part in parts]) for name in names})
    return first


def pick(state: Any, row: int) -> Any:
    """The state of one session in a batch, in memory of its own."""
    if isinstance(state, torch.Tensor):
        return state[row : row + 1].clone()
    if isinstance(state, dict):
        return {key: pick(part, row) for key, part in state.items()}
    if isinstance(state, tuple):
        return tuple(pick(part, row) for part in state)
    if is_dataclass(state):
        return type(state)(**{field.name: pick(getattr(state, field.name), row) for field in fields(state)})
    return state
