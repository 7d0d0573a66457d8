"""Generates `gatsbi_client/_proto` from the proto files. Run it after changing them: `python generate.py`."""

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


def generate(target: Path) -> None:
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


if __name__ == "__main__":
    generate(HERE / "gatsbi_client" / "_proto")
