"""What schemathesis cannot know by itself: sessions that have seen something, lines of JSON, and what no schema says."""

import base64
import json
import math
import re
import struct
import urllib.request
import zlib

import schemathesis

# Of push1-tiny.
ACTIONS = 7
# Fields that a server refuses for a reason that JSON Schema has no words for.
BEYOND_SCHEMAS = {
    "how long a tensor's data is follows from its shape, and its shape from the model's actions or the image": (
        r"(actions|warm_start\.actions|masks\[\d+\]\.masks|.*\.(pixels|frames|actions))"
        r"(\.(shape|data(\[\d+\])?|values))?"
    ),
    "opaque bytes: a picture file": r"(observation\.)?image\.encoded",
    "opaque bytes: a snapshot": r"snapshot",
    "a number of each dimension of the model's actions": (
        r"(observation\.action|action_m(in|ax)|.*\.(weights|previous))(\[\d+\])?|hold"
    ),
    "an object that is in the scene": r".*\.object_id",
    "what the goal was put with": r".*\.goal_id",
    "what the operator allows": (
        r"ttl|keep_(steps|frames)|horizon|random|sampling\.samples|candidates|(.*\.)?(cem|mppi|random_shooting)\.candidates"
    ),
    "what must be more, or less, than another member": (
        r".*\.box\.(right|bottom)|action_repeat|outputs\.every_k|(icem\.)?cem\.elites"
    ),
    "as many as another member has entries": r"masks\[\d+\]\.object_ids",
    "each once": r"masks\[\d+\]\.part",
    "what the model has, or samples of which there are enough": r"outputs\.outputs\[\d+\]",
    "query parameters that exclude each other": r"random",
    "how much all of it comes to": r"outputs|costs|actions",
}
EXCUSED = re.compile("|".join(f"({pattern})" for pattern in BEYOND_SCHEMAS.values()))


def post(base, path, message, method="POST"):
    request = urllib.request.Request(
        base + path, json.dumps(message).encode(), {"Content-Type": "application/json"}, method=method)
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)


def png(side):
    """A grey image."""
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = (b"\0" + b"\x80" * (3 * side)) * side
    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


IMAGE = {"encoded": base64.b64encode(png(64)).decode()}


def open_session(base):
    """A session that has seen two frames and keeps steps."""
    session = post(base, "/v1/sessions", {"keep_steps": 4, "label": "seen"})["session"]["id"]
    for step in range(2):
        post(base, f"/v1/sessions/{session}/observations",
             {"observation": {"step": step, "image": IMAGE, "action": [0.0] * ACTIONS}})
    return session


def put_goal(base):
    return post(base, "/v1/goals", {"image": IMAGE}, method="PUT")["goal"]["id"]


class Seen:
    """The session and the goal that requests are led to; made anew now and then, because some requests delete them."""

    asked = 0

    @classmethod
    def get(cls, base):
        if cls.asked % 50 == 0:
            cls.session, cls.goal = open_session(base), put_goal(base)
        cls.asked += 1
        return cls.session


def mend(value, base):
    """Puts what fits the model in place of what no schema can say: pictures, snapshots, and numbers of a tensor."""
    if isinstance(value, list):
        return [mend(item, base) for item in value]
    if not isinstance(value, dict):
        return value
    if "dtype" in value:
        shape = {2: [3, ACTIONS], 3: [2, 3, ACTIONS]}.get(len(value.get("shape", [])))
        if value["dtype"] != "DATA_TYPE_F32" or shape is None:
            return value
        return {"dtype": value["dtype"], "shape": shape, "values": [0.25] * math.prod(shape)}
    mended = {name: mend(item, base) for name, item in value.items()}
    for name, good in (("action", [0.0] * ACTIONS), ("encoded", IMAGE["encoded"]), ("action_min", []),
                       ("action_max", []), ("horizon", 1), ("candidates", 4), ("iterations", 1), ("elites", 1),
                       ("keep_steps", 1), ("keep_frames", 1), ("at_step", None), ("goal_id", Seen.goal)):
        if mended.get(name) is not None:
            mended[name] = good
    if mended.get("snapshot") is not None:
        with urllib.request.urlopen(f"{base}/v1/sessions/{Seen.session}/snapshot", timeout=60) as answer:
            mended["snapshot"] = json.load(answer)["snapshot"]
    return mended


@schemathesis.hook
def before_call(context, case, kwargs):
    """Leads good requests to what is there, and makes every other one good for the model, too."""
    meta = case.meta
    if meta is None or not meta.generation.mode.is_positive:
        return
    base = case.operation.base_url.rstrip("/")
    session = Seen.get(base)
    if case.path == "/v1/goals/{id}":
        case.path_parameters["id"] = put_goal(base)
    elif "{id}" in case.path:
        case.path_parameters["id"] = open_session(base) if case.method == "DELETE" else session
    if "scale" in (case.query or {}):
        # Large pictures take a build without optimisation seconds.
        case.query["scale"] = min(int(case.query["scale"]), 4)
    before_call.count += 1
    if before_call.count % 2 and case.media_type == "application/json":
        case.body = mend(case.body, base)


before_call.count = 0


@schemathesis.hook
def filter_failure(context, failure, case, response):
    """Keeps what the API is to blame for."""
    kind = type(failure).__name__
    if kind == "RejectedPositiveData" and response.status_code == 400:
        problem = response.json()
        fields = problem.get("fields", [])
        return not (fields and all(EXCUSED.fullmatch(field["field"]) for field in fields))
    if kind == "AcceptedNegativeData" and case.path == "/v1/predictions" and response.status_code == 200:
        # Each prediction has an outcome of its own, which is told in its line.
        return not any("problem" in line for line in lines(response))
    # A media type without a schema, as that of protobuf, cannot be violated.
    return kind != "AcceptedNegativeData" or case.meta.phase.data.description != "Positive test case"


def lines(response):
    return [json.loads(line) for line in response.content.splitlines()]


@schemathesis.deserializer("application/x-ndjson")
def read_lines(context, response):
    return lines(response)


@schemathesis.serializer("application/x-ndjson")
def write_lines(context, value):
    items = value if isinstance(value, list) else [value]
    return "".join(json.dumps(item) + "\n" for item in items).encode()
