"""mbrl-lib over the service: what planners and policies ask of `mbrl.models.ModelEnv`.

    from gatsbi_client.mbrl import ModelEnv  # was: from mbrl.models import ModelEnv

    model_env = ModelEnv(client, session, program, reward)
    agent = mbrl.planning.create_trajectory_optim_agent_for_model(model_env, agent_cfg, num_particles=4)
    action = agent.act(observation)

The belief is the session's: observations that mbrl hands over say how many rows are wanted, and no more.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt
import torch

from gatsbi_client._sync import Client, Handles, Session
from gatsbi_client.costs import CostProgram
from gatsbi_client.rewards import Reward, action_bounds, visible

Values: TypeAlias = "torch.Tensor | npt.NDArray[Any]"


class ModelEnv:
    """Imagined worlds that begin at a session's belief."""

    def __init__(
        self, client: Client, session: Session, costs: CostProgram, reward: Reward, *,
        device: torch.device | str = "cpu", seed: int | None = None,
    ) -> None:
        """`costs` judge whole sequences of actions, `reward` single steps; both are yours to keep in tune."""
        model = next(each for each in client.models() if each.name == session.info.model)
        self.action_space = gymnasium.spaces.Box(*action_bounds(model), dtype=np.float32)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (model.max_objects, 6), dtype=np.float32)
        self.device = torch.device(device)
        self._client, self._session, self._costs, self._reward = client, session, costs, reward
        self._seed, self._rows, self._numpy = seed, 0, True
        self._handles: Handles | None = None
        self._samples = False

    def reset(self, initial_obs_batch: npt.NDArray[Any], return_as_np: bool = True) -> dict[str, torch.Tensor]:
        """Begins one row for each observation of the batch."""
        self.close()
        self._rows, self._numpy = len(initial_obs_batch), return_as_np
        return {}

    def step(
        self, actions: Values, model_state: dict[str, torch.Tensor], sample: bool = False
    ) -> tuple[Values, Values, Values, dict[str, torch.Tensor]]:
        """Steps all rows by `[B, A]`: objects `[B, MAX, 6]`, rewards and ends `[B, 1]`. Rows never end by themselves."""
        if self._handles is None:
            starts = [self._session.id] * (1 if sample else self._rows)
            drawn: dict[str, Any] = {"samples": self._rows, "seed": self._seed} if sample else {}
            self._handles, self._samples = self._client.open_handles(starts, **drawn), sample
        if sample != self._samples:
            raise ValueError(f"rows that began with sample={self._samples} cannot go on with sample={sample}")
        taken = actions.cpu().numpy() if isinstance(actions, torch.Tensor) else np.asarray(actions)
        outputs = self._handles.step(taken).outputs
        rewards = self._reward(outputs["object_ids"], outputs["objects"], taken)[:, None].astype(np.float32)
        answer = visible(outputs), rewards, np.zeros((self._rows, 1), dtype=np.bool_)
        if self._numpy:
            return (*answer, model_state)
        seen, earned, ended = (torch.from_numpy(each).to(self.device) for each in answer)
        return seen, earned, ended, model_state

    def evaluate_action_sequences(
        self, action_sequences: torch.Tensor, initial_state: npt.NDArray[Any], num_particles: int
    ) -> torch.Tensor:
        """Minus the cost of each sequence `[B, H, A]`, over `num_particles` samples of the future, in one call."""
        scores = self._session.score(
            action_sequences.cpu().numpy(), self._costs, samples=num_particles, seed=self._seed
        )
        return -torch.from_numpy(scores.total().copy()).to(self.device)

    def close(self) -> None:
        """Gives the rows back."""
        if self._handles is not None:
            self._handles.close()
            self._handles = None
