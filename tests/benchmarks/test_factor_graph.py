"""gtsam's smoother beside the same problem solved at once, and a foot that stands under a hidden root."""

import numpy as np
import pytest

from steadypose.prior.world.filter import JITTER_SHARE
from steadypose.prior.world.kalman import BodyNoise

pytest.importorskip("gtsam", reason="gtsam has no wheels for Python 3.10")
from steadypose.benchmarks.baselines.factor_graph import FactorGraph, Told

DT = 1 / 30.0
NOISE = BodyNoise(acceleration_at_speed=0.0, slip_at_speed=0.0, network_memory_s=0.2)


def frames(rng: np.random.Generator, count: int, seen: int) -> list[Told]:
    """A body that the network has at 0.3 m/s, over four feet of which two stand; its root hidden after ``seen``."""
    rest = np.array([1.0, 0.0, 0.9, 0.0])
    return [
        Told(
            rng.normal(0, 0.02, 3) if t < seen else None, 0.02, rng.normal(0.3, 0.2, 3), np.array([0.2, 0.2, 0.3]),
            rng.normal(0, 0.02, (4, 3)), np.full(4, 0.02), rest, rest,
        )
        for t in range(count)
    ]  # fmt: skip


def at_once(told: list[Told]) -> tuple[np.ndarray, np.ndarray]:
    """(3,) metres and (3,) m², the last root and its variance, of one least-squares problem along each axis."""
    place, variance, size = np.empty(3), np.empty(3), 7  # a frame: x, v, network's error, four feet
    for axis in range(3):
        rows, values = [], []

        def add(terms: dict[int, float], value: float, sigma: float, rows=rows, values=values) -> None:
            row = np.zeros(size * len(told))
            row[list(terms)] = list(terms.values())
            rows.append(row / sigma)
            values.append(value / sigma)

        for part, sigma in enumerate((1e3, NOISE.first_speed, 1.0)):
            add({part: 1.0}, 0.0, sigma)
        for t, frame in enumerate(told):
            x, v, e = size * t, size * t + 1, size * t + 2
            if t:
                # white-noise acceleration: the step's error, and that of the speed given it
                q, px, pv, left = NOISE.acceleration**2, x - size, v - size, np.exp(-DT / 0.2)
                add({x: 1, px: -1, pv: -DT}, 0, np.sqrt(q * DT**3 / 3))
                add({v: 1, pv: 0.5, x: -1.5 / DT, px: 1.5 / DT}, 0, np.sqrt(q * DT / 4))
                add({e: 1, e - size: -left}, 0, np.sqrt(1 - left**2))
                for k, rest in enumerate(frame.rest):
                    walk = NOISE.rest**rest * NOISE.swing ** (1 - rest)
                    add({x + 3 + k: 1, px + 3 + k: -1}, 0, walk * np.sqrt(DT))
            if frame.root is not None:
                add({x: 1}, frame.root[axis], frame.root_sigma)
            said = frame.velocity_sigma[axis]
            add({v: 1, e: np.sqrt(1 - JITTER_SHARE**2) * said}, frame.velocity[axis], JITTER_SHARE * said)
            for k in range(4):
                add({x + 3 + k: 1, x: -1}, frame.feet[k, axis], frame.feet_sigma[k])
        a = np.stack(rows)
        covariance = np.linalg.inv(a.T @ a)
        place[axis], variance[axis] = (covariance @ a.T @ np.array(values))[-size], covariance[-size, -size]
    return place, variance


@pytest.mark.parametrize("lag", [20, 4])
def test_is_least_squares_whatever_the_lag(lag: int) -> None:
    told = frames(np.random.default_rng(0), 12, 7)
    graph = FactorGraph(NOISE, lag)
    for t, frame in enumerate(told):
        body, covariance, _ = graph.update(frame, DT)
        place, variance = at_once(told[: t + 1])
        np.testing.assert_allclose(body[:3], place, atol=1e-6)
        np.testing.assert_allclose(np.diag(covariance)[:3], variance, rtol=1e-5)


def test_a_standing_foot_holds_a_hidden_root() -> None:
    """The network has it at 0.3 m/s: a metre off after 100 frames, but for the feet that stand."""

    def off(rest: float) -> float:
        graph, rng, body = FactorGraph(BodyNoise()), np.random.default_rng(1), np.zeros(9)
        for told in frames(rng, 100, 10):
            body, _, _ = graph.update(told._replace(load=np.full(4, rest), rest=np.full(4, rest)), DT)
        return float(np.linalg.norm(body[:2]))

    assert off(1.0) < 0.1 < 0.5 < off(0.0)
