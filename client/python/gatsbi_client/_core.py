"""What both transports share: requests as data, parsing of answers, and the rule of repeating."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Any, Callable, Generic, Iterable, Iterator, Mapping, Sequence, TypeVar

import grpc
import numpy as np
import numpy.typing as npt

from gatsbi_client import errors
from gatsbi_client import types as t
from gatsbi_client._proto.gatsbi.v1 import (
    cost_pb2,
    goal_pb2,
    imagination_service_pb2 as im,
    model_service_pb2 as mo,
    output_pb2,
    planning_service_pb2 as pl,
    session_service_pb2 as se,
    step_pb2,
    tensor_pb2,
)

T = TypeVar("T")
Image = npt.NDArray[Any] | bytes

CHANNEL_OPTIONS: list[tuple[str, int]] = [
    ("grpc.max_receive_message_length", -1),
    ("grpc.max_send_message_length", -1),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 2000),
    # A connection that is gone without a word is noticed, also between two answers of a stream.
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 10_000),
]


@dataclass(frozen=True)
class Call(Generic[T]):
    """One call: where it goes, what it says, how its answer is read, and whether it may be made twice."""

    method: str
    request: Any
    answer: Any
    parse: Callable[[Any], T]
    repeatable: bool


@dataclass(frozen=True)
class Retries:
    """How often and how long a call is tried again."""

    attempts: int = 5
    """Tries in all, at least 1."""
    first_wait: float = 0.05
    """Seconds before the second try; doubled each time, with jitter. The server's hint goes before."""
    longest_wait: float = 2.0

    def wait(self, attempt: int, error: errors.GatsbiError, repeatable: bool) -> float | None:
        """Seconds to wait before the next try after `attempt` (from 1) failed; None: give up.

        What the server refused before doing anything may always be repeated; what may have been done, only where
        a second time changes nothing.
        """
        if attempt >= self.attempts:
            return None
        refused = error.reason in ("OVERLOADED", "STARTING", "SHUTTING_DOWN")
        lost = repeatable and isinstance(error, errors.Unavailable)
        if not (refused or lost):
            return None
        backoff = min(self.first_wait * 2 ** (attempt - 1), self.longest_wait) * random.uniform(0.5, 1.0)
        return float(max(backoff, error.retry_after or 0.0))


_DTYPES: dict[int, str] = {
    tensor_pb2.DATA_TYPE_U8: "u1",
    tensor_pb2.DATA_TYPE_F16: "<f2",
    tensor_pb2.DATA_TYPE_F32: "<f4",
    tensor_pb2.DATA_TYPE_I64: "<i8",
}
_ENCODINGS = {
    "f32": output_pb2.ENCODING_F32,
    "f16": output_pb2.ENCODING_F16,
    "u8": output_pb2.ENCODING_U8,
}


def floats(values: npt.ArrayLike) -> tensor_pb2.Tensor:
    """An F32 tensor."""
    array = np.ascontiguousarray(values, dtype="<f4")
    return tensor_pb2.Tensor(dtype=tensor_pb2.DATA_TYPE_F32, shape=array.shape, data=array.tobytes())


def array(tensor: tensor_pb2.Tensor) -> t.Array:
    """A tensor as an array, read-only."""
    return np.frombuffer(tensor.data, dtype=_DTYPES[tensor.dtype]).reshape(tuple(tensor.shape))


def picture(image: Image) -> tensor_pb2.Image:
    """An image: the bytes of a PNG, JPEG or WebP file, or `[H, W, 3]` uint8 or floats in [0, 1]."""
    if isinstance(image, bytes):
        return tensor_pb2.Image(encoded=image)
    if image.dtype == np.uint8:
        data = np.ascontiguousarray(image).tobytes()
        return tensor_pb2.Image(
            pixels=tensor_pb2.Tensor(dtype=tensor_pb2.DATA_TYPE_U8, shape=image.shape, data=data)
        )
    if np.issubdtype(image.dtype, np.floating):
        return tensor_pb2.Image(pixels=floats(image))
    raise TypeError(f"image has dtype {image.dtype}, expected uint8 or a float type")


def selection(
    outputs: Iterable[t.OutputName], encoding: t.EncodingName, every_k: int | None = None, last_only: bool = False
) -> output_pb2.OutputSelection:
    """Which outputs are wanted."""
    return output_pb2.OutputSelection(
        outputs=[output_pb2.Output.Name(output_pb2.Output.Value(f"OUTPUT_{name.upper()}")) for name in outputs],
        encoding=_ENCODINGS[encoding],
        every_k=every_k,
        last_only=last_only,
    )


def sampling(samples: int | None, seed: int | None) -> step_pb2.Sampling:
    """Means where no samples are asked for."""
    if samples is None:
        if seed is not None:
            raise ValueError("a seed is of use with samples only; give samples, or no seed")
        return step_pb2.Sampling(mode=step_pb2.MODE_MEAN)
    return step_pb2.Sampling(mode=step_pb2.MODE_SAMPLE, samples=samples, seed=seed)


def _outputs(values: Iterable[output_pb2.OutputValue]) -> dict[str, t.Array]:
    arrays: dict[str, t.Array] = {}
    for value in values:
        name = output_pb2.Output.Name(value.output).removeprefix("OUTPUT_").lower()
        if value.HasField("tracks"):
            arrays["object_ids"] = array(value.tracks.ids)
            arrays[name] = array(value.tracks.values)
        else:
            arrays[name] = array(value.tensor)
    return arrays


def _session(info: se.Session) -> t.SessionInfo:
    return t.SessionInfo(
        info.id, info.label, info.model, info.model_hash, info.next_step, info.seed, info.bytes,
        info.oldest_step if info.HasField("oldest_step") else None,
    )


def _model(model: mo.Model) -> t.Model:
    return t.Model(
        name=model.name, hash=model.hash, image_size=model.image_size,
        actions=tuple(t.ActionDimension(a.name, a.unit, a.offset, a.scale) for a in model.actions),
        slots=model.slots, agent_slot=model.agent_slot if model.HasField("agent_slot") else None,
        max_objects=model.max_objects, latents=model.latents, trained_steps=model.trained_steps,
        device=model.device, card=model.card, max_candidates=model.limits.max_candidates,
        max_horizon=model.limits.max_horizon, max_samples=model.limits.max_samples,
    )


def _belief(belief: step_pb2.Belief) -> t.Belief:
    objects = tuple(
        t.TrackedObject(o.id, o.slot, o.presence, o.x, o.y, o.width, o.height, o.depth, o.pixel_x, o.pixel_y)
        for o in belief.objects
    )
    return t.Belief(
        belief.session_id, belief.step, belief.model_hash, belief.predicted, belief.repeated,
        _outputs(belief.outputs), objects,
    )


def _chunk(chunk: im.RolloutChunk) -> t.Chunk:
    return t.Chunk(
        chunk.at_step, chunk.model_hash, chunk.seed, chunk.sample, chunk.first_candidate, chunk.candidates,
        tuple(chunk.depths), _outputs(chunk.outputs), chunk.last, chunk.over_samples,
    )


def gather(chunks: Sequence[t.Chunk]) -> t.Rollout:
    """A whole rollout from its chunks, in whatever order they came."""
    depths = tuple(sorted({depth for chunk in chunks for depth in chunk.depths}))
    place = {depth: index for index, depth in enumerate(depths)}
    samples = 1 + max(chunk.sample for chunk in chunks)
    candidates = max(chunk.first_candidate + chunk.candidates for chunk in chunks)
    outputs: dict[str, t.Array] = {}
    for chunk in chunks:
        rows = slice(chunk.first_candidate, chunk.first_candidate + chunk.candidates)
        columns = [place[depth] for depth in chunk.depths]
        for name, values in chunk.outputs.items():
            lead = (candidates, len(depths)) if chunk.over_samples else (samples, candidates, len(depths))
            if name not in outputs:
                outputs[name] = np.zeros(lead + values.shape[2:], dtype=values.dtype)
            target = outputs[name] if chunk.over_samples else outputs[name][chunk.sample]
            target[rows, columns] = values
    first = chunks[0]
    return t.Rollout(first.at_step, first.model_hash, first.seed, depths, outputs)


def list_models() -> Call[tuple[t.Model, ...]]:
    return Call("ModelService/ListModels", mo.ListModelsRequest(), mo.ListModelsResponse,
                lambda r: tuple(_model(m) for m in r.models), True)


def create(model: str, label: str, samples: bool, seed: int | None, keep_steps: int) -> Call[t.SessionInfo]:
    mode = step_pb2.MODE_SAMPLE if samples else step_pb2.MODE_MEAN
    request = se.CreateSessionRequest(model=model, label=label, mode=mode, seed=seed, keep_steps=keep_steps)
    return Call("SessionService/CreateSession", request, se.CreateSessionResponse,
                lambda r: _session(r.session), False)


def get(session: str) -> Call[t.SessionInfo]:
    return Call("SessionService/GetSession", se.GetSessionRequest(session_id=session), se.GetSessionResponse,
                lambda r: _session(r.session), True)


def list_sessions(label: str, page: str) -> Call[tuple[tuple[t.SessionInfo, ...], str]]:
    return Call("SessionService/ListSessions", se.ListSessionsRequest(label=label, page_token=page),
                se.ListSessionsResponse, lambda r: (tuple(_session(s) for s in r.sessions), r.next_page_token), True)


def delete(session: str) -> Call[None]:
    return Call("SessionService/DeleteSession", se.DeleteSessionRequest(session_id=session),
                se.DeleteSessionResponse, lambda r: None, False)


def observe(
    session: str, step: int, image: Image | None, action: npt.ArrayLike | None,
    outputs: Iterable[t.OutputName], encoding: t.EncodingName,
) -> Call[t.Belief]:
    request = se.ObserveRequest(
        session_id=session, observation=_observation(step, image, action), outputs=selection(outputs, encoding)
    )
    # Repeating an observation with the same number gets the stored answer.
    return Call("SessionService/Observe", request, se.ObserveResponse, lambda r: _belief(r.belief), True)


def observe_streamed(
    session: str, step: int, image: Image | None, action: npt.ArrayLike | None,
    outputs: Iterable[t.OutputName], encoding: t.EncodingName, timeout: float,
) -> Call[t.Belief]:
    request = se.ObserveStreamRequest(
        session_id=session, observation=_observation(step, image, action), outputs=selection(outputs, encoding),
        timeout_millis=max(1, round(timeout * 1e3)),
    )

    def parse(answer: se.ObserveStreamResponse) -> t.Belief:
        if answer.HasField("problem"):
            raise errors.from_problem(answer.problem)
        return _belief(answer.belief)

    return Call("SessionService/ObserveStream", request, se.ObserveStreamResponse, parse, True)


def _observation(step: int, image: Image | None, action: npt.ArrayLike | None) -> step_pb2.Observation:
    return step_pb2.Observation(
        step=step,
        image=None if image is None else picture(image),
        action=[] if action is None else np.asarray(action, dtype=np.float32).reshape(-1).tolist(),
    )


def fork(
    session: str, count: int, label: str | None, seed: int | None, at_step: int | None
) -> Call[tuple[t.SessionInfo, ...]]:
    request = se.ForkSessionRequest(session_id=session, count=count, label=label, seed=seed, at_step=at_step)
    return Call("SessionService/ForkSession", request, se.ForkSessionResponse,
                lambda r: tuple(_session(s) for s in r.sessions), False)


def rewind(session: str, to_step: int) -> Call[t.SessionInfo]:
    request = se.RewindSessionRequest(session_id=session, to_step=to_step)
    return Call("SessionService/RewindSession", request, se.RewindSessionResponse,
                lambda r: _session(r.session), False)


def export(session: str, at_step: int | None) -> Call[bytes]:
    return Call("SessionService/ExportSession", se.ExportSessionRequest(session_id=session, at_step=at_step),
                se.ExportSessionResponse, lambda r: bytes(r.snapshot), True)


def restore(snapshot: bytes, session: str, label: str, keep_steps: int) -> Call[t.SessionInfo]:
    request = se.ImportSessionRequest(snapshot=snapshot, session_id=session, label=label, keep_steps=keep_steps)
    return Call("SessionService/ImportSession", request, se.ImportSessionResponse,
                lambda r: _session(r.session), False)


def imagine(
    session: str, actions: npt.ArrayLike, outputs: Iterable[t.OutputName], encoding: t.EncodingName,
    samples: int | None, seed: int | None, every_k: int | None, last_only: bool, at_step: int | None,
) -> Call[t.Chunk]:
    request = im.ImagineRequest(
        session_id=session, at_step=at_step, actions=floats(actions), sampling=sampling(samples, seed),
        outputs=selection(outputs, encoding, every_k, last_only),
    )
    return Call("ImaginationService/Imagine", request, im.ImagineResponse, lambda r: _chunk(r.chunk), True)


def predictions(
    requests: Iterable[t.Prediction], outputs: Iterable[t.OutputName], encoding: t.EncodingName,
    every_k: int | None, last_only: bool,
) -> Call[t.PredictionPart]:
    chosen = selection(outputs, encoding, every_k, last_only)

    def messages() -> Iterator[im.PredictBatchRequest]:
        for each in requests:
            yield im.PredictBatchRequest(
                key=each.key, start=_start(each.start, each.at_step), actions=floats(each.actions),
                sampling=sampling(each.samples, each.seed), outputs=chosen,
            )

    def parse(answer: im.PredictBatchResponse) -> t.PredictionPart:
        if answer.HasField("problem"):
            return t.PredictionPart(answer.key, None, errors.from_problem(answer.problem))
        return t.PredictionPart(answer.key, _chunk(answer.chunk), None)

    return Call("ImaginationService/PredictBatch", messages(), im.PredictBatchResponse, parse, False)


def _start(start: str | bytes, at_step: int | None = None) -> im.Start:
    if isinstance(start, bytes):
        return im.Start(snapshot=start)
    return im.Start(session=im.SessionStart(session_id=start, at_step=at_step))


def open_handles(
    starts: Iterable[str | bytes], samples: int | None, seed: int | None, independent: bool
) -> Call[t.HandlesInfo]:
    drawn = sampling(samples, seed)
    drawn.independent_candidates = independent
    request = im.OpenHandlesRequest(starts=[_start(each) for each in starts], sampling=drawn)
    return Call("ImaginationService/OpenHandles", request, im.OpenHandlesResponse,
                lambda r: t.HandlesInfo(r.handles_id, r.rows, r.model_hash, r.seed), False)


def step_handles(
    handles: str, step: int, actions: npt.ArrayLike, rows: Iterable[int], restart: Iterable[int],
    outputs: Iterable[t.OutputName], encoding: t.EncodingName,
) -> Call[t.HandlesStep]:
    request = im.StepHandlesRequest(
        handles_id=handles, step=step, rows=list(rows), actions=floats(actions), restart=list(restart),
        outputs=selection(outputs, encoding),
    )
    return Call("ImaginationService/StepHandles", request, im.StepHandlesResponse,
                lambda r: t.HandlesStep(r.step, r.model_hash, _outputs(r.outputs)), True)


def close_handles(handles: str) -> Call[None]:
    return Call("ImaginationService/CloseHandles", im.CloseHandlesRequest(handles_id=handles),
                im.CloseHandlesResponse, lambda r: None, False)


def score(
    session: str, actions: npt.ArrayLike, costs: cost_pb2.CostProgram, samples: int | None, seed: int | None,
    by_sample: bool, by_term: bool, at_step: int | None,
) -> Call[t.Scores]:
    request = pl.ScoreRequest(
        session_id=session, at_step=at_step, actions=floats(actions), sampling=sampling(samples, seed), costs=costs,
        by_sample=by_sample, by_term=by_term,
    )

    def parse(r: pl.ScoreResponse) -> t.Scores:
        def optional(name: str) -> t.Floats | None:
            return array(getattr(r, name)) if r.HasField(name) else None

        return t.Scores(r.at_step, r.model_hash, r.seed, array(r.costs), optional("violations"),
                        optional("by_sample"), optional("by_term"), r.best)

    return Call("PlanningService/Score", request, pl.ScoreResponse, parse, True)


def plan(
    session: str, horizon: int, costs: cost_pb2.CostProgram, samples: int | None, seed: int | None,
    optimiser: t.Optimiser | None, action_min: Sequence[float],
    action_max: Sequence[float], warm_start: npt.ArrayLike | bool, budget: float | None,
    action_repeat: int, outputs: Sequence[t.OutputName], encoding: t.EncodingName, at_step: int | None,
) -> Call[t.Plan]:
    # A seed without samples drives the optimiser alone.
    drawn = step_pb2.Sampling(mode=step_pb2.MODE_MEAN, seed=seed) if samples is None else sampling(samples, seed)
    fields: dict[str, Any] = {}
    if optimiser is not None:
        names = {pl.RandomShooting: "random_shooting", pl.Cem: "cem", pl.Icem: "icem", pl.Mppi: "mppi"}
        fields[names[type(optimiser)]] = optimiser
    if warm_start is True:
        fields["warm_start"] = pl.WarmStart(previous=True)
    elif warm_start is not False:
        fields["warm_start"] = pl.WarmStart(actions=floats(warm_start))
    if budget is not None:
        fields["budget_millis"] = max(1, round(budget * 1e3))
    if outputs:
        fields["outputs"] = selection(outputs, encoding)
    request = pl.PlanRequest(
        session_id=session, at_step=at_step, horizon=horizon, costs=costs, sampling=drawn,
        action_min=action_min, action_max=action_max, action_repeat=action_repeat, **fields,
    )

    def parse(r: pl.PlanResponse) -> t.Plan:
        return t.Plan(
            r.at_step, r.model_hash, r.seed, array(r.actions), r.cost, r.violation, array(r.std),
            tuple(r.best_costs), r.iterations, r.candidates, r.stop == pl.STOP_REASON_BUDGET,
            _outputs(r.outputs), tuple(r.depths),
        )

    # A plan becomes the previous one of the next, so a repeated warm start would begin elsewhere.
    return Call("PlanningService/Plan", request, pl.PlanResponse, parse, warm_start is not True)


def put_goal(
    image: Image | None, masks: Mapping[t.PartName, t.Array], object_ids: Sequence[int], model: str, label: str
) -> Call[t.Goal]:
    goals = []
    for part, mask in masks.items():
        tensor = floats(mask) if mask.dtype != np.uint8 else tensor_pb2.Tensor(
            dtype=tensor_pb2.DATA_TYPE_U8, shape=mask.shape, data=np.ascontiguousarray(mask).tobytes()
        )
        ids = object_ids if part == "each_object" else ()
        goals.append(goal_pb2.MaskGoal(part=f"MASK_PART_{part.upper()}", masks=tensor, object_ids=ids))
    request = pl.PutGoalRequest(
        model=model, label=label, image=None if image is None else picture(image), masks=goals
    )
    return Call("PlanningService/PutGoal", request, pl.PutGoalResponse,
                lambda r: t.Goal(r.goal.id, r.goal.label, r.goal.model, r.goal.has_image), False)


def delete_goal(goal: str) -> Call[None]:
    return Call("PlanningService/DeleteGoal", pl.DeleteGoalRequest(goal_id=goal), pl.DeleteGoalResponse,
                lambda r: None, False)


def translate(error: Any) -> errors.GatsbiError:
    """The error behind a gRPC one; sync and asyncio errors have the same methods."""
    code = error.code() if isinstance(error.code(), grpc.StatusCode) else grpc.StatusCode.UNKNOWN
    return errors.from_status(code, error.details() or "", error.trailing_metadata())
