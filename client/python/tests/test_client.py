import asyncio
import re
from pathlib import Path

import numpy as np
import pytest

import gatsbi_client as gc

HERE = Path(__file__).resolve().parents[1]


def test_generated_files_are_current(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(HERE))
    from generate import generate
    generate(tmp_path)
    generated = [path.relative_to(tmp_path) for path in tmp_path.rglob("*.py*")]
    assert Path("_sync.py") in generated and len(generated) > 20
    for path in generated:
        assert (HERE / "gatsbi_client" / path).read_bytes() == (tmp_path / path).read_bytes(), path


@pytest.mark.parametrize("snippet", re.findall(r"```python\n(.*?)```", (HERE / "README.md").read_text(), re.S))
def test_readme(snippet, address, frames, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(snippet, {"address": address, "frames": frames})


def test_fork_rewind_export_and_handles(client, frames, dimension):
    a = np.zeros(dimension)
    with client.create_session(keep_steps=4) as s:
        s.observe(frames[0])
        first = s.observe(frames[1], a, outputs=["frame", "latents"])
        assert first.outputs["frame"].shape[2] == 3
        snapshot = s.export()
        (fork,) = s.fork()
        fork.observe(frames[2], a)
        assert (s.refresh().next_step, fork.next_step) == (2, 3)
        assert s.export() == snapshot
        fork.delete()
        s.observe(frames[2], a)
        assert s.rewind(0).next_step == 1
        again = s.observe(frames[1], a, outputs=["frame", "latents"])
        assert np.array_equal(again.outputs["latents"], first.outputs["latents"])
        with client.import_session(snapshot) as other:
            assert other.next_step == 2
        actions = np.zeros((2, 2, dimension))
        roll = s.imagine(actions, outputs=["latents"], samples=2, seed=3)
        assert roll.outputs["latents"].shape[:3] == (2, 2, 2)
        with client.open_handles([s.id, snapshot]) as h:
            assert h.step(np.zeros((2, dimension))).outputs["objects"].shape[0] == 2


def test_sync_and_asyncio_agree(client, address, frames, dimension):
    actions = np.zeros((2, 3, dimension))
    with client.create_session() as s:
        s.observe(frames[0])
        want = s.imagine(actions, outputs=["frame"]).outputs["frame"].tobytes()
    async def other():
        async with gc.AsyncClient(address) as c, await c.create_session() as s:
            await s.observe(frames[0])
            return (await s.imagine(actions, outputs=["frame"])).outputs["frame"].tobytes()
    assert asyncio.run(other()) == want


def test_planning(client, frames, dimension):
    with client.create_session() as s:
        belief = s.observe(frames[0])
        who = belief.present()[0].id
        program = gc.costs.program(
            gc.costs.to_target(who, 0.3, 0.2, weight=2.0, when="last_step"),
            gc.costs.between("agent", who, weight=0.5), gc.costs.overlap("agent", who), gc.costs.spread(who),
            gc.costs.action_smoothness(previous=np.zeros(dimension)),
            constraints=[gc.costs.at_most(gc.costs.region("agent", -1, -1, 1, 1), 5.0)], risk="worst",
        )
        # Within what plans may do unless told otherwise: a start beyond it is not kept as it is.
        candidates = np.random.default_rng(0).uniform(-0.15, 0.15, (6, 3, dimension))
        scores = s.score(candidates, program, samples=2, seed=4, by_sample=True, by_term=True)
        assert scores.by_sample is not None and scores.by_term is not None and scores.violations is not None
        assert np.allclose(scores.costs, scores.by_sample.max(axis=1)) and not scores.violations.any()
        assert scores.by_term.shape == (6, 5) and scores.best == scores.costs.argmin()
        # Without samples futures are means, and a target's cost is that of the rollout.
        target = gc.costs.program(gc.costs.to_target(who, 0.3, 0.2, when="last_step"))
        rollout = s.imagine(candidates, outputs=["objects"], last_only=True)
        ids, table = (rollout.outputs[name][0, :, -1] for name in ("object_ids", "objects"))
        here = table[ids == who]
        present = here[:, 0] > 0.5
        distance = np.where(present, np.hypot(here[:, 1] - 0.3, here[:, 2] - 0.2), 2.0)
        assert np.allclose(s.score(candidates, target).costs, distance, atol=1e-5)

        start = candidates[distance.argmin()]
        for optimiser in [
            gc.RandomShooting(candidates=8), gc.Cem(candidates=8, elites=3, iterations=2),
            gc.Icem(cem=gc.Cem(candidates=8, elites=3, iterations=2)), gc.Mppi(candidates=8),
        ]:
            plan = s.plan(3, target, optimiser=optimiser, seed=5, warm_start=start, outputs=["objects"])
            assert plan.cost <= distance.min() + 1e-5 and plan.violation == 0 and not plan.out_of_time
            assert plan.actions.shape == (3, dimension) and plan.outputs["objects"].shape[:2] == (1, 3)
            again = s.plan(3, target, optimiser=optimiser, seed=5, warm_start=start)
            assert np.array_equal(plan.actions, again.actions)
        ahead = s.imagine(candidates[2], outputs=["frame", "object_masks"], encoding="u8", last_only=True).outputs
        masks = {"all_objects": ahead["object_masks"][0, 0, 0].astype(np.float32).sum(0).clip(0, 255) / 255}
        goal = client.put_goal(ahead["frame"][0, 0, 0], masks=masks)
        near = gc.costs.program(
            gc.costs.goal_image(goal.id, when="last_step"), gc.costs.goal_masks(goal.id, when="last_step")
        )
        scores = s.score(candidates, near, by_term=True)
        assert scores.best == 2 and scores.costs[2] < 1e-3 < scores.costs[0]
        client.delete_goal(goal.id)
        with pytest.raises(gc.NotFound):
            s.score(candidates, near)
        with pytest.raises(gc.InvalidRequest) as e:
            s.score(candidates, gc.costs.program(gc.costs.to_target(12345, 0, 0)))
        assert "costs.terms[0]" in e.value.fields[0].field


def test_errors(client, frames, dimension):
    with client.create_session() as s:
        s.observe(frames[0])
        with pytest.raises(gc.InvalidRequest) as e:
            s.observe(frames[1], np.zeros(dimension + 1))
        assert "action" in e.value.fields[0].field
        with pytest.raises(gc.InvalidRequest):
            s.observe(frames[1], np.full(dimension, np.nan))
        with pytest.raises(gc.InvalidRequest):
            s.observe(frames[1][:, :, :2], np.zeros(dimension))
        with pytest.raises(gc.StepGap) as gap:
            s.observe(frames[1], np.zeros(dimension), step=9)
        assert gap.value.expected_step == 1
    with pytest.raises(gc.NotFound):
        client.session("0" * 32)


def test_lost_answer_is_asked_for_again(client, cutting, frames, dimension):
    action = np.full(dimension, 0.1)
    wanted = ["objects", "latents", "frame"]
    with gc.Client(cutting.address) as c, c.create_session() as s, client.create_session() as whole:
        cutting.cut_the_next_answer()
        first = s.observe(frames[0], outputs=wanted)
        assert first.repeated and cutting.cuts == 1 and s.refresh().next_step == 1
        # The stored answer has the bytes of one that was not lost, and asking once more moves nothing.
        plain, again = whole.observe(frames[0], outputs=wanted), s.observe(frames[0], outputs=wanted, step=0)
        for name, values in plain.outputs.items():
            assert values.tobytes() == first.outputs[name].tobytes() == again.outputs[name].tobytes()
        assert plain.objects == first.objects == again.objects and not plain.repeated
        with pytest.raises(gc.Conflict):
            s.observe(frames[1], outputs=wanted, step=0)
        assert s.observe(frames[1], action).step == 1
    with gc.Client(cutting.address, retries=gc.Retries(attempts=1)) as once:
        session = once.create_session()
        cutting.cut_the_next_answer()
        with pytest.raises(gc.Unavailable):
            session.observe(frames[0])
        client.session(session.id).delete()


def test_sessions_are_listed(client):
    opened = {client.create_session(label="listed").id for _ in range(3)}
    with client.create_session(label="other") as other:
        assert {each.id for each in client.sessions(label="listed")} == opened
        assert opened | {other.id} <= {each.id for each in client.sessions()}
    for each in opened:
        client.session(each).delete()
    assert client.sessions(label="listed") == ()


def test_a_session_that_has_moved_is_refused(client, frames, dimension):
    actions = np.zeros((1, 2, dimension))
    target = gc.costs.program(gc.costs.to_target("all_objects", 0, 0))
    with client.create_session() as s:
        s.observe(frames[0])
        s.observe(frames[1], actions[0, 0])
        calls = [
            lambda at: s.imagine(actions, outputs=["latents"], at_step=at), lambda at: s.export(at_step=at),
            lambda at: s.score(actions, target, at_step=at),
            lambda at: s.plan(2, target, optimiser=gc.RandomShooting(candidates=2), at_step=at),
        ]
        for call in calls:
            call(1)
            with pytest.raises(gc.Conflict) as e:
                call(0)
            assert e.value.reason
        (fork,) = s.fork(at_step=1)
        fork.delete()
        with pytest.raises(gc.Conflict):
            s.fork(at_step=0)
        many = [gc.Prediction(1, s.id, actions, at_step=1), gc.Prediction(2, s.id, actions, at_step=0)]
        failed = {part.key: part.error for part in client.predict_batch(many, outputs=["latents"])}
        assert failed[1] is None and isinstance(failed[2], gc.Conflict)
