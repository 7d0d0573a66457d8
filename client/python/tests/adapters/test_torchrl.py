"""Against the real TorchRL."""

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import ModelBasedEnvBase
from torchrl.envs.utils import RandomPolicy, check_env_specs

from gatsbi_client import rewards
from gatsbi_client.torchrl import ImaginedEnv


@pytest.fixture
def env(client, session, pushed):
    env = ImaginedEnv(client, session.id, 3, rewards.object_to_target(pushed.id, 0.0, 0.0), horizon=4)
    env.set_seed(7)
    yield env
    env.close(raise_if_closed=False)


def test_the_library_finds_nothing_to_complain_of(env):
    assert isinstance(env, ModelBasedEnvBase)
    check_env_specs(env)


def test_equal_seeds_and_actions_give_equal_episodes_that_end_in_time(env):
    actions = torch.stack([env.action_spec.rand() for _ in range(4)])

    def episode(number):
        env.set_seed(number)
        taken = iter(actions)
        return env.rollout(10, TensorDictModule(lambda _: next(taken), ["objects"], ["action"]))

    one, same, other = episode(7), episode(7), episode(8)
    assert one.shape == (3, 4) and one["next", "truncated"][:, -1].all() and not one["next", "terminated"].any()
    assert torch.equal(one["next", "objects"], same["next", "objects"])
    assert not torch.equal(one["next", "objects"], other["next", "objects"])
    # Rows draw for themselves.
    assert not torch.equal(one["objects"][0], one["objects"][1])


def test_it_imagines_what_the_session_imagines(env, session, dimension):
    env.set_seed(7)
    first = env.reset()
    action = env.action_spec.rand()
    after = env.step(first.set("action", action))["next"]
    actions = np.stack([np.zeros((3, dimension)), action.numpy()], axis=1)
    rollout = session.imagine(actions, outputs=["objects"], samples=3, seed=7)
    ids = rollout.outputs["object_ids"]
    want = np.where(ids[..., None] >= 0, rollout.outputs["objects"], 0)
    for row in range(3):
        np.testing.assert_allclose(first["objects"][row], want[row, row, 0], atol=1e-6)
        np.testing.assert_allclose(after["objects"][row], want[row, row, 1], atol=1e-6)


def test_some_rows_begin_again_and_the_others_stay(env):
    seen = env.reset()
    stepped = env.step(seen.set("action", env.action_spec.rand()))["next"]
    stepped["_reset"] = torch.tensor([[False], [True], [False]])
    again = env.reset(stepped)
    assert torch.equal(again["objects"][1], seen["objects"][1])
    for row in (0, 2):
        assert torch.equal(again["objects"][row], stepped["objects"][row])


def test_a_collector_of_the_library_collects(env):
    collector = Collector(env, RandomPolicy(env.action_spec), frames_per_batch=18, total_frames=18)
    (batch,) = list(collector)
    assert batch.numel() == 18 and batch["next", "reward"].isfinite().all()
    # Episodes of four steps: the fifth begins anew.
    assert batch["next", "done"].reshape(3, 6)[:, 3].all() and not batch["next", "done"].reshape(3, 6)[:, 4].any()
