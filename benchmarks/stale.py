"""Results that stand although what they measured has changed since, each with the reason."""

BEFORE = "measured before results recorded the pipeline's output; to be measured again"

STALE = {
    "completion": BEFORE,
    "contacts": BEFORE,
    "event_mocap": BEFORE,
    "events": BEFORE,
    "hgvae": BEFORE,
    "humor": BEFORE,
    "interpolation": BEFORE,
    "kinect_vicon": BEFORE,
    "latency": BEFORE,
    "mediapipe": BEFORE,
    "restart": BEFORE,
    "scale": BEFORE,
}
"""Study: why its figures are kept. `tests/benchmarks/test_report.py` holds this list against the results."""
