"""The asyncio client. `generate.py` makes the blocking one of it."""

from __future__ import annotations

import asyncio
import time
from os import PathLike
from types import TracebackType
from typing import AsyncIterable, AsyncIterator, Callable, Iterable, Mapping, Sequence, TypeVar, cast

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


class AsyncClient:
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
            channel = grpc.aio.insecure_channel(address, options=core.CHANNEL_OPTIONS)
        else:
            channel = grpc.aio.secure_channel(address, credentials, options=core.CHANNEL_OPTIONS)
        self._channel = access.Keyed(channel, access.key(api_key))
        self._timeout = timeout
        self._retries = retries

    async def close(self) -> None:
        """Closes the connection."""
        await self._channel.close(None)

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def _call(self, call: core.Call[T]) -> T:
        invoke = self._channel.unary_unary(
            f"/gatsbi.v1.{call.method}", type(call.request).SerializeToString, call.answer.FromString
        )
        end, attempt = time.monotonic() + self._timeout, 0
        while True:
            attempt += 1
            try:
                return call.parse(await invoke(call.request, timeout=max(end - time.monotonic(), 0.001)))
            except grpc.RpcError as failed:
                error = core.translate(failed)
                wait = self._retries.wait(attempt, error, call.repeatable)
                if wait is None or time.monotonic() + wait >= end:
                    raise error from failed
            await asyncio.sleep(wait)

    async def _gather(self, call: core.Call[t.Chunk]) -> t.Rollout:
        end, attempt = time.monotonic() + self._timeout, 0
        while True:
            attempt += 1
            try:
                return core.gather([chunk async for chunk in self._chunks(call, end - time.monotonic())])
            except errors.GatsbiError as error:
                wait = self._retries.wait(attempt, error, call.repeatable)
                if wait is None or time.monotonic() + wait >= end:
                    raise
            await asyncio.sleep(wait)

    async def _chunks(self, call: core.Call[t.Chunk], timeout: float) -> AsyncIterator[t.Chunk]:
        invoke = self._channel.unary_stream(
            f"/gatsbi.v1.{call.method}", type(call.request).SerializeToString, call.answer.FromString
        )
        answers = invoke(call.request, timeout=max(timeout, 0.001))
        try:
            async for answer in answers:
                yield call.parse(answer)
        except grpc.RpcError as failed:
            raise core.translate(failed) from failed
        finally:
            answers.cancel()  # type: ignore[no-untyped-call,unused-ignore]

    async def models(self) -> tuple[t.Model, ...]:
        """All models, sorted by name."""
        return await self._call(core.list_models())

    async def create_session(
        self, model: str = "", *, label: str = "", samples: bool = False, seed: int | None = None,
        keep_steps: int = 0,
    ) -> AsyncSession:
        """Opens a session. `samples`: observing draws instead of taking means; `keep_steps`: for rewinding."""
        return AsyncSession(self, await self._call(core.create(model, label, samples, seed, keep_steps)))

    async def session(self, session_id: str) -> AsyncSession:
        """A session that is open already."""
        return AsyncSession(self, await self._call(core.get(session_id)))

    async def sessions(self, *, label: str = "") -> tuple[t.SessionInfo, ...]:
        """All sessions that this client may see, sorted by id; with a label, those that bear it."""
        found: list[t.SessionInfo] = []
        page = ""
        while True:
            more, page = await self._call(core.list_sessions(label, page))
            found += more
            if not page:
                return tuple(found)

    async def import_session(self, snapshot: bytes, *, label: str = "", keep_steps: int = 0) -> AsyncSession:
        """A new session from the bytes of `AsyncSession.export`."""
        return AsyncSession(self, await self._call(core.restore(snapshot, "", label, keep_steps)))

    async def put_goal(
        self, image: Image | None = None, *, masks: Mapping[t.PartName, t.Array] | None = None,
        object_ids: Sequence[int] = (), model: str = "", label: str = "",
    ) -> t.Goal:
        """Keeps a goal: an image, and masks `[H, W]` (`each_object`: `[objects, H, W]`) in [0, 1] or uint8."""
        return await self._call(core.put_goal(image, masks or {}, object_ids, model, label))

    async def delete_goal(self, goal_id: str) -> None:
        """Forgets a goal."""
        await self._call(core.delete_goal(goal_id))

    async def predict_batch(
        self, requests: Iterable[t.Prediction], *, outputs: Sequence[t.OutputName],
        encoding: t.EncodingName = "f32", every_k: int | None = None, last_only: bool = False,
        timeout: float | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> AsyncIterator[t.PredictionPart]:
        """Many rollouts over one stream: parts as they arrive, in any order. Never tried again by itself.

        `progress` is called with the number of predictions that have ended.
        """
        call = core.predictions(requests, outputs, encoding, every_k, last_only)
        invoke = self._channel.stream_stream(
            f"/gatsbi.v1.{call.method}", PredictBatchRequest.SerializeToString, call.answer.FromString
        )
        answers, done = invoke(call.request, timeout=timeout), 0
        try:
            async for answer in answers:
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

    async def open_handles(
        self, starts: Iterable[str | bytes], *, samples: int | None = None, seed: int | None = None,
        independent: bool = False,
    ) -> AsyncHandles:
        """Rows for a policy outside: one for each session id or snapshot, times `samples`.

        Starts share random numbers, sample by sample, unless they are `independent`.
        """
        return AsyncHandles(self, await self._call(core.open_handles(starts, samples, seed, independent)))


class AsyncSession:
    """One robot's belief. As a context manager it deletes the session at the end.

    `at_step` makes a call fail with `Conflict` if the session's last step is another one.
    """

    def __init__(self, client: AsyncClient, info: t.SessionInfo) -> None:
        self._client = client
        self._next = info.next_step
        self.id = info.id
        self.info = info
        """As the server last described it."""

    @property
    def next_step(self) -> int:
        """Number that the next observation bears."""
        return self._next

    async def __aenter__(self) -> AsyncSession:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            await self.delete()
        except errors.GatsbiError as failed:
            # An error of the body says more, and a session that is gone already needs no deleting.
            if error is None and not isinstance(failed, errors.NotFound):
                raise

    async def refresh(self) -> t.SessionInfo:
        """Asks the server, and takes over its next step."""
        return self._take(await self._client._call(core.get(self.id)))

    def _take(self, info: t.SessionInfo) -> t.SessionInfo:
        self.info, self._next = info, info.next_step
        return info

    async def observe(
        self, image: Image | None, action: npt.ArrayLike | None = None, *,
        outputs: Sequence[t.OutputName] = ("objects",), encoding: t.EncodingName = "f32", step: int | None = None,
    ) -> t.Belief:
        """Absorbs an image (None: a dropped frame) and the action that led to it, raw units `[A]`."""
        number = self._next if step is None else step
        belief = await self._client._call(core.observe(self.id, number, image, action, outputs, encoding))
        self._next = max(self._next, belief.step + 1)
        return belief

    def stream(
        self, *, outputs: Sequence[t.OutputName] = ("objects",), encoding: t.EncodingName = "f32"
    ) -> AsyncStream:
        """A control loop on one connection, to be used as a context manager."""
        return AsyncStream(self, outputs, encoding)

    async def imagine(
        self, actions: npt.ArrayLike, *, outputs: Sequence[t.OutputName], encoding: t.EncodingName = "f32",
        samples: int | None = None, seed: int | None = None, every_k: int | None = None, last_only: bool = False,
        at_step: int | None = None,
    ) -> t.Rollout:
        """Rolls actions out, raw units `[N, H, A]` or `[H, A]`. Without `samples`, means are taken."""
        return await self._client._gather(core.imagine(
            self.id, actions, outputs, encoding, samples, seed, every_k, last_only, at_step
        ))

    def imagine_chunks(
        self, actions: npt.ArrayLike, *, outputs: Sequence[t.OutputName], encoding: t.EncodingName = "f32",
        samples: int | None = None, seed: int | None = None, every_k: int | None = None, last_only: bool = False,
        at_step: int | None = None,
    ) -> AsyncIterator[t.Chunk]:
        """As `imagine`, chunk by chunk as they arrive; not tried again by itself."""
        return self._client._chunks(core.imagine(
            self.id, actions, outputs, encoding, samples, seed, every_k, last_only, at_step
        ), self._client._timeout)

    async def score(
        self, actions: npt.ArrayLike, costs: CostProgram, *, samples: int | None = None, seed: int | None = None,
        by_sample: bool = False, by_term: bool = False, at_step: int | None = None,
    ) -> t.Scores:
        """Costs of candidates `[N, H, A]`, raw units. Without `samples`, means are taken."""
        return await self._client._call(core.score(
            self.id, actions, costs, samples, seed, by_sample, by_term, at_step
        ))

    async def plan(
        self, horizon: int, costs: CostProgram, *, optimiser: t.Optimiser | None = None, samples: int | None = None,
        seed: int | None = None, action_min: Sequence[float] = (), action_max: Sequence[float] = (),
        action_repeat: int = 1, warm_start: npt.ArrayLike | bool = False, budget: float | None = None,
        outputs: Sequence[t.OutputName] = (), encoding: t.EncodingName = "f32", at_step: int | None = None,
    ) -> t.Plan:
        """The best actions that `optimiser` (iCEM by default) finds within `budget` seconds.

        `warm_start`: True for the session's previous plan, moved on, or actions `[H, A]`. `outputs`: what to predict
        under the plan. Without `samples`, futures are means; `seed` then drives the optimiser alone.
        """
        return await self._client._call(core.plan(
            self.id, horizon, costs, samples, seed, optimiser, action_min, action_max, warm_start, budget,
            action_repeat, outputs, encoding, at_step,
        ))

    async def fork(
        self, count: int = 1, *, label: str | None = None, seed: int | None = None, at_step: int | None = None
    ) -> tuple[AsyncSession, ...]:
        """New sessions with this one's belief."""
        infos = await self._client._call(core.fork(self.id, count, label, seed, at_step))
        return tuple(AsyncSession(self._client, info) for info in infos)

    async def rewind(self, to_step: int) -> t.SessionInfo:
        """Makes a kept step the last one observed."""
        return self._take(await self._client._call(core.rewind(self.id, to_step)))

    async def export(self, *, at_step: int | None = None) -> bytes:
        """The belief as bytes."""
        return await self._client._call(core.export(self.id, at_step))

    async def restore(self, snapshot: bytes) -> t.SessionInfo:
        """Replaces this session's belief by an exported one."""
        return self._take(await self._client._call(core.restore(snapshot, self.id, "", 0)))

    async def delete(self) -> None:
        """Closes the session."""
        await self._client._call(core.delete(self.id))


class AsyncStream:
    """Observations over one connection, an answer each. One that fails raises and does not end the stream.

    A connection that is lost is opened again, and the observation sent again: its number makes that safe.
    """

    def __init__(self, session: AsyncSession, outputs: Sequence[t.OutputName], encoding: t.EncodingName) -> None:
        self._session, self._outputs, self._encoding = session, outputs, encoding
        self._requests: asyncio.Queue[ObserveStreamRequest | None] = asyncio.Queue()
        self._answers: AsyncIterator[ObserveStreamResponse] | None = None

    async def __aenter__(self) -> AsyncStream:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def observe(
        self, image: Image | None, action: npt.ArrayLike | None = None, *, step: int | None = None
    ) -> t.Belief:
        """As `AsyncSession.observe`."""
        session, client = self._session, self._session._client
        call = core.observe_streamed(
            session.id, session._next if step is None else step, image, action, self._outputs, self._encoding,
            client._timeout,
        )
        end, attempt = time.monotonic() + client._timeout, 0
        while True:
            attempt += 1
            try:
                belief = await self._exchange(call)
                session._next = max(session._next, belief.step + 1)
                return belief
            except errors.GatsbiError as error:
                wait = client._retries.wait(attempt, error, call.repeatable)
                if wait is None or time.monotonic() + wait >= end:
                    raise
            await asyncio.sleep(wait)

    async def _exchange(self, call: core.Call[t.Belief]) -> t.Belief:
        answers = self._answers or aiter(self._open(call))
        # Who breaks off the wait leaves an answer behind: unless it has come, the next one opens another stream.
        self._answers = None
        await self._requests.put(call.request)
        try:
            answer = await anext(answers)
        except grpc.RpcError as failed:
            await self.close()
            raise core.translate(failed) from failed
        except StopAsyncIteration as ended:
            await self.close()
            raise errors.Unavailable("the server ended the stream", code=grpc.StatusCode.UNAVAILABLE) from ended
        self._answers = answers
        return call.parse(answer)

    def _open(self, call: core.Call[t.Belief]) -> AsyncIterable[ObserveStreamResponse]:
        self._requests.put_nowait(None)
        self._requests = asyncio.Queue()
        invoke = self._session._client._channel.stream_stream(
            f"/gatsbi.v1.{call.method}", ObserveStreamRequest.SerializeToString, call.answer.FromString
        )
        return cast("AsyncIterable[ObserveStreamResponse]", invoke(_until_none(self._requests)))

    async def close(self) -> None:
        """Ends the stream; the session stays. Another observation opens it again."""
        await self._requests.put(None)
        self._answers = None


async def _until_none(requests: asyncio.Queue[ObserveStreamRequest | None]) -> AsyncIterator[ObserveStreamRequest]:
    while (request := await requests.get()) is not None:
        yield request


class AsyncHandles:
    """Rows that a policy outside steps. As a context manager it gives them back at the end."""

    def __init__(self, client: AsyncClient, info: t.HandlesInfo) -> None:
        self._client = client
        self._step = 0
        self.info = info

    async def __aenter__(self) -> AsyncHandles:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def step(
        self, actions: npt.ArrayLike, *, rows: Sequence[int] = (), restart: Sequence[int] = (),
        outputs: Sequence[t.OutputName] = ("objects",), encoding: t.EncodingName = "f32",
    ) -> t.HandlesStep:
        """Steps rows (all by default) by actions `[rows, A]`; rows in `restart` go back to their start before."""
        call = core.step_handles(self.info.id, self._step, actions, rows, restart, outputs, encoding)
        answer = await self._client._call(call)
        self._step = answer.step
        return answer

    async def close(self) -> None:
        """Gives the rows back."""
        await self._client._call(core.close_handles(self.info.id))
