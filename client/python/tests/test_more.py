import asyncio

import gymnasium
import numpy as np
import pytest

import gatsbi_client as gc
from gatsbi_client.gym import ImaginedVectorEnv, mask_centres, object_to_target


class Chase:
    """Bring the agent to where it was at the start, moved by what the row's goal is."""

    outputs = ("agent_mask", "objects", "latents")
    space = gymnasium.spaces.Box(-3, 3, (4,), dtype=np.float32)

    def __init__(self):
        self.began = []

    def begin(self, outputs, starts, rng):
        self.began.append(list(starts))
        self.goal = mask_centres(outputs["agent_mask"]) + rng.uniform(-0.2, 0.2, (len(starts), 2))

    def observe(self, outputs):
        at = mask_centres(outputs["agent_mask"])
        return np.concatenate([at, self.goal - at], axis=1).astype(np.float32)

    def reward(self, outputs, actions):
        assert outputs["latents"].shape[0] == len(actions) == len(self.goal)
        return -np.linalg.norm(self.goal - mask_centres(outputs["agent_mask"]), axis=1)


def test_gym_begins_every_episode_anew(client, frames):
    with client.create_session() as s:
        s.observe(frames[0])
        env = ImaginedVectorEnv(client, s.id, 2, object_to_target(0, 0, 0), horizon=2, samples=False)
        first, info = env.reset(seed=4)
        assert env.observation_space.contains(first) and info["object_ids"].shape[0] == 2
        action = env.action_space.sample()
        seen, _, _, truncated, _ = env.step(action)
        assert not truncated.any() and not np.array_equal(seen, first)
        assert env.step(action)[3].all()
        again, reward, _, truncated, _ = env.step(action)
        # Means know no chance: the same belief is seen again.
        assert np.array_equal(again, first) and not reward.any() and not truncated.any()
        env.close()


def test_gym_draws_starts_and_goals(client, frames, dimension):
    with client.create_session() as near, client.create_session() as far:
        near.observe(frames[0])
        for step in range(0, 30, 6):
            far.observe(frames[step], np.zeros(dimension))
        task = Chase()
        env = ImaginedVectorEnv(client, [near.id, far.id], 8, task, horizon=2)

        def episodes(seed):
            seen, info = env.reset(seed=seed)
            # The task's goals are in what is seen, and rows at different starts see different agents.
            assert env.observation_space.contains(seen) and info["starts"].tolist() == task.began[-1]
            told = [seen]
            for _ in range(4):
                seen, reward, _, truncated, info = env.step(np.full((8, dimension), 0.1))
                told += [seen, reward, info["starts"]]
                if truncated.all():
                    np.testing.assert_allclose(reward, -np.linalg.norm(seen[:, 2:], axis=1), rtol=1e-5)
            return np.concatenate([each.ravel() for each in told])

        one, same, other = episodes(1), episodes(1), episodes(2)
        assert np.array_equal(one, same) and not np.array_equal(one, other)
        assert len(task.began) == 6 and task.began[0] != task.began[1]
        seen, info = env.reset(seed=1)
        by_start = [seen[info["starts"] == each, :2] for each in (0, 1)]
        assert np.linalg.norm(by_start[0].mean(axis=0) - by_start[1].mean(axis=0)) > 0.02
        # Rows that start at the same belief draw for themselves.
        assert all(len(np.unique(rows, axis=0)) == len(rows) for rows in by_start)
        env.close()
    with pytest.raises(ValueError, match="starts is empty"):
        ImaginedVectorEnv(client, [], 2, task)


def test_starts_share_random_numbers_unless_they_are_independent(client, frames, dimension):
    with client.create_session() as s:
        s.observe(frames[0])
        for independent in (False, True):
            with client.open_handles([s.id, s.id], samples=1, seed=3, independent=independent) as handles:
                one, other = handles.step(np.zeros((2, dimension)), outputs=["latents"]).outputs["latents"]
                assert np.allclose(one, other, atol=1e-5) != independent


def test_centres_of_masks():
    masks = np.zeros((3, 4, 8))
    masks[0, 0, 7] = 0.3
    masks[1] = 1
    np.testing.assert_allclose(mask_centres(masks), [[0.875, -0.75], [0, 0], [0, 0]], atol=1e-6)


def test_asyncio_batch_and_handles(address, frames, dimension):
    async def run():
        done = []
        async with gc.AsyncClient(address) as c, await c.create_session() as s:
            await s.observe(frames[0])
            good = np.zeros((1, 2, dimension))
            many = [gc.Prediction(1, s.id, good), gc.Prediction(2, "0" * 32, good)]
            parts = [p async for p in c.predict_batch(many, outputs=["latents"], progress=done.append)]
            async with await c.open_handles([s.id]) as h:
                assert (await h.step(good[0, :1])).step == 1
            async for chunk in s.imagine_chunks(good, outputs=["latents"]):
                assert chunk.candidates == 1
        assert done == [1, 2]
        assert isinstance(next(p for p in parts if p.key == 2).error, gc.NotFound)
        assert all(p.error is None for p in parts if p.key == 1)
    asyncio.run(run())
