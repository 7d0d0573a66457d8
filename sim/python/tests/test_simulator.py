"""The simulator over its process protocol. Needs the standard library and a built `gatsbi-sim`, see GATSBI_SIM."""

import os
import unittest

from gatsbi_sim import Simulator, SimulatorError


class SimulatorTest(unittest.TestCase):
    def test_an_episode_is_the_same_again(self):
        with Simulator("push1", size=32) as scene:
            self.assertEqual((scene.spec["size"], len(scene.spec["actions"])), (32, 7))
            episodes = [self.play(scene, seed) for seed in (7, 8, 7)]
        self.assertEqual(episodes[0], episodes[2])
        self.assertNotEqual(episodes[0], episodes[1])

    def play(self, scene, seed):
        seen = scene.reset(seed)
        frames = [bytes(seen.rgb) + bytes(seen.mask)]
        self.assertEqual(seen.rgb.shape, (32, 32, 3))
        self.assertEqual(seen.mask.shape, (32, 32))
        for step in range(1, 4):
            seen = scene.step(scene.scripted_action())
            self.assertEqual(seen.state["step"], step)
            frames.append(bytes(seen.rgb) + bytes(seen.mask))
        return frames, seen.state

    def test_a_goal_is_shown_and_its_distance_told(self):
        with Simulator("push1") as scene:
            seen = scene.reset(7)
            self.assertIsNone(seen.state["goal_distance"])
            at = [list(each["position"][:2]) for each in seen.state["objects"]]
            goal = [[0.52, 0.1]] + [None] * (len(at) - 1)
            shown = scene.set_goal(goal)
            self.assertNotEqual(bytes(shown.mask), bytes(seen.mask))
            self.assertAlmostEqual(shown.state["goal_distance"], 0, places=6)
            after = scene.step([0.0] * 7)
            away = ((at[0][0] - 0.52) ** 2 + (at[0][1] - 0.1) ** 2) ** 0.5
            self.assertAlmostEqual(after.state["goal_distance"], away, places=3)

    def test_futures_come_true(self):
        with Simulator("push1", size=16) as scene:
            scene.reset(7)
            moves = scene.hand_moves([[[0.02, 0.0]] * 2, [[0.0, 0.02]] * 2])
            candidates = [[step["action"] for step in way] for way in moves]
            futures = scene.futures(candidates)
            for action, objects in zip(candidates[1], futures[1]):
                self.assertEqual(scene.step(action).state["objects"], objects)
            with self.assertRaisesRegex(SimulatorError, "has 7 numbers, not 6"):
                scene.futures([[[0.0] * 6]])

    def test_what_is_refused_changes_nothing(self):
        with Simulator("balls3", size=16) as scene:
            for ask, sentence in [
                (lambda: scene.step([]), "the scene was not reset yet"),
                (lambda: scene.step([0.5]), "an action of balls3 has 0 numbers, not 1"),
                (lambda: scene.set_goal([]), "nobody acts in balls3, so it takes neither goals nor candidates"),
            ]:
                with self.assertRaises(SimulatorError) as refused:
                    ask()
                self.assertEqual(str(refused.exception), sentence)
                first = scene.reset(3)
            scene.step([])
            self.assertEqual(bytes(scene.reset(3).rgb), bytes(first.rgb))

    def test_a_program_that_is_not_there_is_named(self):
        with self.assertRaisesRegex(SimulatorError, "no-such-program cannot be started"):
            Simulator("push1", program="./no-such-program")
        with self.assertRaisesRegex(SimulatorError, "there is no scene `push3`"):
            Simulator("push3", program=os.environ.get("GATSBI_SIM"))


if __name__ == "__main__":
    unittest.main()
