"""Blends the completer with HG-VAE's completion where parts of a body are hidden.

HG-VAE's completion is trained longer on hidden parts, but not on gaps in time. In frames with known and unknown joints,
the result is a blend of both, and rotations are solved again.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from steadypose.prior.arrays import Floats
from steadypose.prior.body.inverse_kinematics import HELD, fit_lengths, place_joints, solve_rotations
from steadypose.prior.body.skeleton import finite_joints
from steadypose.prior.models.completer import LiveCompleter
from steadypose.prior.models.completer_features import correction_share
from steadypose.prior.models.hgvae.config import SCALE, HGVAEConfig
from steadypose.prior.models.hgvae.features import body_size, from_tracks, hang_unseen, to_tracks
from steadypose.prior.models.hgvae.live_completion import LiveCompletion
from steadypose.prior.models.line import draw_line
from steadypose.prior.models.weights import WeightsError, load_weights, part

SHARE = 0.65
"""Share of HG-VAE's completion in the blend for a joint that is hidden from the start, to the end or throughout.
Between observations it is proportional to the gap, because the completer is better in short gaps (chosen on validation,
benchmarks/NOTEBOOK.md)."""

SMOOTH = 3.0
"""Standard deviation of the Gaussian that smooths the difference of the two, frames. Hidden limbs in HG-VAE's
completion have ten times the acceleration of real ones."""


class PartsCompleter:
    """Completes windows, with the interface of `LiveCompleter` and its mean pose ``usual``, and with weights of HG-VAE.

    Raises:
        FileNotFoundError: there are no such weights.
        WeightsError: the weights have no completion network.
    """

    def __init__(self, completer: LiveCompleter) -> None:
        arrays, config = load_weights("default", "hgvae")
        sizes = HGVAEConfig.from_dict(config)
        if sizes.completion is None:
            raise WeightsError("weights 'default' of hgvae: expected some with a completion network, these have none")
        self._completer, self._frames, self.usual = completer, sizes.frames, completer.usual
        self._completion = LiveCompletion(sizes.completion, part(arrays, "completion"), 1)
        self._mean = arrays["mean"].astype(np.float64)[:, None]

    def __call__(self, positions: Floats, offsets: Floats) -> tuple[Floats, Floats]:
        """Return local rotations (B, T, 22, 3, 3) and root positions (B, T, 3), metres, like `LiveCompleter`."""
        rotations, root = self._completer(positions, offsets)
        for row, (given, bones) in enumerate(zip(positions, offsets, strict=True)):
            known = finite_joints(given)
            partly = np.asarray(known.any(axis=1) & ~known.all(axis=1))
            if not partly.any() or not known[partly, 0].all():
                continue  # only gaps, or no root that could be the body's origin
            first = place_joints(rotations[row], bones) + root[row][:, None]
            second = self._second(given, first, bones)
            share = SHARE * correction_share(draw_line(known[None]))[0]
            joints = first + share * gaussian_filter1d(second - first, SMOOTH, axis=0, mode="nearest")
            # within a gap, joints that are known in other frames come from the completer alone
            replaced = ~known & (partly[:, None] | ~known.any(axis=0))
            some = replaced.any(axis=1)
            joints = np.where(known[..., None], given, np.where(replaced[..., None], joints, first))[some]
            joints = fit_lengths(joints, bones, np.where(replaced[some], 1.0, HELD))
            rotations[row, some] = solve_rotations(joints, bones, rotations[row, some])
        return rotations, root

    def _second(self, given: Floats, first: Floats, bones: Floats) -> Floats:
        """(T, 22, 3) HG-VAE's completion of a window ``given`` (T, 22, 3) metres, NaN where hidden.

        In frames without known joints, joints that are known in other frames are taken from ``first`` (T, 22, 3).
        """
        known = finite_joints(given)
        blank = ~known.any(axis=1)
        shown = given.copy()
        elsewhere = np.flatnonzero(known.any(axis=0))
        shown[np.ix_(blank, elsewhere)] = first[np.ix_(blank, elsewhere)]
        frames, size = len(given), body_size(bones)
        starts = np.unique(
            np.linspace(0, max(frames - self._frames, 0), -(-frames // self._frames)).round().astype(int)
        )
        total, weight = np.zeros_like(given), np.zeros((frames, 1, 1))
        for start in starts:
            rows = np.minimum(np.arange(start, start + self._frames), frames - 1)  # short windows repeat the last frame
            tracks = to_tracks(shown[rows], size)
            deviations = ((tracks.x - self._mean) / SCALE)[None]
            hang_unseen(deviations)
            self._completion.complete(deviations, tracks.observed[None], np.zeros(1))
            placed = from_tracks(deviations[0] * SCALE + self._mean, tracks, size)
            inside = np.arange(start, start + self._frames) < frames
            fade = np.minimum(np.arange(1, self._frames + 1), np.arange(self._frames, 0, -1))[inside, None, None]
            total[rows[inside]] += fade * placed[inside]
            weight[rows[inside]] += fade
        return total / weight
