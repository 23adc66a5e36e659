"""Results that are kept although what they measured has changed since, each with the reason."""

STALE = {
    **dict.fromkeys(
        ("humor", "humor_credit"),
        "fits start from the published rotations since; joints of validation people, in noise that lasts, went from "
        "24.3 to 23.5 mm",
    ),
    **dict.fromkeys(
        ("events", "event_mocap"),
        "legs without any estimate have an adult's lengths since; no scene hides legs so long",
    ),
    "soak": "it takes its stream from latency.py, whose tables also give a numpy workload's time since",
}
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
