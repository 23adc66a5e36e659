"""Known joints, smoothed, and the cubic spline through each of them, for short gaps."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import finite_joints, limbs
from steadypose.prior.complete.windows import frames_since_and_until
from steadypose.prior.models.mixture.inference import MixtureSmoother
from steadypose.prior.timing.rate import FPS

WHOLE, PART, LOWER_ARM = (0.5, 60.0), (0.8, 40.0), (0.8, 20.0)
"""Share of each joint's own cubic spline in short gaps, and length of gaps without it, frames: where no joint is known,
where others are, and for an elbow and a wrist if the shoulder is. The completer's errors accumulate along limbs, and
those of noisy joints count many times; but a spline overshoots where a wrist turns back."""

LAG, RUN = 8, 6
"""Number of later frames from which a known joint is smoothed, and of known frames in a row below which it is not: of
key frames apart, a smoother takes motion for noise."""


def smoothed(positions: Floats) -> Floats:
    """Return known joints (T, 22, 3) as the live smoother estimates them, which leaves noise-free ones unchanged."""
    smoother, known = MixtureSmoother(LAG, 1), finite_joints(positions)
    lagging = [
        smoother.update(frame[None], t / FPS, seen[None].astype(np.float64))
        for t, (frame, seen) in enumerate(zip(positions, known, strict=True))
    ]
    frames = [frame for frame in lagging if frame is not None] + smoother.flush()
    since, until = frames_since_and_until(np.pad(~known, ((1, 1), (0, 0)), constant_values=True))
    in_a_row = (since + until - 1.0)[1:-1]
    return np.where(
        (known & (in_a_row >= RUN))[..., None], np.concatenate([frame.positions for frame in frames]), positions
    )


def splines(smooth: Floats, known: Bools) -> tuple[Floats, Floats]:
    """Return the share (T, 22) of each joint's own cubic spline in its position, and the spline (T, 22, 3), metres."""
    since, until = frames_since_and_until(known)
    gap = np.where(known, np.inf, since + until - 1.0)
    curve = np.where(np.asarray(known.any(axis=1))[:, None, None], PART, np.broadcast_to(WHOLE, (*known.shape, 2)))
    for shoulder, *below in limbs(("shoulder", "elbow", "wrist")):
        curve[:, below] = np.where(known[:, shoulder, None, None], LOWER_ARM, curve[:, below])
    most, longest = curve.transpose(2, 0, 1)
    share = most * np.maximum(1.0 - gap / longest, 0.0)
    line, times = np.zeros(smooth.shape), np.arange(len(smooth))
    for joint in np.flatnonzero((share > 0).any(axis=0)):
        rows = np.flatnonzero(known[:, joint])
        line[:, joint] = CubicSpline(rows, smooth[rows, joint], bc_type="natural")(times)
    return share, line
