"""Records the committed cases of the twin: `python record.py [--out FOLDER]`.

Every case is a micro model with random weights (so that nothing that is left out goes unseen), its checkpoint
`<case>.checkpoint.safetensors` with 16-bit numbers, and what the twin makes of it in
`<case>.vectors.safetensors`. The models differ in every switch of the configuration between them.
"""

from __future__ import annotations

import argparse
import copy
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gatsbi_twin import checkpoint, vectors
from gatsbi_twin.vectors import Case, Objective, Step

FOLDER = Path(__file__).resolve().parents[2] / "models" / "tests" / "twin"


def stage(factor: int, channels: int, groups: int) -> dict[str, int]:
    """One enlarging stage of a decoder."""
    return {"factor": factor, "channels": channels, "groups": groups}


SUB_PIXEL = {
    "kind": "sub_pixel",
    "inputs": 7,
    "base_side": 2,
    "base": 6,
    "stages": [stage(2, 6, 3), stage(2, 4, 2)],
}
BROADCAST = {"kind": "broadcast", "inputs": 7, "width": 16, "final_kernel": 3}

MODEL: dict[str, Any] = {
    "image_size": 16,
    "action": {"dim": 3, "hidden": 6, "enhanced": 5},
    "mixture": {
        "slots": 3,
        "z_mask": 4,
        "z_comp": 6,
        "hidden": 8,
        "mlp": 10,
        "mask_features": 6,
        "delta": 1.5,
        "comp_prior_action": False,
        "one_memory": False,
        "encoder": {"channels": [6, 8], "groups": [2, 4], "first_kernel": 5, "features": 9},
        "mask_decoder": {
            "inputs": 5,
            "base": 8,
            "base_groups": 2,
            "stages": [stage(4, 6, 3), stage(2, 4, 2)],
        },
        "comp_encoder": {"channels": [4, 8], "features": 7},
        "comp_decoder": SUB_PIXEL,
        "comp_norm": "batch",
        "init": "orthogonal",
    },
    "detector": {
        "keypoints": 4,
        "filters": 4,
        "convs_per_scale": 1,
        "gamma": {"kind": "centred", "steepness": 8.0},
    },
    "objects": {
        "grid": 4,
        "max_objects": 5,
        "z_what": 5,
        "z_dyna": 6,
        "hidden": 16,
        "glimpse": 8,
        "image_encoder": {"channels": [4, 6], "blocks": 1},
        "glimpse_encoder": {"channels": [4, 6, 8], "groups": [1, 2, 2]},
        "glimpse_decoder": {"channels": [8, 6], "groups": [4, 2]},
        "updates": {
            "proposal": [0.1, 0.3],
            "shift": 0.6,
            "scale": 0.3,
            "what": 0.2,
            "depth": 1.0,
            "environment": 0.25,
            "map_sigma": 0.1,
        },
        "prior": {
            "presence": 1e-10,
            "scale_mean": -1.5,
            "scale_std": 0.3,
            "shift_mean": 0.1,
            "shift_std": 1.0,
        },
        "rejection": 0.2,
        "aux_presence_kl": True,
        "graph": {"kind": "knn", "k": 3, "metric": "distance", "aggregate": "attention"},
        "interaction": {"kind": "inter3", "outputs": 7, "celu": False},
        "agent_history": "after",
        "agent_feature": "current",
    },
    "tracking": {
        "discovery": "every_frame",
        "presence": "hold",
        "ids": "monotone",
        "scale_bounds": [0.15, 0.6],
        "merge": None,
    },
}

ORIGINAL = {"discovery": "first_frame", "presence": "product", "ids": "original", "scale_bounds": None, "merge": None}
COLOURS = {"scale_bounds": [0.1, 0.25], "merge": 0.1, "unlike": 0.3, "handover": 0.9}

OBSERVE, MEAN = Step("observe"), Step("observe", noise="mean")
IMAGINE, SKIP = Step("imagine"), Step("skip")


def only(*rows: bool, noise: str = "sample") -> Step:
    """An observed step in which the rows marked true look for new objects."""
    return Step("observe", list(rows), noise)


def blind(noise: str = "sample") -> Step:
    """An observed step without discovery."""
    return Step("observe", False, noise)


@dataclass(frozen=True)
class Micro:
    """A micro model and what is recorded of it."""

    changes: dict[str, Any]
    """What differs from `MODEL`."""
    agent_slot: int | None
    batch: int
    steps: list[Step]
    training: list[Step]
    objective: Objective
    seed: int
    """Chosen so that no decision and no ReLU is close enough to its threshold for rounding to matter."""


CASES: dict[str, Micro] = {
    "serving": Micro(
        changes={"image_size": 32},
        agent_slot=0,
        batch=2,
        steps=[OBSERVE, OBSERVE, OBSERVE, IMAGINE, IMAGINE, SKIP, OBSERVE],
        training=[OBSERVE, OBSERVE, OBSERVE],
        objective=Objective("gaussian", 0.1),
        seed=15,
    ),
    "original": Micro(
        changes={
            "action": {"dim": 0},
            "mixture": {
                "slots": 2,
                "comp_norm": "group",
                "comp_encoder": {"channels": [8, 16]},
                "comp_decoder": BROADCAST,
            },
            "detector": None,
            "objects": {
                "grid": 2,
                "max_objects": 4,
                "graph": {"kind": "fully_connected"},
                "interaction": {"kind": "inter1"},
            },
            "tracking": ORIGINAL,
        },
        agent_slot=None,
        batch=2,
        steps=[
            only(True, True, noise="mean"),
            only(False, False, noise="mean"),
            blind("mean"),
            Step("imagine", noise="mean"),
        ],
        training=[OBSERVE, blind(), OBSERVE],
        objective=Objective("mixture", 0.5),
        seed=4,
    ),
    "local_agent": Micro(
        changes={
            "image_size": 32,
            "mixture": {
                "comp_prior_action": True,
                "comp_decoder": {**BROADCAST, "width": 8, "final_kernel": 1},
                "delta": 0.7,
            },
            "detector": {"gamma": {"kind": "printed"}, "convs_per_scale": 0},
            "objects": {
                "rejection": 0.02,
                "graph": {"kind": "knn", "k": 12, "metric": "weight", "aggregate": "sum"},
                "interaction": {"kind": "inter2", "outputs": 6, "celu": False},
                "agent_history": "before",
            },
            "tracking": {"ids": "original"},
        },
        agent_slot=1,
        batch=3,
        steps=[OBSERVE, only(True, False, True), only(False, True, True), IMAGINE, SKIP, MEAN],
        training=[OBSERVE, only(False, True, True), OBSERVE],
        objective=Objective("fixed_alpha", 0.1, 0.4),
        seed=34,
    ),
    "late_start": Micro(
        changes={
            "mixture": {
                "slots": 4,
                "one_memory": True,
                "comp_norm": "group",
                "mask_decoder": {"stages": [stage(4, 6, 3), stage(4, 4, 2)]},
                "comp_decoder": {**SUB_PIXEL, "stages": [stage(2, 6, 3), stage(4, 4, 2)]},
            },
            "detector": None,
            "objects": {
                "rejection": None,
                "aux_presence_kl": False,
                "image_encoder": {"channels": [4, 6], "blocks": 2},
                "graph": {"kind": "knn", "k": 9, "metric": "distance", "aggregate": "sum"},
                "interaction": {"kind": "inter2", "outputs": 7, "celu": True},
            },
            "tracking": {"scale_bounds": None, "presence": "product"},
        },
        agent_slot=2,
        batch=1,
        steps=[SKIP, OBSERVE, IMAGINE, OBSERVE, Step("imagine", noise="mean")],
        training=[OBSERVE, OBSERVE, OBSERVE],
        objective=Objective("gaussian", 0.1),
        seed=3,
    ),
    "attention": Micro(
        changes={
            "objects": {
                "graph": {"kind": "knn", "k": 3, "metric": "weight", "aggregate": "attention"},
                "interaction": {"kind": "inter3", "outputs": 7, "celu": True},
                "agent_history": "before",
                "agent_feature": "next",
            },
            "tracking": {"presence": "product", "merge": 0.3},
        },
        agent_slot=0,
        batch=2,
        steps=[MEAN, blind("mean"), OBSERVE, IMAGINE, SKIP, SKIP, OBSERVE, IMAGINE],
        training=[OBSERVE, OBSERVE, blind()],
        objective=Objective("mixture", 0.1),
        seed=0,
    ),
    "colours": Micro(
        changes={"objects": {"agent_feature": "next"}, "tracking": COLOURS},
        agent_slot=0,
        batch=3,
        steps=[OBSERVE, OBSERVE, OBSERVE, only(True, False, True), IMAGINE, OBSERVE, OBSERVE],
        training=[OBSERVE, OBSERVE, OBSERVE],
        objective=Objective("gaussian", 0.1),
        seed=0,
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=FOLDER, help="where the files go")
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    for name, micro in CASES.items():
        weights = out / f"{name}.checkpoint.safetensors"
        write_weights(weights, name, micro)
        case = Case(
            micro.steps,
            micro.training,
            micro.objective,
            micro.batch,
            micro.seed,
            limit=397,
            gradient_limit=24,
        )
        rounding, worst = vectors.record(case, weights, out / f"{name}.vectors.safetensors")
        print(f"{name}: rounding up to {rounding:.1e} ({worst})")


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """`base` with the fields of `changes`, objects field by field unless they are of another kind."""
    result = copy.deepcopy(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(result[key], dict)
        if both and value.get("kind") == result[key].get("kind"):
            result[key] = merged(result[key], value)
        else:
            result[key] = value
    return result


def write_weights(path: Path, name: str, micro: Micro) -> None:
    """Writes a checkpoint with random numbers everywhere, running statistics and norm gains included."""
    model, slot, seed = merged(MODEL, micro.changes), micro.agent_slot, micro.seed
    header = {
        "name": name,
        "model": model,
        "agent_slot": None if slot is None else {"index": slot, "score": None},
        "actions": [
            {"name": f"a{i}", "unit": "", "offset": 0.0, "scale": 1.0} for i in range(model["action"]["dim"])
        ],
        "preprocess": "stretch",
        "frame_period": None,
        "first_action": "neutral",
        "provenance": {"data": "", "seed": seed, "steps": 0, "preset": "", "notes": ""},
    }
    gatsbi = checkpoint.build(header)
    generator = torch.Generator().manual_seed(1000 + seed)
    with torch.no_grad():
        for key, tensor in checkpoint.named(gatsbi).items():
            numbers = torch.randn(tensor.shape, generator=generator)
            if key.endswith("running_var"):
                numbers = 1 + 0.5 * numbers.tanh()
            elif tensor.dim() == 1 and key.endswith("weight"):
                numbers = 1 + 0.3 * numbers  # gain of a norm
            elif tensor.dim() == 1:
                numbers = 0.2 * numbers
            elif key.endswith("weight"):
                inputs = tensor.shape[1] if key.startswith("mixture.memory") else tensor[0].numel()
                numbers = 0.8 * numbers / math.sqrt(max(inputs, 1))
            if key == "detector.output.weight":
                numbers = 6 * numbers  # sharp heatmaps, so that keypoints spread
            tensor.copy_(numbers)
        # One scale beyond the ceiling, so that it is seen.
        gatsbi.mixture.mask.post_head.layers[-1].bias[model["mixture"]["z_mask"]] = 12
    checkpoint.save(path, gatsbi, header, torch.float16)


if __name__ == "__main__":
    main()
