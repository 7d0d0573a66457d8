"""Generates `gatsbi_client/_proto` from the proto files, and the blocking client from the asyncio one.

Run it after changing either: `python generate.py`. Generated messages run on the protobuf of their generator's major
version and on the next one, so the generator is an old one: grpcio-tools 1.76.0 makes what runs from 6.31.1 on.
"""

from __future__ import annotations

import re
import shutil
import sys
from importlib.resources import files
from pathlib import Path

from grpc_tools import protoc

HERE = Path(__file__).resolve().parent
SERVICE = HERE.parent.parent / "proto"
OWN = HERE / "proto"


def messages(target: Path) -> None:
    """Writes the generated package into `target`, replacing what was there."""
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    sources = [
        str(path.relative_to(root)) for root in (SERVICE, OWN) for path in sorted(root.rglob("*.proto"))
    ]
    includes = [f"-I{SERVICE}", f"-I{OWN}", f"-I{files('grpc_tools') / '_proto'}"]
    outputs = [f"--python_out={target}", f"--pyi_out={target}"]
    if protoc.main(["protoc", *includes, *outputs, *sources]) != 0:
        sys.exit("protoc failed")
    # Generated imports are absolute; the package lives inside ours.
    for path in [*target.rglob("*.py"), *target.rglob("*.pyi")]:
        text = re.sub(r"^from gatsbi\.", "from gatsbi_client._proto.gatsbi.", path.read_text(), flags=re.M)
        path.write_text(text)
    for folder in [target, *(path for path in target.rglob("*") if path.is_dir())]:
        (folder / "__init__.py").write_text("")


def blocking(asyncio_client: str) -> str:
    """The source of the blocking client."""
    text = asyncio_client
    for awaited, plain in [
        ("The asyncio client. `generate.py` makes the blocking one of it.", "The blocking client, made by `generate.py`."),
        ("import asyncio\n", "import queue\n"),
        ("asyncio.sleep", "time.sleep"),
        ("asyncio.Queue", "queue.Queue"),
        ("aiter(", "iter("),
        ("anext(", "next("),
        ("StopAsyncIteration", "StopIteration"),
        # Stubs demand the grace period, which the blocking channel does not know.
        (".close(None)", ".close()"),
        ("grpc.aio.", "grpc."),
        ("__aenter__", "__enter__"),
        ("__aexit__", "__exit__"),
    ]:
        text = text.replace(awaited, plain)
    text = re.sub(r"\basync (?=def|with|for)|\bawait ", "", text)
    return re.sub(r"\bAsync(?=[A-Z])", "", text)


def generate(target: Path) -> None:
    """Writes into `target` what is generated of the package."""
    messages(target / "_proto")
    (target / "_sync.py").write_text(blocking((HERE / "gatsbi_client" / "_aio.py").read_text()))


if __name__ == "__main__":
    generate(HERE / "gatsbi_client")
