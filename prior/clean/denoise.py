"""The denoise stage: joints seen through noise go where HG-VAE has them, as far as the noise found says.

HG-VAE was taught to tell a window from its noise, and knows what a filter does not: which motions of one joint go with
those of the others. Behind the mixture it takes 13 % off the error in 4 cm of noise after four frames (24.5 to 21.4 mm,
validation motion at 1 to 2.5 times its speed: docs/experiments.md); where noise is millimetres it has no say. What both
are off by is mostly the same noise, so the best mean of them is not that of independent estimates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from steadypose.prior.body.skeleton import HIPS, J
from steadypose.prior.clean.frame import BodyWindows, Bools, Floats
from steadypose.prior.clean.history import History
from steadypose.prior.models.hgvae.features import from_tracks
from steadypose.prior.timing.fixed_lag import Smoothed
from steadypose.prior.timing.rate import FPS

MODEL_SIGMA = 0.005
"""Metres along an axis: what HG-VAE is off by at least, apart from noise."""

NOISE_LEFT = 0.59
"""Of the variance that noise gives to the smoother's answer, what it gives to HG-VAE's."""

MEMORY = 15
"""Frames over which HG-VAE earns its belief."""

SUDDEN = 3.0
"""Times the mean of its squared distance to what was smoothed, above which this very frame's counts."""

LATE_S, LATE_NEWEST_S = 0.01, 0.03
"""Seconds by which HG-VAE is behind a joint: of a frame that others have followed for `SETTLED`, and of the newest. A
joint at 3 m/s it has 3 or 9 cm from where it is; of one that has just begun, what it was off by of late says little."""

SETTLED = 4

RENEWAL = 0.5
"""How far a frame's answer goes to that of the next window: windows one frame apart disagree, which would be jitter."""

_BESIDE_PELVIS = np.array([*HIPS, J["spine1"]])


@dataclass(frozen=True)
class DenoiseSettings:
    """Whether to.

    Attributes:
        enabled: off, joints seen are where the smoother has them.
    """

    enabled: bool = True


class Denoise:
    """Moves the smoother's estimate of the joints seen towards what HG-VAE makes of them.

    Args:
        delay_frames: between the newest frame and the one that is answered.
        slots: bodies at most.
    """

    def __init__(self, delay_frames: int, slots: int) -> None:
        self._apart = np.zeros((slots, 22))  # m², mean square of the distance between the two along an axis
        self._frames = np.zeros((slots, 22))
        self._found = np.full((delay_frames + 1, slots, 22, 3), np.nan)
        self._before = np.full((slots, 22, 3), np.nan)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._found[:, slot] = np.nan
        self._before[slot] = np.nan
        self._apart[slot] = self._frames[slot] = 0.0

    def update(self, windows: BodyWindows | None, history: History) -> None:
        """Take in what HG-VAE makes of the newest windows."""
        self._found[:-1], self._found[-1] = self._found[1:], np.nan
        if windows is None:
            return
        slots, tracks = windows.slots, windows.tracks
        latest = from_tracks(windows.reconstruction.mean[..., -len(self._found) :], tracks, windows.size)
        _place_pelvis(latest, history.positions[:, slots].swapaxes(0, 1))
        latest = latest.swapaxes(0, 1)
        before = self._found[:, slots]
        # a window that ends in the dark tells less of what went before than the last one that did not
        seen = np.asarray(np.isfinite(history.positions[-1, slots, :, 0]).any(axis=1))
        renewed = np.where(seen[:, None, None], before + RENEWAL * (latest - before), before)
        self._found[:, slots] = np.where(np.isnan(before), latest, renewed)

    def denoised(self, smoothed: Smoothed, history: History, jitter: Floats, back: int) -> Smoothed:
        """The smoother's estimate of the frame ``back`` before the newest, denoised; frames are to be given in order.

        The weights are those of least variance for two estimates of which the second holds the share `NOISE_LEFT` of
        the first one's noise and an error of its own. That error is what its distance to the first one shows beyond
        noise, in this joint and of late (innovations, as in adaptive Kalman filters: Mehra 1970): motion that HG-VAE
        has never seen takes its belief away; and it is the later, the faster the joint. Noise is what jumps from frame
        to frame, ``jitter`` (S,) metres as of now: of an error that lasts, HG-VAE keeps all.
        """
        found = self._found[-1 - back]
        seen = np.isfinite(history.positions[-1 - back][..., 0])
        # in a frame that was lost whole, the answer must not jump to the smoother's
        seen |= ~seen.any(axis=1, keepdims=True)
        known = seen & np.isfinite(found[..., 0] + smoothed.sigma)
        moved = np.where(known[..., None], found - smoothed.positions, 0.0)
        square = np.square(moved).mean(axis=-1)
        self._frames += known
        self._apart += known * (square - self._apart) / np.clip(self._frames, 1, MEMORY)
        gained = (1.0 - NOISE_LEFT) * np.square(np.where(known, np.minimum(smoothed.sigma, jitter[:, None]), 0.0))
        own = np.maximum(np.maximum(self._apart, square / SUDDEN) - gained, MODEL_SIGMA**2)
        late_s = np.interp(back, (0, SETTLED), (LATE_NEWEST_S, LATE_S))
        step = np.nan_to_num(smoothed.positions - self._before)  # one frame
        own += (late_s * FPS) ** 2 * np.square(step).mean(axis=-1)
        self._before = smoothed.positions
        share = gained / (gained + own)
        return smoothed._replace(
            positions=smoothed.positions + share[..., None] * moved,
            sigma=smoothed.sigma * np.sqrt(1.0 - share * (1.0 - NOISE_LEFT)),
        )


@njit(cache=True)
def _place_pelvis(found, seen):
    """Move the pelvis to where it lay beside hips and spine, in place.

    The other joints' tracks are told about the trunk's path, the pelvis's about that path's mean, so no joint tells
    HG-VAE of the pelvis's noise: it leaves more of it than of any other's.

    Args:
        found: (B, K, 22, 3) metres, of the newest frames.
        seen: (B, T, 22, 3) metres, NaN where not.
    """
    joints = len(_BESIDE_PELVIS)
    lies, counts = np.empty((joints, 3)), np.empty(joints)
    for row in range(len(found)):
        among = 0
        for k in range(joints):
            joint, counts[k] = _BESIDE_PELVIS[k], 0.0
            for axis in range(3):
                lies[k, axis] = 0.0
            for t in range(seen.shape[1]):
                if math.isnan(seen[row, t, 0, 0] - seen[row, t, joint, 0]):
                    continue
                counts[k] += 1.0
                for axis in range(3):
                    lies[k, axis] += seen[row, t, 0, axis] - seen[row, t, joint, axis]
            if counts[k] > 0:
                among += 1
        if among == 0:
            continue
        for t in range(found.shape[1]):
            for axis in range(3):
                place = 0.0
                for k in range(joints):
                    if counts[k] > 0:
                        place += (found[row, t, _BESIDE_PELVIS[k], axis] + lies[k, axis] / counts[k]) / among
                found[row, t, 0, axis] = place
