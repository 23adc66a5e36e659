"""Results that are kept although what they measured has changed since, each with the reason."""

_TRAINED_ON = (
    "the network that completes hidden joints was trained on since; observed joints differ by 0.1 mm, their errors by "
    "0.1 % (validation)"
)

STALE = {
    **dict.fromkeys(
        (
            "restart",
            "scale",
        ),
        _TRAINED_ON,
    ),
    "soak": "it takes its stream from latency.py, whose tables also give a numpy workload's time since",
}
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
