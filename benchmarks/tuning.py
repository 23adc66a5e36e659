"""The same search for every peer: so many evaluations, on the same clips, by the same loss."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

Parameters = dict[str, float]


@dataclass(frozen=True)
class Tuned:
    """Result of a parameter search.

    Attributes:
        parameters: of the least loss.
        tried: every point, with its figures.
    """

    parameters: Parameters
    tried: list[dict[str, float]]


def loss(figures: Mapping[str, float]) -> float:
    """What tuning minimises: position error, mm, and acceleration error, mm/frame², added."""
    return figures["position_mm"] + figures["acceleration_mm"]


def search(
    space: Mapping[str, tuple[float, float]], evaluate: Callable[[Parameters], dict[str, float]], budget: int
) -> Tuned:
    """Two thirds of the budget evenly over the space (Sobol), the rest in a quarter of its width around the best.

    Args:
        space: lowest and highest of each parameter; logarithms are searched.
        evaluate: parameters to figures, with ``position_mm`` and ``acceleration_mm`` among them.
        budget: how often it is called. Without parameters, once.
    """
    if not space:
        return Tuned({}, [evaluate({})])
    tried: list[dict[str, float]] = []
    best: Parameters = {}
    low, high = np.log(np.array(list(space.values()))).T
    wide = budget - budget // 3
    for centre, width, count in (((low + high) / 2, high - low, wide), (None, (high - low) / 4, budget - wide)):
        middle = np.log(list(best.values())) if centre is None else centre
        for point in _points(np.maximum(middle - width / 2, low), np.minimum(middle + width / 2, high), count):
            parameters = {name: float(f"{value:.4g}") for name, value in zip(space, np.exp(point), strict=True)}
            tried.append({**parameters, **evaluate(parameters)})
        winner = min(tried, key=loss)
        best = {name: winner[name] for name in space}
    return Tuned(best, tried)


def _points(low: np.ndarray, high: np.ndarray, count: int) -> Iterator[np.ndarray]:
    sampler = qmc.Sobol(len(low), scramble=True, rng=0)
    yield from low + sampler.random_base2(int(np.ceil(np.log2(max(count, 1)))))[:count] * (high - low)
