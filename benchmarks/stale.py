"""Results that stand although what they measured has changed since, each with the reason."""

STALE = {
    "ablations": "noisy joints, whose conditions it shares, has another baseline since; the conditions are the same",
    "scale": "measured before results recorded the pipeline's output; to be measured again",
}
"""Study: why its figures are kept. `tests/benchmarks/test_report.py` holds this list against the code."""
