"""Control loops over one connection."""

import asyncio

import numpy as np
import pytest

import gatsbi_client as gc

WANTED = ["objects", "latents"]


def test_a_stream_says_what_single_calls_say(client, frames, dimension):
    actions = np.random.default_rng(0).normal(0, 0.2, (4, dimension))
    with client.create_session() as single, client.create_session() as streamed:
        with streamed.stream(outputs=WANTED) as stream:
            for t in range(4):
                action, image = actions[t] if t else None, None if t == 2 else frames[t]
                want, got = single.observe(image, action, outputs=WANTED), stream.observe(image, action)
                assert got.outputs["latents"].tobytes() == want.outputs["latents"].tobytes()
                assert (got.step, got.predicted, got.objects) == (t, t == 2, want.objects)
        assert streamed.refresh().next_step == streamed.next_step == 4
        # Closed, it opens again.
        assert stream.observe(frames[4], actions[0]).step == 4
        stream.close()


def test_a_bad_observation_does_not_end_a_stream(client, frames, dimension):
    with client.create_session() as s, s.stream() as stream:
        stream.observe(frames[0])
        with pytest.raises(gc.InvalidRequest) as e:
            stream.observe(frames[1], np.zeros(dimension + 2))
        assert "action" in e.value.fields[0].field
        with pytest.raises(gc.StepGap) as gap:
            stream.observe(frames[1], np.zeros(dimension), step=7)
        assert gap.value.expected_step == 1
        assert stream.observe(frames[1], np.zeros(dimension)).step == 1


def test_a_stream_that_is_cut_goes_on(cutting, frames, dimension):
    with gc.Client(cutting.address) as c, c.create_session() as s, s.stream(outputs=WANTED) as stream:
        stream.observe(frames[0])
        cutting.cut_the_next_answer()
        belief = stream.observe(frames[1], np.zeros(dimension))
        assert belief.repeated and belief.step == 1 and cutting.cuts == 1
        assert stream.observe(frames[2], np.zeros(dimension)).step == 2
    with gc.Client(cutting.address, retries=gc.Retries(attempts=1)) as c, c.create_session() as s:
        with s.stream() as stream:
            stream.observe(frames[0])
            cutting.cut_the_next_answer()
            with pytest.raises(gc.Unavailable):
                stream.observe(frames[1], np.zeros(dimension))


def test_a_session_that_is_deleted_ends_its_stream_with_a_typed_error(client, frames, dimension):
    s = client.create_session()
    with s.stream() as stream:
        stream.observe(frames[0])
        s.delete()
        with pytest.raises(gc.NotFound):
            stream.observe(frames[1], np.zeros(dimension))


def test_a_wait_that_is_broken_off_leaves_no_answer_behind(address, frames, dimension):
    async def run():
        async with gc.AsyncClient(address) as client, await client.create_session() as s, s.stream() as stream:
            await stream.observe(frames[0])
            for step in (1, 2):
                waiting = asyncio.ensure_future(stream.observe(frames[step], np.full(dimension, 0.1 * step)))
                await asyncio.sleep(0.001 * step)
                waiting.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await waiting
                belief = await stream.observe(frames[step], np.full(dimension, 0.1 * step))
                assert belief.step == step
            assert (await s.refresh()).next_step == 3

    asyncio.run(run())


def test_streams_of_asyncio_run_side_by_side(address, frames, dimension):
    async def loop(client):
        async with await client.create_session() as s, s.stream(outputs=["latents"]) as stream:
            beliefs = [await stream.observe(frames[t], np.zeros(dimension) if t else None) for t in range(3)]
            return beliefs[-1].outputs["latents"].tobytes()

    async def both():
        async with gc.AsyncClient(address) as client:
            return await asyncio.gather(loop(client), loop(client))

    one, other = asyncio.run(both())
    assert one == other
