"""Windows of a long track: how they are joined, told apart and read; what of a body and its messages is fitted."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.fit.motion import Motion
from steadypose.prior.fit.solve import FitSettings, Start, _stages
from steadypose.prior.fit.windows import _fingerprint, _grounded, _joined, load_of, window_bounds


def window(value: float, turned: float, frames: int = 6) -> dict[str, Any]:
    rotations = np.tile(yaw_matrix(np.array(turned)), (frames, 22, 1, 1))
    return {
        "joints": np.full((frames, 22, 3), value), "rotations": rotations, "load": np.full((frames, 8), value),
        "misfit": np.full((2, frames, 22), value), "offsets": np.full((22, 3), value), "ground": np.full(3, value),
        "energies": np.full(3, value),
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
