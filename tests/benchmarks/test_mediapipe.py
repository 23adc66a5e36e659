import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.studies.mediapipe import Stream, error_of
from steadypose.prior.body.skeleton import J


def test_errors_ask_neither_where_the_body_stands_nor_how_it_is_turned_nor_what_a_joint_is() -> None:
    rng = np.random.default_rng(0)
    truth = np.cumsum(rng.normal(0, 0.01, (40, 22, 3)), axis=0) + rng.normal(0, 0.4, (22, 3))
    truth[3, J["left_wrist"]] = np.nan
    turn = Rotation.from_rotvec((0.2, 0.4, 2.0)).as_matrix()
    walked = truth @ turn.T + np.cumsum(rng.normal(0, 0.1, (40, 1, 3)), axis=0)
    assert error_of(walked, Stream("cam01", walked, truth))["position_mm"] < 1e-6
    off = error_of(walked + np.eye(22)[:, :1] * 0.05, Stream("cam01", walked, truth))
    assert off["position_mm"] < 1.0
    shaken = walked + rng.normal(0, 0.02, walked.shape)
    found = error_of(shaken, Stream("cam01", shaken, truth))
    assert found["position_mm"] == pytest.approx(1e3 * 0.02 * np.sqrt(8 / np.pi), rel=0.25)
