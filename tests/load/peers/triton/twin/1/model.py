"""The twin as a model of Triton's Python backend."""

import os
import sys
from typing import Any

# Triton's interpreter does not look there by itself.
sys.path[:0] = os.environ["PYTHONPATH"].split(os.pathsep)

import numpy as np  # noqa: E402
import triton_python_backend_utils as backend  # noqa: E402
from core import Core  # noqa: E402


class TritonPythonModel:
    """One process with the model."""

    def initialize(self, args: dict[str, str]) -> None:
        self.core = Core()

    def execute(self, requests: list[Any]) -> list[Any]:
        """A batch of sequences."""

        def read(request: Any, name: str) -> np.ndarray:
            return backend.get_input_tensor_by_name(request, name).as_numpy()

        sessions = [str(int(read(request, "SESSION").ravel()[0])) for request in requests]
        bodies = [read(request, "BODY").tobytes() for request in requests]
        objects = self.core.observe(sessions, bodies)
        for session, request in zip(sessions, requests, strict=True):
            if read(request, "END").ravel()[0]:
                self.core.forget(session)
        tensors = [backend.Tensor("OBJECTS", np.frombuffer(table, np.uint8)[None].copy()) for table in objects]
        return [backend.InferenceResponse([tensor]) for tensor in tensors]
