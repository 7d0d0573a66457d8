"""The Gymnasium environment. Needs gymnasium and a built `gatsbi-sim`, see GATSBI_SIM."""

import unittest
import warnings

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env

import gatsbi_sim.gym


class GymTest(unittest.TestCase):
    def test_gymnasium_finds_nothing_to_complain_of(self):
        for scene in ("push1", "balls3"):
            env = gymnasium.make(f"gatsbi/{scene}").unwrapped
            with warnings.catch_warnings(record=True) as complaints:
                check_env(env, skip_render_check=True)
            # Actions are in physical units, which it advises against.
            rest = [str(each.message) for each in complaints if "normalized" not in str(each.message)]
            self.assertEqual(rest, [])
            env.close()

    def test_a_goal_that_is_reached_ends_the_episode(self):
        env = gymnasium.make("gatsbi/push1", render_mode="rgb_array").unwrapped
        _, info = env.reset(seed=7)
        there = [each["position"][:2] for each in info["objects"]]
        frame, _ = env.reset(seed=7, options={"goal": there})
        np.testing.assert_array_equal(env.render(), frame)
        self.assertEqual(env.goal_frame.shape, frame.shape)
        _, reward, terminated, truncated, _ = env.step(np.zeros(7, np.float32))
        self.assertTrue(terminated and not truncated)
        self.assertLess(abs(reward), env.tolerance)
        env.close()

    def test_an_episode_is_as_long_as_in_the_data_sets(self):
        env = gymnasium.make("gatsbi/balls3", size=16).unwrapped
        env.reset(seed=1)
        ends = [env.step(env.scripted_action())[3] for _ in range(99)]
        self.assertEqual(ends.index(True), 98)
        env.close()


if __name__ == "__main__":
    unittest.main()
