"""Results that are kept although what they measured has changed since, each with the reason."""

_TRAINED_ON = "the network that completes hidden joints was trained on since; observed joints are the same"

STALE = {
    **dict.fromkeys(
        (
            "ablations",
            "completion",
            "contacts",
            "counter",
            "event_mocap",
            "events",
            "fidelity",
            "heading",
            "hgvae",
            "hidden_joints",
            "humor",
            "interpolation",
            "kinect_vicon",
            "latency",
            "layouts",
            "mediapipe",
            "noisy_joints",
            "restart",
            "retarget",
            "rotations",
            "scale",
            "world",
        ),
        _TRAINED_ON,
    ),
    "soak": "it takes its stream from latency.py, whose tables also give a numpy workload's time since",
}
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
