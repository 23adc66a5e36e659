"""Writes GLB (glTF 2.0): an animated skeleton with a skin of one octahedron per bone, in metres, y up, facing +z.

Joints are nodes and their rotations an animation, so that Blender, Unity, Unreal and browsers have bones to retarget.
The skin makes the bones visible. A VRM animation (.vrma) is the same file with the rest pose in its nodes, and with an
extension that maps nodes to a humanoid's bones (VRMC_vrm_animation 1.0).
"""

from collections.abc import Sequence

import numpy as np
import pygltflib as gltf
from numpy.typing import NDArray

from steadypose.nodes.sinks.motion_files import Y_UP, BodyMotion
from steadypose.prior.body.skeleton import CHILDREN, JOINTS, PARENTS, VRM

_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_KINDS = {np.float32: gltf.FLOAT, np.uint16: gltf.UNSIGNED_SHORT, np.uint8: gltf.UNSIGNED_BYTE}

WAIST, WIDTH = 0.2, 0.08
"""Position of a bone's widest point, and its half width there, relative to the bone's length; as in Blender."""


def to_glb(motion: BodyMotion, names: Sequence[str] = JOINTS) -> bytes:
    """The content of a GLB file; ``names`` are those of the 22 joints."""
    return _file(motion, names, at_rest=False)


def to_vrma(motion: BodyMotion) -> bytes:
    """The content of a VRM animation, which plays on any VRM avatar."""
    return _file(motion, VRM, at_rest=True)


def _file(motion: BodyMotion, names: Sequence[str], at_rest: bool) -> bytes:
    file, motion = _Glb(), motion.ahead()
    offsets = motion.offsets @ Y_UP.T
    rest = np.zeros((22, 3))
    for joint, parent in enumerate(PARENTS[1:], start=1):
        rest[joint] = rest[parent] + offsets[joint]
    root = motion.root @ Y_UP.T
    turns = motion.rotations[..., [1, 2, 0, 3]]  # a change of axes permutes a quaternion's vector part likewise
    start = np.tile([0.0, 0.0, 0.0, 1.0], (22, 1)) if at_rest else turns[0]
    place = np.array([0.0, -rest[:, 1].min(), 0.0]) if at_rest else root[0]
    nodes = [
        gltf.Node(name=name, translation=at.tolist(), rotation=turn.tolist(), children=list(children))
        for name, at, turn, children in zip(names, [place, *offsets[1:]], start, CHILDREN, strict=True)
    ]  # fmt: skip
    bind = np.tile(np.eye(4), (22, 1, 1))
    bind[:, :3, 3] = -rest
    points, triangles, joints = _octahedra(rest)
    attributes = gltf.Attributes(
        POSITION=file.add(points, gltf.ARRAY_BUFFER),
        JOINTS_0=file.add(np.pad(joints[:, None], ((0, 0), (0, 3))).astype(np.uint8), gltf.ARRAY_BUFFER),
        WEIGHTS_0=file.add(np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)), gltf.ARRAY_BUFFER),
    )
    corners = file.add(triangles, gltf.ELEMENT_ARRAY_BUFFER)
    mesh = gltf.Mesh(primitives=[gltf.Primitive(attributes=attributes, indices=corners)])
    inverse = file.add(bind.swapaxes(1, 2).reshape(22, 16))
    skin = gltf.Skin(joints=list(range(22)), inverseBindMatrices=inverse, skeleton=0)
    times = file.add((np.arange(len(root)) / motion.fps)[:, None])
    tracks = [(0, "translation", file.add(root)), *((j, "rotation", file.add(turns[:, j])) for j in range(22))]
    targets = [gltf.AnimationChannelTarget(node=joint, path=path) for joint, path, _ in tracks]
    animation = gltf.Animation(
        name="motion",
        samplers=[gltf.AnimationSampler(input=times, output=values) for _, _, values in tracks],
        channels=[gltf.AnimationChannel(sampler=k, target=target) for k, target in enumerate(targets)],
    )
    nodes.append(gltf.Node(name="body", mesh=0, skin=0))
    scene = gltf.Scene(nodes=[0, 22])
    result = gltf.GLTF2(scene=0, scenes=[scene], nodes=nodes, meshes=[mesh], skins=[skin], animations=[animation])
    if at_rest:
        bones = {name: {"node": joint} for joint, name in enumerate(names)}
        result.extensionsUsed = ["VRMC_vrm_animation"]
        result.extensions = {"VRMC_vrm_animation": {"specVersion": "1.0", "humanoid": {"humanBones": bones}}}
    return file.finish(result)


class _Glb:
    """The buffer of a file, with its views and accessors."""

    def __init__(self) -> None:
        self._views: list[gltf.BufferView] = []
        self._accessors: list[gltf.Accessor] = []
        self._data = bytearray()

    def add(self, values: NDArray[np.generic], target: int | None = None) -> int:
        """Add an array (N, width). Returns its accessor; floats are stored as float32."""
        values = values if values.dtype.type in _KINDS else values.astype(np.float32)
        self._data += bytes(-len(self._data) % 4)
        view = gltf.BufferView(buffer=0, byteOffset=len(self._data), byteLength=values.nbytes, target=target)
        self._data += values.tobytes()
        self._views.append(view)
        self._accessors.append(
            gltf.Accessor(
                bufferView=len(self._views) - 1,
                componentType=_KINDS[values.dtype.type],
                count=len(values),
                type=_TYPES[values.shape[1]],
                min=values.min(axis=0).tolist(),
                max=values.max(axis=0).tolist(),
            )
        )
        return len(self._accessors) - 1

    def finish(self, file: gltf.GLTF2) -> bytes:
        file.bufferViews, file.accessors = self._views, self._accessors
        file.buffers = [gltf.Buffer(byteLength=len(self._data))]
        file.set_binary_blob(bytes(self._data))
        return b"".join(file.save_to_bytes())


def _octahedra(rest: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.uint16], NDArray[np.uint8]]:
    """Points (126, 3), indices (504, 1) of the triangles' corners, and the joint (126,) that each point moves with."""
    points: list[NDArray[np.float64]] = []
    triangles: list[list[int]] = []
    ring = [1, 2, 3, 4]
    for bone, parent in enumerate(PARENTS[1:]):
        start, along = rest[parent], rest[bone + 1] - rest[parent]
        aside = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        aside *= WIDTH * np.linalg.norm(along) / np.linalg.norm(aside)
        over = np.cross(along, aside) / np.linalg.norm(along)
        points += [start, *(start + WAIST * along + side for side in (aside, over, -aside, -over)), start + along]
        for a, b in zip(ring, ring[1:] + ring[:1], strict=True):
            triangles += [[6 * bone, 6 * bone + b, 6 * bone + a], [6 * bone + 5, 6 * bone + a, 6 * bone + b]]
    corners = np.array(triangles, np.uint16).reshape(-1, 1)
    return np.array(points), corners, np.repeat(np.array(PARENTS[1:], np.uint8), 6)
