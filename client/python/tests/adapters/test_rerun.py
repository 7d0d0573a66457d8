"""Against the real rerun-sdk: what is logged is read back from the file."""

from collections import defaultdict

import numpy as np
import pytest
import rerun
from rerun.chunk import RrdReader

from gatsbi_client.rerun import Recorder


def read(path):
    """Rows by entity: `{entity: {column: [values by step]}}`."""
    entities = defaultdict(lambda: defaultdict(list))
    for chunk in RrdReader(path).stream():
        rows = chunk.to_record_batch()
        for name in rows.schema.names:
            if name != "log_time":
                entities[chunk.entity_path.strip("/")][name.rpartition(":")[2]] += rows[name].to_pylist()
    return entities


@pytest.fixture
def stream(tmp_path):
    stream = rerun.RecordingStream("gatsbi-test")
    stream.save(tmp_path / "walk.rrd")
    yield stream
    stream.disconnect()


def test_a_walk_and_a_future_are_read_back(client, frames, dimension, stream, tmp_path):
    recorder, side = Recorder(stream), frames.shape[1]
    actions = np.random.default_rng(0).normal(0, 0.3, (1, 3, dimension))
    with client.create_session() as session:
        beliefs = []
        for step in range(3):
            action = None if step == 0 else [0.0] * dimension
            beliefs.append(session.observe(frames[step], action, outputs=recorder.OUTPUTS))
            recorder.observed(beliefs[-1], frames[step])
        rollout = session.imagine(actions, outputs=recorder.ROLLOUT_OUTPUTS)
        recorder.imagined(rollout)
    stream.disconnect()

    seen = read(tmp_path / "walk.rrd")
    parts = ("frame", "agent_mask", "object_masks", "objects")
    wanted = {"camera", "imagined/paths", *(f"{where}/{part}" for where in ("belief", "imagined") for part in parts)}
    assert wanted <= set(seen)
    assert sorted(seen["camera"]["step"]) == sorted(seen["belief/objects"]["step"]) == [0, 1, 2]
    assert sorted(seen["imagined/frame"]["step"]) == [3, 4, 5] and seen["imagined/paths"]["step"] == [2]
    first = seen["camera"]["step"].index(0)
    assert bytes(np.ravel(seen["camera"]["buffer"][first]).astype(np.uint8)) == frames[0].tobytes()
    last = seen["belief/objects"]["step"].index(2)
    shown = beliefs[2].present()
    assert seen["belief/objects"]["labels"][last] == [str(each.id) for each in shown]
    # The service counts pixels from the middle of the first one, rerun from its corner.
    want = [[each.pixel_x + 0.5, each.pixel_y + 0.5] for each in shown]
    np.testing.assert_allclose(seen["belief/objects"]["centers"][last], want, atol=1e-3)
    sizes = 2 * np.array(seen["belief/objects"]["half_sizes"][last])
    np.testing.assert_allclose(sizes, [[each.width * side, each.height * side] for each in shown], atol=1e-3)


def test_what_was_not_asked_for_is_not_logged(client, frames, stream, tmp_path):
    with client.create_session() as session:
        Recorder(stream).observed(session.observe(frames[0]))
    stream.disconnect()
    seen = read(tmp_path / "walk.rrd")
    assert "belief/objects" in seen and not {"camera", "belief/frame", "belief/agent_mask"} & set(seen)
