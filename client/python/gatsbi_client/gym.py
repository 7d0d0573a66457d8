"""Imagined worlds as a gymnasium vector environment: one row of handles is one environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from gatsbi_client._sync import Client
from gatsbi_client.rewards import Reward, action_bounds, neutral_action, object_to_target, visible

__all__ = ["ImaginedVectorEnv", "Reward", "object_to_target"]


class ImaginedVectorEnv(VectorEnv[Any, Any, Any]):
    """`num_envs` copies of a session's belief, stepped in imagination.

    Observations are the objects, float32 `[num_envs, MAX, 6]` with zeros in slots that were never filled. An episode
    is truncated after `horizon` steps and never terminates by itself. An ended row begins again at the next step
    (`AutoresetMode.NEXT_STEP`): that step's action is the neutral one, its reward 0. A reset takes one neutral step
    from the session's belief, because rows are seen only after a step.
    """

    def __init__(
        self, client: Client, session_id: str, num_envs: int, reward: Reward, *, horizon: int = 15,
        samples: bool = True,
    ) -> None:
        info = client.session(session_id).info
        model = next(each for each in client.models() if each.name == info.model)
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}
        self.num_envs = num_envs
        self.single_action_space = gymnasium.spaces.Box(*action_bounds(model), dtype=np.float32)
        self.single_observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (model.max_objects, 6), dtype=np.float32
        )
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._client, self._start, self._samples = client, session_id, samples
        self._neutral = neutral_action(model)
        self._reward, self._horizon = reward, horizon
        self._handles: Any = None
        self._ages = np.zeros(num_envs, dtype=np.int64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[Any], dict[str, Any]]:
        """Starts every row anew; equal seeds and actions give equal episodes."""
        self.close_extras()
        # The samples of one start are rows side by side, each with random numbers of its own.
        starts = [self._start] * (1 if self._samples else self.num_envs)
        self._handles = self._client.open_handles(
            starts, samples=self.num_envs if self._samples else None, seed=seed if self._samples else None
        )
        self._ages[:] = 0
        answer = self._handles.step(np.tile(self._neutral, (self.num_envs, 1)))
        return visible(answer.outputs), {"object_ids": answer.outputs["object_ids"]}

    def step(self, actions: npt.ArrayLike) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Steps all rows by actions `[num_envs, A]`, raw units."""
        if self._handles is None:
            raise gymnasium.error.ResetNeeded("step was called before reset")
        ended = self._ages >= self._horizon
        taken = np.array(actions, dtype=np.float32)
        taken[ended] = self._neutral
        outputs = self._handles.step(taken, restart=np.flatnonzero(ended).tolist()).outputs
        self._ages = np.where(ended, 0, self._ages + 1)
        rewards = np.where(ended, 0.0, self._reward(outputs["object_ids"], outputs["objects"], taken))
        truncated = self._ages >= self._horizon
        nothing = np.zeros(self.num_envs, dtype=np.bool_)
        return visible(outputs), rewards, nothing, truncated, {"object_ids": outputs["object_ids"]}

    def close_extras(self, **kwargs: Any) -> None:
        """Gives the rows back."""
        if self._handles is not None:
            self._handles.close()
            self._handles = None
