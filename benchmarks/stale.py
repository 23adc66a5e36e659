"""Results that are kept although what they measured has changed since, each with the reason."""

_TIMES = "it measures times; since, the pose of somebody who enters the image has changed in one of the bundled streams"

STALE = {
    "latency": _TIMES,
    "restart": _TIMES,
    "scale": _TIMES,
    "soak": "it takes its stream from latency.py, whose tables also give a numpy workload's time since",
}
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
