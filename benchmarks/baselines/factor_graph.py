"""A baseline for an unobserved root: a factor graph of root and feet, smoothed over a fixed lag by gtsam.

What an engineer would write in a day from the literature (Dellaert and Kaess, "Factor Graphs for Robot Perception",
2017; standing feet as variables: Bloesch et al., "State Estimation for Legged Robots", RSS 2012; Hartley et al.,
"Hybrid Contact Preintegration for Visual-Inertial-Contact State Estimation", IROS 2018). It is told what `BodyFilter`
is told: the same observations, the same network's velocity and contacts, and the noise of `BodyNoise`. Nothing in it is
tuned. Not in it: the sensor's slow errors, the floor, and the decisions of `RootFilter` on what to take.

The factors are linear, and what leaves the lag is marginalised: for the newest frame this is a Kalman filter's
estimate, whatever the lag, but for gtsam's arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, F

from steadypose.benchmarks.root_drift import Way
from steadypose.msgs.types import PoseClean
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.world.core import BodyEstimate, Scene, WorldCore
from steadypose.prior.world.filter import JITTER_SHARE
from steadypose.prior.world.kalman import BodyNoise
from steadypose.prior.world.observe import FEET, observe
from steadypose.prior.world.settings import TrajectorySettings
from steadypose.prior.world.velocity import VelocityNetwork

LAG = 16
"""Frames."""

_BIAS_SHARE = math.sqrt(1.0 - JITTER_SHARE**2)
_ONE, _NONE = np.eye(3), np.zeros((3, 3))
_POSITION, _VELOCITY = np.hstack([_ONE, _NONE, _NONE]), np.hstack([_NONE, _ONE, _NONE])
"""(3, 9) of a body's variable: root position, metres; velocity, m/s; the network's slow error, in its deviations."""


class Told(NamedTuple):
    """What one frame tells, world.

    Attributes:
        root: (3,) metres, or None while it is not seen.
        root_sigma: metres.
        velocity, velocity_sigma: (3,) m/s, by the network.
        feet: (4, 3) metres from the root.
        feet_sigma: (4,) metres.
        load, rest: (4,) probabilities.
    """

    root: Floats | None
    root_sigma: float
    velocity: Floats
    velocity_sigma: Floats
    feet: Floats
    feet_sigma: Floats
    load: Floats
    rest: Floats


class FactorGraph:
    """Root and feet of one body; ``lag`` in frames."""

    def __init__(self, noise: BodyNoise, lag: int = LAG) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))  # nothing that changed is left as it was
        parameters.enableRelinearization = False
        self._smoother = gtsam.IncrementalFixedLagSmoother(float(lag), parameters)
        self._noise, self._frame, self._speed = noise, -1, 0.0
        self._factors, self._new = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def update(self, told: Told, dt: float) -> tuple[Floats, Floats, Floats]:
        """Take the next frame, ``dt`` seconds after the last: body (9,), its covariance (9, 9), feet (4, 3) metres."""
        self._frame += 1
        body, feet = B(self._frame), [F(len(told.feet) * self._frame + k) for k in range(len(told.feet))]
        self._factors, self._new = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._new.insert(body, np.zeros(9))
        for foot in feet:
            self._new.insert(foot, np.zeros(3))
        if self._frame:
            self._move(body, feet, told, dt)
        else:
            first = [1e3] * 3 + [self._noise.first_speed] * 3 + [1.0] * 3
            self._add({body: np.eye(9)}, np.zeros(9), np.diag(np.square(first)))
        if told.root is not None:
            self._add({body: _POSITION}, told.root, told.root_sigma**2 * _ONE)
        reads = _VELOCITY + np.hstack([_NONE, _NONE, np.diag(_BIAS_SHARE * told.velocity_sigma)])
        self._add({body: reads}, told.velocity, np.diag((JITTER_SHARE * told.velocity_sigma) ** 2))
        for foot, offset, sigma in zip(feet, told.feet, told.feet_sigma, strict=True):
            self._add({body: -_POSITION, foot: _ONE}, offset, sigma**2 * _ONE)
        stamps = {key: float(self._frame) for key in (body, *feet)}
        self._smoother.update(self._factors, self._new, stamps)  # pyright: ignore[reportArgumentType]
        estimate = self._smoother.calculateEstimateVector(body)
        self._speed = math.hypot(*estimate[3:5])
        places = np.stack([self._smoother.calculateEstimateVector(foot) for foot in feet])
        return estimate, self._smoother.marginalCovariance(body), places

    def _move(self, body: int, feet: Sequence[int], told: Told, dt: float) -> None:
        """White-noise acceleration, a Gauss-Markov error of the network, and feet that walk as their contacts say."""
        kept = np.exp(-dt / np.broadcast_to(np.asarray(self._noise.network_memory_s, dtype=np.float64), (3,)))
        forward = np.block([[_ONE, dt * _ONE, _NONE], [_NONE, _ONE, _NONE], [_NONE, _NONE, np.diag(kept)]])
        covariance = np.diag(np.concatenate([np.zeros(6), 1.0 - kept**2]))
        added = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        covariance[:6, :6] = self._noise.density(self._speed) * np.kron(added, _ONE)
        self._add({B(self._frame - 1): -forward, body: np.eye(9)}, np.zeros(9), covariance)
        walk = dt * self._noise.walk(told.load, told.rest, self._speed)
        for foot, variance in zip(feet, walk, strict=True):
            self._add({foot - len(feet): -_ONE, foot: _ONE}, np.zeros(3), variance * _ONE)

    def _add(self, terms: Mapping[int, Floats], value: Floats, covariance: Floats) -> None:
        """A factor: the sum of matrices times variables is ``value``, with this covariance."""
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        blocks: list[Any] = []
        about = gtsam.Values()
        for key, matrix in terms.items():
            blocks += [key, whiten @ matrix]
            about.insert(key, np.zeros(matrix.shape[1]))
        factor = gtsam.JacobianFactor(*blocks, whiten @ value, gtsam.noiseModel.Unit.Create(len(value)))  # pyright: ignore
        self._factors.add(gtsam.LinearContainerFactor(factor, about))


def read(messages: Sequence[PoseClean]) -> Iterator[BodyEstimate]:
    """What the stages of `pose/world` have of a clip of one body, over a calibrated floor."""
    core, scene = WorldCore(TrajectorySettings()), Scene(calibrated=True)
    for message in messages:
        pose = message.sensor_pose
        yield from core.step(
            scene, observe(message.bodies, message.stamp_ns, pose.orientation, pose.position, scene.last)
        )


def follow(messages: Sequence[PoseClean]) -> Way:
    """A clip of one body whose legs are always seen, each frame answered at once."""
    graph = FactorGraph(BodyNoise(network_memory_s=VelocityNetwork("default").memory_s))
    feet, contacts = list(FEET), [CONTACT_JOINTS.index(joint) for joint in FEET]
    positions, velocity, sigma = [], [], []
    for estimate in read(messages):
        seen, motion = estimate.observed, estimate.velocity
        assert motion
        local = seen.positions - seen.positions[0]
        root = seen.positions[0] if seen.root_observed else None
        load, rest = (p[contacts].astype(float) for p in (estimate.contacts.load, estimate.contacts.rest))
        told = Told(root, seen.root_sigma, motion.velocity, motion.sigma, local[feet], seen.feet_sigma, load, rest)
        body, covariance, places = graph.update(told, seen.dt)
        joints = body[:3] + local
        joints[feet] = places
        positions.append(joints)
        velocity.append(body[3:6])
        sigma.append(np.sqrt(np.diag(covariance)[:3]))
    return Way(np.stack(positions), np.stack(velocity), np.stack(sigma))
