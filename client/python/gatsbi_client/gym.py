"""Imagined worlds as a gymnasium vector environment: one row of handles is one environment."""

from __future__ import annotations

from typing import Any, Mapping, Protocol, Sequence

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from gatsbi_client._sync import Client
from gatsbi_client.rewards import Reward, action_bounds, mask_centres, neutral_action, object_to_target, visible
from gatsbi_client.types import Array, Model, OutputName

__all__ = ["ImaginedVectorEnv", "Reward", "Task", "mask_centres", "object_to_target"]


class Task(Protocol):
    """What is done in imagined worlds: what is asked of the service, what is seen of that, and what it is worth.

    All rows come at once: `outputs` are `[rows, ...]` as `OutputName` describes them.
    """

    outputs: Sequence[OutputName]
    space: gymnasium.Space[Any]
    """Of one row's observations."""

    def begin(self, outputs: Mapping[str, Array], starts: Sequence[int], rng: np.random.Generator) -> None:
        """An episode begins with these outputs, rows at these starts; here goals are drawn."""

    def observe(self, outputs: Mapping[str, Array]) -> Array:
        """Observations `[rows, ...]`."""

    def reward(self, outputs: Mapping[str, Array], actions: Array) -> Array:
        """Rewards `[rows]` of the actions `[rows, A]` that led to these outputs."""


class ImaginedVectorEnv(VectorEnv[Any, Any, Any]):
    """`num_envs` rows, stepped in imagination from beliefs of sessions.

    With a `Reward` as the task, observations are the objects, float32 `[num_envs, MAX, 6]` with zeros in slots that
    were never filled. Each episode of each row starts at one of `starts` (ids of sessions), drawn evenly;
    `info["starts"]` tells which. Episodes are truncated after `horizon` steps and never terminate by themselves, so
    rows end together, and begin again at the next step (`AutoresetMode.NEXT_STEP`): that step's action is the neutral
    one, its reward 0. A reset takes one neutral step, because rows are seen only after a step.
    """

    def __init__(
        self, client: Client, starts: str | Sequence[str], num_envs: int, task: Reward | Task, *, horizon: int = 15,
        samples: bool = True,
    ) -> None:
        self._starts = [starts] if isinstance(starts, str) else list(starts)
        if not self._starts:
            raise ValueError("starts is empty; give the id of at least one session")
        info = client.session(self._starts[0]).info
        model = next(each for each in client.models() if each.name == info.model)
        self._task: Task = _Objects(model, task) if callable(task) else task
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}
        self.num_envs = num_envs
        self.single_action_space = gymnasium.spaces.Box(*action_bounds(model), dtype=np.float32)
        self.single_observation_space = self._task.space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._client, self._samples, self._horizon = client, samples, horizon
        self._neutral = np.tile(neutral_action(model), (num_envs, 1))
        self._handles: Any = None
        self._age = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts every row anew; equal seeds and actions give equal episodes from then on."""
        super().reset(seed=seed)
        return self._begin()

    def _begin(self) -> tuple[Any, dict[str, Any]]:
        self.close_extras()
        self._chosen = self.np_random.integers(len(self._starts), size=self.num_envs)
        starts = [self._starts[each] for each in self._chosen]
        seed = int(self.np_random.integers(2**53))
        if self._samples:
            self._handles = self._client.open_handles(starts, samples=1, seed=seed, independent=True)
        else:
            self._handles = self._client.open_handles(starts)
        self._age = 0
        outputs = self._advance(self._neutral)
        self._task.begin(outputs, self._chosen.tolist(), self.np_random)
        return self._task.observe(outputs), self._info(outputs)

    def step(self, actions: npt.ArrayLike) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Steps all rows by actions `[num_envs, A]`, raw units."""
        if self._handles is None:
            raise gymnasium.error.ResetNeeded("step was called before reset")
        nothing = np.zeros(self.num_envs, dtype=np.bool_)
        if self._age >= self._horizon:
            seen, info = self._begin()
            return seen, np.zeros(self.num_envs), nothing, nothing.copy(), info
        taken = np.array(actions, dtype=np.float32)
        outputs = self._advance(taken)
        self._age += 1
        truncated = np.full(self.num_envs, self._age >= self._horizon)
        rewards = np.asarray(self._task.reward(outputs, taken), dtype=np.float64)
        return self._task.observe(outputs), rewards, nothing, truncated, self._info(outputs)

    def _advance(self, actions: Array) -> Mapping[str, Array]:
        outputs: Mapping[str, Array] = self._handles.step(actions, outputs=self._task.outputs).outputs
        return outputs

    def _info(self, outputs: Mapping[str, Array]) -> dict[str, Any]:
        return {"starts": self._chosen} | {name: outputs[name] for name in ("object_ids",) if name in outputs}

    def close_extras(self, **kwargs: Any) -> None:
        """Gives the rows back."""
        if self._handles is not None:
            self._handles.close()
            self._handles = None


class _Objects:
    """Shows the objects and asks a reward about them."""

    outputs: Sequence[OutputName] = ("objects",)

    def __init__(self, model: Model, reward: Reward) -> None:
        self.space: gymnasium.Space[Any] = gymnasium.spaces.Box(
            -np.inf, np.inf, (model.max_objects, 6), dtype=np.float32
        )
        self._reward = reward

    def begin(self, outputs: Mapping[str, Array], starts: Sequence[int], rng: np.random.Generator) -> None:
        pass

    def observe(self, outputs: Mapping[str, Array]) -> Array:
        return visible(outputs)

    def reward(self, outputs: Mapping[str, Array], actions: Array) -> Array:
        return self._reward(outputs["object_ids"], outputs["objects"], actions)
