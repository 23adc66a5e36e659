import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.helpers.synthetic_poses import walker

from steadypose.msgs.types import Pose, PoseClean, PoseRaw, RawBody
from steadypose.prior.clean.batch import StreamBatch
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

FRAMES = 40
OPTICAL = Rotation.from_quat(Pose.from_up("-y").orientation)


def camera(frame: int, *, moves: bool) -> tuple[Rotation, np.ndarray]:
    swing = np.sin(frame / 30) if moves else 0.0
    return Rotation.from_euler("z", 20 * swing, degrees=True) * OPTICAL, np.array([0.3 * swing, -3.0, 1.2])


def cleaned(*, moves: bool, late_s: float = 0.0, served: bool = False) -> list[PoseClean]:
    """A walk seen by a camera with a centimetre of noise, all frames but the first of it late."""
    prior, answers = StreamBatch(PriorSettings(), 1) if served else PriorPipeline(PriorSettings()), []
    for frame in range(FRAMES):
        seconds = frame / 30 + late_s * (frame > 0)
        truth, _, _ = walker(seconds)
        noise = np.random.default_rng(frame).normal(0.0, 0.01, (22, 3))
        turned, place = camera(frame, moves=moves)
        body = RawBody(1, turned.inv().apply(truth + noise - place), np.ones(22))
        raw = PoseRaw(round(seconds * 1e9), "camera", "robot", "smpl22", Pose(place, turned.as_quat()), True, [body])
        answers += prior.process_at(raw, raw.stamp_ns) if isinstance(prior, StreamBatch) else prior.process(raw)
    return answers + prior.flush()


def roots(*, moves: bool) -> np.ndarray:
    """(T, 4) seconds and the root's error, metres."""
    trajectory, found = TrajectoryPipeline(TrajectorySettings()), []
    for clean in cleaned(moves=moves):
        for world in trajectory.process(clean):
            seconds = world.stamp_ns / 1e9
            found += [[seconds, *(it.root_position - walker(seconds)[0][0])] for it in world.bodies]
    return np.array(found)


def test_the_root_is_found_all_the_same() -> None:
    still, moving = roots(moves=False), roots(moves=True)
    assert len(still) == len(moving) == FRAMES
    apart = np.linalg.norm(moving[:, 1:] - still[:, 1:], axis=1)
    assert apart.max() < 0.02
    assert np.median(np.linalg.norm(moving[:, 1:], axis=1)) < 0.02


@pytest.mark.parametrize("served", [False, True])
@pytest.mark.parametrize("late_s", [0.0, 0.004])
def test_joints_are_in_the_frame_that_the_camera_had_at_their_time(late_s: float, served: bool) -> None:
    for frame, clean in enumerate(cleaned(moves=True, late_s=late_s, served=served)):
        turned, place = camera(frame, moves=True)
        np.testing.assert_allclose(clean.sensor_pose.position, place)
        truth = turned.inv().apply(walker(frame / 30)[0] - place)
        assert np.linalg.norm(clean.bodies[0].positions - truth, axis=1).mean() < 0.02
