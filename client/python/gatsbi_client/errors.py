"""What can go wrong. Everything the client raises for an answer of the server is a `GatsbiError`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Iterable

import grpc

from gatsbi_client._proto.gatsbi.client import status_pb2

if TYPE_CHECKING:
    from gatsbi_client._proto.gatsbi.v1 import problem_pb2


@dataclass(frozen=True)
class FieldProblem:
    """What is wrong with one field of a request."""

    field: str
    """Path in the request, such as `observation.action[2]`."""
    description: str
    """What was found and what was expected."""


class GatsbiError(Exception):
    """An error that the service answered, or that kept a call from reaching it."""

    def __init__(
        self,
        message: str,
        *,
        code: grpc.StatusCode,
        reason: str = "",
        fields: tuple[FieldProblem, ...] = (),
        retry_after: float | None = None,
        metadata: dict[str, str] | None = None,
    ) -> None:
        lines = [message, *(f"  {field.field}: {field.description}" for field in fields)]
        super().__init__("\n".join(lines))
        self.message = message
        self.code = code
        self.reason = reason
        """Stable name such as `STEP_GAP`; empty where the error did not come from the service itself."""
        self.fields = fields
        self.retry_after = retry_after
        """Seconds after which trying again may help, if the server said so."""
        self.metadata = metadata or {}


class InvalidRequest(GatsbiError):
    """The request is wrong; `fields` says where."""


class NotAllowed(GatsbiError):
    """The key is missing, unknown, expired, or not good for this."""


class NotFound(GatsbiError):
    """No such session, model or handles."""


class StepGap(GatsbiError):
    """An observation's number is not the next one."""

    @property
    def expected_step(self) -> int | None:
        """The number that the session waits for."""
        value = self.metadata.get("expected_step")
        return None if value is None else int(value)


class Conflict(GatsbiError):
    """The session or the handles are not in the state that the request needs."""


class Overloaded(GatsbiError):
    """There is no room now; see `retry_after`."""


class DeadlineExceeded(GatsbiError):
    """The answer did not come in time."""


class Unavailable(GatsbiError):
    """The server cannot be reached, is starting or is shutting down."""


class NotImplementedByServer(GatsbiError):
    """This server does not have the call."""


class ServerFailure(GatsbiError):
    """The server failed; the session is as it was."""


_CLASSES: dict[grpc.StatusCode, type[GatsbiError]] = {
    grpc.StatusCode.INVALID_ARGUMENT: InvalidRequest,
    grpc.StatusCode.OUT_OF_RANGE: InvalidRequest,
    grpc.StatusCode.UNAUTHENTICATED: NotAllowed,
    grpc.StatusCode.PERMISSION_DENIED: NotAllowed,
    grpc.StatusCode.NOT_FOUND: NotFound,
    grpc.StatusCode.FAILED_PRECONDITION: Conflict,
    grpc.StatusCode.ALREADY_EXISTS: Conflict,
    grpc.StatusCode.RESOURCE_EXHAUSTED: Overloaded,
    grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineExceeded,
    grpc.StatusCode.UNAVAILABLE: Unavailable,
    grpc.StatusCode.UNIMPLEMENTED: NotImplementedByServer,
    grpc.StatusCode.INTERNAL: ServerFailure,
}
_CODES = {code.value[0]: code for code in grpc.StatusCode}


def _class(code: grpc.StatusCode, reason: str) -> type[GatsbiError]:
    return StepGap if reason == "STEP_GAP" else _CLASSES.get(code, GatsbiError)


def from_status(
    code: grpc.StatusCode, message: str, trailers: Iterable[tuple[str, str | bytes]] | None
) -> GatsbiError:
    """The error of a gRPC status with the google.rpc details in its trailers."""
    reason, metadata, retry_after = "", dict[str, str](), None
    fields: list[FieldProblem] = []
    for key, value in trailers or ():
        if key != "grpc-status-details-bin" or not isinstance(value, bytes):
            continue
        for detail in status_pb2.Status.FromString(value).details:
            kind = detail.type_url.rpartition("/")[2]
            if kind == "google.rpc.ErrorInfo":
                info = status_pb2.ErrorInfo.FromString(detail.value)
                reason, metadata = info.reason, dict(info.metadata)
            elif kind == "google.rpc.BadRequest":
                bad = status_pb2.BadRequest.FromString(detail.value)
                fields += [FieldProblem(each.field, each.description) for each in bad.field_violations]
            elif kind == "google.rpc.RetryInfo":
                delay = status_pb2.RetryInfo.FromString(detail.value).retry_delay
                retry_after = delay.seconds + delay.nanos / 1e9
    return _class(code, reason)(
        message, code=code, reason=reason, fields=tuple(fields), retry_after=retry_after, metadata=metadata
    )


def from_problem(problem: problem_pb2.Problem) -> GatsbiError:
    """The error of a problem inside a stream."""
    code = _CODES.get(problem.code, grpc.StatusCode.UNKNOWN)
    fields = tuple(
        FieldProblem(each.field, f"is {each.value}, expected {each.expected}") for each in problem.fields
    )
    retry_after = problem.retry_after_millis / 1e3 if problem.HasField("retry_after_millis") else None
    # Streams have no metadata; what a gap expects is said by its field.
    metadata = {"expected_step": problem.fields[0].expected} if problem.reason == "STEP_GAP" else {}
    return _class(code, problem.reason)(
        problem.message, code=code, reason=problem.reason, fields=fields, retry_after=retry_after, metadata=metadata
    )
