"""Results that stand although the code, weights or settings have changed since, each with the reason."""

BEFORE = "measured before results recorded the code that ran"
TOUCHED = "code that it imports was touched since"
FROZEN = "a finished study, whose code is gone"

STALE = {
    "calibration": BEFORE,
    "camera_rates": BEFORE,
    "completion": BEFORE,
    "contacts": BEFORE,
    "depth_lifting": FROZEN,
    "event_mocap": TOUCHED,
    "events": BEFORE,
    "fuzz": BEFORE,
    "hgvae": BEFORE,
    "humor": BEFORE,
    "identity": BEFORE,
    "importers": FROZEN,
    "interpolation": BEFORE,
    "kinect_vicon": BEFORE,
    "latency": BEFORE,
    "mediapipe": BEFORE,
    "memory": BEFORE,
    "reconstruction": BEFORE,
    "restart": BEFORE,
    "rotations": "since then films are opened too, by a module that opened its streams; they are opened as before",
    "scale": BEFORE,
    "simulated": BEFORE,
    "streaming": BEFORE,
    "web_page": TOUCHED,
}
"""Benchmark: why its figures are kept. `tests/benchmarks/test_report.py` holds this list against the results."""
