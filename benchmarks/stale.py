"""Results that are kept although what they measured has changed since, each with the reason."""

STALE: dict[str, str] = {
    "soak": "measured before the steady stage and the fast matrix products, on which its losses depend little",
}
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
