"""Steps of the twin on one thread: its side in `cargo xtask bench`.

It takes turns with the Rust model (`tests/load/engine/steps.rs`), so it works only when it is told to: each line
`CHECKPOINT BATCH STEP SECONDS` on standard input has a step (`observe`, `imagine` or `train`) repeated for so long, at least
once, and is answered by how often it was made; whoever asks looks at the processor time meanwhile. Steps are made as
in serving: evaluation mode, no gradients, no priors, new objects looked for in every frame, nothing drawn; `train` is the
loss of a short sequence and its gradients. Noise is drawn beforehand. Weights and images are channels-last unless `--contiguous`. Nothing is folded, fused or precomputed:
this is the model as one would write it in PyTorch. With `--compile` imagined steps go through `torch.compile`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import torch

from . import checkpoint, losses, noise

SEQUENCE = 4
"""Frames of a sequence that is trained on."""

SIGMA = 0.1
"""Standard deviation of the image likelihood."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--contiguous", action="store_true", help="weights and images channel by channel")
    parser.add_argument("--compile", action="store_true", help="imagined steps under torch.compile")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_num_interop_threads(1)
    for line in sys.stdin:
        path, batch, step, seconds = line.split()
        memory_format = torch.contiguous_format if arguments.contiguous else torch.channels_last
        if step == "train":
            job = training_of(Path(path), int(batch), memory_format)
        else:
            job = batch_of(Path(path), int(batch), memory_format, arguments.compile)[step]
        print(repeat(job, float(seconds)), flush=True)


@cache
@torch.inference_mode()
def batch_of(
    path: Path, batch: int, memory_format: torch.memory_format, compiled: bool
) -> dict[str, Callable[[], object]]:
    """The steps of a batch that has observed one frame and, to be warm, imagined one step."""
    model = checkpoint.load(path).model.to(memory_format=memory_format)
    config, generator = model.config, torch.Generator().manual_seed(0)
    frame = torch.rand(batch, 3, config.image_size, config.image_size, generator=generator)
    frame = frame.to(memory_format=memory_format)
    action = torch.randn(batch, config.action.dim, generator=generator)
    draws = noise.sample(config, batch, generator)
    state, _ = model.observe(model.initial_state(batch), frame, action, draws)
    imagine = torch.compile(model.imagine, dynamic=False) if compiled else model.imagine
    imagine(state, action, draws)
    return {
        "observe": torch.inference_mode()(lambda: model.observe(state, frame, action, draws)),
        "imagine": torch.inference_mode()(lambda: imagine(state, action, draws)),
    }


@cache
def training_of(path: Path, batch: int, memory_format: torch.memory_format) -> Callable[[], object]:
    """The loss of a batch of sequences and its gradients."""
    model = checkpoint.load(path).model.to(memory_format=memory_format)
    model.train()
    config, generator = model.config, torch.Generator().manual_seed(0)
    size = config.image_size
    frames = [torch.rand(batch, 3, size, size, generator=generator) for _ in range(SEQUENCE)]
    frames = [frame.to(memory_format=memory_format) for frame in frames]
    action = torch.randn(batch, config.action.dim, generator=generator)
    draws = [noise.sample(config, batch, generator) for _ in range(SEQUENCE)]

    def train() -> None:
        model.zero_grad()
        state, total = model.initial_state(batch), torch.zeros(batch)
        for frame, drawn in zip(frames, draws, strict=True):
            before = state
            state, step = model.observe(before, frame, action, drawn, priors=True)
            mixture, image = step.mixture, model.render(state).over(step.mixture.mu_mix)
            total = total - losses.gaussian_log_likelihood(frame, image, SIGMA)
            total = total + losses.latent_kl(mixture.masks.raw, mixture.mask_prior)
            total = total + losses.latent_kl(mixture.comps.raw, mixture.comp_prior)
            total = total + sum(step.objects.kl.values())
            total = total + losses.residual_norm(mixture, before.step == 0)
        total.mean().backward()

    return train


def repeat(job: Callable[[], object], seconds: float) -> int:
    """Runs a job as often as there is time for, at least once; returns how often."""
    began, made = time.perf_counter(), 0
    while made == 0 or time.perf_counter() - began < seconds:
        job()
        made += 1
    return made


if __name__ == "__main__":
    main()
