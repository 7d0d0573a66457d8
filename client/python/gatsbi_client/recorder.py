"""Records what a robot sees and does to an MCAP file, which Foxglove opens and `gatsbi-episodes import mcap` reads.

    with Recorder("run.mcap") as recorder:
        for frame, action in robot:
            session.observe(frame, action)
            recorder.add(frame, action)

Needs `pip install gatsbi-client[mcap]`.
"""

from __future__ import annotations

import base64
import json
import os
import time
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt
from mcap.writer import Writer

_IMAGE = {"title": "foxglove.RawImage", "type": "object"}
_ACTION = {
    "title": "gatsbi.Action",
    "type": "object",
    "properties": {"values": {"type": "array", "items": {"type": "number"}}},
}


class Recorder:
    """One recording, an episode. The file has its name once the recorder is closed; after a failure there is none."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path)
        self._partial = self._path.with_name(f".{self._path.name}.partial")
        self._file = self._partial.open("wb")
        self._writer = Writer(self._file)
        self._writer.start(library="gatsbi-client")
        self._camera = self._channel("/camera", "foxglove.RawImage", _IMAGE)
        self._action = self._channel("/action", "gatsbi.Action", _ACTION)
        self._last = 0

    def add(
        self, frame: npt.NDArray[np.uint8] | None, action: npt.ArrayLike | None = None, *, at: float | None = None
    ) -> None:
        """What was seen, `[H, W, 3]` bytes or None for a dropped frame, and the action that led to it.

        Both as `observe` takes them. `at` is the time in seconds since 1970, now by default. The action is logged a nanosecond before its frame: what
        held since the frame before.
        """
        now = max(round((time.time() if at is None else at) * 1e9), self._last + 2)
        if frame is not None and (frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8):
            raise ValueError(f"frame is {frame.dtype} of shape {list(frame.shape)}, expected uint8 [height, width, 3]")
        if action is not None:
            values = np.asarray(action, np.float32)
            if values.ndim != 1 or not np.isfinite(values).all():
                raise ValueError(f"action has shape {list(values.shape)}, expected finite numbers of one dimension")
            # As doubles, which keep single precision exactly.
            self._write(self._action, now - 1, {"values": values.astype(float).tolist()})
        if frame is not None:
            height, width = frame.shape[:2]
            seconds, nanoseconds = divmod(now, 10**9)
            self._write(self._camera, now, {
                "timestamp": {"sec": seconds, "nsec": nanoseconds}, "frame_id": "camera", "width": width,
                "height": height, "encoding": "rgb8", "step": 3 * width,
                "data": base64.b64encode(np.ascontiguousarray(frame).data).decode(),
            })
        self._last = now

    def close(self) -> None:
        """Completes the file and gives it its name."""
        if not self._file.closed:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
            self._partial.replace(self._path)

    def _channel(self, topic: str, name: str, schema: dict[str, Any]) -> int:
        number = self._writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
        return self._writer.register_channel(topic, "json", number)

    def _write(self, channel: int, time_: int, message: dict[str, Any]) -> None:
        self._writer.add_message(channel, time_, json.dumps(message).encode(), time_)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._file.close()
            self._partial.unlink(missing_ok=True)
