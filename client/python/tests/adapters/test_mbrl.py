"""Against the real mbrl-lib."""

import mbrl.models
import mbrl.planning
import numpy as np
import omegaconf
import pytest
import torch

from gatsbi_client import rewards
from gatsbi_client.mbrl import ModelEnv


@pytest.fixture
def model_env(client, session, program, pushed):
    env = ModelEnv(client, session, program, rewards.object_to_target(pushed.id, 0.0, 0.0), seed=5)
    yield env
    env.close()


def test_it_has_what_the_original_has(model_env):
    public = {name for name in vars(mbrl.models.ModelEnv) if not name.startswith("_")} - {"render"}
    assert public and all(hasattr(model_env, name) for name in public)
    for name in ("device", "action_space", "observation_space"):
        assert hasattr(model_env, name)


def test_sequences_are_worth_minus_their_costs(model_env, session, program, dimension):
    sequences = torch.from_numpy(np.random.default_rng(0).normal(0, 0.3, (6, 3, dimension))).float()
    worth = model_env.evaluate_action_sequences(sequences, np.zeros(3), num_particles=2)
    want = session.score(sequences.numpy(), program, samples=2, seed=5)
    np.testing.assert_array_equal(worth.numpy(), -want.costs)


def test_an_agent_of_the_library_plans_with_it(model_env, session, program, dimension):
    torch.manual_seed(0)
    cem = {
        "_target_": "mbrl.planning.CEMOptimizer", "num_iterations": 2, "elite_ratio": 0.25, "population_size": 12,
        "alpha": 0.1, "device": "cpu", "lower_bound": "???", "upper_bound": "???", "return_mean_elites": False,
        "clipped_normal": False,
    }
    config = omegaconf.OmegaConf.create({
        "_target_": "mbrl.planning.TrajectoryOptimizerAgent", "action_lb": "???", "action_ub": "???",
        "planning_horizon": 3, "optimizer_cfg": cem, "replan_freq": 1, "verbose": False,
        # mbrl-lib was written for a Hydra that left inner objects alone, and runs on later ones.
        "_recursive_": False,
    })
    agent = mbrl.planning.create_trajectory_optim_agent_for_model(model_env, config, num_particles=1)
    plan = agent.plan(np.zeros(3))
    assert plan.shape == (3, dimension)
    wild = np.stack([plan, np.tile(model_env.action_space.high, (3, 1))])
    scores = session.score(wild, program, samples=1, seed=5)
    assert scores.costs[0] < scores.costs[1]
    assert agent.act(np.zeros(3)).shape == (dimension,)


@pytest.mark.parametrize("sample", [False, True])
def test_rows_step_as_rollouts_do(model_env, session, dimension, sample):
    actions = np.random.default_rng(1).normal(0, 0.3, (2, 3, dimension)).astype(np.float32)
    actions[1] = actions[0] if sample else actions[1]
    state = model_env.reset(np.zeros((2, 4)))
    for depth in range(3):
        seen, earned, ended, state = model_env.step(actions[:, depth], state, sample=sample)
    assert earned.shape == ended.shape == (2, 1) and not ended.any()
    drawn = {"samples": 2, "seed": 5} if sample else {}
    rollout = session.imagine(actions[:1] if sample else actions, outputs=["objects"], last_only=True, **drawn)
    want, ids = (rollout.outputs[name][:, :, -1].reshape(2, *rollout.outputs[name].shape[3:])
                 for name in ("objects", "object_ids"))
    np.testing.assert_allclose(seen, np.where(ids[..., None] >= 0, want, 0), atol=1e-6)
    with pytest.raises(ValueError, match="cannot go on"):
        model_env.step(actions[:, 0], state, sample=not sample)
    model_env.reset(np.zeros((2, 4)), return_as_np=False)
    assert isinstance(model_env.step(torch.zeros(2, dimension), {})[0], torch.Tensor)
