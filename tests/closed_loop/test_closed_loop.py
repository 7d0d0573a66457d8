"""The harness itself: the search, the goals, the table, and one short run with everything real."""

import json

import numpy as np
import pytest
from gatsbi_sim import Simulator

import goals
import report
import run
from search import Budget, Icem


def test_noise_has_unit_variance_and_follows_itself():
    for horizon in (5, 6):
        noise = Icem(Budget(horizon=horizon), 1.0, np.random.default_rng(0)).noise(20_000)
        np.testing.assert_allclose(noise.std(axis=0), 1.0, atol=0.03)
        assert np.corrcoef(noise[:, 0, 0], noise[:, 1, 0])[0, 1] > 0.25


def test_the_search_finds_the_least_cost_and_spends_its_budget():
    wanted, spent = np.linspace(-0.5, 0.5, 10).reshape(5, 2), []

    def cost(tried):
        spent.append(len(tried))
        return ((tried - wanted) ** 2).sum(axis=(1, 2))

    search = Icem(Budget(candidates=64, iterations=8), 1.0, np.random.default_rng(0))
    assert np.abs(search.plan(cost) - wanted).max() < 0.2
    assert spent == [64] * 8


def test_intervals_are_those_of_wilson():
    low, high = report.interval(45, 50)
    assert (round(low, 4), round(high, 4)) == (0.7864, 0.9565)
    assert report.interval(0, 50)[0] == 0 and report.interval(50, 50)[1] == 1


def test_a_goal_follows_from_its_number():
    with Simulator(goals.SCENE, size=goals.SIZE) as scene:
        goal = goals.draw(scene, 3)
        assert goal == goals.draw(scene, 3) != goals.draw(scene, 4)
        assert goals.DISTANCES[0] <= goal.distance <= goals.DISTANCES[1]
        seen = scene.reset(goal.seed)
        goal.set(scene, len(seen.state["objects"]))
        assert scene.step([0.0] * 7).state["goal_distance"] == pytest.approx(goal.distance, abs=0.002)
        # The table is found from the picture: objects' centres lie a little above the hand's plane.
        table = goals.Table(scene)
        for each in seen.state["objects"]:
            found = table.metres(goals.in_image(each["pixel"]))
            np.testing.assert_allclose(found, each["position"][:2], atol=0.01)


def test_every_arm_runs_and_nothing_runs_twice(tmp_path, capsys):
    budget = ["--horizon", "2", "--candidates", "6", "--iterations", "1", "--decisions", "2"]
    arms = ["nothing", "random", "model", "plan", "truth"]
    run.main(["--out", str(tmp_path), "--goals", "1", "--arms", *arms, *budget])
    lines = {arm: (tmp_path / f"{arm}.jsonl").read_text() for arm in arms}
    for arm, steps in zip(arms, (0, 0, 12, 12, 12)):
        done = json.loads(lines[arm])
        assert [each["steps"] for each in done["decisions"]] == [steps] * 2
    assert json.loads(lines["nothing"])["distance"] == pytest.approx(json.loads(lines["nothing"])["at_first"], abs=0.002)
    assert all("off" in each for each in json.loads(lines["model"])["decisions"])
    run.main(["--out", str(tmp_path), "--goals", "1", "--arms", *arms, *budget])
    assert lines == {arm: (tmp_path / f"{arm}.jsonl").read_text() for arm in arms}
    capsys.readouterr()
    report.main([str(tmp_path), "--strips", str(tmp_path / "strips.png"), "--common"])
    table = capsys.readouterr().out
    assert all(f"| {arm} | 1 | 0% (0%-79%) |" in table for arm in arms) and (tmp_path / "strips.png").exists()
