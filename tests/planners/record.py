"""Records what public planners do on test functions, for `server/src/planning/search/reference.rs` to compare with.

mbrl-lib's CEM and iCEM and pytorch-mppi's MPPI, as they are published. Two things are recorded:

- `updates`: iteration by iteration what was sampled, what it cost, and the distribution before and after. The same
  samples must lead our search to the same distribution.
- `qualities`: the least cost that a whole search found, over many seeds. Ours draws other numbers, so the two samples
  are compared as distributions.

Run it where `.ci/adapters mppi mbrl` has put the libraries:

    cd .venv-adapters && PYTHONPATH=mbrl:mppi:torch python3 ../tests/planners/record.py > ../server/tests/planners/reference.json
"""

from __future__ import annotations

import json
import sys
from importlib.metadata import version
from typing import Any, Callable
from unittest import mock

import numpy as np
import torch
from mbrl.planning.trajectory_opt import CEMOptimizer, ICEMOptimizer
from pytorch_mppi import MPPI

Cost = Callable[[torch.Tensor], torch.Tensor]
SEEDS = 100


def sphere(x: torch.Tensor) -> torch.Tensor:
    """Least at 0.4 in every dimension."""
    return ((x - 0.4) ** 2).sum(dim=(1, 2))


def rosenbrock(x: torch.Tensor) -> torch.Tensor:
    """The curved valley over all dimensions in a row, least at 1."""
    x = x.flatten(1)
    return (100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1 - x[:, :-1]) ** 2).sum(dim=1)


def double_integrator(x: torch.Tensor) -> torch.Tensor:
    """A mass that should come to rest at 0, and whose forces cost."""
    place, speed = torch.ones(len(x)), torch.zeros(len(x))
    cost = torch.zeros(len(x))
    for force in x[:, :, 0].T:
        speed = speed + 0.3 * force
        place = place + 0.3 * speed
        cost = cost + place**2 + 0.1 * speed**2 + 0.05 * force**2
    return cost


# Name, function, steps, dimensions, limits.
FUNCTIONS: list[tuple[str, Cost, int, int, float, float]] = [
    ("sphere", sphere, 3, 2, -1.0, 3.0),
    ("rosenbrock", rosenbrock, 2, 2, -2.0, 2.0),
    ("double_integrator", double_integrator, 12, 1, -1.0, 1.0),
]


def cem(steps: int, width: int, low: float, high: float, **sizes: Any) -> CEMOptimizer:
    limits = [[[limit] * width] * steps for limit in (low, high)]
    return CEMOptimizer(
        lower_bound=limits[0], upper_bound=limits[1], device=torch.device("cpu"), clipped_normal=True, **sizes)


def icem(steps: int, width: int, low: float, high: float, **sizes: Any) -> ICEMOptimizer:
    limits = [[[limit] * width] * steps for limit in (low, high)]
    return ICEMOptimizer(
        lower_bound=limits[0], upper_bound=limits[1], device=torch.device("cpu"), colored_noise_exponent=2.0,
        population_decay_factor=1.25, keep_elite_frac=0.3, **sizes)


def mppi(cost: Cost, steps: int, width: int, low: float, high: float, samples: int, sigma: float, lambda_: float) -> MPPI:
    """Planned from a single state; a rollout's cost is that of its actions together, taken at its last step."""
    taken: list[torch.Tensor] = []

    def running_cost(_: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        taken.append(action)
        if len(taken) < steps:
            return torch.zeros(len(action))
        together = torch.stack(taken, dim=1)
        taken.clear()
        return cost(together)

    return MPPI(
        lambda state, _: state, running_cost, nx=1, noise_sigma=torch.eye(width) * sigma**2, num_samples=samples,
        horizon=steps, device="cpu", lambda_=lambda_, u_min=torch.full((width,), low), u_max=torch.full((width,), high),
        U_init=torch.full((steps, width), (low + high) / 2))


def numbers(tensor: torch.Tensor) -> list[float]:
    # As short as a 32-bit float is known by.
    return [float(np.format_float_positional(x, unique=True)) for x in tensor.detach().numpy().astype(np.float32).ravel()]


def fits(optimiser: Any, cost: Cost, start: torch.Tensor) -> list[dict[str, Any]]:
    """What an optimiser of mbrl-lib makes of its samples."""
    iterations: list[dict[str, Any]] = []
    fitted: dict[str, list[torch.Tensor]] = {"mean": [], "spread": []}

    def seen(population: torch.Tensor, values: torch.Tensor, _: int) -> None:
        iterations.append({"count": len(population), "samples": numbers(population), "costs": numbers(-values)})

    # The distribution is known to the optimiser alone, so what it fits is caught where it is fitted.
    def caught(kind: str, of: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
        def fit(*args: Any, **kwargs: Any) -> torch.Tensor:
            fitted[kind].append(of(*args, **kwargs))
            return fitted[kind][-1]

        return fit

    is_cem = isinstance(optimiser, CEMOptimizer)
    spread = torch.std if is_cem else torch.var
    with mock.patch.object(torch, "mean", caught("mean", torch.mean)), \
            mock.patch.object(torch, spread.__name__, caught("spread", spread)):
        optimiser.optimize(lambda x: -cost(x), x0=start, callback=seen)
    spreads = fitted["spread"] if is_cem else [variance.sqrt() for variance in fitted["spread"]]
    mean, std = start, torch.ones_like(start) if is_cem else optimiser.initial_var.sqrt()
    for iteration, fitted_mean, fitted_std in zip(iterations, fitted["mean"], spreads, strict=True):
        # A momentum mixes both alike (iCEM's mixes variances; it is recorded without momentum).
        next_mean, next_std = ((1 - optimiser.alpha) * new + optimiser.alpha * old
                               for old, new in ((mean, fitted_mean), (std, fitted_std)))
        iteration |= {"mean_before": numbers(mean), "mean": numbers(next_mean),
                      "std_before": numbers(std), "std": numbers(next_std)}
        mean, std = next_mean, next_std
    return iterations


def updates() -> list[dict[str, Any]]:
    recorded = []
    for name, cost, steps, width, low, high in FUNCTIONS:
        start = torch.full((steps, width), (low + high) / 2)
        space = {"function": name, "steps": steps, "width": width, "low": low, "high": high}
        sizes = dict(num_iterations=4, elite_ratio=0.25, population_size=24)
        for alpha in (0.0, 0.2):
            torch.manual_seed(7)
            found = fits(cem(steps, width, low, high, alpha=alpha, **sizes), cost, start)
            recorded.append(space | {"optimiser": "cem", "momentum": alpha, "elites": 6, "iterations": found})
        torch.manual_seed(7)
        found = fits(icem(steps, width, low, high, alpha=0.0, **sizes), cost, start)
        recorded.append(space | {"optimiser": "icem", "momentum": 0.0, "elites": 6, "iterations": found})
        torch.manual_seed(7)
        optimiser = mppi(cost, steps, width, low, high, samples=24, sigma=0.3 * (high - low) / 2, lambda_=0.7)
        found = []
        for _ in range(4):
            before = optimiser.U.clone()
            optimiser.command(torch.zeros(1), shift_nominal_trajectory=False)
            found.append({"count": 24, "samples": numbers(optimiser.perturbed_action), "costs": numbers(optimiser.cost_total),
                          "mean_before": numbers(before), "mean": numbers(optimiser.U)})
        recorded.append(space | {"optimiser": "mppi", "lambda": 0.7, "iterations": found})
    return recorded


def qualities() -> list[dict[str, Any]]:
    recorded = []
    for name, cost, steps, width, low, high in FUNCTIONS:
        start = torch.full((steps, width), (low + high) / 2)
        half = (high - low) / 2
        space = {"function": name, "steps": steps, "width": width, "low": low, "high": high}
        for optimiser in ("cem", "icem", "mppi"):
            least = []
            for seed in range(SEEDS):
                torch.manual_seed(seed)
                best = [np.inf]
                keep = lambda values: best.append(min(best[-1], float(values.min())))
                if optimiser == "mppi":
                    search = mppi(cost, steps, width, low, high, samples=200, sigma=0.3 * half, lambda_=0.1)
                    for _ in range(10):
                        search.command(torch.zeros(1), shift_nominal_trajectory=False)
                        keep(cost(search.perturbed_action))
                    keep(cost(search.U[None]))
                else:
                    make = cem if optimiser == "cem" else icem
                    sizes = dict(num_iterations=8, elite_ratio=0.1, population_size=200, alpha=0.1)
                    make(steps, width, low, high, **sizes).optimize(
                        lambda x: -cost(x), x0=start, callback=lambda _, values, __: keep(-values))
                least.append(best[-1])
            recorded.append(space | {"optimiser": optimiser, "least": [float(f"{x:.6g}") for x in sorted(least)]})
    return recorded


def main() -> None:
    torch.set_num_threads(1)
    versions = {name: version(name).split("+")[0] for name in ("mbrl", "pytorch-mppi", "torch", "numpy")}
    json.dump({"versions": versions, "updates": updates(), "qualities": qualities()}, sys.stdout)
    print()


if __name__ == "__main__":
    main()
