"""The identify stage: multi-person tracking by position and bone lengths, which gives people stable ids.

It serves sources that number the bodies of each frame anew (detectors), or that give a person a new number after an
occlusion. Each frame solves one assignment problem. The scores are log-likelihood ratios of "the same person" against
"somebody else", as in multiple-hypothesis tracking (Blackman, "Multiple Hypothesis Tracking For Multiple Target
Tracking", IEEE AES Magazine 19(1), 2004, section II.C). Pairs with a score below 0 are not matched.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats, medians
from steadypose.prior.body.skeleton import TRUNK_LANDMARKS, J, finite_joints
from steadypose.prior.clean.settings import RECENT_S, IdentifySettings
from steadypose.prior.timing.kalman import ConstantVelocityFilter

ACCELERATION = 1.0  # spectral density of a visible body's white acceleration noise, m²/s³
SPEED, SPEED_MEMORY_S = 0.6, 1.0
"""Standard deviation and correlation time of the velocity of a body out of sight, m/s and seconds. The velocity is an
Ornstein-Uhlenbeck process, so a person who stops behind a pillar is not predicted into the next room."""
PLACE_SIGMA, HEIGHT_SIGMA = 0.1, 0.3
"""Standard deviation along an axis of a body's position in one frame, and upper bound of the standard deviation of its
height while it is unobserved, metres."""
NEWCOMERS = 0.01
"""Density of new people relative to one person who reappears, 1/m³ (a tenth of a person in a room of 20 m²)."""
LENGTH_SIGMA, LENGTH_MEMORY_S = 0.05, 1.0
"""Standard deviation (metres) and correlation time (seconds) of the error of an observed bone length."""
LENGTH_SPREAD = 0.1  # standard deviation of a bone's length between people, relative to its length
LENGTH_DOUBT = 3.0
"""Largest amount by which one bone can lower the log-likelihood ratio, so that an outlier does not decide."""
CERTAIN_SCORE = 3.0
"""Margin of the best score over all others at which a body is recognised without waiting for `birth` (odds of 20 to
1)."""
APART = 0.25  # distance below which two bodies are one person detected twice, metres
MIN_CONFIDENCE = 0.3  # least confidence of a bone's joints for its length to count
MIN_JOINTS = 6  # least number of visible joints of a detection
_FREE, _TENTATIVE = 0, -1  # values in place of an id; ids start at 1

_BONES: tuple[tuple[tuple[str, str], ...], ...] = (
    (("left_hip", "left_knee"), ("right_hip", "right_knee")),
    (("left_knee", "left_ankle"), ("right_knee", "right_ankle")),
    (("left_shoulder", "left_elbow"), ("right_shoulder", "right_elbow")),
    (("left_elbow", "left_wrist"), ("right_elbow", "right_wrist")),
    (("left_shoulder", "right_shoulder"),),
    (("pelvis", "neck"),),
)


class Identify:
    """Assigns an id to each body of a frame; ``counters`` count ``too_many_bodies``.

    Each of the ``rows`` holds a track: a person, visible or out of sight, or a tentative track without an id. A
    constant-velocity Kalman filter predicts each track's position. Bodies are first matched by position to tracks
    observed within `RECENT_S`. Each unmatched body starts a tentative track. After ``birth`` seconds, or as soon as the
    score is decisive, a tentative track is either recognised as a person out of sight or becomes a new person. The wait
    lets bone lengths average over several frames.
    """

    def __init__(self, settings: IdentifySettings, rows: int, counters: Counter[str]) -> None:
        self._settings, self._rows, self._counters = settings, rows, counters
        self._next_id = 1
        self.reset()

    def reset(self) -> None:
        """Forget all tracks. Their ids are not used again."""
        rows = self._rows
        self._origin_ns = self._last_ns = -1
        self._filter = ConstantVelocityFilter(ACCELERATION, PLACE_SIGMA)
        self._id = np.full(rows, _FREE)
        self._place = np.full((rows, 3), np.nan)
        self._pose = np.full((rows, 22, 3), np.nan)
        self._first_s = np.zeros(rows)
        self._observed_s = np.zeros(rows)
        self._lengths = np.zeros((rows, len(_BONES)))
        self._lengths_s = np.zeros((rows, len(_BONES)))

    def update(self, stamp_ns: int, bodies: Floats, confidence: Floats) -> list[int | None]:
        """Return the id of each body (N, 22, 3) metres, world-aligned, NaN where unobserved; None for a body without an
        id yet.

        An earlier stamp than the last, or a much later one, starts a new stream.
        """
        if self._origin_ns < 0 or not 0 < stamp_ns - self._last_ns <= self._settings.death * 1e9:
            self.reset()
            self._origin_ns = self._last_ns = stamp_ns
        step = (stamp_ns - self._last_ns) * 1e-9
        now = (stamp_ns - self._origin_ns) * 1e-9
        self._last_ns = stamp_ns
        count = len(bodies)
        if count > self._rows:
            self._counters["too_many_bodies"] += count - self._rows
        bodies, confidence = bodies[: self._rows], confidence[: self._rows]
        unobserved_s = now - self._observed_s
        self._forget((unobserved_s > self._settings.death) | ((self._id == _TENTATIVE) & (unobserved_s > RECENT_S)))
        row_of, places, score = self._follow(bodies, now)
        self._start_tracks(bodies, row_of, places, now)
        observed = np.flatnonzero(row_of >= 0)
        lengths = _bone_lengths(bodies, confidence)
        self._update_tracks(row_of[observed], bodies[observed], places[observed], lengths[observed], now, step)
        self._assign_ids(row_of, places, score, now)
        return [int(self._id[row]) if row >= 0 and self._id[row] > 0 else None for row in row_of] + [None] * (
            count - len(row_of)
        )

    def _follow(self, bodies: Floats, now: float) -> tuple[NDArray[np.intp], Floats, Floats]:
        """Match bodies to tracks observed within `RECENT_S`.

        Returns (N,) row of each body or -1, (N, 3) its position, and (rows, N) score by position of all pairs.
        """
        row_of, places = np.full(len(bodies), -1), np.full((len(bodies), 3), np.nan)
        score = np.full((self._rows, len(bodies)), -np.inf)
        expected = self._filter.predict(now)
        rows = np.flatnonzero(self._id != _FREE)
        if expected is None or not len(rows) or not len(bodies):
            return row_of, places, score
        # a body's position: the median displacement of its joints from the pose last observed
        place = medians(bodies[None] - self._pose[rows, None], axis=-2)
        unobserved_s = now - self._observed_s[rows]
        there, sigma = _unobserved(self._place[rows], expected.positions[rows], expected.sigma[rows], unobserved_s)
        score[rows] = _place_score(place - there[:, None], sigma[:, None])
        recent = np.flatnonzero(unobserved_s <= RECENT_S)
        for k, body in _best(score[rows[recent]]):
            row_of[body], places[body] = rows[recent[k]], place[recent[k], body]
        return row_of, places, score

    def _start_tracks(self, bodies: Floats, row_of: NDArray[np.intp], places: Floats, now: float) -> None:
        """Start tentative tracks for unmatched bodies, in place, as long as rows are free."""
        free = iter(np.flatnonzero(self._id == _FREE))
        for body in np.flatnonzero((row_of < 0) & (finite_joints(bodies).sum(axis=1) >= MIN_JOINTS)):
            row = next(free, None)
            if row is None:
                self._counters["too_many_bodies"] += 1
                return
            row_of[body], places[body] = row, _middle(bodies[body])
            self._id[row], self._first_s[row] = _TENTATIVE, now

    def _update_tracks(
        self, rows: NDArray[np.intp], bodies: Floats, places: Floats, lengths: Floats, now: float, step: float
    ) -> None:
        """Update tracks with the positions and bone lengths (N, B) of their bodies."""
        measured = np.full((self._rows, 3), np.nan)
        measured[rows] = places
        estimate = self._filter.update(measured, now)
        self._place[rows] = estimate.positions[rows]
        pose = bodies - places[:, None]
        self._pose[rows] = np.where(np.isfinite(pose), pose, self._pose[rows])
        self._observed_s[rows] = now
        weight = np.isfinite(lengths) * np.clip(step, _MIN_STEP_S, RECENT_S)
        self._lengths_s[rows] += weight
        share = weight / np.maximum(self._lengths_s[rows], _MIN_STEP_S)
        self._lengths[rows] += share * (np.nan_to_num(lengths) - self._lengths[rows])

    def _assign_ids(self, row_of: NDArray[np.intp], places: Floats, place_score: Floats, now: float) -> None:
        """Recognise tentative tracks as people out of sight, or give them new ids."""
        observed = np.flatnonzero(row_of >= 0)
        tentative = observed[self._id[row_of[observed]] == _TENTATIVE]
        if not len(tentative):
            return
        old_enough = now - self._first_s[row_of[tentative]] >= self._settings.birth
        away = np.setdiff1d(np.flatnonzero(self._id > 0), row_of)
        score = place_score[np.ix_(away, tentative)].T + self._length_score(row_of[tentative], away)
        waiting = ~old_enough
        for k, person in _best(score):
            others = np.r_[0.0, np.delete(score[k], person), np.delete(score[:, person], k)]
            if old_enough[k] or score[k, person] - others.max() > CERTAIN_SCORE:
                self._recognise(int(row_of[tentative[k]]), int(away[person]))
            waiting[k] = True
        for k in np.flatnonzero(~waiting):
            named = observed[self._id[row_of[observed]] > 0]
            if (np.linalg.norm(places[named] - places[tentative[k]], axis=1) > APART).all():
                self._id[row_of[tentative[k]]] = self._next_id
                self._next_id += 1

    def _length_score(self, rows: NDArray[np.intp], people: NDArray[np.intp]) -> Floats:
        """(rows, people) log-likelihood ratio of the bone lengths: the same person against another."""
        variance = [LENGTH_SIGMA**2 / np.maximum(self._lengths_s[who] / LENGTH_MEMORY_S, 1.0) for who in (rows, people)]
        both = (self._lengths_s[rows, None] > 0) & (self._lengths_s[people] > 0)
        apart = self._lengths[rows, None] - self._lengths[people]
        same = variance[0][:, None] + variance[1]
        other = same + 2 * (LENGTH_SPREAD * _GENERIC_LENGTHS) ** 2
        ratio = 0.5 * (np.log(other / same) - apart**2 * (1 / same - 1 / other))
        return np.where(both, np.maximum(ratio, -LENGTH_DOUBT), 0.0).sum(axis=-1)

    def _recognise(self, row: int, person: int) -> None:
        """Give the track of a row the id and bones of a person out of sight."""
        self._id[row] = self._id[person]
        total = np.maximum(self._lengths_s[row] + self._lengths_s[person], _MIN_STEP_S)
        self._lengths[row] += self._lengths_s[person] / total * (self._lengths[person] - self._lengths[row])
        self._lengths_s[row] += self._lengths_s[person]
        self._forget(np.arange(self._rows) == person)

    def _forget(self, rows: Bools) -> None:
        if rows.any():
            self._filter.forget(rows)
            self._id[rows] = _FREE
            self._pose[rows] = np.nan
            self._lengths[rows] = self._lengths_s[rows] = 0.0


_MIN_STEP_S = 1e-3

_ENDS = np.array([[[J[end] for end in bone] for bone in (sides[0], sides[-1])] for sides in _BONES])
"""(B, 2, 2) the joints at the two ends of each bone, on both sides of the body."""
_GENERIC_LENGTHS = np.array([0.415, 0.41, 0.275, 0.25, 0.36, 0.50])  # (B,) metres, bone lengths of the generic adult


def _bone_lengths(bodies: Floats, confidence: Floats) -> Floats:
    """(N, B) metres, bone lengths of bodies (N, 22, 3), mean of both sides; NaN where neither side is well observed."""
    ends = np.where((confidence >= MIN_CONFIDENCE)[..., None], bodies, np.nan)[:, _ENDS]
    lengths = np.linalg.norm(ends[..., 0, :] - ends[..., 1, :], axis=-1)
    observed = np.isfinite(lengths) & (lengths < 2 * _GENERIC_LENGTHS[:, None])
    sides = observed.sum(axis=-1)
    return np.where(sides > 0, np.where(observed, lengths, 0.0).sum(axis=-1) / np.maximum(sides, 1), np.nan)


def _middle(body: Floats) -> Floats:
    """(3,) metres, median of the trunk's joints, or of all joints (22, 3) if the trunk is not observed."""
    trunk = medians(body[list(TRUNK_LANDMARKS)])
    return trunk if np.isfinite(trunk).all() else medians(body)


def _unobserved(last: Floats, coasting: Floats, sigma: Floats, unobserved_s: Floats) -> tuple[Floats, Floats]:
    """Predict bodies out of sight, last observed at (R, 3), with an Ornstein-Uhlenbeck velocity, not a constant one.

    ``coasting`` (R, 3) and ``sigma`` (R,) are the prediction at constant velocity and its deviation along an axis.
    """
    age = np.maximum(unobserved_s / SPEED_MEMORY_S, 1e-6)
    forgotten = 1.0 - np.exp(-age)
    spread = SPEED * SPEED_MEMORY_S * np.sqrt(2.0 * (age - forgotten))
    return last + (forgotten / age)[:, None] * (coasting - last), np.minimum(sigma, np.hypot(PLACE_SIGMA, spread))


def _place_score(away: Floats, sigma: Floats) -> Floats:
    """Log-likelihood ratio that bodies, displaced by (..., 3) metres from a person's prediction, are that person."""
    horizontal, vertical = sigma**2 + PLACE_SIGMA**2, np.minimum(sigma, HEIGHT_SIGMA) ** 2 + PLACE_SIGMA**2
    distance_squared = (away[..., :2] ** 2).sum(axis=-1) / horizontal + away[..., 2] ** 2 / vertical
    score = -0.5 * (distance_squared + np.log((2 * np.pi) ** 3 * horizontal**2 * vertical)) - np.log(NEWCOMERS)
    return np.where(np.isfinite(score), score, -np.inf)


def _best(score: Floats) -> list[tuple[int, int]]:
    """Return the pairs (row, column) of the assignment with the greatest sum of positive scores (R, C)."""
    from scipy.optimize import linear_sum_assignment  # imported here, as it takes 12 MB that most sources do not need

    pairs = zip(*linear_sum_assignment(np.maximum(score, 0.0), maximize=True), strict=True)
    return [(int(r), int(c)) for r, c in pairs if score[r, c] > 0]
