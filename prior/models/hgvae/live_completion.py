"""Live inference of the completion network (`CompletionNet`) without torch, and its features.

The network is a transformer. A node, its token, is a patch of the window in time; its inputs are the whole body's
tracks, the nearness of each joint's observations, and each joint's noise and mobility. The output is fused with the
interpolation that fills the window's gaps (`prior.models.hgvae.features`), weighted by the interpolation's variance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import PARENT
from steadypose.prior.compiled import njit
from steadypose.prior.models.compiled_graph import LOG_VAR_RANGE, Network, Program
from steadypose.prior.models.hgvae.config import JOINT_NODES, SCALE, CompletionConfig
from steadypose.prior.models.weights import Arrays, part

NEAR = 8.0
"""Distance at which the nearness of an observation, 1 / (1 + d / NEAR), is one half, frames. An exponential would not
distinguish an arm that was observed a second ago from one that was never observed."""

LAG = 5  # interval over which the mobility of a joint relative to its parent is measured, frames

GROWTH = 1.5
"""Exponent of the growth of the interpolation's variance with the time from an observation: 1 is a random walk, 2
constant velocity. A learned exponent is dominated by faults of the training sensors, and moves resting arms."""

STILL = 0.004  # least mobility of a joint along an axis in `LAG` frames, metres
CENTIMETRE = 0.01 / SCALE  # unit of the joints' noise, which enters by its logarithm: a centimetre in units of `SCALE`

BIAS_SCALE = 0.01
BIAS_MIN = 0.002
"""Least bias along an axis, metres."""

HALF_CERTAIN_SIGMA = 0.01
"""Standard deviation along an axis at which a completed entry has a certainty of one half, metres."""

FIRST_LOG_VAR = -3.0  # log-variance at an output of 0, in units of `SCALE`: a standard deviation of 4.5 cm

JOINTS = JOINT_NODES // 3

FRAME_INPUTS = JOINT_NODES + 2 * JOINTS
"""Number of inputs per frame: tracks, and the nearness of each joint's last and next observation."""

WINDOW_INPUTS = 2 * JOINTS + 2
"""Number of inputs per window: noise of each joint and of all joints, mobility of each joint, and the sensor's bias."""

_NEVER = -1.0


class Features(NamedTuple):
    """The network's input. Variances are along an axis, in units of `SCALE`."""

    nodes: NDArray[np.float32]  # (B, T / patch, inputs) float32
    mobility: NDArray[np.float32]
    """(B, 22) float32, mean squared displacement of a joint relative to its parent in `LAG` frames, minus the part that
    noise explains"""
    noise: NDArray[np.float32]  # (B, 22) float32, variance of an observation: jitter and bias
    gap: NDArray[np.float32]
    """(B, 22, T) float32, frames to an observation; 1 / (1 / last + 1 / next) between two; 0 where observed, -1 for a
    joint never observed"""

    def line_variance(self) -> NDArray[np.float32]:
        """(B, 22, T) variance of the interpolation of hidden joints.

        It grows with the time from an observation and with the joint's mobility, and includes the parent's variance. It
        is 0 where a joint is observed, and infinite if it never was.
        """
        variance = np.empty_like(self.gap)
        _line_variance(self.mobility, self.noise, self.gap, variance)
        return variance


def completion_features(
    deviations: NDArray[np.floating],
    observed: NDArray[np.floating],
    bias_sigma: NDArray[np.floating] | float,
    patch: int,
) -> Features:
    """Build the completion network's input.

    Args:
        deviations: (B, 66, T) tracks minus the training mean, in units of `SCALE`; interpolated where unobserved.
        observed: (B, 66, T) more than 0 where observed.
        bias_sigma: (B,) metres along an axis, the sensor's bias.
        patch: frames in a node.
    """
    count, _, frames = deviations.shape
    nodes = np.empty((count, frames // patch, FRAME_INPUTS * patch + WINDOW_INPUTS), dtype=np.float32)
    mobility, noise = np.empty((2, count, JOINTS), dtype=np.float32)
    gap = np.empty((count, JOINTS, frames), dtype=np.float32)
    _write_nodes(deviations.astype(np.float32), observed.astype(np.float32), patch, nodes, mobility, noise, gap)
    bias = np.reshape(np.maximum(bias_sigma, BIAS_MIN), (-1, 1))
    nodes[..., -1] = np.log(bias / BIAS_SCALE)
    noise += (bias / SCALE) ** 2
    return Features(nodes, mobility, noise, gap)


@njit(cache=True)
def _line_variance(mobility, noise, gap, variance):
    count, joints, frames = gap.shape
    least = np.float32((STILL / SCALE) ** 2)
    held = np.empty((joints, frames), dtype=np.float32)
    for row in range(count):
        for joint in range(joints):
            parent = PARENT[joint]
            for t in range(frames):
                far = gap[row, joint, t]
                held[joint, t] = held[parent, t] if parent > 0 else 0.0
                if far > 0:
                    held[joint, t] += (mobility[row, joint] + least) * (far / LAG) ** GROWTH + noise[row, joint]
                variance[row, joint, t] = np.inf if far == _NEVER else (held[joint, t] if far > 0 else 0.0)


@njit(cache=True)
def _write_nodes(deviations, observed, patch, nodes, mobility, noise, gap):
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
                gap[b, joint, t] = since
                near = 1.0 / (1.0 + since / NEAR) if since < frames else 0.0
                nodes[b, t // patch, (t % patch) * frame + tracks + joint] = near
            since = frames
            for t in range(frames - 1, -1, -1):
                since = 0 if seen[joint, t] > 0 else min(since + 1, frames)
                near = 1.0 / (1.0 + since / NEAR) if since < frames else 0.0
                nodes[b, t // patch, (t % patch) * frame + tracks + joints + joint] = near
                last = gap[b, joint, t]
                if last == frames and since == frames:
                    gap[b, joint, t] = _NEVER
                elif last == frames or since == frames:
                    gap[b, joint, t] = min(last, since)
                elif since > 0:
                    gap[b, joint, t] = last * since / (last + since)
        _measure_noise(deviations[b], seen, nodes[b, :, patch * frame :], noise[b])
        _measure_mobility(deviations[b], seen, mobility[b])
        for joint in range(joints):
            log_mobility = 0.5 * math.log(mobility[b, joint] / CENTIMETRE**2 + 1e-3)
            for node in range(nodes.shape[1]):
                nodes[b, node, patch * frame + joints + 1 + joint] = log_mobility
            mobility[b, joint] = max(mobility[b, joint] - 2 * noise[b, joint], 0.0)


@njit(cache=True)
def _total(values):
    total = values[0]
    for k in range(1, len(values)):
        total += values[k]
    return total


@njit(cache=True)
def _measure_mobility(deviations, seen, mobility):
    """Mean squared displacement of each joint relative to its parent in `LAG` frames; the mean of all if unknown."""
    tracks, frames = deviations.shape
    joints = tracks // 3
    counts = np.zeros(joints)
    for joint in range(joints):
        above = PARENT[joint]
        mobility[joint] = 0.0
        for t in range(LAG, frames):
            if seen[joint, t] > 0 and seen[joint, t - LAG] > 0:
                counts[joint] += 1
                for axis in range(3):
                    way = deviations[3 * joint + axis, t] - deviations[3 * joint + axis, t - LAG]
                    if above > 0:
                        way -= deviations[3 * above + axis, t] - deviations[3 * above + axis, t - LAG]
                    mobility[joint] += way * way / 3
    together = _total(mobility) / max(_total(counts), 1.0)
    for joint in range(joints):
        mobility[joint] = mobility[joint] / counts[joint] if counts[joint] > 0 else together


@njit(cache=True)
def _measure_noise(deviations, seen, nodes, noise):
    """Noise of each joint and of all joints, from the second differences of their tracks; written to every node."""
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
            noise[joint] = square / 18  # a second difference has six times the variance, summed over three axes


class LiveCompletion:
    """A trained `CompletionNet` for at most ``max_batch`` windows per call."""

    def __init__(self, config: CompletionConfig, weights: Arrays, max_batch: int) -> None:
        p, self._patch = Program(), config.patch
        place, read = weights["place"], weights["read.weight"].T
        self._nodes = p.matrix(len(place), len(read))
        graph = p.linear(self._nodes, read, weights["read.bias"] + place)
        for k in range(config.layers):
            p.attention(graph, part(weights, f"layers.{k}"), config.heads)
        self._written = p.normed(graph, part(weights, "norm"), part(weights, "write"))
        self._net = Network(p, max_batch)

    def complete(
        self, deviations: NDArray[np.floating], observed: NDArray[np.floating], bias_sigma: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """Complete the unobserved entries of windows, in place (see `CompletionNet.complete`).

        Args:
            deviations: (B, 66, T) tracks minus the training mean, in units of `SCALE`; changed.
            observed: (B, 66, T) more than 0 where observed.
            bias_sigma: (B,) metres along an axis, the sensor's bias.

        Returns:
            (B, 66, T) certainty of each entry (see `completion.certainty_of`).
        """
        certainty = (observed > 0).astype(np.float32)
        partly = np.flatnonzero((observed == 0).any(axis=(-2, -1)))
        if not len(partly):
            return certainty
        features = completion_features(deviations[partly], observed[partly], bias_sigma[partly], self._patch)
        rows = slice(0, len(partly))
        self._net.matrix(self._nodes, rows)[:] = features.nodes
        self._net.run(rows)
        written = self._net.matrix(self._written, rows)
        _fuse(written, features.line_variance(), partly, observed, deviations, certainty)
        return certainty


@njit(cache=True)
def _fuse(written, line_variance, places, observed, deviations, certainty):
    """Complete the windows at ``places`` and write their certainty, like `CompletionNet.fuse` and `certainty_of`."""
    joints, frames = line_variance.shape[1:]
    patch = written.shape[2] // (4 * joints)
    half = np.float32(2 * math.log(HALF_CERTAIN_SIGMA / SCALE))
    for row in range(len(places)):
        place = places[row]
        for joint in range(joints):
            for t in range(frames):
                held = line_variance[row, joint, t]
                if held == 0:
                    continue
                node, k = t // patch, t % patch
                log_var = written[row, node, 3 * joints * patch + k * joints + joint] + np.float32(FIRST_LOG_VAR)
                log_var = min(max(log_var, LOG_VAR_RANGE[0]), LOG_VAR_RANGE[1])
                gain = held / (held + math.exp(log_var)) if held < np.inf else 1.0
                fused = min(max(log_var + math.log(max(gain, 1e-6)), LOG_VAR_RANGE[0]), LOG_VAR_RANGE[1])
                for axis in range(3):
                    track = 3 * joint + axis
                    if observed[place, track, t] == 0:
                        deviations[place, track, t] += gain * written[row, node, k * 3 * joints + track]
                        certainty[place, track, t] = 1.0 / (1.0 + math.exp(fused - half))
