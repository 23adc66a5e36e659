from pathlib import Path
from typing import Any

import bvhio
import numpy as np
import pandas
import pytest
from conftest import record
from numpy.typing import NDArray
from pygltflib import GLTF2
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import world_body

from steadypose.msgs.topics import POSE_WORLD
from steadypose.msgs.types import JOINTS, PoseRaw, PoseWorld, WorldBody
from steadypose.nodes.cli import main
from steadypose.nodes.sinks import motion_files
from steadypose.nodes.sinks.glb import to_glb
from steadypose.nodes.sinks.motion_files import BodyMotion, ExportError, read_motion, steady
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import PARENTS, REST_OFFSETS
from steadypose.prior.mocap.clip import TO_Z_UP
from steadypose.prior.mocap.files import read_motion as read_file

FRAMES = 40


@pytest.fixture
def motion() -> BodyMotion:
    """A body that walks along x and turns all its joints by up to half a radian about changing axes."""
    rng = np.random.default_rng(0)
    phases, axes = rng.uniform(0, 6, (22, 3)), rng.normal(scale=0.3, size=(22, 3))
    time = np.arange(FRAMES)[:, None, None] / 30
    rotations = Rotation.from_rotvec((axes * np.sin(3 * time + phases)).reshape(-1, 3)).as_quat()
    root = np.stack([np.arange(FRAMES) * 0.03, np.sin(np.arange(FRAMES) * 0.1), np.full(FRAMES, 0.95)], axis=1)
    return BodyMotion(30.0, root, rotations.reshape(FRAMES, 22, 4), 1.1 * REST_OFFSETS)


def npz(path: Path, motion: BodyMotion, turn: Rotation | None = None, gap=slice(0), backwards: bool = False) -> Path:
    """What ``clean`` writes of it, from a sensor whose axes are turned, in all frames or in each, without anybody in a
    gap."""
    turn = turn or Rotation.identity()
    rotations = motion.rotations.copy()
    rotations[:, 0] = (turn * Rotation.from_quat(rotations[:, 0])).as_quat()
    world = motion.positions
    rotations[gap] = world[gap] = np.nan
    stamps = np.round(np.arange(FRAMES) * 1e9 / 30).astype(np.int64)[:: -1 if backwards else 1]
    seen = world @ turn.as_matrix().swapaxes(-1, -2)
    np.savez(path, positions=seen, world_positions=world, rotations=rotations, stamp_ns=stamps)
    return path


def recording(path: Path, motion: BodyMotion) -> Path:
    def body(id: int, frame: int) -> WorldBody:
        return world_body(motion.positions[frame] + [10.0 * id, 0, 0], motion.rotations[frame], id=id)

    stream = []
    for frame in range(FRAMES):
        bodies = [body(id, frame) for id in (0, 3) if id == 0 or frame > 20]
        stream.append(PoseWorld(round(frame * 1e9 / 30), "world", "test", np.array([0.0, 0.0, 1.0, 0.0]), bodies))
    return record(path, stream, POSE_WORLD)


def test_bvh_is_read_by_bvhio_and_by_ourselves(tmp_path: Path, motion: BodyMotion) -> None:
    path = tmp_path / "take.bvh"
    path.write_bytes(motion_files.to_bvh(motion))
    root = bvhio.readAsHierarchy(str(path))
    expected = 100 * motion.positions @ TO_Z_UP["y"]
    for frame in (0, 17, FRAMES - 1):
        root.loadPose(frame)
        for joint, _, _ in root.layout():
            if joint.Name in JOINTS:
                at = np.array(joint.PositionWorld)
                np.testing.assert_allclose(at, expected[frame, JOINTS.index(joint.Name)], atol=2e-3, err_msg=joint.Name)
    fps, body = read_file("take.bvh", path.read_bytes())
    assert fps == pytest.approx(30.0)
    np.testing.assert_allclose(body, motion.positions, atol=1e-5)


def test_trc_and_csv_are_read_by_pandas(tmp_path: Path, motion: BodyMotion) -> None:
    path = tmp_path / "take.trc"
    path.write_bytes(motion_files.to_trc(motion))
    head = pandas.read_csv(path, sep="\t", skiprows=1, nrows=1)
    assert head[["DataRate", "NumFrames", "NumMarkers", "Units"]].iloc[0].tolist() == [30, FRAMES, 22, "mm"]
    markers = pandas.read_csv(path, sep="\t", skiprows=3, nrows=1, header=None).iloc[0, 2:].dropna()
    assert markers.tolist() == list(JOINTS)
    table = pandas.read_csv(path, sep="\t", skiprows=6, header=None).to_numpy()
    np.testing.assert_allclose(table[:, 1], np.arange(FRAMES) / 30, atol=1e-6)
    np.testing.assert_allclose(table[:, 2:].reshape(FRAMES, 22, 3), 1000 * motion.positions @ TO_Z_UP["y"], atol=1e-3)

    path = tmp_path / "take.csv"
    path.write_bytes(motion_files.to_csv(motion))
    table = pandas.read_csv(path, comment="#")
    np.testing.assert_allclose(table["stamp"], motion.start_s + np.arange(FRAMES) / 30, atol=1e-6)
    for k, joint in enumerate(JOINTS):
        found = table[[f"{joint}_{part}" for part in ("x", "y", "z", "qx", "qy", "qz", "qw")]].to_numpy()
        np.testing.assert_allclose(found[:, :3], motion.positions[:, k], atol=1e-5)
        np.testing.assert_allclose(found[:, 3:], motion.rotations[:, k], atol=1e-5)


def test_glb_moves_its_joints_and_its_skin_where_the_body_is(tmp_path: Path, motion: BodyMotion) -> None:
    path = tmp_path / "take.glb"
    path.write_bytes(to_glb(motion))
    file: Any = GLTF2().load(str(path))

    def values(accessor: int) -> NDArray[np.generic]:
        entry = file.accessors[accessor]
        kind = {5126: np.float32, 5123: np.uint16, 5121: np.uint8}[entry.componentType]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[entry.type]
        start = file.bufferViews[entry.bufferView].byteOffset or 0
        return np.frombuffer(file.binary_blob(), kind, entry.count * width, start).reshape(-1, width)

    expected = motion.positions @ TO_Z_UP["y"]
    frame = 17
    at = {node.name: np.array(node.translation) for node in file.nodes[:22]}
    turn = {}
    for channel in file.animations[0].channels:
        sampler = file.animations[0].samplers[channel.sampler]
        node = file.nodes[channel.target.node]
        assert values(sampler.input)[frame, 0] == pytest.approx(frame / 30)
        if channel.target.path == "translation":
            at[node.name] = values(sampler.output)[frame]
        else:
            turn[node.name] = Rotation.from_quat(values(sampler.output)[frame])
    transforms: dict[int, Floats] = {}

    def place(node: int, above: Floats) -> None:
        local = np.eye(4)
        name = file.nodes[node].name
        local[:3, :3], local[:3, 3] = turn[name].as_matrix(), at[name]
        transforms[node] = above @ local
        for child in file.nodes[node].children or ():
            place(child, transforms[node])

    place(0, np.eye(4))
    for node, transform in transforms.items():
        np.testing.assert_allclose(transform[:3, 3], expected[frame, node], atol=1e-5)
    # The skin: the tip of each bone is where its joint is.
    skin, primitive = file.skins[0], file.meshes[0].primitives[0]
    bind = values(skin.inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
    points, joints = values(primitive.attributes.POSITION), values(primitive.attributes.JOINTS_0)[:, 0]
    for bone, parent in enumerate(PARENTS[1:]):
        tip = 6 * bone + 5
        assert joints[tip] == parent
        moved = transforms[parent] @ bind[parent] @ [*points[tip], 1.0]
        np.testing.assert_allclose(moved[:3], expected[frame, bone + 1], atol=1e-5)
    assert len(np.unique(values(primitive.indices))) == len(points)


@pytest.mark.parametrize("angles", [[1.5, 0.2, -2.0], np.outer(np.arange(FRAMES), [0.01, 0.0, 0.02])])
def test_an_npz_of_a_turned_sensor_is_exported_in_the_world(tmp_path: Path, motion: BodyMotion, angles: Floats) -> None:
    path = npz(tmp_path / "clean.npz", motion, Rotation.from_euler("xyz", angles))
    found = read_motion(path, 0)  # as `info` calls its one body
    assert found.fps == pytest.approx(30.0)
    np.testing.assert_allclose(found.positions, motion.positions, atol=1e-6)
    with pytest.raises(ExportError, match="no body 7 to export; bodies in it: 0"):
        read_motion(path, 7)


def test_of_a_recording_the_body_that_is_there_longest_or_was_asked_for(tmp_path: Path, motion: BodyMotion) -> None:
    path = recording(tmp_path / "take", motion)
    np.testing.assert_allclose(read_motion(path).positions, motion.positions, atol=1e-5)
    np.testing.assert_allclose(read_motion(path, 3).positions[:, 0, 0], motion.root[21:, 0] + 30.0, atol=1e-5)
    assert main(["export", str(path), str(tmp_path / "x.bvh"), "--body", "7"]) != 0


def test_a_gap_is_filled_the_rate_kept_and_a_body_placed_by_all_its_joints(tmp_path: Path, motion: BodyMotion) -> None:
    found = read_motion(npz(tmp_path / "clean.npz", motion, gap=slice(11, 14)))
    assert len(found.root) == FRAMES
    np.testing.assert_allclose(found.positions, motion.positions, atol=0.05)
    np.testing.assert_allclose(found.positions[14:], motion.positions[14:], atol=1e-6)
    seen = motion.positions
    seen[::3, 0] += [0.0, 0.0, 0.05]
    found = steady(np.arange(FRAMES) / 30, seen, motion.rotations)
    np.testing.assert_allclose(found.positions, motion.positions, atol=0.05 / 22 + 1e-6)


@pytest.mark.parametrize(("stamps", "fps"), [
    ((np.arange(FRAMES) / 30).round(3), 30.0),
    ((np.arange(FRAMES) / 120).round(3), 120.0),
    (np.arange(FRAMES) / 29.914, 30.0),
    (np.arange(FRAMES) * 1.001 / 60, 59.94),
    (np.arange(FRAMES) / 30 + np.random.default_rng(0).uniform(0, 0.005, FRAMES), 30.0),
    (np.arange(FRAMES) / 30 + (np.arange(FRAMES) > 9), 30.0),
    (np.arange(FRAMES) / 27.5, 27.5),
])  # fmt: skip
def test_the_rate_of_rounded_stamps_is_the_sensors(motion: BodyMotion, stamps: Floats, fps: float) -> None:
    found = steady(stamps, motion.positions, motion.rotations)
    assert found.fps == fps
    assert len(found.root) == pytest.approx((stamps[-1] - stamps[0]) * found.fps + 1, abs=1)


def test_a_rounded_frame_time_costs_no_frame(motion: BodyMotion) -> None:
    whole, turned = (np.tile(part, (20, 1, 1)) for part in (motion.positions, motion.rotations))
    found = steady(np.arange(len(whole)) * np.float64(0.008333), whole, turned)
    assert (found.fps, len(found.root)) == (120.0, len(whole))


@pytest.mark.parametrize(("source", "out", "more", "match"), [
    ("clean.npz", "there.glb", [], "--force"),
    ("clean.npz", "take.fbx", [], ".bvh, .glb, .vrma, .csv, .trc"),
    ("raw.npz", "take.bvh", [], "clean it first"),
    ("clean.npz", "take.csv", ["--names", "vrm"], "expected OUT to end in .bvh or .glb, got .csv"),
    ("back.npz", "take.bvh", [], "stamps, got 1.266666667 s after 1.300000000 s; sort the input by stamp"),
])  # fmt: skip
def test_what_cannot_be_written_is_said(source: str, out: str, more: list[str], match: str, tmp_path, motion, capsys):
    npz(tmp_path / "clean.npz", motion)
    npz(tmp_path / "back.npz", motion, backwards=True)
    np.savez(tmp_path / "raw.npz", positions=np.zeros((3, 22, 3)), fps=30.0)
    (tmp_path / "there.glb").touch()
    assert main(["export", str(tmp_path / source), str(tmp_path / out), *more]) == 2
    assert match in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["back.npz", "clean.npz", "raw.npz", "there.glb"]


@pytest.mark.parametrize("suffix", [".csv", ".trc"])
def test_tables_come_back_as_they_went(tmp_path: Path, motion: BodyMotion, suffix: str) -> None:
    source, out = npz(tmp_path / "clean.npz", motion), tmp_path / f"take{suffix}"
    assert main(["export", str(source), str(out)]) == 0
    frames = [message for _, message in open_recording(out) if isinstance(message, PoseRaw)]
    found = np.stack([frame.bodies[0].positions for frame in frames])
    np.testing.assert_allclose(found, motion.positions, atol=1e-5)
    assert frames[-1].stamp_ns == pytest.approx((FRAMES - 1) / 30 * 1e9, abs=1e6)


def test_a_vrm_animation_rests_in_a_t_and_names_its_humanoid(tmp_path: Path, motion: BodyMotion) -> None:
    source = npz(tmp_path / "in.npz", motion)
    assert main(["export", str(source), str(tmp_path / "take.vrma")]) == 0
    file: Any = GLTF2().load_binary(str(tmp_path / "take.vrma"))
    bones = file.extensions["VRMC_vrm_animation"]["humanoid"]["humanBones"]
    assert file.extensionsUsed == ["VRMC_vrm_animation"]
    required = {"hips", "spine", "head", "leftUpperArm", "leftLowerArm", "leftHand", "rightUpperLeg", "rightFoot"}
    assert required < bones.keys()
    assert file.nodes[bones["leftLowerArm"]["node"]].name == "leftLowerArm"
    assert all(file.nodes[bone["node"]].rotation == [0.0, 0.0, 0.0, 1.0] for bone in bones.values())
    upper, lower = (file.nodes[bones[name]["node"]].translation for name in ("leftUpperArm", "leftLowerArm"))
    assert upper[0] > 0.05, "the left is at +x, for a body that faces +z"
    assert lower[0] > 5 * abs(lower[1]), "arms are stretched out sideways"
    assert file.nodes[bones["hips"]["node"]].translation[1] == pytest.approx(0.95, abs=0.15)


@pytest.mark.parametrize(("names", "elbow"), [("vrm", "leftLowerArm"), ("mixamo", "mixamorig:LeftForeArm")])
def test_joints_have_the_names_of_the_rig_that_is_asked_for(tmp_path: Path, motion: BodyMotion, names: str, elbow: str):
    source = npz(tmp_path / "in.npz", motion)
    for out in ("take.bvh", "take.glb"):
        assert main(["export", str(source), str(tmp_path / out), "--names", names]) == 0
    found = bvhio.readAsHierarchy(str(tmp_path / "take.bvh"))
    assert elbow in {joint.Name for joint, _, _ in found.layout()}
    file: Any = GLTF2().load_binary(str(tmp_path / "take.glb"))
    assert elbow in {node.name for node in file.nodes}
    if names == "mixamo":  # and they are read again, as any rig of that kind
        read = read_file("take.bvh", (tmp_path / "take.bvh").read_bytes())
        off = np.linalg.norm(read.positions - motion.positions, axis=-1).max(axis=0)
        # their place in other rigs is that of SMPL
        assert {JOINTS[joint] for joint in np.flatnonzero(off > 1e-6)} <= {"left_collar", "right_collar"}
