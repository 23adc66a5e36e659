"""Results that are kept although what they measured has changed since, each with the reason."""

STALE = {
    "humor": "what a fit owes to the model is a study of its own since, with more clips; the other tables are the same",
    "soak": "it takes its stream from latency.py, whose tables also give a numpy workload's time since",
}
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
