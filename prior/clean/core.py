"""Runs the stages of the prior in order: one time step of all bodies together, each body in its own slot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.clean.bones import BiasEstimator, PersonEstimator, SensorBias
from steadypose.prior.clean.frame import CleanFrame, Gated, Imputed, Observation, Person, Score, SensorNoise
from steadypose.prior.clean.fuse import Fuse
from steadypose.prior.clean.gate import Gate
from steadypose.prior.clean.history import History
from steadypose.prior.clean.impute import impute
from steadypose.prior.clean.occluded import Track
from steadypose.prior.clean.posture import Posture, mix
from steadypose.prior.clean.reconstruct import Denoise, Reconstruct
from steadypose.prior.clean.rotations import Orient, Refine
from steadypose.prior.clean.score import Scorer
from steadypose.prior.clean.sensor_error import Correct, DepthError
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.clean.steady import Steady
from steadypose.prior.models.mixture.inference import MixtureSmoother
from steadypose.prior.timing.kalman import Smoothed
from steadypose.prior.timing.rate import FPS

IDLE_S = 3.0
"""Time without a body after which only the stamps advance, seconds. This takes a twentieth of the time, and by then
every stage is in its initial state."""

UNPUBLISHED_S = 0.5
"""Longest time that a body may be observed without a publishable estimate, seconds. Its state then contains NaN and is
reset."""


class _Newest(NamedTuple):
    """Results of the newest frame, used for it and for the frames that are still to be published."""

    gated: Gated
    present: Bools  # (S,) which slots hold a body
    person: Person
    bias: SensorBias  # estimated up to this frame
    correlated: Floats  # (S,) certainty that the sensor's noise is time-correlated, 0 to 1
    correlated_sigma: Floats  # (S,) metres along an axis, the time-correlated part of the sensor's error
    omitted_sigma: Floats  # (S,) metres along an axis, the part of the sensor's error that the smoother omits
    rotations: Floats  # (K, S, 22, 3, 3) local, of the last frames
    score: Score
    imputed: Imputed | None  # the last frames, completed; None if no body is


class CleanCore:
    """Turns observations into clean frames, ``settings.delay`` frames later. Each stage keeps its own state, by slot.

    It reads no clock and draws no random number: the same input gives the same output, bit for bit. ``counts`` are of
    refused joints and skipped frames, by cause. ``fuse``, the stage before posture, is public because training records
    its candidates.
    """

    def __init__(self, settings: PriorSettings, counters: Counter[str]) -> None:
        slots, delay = settings.max_bodies, settings.delay
        denoise, score, impute = settings.denoise.enabled, settings.score.enabled, settings.impute.enabled
        self._delay, self._counters, self._bias_sigma = delay, counters, settings.bias_sigma
        self._refine = Refine(settings.refine, delay, slots)
        self._gate = Gate(settings.gate, slots, counters)
        self._correct = Correct(settings.correct, slots) if settings.correct.sensor else None
        self._smooth = MixtureSmoother(delay, slots, settings.smooth.weights)
        self._reconstruct = Reconstruct(settings.reconstruct, slots) if denoise or score or impute else None
        self._denoise = Denoise(delay, slots) if denoise else None
        self._bias = BiasEstimator(settings.bias_sigma, slots)
        self._depth_error = DepthError(slots)
        self._person = PersonEstimator(settings.person, slots)
        self._score = Scorer(settings.score, settings.reconstruct.weights, slots) if score else None
        self._imputes = impute
        self.fuse = Fuse(settings.fuse, slots)
        self._posture = Posture(settings.posture) if settings.posture.enabled else None
        self._steady = Steady(slots, delay) if settings.steady.enabled else None
        self._orient = Orient(settings.orient, slots) if settings.orient.enabled else None
        self._history = History(max(delay + 1, self._reconstruct.frames if self._reconstruct else 0), slots)
        stages = (
            self._gate, self._correct, self._history, self._smooth, self._denoise, self._bias, self._depth_error,
            self._person, self._score, self._refine, self.fuse, self._steady, self._orient,
        )  # fmt: skip
        self._stages = [stage for stage in stages if stage is not None]
        self._newest: _Newest | None = None
        self._unpublished = np.zeros(slots, dtype=np.int64)  # frames in a row
        self._nobody = 0  # frames in a row without a body
        self._last: CleanFrame | None = None
        self._noise: tuple[Floats, Floats] | None = None  # jitter and bias of the bodies present

    @property
    def sensor_noise(self) -> SensorNoise | None:
        """The latest estimate of the sensor's error: the median over the bodies present. None before the first body."""
        return self._noise and SensorNoise(*(float(np.median(sigma)) for sigma in self._noise))

    def step(self, observation: Observation) -> CleanFrame | None:
        """Process a frame of the grid; return the output for the frame ``delay`` earlier, or None if there is none."""
        self._nobody = 0 if observation.present.any() else self._nobody + 1
        if self._last and self._nobody > IDLE_S * FPS:
            stamp_s = self._smooth.skip(observation.stamp_s)
            return replace(self._last, estimate=replace(self._last.estimate, stamp_s=stamp_s))
        self._last = self._through_stages(observation)
        return self._last

    def _through_stages(self, observation: Observation) -> CleanFrame | None:
        # the previous frame's estimates: the only feedback between frames
        person, bias_sigma, present = self._person.current, self._bias.bias_sigma, observation.present
        gated = self._gate.update(observation)
        if self._correct:
            gated = self._correct.update(gated)
        self._history.append(gated)
        smoothed = self._smooth.update(gated.positions, observation.stamp_s, observation.confidence)
        windows = None
        if self._reconstruct:
            windows = self._reconstruct.update(self._history, present, person, bias_sigma, self._smooth.correlated)
        if self._denoise:
            correlated_sigma = (1.0 - self._smooth.white) * bias_sigma
            smoothed = self._denoise.update(windows, smoothed, self._history, gated.jitter, correlated_sigma)
        bias = self._bias.update(smoothed, person, gated.jitter)
        omitted_sigma = self._depth_error.update(smoothed, self._smooth.white)
        person = self._person.update(smoothed, bias.bias_sigma, present)
        score = Score.unscored(len(present))
        if self._score:
            # Bones show only part of the bias. Assume at least the expected bias, so that it is not flagged as a fault.
            sigma = np.hypot(gated.jitter, np.maximum(bias.bias_sigma, self._bias_sigma))
            score = self._score.update(windows, gated.faulty, sigma)
        imputed = impute(windows, gated.jitter, self._delay + 1) if self._imputes else None
        rotations = self._refine.update(gated, person)
        if present.any():
            self._noise = gated.jitter[present], bias.bias_sigma[present]
        correlated_sigma = (1.0 - self._smooth.white) * bias.bias_sigma
        self._newest = newest = _Newest(
            gated, present, person, bias, self._smooth.correlated, correlated_sigma, omitted_sigma, rotations, score,
            imputed,
        )  # fmt: skip
        return None if smoothed is None else self._fused(smoothed, newest, self._delay)

    def flush(self) -> list[CleanFrame]:
        """Return the output for the frames that the delay still holds, oldest first."""
        newest, self._newest = self._newest, None
        self._nobody, self._last = 0, None
        if newest is None:
            return []
        held = self._smooth.flush()
        if self._denoise:
            held = self._denoise.flush(held, self._history, newest.gated.jitter, newest.correlated_sigma)
        return [self._fused(smoothed, newest, len(held) - 1 - k) for k, smoothed in enumerate(held)]

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        for stage in self._stages:
            stage.forget(slot)
        self._unpublished[slot] = 0
        if self._newest is not None:
            self._newest = self._newest._replace(present=self._newest.present & ~slot)

    def note_published(self, frame: CleanFrame, published: Collection[int]) -> None:
        """Reset bodies that have been observed for `UNPUBLISHED_S` without a publishable estimate; ``published`` are
        the slots of the bodies in ``frame`` that were published."""
        missed: Bools = np.asarray(np.isfinite(frame.observed).any(axis=(1, 2)))
        missed[list(published)] = False
        self._unpublished = np.where(missed, self._unpublished + 1, 0)
        invalid = self._unpublished > UNPUBLISHED_S * FPS
        if invalid.any():
            self._counters["body_begun_anew"] += int(invalid.sum())
            self.forget(invalid)

    def _fused(self, smoothed: Smoothed, newest: _Newest, back: int) -> CleanFrame:
        """Return the output for the frame ``back`` frames before the newest."""
        at, imputed = -1 - back, newest.imputed
        sigma = np.hypot(smoothed.sigma, newest.gated.observation.layout_sigma)
        estimate = self.fuse.fuse(
            smoothed._replace(sigma=sigma),
            newest.person,
            newest.bias,
            newest.rotations[at],
            imputed and Imputed(imputed.positions[at], imputed.sigma[at]),
            self._history.unobserved_s[at],
            self._history.observed_since(back),
            newest.present,
            Track(self._history.positions, len(self._history.positions) - 1 - back, newest.gated.jitter),
        )
        if self._posture:
            noise = np.hypot(newest.gated.jitter, newest.correlated_sigma)
            estimate = self._posture.update(estimate, newest.bias.lengths, noise, newest.correlated)
        if self._steady:
            estimate = self._steady.update(estimate, smoothed.step, self._history.positions[at], newest.correlated)
        estimate = replace(estimate, sigma=np.hypot(estimate.sigma, newest.omitted_sigma[:, None]))
        mixed = mix(estimate, self._history.unobserved_s[at])
        if self._orient:
            oriented = self._orient.update(replace(mixed, sigma=estimate.sigma))
            mixed = replace(mixed, rotations=oriented.rotations)
        return CleanFrame(mixed, newest.score, self._history.observed[at], self._history.confidence[at])
