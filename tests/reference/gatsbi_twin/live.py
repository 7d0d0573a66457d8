"""Live agreement: `python -m gatsbi_twin.live [PRESET ...]`.

Makes untrained checkpoints of the presets through the Rust trainer, shakes what starts at zero or one (biases,
norm gains, running statistics) so that nothing that is left out goes unseen, records them with the twin into a
temporary folder, and runs the Rust comparison on it. Exits with the comparison's status.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from . import checkpoint, vectors
from .vectors import Case, Objective, Step

ROOT = Path(__file__).resolve().parents[3]
BEFORE_RELU = re.compile(r"(objects\.img_encoder\.enc|detector\.conv)\..*bias$")
PRESETS = ("tiny", "push1", "bair", "balls")

CASE = Case(
    steps=[
        Step("observe"),
        Step("observe", [True, False]),
        Step("imagine"),
        Step("skip"),
        Step("observe", noise="mean"),
        Step("imagine", noise="mean"),
    ],
    training=[Step("observe"), Step("observe", discover=False), Step("observe")],
    objective=Objective("gaussian", 0.1, 0.4),
    batch=2,
    seed=0,
    limit=20_011,
    gradient_limit=997,
)

CLEAR = 5e-5
"""Rounding, as `vectors.record` measures it, that leaves half of the tolerance to disagreement."""
ATTEMPTS = 6


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("presets", nargs="*", default=PRESETS, metavar="PRESET", help=", ".join(PRESETS))
    parser.add_argument("--out", type=Path, help="keep the files in this folder")
    parser.add_argument("--record-only", action="store_true", help="do not run the comparison")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        out: Path = options.out or Path(temporary)
        out.mkdir(parents=True, exist_ok=True)
        for preset in options.presets:
            weights = out / f"{preset}.checkpoint.safetensors"
            untrained(preset, weights)
            shake(weights)
            record(preset, weights, out / f"{preset}.vectors.safetensors")
        return 0 if options.record_only else compare(out)


def untrained(preset: str, path: Path) -> None:
    """Writes the untrained checkpoint of a preset."""
    command = ["cargo", "run", "--quiet", "--package", "gatsbi-training", "--", "init"]
    arguments = ["--preset", preset, "--seed", "1", "--out", str(path.resolve())]
    subprocess.run(command + arguments, cwd=ROOT, check=True)


def record(preset: str, weights: Path, file: Path) -> None:
    """Records inputs that keep clear of thresholds: of several draws the first that rounding hardly changes.

    If there is none the last is taken, and it is for the comparison to say whether it matters.
    """
    for seed in range(ATTEMPTS):
        rounding, worst = vectors.record(replace(CASE, seed=seed), weights, file)
        print(f"{preset}, draw {seed}: rounding up to {rounding:.1e} ({worst})", flush=True)
        if rounding < CLEAR:
            return


def shake(path: Path) -> None:
    """Adds noise to everything one-dimensional in a checkpoint.

    What the ReLUs of the image encoder and the detector see is lifted besides. Of half a million a few always
    lie so close to zero that rounding decides which gradient they pass, which was measured to change gradients
    by up to a tenth; the micro cases, which are small enough to have none there, test the ReLUs.
    """
    loaded = checkpoint.load(path)
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for name, tensor in loaded.named().items():
            if tensor.dim() == 1:
                noise = torch.randn(tensor.shape, generator=generator)
                if name.endswith("running_var"):
                    tensor.mul_((0.3 * noise).exp())
                else:
                    tensor.add_(0.1 * noise)
                if BEFORE_RELU.match(name):
                    tensor.add_(5)
    checkpoint.save(path, loaded.model, loaded.header)


def compare(folder: Path) -> int:
    """Runs the Rust comparison on the committed cases and those in `folder`."""
    command = ["cargo", "test", "--package", "gatsbi-models", "--test", "twin", "--", "--nocapture"]
    environment = os.environ | {"GATSBI_TWIN_DIR": str(folder.resolve())}
    return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
