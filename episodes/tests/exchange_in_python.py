"""The formats' own packages read what `gatsbi-episodes` exports, byte by byte; a video is imported with a real decoder.

Run with GATSBI_EPISODES naming the program, and with imageio-ffmpeg, mcap, mcap-protobuf-support, numpy, pandas, pillow and
pyarrow installed.
"""

import io
import json
import os
import pathlib
import subprocess
import tempfile
import unittest

import imageio_ffmpeg
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image

HERE = pathlib.Path(__file__).parent
SAMPLE = HERE / "../samples/push1-heldout.parquet"
PROGRAM = os.environ.get("GATSBI_EPISODES", "gatsbi-episodes")


def run(*arguments, **environment):
    subprocess.run([PROGRAM, *map(str, arguments)], check=True, env=os.environ | environment, stdout=subprocess.DEVNULL)


class Exchange(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.out = pathlib.Path(folder.name) / "out"
        self.sample = pd.read_parquet(SAMPLE)

    def frames(self, row):
        return np.frombuffer(row["rgb"], np.uint8).reshape(row["length"], 64, 64, 3)

    def actions(self, row):
        return np.asarray(row["actions"], np.float32).reshape(row["length"], 7)

    def test_lerobot_in_pyarrow(self):
        run("export", "lerobot", SAMPLE, "--out", self.out)
        info = json.loads((self.out / "meta/info.json").read_text())
        self.assertEqual((info["codebase_version"], info["fps"], info["total_frames"]), ("v3.0", 5, 240))
        self.assertEqual(info["features"]["observation.images.main"]["dtype"], "image")
        table = pq.read_table(self.out / info["data_path"].format(chunk_index=0, file_index=0)).to_pylist()
        self.assertEqual([row["index"] for row in table], list(range(240)))
        for row in table:
            episode = self.sample.iloc[row["episode_index"]]
            picture = np.asarray(Image.open(io.BytesIO(row["observation.images.main"]["bytes"])))
            np.testing.assert_array_equal(picture, self.frames(episode)[row["frame_index"]])
            self.assertEqual(np.float32(row["action"]).tobytes(), self.actions(episode)[row["frame_index"]].tobytes())
            self.assertAlmostEqual(row["timestamp"], row["frame_index"] / 5, places=5)
        episodes = pd.read_parquet(self.out / "meta/episodes")
        self.assertEqual(list(episodes["dataset_to_index"]), [40, 80, 120, 160, 200, 240])
        tasks = pd.read_parquet(self.out / "meta/tasks.parquet")
        self.assertEqual(tasks.loc["unspecified"]["task_index"], 0)
        actions = np.concatenate([self.actions(row) for _, row in self.sample.iterrows()])
        statistics = json.loads((self.out / "meta/stats.json").read_text())
        np.testing.assert_allclose(statistics["action"]["mean"], actions.mean(0, np.float64), atol=1e-6)
        np.testing.assert_allclose(statistics["action"]["std"], actions.std(0, np.float64), atol=1e-6)
        self.assertEqual(np.shape(statistics["observation.images.main"]["mean"]), (3, 1, 1))

    def test_mcap_in_its_reference_library(self):
        run("export", "mcap", SAMPLE, "--out", self.out)
        files = sorted(self.out.iterdir())
        self.assertEqual(len(files), 6)
        for file, (_, row) in zip(files, self.sample.iterrows(), strict=True):
            self.assertEqual(file.name, f"episode-{row['episode_id']:06}.mcap")
            with file.open("rb") as stream:
                reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
                summary = reader.get_summary()
                self.assertEqual(summary.statistics.message_count, 80)
                self.assertEqual(summary.statistics.message_end_time, 7_800_000_000)
                # The index leads to the same messages as the file from its beginning.
                seen = list(reader.iter_decoded_messages(topics=["/camera"]))
                actions = list(reader.iter_messages(topics=["/action"]))
            for t, message in enumerate(seen):
                picture = np.asarray(Image.open(io.BytesIO(message.decoded_message.data)))
                np.testing.assert_array_equal(picture, self.frames(row)[t])
                self.assertEqual(message.message.log_time, t * 200_000_000)
            values = np.array([json.loads(message.data)["values"] for _, _, message in actions], np.float32)
            self.assertEqual(values.tobytes(), self.actions(row).tobytes())

    def test_a_video_is_decoded_frame_by_frame(self):
        fixture = HERE / "fixtures/lerobot-video"
        run("import", "lerobot", fixture, "--out", self.out, GATSBI_FFMPEG=imageio_ffmpeg.get_ffmpeg_exe())
        episodes = pd.read_parquet(self.out / "episodes-00000.parquet")
        self.assertEqual(list(episodes["length"]), [4, 3])
        for e, row in episodes.iterrows():
            frames = np.frombuffer(row["rgb"], np.uint8).reshape(row["length"], 32, 32, 3)
            for t, frame in enumerate(frames):
                middle = frame[8:24, 8:24].mean((0, 1))
                np.testing.assert_allclose(middle, [40 * t + 20, 100 * e + 20, 128], atol=6)


if __name__ == "__main__":
    unittest.main()
