"""Runs the closed loops: real simulator, real server, real client, simulated time that stands still while planning.

    python run.py --out loops --goals 50 --arms nothing random model truth

It starts the server itself. What is done is appended to `OUT/ARM.jsonl`, a line a goal, and never done again, so it
can be stopped at any moment and started again. `report.py OUT` makes the table and the pictures.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from gatsbi_client import Client, Unavailable
from gatsbi_sim import Simulator

import goals
from arms import Arm, Model, Nothing, Random, ServicePlan, Truth
from search import Budget

ROOT = Path(__file__).resolve().parents[2]
DECISIONS = 20


def episode(scene: Simulator, arm: Arm, goal: goals.Goal, most: int, frames: Path) -> dict[str, Any]:
    """Pursues a goal until it is reached or the decisions are used up."""
    seen = scene.reset(goal.seed)
    goal.set(scene, len(seen.state["objects"]))
    told = arm.begin(seen, goal)
    kept, decisions = [np.array(seen.rgb)], []
    distance = goal.distance
    while len(decisions) < most and distance > goals.SUCCESS:
        action, decision = arm.decide()
        seen = scene.step(action)
        distance = seen.state["goal_distance"]
        place = goals.in_image(seen.state["objects"][goal.named]["pixel"]).tolist()
        decisions.append(decision | {"then": place, "distance": distance} | arm.look(seen, action))
        kept.append(np.array(seen.rgb))
    np.savez_compressed(frames / f"{goal.number}.npz", frames=kept, target=goal.pixel)
    return {
        "goal": goal.number, "object": goal.named, "at_first": goal.distance, "first": told,
        "reached": distance <= goals.SUCCESS, "distance": distance, "decisions": decisions,
    }


def main(arguments: list[str] | None = None) -> None:
    """Runs what is missing."""
    parse = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parse.add_argument("--out", type=Path, required=True)
    parse.add_argument("--goals", type=int, default=50)
    parse.add_argument("--first", type=int, default=0, help="number of the first goal")
    parse.add_argument("--arms", nargs="+", default=["nothing", "random", "model", "truth"])
    parse.add_argument("--checkpoint", type=Path, default=ROOT / "models/checkpoints/push1-tiny.safetensors")
    parse.add_argument("--horizon", type=int, default=Budget.horizon)
    parse.add_argument("--candidates", type=int, default=Budget.candidates)
    parse.add_argument("--iterations", type=int, default=Budget.iterations)
    parse.add_argument("--decisions", type=int, default=DECISIONS, help="most of an episode")
    given = parse.parse_args(arguments)
    # Whoever is told to end takes the programs it started along.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended; run it again to go on"))
    budget = Budget(given.horizon, given.candidates, given.iterations)
    program = os.environ.get("GATSBI_SIM", str(ROOT / "target/debug/gatsbi-sim"))
    with ExitStack() as stack:
        scene = stack.enter_context(Simulator(goals.SCENE, size=goals.SIZE, program=program))
        arms: dict[str, Arm] = {"nothing": Nothing(), "random": Random(scene, budget), "truth": Truth(scene, budget)}
        if {"model", "plan"} & set(given.arms):
            client = stack.enter_context(Client(stack.enter_context(Server(given.checkpoint)), timeout=600))
            arms |= {"model": Model(scene, budget, client), "plan": ServicePlan(scene, budget, client)}
        for name in given.arms:
            frames = given.out / name
            frames.mkdir(parents=True, exist_ok=True)
            lines = given.out / f"{name}.jsonl"
            done = {json.loads(line)["goal"] for line in lines.read_text().splitlines()} if lines.exists() else set()
            for number in range(given.first, given.first + given.goals):
                if number in done:
                    continue
                result = episode(scene, arms[name], goals.draw(scene, number), given.decisions, frames)
                with lines.open("a") as file:
                    file.write(json.dumps(result) + "\n")
                print(name, number, "reached" if result["reached"] else f"{result['distance']:.3f} m", flush=True)


class Server:
    """A server of one's own; as a context manager it gives its address and ends at the end."""

    def __init__(self, checkpoint: Path) -> None:
        self._address, http, admin = (f"127.0.0.1:{_free_port()}" for _ in range(3))
        program = os.environ.get("GATSBI_SERVER", str(ROOT / "target/debug/gatsbi-server"))
        listen = ["--grpc-listen", self._address, "--http-listen", http, "--admin-listen", admin]
        self._process = subprocess.Popen(
            [program, "--checkpoint", str(checkpoint), "--threads", "1", *listen], stdout=subprocess.DEVNULL
        )

    def __enter__(self) -> str:
        with Client(self._address) as client:
            while True:
                if self._process.poll() is not None:
                    sys.exit("the server has ended; it has said why above")
                try:
                    client.models()
                    return self._address
                except Unavailable:
                    time.sleep(0.1)

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait()


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


if __name__ == "__main__":
    main()
