import json
import os
import subprocess

import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader

from gatsbi_client.recorder import Recorder

ACTIONS = np.random.default_rng(0).normal(size=(4, 7)).astype(np.float32)


def record(path, frames):
    with Recorder(path) as recorder:
        recorder.add(frames[0], at=100.0)
        for t in range(1, 4):
            recorder.add(frames[t], ACTIONS[t], at=100.0 + t / 5)


def test_a_recording_becomes_an_episode_byte_for_byte(frames, tmp_path):
    record(tmp_path / "run.mcap", frames)
    program = os.environ.get("GATSBI_EPISODES", "gatsbi-episodes")
    subprocess.run([program, "import", "mcap", tmp_path / "run.mcap", "--out", tmp_path / "data"], check=True)
    row = pd.read_parquet(tmp_path / "data/episodes-00000.parquet").iloc[0]
    assert row["rgb"] == frames[:4].tobytes()
    # Action t follows frame t; nothing follows the last, for which the one before still holds.
    held = [1, 2, 3, 3]
    assert np.asarray(row["actions"], np.float32).tobytes() == ACTIONS[held].tobytes()
    manifest = json.loads((tmp_path / "data/manifest.json").read_text())
    assert manifest["dataset"]["frame_period_seconds"] == pytest.approx(0.2)


def test_the_reference_library_reads_it(frames, tmp_path):
    record(tmp_path / "run.mcap", frames)
    with (tmp_path / "run.mcap").open("rb") as file:
        messages = [(channel.topic, message.log_time) for _, channel, message in make_reader(file).iter_messages()]
    assert messages[:3] == [("/camera", 100 * 10**9), ("/action", 100_200_000_000 - 1), ("/camera", 100_200_000_000)]


def test_a_failure_leaves_nothing(frames, tmp_path):
    with pytest.raises(ValueError, match=r"float64 of shape \[2, 2\], expected uint8"):
        with Recorder(tmp_path / "run.mcap") as recorder:
            recorder.add(frames[0])
            recorder.add(np.zeros((2, 2)))
    assert list(tmp_path.iterdir()) == []
