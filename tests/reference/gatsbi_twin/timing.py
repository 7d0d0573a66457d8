"""Time of one step: `python -m gatsbi_twin.timing CHECKPOINT [--batch 1 8 64] [--threads 1 2]`.

Steps are made as in serving: evaluation mode, no gradients, no priors, new objects looked for in every frame,
weights and images channels-last unless `--contiguous`. Prints the least and the median time in milliseconds of an
observed step, an imagined step, and drawing the image of a state. Nothing is folded, fused or precomputed: this is
the model as one would write it in PyTorch.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

from . import checkpoint, noise
from .model import Gatsbi


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoints", nargs="+", type=Path)
    parser.add_argument("--batch", nargs="+", type=int, default=[1, 8, 64])
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--seconds", type=float, default=3.0, help="time spent on each number")
    parser.add_argument("--contiguous", action="store_true", help="weights and images in rows of channels")
    options = parser.parse_args()
    print(f"{'checkpoint':<12} {'threads':>7} {'batch':>5}  {'observe':>15}  {'imagine':>15}  {'draw':>15}")
    for path in options.checkpoints:
        model = checkpoint.load(path).model
        if not options.contiguous:
            model = model.to(memory_format=torch.channels_last)
        for threads in options.threads:
            torch.set_num_threads(threads)
            for batch in options.batch:
                columns = [f"{low:6.1f} / {mid:6.1f}" for low, mid in measure(model, batch, options.seconds)]
                name = path.name.split(".")[0]
                print(f"{name:<12} {threads:>7} {batch:>5}  {'  '.join(columns)}", flush=True)


@torch.inference_mode()
def measure(model: Gatsbi, batch: int, seconds: float) -> list[tuple[float, float]]:
    """Least and median milliseconds of observing, imagining and drawing."""
    config, generator = model.config, torch.Generator().manual_seed(0)
    frame = torch.rand(batch, 3, config.image_size, config.image_size, generator=generator)
    frame = frame.to(memory_format=torch.channels_last)
    action = torch.randn(batch, config.action.dim, generator=generator)
    draws = noise.sample(config, batch, generator)
    state, step = model.observe(model.initial_state(batch), frame, action, draws)
    jobs = [
        lambda: model.observe(state, frame, action, draws),
        lambda: model.imagine(state, action, draws),
        lambda: model.render(state).over(step.mixture.mu_mix),
    ]
    return [clock(job, seconds) for job in jobs]


def clock(job: Callable[[], object], seconds: float) -> tuple[float, float]:
    """Least and median milliseconds of a job repeated for so long, but at least five times."""
    job()
    times: list[float] = []
    while sum(times) < seconds or len(times) < 5:
        start = time.perf_counter()
        job()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times), 1e3 * statistics.median(times)


if __name__ == "__main__":
    main()
