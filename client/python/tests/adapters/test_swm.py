"""Against the real stable-worldmodel."""

import gymnasium
import numpy as np
import pytest
import torch
from stable_worldmodel import PlanConfig
from stable_worldmodel.solver import CEMSolver, ICEMSolver, MPPISolver

from gatsbi_client.swm import RemoteCost


def test_costs_are_those_of_the_service(client, session, program, dimension):
    candidates = torch.randn(1, 5, 3, dimension, generator=torch.Generator().manual_seed(0))
    scales = np.array([each.scale for each in client.models()[0].actions])
    offsets = np.array([each.offset for each in client.models()[0].actions])
    for normalised in (True, False):
        costs = RemoteCost(client, [session], [program], normalised=normalised).get_cost({}, candidates)
        raw = candidates[0].numpy() * scales + offsets if normalised else candidates[0].numpy()
        np.testing.assert_allclose(costs[0], session.score(raw, program).costs, atol=1e-5)


def test_blocks_of_actions_are_taken_apart(client, session, program, dimension):
    candidates = torch.randn(1, 2, 4, dimension, generator=torch.Generator().manual_seed(0))
    model = RemoteCost(client, [session], [program])
    blocks = candidates.reshape(1, 2, 2, 2 * dimension)
    assert torch.equal(model.get_cost({}, candidates), model.get_cost({}, blocks))


@pytest.mark.parametrize("solver", [CEMSolver, ICEMSolver, MPPISolver])
def test_a_solver_of_the_library_plans_with_it(client, session, program, dimension, solver):
    (other,) = session.fork()
    model = RemoteCost(client, [session, other], [program, program])
    made = solver(model, batch_size=1, num_samples=12, n_steps=2, topk=3, seed=1)
    space = gymnasium.spaces.Box(-2, 2, (2, dimension), dtype=np.float32)
    made.configure(action_space=space, n_envs=2, config=PlanConfig(horizon=3, receding_horizon=1))
    plan = made.solve({"session": torch.tensor([[0], [1]])})["actions"]
    assert plan.shape == (2, 3, dimension)
    best = model.get_cost({"session": torch.tensor([0])}, plan[None, :1])
    wild = model.get_cost({"session": torch.tensor([0])}, torch.full((1, 1, 3, dimension), 2.0))
    assert best < wild
    other.delete()


def test_sessions_that_are_not_named_are_asked_for(client, session, program, dimension):
    model = RemoteCost(client, [session, session], [program, program])
    with pytest.raises(ValueError, match="name them as `session`"):
        model.get_cost({}, torch.zeros(1, 2, 3, dimension))
