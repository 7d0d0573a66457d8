"""pytorch-mppi over the service: all candidates of an iteration, over their whole horizon, in one call.

    from pytorch_mppi import MPPI
    from gatsbi_client.mppi import whole_horizon

    controller = MPPI(**whole_horizon(session, program), noise_sigma=torch.eye(7), num_samples=64, horizon=8)
    action = controller.command(torch.zeros(1))

SMPPI and KMPPI take the same. pytorch-mppi asks its dynamics step by step, which over a network would be a round trip
a step. So its state is a number that never changes, and the service is asked at the end of the horizon, where all
actions are known. `rollout_samples` stays 1: `samples` are drawn by the service.
"""

from __future__ import annotations

from typing import Any

import torch

from gatsbi_client._sync import Session
from gatsbi_client.costs import CostProgram


def whole_horizon(
    session: Session, costs: CostProgram, *, samples: int | None = None, seed: int | None = None,
    per_violation: float = 1e3,
) -> dict[str, Any]:
    """Arguments of `pytorch_mppi.MPPI`; actions are in raw units, and futures start from the session's belief."""

    def stay(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return state

    def nothing(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return action.new_zeros(action.shape[0])

    def score(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        # [M, K, T, A]: the M copies of a candidate have the same actions.
        scores = session.score(actions[0].cpu().numpy(), costs, samples=samples, seed=seed)
        return torch.from_numpy(scores.total(per_violation).copy()).to(actions)

    return {"dynamics": stay, "running_cost": nothing, "terminal_state_cost": score, "nx": 1}
