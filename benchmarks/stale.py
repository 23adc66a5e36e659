"""Results that are kept although what they measured has changed since, each with the reason."""

STALE = {
    "ablations": "noisy joints, whose conditions it shares, has another baseline since; the conditions are the same",
    "scale": "measured before results recorded the pipeline's output; to be measured again",
}
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
