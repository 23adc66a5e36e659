"""Results that stand although what they measured has changed since, each with the reason."""

BEFORE = "measured before results recorded the pipeline's output; to be measured again"
WHITE = "measured before white noise was one for all modes of a body; to be measured again"

STALE = {
    "humor": BEFORE,
    "kinect_vicon": BEFORE,
    "latency": BEFORE,
    "mediapipe": BEFORE,
    "noisy_joints": WHITE,
    "restart": BEFORE,
    "scale": BEFORE,
}
"""Study: why its figures are kept. `tests/benchmarks/test_report.py` holds this list against the code."""
