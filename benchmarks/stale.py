"""Results that are kept although what they measured has changed since, each with the reason."""

_STEADY = "measured before the steady stage, which moves observed joints by a share of each revision"

STALE: dict[str, str] = dict.fromkeys(
    (
        "restart",
        "soak",
    ),
    _STEADY,
)
"""Reason for keeping each study's figures. `tests/benchmarks/test_report.py` compares this list with the code."""
