"""What the service saw and imagined, as a rerun recording: `rerun recording.rrd` shows it.

    import rerun
    from gatsbi_client.rerun import Recorder

    stream = rerun.RecordingStream("gatsbi")
    stream.save("recording.rrd")
    recorder = Recorder(stream)
    recorder.observed(session.observe(frame, action, outputs=recorder.OUTPUTS), frame)
    recorder.imagined(session.imagine(actions, outputs=recorder.ROLLOUT_OUTPUTS))
"""

from __future__ import annotations

from typing import Any, Mapping

import numpy as np
import numpy.typing as npt
import rerun

from gatsbi_client.types import Array, Belief, OutputName, Rollout

PRESENT = 0.5
"""From this presence on an object is drawn."""


class Recorder:
    """Logs beliefs along the timeline `step`, and rollouts along it from where they begin.

    Entities: `camera` (what came in), `belief` and `imagined`, each with `frame`, `agent_mask`, `object_masks` (the
    strongest object's number plus one) and `objects` (boxes named by id); `imagined/paths` are the objects' ways.
    What was not asked for is not logged.
    """

    OUTPUTS: tuple[OutputName, ...] = ("frame", "agent_mask", "object_masks", "objects")
    ROLLOUT_OUTPUTS: tuple[OutputName, ...] = OUTPUTS

    def __init__(self, stream: rerun.RecordingStream) -> None:
        """`stream` is yours: saved to a file, sent to a viewer, or both."""
        self._stream = stream

    def observed(self, belief: Belief, image: npt.NDArray[Any] | bytes | None = None) -> None:
        """A belief, and the image that led to it."""
        self._stream.set_time("step", sequence=belief.step)
        if isinstance(image, bytes):
            self._stream.log("camera", rerun.EncodedImage(contents=image))
        elif image is not None:
            self._stream.log("camera", rerun.Image(_bytes(image)))
        self._pictures("belief", belief.outputs)
        objects = [each for each in belief.objects if each.presence >= PRESENT]
        table = np.array([[each.x, each.y, each.width, each.height] for each in objects]).reshape(-1, 4)
        self._boxes("belief", [each.id for each in objects], table, belief.outputs)

    def imagined(self, rollout: Rollout, *, candidate: int = 0, sample: int = 0) -> None:
        """One future of a rollout, at the steps that it is about."""
        outputs = {name: values[sample, candidate] for name, values in rollout.outputs.items() if "spread" not in name}
        for at, depth in enumerate(rollout.depths):
            self._stream.set_time("step", sequence=rollout.at_step + depth)
            now = {name: values[at] for name, values in outputs.items()}
            self._pictures("imagined", now)
            if "objects" in now:
                shown = (now["object_ids"] >= 0) & (now["objects"][:, 0] >= PRESENT)
                self._boxes("imagined", now["object_ids"][shown].tolist(), now["objects"][shown, 1:5], now)
        if "objects" in outputs:
            self._stream.set_time("step", sequence=rollout.at_step)
            self._paths(outputs)

    def _pictures(self, where: str, outputs: Mapping[str, Array]) -> None:
        if "frame" in outputs:
            self._stream.log(f"{where}/frame", rerun.Image(_bytes(outputs["frame"])))
        if "agent_mask" in outputs:
            self._stream.log(f"{where}/agent_mask", rerun.Image(_bytes(outputs["agent_mask"])))
        if "object_masks" in outputs:
            masks = _bytes(outputs["object_masks"])
            strongest = np.where(masks.max(axis=0) >= 128, masks.argmax(axis=0) + 1, 0)
            self._stream.log(f"{where}/object_masks", rerun.SegmentationImage(strongest.astype(np.uint8)))

    def _boxes(self, where: str, ids: list[int], table: Array, outputs: Mapping[str, Array]) -> None:
        side = _side(outputs)
        boxes = rerun.Boxes2D(
            centers=_pixels(table[:, :2], side), sizes=table[:, 2:4] * side, labels=[str(each) for each in ids],
            class_ids=[each % 256 for each in ids],
        )
        self._stream.log(f"{where}/objects", boxes)

    def _paths(self, outputs: Mapping[str, Array]) -> None:
        side, ids, table = _side(outputs), outputs["object_ids"], outputs["objects"]
        known = sorted(set(ids[ids >= 0].tolist()))
        ways = [_pixels(table[(ids == each) & (table[..., 0] >= PRESENT)][:, 1:3], side) for each in known]
        drawn = [(each, way) for each, way in zip(known, ways) if len(way) > 1]
        self._stream.log("imagined/paths", rerun.LineStrips2D(
            [way for _, way in drawn], labels=[str(each) for each, _ in drawn],
        ))


def _bytes(values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Floats in [0, 1] as bytes."""
    if values.dtype == np.uint8:
        return values
    return np.asarray((values.astype(np.float32) * 255).round().clip(0, 255), dtype=np.uint8)


def _side(outputs: Mapping[str, Array]) -> int:
    """Height of the pictures in pixels; 64 where there is none."""
    for name, axis in (("frame", -3), ("agent_mask", -2), ("object_masks", -2)):
        if name in outputs:
            return int(outputs[name].shape[axis])
    return 64


def _pixels(at: Array, side: int) -> Array:
    """Positions in [-1, 1] as pixels; rerun puts 0 on the upper left corner of a picture."""
    return (at + 1) / 2 * side
