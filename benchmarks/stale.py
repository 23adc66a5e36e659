"""Results that are kept although what they measured has changed since, each with the reason."""

_SIGMA = (
    "deviations in noise that lasts are larger since, so roots turn 3 % less from the truth; positions are the same"
)
_LAYOUTS = "pelvis and neck of layouts that lack them are placed otherwise since; it measures times"
_RUNNING = "pelvis and neck of layouts that lack them are placed otherwise since; it is being measured again"

STALE = {
    "counter": _RUNNING,
    "events": _RUNNING,
    "kinect_vicon": _RUNNING,
    "latency": _LAYOUTS,
    "mediapipe": _RUNNING,
    "restart": _LAYOUTS,
    "retarget": _RUNNING,
    "rotations": _RUNNING,
    "scale": _LAYOUTS,
    "ablations": _SIGMA,
    "soak": "it takes its stream from latency.py, whose tables also give a numpy workload's time since",
}
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
