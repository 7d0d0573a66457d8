"""Simulated robot scenes, served by the program `gatsbi-sim` in a process of its own.

`Simulator` needs the standard library only; `gatsbi_sim.gym` has a Gymnasium environment on top of it.

    with Simulator("push1") as scene:
        seen = scene.reset(seed=7)
        seen = scene.step(scene.scripted_action())
        seen.rgb, seen.mask, seen.state["objects"][0]["position"]
"""

import dataclasses
import json
import os
import subprocess
import tempfile

PROTOCOL = 1


class SimulatorError(Exception):
    """What the simulator refused, or why it is not there."""


@dataclasses.dataclass
class Observation:
    """A frame and the truth about it."""

    rgb: memoryview
    """[height, width, 3] bytes"""
    mask: memoryview
    """[height, width] bytes: 0 background, 1 agent, 2 + i object i"""
    state: dict
    """step, objects (position, quaternion, pixel), ee_pose, joint_positions, contacts_agent, contacts_objects,
    goal_distance; metres, radians, quaternions as w, x, y, z"""


class Simulator:
    """One scene: push1, push1-play, roll, roll-cycle, push2, balls3, balls6 or balls9.

    A request that is refused changes nothing.
    """

    def __init__(self, scene, *, size=64, program=None):
        """Starts the program: `program`, else the environment variable GATSBI_SIM, else `gatsbi-sim` of the path."""
        program = program or os.environ.get("GATSBI_SIM") or "gatsbi-sim"
        command = [program, "serve", "--scene", scene, "--size", str(size)]
        pipe = subprocess.PIPE
        # A file, because nobody reads it while the program runs, and a full pipe would stop it.
        self._said = tempfile.TemporaryFile()
        try:
            self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=self._said)
        except OSError as error:
            self._said.close()
            raise SimulatorError(
                f"{program} cannot be started ({error}): build it with `cargo build --release -p gatsbi-sim` "
                "and name the file in GATSBI_SIM"
            ) from error
        hello = self._read()
        if hello["protocol"] != PROTOCOL:
            self.close()
            raise SimulatorError(f"{program} speaks protocol {hello['protocol']}, not {PROTOCOL}")
        self.spec = hello["spec"]

    def reset(self, seed):
        """Begins the episode of this seed, and forgets the goal."""
        return self._observe({"op": "reset", "seed": seed})

    def step(self, action):
        """Holds an action for one frame period. Its numbers, units and bounds are in `spec["actions"]`."""
        return self._observe({"op": "step", "action": [float(value) for value in action]})

    def set_goal(self, objects):
        """Sets where objects shall be, [x, y] in metres or None for each, and shows how that would look."""
        goal = [None if at is None else [float(value) for value in at] for at in objects]
        return self._observe({"op": "set_goal", "objects": goal})

    def scripted_action(self):
        """The action that the script of the data sets would take now."""
        return self._ask({"op": "scripted_action"})["action"]

    def futures(self, candidates):
        """The objects after each action of each candidate `[N][H][A]`, as in `Observation.state`; nothing has moved."""
        return self._ask({"op": "futures", "candidates": _numbers(candidates)})["futures"]

    def hand_moves(self, candidates):
        """Actions that move the hand by `[N][H][2]` metres along x and y of the table: `action`, and the hand's
        `position` and `pixel` after it, if nothing is in the way."""
        return self._ask({"op": "hand_moves", "candidates": _numbers(candidates)})["moves"]

    def close(self):
        """Ends the program."""
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait()
        self._said.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def _observe(self, request):
        answer = self._ask(request)
        rgb, mask = (self._picture(answer[name]) for name in ("rgb", "mask"))
        return Observation(rgb=rgb, mask=mask, state=answer["state"])

    def _ask(self, request):
        try:
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()
        except (BrokenPipeError, ValueError) as error:
            raise self._ended() from error
        return self._read()

    def _read(self):
        line = self._process.stdout.readline()
        if not line:
            raise self._ended()
        answer = json.loads(line)
        if "error" in answer:
            raise SimulatorError(answer["error"])
        return answer

    def _picture(self, shape):
        size = 1
        for side in shape:
            size *= side
        picture = self._process.stdout.read(size)
        if len(picture) < size:
            raise self._ended()
        return memoryview(picture).cast("B", shape)

    def _ended(self):
        said = ""
        if not self._said.closed:
            self._process.wait()
            self._said.seek(0)
            said = self._said.read().decode(errors="replace").strip()
            self.close()
        return SimulatorError(said or "the simulator has ended")


def _numbers(nested):
    """Nested sequences of numbers, NumPy's too, as lists of floats."""
    if hasattr(nested, "tolist"):
        return nested.tolist()
    return float(nested) if not hasattr(nested, "__len__") else [_numbers(each) for each in nested]
