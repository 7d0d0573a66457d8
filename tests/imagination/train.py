"""Trains a small policy in imagination alone: PPO of stable-baselines3 on `ImaginedVectorEnv`.

    python train.py reach --out runs/reach [--steps 16000] [--checkpoint FILE]

The simulator gives beginnings (a few frames each, moved by chance); whatever is learned from is imagined by the
server, which this starts. `OUT` gets `policy.zip` and `curve.jsonl`, a line for each episode of all rows.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gatsbi_client import Client
from gatsbi_client.gym import ImaginedVectorEnv
from gatsbi_sim import Simulator
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

from goals import SCENE, SIZE
from push import Push
from reach import Reach
from robot import RobotTask, begin
from run import ROOT, Server

TASKS = {"reach": Reach, "push": Push}
FIRST_SEED = 950_000
"""Of beginnings; neither models nor closed loops know these seeds."""


class Rows(VecEnv):
    """Imagined rows as stable-baselines3 wants them: what ends begins again at once."""

    def __init__(self, env: ImaginedVectorEnv, task: RobotTask, curve: Path, seed: int) -> None:
        actions = gymnasium.spaces.Box(-1, 1, (2,), dtype=np.float32)
        super().__init__(env.num_envs, env.single_observation_space, actions)
        self._env, self._task, self._curve = env, task, curve
        self._seed: int | None = seed
        self._began, self.taken = time.monotonic(), 0

    def reset(self) -> np.ndarray:
        observations, _ = self._env.reset(seed=self._seed)
        self._seed = None
        self._returns = np.zeros(self.num_envs)
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observations, rewards, _, truncated, _ = self._env.step(self._task.act(self._actions))
        self._returns += rewards
        self.taken += self.num_envs
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        # Rows of the service end together.
        if truncated.all():
            infos = [{"terminal_observation": each, "TimeLimit.truncated": True} for each in observations]
            told = {"steps": self.taken, "seconds": time.monotonic() - self._began, "returns": self._returns.tolist()}
            with self._curve.open("a") as file:
                file.write(json.dumps(told) + "\n")
            observations = self.reset()
        return observations, rewards, truncated, infos

    def close(self) -> None:
        self._env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("rows have no attributes of their own")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError("rows have no methods of their own")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


def main(arguments: list[str] | None = None) -> None:
    """Trains."""
    parse = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parse.add_argument("task", choices=TASKS)
    parse.add_argument("--out", type=Path, required=True)
    parse.add_argument("--steps", type=int, default=16_000, help="imagined steps of all rows together")
    parse.add_argument("--rows", type=int, default=32)
    parse.add_argument("--beginnings", type=int, default=48)
    parse.add_argument("--seed", type=int, default=1)
    parse.add_argument("--checkpoint", type=Path, default=ROOT / "models/checkpoints/push1-tiny.safetensors")
    given = parse.parse_args(arguments)
    torch.set_num_threads(1)
    given.out.mkdir(parents=True, exist_ok=True)
    curve = given.out / "curve.jsonl"
    curve.unlink(missing_ok=True)
    program = os.environ.get("GATSBI_SIM", str(ROOT / "target/debug/gatsbi-sim"))
    with ExitStack() as stack:
        client = stack.enter_context(Client(stack.enter_context(Server(given.checkpoint)), timeout=600))
        with Simulator(SCENE, size=SIZE, program=program) as scene:
            kind = TASKS[given.task]
            begun = [begin(scene, client, FIRST_SEED + each, kind.outputs)[1] for each in range(given.beginnings)]
            task = kind(scene, begun)
        env = ImaginedVectorEnv(
            client, [each.session.id for each in begun], given.rows, task, horizon=task.steps
        )
        rows = Rows(env, task, curve, given.seed)
        stack.callback(rows.close)
        policy = PPO(
            "MlpPolicy", rows, n_steps=2 * task.steps, batch_size=128, n_epochs=10, learning_rate=1e-3, gamma=0.9,
            gae_lambda=0.9, policy_kwargs={"net_arch": [32, 32], "log_std_init": -0.5}, seed=given.seed, device="cpu",
            verbose=1,
        )
        began = time.monotonic()
        try:
            policy.learn(given.steps)
        except KeyboardInterrupt:
            print("ended early; what was learned is kept")
        seconds = time.monotonic() - began
        policy.save(given.out / "policy.zip")
        print(f"{rows.taken} imagined steps in {seconds:.0f} s, {rows.taken / seconds:.1f} a second end to end")


if __name__ == "__main__":
    main()
