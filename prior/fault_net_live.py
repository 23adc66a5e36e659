"""The fault network as the live node runs it: the same numbers as `FaultNet`, without torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prior.fault_net import OFF_SCALE, RECENT, ROUGH_SCALE, SENSOR_SCALE, FaultNet
from prior.graph import JOINT_NODES, SCALE
from prior.graph_program import Network, Program

Floats = NDArray[np.float64]


class LiveFaultNet:
    """A trained `FaultNet`, for one sensor.

    Args:
        model: whose weights are copied.
        sensor_sigma: metres along an axis, what the sensor may be off by.
        most: windows at once.
    """

    def __init__(self, model: FaultNet, sensor_sigma: float, most: int) -> None:
        p, frames = Program(), model.config.frames
        self._mean = model.mean.double().numpy()[:, None]
        self._told = p.matrix(JOINT_NODES, 4 * frames + 2)
        graph = p.trunk(self._told, model.read, model.blocks)
        self._odds = p.layer(graph, model.write)
        self._net = Network(p, most)
        self._net.matrix(self._told, slice(None))[..., -1] = np.log(sensor_sigma / SENSOR_SCALE)

    def __call__(self, x: Floats, found: Floats, sigma: Floats, observed: Floats) -> Floats:
        """(B, 22) logarithm of the odds that a joint is off; the arguments are those of `FaultNet`."""
        rows, frames = slice(0, len(x)), x.shape[-1]
        told = self._net.matrix(self._told, rows)
        seen = observed > 0
        off = np.where(seen, x - found, 0.0).astype(np.float32) / np.float32(OFF_SCALE)
        told[..., :frames] = np.where(seen, (x - self._mean) / SCALE, 0.0)
        told[..., frames : 2 * frames] = np.copysign(np.log(np.abs(off) + np.sqrt(off * off + np.float32(1))), off)
        told[..., 2 * frames : 3 * frames] = np.log(sigma.astype(np.float32) / np.float32(OFF_SCALE))
        told[..., 3 * frames : 4 * frames] = seen
        told[..., 4 * frames] = _roughness(np.where(seen, x, found)[..., -RECENT - 2 :], seen[..., -RECENT - 2 :])
        self._net.run(self._net.steps, rows)
        return self._net.matrix(self._odds, rows)[..., 0].astype(np.float64)


def _roughness(x: Floats, seen: NDArray[np.bool_]) -> Floats:
    """(B, 66) how much the last frames of tracks (B, 66, RECENT + 2) shake, where seen; see `FaultNet`."""
    shown = seen[..., 2:] & seen[..., 1:-1] & seen[..., :-2]
    shaken = (np.diff(x, n=2, axis=-1) ** 2 * shown).sum(axis=-1) / np.maximum(shown.sum(axis=-1), 1)
    return 0.5 * np.log(shaken / ROUGH_SCALE**2 + 1e-3)
