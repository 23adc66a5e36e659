"""Layouts that a user describes in TOML."""

from __future__ import annotations

import numpy as np
import pytest

from steadypose.prior.body.layouts import COCO17, SKELETONS, add_layouts, to_canonical


@pytest.mark.usefixtures("own_layouts")
def test_names_that_are_known_need_no_table() -> None:
    add_layouts({"own17": {"joints": list(COCO17.joints)}})
    joints = np.random.default_rng(0).normal(size=(5, 17, 3))
    np.testing.assert_allclose(to_canonical(SKELETONS["own17"], joints)[0], to_canonical(COCO17, joints)[0])


@pytest.mark.usefixtures("own_layouts")
def test_other_names_and_means() -> None:
    joints = ["Top", "hl", "hr", "left_shoulder", "right_shoulder", "chest"]
    table = {"left_hip": "hl", "right_hip": "hr", "head": "Top", "spine3": ["chest", "left_shoulder", "right_shoulder"]}
    add_layouts({"own6": {"joints": joints, "canonical": table}})
    mapped = SKELETONS["own6"].table
    assert mapped["head"] == "Top"
    assert mapped["pelvis"] == {"hl": 1.0, "hr": 1.0}
    assert mapped["neck"] == {"left_shoulder": 1.0, "right_shoulder": 1.0}
    assert set(mapped["spine3"]) == {"chest", "left_shoulder", "right_shoulder"}
    assert "left_knee" not in mapped


CORNERS = ["left_hip", "right_hip", "left_shoulder", "right_shoulder"]


@pytest.mark.parametrize(
    ("description", "said"),
    [
        ("joints", "expected a section"),
        ({"joints": CORNERS, "order": 1}, "got order"),
        ({"joints": [*CORNERS, "left_hip"]}, "each once"),
        ({"joints": "left_hip"}, "list of names"),
        ({}, "list of names"),
        ({"joints": CORNERS[1:]}, "expected to find left_hip"),
        ({"joints": CORNERS, "canonical": {"nose": "left_hip"}}, "joints of smpl22"),
        ({"joints": CORNERS, "canonical": {"head": "Top"}}, "expected names of joints, got .*Top"),
        ({"joints": CORNERS, "canonical": {"head": []}}, "expected names of joints"),
        ({"joints": CORNERS, "canonical": 3}, "expected a section"),
    ],
)
def test_what_is_wrong_is_named(description: object, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        add_layouts({"bad": description})
    assert "bad" not in SKELETONS


def test_a_name_that_is_taken() -> None:
    with pytest.raises(ValueError, match="another layout called coco17"):
        add_layouts({"coco17": {"joints": CORNERS}})
