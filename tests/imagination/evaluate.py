"""Runs a policy that was trained in imagination in the simulator, beside chance and doing nothing.

    python evaluate.py reach runs/reach [--episodes 50] [--picture strips.png]

The policy sees what the service believes of the simulator's frames. What is counted is the simulator's truth: the
task's return there, and how far it was from the goal at the end. It prints a table in Markdown; means have bootstrapped 95 % intervals.
"""

from __future__ import annotations

import argparse
import json
import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from gatsbi_client import Client
from gatsbi_client.gym import mask_centres
from gatsbi_sim import Simulator
from PIL import Image, ImageDraw
from stable_baselines3 import PPO

import robot
from goals import FIRST_SEED, SCENE, SIZE
from report import mean
from robot import RobotTask
from run import ROOT, Server
from train import TASKS

Array = np.ndarray
ARMS = ("nothing", "random", "policy")
SHOWN = 3
"""Episodes of an arm in the picture."""
ZOOM = 2


class Arena:
    """Where the arms of the comparison act: the simulator, the service, and what is to be done."""

    def __init__(self, scene: Simulator, client: Client, task: str, policy: PPO) -> None:
        self._scene, self._client, self._policy = scene, client, policy
        self._believing: RobotTask = TASKS[task](scene)
        self._judging: RobotTask = TASKS[task](scene)

    def episode(self, number: int, who: str) -> tuple[dict[str, Any], list[Array]]:
        """One episode, and its frames."""
        seed, believing, judging = FIRST_SEED + number, self._believing, self._judging
        client = self._client if who == "policy" else None
        goal = judging.draw(self._scene, None, seed)
        seen_goal = believing.draw(self._scene, client, seed) if client else goal
        now, beginning = robot.begin(self._scene, client, seed, believing.outputs)
        session, outputs = beginning.session, beginning.outputs
        judging.pursue(goal, beginning, judging.truth(now))
        if session is not None:
            believing.pursue(seen_goal, beginning, outputs)
        rng = np.random.default_rng([5, number])
        rewards, frames = [], [np.array(now.rgb)]
        told: dict[str, Any] = {"number": number, "at_first": judging.left(judging.truth(now)), "off": []}
        for _ in range(judging.steps):
            if session is not None:
                chosen, _ = self._policy.predict(believing.observe(outputs), deterministic=True)
                action = believing.act(chosen)[0]
            elif who == "random":
                action = judging.act(rng.uniform(-1, 1, (1, 2)))[0]
            else:
                action = np.zeros(7)
            now = self._scene.step(action)
            judging.robots.joints = robot.joints(now)
            rewards.append(float(judging.reward(judging.truth(now), action)[0]))
            frames.append(np.array(now.rgb))
            if session is not None:
                believing.robots.joints = robot.joints(now)
                outputs = robot.row(session.observe(np.array(now.rgb), action, outputs=believing.outputs))
                told["off"].append(abs(believing.left(outputs) - judging.left(judging.truth(now))))
        if session is not None:
            session.delete()
        left = judging.left(judging.truth(now))
        return told | {"return": sum(rewards), "rewards": rewards, "left": left, "mark": judging.mark().tolist()}, frames


def strip(title: str, frames: list[Array], goal: list[float]) -> Array:
    """One episode's frames in a row, with where the arm's centre should be."""
    side = SIZE * ZOOM
    sheet = Image.new("RGB", (len(frames) * side, side + 14), "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((2, 1), title, fill="black")
    for place, frame in enumerate(frames):
        sheet.paste(Image.fromarray(frame).resize((side, side), Image.Resampling.NEAREST), (place * side, 14))
        x, y = place * side + (goal[0] + 1) * side / 2, 14 + (goal[1] + 1) * side / 2
        draw.ellipse((x - 4, y - 4, x + 4, y + 4), outline="white")
    return np.asarray(sheet)


def main(arguments: list[str] | None = None) -> None:
    """Prints the table; draws the picture."""
    parse = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parse.add_argument("task", choices=TASKS)
    parse.add_argument("out", type=Path, help="where train.py has left the policy")
    parse.add_argument("--episodes", type=int, default=50)
    parse.add_argument("--arms", nargs="+", choices=ARMS, default=ARMS)
    parse.add_argument("--picture", type=Path, help="the first episodes of chance and of the policy")
    parse.add_argument("--checkpoint", type=Path, default=ROOT / "models/checkpoints/push1-tiny.safetensors")
    given = parse.parse_args(arguments)
    policy = PPO.load(given.out / "policy.zip", device="cpu")
    program = os.environ.get("GATSBI_SIM", str(ROOT / "target/debug/gatsbi-sim"))
    unit, strips = TASKS[given.task].unit, []
    print(f"| who acts | episodes | return | {unit} from the goal at the end | at first |\n|---|---|---|---|---|")
    with ExitStack() as stack:
        scene = stack.enter_context(Simulator(SCENE, size=SIZE, program=program))
        client = stack.enter_context(Client(stack.enter_context(Server(given.checkpoint)), timeout=600))
        arena = Arena(scene, client, given.task, policy)
        for who in given.arms:
            done, lines = [], given.out / f"{who}.jsonl"
            lines.unlink(missing_ok=True)
            for number in range(given.episodes):
                told, frames = arena.episode(number, who)
                done.append(told)
                with lines.open("a") as file:
                    file.write(json.dumps(told) + "\n")
                if number < SHOWN and who != "nothing":
                    title = f"{who}, episode {number}: return {told['return']:.2f}"
                    strips.append(strip(title, frames, told["mark"]))
            parts = (mean([each[name] for each in done]) for name in ("return", "left", "at_first"))
            print(f"| {who} | {len(done)} | {' | '.join(parts)} |", flush=True)
            if off := [step for each in done for step in each["off"]]:
                print(f"\nWhat the service believes to be left differs by {np.median(off):.3f} {unit} (median).")
    if given.picture is not None:
        Image.fromarray(np.concatenate(strips)).save(given.picture, optimize=True)


if __name__ == "__main__":
    main()
