"""Results that are kept although what they measured has changed since, each with the reason."""

_STEADY = "measured before the steady stage and the fast matrix products, which its seconds and losses depend on little"

STALE: dict[str, str] = dict.fromkeys(
    (
        "restart",
        "soak",
    ),
    _STEADY,
)
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
