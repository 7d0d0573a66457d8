"""Python client of the gatsbi world-model service: numpy in, numpy out.

`Client` and `Session` block, `AsyncClient` and `AsyncSession` are awaited; both say the same on the wire.
"""

from gatsbi_client._aio import AsyncClient, AsyncHandles, AsyncSession
from gatsbi_client._core import Retries
from gatsbi_client._sync import Client, Handles, Session
from gatsbi_client.errors import (
    Conflict, DeadlineExceeded, FieldProblem, GatsbiError, InvalidRequest, NotFound, NotImplementedByServer,
    Overloaded, ServerFailure, StepGap, Unavailable,
)
from gatsbi_client.types import Belief, Chunk, Model, Prediction, PredictionPart, Rollout

__all__ = [
    "AsyncClient", "AsyncHandles", "AsyncSession", "Belief", "Chunk", "Client", "Conflict", "DeadlineExceeded",
    "FieldProblem", "GatsbiError", "Handles", "InvalidRequest", "Model", "NotFound", "NotImplementedByServer",
    "Overloaded", "Prediction", "PredictionPart", "Retries", "Rollout", "ServerFailure", "Session", "StepGap",
    "Unavailable",
]
