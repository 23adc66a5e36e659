"""The stages of the prior in order, for one time step of all bodies together, one slot a body."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.clean.correct import Correct
from steadypose.prior.clean.denoise import Denoise
from steadypose.prior.clean.frame import CleanFrame, Gated, Imputed, Observation, Person, Score, SensorNoise
from steadypose.prior.clean.fuse import Fuse
from steadypose.prior.clean.gate import Gate
from steadypose.prior.clean.history import History
from steadypose.prior.clean.impute import Impute
from steadypose.prior.clean.orient import Orient
from steadypose.prior.clean.person import PersonEstimator
from steadypose.prior.clean.reconstruct import Reconstruct
from steadypose.prior.clean.refine import Refine
from steadypose.prior.clean.score import Scorer
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.clean.slow_error import SlowError, SlowErrorEstimator
from steadypose.prior.clean.smooth import Smooth
from steadypose.prior.timing.fixed_lag import Smoothed
from steadypose.prior.timing.rate import FPS

IDLE_S = 3.0
"""Seconds without a body after which only stamps are kept, in a twentieth of the time: every stage is then as it was
before the first body."""

SPOILED_S = 0.5
"""Seconds that a body may be seen without a publishable estimate, before its state, which then contains NaN, is
reset."""


@dataclass(frozen=True)
class _Newest:
    """Results of the newest frame, for it and for those still to be answered.

    Attributes:
        gated: the frame.
        present: (S,) which slots hold a body.
        person: their bones.
        slow_error: of the sensor, as estimated by then.
        rotations: (K, S, 22, 3, 3) local, of the last frames.
        score: of the newest frame.
        imputed: the last frames, completed; None without that stage.
    """

    gated: Gated
    present: Bools
    person: Person
    slow_error: SlowError
    rotations: Floats
    score: Score
    imputed: Imputed | None


class CleanCore:
    """From observations to clean frames, ``settings.delay`` later. Each stage keeps its own state, by slot.

    Nothing here reads a clock or draws a random number: the same input gives the same output, bit for bit.

    Args:
        settings: of the prior.
        counters: gets numbers of joints and frames refused or skipped, by cause.

    Attributes:
        fuse: the last stage.
        sensor_noise: latest estimate of the sensor's error, the median over the bodies present.
    """

    def __init__(self, settings: PriorSettings, counters: Counter[str]) -> None:
        slots, delay, noise = settings.max_bodies, settings.delay, settings.noise
        denoise, score, impute = settings.denoise.enabled, settings.score.enabled, settings.impute.enabled
        self._slots, self._delay, self._counters = slots, delay, counters
        self._silent = np.zeros(slots, dtype=np.int64)
        self._bias_sigma = noise.bias_sigma
        self._refine = Refine(settings.refine, delay, slots)
        self._gate = Gate(settings.gate, slots, counters)
        self._correct = Correct(settings.correct, slots) if settings.correct.sensor else None
        self._smooth = Smooth(settings.smooth, delay, slots)
        self._reconstruct = Reconstruct(settings.encode, noise, slots) if denoise or score or impute else None
        self._denoise = Denoise(delay, slots) if denoise else None
        self._slow_error = SlowErrorEstimator(noise.bias_sigma, slots)
        self._person = PersonEstimator(settings.bones, slots)
        self._score = Scorer(settings.score, settings.encode.weights, slots) if score else None
        self._impute = Impute(settings.impute, delay, slots, counters) if impute else None
        self.fuse = Fuse(settings.fuse, slots)
        self._orient = Orient(settings.orient, slots) if settings.orient.enabled else None
        self._history = History(max(delay + 1, self._reconstruct.frames if self._reconstruct else 0), slots)
        self._newest: _Newest | None = None
        self._nobody = 0  # frames in a row without a body
        self._last: CleanFrame | None = None
        self.sensor_noise: SensorNoise | None = None

    def step(self, observation: Observation, *, hurry: bool = False) -> CleanFrame | None:
        """Take in a frame of the grid; returns the output for the one ``delay`` before, or None while there is none.

        In a hurry, hidden joints are imputed without gradient ascent: for a live node that falls behind.
        """
        self._nobody = 0 if observation.present.any() else self._nobody + 1
        if self._last and self._nobody > IDLE_S * FPS:
            stamp_s = self._smooth.skip(observation.stamp_s)
            return replace(self._last, estimate=replace(self._last.estimate, stamp_s=stamp_s))
        self._last = self._answered(observation, hurry=hurry)
        return self._last

    def _answered(self, observation: Observation, *, hurry: bool) -> CleanFrame | None:
        """As `step`, through all stages."""
        # of the frame before: all that is fed back
        person, bias_sigma, present = self._person.current, self._slow_error.bias_sigma, observation.present
        gated = self._gate.update(observation)
        if self._correct:
            gated = self._correct.update(gated)
        self._history.append(gated)
        smoothed = self._smooth.update(gated)
        windows = None
        if self._reconstruct:
            windows = self._reconstruct.update(self._history, present, person, bias_sigma)
        if self._denoise:
            self._denoise.update(windows, self._history)
        denoised = None if smoothed is None else self._denoised(smoothed, gated, self._delay)
        slow_error = self._slow_error.update(denoised, person.offsets, gated.jitter)
        person = self._person.update(denoised, slow_error.bias_sigma, present)
        score = Score.unscored(self._slots)
        if self._score:
            # bones do not show all of a sensor's slow error: at least the expected one is assumed, lest it be a fault
            bias = np.maximum(slow_error.bias_sigma, self._bias_sigma)
            score = self._score.update(windows, gated.frozen, np.hypot(gated.jitter, bias))
        imputed = self._impute.update(windows, gated.jitter, hurry=hurry) if self._impute else None
        rotations = self._refine.update(gated, person)
        if present.any():
            sigmas = gated.jitter[present], slow_error.bias_sigma[present]
            self.sensor_noise = SensorNoise(*(float(np.median(sigma)) for sigma in sigmas))
        self._newest = newest = _Newest(gated, present, person, slow_error, rotations, score, imputed)
        return None if denoised is None else self._answer(denoised, newest, self._delay)

    def flush(self) -> list[CleanFrame]:
        """The output for the frames that the delay still holds, oldest first."""
        newest, self._newest = self._newest, None
        self._nobody, self._last = 0, None
        if newest is None:
            return []
        held = self._smooth.flush()
        return [
            self._answer(self._denoised(smoothed, newest.gated, back), newest, back)
            for back, smoothed in zip(reversed(range(len(held))), held, strict=True)
        ]

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        steps = (
            self._gate, self._correct, self._history, self._smooth, self._denoise, self._slow_error,
            self._person, self._score, self._impute, self._refine, self.fuse,
            self._orient,
        )  # fmt: skip
        for step in steps:
            if step is not None:
                step.forget(slot)
        if self._newest is not None:
            self._newest = replace(self._newest, present=self._newest.present & ~slot)

    def note_answered(self, frame: CleanFrame, answered: Collection[int]) -> None:
        """Reset bodies that have been seen for `SPOILED_S` without a publishable estimate.

        Args:
            frame: as returned by `step`.
            answered: slots of the bodies that were published.
        """
        silent: Bools = np.asarray(np.isfinite(frame.observed).any(axis=(1, 2)))
        silent[list(answered)] = False
        self._silent = np.where(silent, self._silent + 1, 0)
        spoiled = self._silent > SPOILED_S * FPS
        if spoiled.any():
            self._counters["body_begun_anew"] += int(spoiled.sum())
            self._silent[spoiled] = 0
            self.forget(spoiled)

    def _denoised(self, smoothed: Smoothed, gated: Gated, back: int) -> Smoothed:
        """The smoother's estimate of the frame ``back`` before the newest, denoised if that stage is on."""
        return self._denoise.denoised(smoothed, self._history, gated.jitter, back) if self._denoise else smoothed

    def _answer(self, denoised: Smoothed, newest: _Newest, back: int) -> CleanFrame:
        """The output for the frame ``back`` before the newest."""
        at, imputed = -1 - back, newest.imputed
        estimate = self.fuse.fuse(
            denoised,
            newest.person,
            newest.slow_error,
            newest.rotations[at],
            imputed and Imputed(imputed.positions[at], imputed.sigma[at]),
            self._history.unseen_s[at],
            self._history.seen_since(back),
            newest.present,
        )
        if self._orient:
            estimate = self._orient.update(estimate)
        return CleanFrame(estimate, newest.score, self._history.observed[at], self._history.confidence[at])
