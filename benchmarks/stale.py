"""Results that are kept although what they measured has changed since, each with the reason."""

_LAYOUTS = "pelvis and neck of layouts that lack them are placed otherwise since; it measures times"
_RUNNING = "pelvis and neck of layouts that lack them are placed otherwise since; it is being measured again"

STALE = {
    "kinect_vicon": _RUNNING,
    "latency": _LAYOUTS,
    "restart": _LAYOUTS,
    "rotations": _RUNNING,
    "scale": _LAYOUTS,
    "soak": "it takes its stream from latency.py, whose tables also give a numpy workload's time since",
}
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
