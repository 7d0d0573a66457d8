"""stable-worldmodel over the service: a `Costable` for its solvers.

    from gatsbi_client.swm import RemoteCost

    solver = stable_worldmodel.solver.CEMSolver(RemoteCost(client, [session], [program]), num_samples=64, n_steps=3)

An environment of the solver is a session with a cost program of its own. Solvers pass environments in batches; put
their numbers into the info as `session`, `[B]` integers, where there is more than one.
"""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np
import torch

from gatsbi_client._sync import Client, Session
from gatsbi_client.costs import CostProgram


class RemoteCost:
    """Costs of candidates, computed next to the model; nothing else crosses the wire."""

    def __init__(
        self, client: Client, sessions: Sequence[Session], costs: Sequence[CostProgram], *,
        normalised: bool = True, samples: int | None = None, seed: int | None = None,
    ) -> None:
        """`normalised`: candidates are in the network's units, as solvers draw them; otherwise in raw units."""
        if len(sessions) != len(costs):
            raise ValueError(f"there are {len(sessions)} sessions and {len(costs)} cost programs, expected one each")
        models = {each.name: each for each in client.models()}
        self._sessions, self._costs = sessions, costs
        self._actions = [models[session.info.model].actions for session in sessions]
        self._normalised, self._samples, self._seed = normalised, samples, seed

    def get_cost(self, info_dict: dict[str, Any], action_candidates: torch.Tensor) -> torch.Tensor:
        """Costs `[B, S]` of candidates `[B, S, H, A]`; with blocks of actions the last axis holds all of a block."""
        environments, candidates = action_candidates.shape[:2]
        numbers = info_dict.get("session")
        if numbers is None:
            if environments != len(self._sessions):
                raise ValueError(
                    f"candidates are for {environments} of {len(self._sessions)} sessions; name them as `session`"
                )
            chosen: list[int] = list(range(environments))
        else:
            chosen = np.asarray(numbers).reshape(environments, -1)[:, 0].astype(int).tolist()
        costs = action_candidates.new_empty(environments, candidates)
        for place, number in enumerate(chosen):
            dimensions = self._actions[number]
            actions = action_candidates[place].reshape(candidates, -1, len(dimensions)).cpu().numpy()
            if self._normalised:
                actions = actions * [each.scale for each in dimensions] + [each.offset for each in dimensions]
            scores = self._sessions[number].score(
                actions, self._costs[number], samples=self._samples, seed=self._seed
            )
            costs[place] = torch.from_numpy(scores.total().copy())
        return costs

    criterion = get_cost
