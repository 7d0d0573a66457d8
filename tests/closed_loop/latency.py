"""How long a plan takes: the service's CEM beside the same CEM in Python over the model's PyTorch twin.

    python latency.py --candidates 64 --horizon 10 --iterations 3 --rounds 9

Both start from the same checkpoint, frames and actions, search the same space for the same cost (the distance of an
object to a target) with the same number of candidates, and have as many threads. The service is asked by its client, so
its time holds the way over gRPC; the twin's caller pays nothing for that. They take turns, and times are those of the
clock. Before, both price the same candidates, which shows that they compute the same.

Needs what the closed loops need, pyarrow, and the twin's torch (`cargo xtask twin` makes .venv-twin).
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pyarrow.parquet as parquet
import torch
from gatsbi_client import Cem, Client, costs
from gatsbi_twin import checkpoint, noise

from run import ROOT, Server
from search import Array

FRAMES = 6
TARGET = (0.3, 0.2)
ELITES, INITIAL, LEAST, MOMENTUM = 8, 0.5, 0.05, 0.1


class Twin:
    """The twin of a checkpoint, with a belief and a search around it."""

    def __init__(self, path: Path, memory_format: torch.memory_format) -> None:
        loaded = checkpoint.load(path)
        self._model = loaded.model.to(memory_format=memory_format)
        self._format = memory_format
        about = loaded.header["actions"]
        self._offset, self._scale = (np.array([each[key] for each in about]) for key in ("offset", "scale"))

    @torch.inference_mode()
    def observe(self, frames: Array, actions: Array) -> None:
        """Begins anew with frames `[T, H, W, 3]` and, for each but the first, the action that led to it."""
        config, state = self._model.config, self._model.initial_state(1)
        draws = noise.mean(config, 1)
        for step, frame in enumerate(frames):
            image = torch.tensor(frame).permute(2, 0, 1)[None].float() / 255
            action = self._scaled(actions[step - 1] if step else self._offset)[None]
            state, _ = self._model.observe(state, image.to(memory_format=self._format), action, draws)
        self._state = state

    def _scaled(self, action: Array) -> torch.Tensor:
        return torch.tensor((action - self._offset) / self._scale, dtype=torch.float32)

    @torch.inference_mode()
    def price(self, candidates: Array, object_id: int) -> Array:
        """The cost of candidates `[N, H, A]`: the mean distance of an object to the target."""
        count, horizon, _ = candidates.shape
        state = _repeated(self._state, count)
        slot = int((self._state.objects.ids[0] == object_id).nonzero()[0, 0])
        draws = noise.mean(self._model.config, count)
        total, target = torch.zeros(count), torch.tensor(TARGET)
        for step in range(horizon):
            state, _ = self._model.imagine(state, self._scaled(candidates[:, step]), draws)
            total += torch.linalg.vector_norm(state.objects.z[:, slot, 4:6] - target, dim=1)
        return (total / horizon).numpy()

    def plan(self, object_id: int, budget: argparse.Namespace, rng: np.random.Generator) -> Array:
        """The best actions that CEM finds, by the service's rules."""
        low, high = self._offset - 2 * self._scale, self._offset + 2 * self._scale
        mean = np.zeros((budget.horizon, len(low)))
        std = np.full_like(mean, INITIAL)
        best, least = mean, np.inf
        for _ in range(budget.iterations):
            drawn = (mean + std * rng.normal(size=(budget.candidates, *mean.shape))).clip(-1, 1)
            priced = self.price(low + (high - low) * (drawn + 1) / 2, object_id)
            order = np.argsort(priced, kind="stable")
            if priced[order[0]] < least:
                best, least = drawn[order[0]], priced[order[0]]
            chosen = drawn[order[:ELITES]]
            mean = MOMENTUM * mean + (1 - MOMENTUM) * chosen.mean(axis=0)
            std = np.maximum(MOMENTUM * std + (1 - MOMENTUM) * chosen.std(axis=0), LEAST)
        return low + (high - low) * (best + 1) / 2


def _repeated(part: Any, count: int) -> Any:
    """A belief of one row as one of many, whatever it is made of."""
    if isinstance(part, torch.Tensor):
        return part.expand(count, *part.shape[1:]).contiguous()
    if isinstance(part, dict):
        return {name: _repeated(each, count) for name, each in part.items()}
    if isinstance(part, tuple):
        return tuple(_repeated(each, count) for each in part)
    return replace(part, **{name: _repeated(each, count) for name, each in vars(part).items()})


def recorded() -> tuple[Array, Array]:
    """Frames and actions of a recorded robot."""
    row = parquet.ParquetFile(ROOT / "episodes/samples/push1-heldout.parquet").read_row_group(1).to_pylist()[0]
    frames = np.frombuffer(row["rgb"], np.uint8).reshape(row["length"], 64, 64, 3)
    return frames[:FRAMES].copy(), np.asarray(row["actions"], np.float32).reshape(row["length"], -1)


def timed(job: Callable[[], object]) -> float:
    began = time.perf_counter()
    job()
    return time.perf_counter() - began


def main() -> None:
    parse = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parse.add_argument("--checkpoint", type=Path, default=ROOT / "models/checkpoints/push1-tiny.safetensors")
    parse.add_argument("--candidates", type=int, default=64)
    parse.add_argument("--horizon", type=int, default=10)
    parse.add_argument("--iterations", type=int, default=3)
    parse.add_argument("--rounds", type=int, default=9)
    budget = parse.parse_args()
    # As many as the server of the closed loops has.
    torch.set_num_threads(1)
    torch.set_num_interop_threads(1)
    frames, actions = recorded()
    twins = {"channels-last": Twin(budget.checkpoint, torch.channels_last),
             "contiguous": Twin(budget.checkpoint, torch.contiguous_format)}
    for twin in twins.values():
        twin.observe(frames, actions)
    with Server(budget.checkpoint) as address, Client(address, timeout=600) as client, client.create_session() as session:
        for step, frame in enumerate(frames):
            belief = session.observe(frame, actions[step - 1] if step else None)
        followed = max(belief.objects, key=lambda each: each.presence)
        cost = costs.program(costs.to_target(followed.id, *TARGET))
        optimiser = Cem(candidates=budget.candidates, iterations=budget.iterations, elites=ELITES, initial_std=INITIAL,
                        min_std=LEAST, momentum=MOMENTUM)
        spread = np.random.default_rng(0).uniform(-1, 1, (16, budget.horizon, actions.shape[1]))
        same = (spread * np.abs(actions).max(axis=0)).astype(np.float32)
        apart = np.abs(twins["contiguous"].price(same, followed.id) - session.score(same, cost).costs).max()
        print(f"costs of the same candidates differ by at most {apart:.1e}")

        def served(seed: int) -> object:
            return session.plan(budget.horizon, cost, optimiser=optimiser, seed=seed)

        served(0)
        for twin in twins.values():
            twin.plan(followed.id, budget, np.random.default_rng(0))
        times: dict[str, list[float]] = {"service": [], **{name: [] for name in twins}}
        for seed in range(1, budget.rounds + 1):
            times["service"].append(timed(lambda: served(seed)))
            for name, twin in twins.items():
                times[name].append(timed(lambda: twin.plan(followed.id, budget, np.random.default_rng(seed))))
        best = min(twins, key=lambda name: np.median(times[name]))
        ratio = np.median(np.array(times[best]) / times["service"])
    priced = budget.candidates * budget.iterations
    for name, each in times.items():
        low, middle, high = np.percentile(each, [25, 50, 75])
        print(f"{name:<14} {middle:7.3f} s a plan ({low:.3f} to {high:.3f}), {priced / middle:7.1f} candidates/s")
    print(json.dumps({"candidates": budget.candidates, "horizon": budget.horizon, "iterations": budget.iterations,
                      "rounds": budget.rounds, "twin_format": best, "twin_over_service": round(float(ratio), 2)}))


if __name__ == "__main__":
    main()
