from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.studies.root_drift import Clip, observe
from steadypose.msgs.types import Tracking
from steadypose.prior.body.skeleton import J, limbs
from steadypose.prior.sim.motion import Motion
from steadypose.prior.sim.scripts import idle, sit_rise, walk_turn
from steadypose.prior.world.observe import FEET
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

STEP_M, TREAD_M = 0.17, 0.55


class Seen(Clip):
    """A clip of which the root is seen throughout."""

    @property
    def hidden(self):
        return np.zeros(len(self.positions), dtype=bool)


def acted(script: Callable[[np.random.Generator], list[Motion]], seconds: float) -> Seen:
    motion = script(np.random.default_rng(0))[0]
    motion = motion.at(np.arange(motion.times[0], motion.times[0] + seconds, 1 / 30))
    rotations = Rotation.from_matrix(motion.rotations.reshape(-1, 3, 3)).as_quat().reshape(-1, 22, 4)
    return Seen(motion.positions, rotations, motion.contacts)


def lying(face: int) -> Seen:
    """Stands for 3 s, tips over about the ankles within 1.2 s, on its back (-1) or front (1), and lies."""
    clip = acted(idle, 11.0)
    share = np.clip((np.arange(len(clip.positions)) / 30 - 3.0) / 1.2, 0.0, 1.0)
    left = clip.positions[0, J["left_hip"]] - clip.positions[0, J["right_hip"]]
    axis = left * [1, 1, 0] / np.linalg.norm(left[:2])
    turn = Rotation.from_rotvec(-face * np.pi / 2 * (share**2 * (3 - 2 * share))[:, None] * axis)
    pivot = clip.positions[:, FEET[:2]].mean(axis=1) * [1, 1, 0]
    positions = np.einsum("tij,tkj->tki", turn.as_matrix(), clip.positions - pivot[:, None]) + pivot[:, None]
    positions[..., 2] += np.maximum(0.05 - positions[..., 2].min(axis=1), 0.0)[:, None]
    rotations = clip.rotations.copy()
    rotations[:, 0] = (turn * Rotation.from_quat(rotations[:, 0])).as_quat()
    return Seen(positions, rotations, clip.contacts)


def stairs(height: float) -> Seen:
    """A walk of which each foot stands on the step that the body has come to."""
    clip = acted(walk_turn, 12.0)
    positions, frames = clip.positions.copy(), np.arange(len(clip.positions))
    path = np.cumsum(np.linalg.norm(np.diff(positions[:, 0, :2], axis=0, prepend=positions[:1, 0, :2]), axis=1))
    lifts = []
    for leg, labels in zip(limbs(("knee", "ankle", "foot")), ([2, 4], [3, 5]), strict=True):
        stands = np.flatnonzero(clip.contacts[:, labels].any(axis=1))
        stances = np.split(stands, np.flatnonzero(np.diff(stands) > 1) + 1)
        steps = np.concatenate([np.full(len(s), np.floor(np.median(path[s]) / TREAD_M)) for s in stances])
        lifts.append(height * np.interp(frames, stands, steps))
        positions[:, leg, 2] += lifts[-1][:, None]
    others = [j for j in range(22) if j not in np.ravel(limbs(("knee", "ankle", "foot")))]
    body = np.convolve(np.pad(np.mean(lifts, axis=0), 7, "edge"), np.ones(15) / 15, "valid")
    positions[:, others, 2] += body[:, None]
    return Seen(positions, clip.rotations, clip.contacts)


SCENES: dict[str, Callable[[], Seen]] = {
    "sits": lambda: acted(sit_rise, 18.0),
    "lies on its back": lambda: lying(-1),
    "lies on its front": lambda: lying(1),
    "climbs": lambda: stairs(STEP_M),
    "descends": lambda: stairs(-STEP_M),
}


@cache
def told(name: str, calibrated: bool):
    """The truth, what was seen and what was answered (T, 22, 3) metres, and the floor and levels at the end."""
    clip, pipeline = SCENES[name](), TrajectoryPipeline(TrajectorySettings())
    messages = [replace(m, calibrated=calibrated) for m in observe(clip, np.random.default_rng(0))]
    bodies = [world.bodies[0] for message in messages for world in pipeline.process(message)]
    assert {body.tracking for body in bodies} == {Tracking.OK}
    scene = pipeline.scene(messages[0].source)
    assert scene
    seen = np.array([message.bodies[0].positions for message in messages])
    return clip.positions, seen, np.array([body.positions for body in bodies]), scene.floor.height, scene.floor.levels


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("name", SCENES)
def test_every_joint_is_on_average_as_near_to_the_truth_as_it_was_seen(name: str, calibrated: bool):
    truth, seen, answer, _, _ = told(name, calibrated)
    before, after = (np.linalg.norm(p - truth, axis=-1) for p in (seen, answer))
    assert after.mean() < before.mean()
    assert after[:, FEET].mean() < before[:, FEET].mean()
    assert after.max() < 0.2


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("name", ["sits", "lies on its back", "lies on its front"])
def test_neither_seat_nor_body_is_taken_for_ground(name: str, calibrated: bool):
    *_, floor, levels = told(name, calibrated)
    assert abs(floor) < 0.05
    assert not levels


def test_stairs_are_levels_above_a_floor_that_stays():
    *_, floor, levels = told("climbs", True)
    assert abs(floor) < 0.05
    assert len(levels) >= 4
    off = np.array(levels) / STEP_M
    assert np.abs(off - off.round()).max() * STEP_M < 0.05


def test_the_floor_goes_down_with_the_feet():
    truth, *_, floor, _ = told("descends", True)
    assert truth[-1, FEET[2:], 2].min() < -1.5
    assert floor < -1.5
