import numpy as np
import pytest

from steadypose.benchmarks.motion import simulated_clips
from steadypose.benchmarks.studies import layouts
from steadypose.prior.body.layouts import SKELETONS, to_canonical
from steadypose.prior.body.skeleton import J


@pytest.mark.parametrize("layout", layouts.LAYOUTS)
def test_a_sensors_joints_are_those_of_the_body(layout: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layouts, "NOISE", 0.0)
    clips = simulated_clips(20, 2, 0)
    joints = layouts.sensed(clips, layout, np.random.default_rng(0), counter=False)
    body, _ = to_canonical(SKELETONS[layout], joints)
    off = np.linalg.norm(body - clips.positions, axis=-1).mean(axis=(0, 1))
    assert np.nanmax(off) < 0.035
    assert np.isfinite(off[[J["pelvis"], J["neck"], J["left_wrist"]]]).all()
    hidden = layouts.sensed(clips, layout, np.random.default_rng(0), counter=True)
    body, _ = to_canonical(SKELETONS[layout], hidden)
    assert np.isnan(body[:, :, [J["pelvis"], J["left_hip"], J["right_ankle"]]]).all()
    assert np.isfinite(body[:, :, [J["left_shoulder"], J["right_wrist"]]]).all()
