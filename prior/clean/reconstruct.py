"""The stages reconstruct and denoise: HG-VAE reconstructs each body's window; observed joints are fused with the
result.

HG-VAE is trained to denoise windows and models nonlinear motion; the whole-body smoothers model only the linear part.
In noise of 1 cm it has almost no weight. Both estimates share most of their noise, so the fusion weights account for
correlated errors.
"""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import HIPS, J
from steadypose.prior.clean.frame import BodyWindows, Person
from steadypose.prior.clean.history import BRIEF_S, History
from steadypose.prior.clean.settings import ReconstructSettings
from steadypose.prior.compiled import njit
from steadypose.prior.models.hgvae.features import body_size, from_tracks, to_tracks
from steadypose.prior.models.hgvae.inference import LiveHGVAE
from steadypose.prior.timing.kalman import Smoothed
from steadypose.prior.timing.rate import FPS

MIN_CONFIDENCE = 0.1  # least confidence assigned to a joint that passed the gate

PATH_NOISE, LEAST_UNCERTAIN = 3.0, 1e-3
"""`noise_ratio` of the path in noise that is not time-correlated, and least uncertainty, of 1, that it is."""

MODEL_SIGMA = 0.005
"""Least standard deviation along an axis of HG-VAE's own error, excluding the sensor's noise, metres."""

NOISE_LEFT = 0.75
"""Variance that sensor noise causes in HG-VAE's reconstruction, relative to the variance in the smoother's estimate."""

MEMORY = 15
"""Length of the running mean of the squared distance between the two estimates, frames. It gives HG-VAE's own error."""

SUDDEN = 3.0
"""Factor over the running mean above which the current squared distance, divided by this factor, replaces it."""

LATE_S, LATE_NEWEST_S = 0.01, 0.03
"""Lag of HG-VAE behind a moving joint, seconds: at least `SETTLED` frames before the newest frame, and in the newest.
At 3 m/s this is 3 or 9 cm. When a motion begins, the running mean does not include it yet."""

SETTLED = 4  # distance from the newest frame at which a frame of the window has settled, frames

RENEWAL = 0.5
"""Weight of the newest window in the running mean of a frame's reconstructions. Successive windows disagree, and
without the mean this would be jitter."""

_BESIDE_PELVIS = np.array([*HIPS, J["spine1"]])


class Reconstruct:
    """Runs HG-VAE once per frame over the last frames of the bodies present."""

    def __init__(self, settings: ReconstructSettings, slots: int) -> None:
        self._model = LiveHGVAE.load(settings.weights, slots)
        self.frames = self._model.frames

    def update(
        self, history: History, present: Bools, person: Person, bias_sigma: Floats, correlated: Floats
    ) -> BodyWindows | None:
        """Reconstruct the windows of the bodies ``present`` (S,); None if there is none.

        ``bias_sigma`` (S,) metres along an axis is estimated from each body; ``correlated`` (S,) is the certainty that
        its noise is time-correlated, 0 to 1. The highest frequencies do not show such noise, so the path is low-passed.
        """
        slots = np.flatnonzero(present)
        if not len(slots):
            return None
        size = body_size(person.offsets[slots])
        noise_ratio = PATH_NOISE / np.maximum(1.0 - correlated[slots], LEAST_UNCERTAIN) ** 2
        tracks = to_tracks(history.positions[-self.frames :, slots].swapaxes(0, 1), size, noise_ratio)
        by_joint = np.clip(history.confidence[-self.frames :, slots], MIN_CONFIDENCE, 1.0)
        confidence = tracks.observed * np.repeat(by_joint.transpose(1, 2, 0), 3, axis=1)
        return BodyWindows(slots, tracks, size, self._model.reconstruct(tracks.x, confidence, bias_sigma[slots]))


class Denoise:
    """Moves the smoother's estimate of observed joints towards HG-VAE's reconstruction, ``delay_frames`` behind the
    newest frame."""

    def __init__(self, delay_frames: int, slots: int) -> None:
        self._apart = np.zeros((slots, 22))  # m², mean square of the distance between the two estimates along an axis
        self._frames = np.zeros((slots, 22))
        self._reconstructed = np.full((delay_frames + 1, slots, 22, 3), np.nan)
        self._before = np.full((slots, 22, 3), np.nan)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._reconstructed[:, slot] = np.nan
        self._before[slot] = np.nan
        self._apart[slot] = self._frames[slot] = 0.0

    def update(
        self,
        windows: BodyWindows | None,
        smoothed: Smoothed | None,
        history: History,
        jitter: Floats,
        bias_sigma: Floats,
    ) -> Smoothed | None:
        """Add HG-VAE's reconstruction of the newest windows, if any, and denoise the smoother's newest estimate,
        ``delay_frames`` before the newest frame, if any. ``jitter`` and ``bias_sigma`` (S,) metres along an axis are
        estimated from each body so far."""
        self._take(windows, history)
        if smoothed is None:
            return None
        return self._denoised(smoothed, history, jitter, bias_sigma, len(self._reconstructed) - 1)

    def flush(self, held: list[Smoothed], history: History, jitter: Floats, bias_sigma: Floats) -> list[Smoothed]:
        """Denoise the last estimates that the smoother held, oldest first."""
        backs = reversed(range(len(held)))
        return [self._denoised(one, history, jitter, bias_sigma, back) for one, back in zip(held, backs, strict=True)]

    def _take(self, windows: BodyWindows | None, history: History) -> None:
        self._reconstructed[:-1], self._reconstructed[-1] = self._reconstructed[1:], np.nan
        if windows is None:
            return
        slots, tracks = windows.slots, windows.tracks
        latest = from_tracks(windows.reconstruction.mean[..., -len(self._reconstructed) :], tracks, windows.size)
        _place_pelvis(latest, history.positions[:, slots].swapaxes(0, 1))
        latest = latest.swapaxes(0, 1)
        before = self._reconstructed[:, slots]
        # a window that ends in an unobserved frame is worse for earlier frames than the last window that does not
        seen = np.asarray(np.isfinite(history.positions[-1, slots, :, 0]).any(axis=1))
        renewed = np.where(seen[:, None, None], before + RENEWAL * (latest - before), before)
        self._reconstructed[:, slots] = np.where(np.isnan(before), latest, renewed)

    def _denoised(
        self, smoothed: Smoothed, history: History, jitter: Floats, bias_sigma: Floats, back: int
    ) -> Smoothed:
        """Denoise the smoother's estimate of the frame ``back`` frames before the newest.

        The weights minimise the variance of the fused estimate. HG-VAE's estimate has the share `NOISE_LEFT` of the
        smoother's noise variance, and an error of its own with two parts. The first part is the running mean of the
        squared distance between the two estimates, less the part that noise explains (innovation-based adaptation, as
        in adaptive Kalman filters: Mehra 1970). It lowers HG-VAE's weight in motion unlike its training data. The
        second part is HG-VAE's lag times the joint's speed. Of errors that last, a window shows the part that changes
        within it; in its newest frames HG-VAE follows them, so there only jitter counts as noise.
        """
        reconstructed = self._reconstructed[-1 - back]
        seen = np.isfinite(history.positions[-1 - back][..., 0])
        # also in a frame without any observation: otherwise the estimate would jump to the smoother's
        seen |= ~seen.any(axis=1, keepdims=True)
        # and between two observations that are close in time
        seen |= history.observed_since(back) & (history.unobserved_s[-1 - back] < BRIEF_S)
        late = np.interp(back, (0, SETTLED), (LATE_NEWEST_S, LATE_S)) * FPS
        noise = np.hypot(jitter, min(back / SETTLED, 1.0) * bias_sigma)
        positions, sigma = smoothed.positions.copy(), smoothed.sigma.copy()
        _denoise(positions, sigma, seen, reconstructed, noise, late, self._apart, self._frames, self._before)
        self._before = smoothed.positions
        return smoothed._replace(positions=positions, sigma=sigma)


@njit(cache=True)
def _denoise(positions, sigma, seen, reconstructed, noise, late, apart, frames, before):
    """Denoise the joints (S, 22, 3) that are ``seen`` (S, 22), and their deviations, in place: see `Denoise._denoised`.

    ``late`` is HG-VAE's lag in frames, ``apart`` and ``frames`` are the state of the running mean, and ``before`` is
    the smoother's estimate one frame earlier. ``noise`` (S,) is in metres along an axis.
    """
    moved = np.empty(3)
    for slot in range(len(positions)):
        for joint in range(positions.shape[1]):
            square = speed = 0.0
            for axis in range(3):
                moved[axis] = reconstructed[slot, joint, axis] - positions[slot, joint, axis]
                square += moved[axis] * moved[axis]
                step = positions[slot, joint, axis] - before[slot, joint, axis]
                speed += step * step if math.isfinite(step) else 0.0
            square /= 3.0
            if not (seen[slot, joint] and math.isfinite(square + sigma[slot, joint])):
                continue
            frames[slot, joint] += 1.0
            apart[slot, joint] += (square - apart[slot, joint]) / min(frames[slot, joint], MEMORY)
            gained = (1.0 - NOISE_LEFT) * min(sigma[slot, joint], noise[slot]) ** 2
            own = max(max(apart[slot, joint], square / SUDDEN) - gained, MODEL_SIGMA**2) + late**2 * (speed / 3.0)
            share = gained / (gained + own)
            for axis in range(3):
                positions[slot, joint, axis] += share * moved[axis]
            sigma[slot, joint] *= math.sqrt(1.0 - share * (1.0 - NOISE_LEFT))


@njit(cache=True)
def _place_pelvis(reconstructed, seen):
    """Replace the pelvis (B, K, 22, 3), in place, with the mean of hips and spine less their mean observed offsets.

    The pelvis's track is relative to the mean of the trunk's trajectory, the other tracks to the trajectory itself. No
    other joint therefore informs HG-VAE of the pelvis's noise. ``seen`` (B, T, 22, 3) are the observations.
    """
    joints = len(_BESIDE_PELVIS)
    lies, counts = np.empty((joints, 3)), np.empty(joints)
    for row in range(len(reconstructed)):
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
        for t in range(reconstructed.shape[1]):
            for axis in range(3):
                place = 0.0
                for k in range(joints):
                    if counts[k] > 0:
                        place += (reconstructed[row, t, _BESIDE_PELVIS[k], axis] + lies[k, axis] / counts[k]) / among
                reconstructed[row, t, 0, axis] = place
