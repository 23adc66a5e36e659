from copy import deepcopy
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

from steadypose.prior.body.skeleton import REST_POSITIONS, limbs
from steadypose.prior.world.filter import RootFilter
from steadypose.prior.world.floor import Floor
from steadypose.prior.world.kalman import BodyFilter, BodyNoise
from steadypose.prior.world.networks import RootVelocity, Stance
from steadypose.prior.world.observe import FEET, BodyObservation

DT = 1 / 30
LEGS = [joint for leg in limbs(("knee", "ankle", "foot")) for joint in leg]
SWINGS = Stance(np.zeros(4), np.zeros(4))
STILL = RootVelocity(np.zeros(3), np.full(3, 0.1))
SOLES = np.array([0.07, 0.07, 0.022, 0.022])
HIDDEN = np.inf


def seen(root: Any, dt: float = DT, sigma: float = 0.02, root_sigma: float | None = None, legs=1.0) -> BodyObservation:
    """A body in the rest pose, of which a share of the legs is observed."""
    positions = REST_POSITIONS - REST_POSITIONS[0] + root
    observed = np.ones(22, dtype=bool)
    observed[LEGS] = np.arange(len(LEGS)) < legs * len(LEGS)
    sigmas = np.full(22, sigma)
    return BodyObservation(
        cast(Any, None), 0, dt, positions, np.array([0.0, 0.0, 0.0, 1.0]), observed, sigmas,
        sigma if root_sigma is None else root_sigma, True,
    )  # fmt: skip


def split(sigma: Any) -> tuple[Any, Any]:
    """Standard deviations of an error's independent and of its slow part."""
    return 0.3 * sigma, np.sqrt(0.91) * sigma


@pytest.mark.parametrize(
    ("root", "root_sigma", "legs", "inferred"),
    [(0.0, None, 1.0, 0.0), (0.0, None, 0.5, 0.5), (0.0, HIDDEN, 0.0, 1.0), (np.nan, HIDDEN, 1.0, 1.0)],
)
def test_a_first_velocity_is_the_networks_as_far_as_the_legs_are_observed(root, root_sigma, legs, inferred) -> None:
    ours = RootFilter(seen(np.zeros(3), 0.0, root_sigma=root_sigma), BodyNoise(first_speed=1.0))
    walks = RootVelocity(np.array([1.0, 0.0, 0.0]), np.full(3, 0.2))
    state = ours.update(seen(np.full(3, root), 0.0, root_sigma=root_sigma, legs=legs), walks, SWINGS, Floor(True))
    np.testing.assert_allclose(state.velocity, [1 / (1 + 0.2**2 + (0.5 * inferred) ** 2), 0, 0], atol=1e-9)


def test_it_is_a_kalman_filter_of_what_is_seen_and_of_standing_feet_while_the_root_is_hidden() -> None:
    rng, floor, noise = np.random.default_rng(0), Floor(calibrated=True), BodyNoise()
    for _ in range(30):  # a step on which the body stands at the edge: it ends 40 cm from where feet have been
        floor.observe(np.array([0.0, 0.0, 0.3]), 0.02, DT)
    edge = np.array([0.39, 0.0, 1.25]) - [REST_POSITIONS[FEET[2], 0] - REST_POSITIONS[0, 0], 0.0, 0.0]
    roots = edge + 0.01 * rng.normal(size=(24, 3)) * [0.0, 1.0, 1.0]
    ours = RootFilter(seen(roots[0], 0.0), noise)
    theirs = BodyFilter(noise, roots[0], *split(0.02), np.zeros(3), 4)
    off, raised, shift = np.zeros(3), 0, np.zeros(3)
    for t, root in enumerate(roots):
        hidden, dt = t >= 12, DT if t else 0.0
        now = seen(root, dt, root_sigma=HIDDEN if hidden else None)
        network = RootVelocity(0.2 * rng.normal(size=3), rng.uniform(0.05, 0.2, 3))
        stance = Stance(np.array([1.0, 0.8, 0.8, 0.3]), np.array([0.9, 0.4, 0.6, 0.0]))
        state = ours.update(now, network, stance, floor)
        if t:
            theirs.predict(dt, *stance)
        if t and not hidden:
            off += (1 - np.exp(-DT / 0.5)) * ((root - roots[t - 1]) / DT - network.velocity - off)
        sigma = network.sigma if hidden else np.hypot(network.sigma, np.linalg.norm(off))
        theirs.observe_velocity(network.velocity, *split(sigma))
        if not hidden:
            theirs.observe_position(root, *split(0.02))
        for foot, place in enumerate(now.feet):
            theirs.observe_foot(foot, place - hidden * root, *split(0.02), from_root=hidden)
        for foot in (0, 2):
            under = floor.under(theirs.feet[foot] - [0.0, 0.0, SOLES[foot]])
            if hidden and np.isfinite(under):
                raised += 1
                theirs.observe_foot_height(foot, under + SOLES[foot], np.hypot(floor.sigma, 0.02))
        np.testing.assert_allclose(state.position, theirs.position, atol=1e-9)
        np.testing.assert_allclose(state.velocity, theirs.velocity, atol=1e-9)
        np.testing.assert_allclose(state.covariance, theirs.covariance, atol=1e-9)
        np.testing.assert_allclose(state.feet, theirs.feet, atol=1e-9)
        shift = hidden * (theirs.position - root)
        np.testing.assert_allclose(state.shift, shift, atol=1e-9)
    assert raised > 12
    for later in range(1, 4):
        after = ours.update(seen(roots[-1]), STILL, SWINGS, floor)
        np.testing.assert_allclose(after.shift, shift * np.exp(-later * DT / 0.1), atol=1e-9)


def settled(sigma: float = 0.02) -> RootFilter:
    """The filter of a body that has stood at the origin for a second."""
    ours = RootFilter(seen(np.zeros(3), 0.0, sigma=sigma), BodyNoise())
    for t in range(30):
        ours.update(seen(np.zeros(3), DT if t else 0.0, sigma=sigma), STILL, SWINGS, Floor(True))
    return ours


def places(ours: RootFilter, at: float, frames: int, sigma: float = 0.02) -> NDArray[np.float64]:
    """Where the root is estimated, along the axis along which it has jumped."""
    now = seen(np.array([0.0, at, 0.0]), sigma=sigma)
    states = [ours.update(now, STILL, SWINGS, Floor(True)) for _ in range(frames)]
    return np.array([state.position[1] for state in states])


def test_a_root_that_jumps_by_more_than_thirty_centimetres_is_believed_in_its_sixth_frame() -> None:
    assert places(settled(), 0.28, 1)[0] > 0.01
    assert abs(places(settled(), 0.32, 1)[0]) < 0.01
    found = places(settled(), 5.0, 6)
    assert np.abs(found[:5]).max() < 0.01
    assert found[5] == 5.0


def test_a_root_that_is_known_badly_may_jump_by_five_standard_deviations() -> None:
    spread = float(settled(0.2).update(seen(np.zeros(3), sigma=0.2), STILL, SWINGS, Floor(True)).position_sigma[1])
    gate = 5 * np.hypot(spread, 0.2)
    assert places(settled(0.2), 0.9 * gate, 1, 0.2)[0] > 0.05
    assert abs(places(settled(0.2), 1.2 * gate, 1, 0.2)[0]) < 0.05


def test_a_root_that_comes_back_elsewhere_is_believed_at_once_and_keeps_its_velocity() -> None:
    ours = settled()
    walks = RootVelocity(np.array([1.0, 0.0, 0.0]), np.full(3, 0.05))
    before = [ours.update(seen(np.zeros(3), root_sigma=HIDDEN), walks, SWINGS, Floor(True)) for _ in range(15)][-1]
    assert before.velocity[0] > 0.8
    after = ours.update(seen(np.array([3.0, 0.0, 0.0])), None, SWINGS, Floor(True))
    assert after.position[0] == 3.0
    assert after.velocity[0] == pytest.approx(before.velocity[0])


def test_a_network_at_odds_with_the_root_is_not_used_until_it_agrees_to_thirty_centimetres_a_second() -> None:
    ours, wrong = settled(), RootVelocity(np.array([1.0, 0.0, 0.0]), np.full(3, 0.1))

    def used(network: RootVelocity) -> bool:
        tried = [deepcopy(ours).update(seen(np.zeros(3)), say, SWINGS, Floor(True)) for say in (network, None)]
        return not np.allclose(tried[0].covariance, tried[1].covariance)

    assert used(wrong)
    ours.update(seen(np.array([0.0, 5.0, 0.0])), wrong, SWINGS, Floor(True))
    assert not used(STILL)  # the root may be elsewhere
    state = [ours.update(seen(np.zeros(3)), wrong, SWINGS, Floor(True)) for _ in range(60)][-1]
    close = [wrong._replace(velocity=state.velocity + [0.0, off, 9.0]) for off in (-0.35, -0.25, 0.25, 0.35)]
    assert [used(network) for network in close] == [False, True, True, False]


def test_after_a_gap_feet_stand_anew() -> None:
    for dt, stands in ((0.29, True), (0.31, False)):
        ours = settled()
        moved = seen(np.array([0.2, 0.0, 0.0]), dt, sigma=0.1)
        rests = Stance(np.ones(4), np.ones(4))
        state = ours.update(moved, STILL, rests, Floor(True))
        assert np.allclose(state.feet[:, 0], moved.feet[:, 0]) != stands


def test_feet_that_are_not_known_have_no_place() -> None:
    ours, now = settled(), seen(np.zeros(3))
    now.positions[FEET[1]] = np.nan
    now.sigma[FEET[2]] = np.inf
    assert np.isnan(ours.update(now, STILL, SWINGS, Floor(True)).feet[:, 0]).tolist() == [False, True, True, False]


def spring(rate: float, dt: float) -> NDArray[np.float64]:
    """Of an error and its rate in units of ``rate``: x'' = -2 w x' - w² x."""
    return np.asarray(expm(rate * dt * np.array([[0.0, 1.0], [-1.0, -2.0]])), dtype=np.float64)


def diagonal(*blocks: Any) -> NDArray[np.float64]:
    return np.asarray(block_diag(*blocks), dtype=np.float64)


class Textbook:
    """One axis, dense matrices."""

    def __init__(self, noise: BodyNoise, position, jitter, bias, velocity, feet):
        self.noise, self.feet = noise, feet
        self.x = np.r_[position, velocity, np.zeros(3 + 3 * feet)]
        self.p = np.diag([jitter**2 + bias**2, noise.first_speed**2, 1.0, 1.0, 1.0] + [0.0, 1.0, 1.0] * feet)
        self.p[0, 2] = self.p[2, 0] = -bias

    def predict(self, dt, load, rest, speed):
        n = self.noise
        root = spring(n.sensor_rate + speed / n.sensor_memory_m, dt)
        foot = spring(n.sensor_rate, dt)
        kept = np.exp(-dt / n.network_memory_s)
        f = diagonal([[1, dt], [0, 1]], root, kept, *[diagonal(1, foot)] * self.feet)
        a = (n.acceleration + n.acceleration_at_speed * speed) ** 2
        q = [a * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(2) - root @ root.T, 1 - kept**2]
        for bears, r in zip(load, rest, strict=True):
            rolls = max(bears - r, 0.0)
            slip = 1 + n.slip_at_speed * speed
            walk = (slip * n.rest) ** (2 * r) * (slip * n.load) ** (2 * rolls) * n.swing ** (2 * (1 - r - rolls)) * dt
            q += [walk, np.eye(2) - foot @ foot.T]
        self.x, self.p = f @ self.x, f @ self.p @ f.T + diagonal(*q)

    def correct(self, entries, z, sigma):
        h = np.zeros(len(self.x))
        h[list(entries)] = list(entries.values())
        k = self.p @ h / (h @ self.p @ h + sigma**2)
        self.x = self.x + k * (z - h @ self.x)
        self.p = self.p - np.outer(k, h) @ self.p

    def place(self, at, z, jitter, bias, from_root):
        """A foot seen once is where it is seen, less two errors of its own: the limit of a vague prior."""
        self.x[at : at + 3] = z + from_root * self.x[0], 0.0, 0.0
        self.p[at : at + 3], self.p[:, at : at + 3] = 0.0, 0.0
        self.p[at], self.p[:, at] = from_root * self.p[0], from_root * self.p[:, 0]
        self.p[at, at] = from_root * self.p[0, 0] + jitter**2 + bias**2
        self.p[at, at + 1] = self.p[at + 1, at] = -bias
        self.p[at + 1, at + 1] = self.p[at + 2, at + 2] = 1.0


def test_agrees_with_a_textbook_filter():
    rng = np.random.default_rng(0)
    start = rng.normal(size=3)
    noise = BodyNoise(3.0, 2.0, sensor_rate=5.0, network_memory_s=0.2)
    velocity = np.array([1.0, 0.2, 0.0])
    ours = BodyFilter(noise, start, 0.02, 0.05, velocity, feet=2)
    theirs = [Textbook(noise, start[a], 0.02, 0.05, velocity[a], feet=2) for a in range(3)]
    for step in range(40):
        load, rest = np.sort(rng.random((2, 2)), axis=0)[::-1]
        speed = np.hypot(*ours.velocity[:2])
        ours.predict(DT, load, rest)
        seen, at_root, network, foot = rng.normal(size=(4, 3))
        ours.observe_velocity(network, 0.1, 0.3)
        if step < 20:
            ours.observe_position(seen, 0.02, 0.05)
        ours.observe_foot(0, foot, 0.01, 0.03, from_root=False)
        ours.observe_foot(1, at_root, 0.01, 0.03, from_root=True)
        for a, each in enumerate(theirs):
            each.predict(DT, load, rest, speed)
            each.correct({1: 1.0, 4: 0.3}, network[a], 0.1)
            if step < 20:
                each.correct({0: 1.0, 2: 0.05}, seen[a], 0.02)
            if step == 0:
                each.place(5, foot[a], 0.01, 0.03, from_root=0.0)
                each.place(8, at_root[a], 0.01, 0.03, from_root=1.0)
            else:
                each.correct({5: 1.0, 6: 0.03}, foot[a], 0.01)
                each.correct({8: 1.0, 9: 0.03, 0: -1.0}, at_root[a], 0.01)
    for a, each in enumerate(theirs):
        np.testing.assert_allclose([ours.position[a], ours.velocity[a]], each.x[:2], atol=1e-8)
        np.testing.assert_allclose(ours.feet[:, a], each.x[[5, 8]], atol=1e-8)
        np.testing.assert_allclose(ours.covariance[a::3, a::3], each.p[:2, :2], atol=1e-8)


def test_foot_height_tells_only_the_height_of_root_and_foot():
    f = BodyFilter(BodyNoise(), np.zeros(3), 0.5, 0.0, np.zeros(3), feet=2)
    f.observe_foot(1, np.array([0.0, 0.0, -0.9]), 0.01, 0.0, from_root=True)
    f.observe_foot_height(1, 0.08, 0.02)
    assert f.position[2] == pytest.approx(0.98, abs=0.01)
    assert f.feet[:, 2] == pytest.approx([0.0, 0.08], abs=0.01)
    assert f.position_sigma[2] < 0.03
    assert (f.position_sigma[:2] > 0.49).all()
    assert f.placed.tolist() == [False, True]
    f.lose(1)
    assert not f.placed.any()


@pytest.mark.parametrize(("speed", "slips"), [(0.0, 1.0), (2.0, 2.0)])
def test_feet_walk_and_the_root_accelerates_more_the_faster_the_root_moves(speed: float, slips: float):
    load, rest = np.array([1.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    expected = np.array([0.006 * slips, 0.2 * slips, 4.0]) ** 2
    np.testing.assert_allclose(BodyNoise().walk(load, rest, speed), expected)
    assert BodyNoise().density(speed) == pytest.approx((3.0 + speed) ** 2)
    f = BodyFilter(BodyNoise(), np.zeros(3), 0.01, 0.0, np.array([0.6 * speed, -0.8 * speed, 9.0]), feet=3)
    for foot in range(3):
        f.observe_foot(foot, np.zeros(3), 0.01, 0.0, from_root=False)
    f.predict(DT, load, rest)
    np.testing.assert_allclose(f.feet_sigma**2, np.tile((0.01**2 + expected * DT)[:, None], (1, 3)))
