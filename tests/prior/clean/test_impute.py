import numpy as np
import pytest
from tests.helpers.bodies import stream, waving
from tests.helpers.values import clean, clean_bodies

from steadypose.msgs.types import JointState
from steadypose.prior.body.skeleton import J
from steadypose.prior.clean.impute import CARRY_FRAMES, _carried
from steadypose.prior.clean.settings import ImputeSettings, PriorSettings

ARM = [J["left_elbow"], J["left_wrist"]]


def hidden_arm(frames: int = 70, start: int = 50) -> np.ndarray:
    seen = waving(frames)
    seen[start:, ARM] = np.nan
    return seen


def test_what_the_model_was_off_is_carried_into_a_gap_from_both_sides_and_fades() -> None:
    off = np.zeros((2, 6))
    observed = np.ones((2, 6))
    off[0, 1], off[0, 4] = 1.0, 2.0
    observed[0, 2:4] = 0
    observed[1, 3:] = 0
    off[1, 2] = 1.0
    carried = _carried(off, observed, CARRY_FRAMES, np.ones(2, dtype=np.int64))
    near, far = np.exp(-1 / CARRY_FRAMES), np.exp(-2 / CARRY_FRAMES)
    assert carried[0, 2] == pytest.approx(2 / 3 * near + 1 / 3 * 2 * far)
    np.testing.assert_allclose(carried[1, 3:], np.exp(-np.arange(1, 4) / CARRY_FRAMES))
    np.testing.assert_array_equal(carried[observed > 0], off[observed > 0])


def test_beside_a_gap_the_mean_of_some_frames_is_carried_and_none_beyond_the_next_gap() -> None:
    off = np.array([[5.0, 1.0, 3.0, 0.0, 8.0, 0.0, 6.0, 9.0]])
    observed = np.array([[1.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 1.0]])
    carried = _carried(off, observed, 1e9, np.array([2]))
    np.testing.assert_allclose(carried[0, [3, 5]], [(2.0 + 8.0) / 2, (8.0 + 7.5) / 2])


def test_a_hidden_arm_is_imputed_better_than_held_and_marked() -> None:
    bodies, truth = clean_bodies(hidden_arm(), delay=0), waving(70)[:, ARM]
    held = np.linalg.norm(truth[51:65] - truth[49], axis=-1).mean()
    found = np.array([b.positions[ARM] for b in bodies])
    assert np.linalg.norm(found - truth, axis=-1)[51:65].mean() < held
    assert (bodies[45].state == JointState.REFINED).all()
    assert (bodies[60].sigma[ARM] > 1.1 * bodies[45].sigma[ARM]).all()
    assert all((b.state[ARM] == JointState.IMPUTED).all() for b in bodies[50:])
    assert all(np.isnan(b.raw_positions[ARM]).all() for b in bodies[50:])


def test_other_bodies_do_not_change_what_is_imputed() -> None:
    alone = clean_bodies(hidden_arm(45, 30), delay=0)
    messages = stream(hidden_arm(45, 30))
    for message, other in zip(messages, stream(waving(45) + [2.0, 0.0, 0.0]), strict=True):
        body = other.bodies[0]
        body.id = 5
        body.positions[ARM] = np.nan
        message.bodies.append(body)
    beside = [c.bodies[0] for c in clean(messages, delay=0)[0]]
    assert all(np.allclose(a.positions, b.positions, atol=1e-6) for a, b in zip(alone, beside, strict=True))


def test_switched_off_hidden_joints_follow_the_refinement_model() -> None:
    refined = {"impute": {"enabled": False}, "refine": {"enabled": True}}
    off = clean_bodies(hidden_arm(45, 30), delay=0, **refined, score={"enabled": False})
    scored = clean_bodies(hidden_arm(45, 30), delay=0, **refined)
    assert all((a.positions == b.positions).all() for a, b in zip(off, scored, strict=True))
    assert all((b.state[ARM] == JointState.IMPUTED).all() for b in off[30:])


def test_keys_of_the_version_before_are_ignored_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    assert PriorSettings.from_dict({"impute": {"steps": 2, "enabled": False}}).impute == ImputeSettings(enabled=False)
    assert "[prior.impute] steps: no longer used" in caplog.text
