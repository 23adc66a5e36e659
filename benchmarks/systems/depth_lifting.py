"""Key points lifted by a stereo depth image, against the truth: simulated people of capsules in a room.

Each picture has a person of another build in another pose (walking, reaching, waving, sitting down), turned any way,
in front of a wall 0.6 to 3 m behind, filmed by `prior.sim.depth.Stereo`. A joint counts as seen if the first
thing on its ray is its own limb. Key points are off by a Gaussian; their confidence is 0.6 to 0.95 for a joint that is
seen, 0.2 to 0.8 for a hidden one.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.provenance import require_committed
from steadypose.benchmarks.results import RESULTS, Table, save, show
from steadypose.prior.body.layouts import COCO17
from steadypose.prior.camera.depth_lifting import lift
from steadypose.prior.sim import scripts
from steadypose.prior.sim.body import REST_HEIGHT, stature
from steadypose.prior.sim.depth import Stereo, render, room, spoil
from steadypose.prior.sim.motion import Motion
from steadypose.prior.sim.sensors import mount

Floats = NDArray[np.float64]

DEPENDS_ON = ()

DISTANCES = (2.0, 3.0, 4.0)
KEYPOINT_NOISE = (0.0, 1.5, 4.0)
ON_THE_BACKGROUND = 0.25
"""metres behind its true place, from where a joint is not on the body any more"""
POSES = (scripts.idle, scripts.walk_turn, scripts.reach, scripts.sit_rise, scripts.wave_hidden_arm)
_BODY = [index for index, name in enumerate(COCO17.joints) if not name.endswith(("eye", "ear", "nose"))]
"""the joints of trunk, arms and legs: a detector's face points lie on the skin, not in joints"""


@dataclass(frozen=True)
class Picture:
    """A person's key points and depth image, with the ground truth.

    Attributes:
        keypoints: (17, 2) pixels, exact.
        confidence: (17,).
        depth: (H, W) millimetres.
        truth: (17, 3) metres, optical frame.
        seen: (17,) whether nothing but the joint's own limb occludes it.
    """

    keypoints: Floats
    confidence: Floats
    depth: NDArray[np.uint16]
    truth: Floats
    seen: NDArray[np.bool_]


@dataclass(frozen=True)
class Args:
    """How near the truth key points are lifted."""

    pictures: int = 120
    """at each distance"""
    quick: bool = False
    """30 pictures, to see that it works; nothing is written unless --out says where"""
    out: Path | None = None
    """folder for the JSON file; benchmarks/results unless --quick"""


def picture(motion: Motion, camera: Stereo, distance: float, rng: np.random.Generator) -> Picture:
    """A moment of a motion, ``distance`` metres in front of the camera."""
    moment = int(rng.integers(len(motion.times)))
    joints, turned = motion.positions[moment], motion.orientations[moment]
    yaw = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
    joints = (joints - [*joints[0, :2], 0.0]) @ yaw.T
    height, pitch = rng.uniform(0.9, 1.6), rng.uniform(0.0, 0.15)
    # the optical frame: x right, y down, z forward; the person stands at `distance` along the world's x
    to_optical = Rotation.from_euler("x", pitch).as_matrix() @ np.array(
        [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
    )
    eye = np.array([0.0, 0.0, height])
    joints = (joints + [distance, rng.uniform(-0.3, 0.3), 0.0] - eye) @ to_optical.T
    truth = mount(COCO17.name).positions(joints, to_optical @ yaw @ turned, stature(motion.offsets) / REST_HEIGHT)
    exact = render([(joints, motion.offsets)], camera, room(camera, height, pitch, distance + rng.uniform(0.6, 3.0)))
    keypoints = camera.project(truth)
    x, y = np.rint(keypoints).astype(int).T
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    skin = exact[np.where(inside, y, 0), np.where(inside, x, 0)]
    # the flesh over a joint is at most as thick as its limb seen from its end
    seen = inside & (truth[:, 2] - skin < np.array([_flesh(name) for name in COCO17.joints]))
    confidence = np.where(seen, rng.uniform(0.6, 0.95, len(seen)), rng.uniform(0.2, 0.8, len(seen)))
    return Picture(keypoints, confidence, spoil(exact, camera, rng), truth, seen)


def _flesh(joint: str) -> float:
    """Metres of its own flesh that may lie in front of a joint."""
    return {"hip": 0.16, "shoulder": 0.11, "ear": 0.08}.get(joint.split("_")[-1], 0.075)


def pictures(count: int, distance: float, seed: int = 0) -> list[Picture]:
    """Pictures of people at a distance in metres, the same for the same seed."""
    rng = np.random.default_rng((seed, round(10 * distance)))
    people = [pose(rng)[0] for pose in POSES for _ in range(max(count // 60, 1))]
    camera = Stereo()
    return [picture(people[n % len(people)], camera, distance, rng) for n in track(range(count), f"{distance:g} m")]


Lifter = Callable[[Floats, Floats, NDArray[np.uint16], Floats], Floats]


def ours(keypoints: Floats, confidence: Floats, depth: NDArray[np.uint16], intrinsics: Floats) -> Floats:
    return lift(keypoints[None], confidence[None], depth, intrinsics)[0][0].astype(np.float64)


def median(keypoints: Floats, confidence: Floats, depth: NDArray[np.uint16], intrinsics: Floats) -> Floats:
    """The common method: the median depth of a small square around each key point of sufficient confidence."""
    positions = np.full((len(keypoints), 3), np.nan)
    for joint, (x, y) in enumerate(np.rint(keypoints).astype(int)):
        around = depth[max(y - 3, 0) : max(y + 4, 0), max(x - 3, 0) : max(x + 4, 0)]
        if confidence[joint] >= 0.3 and (around > 0).any():
            ray = np.linalg.solve(intrinsics, [*keypoints[joint], 1.0])
            positions[joint] = ray * np.median(around[around > 0]) / 1000
    return positions


LIFTERS: dict[str, Lifter] = {"steadypose": ours, "median of 7 x 7 pixels": median}


def measure(scenes: list[Picture], lifter: Lifter, noise: float, seed: int = 1) -> dict[str, float]:
    """Errors of a lifter over pictures, with key points off by ``noise`` pixels (standard deviation an axis)."""
    rng = np.random.default_rng(seed)
    intrinsics = Stereo().intrinsics
    lifted = []
    for scene in scenes:
        keypoints = scene.keypoints + noise * rng.standard_normal(scene.keypoints.shape)
        lifted.append(lifter(keypoints, scene.confidence, scene.depth, intrinsics)[_BODY])
    positions = np.stack(lifted)
    truth = np.stack([scene.truth for scene in scenes])[:, _BODY]
    seen = np.stack([scene.seen for scene in scenes])[:, _BODY]
    error = np.linalg.norm(positions - truth, axis=-1)
    given = np.isfinite(error)
    root = np.linalg.norm((positions[:, -6] + positions[:, -5] - truth[:, -6] - truth[:, -5]) / 2, axis=-1)
    return {
        "mean": float(error[given & seen].mean()),
        "median": float(np.median(error[given & seen])),
        "p95": float(np.percentile(error[given & seen], 95)),
        "root": float(np.nanmean(root)),
        "mean_hidden": float(error[given & ~seen].mean()),
        "seen_given": float((given & seen).sum() / seen.sum()),
        "hidden_given": float((given & ~seen).sum() / (~seen).sum()),
        "joints": int(given.sum()),
        "on_background": int((positions[..., 2] - truth[..., 2] > ON_THE_BACKGROUND)[given].sum()),
    }


def main(args: Args) -> None:
    """Measure, print, write."""
    if args.out or not args.quick:
        require_committed(args.out or RESULTS)
    console = Console()
    rows, figures = [], []
    for distance in DISTANCES:
        scenes = pictures(30 if args.quick else args.pictures, distance)
        for noise in KEYPOINT_NOISE:
            for name, lifter in LIFTERS.items():
                found = measure(scenes, lifter, noise)
                figures.append({"distance": distance, "keypoint_noise": noise, "lifter": name} | found)
                rows.append(_row(name, distance, noise, found))
    table = Table(
        name="depth_lifting",
        title="Key points lifted by a stereo depth image (simulated)",
        columns=["", "m", "key points off, px", "error, mm: seen", "p95", "root", "hidden", "seen given, %",
                 "hidden given, %", "on the background"],
        rows=rows,
        note=f"Joints of trunk, arms and legs. On the background: more than {100 * ON_THE_BACKGROUND:g} cm behind "
        "its true place. Hidden: behind other flesh; a lifter should not give it.",
    )  # fmt: skip
    show(table, console)
    if args.out or not args.quick:
        data: dict[str, Any] = {"depth_lifting": figures}
        console.print(f"wrote {save('depth_lifting', sys.argv[1:], [table], data, DEPENDS_ON, args.out or RESULTS)}")


def _row(name: str, distance: float, noise: float, found: dict[str, float]) -> list[str]:
    lengths = [f"{1000 * found[key]:.0f}" for key in ("mean", "p95", "root", "mean_hidden")]
    shares = [f"{100 * found[key]:.0f}" for key in ("seen_given", "hidden_given")]
    return [name, f"{distance:g}", f"{noise:g}", *lengths, *shares, f"{found['on_background']} of {found['joints']}"]


if __name__ == "__main__":
    main(tyro.cli(Args))
