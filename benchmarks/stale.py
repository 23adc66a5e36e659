"""Results that are kept although what they measured has changed since, each with the reason."""

STALE = {
    "retarget": "the root's step is bounded since: worst slip on walk_turn and crossing 33 and 83 mm, not 247 and 442",
    "soak": "it takes its stream from latency.py, whose tables also give a numpy workload's time since",
}
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
