"""The blocking client, made by `generate.py`."""

from __future__ import annotations

import queue
import time
from os import PathLike
from types import TracebackType
from typing import Iterable, Iterator, Callable, Iterable, Mapping, Sequence, TypeVar, cast

import grpc
import numpy.typing as npt

from gatsbi_client import _access as access
from gatsbi_client import _core as core
from gatsbi_client import errors
from gatsbi_client import types as t
from gatsbi_client._core import Image, Retries
from gatsbi_client._proto.gatsbi.v1.imagination_service_pb2 import PredictBatchRequest
from gatsbi_client._proto.gatsbi.v1.session_service_pb2 import ObserveStreamRequest, ObserveStreamResponse
from gatsbi_client.costs import CostProgram

T = TypeVar("T")


class Client:
    """A connection to a server, such as `127.0.0.1:50051`."""

    def __init__(
        self, address: str, *, timeout: float = 30.0, retries: Retries = Retries(),
        api_key: str | None = None, ca: str | PathLike[str] | None = None,
        certificate: tuple[str | PathLike[str], str | PathLike[str]] | None = None,
    ) -> None:
        """`timeout` is in seconds for a whole call with all its tries.

        `api_key` is `GATSBI_API_KEY` of the environment if absent. With `ca`, a file of authorities (PEM), TLS is
        spoken; `certificate` are the files of an own certificate and its key, where the server asks for one.
        """
        credentials = access.credentials(ca, certificate)
        if credentials is None:
            channel = grpc.insecure_channel(address, options=core.CHANNEL_OPTIONS)
        else:
            channel = grpc.secure_channel(address, credentials, options=core.CHANNEL_OPTIONS)
        self._channel = access.Keyed(channel, access.key(api_key))
        self._timeout = timeout
        self._retries = retries

    def close(self) -> None:
        """Closes the connection."""
        self._channel.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _call(self, call: core.Call[T]) -> T:
        invoke = self._channel.unary_unary(
            f"/gatsbi.v1.{call.method}", type(call.request).SerializeToString, call.answer.FromString
        )
        end, attempt = time.monotonic() + self._timeout, 0
        while True:
            attempt += 1
            try:
                return call.parse(invoke(call.request, timeout=max(end - time.monotonic(), 0.001)))
            except grpc.RpcError as failed:
                error = core.translate(failed)
                wait = self._retries.wait(attempt, error, call.repeatable)
                if wait is None or time.monotonic() + wait >= end:
                    raise error from failed
            time.sleep(wait)

    def _gather(self, call: core.Call[t.Chunk]) -> t.Rollout:
        end, attempt = time.monotonic() + self._timeout, 0
        while True:
            attempt += 1
            try:
                return core.gather([chunk for chunk in self._chunks(call, end - time.monotonic())])
            except errors.GatsbiError as error:
                wait = self._retries.wait(attempt, error, call.repeatable)
                if wait is None or time.monotonic() + wait >= end:
                    raise
            time.sleep(wait)

    def _chunks(self, call: core.Call[t.Chunk], timeout: float) -> Iterator[t.Chunk]:
        invoke = self._channel.unary_stream(
            f"/gatsbi.v1.{call.method}", type(call.request).SerializeToString, call.answer.FromString
        )
        answers = invoke(call.request, timeout=max(timeout, 0.001))
        try:
            for answer in answers:
                yield call.parse(answer)
        except grpc.RpcError as failed:
            raise core.translate(failed) from failed
        finally:
            answers.cancel()  # type: ignore[no-untyped-call,unused-ignore]

    def models(self) -> tuple[t.Model, ...]:
        """All models, sorted by name."""
        return self._call(core.list_models())

    def create_session(
        self, model: str = "", *, label: str = "", samples: bool = False, seed: int | None = None,
        keep_steps: int = 0,
    ) -> Session:
        """Opens a session. `samples`: observing draws instead of taking means; `keep_steps`: for rewinding."""
        return Session(self, self._call(core.create(model, label, samples, seed, keep_steps)))

    def session(self, session_id: str) -> Session:
        """A session that is open already."""
        return Session(self, self._call(core.get(session_id)))

    def sessions(self, *, label: str = "") -> tuple[t.SessionInfo, ...]:
        """All sessions that this client may see, sorted by id; with a label, those that bear it."""
        found: list[t.SessionInfo] = []
        page = ""
        while True:
            more, page = self._call(core.list_sessions(label, page))
            found += more
            if not page:
                return tuple(found)

    def import_session(self, snapshot: bytes, *, label: str = "", keep_steps: int = 0) -> Session:
        """A new session from the bytes of `Session.export`."""
        return Session(self, self._call(core.restore(snapshot, "", label, keep_steps)))

    def put_goal(
        self, image: Image | None = None, *, masks: Mapping[t.PartName, t.Array] | None = None,
        object_ids: Sequence[int] = (), model: str = "", label: str = "",
    ) -> t.Goal:
        """Keeps a goal: an image, and masks `[H, W]` (`each_object`: `[objects, H, W]`) in [0, 1] or uint8."""
        return self._call(core.put_goal(image, masks or {}, object_ids, model, label))

    def delete_goal(self, goal_id: str) -> None:
        """Forgets a goal."""
        self._call(core.delete_goal(goal_id))

    def predict_batch(
        self, requests: Iterable[t.Prediction], *, outputs: Sequence[t.OutputName],
        encoding: t.EncodingName = "f32", every_k: int | None = None, last_only: bool = False,
        timeout: float | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> Iterator[t.PredictionPart]:
        """Many rollouts over one stream: parts as they arrive, in any order. Never tried again by itself.

        `progress` is called with the number of predictions that have ended.
        """
        call = core.predictions(requests, outputs, encoding, every_k, last_only)
        invoke = self._channel.stream_stream(
            f"/gatsbi.v1.{call.method}", PredictBatchRequest.SerializeToString, call.answer.FromString
        )
        answers, done = invoke(call.request, timeout=timeout), 0
        try:
            for answer in answers:
                part = call.parse(answer)
                if part.last:
                    done += 1
                    if progress is not None:
                        progress(done)
                yield part
        except grpc.RpcError as failed:
            raise core.translate(failed) from failed
        finally:
            answers.cancel()  # type: ignore[no-untyped-call,unused-ignore]

    def open_handles(
        self, starts: Iterable[str | bytes], *, samples: int | None = None, seed: int | None = None,
        independent: bool = False,
    ) -> Handles:
        """Rows for a policy outside: one for each session id or snapshot, times `samples`.

        Starts share random numbers, sample by sample, unless they are `independent`.
        """
        return Handles(self, self._call(core.open_handles(starts, samples, seed, independent)))


class Session:
    """One robot's belief. As a context manager it deletes the session at the end.

    `at_step` makes a call fail with `Conflict` if the session's last step is another one.
    """

    def __init__(self, client: Client, info: t.SessionInfo) -> None:
        self._client = client
        self._next = info.next_step
        self.id = info.id
        self.info = info
        """As the server last described it."""

    @property
    def next_step(self) -> int:
        """Number that the next observation bears."""
        return self._next

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.delete()
        except errors.GatsbiError as failed:
            # An error of the body says more, and a session that is gone already needs no deleting.
            if error is None and not isinstance(failed, errors.NotFound):
                raise

    def refresh(self) -> t.SessionInfo:
        """Asks the server, and takes over its next step."""
        return self._take(self._client._call(core.get(self.id)))

    def _take(self, info: t.SessionInfo) -> t.SessionInfo:
        self.info, self._next = info, info.next_step
        return info

    def observe(
        self, image: Image | None, action: npt.ArrayLike | None = None, *,
        outputs: Sequence[t.OutputName] = ("objects",), encoding: t.EncodingName = "f32", step: int | None = None,
    ) -> t.Belief:
        """Absorbs an image (None: a dropped frame) and the action that led to it, raw units `[A]`."""
        number = self._next if step is None else step
        belief = self._client._call(core.observe(self.id, number, image, action, outputs, encoding))
        self._next = max(self._next, belief.step + 1)
        return belief

    def stream(
        self, *, outputs: Sequence[t.OutputName] = ("objects",), encoding: t.EncodingName = "f32"
    ) -> Stream:
        """A control loop on one connection, to be used as a context manager."""
        return Stream(self, outputs, encoding)

    def imagine(
        self, actions: npt.ArrayLike, *, outputs: Sequence[t.OutputName], encoding: t.EncodingName = "f32",
        samples: int | None = None, seed: int | None = None, every_k: int | None = None, last_only: bool = False,
        at_step: int | None = None,
    ) -> t.Rollout:
        """Rolls actions out, raw units `[N, H, A]` or `[H, A]`. Without `samples`, means are taken."""
        return self._client._gather(core.imagine(
            self.id, actions, outputs, encoding, samples, seed, every_k, last_only, at_step
        ))

    def imagine_chunks(
        self, actions: npt.ArrayLike, *, outputs: Sequence[t.OutputName], encoding: t.EncodingName = "f32",
        samples: int | None = None, seed: int | None = None, every_k: int | None = None, last_only: bool = False,
        at_step: int | None = None,
    ) -> Iterator[t.Chunk]:
        """As `imagine`, chunk by chunk as they arrive; not tried again by itself."""
        return self._client._chunks(core.imagine(
            self.id, actions, outputs, encoding, samples, seed, every_k, last_only, at_step
        ), self._client._timeout)

    def score(
        self, actions: npt.ArrayLike, costs: CostProgram, *, samples: int | None = None, seed: int | None = None,
        by_sample: bool = False, by_term: bool = False, at_step: int | None = None,
    ) -> t.Scores:
        """Costs of candidates `[N, H, A]`, raw units. Without `samples`, means are taken."""
        return self._client._call(core.score(
            self.id, actions, costs, samples, seed, by_sample, by_term, at_step
        ))

    def plan(
        self, horizon: int, costs: CostProgram, *, optimiser: t.Optimiser | None = None, samples: int | None = None,
        seed: int | None = None, action_min: Sequence[float] = (), action_max: Sequence[float] = (),
        action_repeat: int = 1, warm_start: npt.ArrayLike | bool = False, budget: float | None = None,
        outputs: Sequence[t.OutputName] = (), encoding: t.EncodingName = "f32", at_step: int | None = None,
    ) -> t.Plan:
        """The best actions that `optimiser` (iCEM by default) finds within `budget` seconds.

        `warm_start`: True for the session's previous plan, moved on, or actions `[H, A]`. `outputs`: what to predict
        under the plan. Without `samples`, futures are means; `seed` then drives the optimiser alone.
        """
        return self._client._call(core.plan(
            self.id, horizon, costs, samples, seed, optimiser, action_min, action_max, warm_start, budget,
            action_repeat, outputs, encoding, at_step,
        ))

    def fork(
        self, count: int = 1, *, label: str | None = None, seed: int | None = None, at_step: int | None = None
    ) -> tuple[Session, ...]:
        """New sessions with this one's belief."""
        infos = self._client._call(core.fork(self.id, count, label, seed, at_step))
        return tuple(Session(self._client, info) for info in infos)

    def rewind(self, to_step: int) -> t.SessionInfo:
        """Makes a kept step the last one observed."""
        return self._take(self._client._call(core.rewind(self.id, to_step)))

    def export(self, *, at_step: int | None = None) -> bytes:
        """The belief as bytes."""
        return self._client._call(core.export(self.id, at_step))

    def restore(self, snapshot: bytes) -> t.SessionInfo:
        """Replaces this session's belief by an exported one."""
        return self._take(self._client._call(core.restore(snapshot, self.id, "", 0)))

    def delete(self) -> None:
        """Closes the session."""
        self._client._call(core.delete(self.id))


class Stream:
    """Observations over one connection, an answer each. One that fails raises and does not end the stream.

    A connection that is lost is opened again, and the observation sent again: its number makes that safe.
    """

    def __init__(self, session: Session, outputs: Sequence[t.OutputName], encoding: t.EncodingName) -> None:
        self._session, self._outputs, self._encoding = session, outputs, encoding
        self._requests: queue.Queue[ObserveStreamRequest | None] = queue.Queue()
        self._answers: Iterator[ObserveStreamResponse] | None = None

    def __enter__(self) -> Stream:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def observe(
        self, image: Image | None, action: npt.ArrayLike | None = None, *, step: int | None = None
    ) -> t.Belief:
        """As `Session.observe`."""
        session, client = self._session, self._session._client
        call = core.observe_streamed(
            session.id, session._next if step is None else step, image, action, self._outputs, self._encoding,
            client._timeout,
        )
        end, attempt = time.monotonic() + client._timeout, 0
        while True:
            attempt += 1
            try:
                belief = self._exchange(call)
                session._next = max(session._next, belief.step + 1)
                return belief
            except errors.GatsbiError as error:
                wait = client._retries.wait(attempt, error, call.repeatable)
                if wait is None or time.monotonic() + wait >= end:
                    raise
            time.sleep(wait)

    def _exchange(self, call: core.Call[t.Belief]) -> t.Belief:
        answers = self._answers or iter(self._open(call))
        # Who breaks off the wait leaves an answer behind: unless it has come, the next one opens another stream.
        self._answers = None
        self._requests.put(call.request)
        try:
            answer = next(answers)
        except grpc.RpcError as failed:
            self.close()
            raise core.translate(failed) from failed
        except StopIteration as ended:
            self.close()
            raise errors.Unavailable("the server ended the stream", code=grpc.StatusCode.UNAVAILABLE) from ended
        self._answers = answers
        return call.parse(answer)

    def _open(self, call: core.Call[t.Belief]) -> Iterable[ObserveStreamResponse]:
        self._requests.put_nowait(None)
        self._requests = queue.Queue()
        invoke = self._session._client._channel.stream_stream(
            f"/gatsbi.v1.{call.method}", ObserveStreamRequest.SerializeToString, call.answer.FromString
        )
        return cast("Iterable[ObserveStreamResponse]", invoke(_until_none(self._requests)))

    def close(self) -> None:
        """Ends the stream; the session stays. Another observation opens it again."""
        self._requests.put(None)
        self._answers = None


def _until_none(requests: queue.Queue[ObserveStreamRequest | None]) -> Iterator[ObserveStreamRequest]:
    while (request := requests.get()) is not None:
        yield request


class Handles:
    """Rows that a policy outside steps. As a context manager it gives them back at the end."""

    def __init__(self, client: Client, info: t.HandlesInfo) -> None:
        self._client = client
        self._step = 0
        self.info = info

    def __enter__(self) -> Handles:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def step(
        self, actions: npt.ArrayLike, *, rows: Sequence[int] = (), restart: Sequence[int] = (),
        outputs: Sequence[t.OutputName] = ("objects",), encoding: t.EncodingName = "f32",
    ) -> t.HandlesStep:
        """Steps rows (all by default) by actions `[rows, A]`; rows in `restart` go back to their start before."""
        call = core.step_handles(self.info.id, self._step, actions, rows, restart, outputs, encoding)
        answer = self._client._call(call)
        self._step = answer.step
        return answer

    def close(self) -> None:
        """Gives the rows back."""
        self._client._call(core.close_handles(self.info.id))
