"""Python client of the gatsbi world-model service: numpy in, numpy out.

`Client` and `Session` block, `AsyncClient` and `AsyncSession` are awaited; both say the same on the wire.
"""

from gatsbi_client import costs
from gatsbi_client._aio import AsyncClient, AsyncHandles, AsyncSession, AsyncStream
from gatsbi_client._core import Retries
from gatsbi_client._proto.gatsbi.v1.planning_service_pb2 import Cem, Icem, Mppi, RandomShooting
from gatsbi_client._sync import Client, Handles, Session, Stream
from gatsbi_client.errors import (
    Conflict, DeadlineExceeded, FieldProblem, GatsbiError, InvalidRequest, NotAllowed, NotFound,
    NotImplementedByServer, Overloaded, ServerFailure, StepGap, Unavailable,
)
from gatsbi_client.types import (
    Belief, Chunk, Goal, Model, Plan, Prediction, PredictionPart, Rollout, Scores, SessionInfo,
)

__all__ = [
    "AsyncClient", "AsyncHandles", "AsyncSession", "AsyncStream", "Belief", "Cem", "Chunk", "Client", "Conflict",
    "DeadlineExceeded", "FieldProblem", "GatsbiError", "Goal", "Handles", "Icem", "InvalidRequest", "Model", "Mppi",
    "NotAllowed", "NotFound", "NotImplementedByServer", "Overloaded", "Plan", "Prediction", "PredictionPart",
    "RandomShooting", "Retries", "Rollout", "Scores", "ServerFailure", "Session", "SessionInfo", "StepGap", "Stream",
    "Unavailable", "costs",
]
