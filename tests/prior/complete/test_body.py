import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.helpers.bodies import waving

from steadypose.prior.body.inverse_kinematics import place_joints, solve_rotations
from steadypose.prior.body.skeleton import HIPS, REST_OFFSETS, J
from steadypose.prior.complete import body, parts
from steadypose.prior.complete.body import LONGEST, LONGEST_GAP, Uncertainty, complete, frames_apart, gaps, views
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.complete.stream import is_root_centred, root_path
from steadypose.prior.models.completer import LiveCompleter
from steadypose.prior.models.posture import LivePosture
from steadypose.prior.models.root_velocity import NewestMotion
from steadypose.prior.sim.noise import time_correlated

POSTURE = LivePosture.load("default")
LEGS = [J[f"{side}_{part}"] for side in ("left", "right") for part in ("knee", "ankle", "foot")]


class Oracle:
    """Knows how somebody moves."""

    def __init__(self, positions: np.ndarray) -> None:
        self.positions = positions

    def __call__(self, seen: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        known = np.isfinite(seen[0]).all(axis=-1)
        assert known.any(), "a window of which nothing is known tells nothing"
        assert len(known) <= LONGEST
        frames = np.flatnonzero(known.any(axis=1))
        joints = known[frames].argmax(axis=1)
        at = [
            int(np.linalg.norm(self.positions[:, joint] - seen[0, frame, joint], axis=-1).argmin())
            for frame, joint in zip(frames, joints, strict=True)
        ]
        ends = np.concatenate([[at[0] - frames[0]], at, [at[-1] + len(known) - 1 - frames[-1]]])
        rows = np.interp(np.arange(len(known)), np.array([0, *frames, len(known) - 1]), ends).round().astype(int)
        truth = self.positions[rows]
        return solve_rotations(truth, offsets[0])[None], truth[None, :, 0]


@given(
    frames=st.integers(3, 400),
    holes=st.lists(st.tuples(st.integers(0, 399), st.integers(1, LONGEST_GAP), st.booleans()), max_size=8),
)
@settings(max_examples=60, deadline=None)
def test_every_frame_with_something_missing_is_in_a_window_that_sees_the_ends_of_its_gap(frames, holes) -> None:
    known = np.ones((frames, 22), dtype=bool)
    for start, length, whole in holes:
        known[start : start + length, slice(None) if whole else slice(16, 22)] = False
    if any(gap.end - gap.start > LONGEST_GAP for gap in gaps(known)) or not known.any():
        return
    total = np.zeros(frames)
    for view in views(known):
        assert len(view.weight) <= LONGEST
        assert view.start >= 0
        assert view.frames.stop <= frames
        total[view.frames] += view.weight
        for gap in gaps(known):
            inside = slice(max(gap.start - view.start, 0), max(gap.end - view.start, 0))
            if view.weight[inside].any():
                assert view.start < gap.start or gap.start == 0
                assert view.frames.stop > gap.end or gap.end == frames
    assert (total[~known.all(axis=1)] > 0).all()


@pytest.mark.parametrize("hidden", [
    (slice(40, 90), slice(None)),  # a gap
    (slice(None), LEGS),  # a part
    (np.arange(300) % 15 > 0, slice(None)),  # key frames
    (slice(100, 250), slice(None)),  # longer than any window
    (slice(0, 20), slice(None)),  # the beginning
])  # fmt: skip
def test_who_knows_the_motion_gives_it_back(hidden: tuple, monkeypatch) -> None:
    for share in ("WHOLE", "PART", "LOWER_ARM"):  # splines do not know it
        monkeypatch.setattr(body, share, (0.0, 1.0))
    positions = waving(300)
    seen = positions.copy()
    seen[hidden] = np.nan
    done = complete(Oracle(positions), seen, REST_OFFSETS)
    known = np.isfinite(seen).all(axis=-1)
    assert np.array_equal(done.positions[known], positions[known])
    assert np.abs(done.positions - positions).max() < 6e-3
    assert np.abs(done.rotations - solve_rotations(positions, REST_OFFSETS)).max() < 1e-2
    assert np.array_equal(done.known, known)


def test_collars_that_are_never_known_are_means_and_others_are_completed() -> None:
    positions = waving(40)
    collars = [J["left_collar"], J["right_collar"]]
    positions[:, collars] = np.nan
    positions[10:20, J["left_wrist"]] = np.nan
    done = complete(Oracle(waving(40)), positions, REST_OFFSETS).positions
    shoulder, neck, spine3 = (done[:, J[name]] for name in ("right_shoulder", "neck", "spine3"))
    np.testing.assert_allclose(done[:, J["right_collar"]], 0.333 * spine3 + 0.278 * neck + 0.389 * shoulder)
    positions[0, collars] = waving(1)[0, collars]
    done = complete(Oracle(waving(40)), positions, REST_OFFSETS).positions
    mean = 0.333 * done[:, J["spine3"]] + 0.278 * done[:, J["neck"]] + 0.389 * done[:, J["right_shoulder"]]
    assert np.abs(done[:, J["right_collar"]] - mean).max() > 0.001, "it was known once"


def test_a_second_opinion_counts_where_a_part_is_hidden_and_nowhere_else() -> None:
    positions = waving(70)
    completer = LiveCompleter.load("default")
    both = PartsCompleter(completer)
    seen = positions.copy()
    seen[20:40] = np.nan
    assert np.array_equal(both(seen[None], REST_OFFSETS[None])[0], completer(seen[None], REST_OFFSETS[None])[0])
    seen[:, LEGS] = np.nan
    rotations, root = both(seen[None], REST_OFFSETS[None])
    alone, _ = completer(seen[None], REST_OFFSETS[None])
    legs = [J["left_hip"], J["right_hip"], J["left_knee"], J["right_knee"]]
    assert np.abs(rotations - alone)[0, :20][:, legs].max() > 1e-3
    upper = [J["left_elbow"], J["right_elbow"], J["neck"]]
    assert np.allclose(rotations[0, 20:40][:, upper], alone[0, 20:40][:, upper], atol=1e-3)
    known = np.isfinite(seen).all(axis=-1)
    placed = place_joints(rotations[0], REST_OFFSETS) + root[0][:, None]
    assert np.abs(placed - positions)[known].max() < 0.01


@pytest.mark.parametrize(("frames", "share"), [(8, parts.SHARE * 9 / 75), (30, parts.SHARE * 31 / 75)])
def test_a_second_opinion_counts_less_in_a_short_gap(frames: int, share: float, monkeypatch) -> None:
    """In a gap of n frames between observations n + 1 apart, it has the (n + 1) / 75th of its share."""
    positions, hidden = waving(100), (slice(40, 40 + frames), [J["left_knee"], J["left_ankle"], J["left_foot"]])
    seen = positions.copy()
    seen[hidden] = np.nan
    completer = LiveCompleter.load("default")
    both = PartsCompleter(completer)
    monkeypatch.setattr(parts, "gaussian_filter1d", lambda values, *_, **__: values)
    monkeypatch.setattr(parts, "fit_lengths", lambda joints, *_: joints)
    monkeypatch.setattr(both, "_second", lambda given, first, bones: first + 0.1)
    given: list[np.ndarray] = []
    solve = parts.solve_rotations
    monkeypatch.setattr(
        parts, "solve_rotations", lambda joints, *others: given.append(joints) or solve(joints, *others)
    )
    rotations, root = completer(seen[None], REST_OFFSETS[None])
    alone = place_joints(rotations[0], REST_OFFSETS) + root[0][:, None]
    both(seen[None], REST_OFFSETS[None])
    np.testing.assert_allclose(given[0][:, hidden[1]] - alone[hidden], 0.1 * share, atol=1e-6)


def test_what_is_far_from_all_that_is_known_is_not_made_up() -> None:
    positions = waving(300)
    seen = positions.copy()
    seen[100:] = np.nan
    done = complete(Oracle(positions), seen, REST_OFFSETS)
    assert np.isfinite(done.positions[: 100 + LONGEST_GAP]).all()
    assert np.isnan(done.positions[100 + LONGEST_GAP :]).all()
    with pytest.raises(ValueError, match="at least one frame"):
        complete(Oracle(positions), np.full((30, 22, 3), np.nan), REST_OFFSETS)


def test_doubt_grows_from_what_is_known() -> None:
    known = np.random.default_rng(0).random((40, 3)) < 0.2
    known[:, 2] = False
    apart = frames_apart(known)
    for t, k in np.ndindex(known.shape):
        rows = np.flatnonzero(known[:, k])
        assert apart[t, k] == (np.abs(rows - t).min() if len(rows) else np.inf)
    given_ = waving(60)
    given_[20:40, 18], given_[:, 20] = np.nan, np.nan
    sigma = Uncertainty((0.1,) * 22, 10.0, POSTURE).of(given_)
    assert (np.diff(sigma[19:30, 18]) > 0).all()
    assert (sigma[:19, 18] < 0.01).all()
    given_[50:, 19] = np.nan
    sigma = Uncertainty((0.1,) * 22, 10.0, POSTURE).of(given_)
    noise = sigma[0]
    half = np.hypot(0.05, noise[19])  # ten frames after its last frame, none follows
    between = np.hypot(0.1 / (1.0 + (10.0 * 21.0 / 110.0) ** 2), noise[18])  # ten frames after one, eleven before one
    np.testing.assert_allclose([sigma[59, 19], sigma[29, 18]], [half, between], rtol=1e-6)


def test_doubt_of_a_joint_that_is_never_known_depends_on_what_is() -> None:
    def of(*missing: str) -> np.ndarray:
        seen = waving(10)
        seen[:, [J[name] for name in missing]] = np.nan
        return Uncertainty((0.0,) * 22, 10.0, POSTURE).of(seen)[0]

    wrist, feet = J["left_wrist"], ("left_foot", "right_foot")
    assert 0.05 < of("left_wrist")[wrist] < 0.8 * of("left_wrist", "left_elbow")[wrist]
    assert of(*feet)[J["left_foot"]] < 0.04, "an ankle is known"
    assert of(*feet, "left_ankle", "right_ankle")[J["left_foot"]] > 0.06
    hips = ("pelvis", "left_hip", "right_hip")
    legs = [f"{side}_{part}" for side in ("left", "right") for part in ("knee", "ankle", "foot")]
    np.testing.assert_allclose(of(*hips, *legs)[[0, J["left_hip"]]], 0.12, rtol=1e-3)
    assert of(*hips)[J["left_hip"]] < 0.03
    seen = waving(10)
    seen[:, [J["neck"], J["head"]]] = np.nan
    sigma = Uncertainty((0.1,) * 22, 10.0, POSTURE).of(seen)[0, [J["neck"], J["head"]]]
    np.testing.assert_allclose(sigma, 0.1, rtol=1e-3)


@pytest.mark.parametrize(("gap", "at", "drift"), [
    (slice(30, 60), 44, 0.0045 * 15 * 31 / 60),  # 15 and 16 frames from its ends
    (slice(30, 149), 89, 0.00115 * 30**1.5),  # 60 from both
    (slice(30, 269), 149, 0.00115 * 60**1.5),  # 120 from both
    (slice(260, 300), 299, 0.00115 * 40**1.5),  # 40 after the last
])  # fmt: skip
def test_doubt_of_a_body_on_its_way_grows_with_the_gap(gap: slice, at: int, drift: float) -> None:
    seen = waving(300)
    seen[gap] = np.nan
    sigma = Uncertainty((0.0,) * 22, 1e-9, POSTURE).of(seen)
    np.testing.assert_allclose(sigma[at, 0], np.sqrt(drift**2 + 0.015**2 + sigma[0, 0] ** 2), rtol=1e-6)


class Walks:
    """A network that predicts of everybody that they walk forward at 1 m/s."""

    def start(self, count: int) -> np.ndarray:
        return np.zeros((count, 0))

    def __call__(self, features: np.ndarray, state: np.ndarray) -> NewestMotion:
        velocity = np.tile(np.array([1.0, 0.0, 0.0], np.float32), (len(features), 1))
        return NewestMotion(velocity, np.zeros_like(velocity), state)


def test_a_way_is_read_from_motion() -> None:
    positions = waving(61)
    centred = positions - positions[:, :1]
    assert is_root_centred(centred)
    assert is_root_centred(positions - positions[:, list(HIPS)].mean(axis=1, keepdims=True) + 1e-3), "as MediaPipe's"
    assert not is_root_centred(positions)
    assert not is_root_centred(np.repeat(centred[:1], 61, axis=0)), "nothing moves at all"
    facing = np.tile(np.eye(3), (61, 1, 1))
    way = root_path(Walks(), centred, facing)  # type: ignore[arg-type]
    assert np.allclose(way[-1, :2], [2.0, 0.0], atol=1e-6)
    assert np.allclose((centred + way[:, None])[..., 2].min(axis=1), 0.02, atol=0.06)


ARM = [J["left_shoulder"], J["left_elbow"], J["left_wrist"]]


@pytest.mark.parametrize(
    ("correlation", "sigma", "away", "frames", "off"),
    [(0.0, 0.01, slice(None), 15, 0.03), (0.0, 0.01, ARM, 15, 0.03), (0.95, 0.02, ARM, 6, 0.05)],
)
def test_noise_does_not_throw_a_body_off_course_in_a_gap(
    correlation: float, sigma: float, away: slice | list[int], frames: int, off: float
) -> None:
    truth = waving(150)
    seen = truth + time_correlated(np.random.default_rng(0).normal(0.0, sigma, truth.shape), correlation)
    seen[60 : 60 + frames, away] = np.nan
    done = complete(PartsCompleter(LiveCompleter.load("default")), seen, REST_OFFSETS)
    assert np.linalg.norm(done.positions - truth, axis=-1)[60 : 60 + frames, away].mean() < off
    known = np.isfinite(seen)
    np.testing.assert_array_equal(done.positions[known], seen[known])


def test_short_gaps_are_nearer_to_each_joints_spline_than_long_ones() -> None:
    positions, off = waving(300), []

    class Raised(Oracle):
        """A completer that is 10 cm too high."""

        def __call__(self, seen: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            rotations, root = super().__call__(seen, offsets)
            return rotations, root + np.where(np.isfinite(seen).all(axis=(-1, -2)), 0.0, 0.1)[..., None] * (0, 0, 1)

    for gap in (6, 30, 60):
        seen = positions.copy()
        seen[100 : 100 + gap] = np.nan
        done = complete(Raised(positions), seen, REST_OFFSETS)
        off.append((done.positions - positions)[100 + gap // 2, 0, 2])
    np.testing.assert_allclose(off, (0.055, 0.075, 0.1), atol=0.006)


def test_a_lower_arm_follows_its_spline_less_where_its_shoulder_is_known() -> None:
    known = np.ones((60, 22), dtype=bool)
    known[20:30, [J["left_wrist"], J["right_shoulder"], J["right_wrist"], J["left_foot"]]] = False
    share, _ = body.splines(waving(60), known)
    parts = "left_wrist", "right_shoulder", "right_wrist", "left_foot"
    np.testing.assert_allclose(share[25, [J[part] for part in parts]], (0.4, 0.6, 0.6, 0.6))
    assert not share[25, known[25]].any()
