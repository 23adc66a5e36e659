"""What the stages of the prior hand to each other: the last frames of every body, in preallocated rings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import REST_OFFSETS
from steadypose.prior.timing.fixed_lag import Smoothed
from steadypose.prior.timing.ring import Ring

if TYPE_CHECKING:
    from steadypose.prior.clean.reconstruct import Encoded


@dataclass(frozen=True)
class Estimate:
    """The prior's answer for one moment and every slot, in world-aligned coordinates.

    Attributes:
        stamp_s: the moment, seconds.
        positions: (S, 22, 3) metres; NaN for a body of which nothing is known.
        rotations: (S, 22, 3, 3) local.
        offsets: (S, 22, 3) metres, the bones on which these rotations have these positions.
        sigma: (S, 22) metres, standard deviation along an axis.
        state: (S, 22) `JointState`.
    """

    stamp_s: float
    positions: NDArray[np.float64]
    rotations: NDArray[np.float64]
    offsets: NDArray[np.float64]
    sigma: NDArray[np.float64]
    state: NDArray[np.uint8]


class Imputed(NamedTuple):
    """The last frames of every body as HG-VAE completes them, the newest last.

    Attributes:
        positions: (K, S, 22, 3) metres; NaN for a body of which nothing is hidden.
        sigma: (K, S, 22) metres, standard deviation along an axis.
    """

    positions: NDArray[np.float64]
    sigma: NDArray[np.float64]


class Window:
    """The last T frames of S bodies in world-aligned coordinates (z up); the newest is the last.

    Attributes:
        stamp_s: ring of capture times, seconds.
        raw: ring of (S, 22, 3) metres, the canonical joints that came in; NaN where unobserved.
        confidence: ring of (S, 22) in 0..1.
        positions: ring of (S, 22, 3) metres after gate and correction; NaN where unobserved or refused.
        sensor_position: (3,) metres, where the sensor stands.
        noise: (S,) metres along an axis, how much each body's joints jump about from frame to frame.
        stuck: (S, 22) joints of which the sensor repeats its last answer.
        smoothed: the fixed-lag smoother's estimate of the frame ``delay`` before the newest, or None while there is
            none.
        rotations: ring of (S, 22, 3, 3) local, solved from the positions.
        encoded: what HG-VAE makes of the windows of the bodies present; None if there is no body or no such stage.
        anomaly: (S,) how unlike human motion the last half second is (`prior.clean.score`); NaN if not scored.
        anomaly_flag: (S,) whether it is too much so.
        joint_anomaly: (S, 22) the same joint by joint; NaN where not seen.
        imputed: the last frames as HG-VAE completes them, or None while there is no such stage.
        present: (S,) which slots hold a body.
        offsets: (S, 22, 3) metres, each person's bones.
        length_variance: (S, 22) metres^2, of each bone, still to be learned away; 0 of a generic adult's.
        measured: (S,) whether these are the person's own, not yet those of a generic adult.
        decoded: (D, S, 22, 3, 3) local rotations of the last frames, from the refinement model.
        out: the estimate of the frame ``delay`` before the newest, or None while there is none.
    """

    def __init__(self, frames: int, slots: int, decoded_frames: int | None = None) -> None:
        self.slots = slots
        self.stamp_s = Ring(frames, ())
        self.raw = Ring(frames, (slots, 22, 3))
        self.confidence = Ring(frames, (slots, 22), fill=0.0)
        self.positions = Ring(frames, (slots, 22, 3))
        self.rotations = Ring(frames, (slots, 22, 3, 3))
        self.sensor_position = np.zeros(3)
        self.noise = np.zeros(slots)
        self.stuck = np.zeros((slots, 22), dtype=bool)
        self.smoothed: Smoothed | None = None
        self.encoded: Encoded | None = None
        self.anomaly = np.full(slots, np.nan)
        self.anomaly_flag = np.zeros(slots, dtype=bool)
        self.joint_anomaly = np.full((slots, 22), np.nan)
        self.imputed: Imputed | None = None
        self.present = np.zeros(slots, dtype=bool)
        self.offsets = np.tile(REST_OFFSETS, (slots, 1, 1))
        self.length_variance = np.zeros((slots, 22))
        self.measured = np.zeros(slots, dtype=bool)
        self.decoded = np.broadcast_to(np.eye(3), (decoded_frames or frames, slots, 22, 3, 3)).copy()
        self.out: Estimate | None = None

    def clear(self, slot: NDArray[np.bool_]) -> None:
        """Forget what these slots (S,) held."""
        for ring in (self.raw, self.confidence, self.positions, self.rotations):
            ring.clear(slot)
        self.present &= ~slot
        self.measured &= ~slot
        self.anomaly_flag &= ~slot
        self.noise[slot] = 0.0
        self.offsets[slot] = REST_OFFSETS
        self.length_variance[slot] = 0.0
        self.decoded[:, slot] = np.eye(3)


class Stage(Protocol):
    """One step of the prior. A stage keeps its state by slot, and reads and writes the window."""

    delay_frames: int
    """How many later frames it needs."""

    def update(self, window: Window) -> Window:
        """Work on the newest frame; return the window."""
        ...

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Forget the bodies in these slots (S,)."""
        ...
