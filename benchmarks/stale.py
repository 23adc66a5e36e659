"""Results that stand although what they measured has changed since, each with the reason."""

BEFORE = "measured before results recorded the pipeline's output; to be measured again"

STALE = {
    "scale": BEFORE,
}
"""Study: why its figures are kept. `tests/benchmarks/test_report.py` holds this list against the code."""
