"""Results that are kept although what they measured has changed since, each with the reason."""

STALE: dict[str, str] = {
    "ablations": "measured before hidden joints were completed by a transformer",
    "completion": "measured before hidden joints were completed by a transformer",
    "contacts": "measured before hidden joints were completed by a transformer",
    "counter": "measured before hidden joints were completed by a transformer",
    "event_mocap": "measured before hidden joints were completed by a transformer",
    "events": "measured before hidden joints were completed by a transformer",
    "fidelity": "measured before hidden joints were completed by a transformer",
    "heading": "measured before hidden joints were completed by a transformer",
    "hgvae": "measured before hidden joints were completed by a transformer",
    "hidden_joints": "measured before hidden joints were completed by a transformer",
    "humor": "measured before hidden joints were completed by a transformer",
    "interpolation": "measured before hidden joints were completed by a transformer",
    "kinect_vicon": "measured before hidden joints were completed by a transformer",
    "latency": "measured before hidden joints were completed by a transformer",
    "layouts": "measured before hidden joints were completed by a transformer",
    "mediapipe": "measured before hidden joints were completed by a transformer",
    "noisy_joints": "measured before hidden joints were completed by a transformer",
    "restart": "measured before hidden joints were completed by a transformer",
    "retarget": "measured before hidden joints were completed by a transformer",
    "rotations": "measured before hidden joints were completed by a transformer",
    "scale": "measured before hidden joints were completed by a transformer",
    "world": "measured before hidden joints were completed by a transformer",
    "soak": "measured before the steady stage and the fast matrix products, on which its losses depend little",
}
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
