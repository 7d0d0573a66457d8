"""The experiment's parts against the real simulator and the real server; training itself takes too long for a test."""

import os

import numpy as np
import pytest
from gatsbi_client import Client
from gatsbi_client.gym import ImaginedVectorEnv, mask_centres
from gatsbi_sim import Simulator

import arm
import robot
from goals import SCENE, SIZE
from reach import Reach
from run import ROOT, Server


@pytest.fixture
def scene():
    with Simulator(SCENE, size=SIZE, program=os.environ.get("GATSBI_SIM")) as scene:
        yield scene


def test_kinematics_are_those_of_the_simulated_robot(scene):
    for seed in (1, 2, 3):
        now = scene.reset(seed)
        posture = robot.joints(now)
        at, down = arm.hands(posture)
        np.testing.assert_allclose(at[0], now.state["ee_pose"][:3], atol=1e-9)
        # Far enough to come to the tray's rim.
        ways = np.random.default_rng(seed).uniform(-0.06, 0.1, (6, 2))
        for way, move in zip(ways, scene.hand_moves(ways[None])[0]):
            found = arm.velocities(posture, way[None], down)
            np.testing.assert_allclose(found[0], move["action"], atol=2e-3)
            posture = posture + arm.PERIOD * found
            np.testing.assert_allclose(arm.hands(posture)[0][0], move["position"], atol=1e-4)


def test_the_imagined_arm_goes_where_the_simulated_one_goes(scene):
    with Server(ROOT / "models/checkpoints/push1-tiny.safetensors") as address, Client(address, timeout=600) as client:
        begun = [robot.begin(scene, client, seed, Reach.outputs)[1] for seed in (11, 12)]
        task = Reach(scene, begun)
        env = ImaginedVectorEnv(client, [each.session.id for each in begun], 2, task, horizon=3)
        first, info = env.reset(seed=0)
        # Away from the middle of the tray could be out of it.
        ways = np.sign(arm.CENTRE - task.robots.hands)
        for _ in range(3):
            seen, rewards, _, truncated, _ = env.step(task.act(ways))
        np.testing.assert_allclose(rewards, -np.linalg.norm(seen[:, 2:], axis=1) / 2, rtol=1e-4)
        assert truncated.all()
        env.close()
        for row, start in enumerate(info["starts"]):
            now, beginning = robot.begin(scene, None, (11, 12)[start])
            simulated, before = robot.Robots([beginning]), mask_centres(Reach.truth(now)["agent_mask"])
            for _ in range(3):
                now = scene.step(simulated.act(ways[[row]])[0])
                simulated.joints = robot.joints(now)
            true = mask_centres(Reach.truth(now)["agent_mask"]) - before
            imagined = (seen - first)[row, None, :2] / 2
            assert np.linalg.norm(true) > 0.1 and np.linalg.norm(true - imagined) < 0.5 * np.linalg.norm(true)
