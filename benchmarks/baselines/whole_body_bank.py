"""A baseline without parameters to tune: the multiple-model estimate of smoothers of the whole body.

As `benchmarks.baselines.bank`, but of eight smoothers over modes of the whole body instead of joints: eigenvectors of
the covariance of joints' accelerations, learned once from other people's motion (`prior.models.mixture.tracks`). In
white noise it has 0.84 to 0.93 of that bank's error, whoever moves. The smoothers are the product's own
(`prior.models.mixture.bank`), and their weights in each mode the likelihood of the mode's innovations. The product
falls back to the same, but for an estimate of the noise that modes share where it is white.
"""

from __future__ import annotations

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.models.mixture.bank import (
    DENSITIES,
    EXPERTS,
    MEASUREMENT_SIGMA,
    MULTIPLE_MODEL,
    advance,
    new_bank,
)
from steadypose.prior.models.mixture.features import FEATURES, PARENT, describe
from steadypose.prior.models.mixture.tracks import body_covariance
from steadypose.prior.timing.rate import FPS


def whole_body_bank(seen: Floats, stamps_s: Floats, delay: int) -> Floats:
    """Each frame's estimate, given the measurements up to ``delay`` frames later (those there are, at the end).

    Args:
        seen: (T, ..., 22, 3) metres, canonical joints of a body, NaN where missing.
        stamps_s: (T,) seconds.
        delay: frames.

    Raises:
        ValueError: other joints; the compiled loops would write past the ends of their arrays.
    """
    if seen.shape[-2:] != (len(PARENT), 3):
        raise ValueError(f"expected (..., {len(PARENT)}, 3) canonical joints of a body, got {seen.shape}")
    frames = np.ascontiguousarray(seen.reshape(len(seen), -1, *seen.shape[-2:]))
    bodies, joints = frames.shape[1:3]
    bank, sure, answers = new_bank(bodies, delay), np.ones((bodies, joints)), np.full(frames.shape, np.nan)
    experts, features = np.empty((bodies, joints, EXPERTS, 3)), np.empty((bodies, joints, FEATURES), np.float32)
    unknown = np.zeros(bodies)  # of the noise, whether it is white
    scale, gap, between = np.empty(bodies), np.empty((bodies, joints)), np.empty((bodies, joints))

    def answer(count: int, back: int) -> None:
        describe(bank, count, back, PARENT, unknown, experts, features, scale, gap, between)
        answers[count - 1 - back] = experts[:, :, MULTIPLE_MODEL]

    for t, frame in enumerate(frames):
        step = stamps_s[t] - stamps_s[t - 1] if t else 1 / FPS
        advance(bank, t, step, frame, sure, DENSITIES, MEASUREMENT_SIGMA, body_covariance())
        if t >= delay:
            answer(t + 1, delay)
    for back in reversed(range(min(delay, len(frames)))):
        answer(len(frames), back)
    return answers.reshape(seen.shape)
