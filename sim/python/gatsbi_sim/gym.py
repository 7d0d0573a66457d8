"""The scenes as Gymnasium environments.

    import gymnasium
    import gatsbi_sim.gym

    env = gymnasium.make("gatsbi/push1")
    frame, info = env.reset(seed=7, options={"goal": [[0.5, 0.1], None, None, None]})

Observations are frames; `info` has the label map (`mask`) and the truth (`gatsbi_sim.Observation.state`).
The reward is minus the largest distance of an object from its goal in metres, 0 without a goal. An episode terminates
when the goal is reached and is truncated at the length of the episodes of the data sets.
"""

import gymnasium
import numpy as np

from gatsbi_sim import Simulator

SCENES = ("push1", "push1-play", "roll", "roll-cycle", "push2", "balls3", "balls6", "balls9")


class SimEnv(gymnasium.Env):
    """One scene in a process of its own."""

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, scene, *, size=64, tolerance=0.02, render_mode=None, program=None):
        """A goal counts as reached within `tolerance` metres."""
        self._simulator = Simulator(scene, size=size, program=program)
        self.spec_of_scene = self._simulator.spec
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": round(1 / self.spec_of_scene["frame_period_seconds"]),
        }
        self.render_mode = render_mode
        self.tolerance = tolerance
        bounds = [[a["low"], a["high"]] for a in self.spec_of_scene["actions"]]
        low, high = np.array(bounds, np.float32).reshape(-1, 2).T
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.observation_space = gymnasium.spaces.Box(0, 255, (size, size, 3), np.uint8)
        self.goal_frame = None
        """[height, width, 3] how the goal looks, if there is one"""
        self._frame = None

    def reset(self, *, seed=None, options=None):
        """`options["goal"]`: [x, y] in metres or None for each object."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**63))
        seen = self._simulator.reset(seed)
        self.goal_frame = None
        goal = (options or {}).get("goal")
        if goal is not None:
            shown = self._simulator.set_goal(goal)
            self.goal_frame = np.array(shown.rgb)
        return self._observe(seen)

    def step(self, action):
        seen = self._simulator.step(np.asarray(action, np.float32))
        frame, info = self._observe(seen)
        distance = seen.state["goal_distance"]
        reached = distance is not None and distance <= self.tolerance
        truncated = seen.state["step"] >= self.spec_of_scene["frames"] - 1
        return frame, -float(distance or 0.0), reached, truncated, info

    def scripted_action(self):
        """The action that the script of the data sets would take now."""
        return np.array(self._simulator.scripted_action(), np.float32)

    def render(self):
        return self._frame if self.render_mode == "rgb_array" else None

    def close(self):
        self._simulator.close()

    def _observe(self, seen):
        self._frame = np.array(seen.rgb)
        return self._frame, {"mask": np.array(seen.mask), **seen.state}


for _scene in SCENES:
    gymnasium.register(
        f"gatsbi/{_scene}", entry_point="gatsbi_sim.gym:SimEnv", kwargs={"scene": _scene}
    )
