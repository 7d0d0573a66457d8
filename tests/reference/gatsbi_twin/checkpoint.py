"""Checkpoints: one safetensors file with the weights, its header as JSON in the metadata."""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import load_file
from safetensors.torch import save as serialize
from torch import Tensor

from .config import GatsbiConfig
from .model import Gatsbi

FORMAT_KEY = "gatsbi.checkpoint"
HEADER_KEY = "gatsbi.header"
VERSION = "1"

# Modules of the twin whose parameters carry other names in the file: those that G-SWM gave them.
RENAMED = {
    "objects.propagation.proposal.": "objects.pred_proposal.net.mod.",
    "objects.propagation.proposal_encoder.": "objects.proposal_encoder.",
    "objects.propagation.posterior.": "objects.latent_post_prop.",
    "objects.propagation.prior.": "objects.latent_prior_prop.",
    "objects.propagation.attributes.": "objects.pres_depth_where_what_prior.",
    "objects.discovery.image_encoder.": "objects.img_encoder.",
    "objects.discovery.map.": "objects.prop_map_mlp.",
    "objects.discovery.dyna_head.": "objects.latent_post_disc.",
    "objects.discovery.attribute_head.": "objects.pres_depth_where_what_latent_post_disc.",
    "objects.surroundings.": "objects.",
    "objects.decoder.": "objects.glimpse_decoder.",
}
for _which in ("post", "prior"):
    RENAMED |= {
        f"objects.{_which}.relation.own.": f"objects.prop_cond_self_{_which}.",
        f"objects.{_which}.relation.relational.": f"objects.prop_cond_relational_{_which}.",
        f"objects.{_which}.relation.weights.": f"objects.prop_cond_weights_{_which}.",
        f"objects.{_which}.input.": f"objects.temporal_rnn_{_which}_input.mod.",
        f"objects.{_which}.cell.": f"objects.temporal_rnn_{_which}.mod.",
        f"objects.{_which}.h_start": f"objects.h_init_{_which}",
        f"objects.{_which}.c_start": f"objects.c_init_{_which}",
    }


@dataclass
class Checkpoint:
    """A loaded checkpoint; the model is in evaluation mode."""

    model: Gatsbi
    header: dict[str, Any]

    def named(self) -> dict[str, Tensor]:
        """Parameters and running statistics by their names in the file, in name order."""
        return named(self.model)


def named(model: Gatsbi) -> dict[str, Tensor]:
    """Parameters and running statistics of a model by their names in the file, in name order."""
    tensors = {}
    for name, tensor in model.state_dict(keep_vars=True).items():
        # How many batches a batch norm has seen matters only without a momentum.
        if not name.endswith("num_batches_tracked"):
            tensors[_file_name(name)] = tensor
    return dict(sorted(tensors.items()))


def build(header: dict[str, Any]) -> Gatsbi:
    """The model that a header describes, in evaluation mode, its learned constants uninitialised."""
    slot = header["agent_slot"]
    config = GatsbiConfig.from_json(header["model"])
    with warnings.catch_warnings():
        # Without an agent an action has no dimensions.
        warnings.filterwarnings("ignore", "Initializing zero-element tensors")
        return Gatsbi(config, None if slot is None else slot["index"]).eval()


def load(path: Path) -> Checkpoint:
    """Reads a checkpoint; its tensors must be exactly those of the model that its header describes."""
    with safe_open(path, "pt") as file:
        header = json.loads(file.metadata()[HEADER_KEY])
    stored = load_file(path)
    model = build(header)
    wanted = named(model)
    if stored.keys() != wanted.keys():
        missing, unknown = sorted(wanted.keys() - stored.keys()), sorted(stored.keys() - wanted.keys())
        raise ValueError(f"{path}: missing {missing}, unknown {unknown}")
    with torch.no_grad():
        for name, tensor in wanted.items():
            if tensor.shape != stored[name].shape:
                raise ValueError(f"{path}: {name} is {list(stored[name].shape)}, not {list(tensor.shape)}")
            tensor.copy_(stored[name])
    return Checkpoint(model, header)


def save(path: Path, model: Gatsbi, header: dict[str, Any], dtype: torch.dtype = torch.float32) -> None:
    """Writes a checkpoint, its numbers as `dtype` (32-bit or 16-bit floats)."""
    tensors = {name: tensor.detach().to(dtype).contiguous() for name, tensor in named(model).items()}
    path.write_bytes(in_order(serialize(tensors, {FORMAT_KEY: VERSION, HEADER_KEY: json.dumps(header)})))


def in_order(file: bytes) -> bytes:
    """A safetensors file with its metadata in the order of the keys, so that equal contents are equal bytes."""
    start = 8 + int.from_bytes(file[:8], "little")
    contents = json.loads(file[8:start])
    contents["__metadata__"] = dict(sorted(contents["__metadata__"].items()))
    head = json.dumps(contents, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 8)
    return len(head).to_bytes(8, "little") + head + file[start:]


def _file_name(name: str) -> str:
    for ours, theirs in RENAMED.items():
        if name.startswith(ours):
            return theirs + name[len(ours) :]
    return name
