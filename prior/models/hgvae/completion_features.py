"""What the completion network reads of a window, in training and live: compiled loops, shared by both.

A node is a part of the window's time; its inputs are the whole body's tracks, how near each joint's sightings are, and
how noisy and how lively this person's joints are. Beside them stands the variance of the line that the window's guess
is (`prior.models.hgvae.features`), with which the network's answer is fused.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import PARENT
from steadypose.prior.models.hgvae.config import JOINT_NODES, SCALE

NEAR = 8.0
"""Frames from a sighting at which its nearness is a half. It falls as 1 / (1 + d / NEAR): by an exponential, an
arm seen a second ago would pass for one never seen."""

LAG = 5
"""Frames over which it is measured how much a joint moves beside the one above."""

GROWTH = 1.5
"""Exponent with which the variance of the line grows with the time from a sighting: 1 is a random walk's, 2 that of
constant speed. With two more parameters it can be learned; then the sensors of training that get joints plainly wrong
decide it, and arms that hold still are moved again."""

STILL = 0.004
"""Metres along an axis in `LAG` frames: what a joint that was never seen to move may do."""

CENTIMETRE = 0.01 / SCALE
"""in the network's units: the noise of joints is given in these, by its logarithm"""

BIAS_SCALE = 0.01
BIAS_MIN = 0.002
"""Metres along an axis: errors that last are given in the one by their logarithm, those under the other as none."""

HALF_BELIEVED = 0.01
"""Metres along an axis: a guess with this standard deviation is half believed."""

FIRST_LOG_VAR = -3.0
"""What the network's zero stands for, in units of `SCALE`: 4.5 cm."""

JOINTS = JOINT_NODES // 3

FRAME_INPUTS = JOINT_NODES + 2 * JOINTS
"""Inputs a frame: tracks, and how near a joint's last and next sighting are."""

WINDOW_INPUTS = 2 * JOINTS + 2
"""Inputs a window: how noisy joints are, each and all, how much they move, and the sensor's error that lasts."""

_NEVER = -1.0


class Features(NamedTuple):
    """Windows as the network reads them.

    Attributes:
        nodes: (B, T / patch, inputs) float32.
        moved: (B, 22) float32, by how much a joint moves in `LAG` frames beside the one above, without the noise: mean
            of the square along an axis, in units of `SCALE`.
        noise: (B, 22) float32, variance of a sighting along an axis: from frame to frame, and what lasts.
        apart: (B, 22, T) float32, frames from a sighting, less where it lies between two; 0 where seen, -1 of a joint
            never seen.
    """

    nodes: NDArray[np.float32]
    moved: NDArray[np.float32]
    noise: NDArray[np.float32]
    apart: NDArray[np.float32]

    def line_variance(self) -> NDArray[np.float32]:
        """(B, 22, T) variance along an axis, in units of `SCALE`, of the line that a hidden joint is guessed to follow.

        It grows with the time from a sighting and with how much this joint moves, and adds to that of the joint which
        it hangs from. 0 where a joint is seen, infinite where it never was.
        """
        variance = np.empty_like(self.apart)
        _line_variance(self.moved, self.noise, self.apart, variance)
        return variance


def completion_features(
    deviations: NDArray[np.floating],
    observed: NDArray[np.floating],
    bias_sigma: NDArray[np.floating] | float,
    patch: int,
) -> Features:
    """Windows as the completion network reads them.

    Args:
        deviations: (B, 66, T) tracks about the training mean in units of `SCALE`, what was not seen guessed.
        observed: (B, 66, T) more than 0 where seen.
        bias_sigma: (B,) metres along an axis, the errors of the sensor that last.
        patch: frames in a node.
    """
    count, _, frames = deviations.shape
    nodes = np.empty((count, frames // patch, FRAME_INPUTS * patch + WINDOW_INPUTS), dtype=np.float32)
    moved, noise = np.empty((2, count, JOINTS), dtype=np.float32)
    apart = np.empty((count, JOINTS, frames), dtype=np.float32)
    _write_nodes(deviations.astype(np.float32), observed.astype(np.float32), patch, nodes, moved, noise, apart)
    bias = np.reshape(np.maximum(bias_sigma, BIAS_MIN), (-1, 1))
    nodes[..., -1] = np.log(bias / BIAS_SCALE)
    noise += (bias / SCALE) ** 2
    return Features(nodes, moved, noise, apart)


@njit(cache=True)
def _line_variance(moved, noise, apart, variance):
    count, joints, frames = apart.shape
    least = np.float32((STILL / SCALE) ** 2)
    held = np.empty((joints, frames), dtype=np.float32)
    for row in range(count):
        for joint in range(joints):
            parent = PARENT[joint]
            for t in range(frames):
                far = apart[row, joint, t]
                held[joint, t] = held[parent, t] if parent > 0 else 0.0
                if far > 0:
                    held[joint, t] += (moved[row, joint] + least) * (far / LAG) ** GROWTH + noise[row, joint]
                variance[row, joint, t] = np.inf if far == _NEVER else (held[joint, t] if far > 0 else 0.0)


@njit(cache=True)
def _write_nodes(deviations, observed, patch, nodes, moved, noise, apart):
    count, tracks, frames = deviations.shape
    joints = tracks // 3
    frame = tracks + 2 * joints
    seen = np.empty((joints, frames))
    for b in range(count):
        for track in range(tracks):
            for t in range(frames):
                nodes[b, t // patch, (t % patch) * frame + track] = deviations[b, track, t]
        for joint in range(joints):
            since = frames
            for t in range(frames):
                seen[joint, t] = min(
                    observed[b, 3 * joint, t], observed[b, 3 * joint + 1, t], observed[b, 3 * joint + 2, t]
                )
                since = 0 if seen[joint, t] > 0 else min(since + 1, frames)
                apart[b, joint, t] = since
                near = 1.0 / (1.0 + since / NEAR) if since < frames else 0.0
                nodes[b, t // patch, (t % patch) * frame + tracks + joint] = near
            since = frames
            for t in range(frames - 1, -1, -1):
                since = 0 if seen[joint, t] > 0 else min(since + 1, frames)
                near = 1.0 / (1.0 + since / NEAR) if since < frames else 0.0
                nodes[b, t // patch, (t % patch) * frame + tracks + joints + joint] = near
                last = apart[b, joint, t]
                if last == frames and since == frames:
                    apart[b, joint, t] = _NEVER
                elif last == frames or since == frames:
                    apart[b, joint, t] = min(last, since)
                elif since > 0:
                    apart[b, joint, t] = last * since / (last + since)
        _measure_noise(deviations[b], seen, nodes[b, :, patch * frame :], noise[b])
        _measure_moved(deviations[b], seen, moved[b])
        for joint in range(joints):
            liveliness = 0.5 * math.log(moved[b, joint] / CENTIMETRE**2 + 1e-3)
            for node in range(nodes.shape[1]):
                nodes[b, node, patch * frame + joints + 1 + joint] = liveliness
            moved[b, joint] = max(moved[b, joint] - 2 * noise[b, joint], 0.0)


@njit(cache=True)
def _total(values):
    total = values[0]
    for k in range(1, len(values)):
        total += values[k]
    return total


@njit(cache=True)
def _measure_moved(deviations, seen, moved):
    """How much each joint moves in `LAG` frames beside the one above; as all do, where that was not to be seen."""
    tracks, frames = deviations.shape
    joints = tracks // 3
    counts = np.zeros(joints)
    for joint in range(joints):
        above = PARENT[joint]
        moved[joint] = 0.0
        for t in range(LAG, frames):
            if seen[joint, t] > 0 and seen[joint, t - LAG] > 0:
                counts[joint] += 1
                for axis in range(3):
                    way = deviations[3 * joint + axis, t] - deviations[3 * joint + axis, t - LAG]
                    if above > 0:
                        way -= deviations[3 * above + axis, t] - deviations[3 * above + axis, t - LAG]
                    moved[joint] += way * way / 3
    together = _total(moved) / max(_total(counts), 1.0)
    for joint in range(joints):
        moved[joint] = moved[joint] / counts[joint] if counts[joint] > 0 else together


@njit(cache=True)
def _measure_noise(deviations, seen, nodes, noise):
    """How much each joint jumps about, by the second difference of its track, and how much all do, to every node."""
    tracks, frames = deviations.shape
    joints = tracks // 3
    squares, counts = np.zeros(joints), np.zeros(joints)
    for joint in range(joints):
        for t in range(1, frames - 1):
            if seen[joint, t - 1] > 0 and seen[joint, t] > 0 and seen[joint, t + 1] > 0:
                counts[joint] += 1
                for axis in range(3):
                    track = deviations[3 * joint + axis]
                    squares[joint] += (track[t - 1] - 2 * track[t] + track[t + 1]) ** 2
    together = _total(squares) / max(_total(counts), 1.0)
    for joint in range(joints + 1):
        alone = joint < joints and counts[joint] > 3
        square = squares[joint] / counts[joint] if alone else together
        level = 0.25 * math.log(square / CENTIMETRE**2 + 1e-3)
        for node in range(len(nodes)):
            nodes[node, joint] = level
        if joint < joints:
            noise[joint] = square / 18  # a second difference has six times the variance, and this is of three axes
