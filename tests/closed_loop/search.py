"""The search that all planning arms share: iCEM (Pinneri et al. 2020) over displacements of the hand.

The service's own optimisers search in the model's actions, here seven joint velocities. A push lives in a plane, so
the hand's displacements, which the robot's controller turns into joint velocities, are the better space to search.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Callable

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Budget:
    """What a decision may cost: `iterations` times `candidates` futures of `horizon` steps."""

    horizon: int = 5
    candidates: int = 20
    iterations: int = 2

    @property
    def steps(self) -> int:
        """Model steps of a decision."""
        return self.horizon * self.candidates * self.iterations


class Icem:
    """One episode's search; it remembers the last plan and its elites."""

    elites, kept, momentum, beta = 5, 2, 0.1, 2.0

    def __init__(self, budget: Budget, reach: float, rng: np.random.Generator) -> None:
        """`reach`: largest displacement along an axis in one step, metres."""
        self.budget, self.reach, self._rng = budget, reach, rng
        self._mean = np.zeros((budget.horizon, 2))
        self._carried = np.empty((0, budget.horizon, 2))

    def plan(self, cost: Callable[[Array], Array]) -> Array:
        """The best displacements `[H, 2]` found; `cost` gives `[N]` for `[N, H, 2]`."""
        budget, std = self.budget, np.full((self.budget.horizon, 2), 0.7 * self.reach)
        mean, carried = self._mean, self._carried
        best, least = mean, np.inf
        for iteration in range(budget.iterations):
            drawn = mean + std * self.noise(budget.candidates - len(carried))
            tried = np.concatenate([carried, drawn])
            if iteration == budget.iterations - 1:
                tried[-1] = mean
            tried = tried.clip(-self.reach, self.reach)
            costs = cost(tried)
            order = np.argsort(costs, kind="stable")
            chosen = tried[order[: self.elites]]
            if costs[order[0]] < least:
                best, least = tried[order[0]], float(costs[order[0]])
            mean = self.momentum * mean + (1 - self.momentum) * chosen.mean(axis=0)
            std = self.momentum * std + (1 - self.momentum) * chosen.std(axis=0) + 0.05 * self.reach
            carried = chosen[: self.kept]
        self._mean, self._carried = _moved_on(best), _moved_on(carried)
        return best

    def noise(self, count: int) -> Array:
        """Coloured noise `[count, H, 2]` of unit variance: its power falls with frequency to the `beta`."""
        horizon = self.budget.horizon
        frequencies = np.fft.rfftfreq(horizon)
        frequencies[0] = 1 / horizon
        scale = frequencies ** (-self.beta / 2)
        shape = (count, 2, len(scale))
        spectrum = (self._rng.normal(size=shape) + 1j * self._rng.normal(size=shape)) * scale
        spectrum[..., 0] = spectrum[..., 0].real * np.sqrt(2)
        if horizon % 2 == 0:
            spectrum[..., -1] = spectrum[..., -1].real * np.sqrt(2)
        weights = np.full(len(scale), 2.0)
        weights[0] = 1.0
        if horizon % 2 == 0:
            weights[-1] = 1.0
        deviation = np.sqrt(2 * (weights * scale**2).sum()) / horizon
        return np.moveaxis(np.fft.irfft(spectrum, horizon) / deviation, 1, 2)


def _moved_on(plans: Array) -> Array:
    """Plans `[..., H, 2]` one step later; the last displacement is repeated."""
    return np.concatenate([plans[..., 1:, :], plans[..., -1:, :]], axis=-2)
