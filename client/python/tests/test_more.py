import asyncio

import numpy as np

import gatsbi_client as gc
from gatsbi_client.gym import ImaginedVectorEnv, object_to_target


def test_gym_restarts_at_the_session_belief(client, frames):
    with client.create_session() as s:
        s.observe(frames[0])
        env = ImaginedVectorEnv(client, s.id, 2, object_to_target(0, 0, 0), horizon=2)
        first, _ = env.reset(seed=4)
        assert env.observation_space.contains(first)
        action = env.action_space.sample()
        seen, _, _, truncated, _ = env.step(action)
        assert not truncated.any() and not np.array_equal(seen, first)
        assert env.step(action)[3].all()
        again, reward, _, truncated, _ = env.step(action)
        assert np.array_equal(again, first) and not reward.any() and not truncated.any()
        env.close()


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
