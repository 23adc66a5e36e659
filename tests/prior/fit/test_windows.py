from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import waving

from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import REST_OFFSETS
from steadypose.prior.fit import windows
from steadypose.prior.fit.energy import Smooth, energy
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.motion import Motion, Variables
from steadypose.prior.fit.observations import SeenJoints
from steadypose.prior.fit.solve import DISCREPANCY, FitSettings, Start, _explains, _stages, fit_window
from steadypose.prior.fit.windows import _fingerprint, _grounded, _joined, load_of, window_bounds


def window(value: float, turned: float, frames: int = 6) -> dict[str, Any]:
    rotations = np.tile(yaw_matrix(np.array(turned)), (frames, 22, 1, 1))
    return {
        "joints": np.full((frames, 22, 3), value), "rotations": rotations, "load": np.full((frames, 8), value),
        "misfit": np.full((2, frames, 22), value), "offsets": np.full((22, 3), value), "ground": np.full(3, value),
        "energies": np.full(3, value), "kept": np.array(value > 0.5),
    }  # fmt: skip


def test_windows_are_faded_over_where_they_overlap() -> None:
    found = _joined([window(0.0, 0.0), window(1.0, 1.0), window(2.0, 2.0)], [(0, 6), (3, 9), (7, 13)])
    line = [0, 0, 0, 0.25, 0.5, 0.75, 1, 1 + 1 / 3, 1 + 2 / 3, 2, 2, 2, 2]
    for values in (found.joints[:, 4, 1], found.load[:, 3], found.misfit[1, :, 5]):
        np.testing.assert_allclose(values, line)
    turns = Rotation.from_matrix(found.rotations[:, 7]).as_rotvec()
    np.testing.assert_allclose(turns, np.outer(line, [0.0, 0.0, 1.0]), atol=1e-12)
    for values in (found.offsets[:, 3, 1], found.ground[:, 2], found.energies[:, 0]):
        assert values.tolist() == [0.0, 1.0, 2.0]
    assert found.kept.tolist() == [False, True, True]


def test_windows_follow_each_other_every_two_and_a_half_seconds() -> None:
    assert window_bounds(90) == [(0, 90)]
    assert window_bounds(91) == [(0, 90), (1, 91)]
    assert window_bounds(165) == [(0, 90), (75, 165)]
    assert window_bounds(200) == [(0, 90), (75, 165), (110, 200)]


def test_whatever_a_fit_depends_on_tells_windows_apart() -> None:
    model = torch.nn.Linear(2, 2)
    start = Start(torch.zeros(3, 3), torch.zeros(3, 22, 3, 3), torch.zeros(22, 3))
    given: list[Any] = [[start], FitSettings(), 3]
    found = [_fingerprint(cast(Any, model), *given)]
    assert found == [_fingerprint(cast(Any, model), *given)]
    for other in (
        [[replace(start, root=start.root + 1e-6)], *given[1:]],
        [[start, start], *given[1:]],
        [[start], replace(FitSettings(), bones_sigma=0.02), 3],
        [*given[:2], 2],
    ):
        found.append(_fingerprint(cast(Any, model), *other))
    model.weight.data += 1e-6
    found.append(_fingerprint(cast(Any, model), *given))
    assert len(set(found)) == 6


def test_load_is_that_of_the_first_logits_and_the_first_frames_have_the_thirds() -> None:
    logits = torch.cat([torch.logit(torch.tensor([[0.2], [0.7]])).expand(2, 8), torch.zeros(2, 8)], dim=1)
    joints = torch.zeros(4, 22, 3)
    found = load_of(cast(Motion, SimpleNamespace(predicted=(None, logits), joints=joints)))
    np.testing.assert_allclose(found, np.tile([[0.2], [0.2], [0.2], [0.7]], (1, 8)), atol=1e-6)
    none = load_of(cast(Motion, SimpleNamespace(predicted=(None, logits[:, :0]), joints=joints)))
    assert none.shape == (4, 8)
    assert np.isnan(none).all()


@pytest.mark.parametrize(("degrees", "lies"), [(55.0, False), (65.0, True), (180.0, True)])
def test_a_pelvis_tilted_by_more_than_sixty_degrees_lies(degrees: float, lies: bool) -> None:
    rotations = torch.eye(3).repeat(5, 22, 1, 1)
    rotations[2, 0] = torch.from_numpy(Rotation.from_euler("y", degrees, degrees=True).as_matrix())
    start = Start(torch.zeros(5, 3), rotations, torch.zeros(22, 3))
    assert _grounded(start).ground_known == lies
    assert _grounded(replace(start, ground_known=True)).ground_known


@pytest.mark.parametrize("known", [False, True])
def test_a_floor_that_is_known_is_no_variable_and_only_the_last_stage_has_latents(known: bool) -> None:
    start = Start(torch.zeros(5, 3), torch.zeros(5, 22, 3, 3), torch.zeros(22, 3), 0.2, known)
    root, poses, motion = _stages(start, [], FitSettings())
    assert root.free == ("root", "orientation")
    assert poses.free == ("root", "orientation", "turns", "bones", *([] if known else ["ground"]))
    assert motion.free == (*poses.free, "latents")
    names = [[type(term).__name__ for term in stage.terms] for stage in (root, poses, motion)]
    ground = [] if known else ["Ground"]
    assert names[0] == ["Smooth"]
    assert names[1] == ["Bones", *ground, "Smooth", "FirstState"]
    assert names[2] == ["Bones", *ground, "Transitions", "FirstState", "Standing", "Smooth"]


def test_each_stage_lowers_the_energy_of_its_terms_and_says_so() -> None:
    torch.manual_seed(0)
    model = HumorNet(HumorConfig(hidden=64, latent=4, components=2)).eval()
    positions = waving(6) + 0.01 * np.random.default_rng(0).standard_normal((6, 22, 3))
    start = Start.of(positions[:, 0] + 0.05, np.tile(np.eye(3), (6, 22, 1, 1)), REST_OFFSETS)
    seen = SeenJoints(torch.from_numpy(positions).float(), torch.full((6, 22), 0.02))
    brief = FitSettings(root_steps=20, pose_steps=20, motion_steps=20, acceleration_share=0.0, discrepancy=torch.inf)
    told: list[int] = []
    found = fit_window(model, start, [seen], brief, advanced=lambda: told.append(1))
    assert len(found.energies) == len(told) == 3
    assert found.kept
    assert not any(p.requires_grad for p in model.parameters())
    assert not found.motion.variables.root.requires_grad
    before = Variables.initial(start.root, start.rotations, start.offsets, 0.0, 4)
    stages = _stages(start, [seen], brief)
    assert float(energy(found.motion, stages[2].terms)) == pytest.approx(found.energies[2], rel=1e-4)
    for number in (1, 2):
        upto = fit_window(model, start, [seen], brief, stages=number)
        assert upto.energies == pytest.approx(found.energies[:number], rel=1e-3)
        value = float(energy(upto.motion, stages[number - 1].terms))
        assert value == pytest.approx(upto.energies[-1], rel=1e-4)
        assert value < 0.6 * float(energy(Motion(model, before), stages[number - 1].terms))
        changed = {name for name in stages[2].free if getattr(upto.motion.variables, name).any()}
        assert changed == set(stages[number - 1].free)


def test_a_motion_model_that_contradicts_the_observations_is_left_out() -> None:
    torch.manual_seed(0)
    model = HumorNet(HumorConfig(hidden=64, latent=4, components=2)).eval()  # not trained
    positions = waving(6)
    start = Start.of(positions[:, 0], np.tile(np.eye(3), (6, 22, 1, 1)), REST_OFFSETS)
    seen = SeenJoints(torch.from_numpy(positions).float(), torch.full((6, 22), 0.01))
    settings = FitSettings(root_steps=20, pose_steps=20, motion_steps=20)
    found, before = fit_window(model, start, [seen], settings), fit_window(model, start, [seen], settings, stages=2)
    assert not found.kept
    assert len(found.energies) == 3
    torch.testing.assert_close(found.motion.joints, before.motion.joints)
    assert before.kept


@pytest.mark.parametrize(
    ("before", "after", "kept"), [(50.0, 53.9, True), (50.0, 54.1, False), (1.0, 9.9, True), (1.0, 10.1, False)]
)
def test_the_last_stage_may_explain_a_little_less_or_all_below_the_noise(before: float, after: float, kept: bool):
    def of(nats: float) -> Motion:
        return cast(Motion, torch.full((200,), (nats / 100.0) ** 0.5))  # 200 residuals; 100 nats are their noise's

    term = cast(Any, SimpleNamespace(residual=lambda values: values, kernel=lambda square: square))
    assert _explains(of(after), of(before), [term], DISCREPANCY) == kept


def test_smoothness_yields_to_what_a_joint_does_and_not_to_a_jump() -> None:
    root = torch.zeros(30, 3)
    root[:, 0] = 0.5 * 6.0 * (torch.arange(30) / 30.0) ** 2
    root[20:, 1] += 0.3
    start = Start(root, torch.eye(3).repeat(30, 22, 1, 1), torch.zeros(22, 3))
    (smooth,) = _stages(start, [], FitSettings(smooth_sigma=4.0, acceleration_share=2.0))[0].terms
    assert isinstance(smooth, Smooth)
    assert isinstance(smooth.sigma, torch.Tensor)
    expected = torch.full((28, 22), (4.0**2 + 2.0**2 * 6.0**2 / 3.0) ** 0.5)
    torch.testing.assert_close(smooth.sigma, expected, rtol=1e-3, atol=0.0)


def test_bodies_are_fitted_where_the_window_before_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "FRAMES", 8)
    monkeypatch.setattr(windows, "OVERLAP", 2)
    given: list[tuple[Start, Any, Any, int]] = []

    def fit(model: Any, start: Start, seen: Any, settings: Any, *, anchor: Any, stages: int) -> Any:
        given.append((start, seen[0], anchor, stages))
        return SimpleNamespace(energies=(9.0, float(start.root[0, 0])), frames=len(start.root), number=len(given))

    def arrays(fitted: Any, seen: Any) -> dict[str, Any]:
        return {**window(fitted.number, 0.0, fitted.frames), "misfit": np.zeros((1, fitted.frames, 22))}

    monkeypatch.setattr(windows, "fit_window", fit)
    monkeypatch.setattr(windows, "_arrays", arrays)
    roots = np.arange(42.0).reshape(14, 3)
    starts = [Start.of(roots + off, np.tile(np.eye(3), (14, 22, 1, 1)), REST_OFFSETS) for off in (5.0, 0.0)]
    seen = SeenJoints(torch.arange(14 * 66).reshape(14, 22, 3).float(), torch.ones(14, 22))
    told: list[int] = []
    settings, model = FitSettings(), cast(Any, torch.nn.Linear(1, 1))
    windows.fit_track(
        model, windows.Track(starts, [seen]), settings, stages=2, advanced=lambda: told.append(len(given))
    )
    assert told == [2, 3], "the second window only from the better start"
    assert [stages for *_, stages in given] == [2, 2, 2]
    start, joints, anchor, _ = given[2]
    np.testing.assert_array_equal(start.root.numpy(), roots[6:14])
    np.testing.assert_array_equal(joints.positions.numpy(), seen.positions[6:14].numpy())
    assert (start.offsets == 2.0).all()
    assert start.ground == 2.0
    np.testing.assert_array_equal(anchor.joints.numpy(), np.full((2, 22, 3), 2.0))
    assert given[0][2] is given[1][2] is None
