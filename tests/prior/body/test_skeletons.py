import numpy as np
import pytest

from steadypose.prior.body.layouts import COCO17, SKELETONS, add_layouts, to_canonical
from steadypose.prior.body.skeleton import BONES_BETWEEN, JOINTS, MIRROR, PARENTS, REST_OFFSETS, REST_POSITIONS, J

EXPECTED_COUNTS = {
    "smpl22": 22, "coco17": 17, "blazepose33": 33, "h36m17": 17, "kinect22": 22, "azure_kinect32": 32, "zed38": 38,
    "openpose25": 25, "kinect25": 25, "smpl24": 24, "coco_wholebody23": 23, "halpe26": 26, "zed18": 18, "zed34": 34,
    "mhr70": 70, "soma77": 77,
}  # fmt: skip


def test_every_promised_skeleton_is_there_with_its_joints() -> None:
    # another test of this process may have added a layout of its own
    ours = {name: skeleton for name, skeleton in SKELETONS.items() if not name.startswith("own_")}
    assert {name: len(s.joints) for name, s in ours.items()} == EXPECTED_COUNTS
    for skeleton in SKELETONS.values():
        assert len(set(skeleton.joints)) == len(skeleton.joints)


@pytest.mark.parametrize("skeleton", SKELETONS.values(), ids=lambda s: s.name)
def test_weights_make_means(skeleton) -> None:
    sums = skeleton.to_canonical.sum(axis=1)
    assert np.allclose(sums[skeleton.observable], 1.0)
    assert np.all(sums[~skeleton.observable] == 0.0)


@pytest.mark.parametrize("skeleton", SKELETONS.values(), ids=lambda s: s.name)
def test_left_joints_come_from_left_joints(skeleton) -> None:
    for joint, row in zip(JOINTS, skeleton.to_canonical, strict=True):
        sources = [skeleton.joints[k].lower() for k in np.flatnonzero(row)]
        if joint.startswith("left"):
            assert not any("right" in s or s.startswith("r") for s in sources), (joint, sources)
        if joint.startswith("right"):
            assert not any("left" in s or s.startswith("l") for s in sources), (joint, sources)


def test_the_tree_is_symmetric_and_breadth_first() -> None:
    assert all(p < j for j, p in enumerate(PARENTS))
    assert (np.diff(BONES_BETWEEN[0]) >= 0).all()
    assert np.array_equal(MIRROR[MIRROR], np.arange(22))
    assert np.allclose(REST_OFFSETS[MIRROR] * [1, -1, 1], REST_OFFSETS)


def test_a_joint_with_a_missing_source_is_unobserved_and_confidence_is_the_least() -> None:
    positions = np.random.default_rng(0).normal(size=(5, 17, 3))
    confidence = np.full((5, 17), 0.9)
    confidence[:, COCO17.joints.index("left_hip")] = 0.4
    positions[2, COCO17.joints.index("right_hip"), 1] = np.inf
    mapped, trust = to_canonical(COCO17, positions, confidence)
    hips, shoulders = (
        (positions[0, COCO17.joints.index(f"left_{part}")] + positions[0, COCO17.joints.index(f"right_{part}")]) / 2
        for part in ("hip", "shoulder")
    )
    assert np.allclose(mapped[0, 0], hips + 0.15 * (shoulders - hips))
    assert np.allclose(mapped[0, J["neck"]], shoulders + 0.1 * (shoulders - hips))
    assert trust[0, 0] == pytest.approx(0.4)
    assert np.isnan(mapped[2, 0]).all()
    assert trust[2, 0] == 0.0
    assert np.isfinite(mapped[2, J["left_hip"]]).all()
    assert np.isnan(mapped[:, J["spine2"]]).all()


@pytest.mark.parametrize("name", ["coco17", "blazepose33", "h36m17", "openpose25", "halpe26", "zed18", "mhr70"])
def test_pelvis_and_neck_of_a_mean_person_lie_above_hips_and_shoulders(name: str) -> None:
    skeleton = SKELETONS[name]
    joints = np.full((len(skeleton.joints), 3), np.nan)
    for side in ("left", "right"):
        for part in ("hip", "shoulder"):
            weights = skeleton.to_canonical[J[f"{side}_{part}"]]
            joints[weights.argmax()] = REST_POSITIONS[J[f"{side}_{part}"]]
    mapped, _ = to_canonical(skeleton, joints)
    assert np.linalg.norm(mapped[0] - REST_POSITIONS[0]) < 0.005
    if "neck" in skeleton.table and not isinstance(skeleton.table["neck"], str):
        assert np.linalg.norm(mapped[J["neck"]] - REST_POSITIONS[J["neck"]]) < 0.015


def test_only_a_pelvis_and_a_neck_that_are_interpolated_have_an_error_of_their_own() -> None:
    errs = {name: {JOINTS[j] for j in np.flatnonzero(layout.sigma)} for name, layout in SKELETONS.items()}
    assert errs["coco17"] == errs["blazepose33"] == {"pelvis", "neck"}
    assert errs["h36m17"] == errs["halpe26"] == {"pelvis"}, "their necks are measured"
    assert errs["smpl22"] == errs["kinect22"] == set()


def test_the_name_of_another_layout_is_refused() -> None:
    with pytest.raises(ValueError, match="another layout called coco17"):
        add_layouts({"coco17": {"joints": CORNERS}})


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
    assert set(mapped["pelvis"]) == set(mapped["neck"]) == {"hl", "hr", "left_shoulder", "right_shoulder"}
    assert set(mapped["spine3"]) == {"chest", "left_shoulder", "right_shoulder"}
    assert "left_knee" not in mapped


CORNERS = ["left_hip", "right_hip", "left_shoulder", "right_shoulder"]


@pytest.mark.parametrize(("description", "said"), [
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
])  # fmt: skip
def test_what_is_wrong_in_a_layout_is_named(description: object, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        add_layouts({"bad": description})
    assert "bad" not in SKELETONS
