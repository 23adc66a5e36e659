"""Results that are kept although what they measured has changed since, each with the reason."""

STALE = {
    "soak": "an hour of faults; since then, the network that completes hidden joints was trained on, and the code of "
    "the benchmarks that it shares is shorter",
}
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
