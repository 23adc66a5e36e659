"""Completion of a recording: motion between key frames (in-betweening), and unobserved parts of a body.

Known joints do not change, bit for bit. The completer estimates the rest with the person's bones, window by window
(`views`). Windows overlap, and each gap lies in one window with both its ends. The completer's input is smoothed
(`smoothed`), because errors of the velocity at the edges of a gap accumulate in it. Measured bone lengths vary, so
known joints are a few millimetres off these bones. This residual is interpolated between known frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.inverse_kinematics import HELD, fit_lengths, place_joints, solve_rotations
from steadypose.prior.body.mixtures import mix
from steadypose.prior.body.skeleton import HIPS, PARENTS, J, finite_joints, limbs
from steadypose.prior.models.completer_features import growth, rotations_of_6d
from steadypose.prior.models.line import draw_line
from steadypose.prior.models.mixture.inference import MixtureSmoother
from steadypose.prior.models.posture import LivePosture
from steadypose.prior.timing.rate import FPS

LONGEST_GAP = 64  # longest gap on which the completer is trained, frames
AROUND = 7  # context of a window on each side of a gap, if the recording has it, frames
LONGEST = LONGEST_GAP + 2 * AROUND  # longest window, frames

_HOP = 32


class View(NamedTuple):
    """A window."""

    start: int  # its first frame
    weight: Floats  # (frames,) weight of its output where windows overlap

    @property
    def frames(self) -> slice:
        return slice(self.start, self.start + len(self.weight))


class Gap(NamedTuple):
    """Frames ``start`` to ``end - 1``, in which no joint is known."""

    start: int
    end: int


def frames_apart(known: Bools) -> Floats:
    """(T, K) frames to the nearest frame in which each column is ``known`` (T, K); infinite if there is none."""
    return np.minimum(*frames_since_and_until(known))


def frames_since_and_until(known: Bools) -> tuple[Floats, Floats]:
    """(T, K) frames since the last and until the next frame in which each column is ``known``; infinite if none."""
    at = np.arange(len(known), dtype=np.float64)[:, None]
    before = np.maximum.accumulate(np.where(known, at, -np.inf), axis=0)
    after = np.minimum.accumulate(np.where(known, at, np.inf)[::-1], axis=0)[::-1]
    return at - before, after - at


def gaps(known: Bools) -> list[Gap]:
    """Return the runs of frames in which no joint is ``known`` (T, 22)."""
    blank = np.concatenate([[False], ~known.any(axis=1), [False]]).astype(np.int8)
    return [Gap(*ends) for ends in zip(*(np.flatnonzero(np.diff(blank) == d) for d in (1, -1)), strict=True)]


def views(known: Bools) -> list[View]:
    """Return windows over all frames with unknown joints (T, 22). No gap may be longer than `LONGEST_GAP`.

    A gap, or several gaps close together, gets its own window, because both ends must lie inside. The other frames get
    windows that overlap by half.
    """
    frames = len(known)
    own = np.zeros(frames)
    windows: list[View] = []
    waiting = gaps(known)
    while waiting:
        first = max(waiting[0].start - AROUND, 0)
        taken = 1
        while taken < len(waiting) and waiting[taken].end + AROUND - first <= LONGEST:
            taken += 1
        last = min(waiting[taken - 1].end + AROUND, frames)
        weight = np.ones(last - first)
        rise, fall = waiting[0].start - first, last - waiting[taken - 1].end
        if rise:
            weight[:rise] = (np.arange(rise) + 1.0) / (rise + 1.0)
        if fall:
            weight[-fall:] = (np.arange(fall, 0, -1)) / (fall + 1.0)
        # a gap of which this window contains only one end is left to the window that contains both
        for gap in gaps(known[first:last]):
            if not any(gap.start + first == whole.start and gap.end + first == whole.end for whole in waiting[:taken]):
                weight[gap.start : gap.end] = 0.0
        windows.append(View(first, weight))
        own[first:last] = np.maximum(own[first:last], weight)
        waiting = waiting[taken:]
    settled = known.all(axis=1) | (own >= 1.0)
    for run in gaps(settled[:, None]):
        first = max(run.start - AROUND, 0)
        more = max(-(-(run.end - first - LONGEST) // _HOP), 0)
        for start in range(first, first + more * _HOP + 1, _HOP):
            end = min(start + LONGEST, frames)
            weight = np.minimum(np.arange(1, end - start + 1), np.arange(end - start, 0, -1)) / (end - start)
            windows.append(View(start, weight * (1.0 - own[start:end])))
    return windows


MIN_SIGMA = 0.002  # least standard deviation of a given joint along an axis, metres
MIN_NEVER = 0.015  # least standard deviation along an axis of a joint that was never given, metres

_WAIST, UNOBSERVED_WAIST = [J["pelvis"], *HIPS], 0.12
"""Least standard deviation along an axis of pelvis and hips if no joint from the hips down was ever given, metres
(validation: 0.09, 0.15; the Gaussian of postures has too little variance for the bending of a trunk)."""
_LOWER = np.ravel(limbs(("hip", "knee", "ankle", "foot")))
_HEAD = [J["neck"], J["head"]]

DRIFT, MAX_DRIFT, LONG = 0.0045, 0.14, 60.0
"""Drift of a body in a gap without the pelvis: metres along an axis per frame from the gap's nearer end, maximum in
metres, and length of gaps with the full drift in frames. In shorter gaps, drift is proportional to their length. Values
are from validation people, whose RMS drift reaches 135 mm."""

WANDER = 0.00115
"""Drift of a body whose velocity is a random walk, between two known ends s and u frames away: metres along an axis,
times (s u / (s + u))^1.5. In gaps of more than 3 s and beyond a recording's ends it exceeds the other (validation)."""


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of the completer's output, measured on validation people."""

    far: Sequence[float]
    """(22,) metres along an axis, standard deviation of each joint far from the frames in which it is known"""
    half: float
    """frames from a joint's last known frame at which its standard deviation is half of that, if none follows"""
    posture: LivePosture  # Gaussian of postures, for joints that are known in no frame

    def of(self, given: Floats) -> Floats:
        """(T, 22) metres along an axis, standard deviations of joints (T, 22, 3) metres, NaN where not given.

        The noise of given joints is estimated from their second differences.
        """
        known = finite_joints(given)
        since, until = frames_since_and_until(known)
        with np.errstate(divide="ignore"):
            # as in the variance of a Brownian bridge, which is s u / (s + u)
            between = 1.0 / (1.0 / since + 1.0 / until)
            grown = growth(between, self.half)
        bends = np.linalg.norm(np.diff(given, n=2, axis=0), axis=-1)
        noise = np.full(22, MIN_SIGMA)
        for joint in np.flatnonzero(np.isfinite(bends).any(axis=0)):
            # 1.538 is the median length of a standard normal vector; a second difference has six times the variance
            noise[joint] = max(np.nanmedian(bends[:, joint]) / (1.538 * np.sqrt(6.0)), MIN_SIGMA)
        ever: Bools = np.asarray(known.any(axis=0))
        never = self.posture.sigma_given(ever)
        never[_HEAD] = np.maximum(never[_HEAD], np.take(self.far, _HEAD))  # its posture varies between people
        if not ever[_LOWER].any():
            never[_WAIST] = np.maximum(never[_WAIST], UNOBSERVED_WAIST)
        guessed = np.hypot(np.maximum(np.where(ever, self.far, never), MIN_NEVER) * grown, noise)
        since, until, between = since[:, :1], until[:, :1], between[:, :1]
        rootless = np.minimum(since, until) * np.minimum((since + until) / LONG, 1.0)
        drift = np.minimum(DRIFT * np.where(np.isfinite(rootless), rootless, 0.0), MAX_DRIFT)
        drift = np.maximum(drift, WANDER * np.where(np.isfinite(between), between, 0.0) ** 1.5)
        guessed = np.hypot(guessed, drift)
        return np.where(known, noise, guessed)


Fill = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Type of a completer of whole windows, such as `LiveCompleter`. It maps positions (B, T, 22, 3), NaN where unknown,
and bones (B, 22, 3) to local rotations (B, T, 22, 3, 3) and root positions (B, T, 3), metres."""

BENT = 0.02  # distance of a known joint from its bones above which the unknown joints above are solved again, metres


@dataclass(frozen=True)
class Completed:
    """A body's completed motion."""

    positions: Floats
    """(T, 22, 3) metres, world, z up; NaN more than `LONGEST_GAP` frames before or after all known frames"""
    rotations: Floats  # (T, 22, 3, 3) local; NaN likewise
    known: Bools  # (T, 22) which joints were given
    span: int  # length of the longest gap that was filled, frames


def complete(
    fill: Fill, positions: Floats, offsets: Floats, advanced: Callable[[int], None] = lambda frames: None
) -> Completed:
    """Complete a body's motion (T, 22, 3) metres, z up, at 30 Hz, NaN where unknown, on bones (22, 3), by ``fill``.

    ``advanced`` is called with the end of each finished window. Raises ValueError if no joint is known in any frame.
    """
    known = finite_joints(positions)
    if not known.any():
        raise ValueError("expected joints in at least one frame, all are missing")
    frames = np.flatnonzero(known.any(axis=1))
    reached = slice(max(int(frames[0]) - LONGEST_GAP, 0), int(frames[-1]) + 1 + LONGEST_GAP)
    joints, rotations = np.full(positions.shape, np.nan), np.full((*positions.shape, 3), np.nan)
    joints[reached], rotations[reached] = _completed(
        fill, positions[reached], offsets, lambda frame: advanced(frame + reached.start)
    )
    return Completed(joints, rotations, known, max((gap.end - gap.start for gap in gaps(known)), default=0))


def _completed(
    fill: Fill, positions: Floats, offsets: Floats, advanced: Callable[[int], None]
) -> tuple[Floats, Floats]:
    """Return joints (T, 22, 3) and rotations (T, 22, 3, 3) of frames that begin and end near known frames."""
    known = finite_joints(positions)
    smooth = smoothed(positions)
    bridged = _bridged(fill, smooth, offsets)
    rotations, root = _filled(fill, bridged, offsets, advanced)
    placed = place_joints(rotations, offsets) + root[:, None]
    missed = _faded(np.where(known[..., None], smooth - placed, 0.0), known)
    joints = np.where(known[..., None], positions, placed + missed)
    bent = (~known).any(axis=1) & (np.linalg.norm(missed, axis=-1) > BENT).any(axis=1)
    if bent.any():
        joints[bent] = fit_lengths(joints[bent], offsets, np.where(known[bent], HELD, 1.0))
        joints = np.where(known[..., None], positions, joints)
    share, line = splines(smooth, known)
    joints += share[..., None] * (line - joints)
    joints = mix(joints, np.broadcast_to(~known.any(axis=0), known.shape))
    moved = bent | (share > 0).any(axis=1)
    if moved.any():
        rotations[moved] = solve_rotations(joints[moved], offsets, rotations[moved])
    return joints, rotations


def _faded(missed: Floats, known: Bools) -> Floats:
    """Interpolate the known joints' residuals (T, 22, 3) in time; a joint that is never known gets its parent's."""
    line = draw_line(known[None])
    before, after = (np.take_along_axis(missed, rows[..., None], axis=0) for rows in (line.before[0], line.after[0]))
    weight = line.weight[0][..., None]
    faded = (1.0 - weight) * before + weight * after
    for joint, parent in enumerate(PARENTS):
        if parent >= 0 and not line.ever[0, joint]:
            faded[:, joint] = faded[:, parent]
    return faded


def _bridged(fill: Fill, positions: Floats, offsets: Floats) -> Floats:
    """Insert key frames into gaps longer than `LONGEST_GAP`, so that the remaining gaps are shorter.

    The key frames come from the completer, applied to every n-th frame of the gap and its surroundings.
    """
    bridged, frames = positions.copy(), len(positions)
    for gap in gaps(finite_joints(positions)):
        length = gap.end - gap.start
        if length <= LONGEST_GAP:
            continue
        step = -(-(length + 1) // LONGEST_GAP)
        inside = np.linspace(gap.start - 1, gap.end, -(-(length + 1) // step) + 1).round().astype(int)
        before, after = (edge + step * np.arange(1, AROUND) for edge in (-gap.start + 1, gap.end))
        rows = np.concatenate([-before[::-1], inside, after])
        rows = rows[(rows >= 0) & (rows < frames)]
        rotations, root = fill(positions[None, rows], offsets[None])
        placed = place_joints(rotations[0], offsets) + root[0][:, None]
        put = (rows >= gap.start) & (rows < gap.end)
        bridged[rows[put]] = placed[put]
    return bridged


def _filled(fill: Fill, positions: Floats, offsets: Floats, advanced: Callable[[int], None]) -> tuple[Floats, Floats]:
    """Return rotations (T, 22, 3, 3) and root (T, 3) of all frames.

    Where windows overlap, the first two columns of their rotations and their roots are averaged by weight.
    """
    known = finite_joints(positions)
    frames = len(positions)
    columns, root, total = np.zeros((frames, 22, 6)), np.zeros((frames, 3)), np.zeros(frames)
    for view in sorted(views(known), key=lambda view: view.start):
        rows = view.frames
        turned, placed = fill(positions[None, rows], offsets[None])
        columns[rows] += view.weight[:, None, None] * turned[0][..., :2].swapaxes(-1, -2).reshape(-1, 22, 6)
        root[rows] += view.weight[:, None] * placed[0]
        total[rows] += view.weight
        advanced(rows.stop)
    covered = total > 0
    rotations = solve_rotations(positions, offsets)
    rotations[covered] = rotations_of_6d(columns[covered])
    root = np.where(covered[:, None], root / np.maximum(total, 1e-12)[:, None], positions[:, 0])
    return rotations, root


WHOLE, PART, LOWER_ARM = (0.5, 60.0), (0.8, 40.0), (0.8, 20.0)
"""Share of each joint's own cubic spline in the shortest gaps, and length of gaps from which on it is 0, frames: where
no joint is known, where others are, and for an elbow and a wrist if the shoulder is. The completer's errors accumulate
along limbs; but a spline overshoots where a wrist reverses its motion."""

LAG, RUN = 8, 6
"""Number of later frames used to smooth a known joint, and number of known frames in a row below which it is not
smoothed: between isolated key frames, a smoother cannot distinguish motion from noise."""


def smoothed(positions: Floats) -> Floats:
    """Return known joints (T, 22, 3) as the live smoother estimates them, which leaves noise-free ones unchanged."""
    smoother, known = MixtureSmoother(LAG, 1), finite_joints(positions)
    lagging = [
        smoother.update(frame[None], t / FPS, observed[None].astype(np.float64))
        for t, (frame, observed) in enumerate(zip(positions, known, strict=True))
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
