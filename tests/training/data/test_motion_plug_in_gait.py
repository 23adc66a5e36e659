import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.prior.body.skeleton import JOINTS, J
from steadypose.prior.mocap import plug_in_gait as pig
from steadypose.prior.mocap.plug_in_gait import calibrate, joint_centres

Array = NDArray[np.float64]

# A body facing +x, left +y, up +z: joints that the methods find by geometry alone (metres).
HIP = np.array([0.0, 0.0931, 0.95])  # 0.33 of a 26 cm wide pelvis and 7.3 mm to the side
KNEE = np.array([0.0, 0.0931, 0.53])
ELBOW = np.array([0.0, 0.18, 1.15])
THIGH_WAND_ERROR, ARM_WAND_ERROR = 25.0, -15.0  # degrees


def unit(v: Array) -> Array:
    return v / np.linalg.norm(v)


def body(knee_bend: float, elbow_bend: float) -> dict[str, Array]:
    """Markers (3,) of one pose, angles in degrees. The right side mirrors the left."""
    width, depth = 0.26, 0.20
    # Harrington's regression, turned round: the pelvis whose hips are at HIP.
    front_x = HIP[0] + 0.24 * depth + 0.0099
    front_z = HIP[2] + 0.30 * width + 0.0109
    m: dict[str, Array] = {
        "LASI": np.array([front_x, width / 2, front_z]), "LPSI": np.array([front_x - depth, 0.05, front_z]),
        "C7": np.array([-0.06, 0.0, 1.50]), "CLAV": np.array([0.06, 0.0, 1.44]), "T10": np.array([-0.10, 0.0, 1.22]),
        "STRN": np.array([0.06, 0.0, 1.22]), "LSHO": np.array([0.0, 0.18, 1.46]), "LFHD": np.array([0.09, 0.07, 1.68]),
        "LBHD": np.array([-0.09, 0.07, 1.68]),
    }  # fmt: skip
    lateral = np.array([0.0, 1.0, 0.0])
    knee_offset = pig.KNEE_WIDTH / 2 + pig.MARKER_RADIUS
    m["LKNE"] = KNEE + knee_offset * lateral
    # The wand is off by an angle about the line from the hip to the knee's marker.
    m["LTHI"] = wand(HIP, m["LKNE"], THIGH_WAND_ERROR)
    shank = Rotation.from_euler("y", knee_bend, degrees=True).apply([0.0, 0.0, -0.42])
    ankle = KNEE + shank
    m["LANK"] = ankle + (pig.ANKLE_WIDTH / 2 + pig.MARKER_RADIUS) * lateral
    forward = Rotation.from_euler("y", knee_bend, degrees=True).apply([1.0, 0.0, 0.0])
    m["LHEE"], m["LTOE"] = ankle - 0.06 * forward, ankle + 0.12 * forward
    m["LELB"] = ELBOW + (pig.ELBOW_WIDTH / 2 + pig.MARKER_RADIUS) * lateral
    m["LUPA"] = wand(shoulder(m), m["LELB"], ARM_WAND_ERROR)
    wrist = ELBOW + Rotation.from_euler("y", -elbow_bend, degrees=True).apply([0.0, 0.0, -0.25])
    m["LWRA"], m["LWRB"] = wrist + [0.02, 0.02, 0], wrist - [0.02, 0.02, 0]
    mirror = {"R" + n[1:]: p * [1, -1, 1] for n, p in m.items() if n.startswith("L")}
    return m | mirror


def shoulder(m: dict[str, Array]) -> Array:
    up = unit((m["C7"] + m["CLAV"]) / 2 - (m["T10"] + m["STRN"]) / 2)
    return m["LSHO"] - 0.17 * 2 * m["LSHO"][1] * up


def wand(upper: Array, marker: Array, error: float) -> Array:
    """Half way up the limb, lateral but for an error about it."""
    along = unit(upper - marker)
    side = np.array([0.0, 1.0, 0.0])
    side = unit(side - (side @ along) * along)
    return marker + 0.2 * along + 0.08 * Rotation.from_rotvec(np.radians(error) * along).apply(side)


def recording(bends: list[tuple[float, float]], turn: Rotation, shift: Array) -> dict[str, Array]:
    poses = [body(*b) for b in bends]
    return {n: turn.apply(np.array([p[n] for p in poses])) + shift for n in poses[0]}


BENDS = [(b, b / 1.5) for b in np.linspace(0, 100, 60)]
STILL = Rotation.identity()


def test_finds_the_joints_under_the_skin_whatever_way_the_body_stands() -> None:
    turn = Rotation.from_euler("zyx", [130, 20, -15], degrees=True)
    shift = np.array([1.0, -2.0, 0.3])
    markers = recording(BENDS, turn, shift)
    found = turn.inv().apply((joint_centres(markers, calibrate([markers])) - shift).reshape(-1, 3)).reshape(-1, 22, 3)

    mirror = np.array([1.0, -1.0, 1.0])
    for name, place, tolerance in (("hip", HIP, 1e-6), ("knee", KNEE, 0.004), ("elbow", ELBOW, 0.004)):
        assert np.abs(found[:, J[f"left_{name}"]] - place).max() < tolerance, name
        assert np.abs(found[:, J[f"right_{name}"]] - place * mirror).max() < tolerance, name
    ankles = KNEE + Rotation.from_euler("y", [[b] for b, _ in BENDS], degrees=True).apply([0.0, 0.0, -0.42])
    assert np.abs(found[:, J["left_ankle"]] - ankles).max() < 0.006


def test_a_misplaced_wand_is_corrected_by_the_way_the_limb_bends() -> None:
    markers = recording(BENDS, STILL, np.zeros(3))
    found = calibrate([markers]).axis
    assert np.degrees(found["left_knee"]) == pytest.approx(-THIGH_WAND_ERROR, abs=4)
    assert np.degrees(found["right_knee"]) == pytest.approx(THIGH_WAND_ERROR, abs=4)
    assert np.degrees(found["left_elbow"]) == pytest.approx(-ARM_WAND_ERROR, abs=4)


def test_a_subject_who_never_bends_keeps_the_wand() -> None:
    markers = recording([(0.0, 0.0)] * 60, STILL, np.zeros(3))
    assert set(calibrate([markers]).axis.values()) == {0.0}


def test_a_lost_marker_loses_the_joints_that_rest_on_it_and_no_others() -> None:
    markers = recording(BENDS, STILL, np.zeros(3))
    calibration = calibrate([markers])
    whole = joint_centres(markers, calibration)
    markers["LWRA"][10] = np.nan
    markers["RTHI"][20] = np.nan
    found = joint_centres(markers, calibration)
    lost = {(int(t), JOINTS[j]) for t, j in np.argwhere(np.isnan(found).any(axis=-1))}
    # The knee's centre rests on the thigh's wand, and the ankle and foot on the shank that ends in it.
    assert lost == {(10, "left_wrist"), (20, "right_knee"), (20, "right_ankle"), (20, "right_foot")}
    rest = np.isfinite(found)
    np.testing.assert_array_equal(found[rest], whole[rest])
