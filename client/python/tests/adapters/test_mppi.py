"""Against the real pytorch-mppi."""

import numpy as np
import pytest
import torch
from pytorch_mppi import KMPPI, MPPI, SMPPI

from gatsbi_client.mppi import whole_horizon


@pytest.mark.parametrize("kind", [MPPI, SMPPI, KMPPI])
def test_an_iteration_is_one_call_and_gets_better(session, program, dimension, kind, monkeypatch):
    calls, score = [], session.score
    monkeypatch.setattr(session, "score", lambda *a, **k: calls.append(a[0].shape) or score(*a, **k))
    torch.manual_seed(0)
    controller = kind(
        **whole_horizon(session, program), noise_sigma=0.2 * torch.eye(dimension), num_samples=16, horizon=4,
        lambda_=0.05, u_min=-torch.ones(dimension), u_max=torch.ones(dimension),
        U_init=torch.ones(4, dimension),
    )
    before = score(np.ones((1, 4, dimension)), program).costs[0]
    for _ in range(4):
        action = controller.command(torch.zeros(1), shift_nominal_trajectory=False)
    assert action.shape == (dimension,) and calls == [(16, 4, dimension)] * 4
    plan = controller.get_action_sequence().clamp(-1, 1)
    assert score(plan.numpy()[None], program).costs[0] < before


def test_costs_are_those_of_the_service(session, program, dimension):
    torch.manual_seed(0)
    hooks = whole_horizon(session, program, samples=2, seed=3)
    controller = MPPI(**hooks, noise_sigma=torch.eye(dimension), num_samples=5, horizon=3, lambda_=1.0)
    controller.U = torch.zeros(3, dimension)
    controller.command(torch.zeros(1), shift_nominal_trajectory=False)
    want = session.score(controller.actions[0].numpy(), program, samples=2, seed=3)
    np.testing.assert_allclose(controller.cost_total.numpy(), want.costs, atol=1e-5)
