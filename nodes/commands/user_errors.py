"""Which errors are for the user, and which are bugs."""

from __future__ import annotations


def is_for_user(error: Exception) -> bool:
    """Whether an error says what to do: the project's own, and those of files. Others are bugs."""
    return isinstance(error, OSError) or type(error).__module__.startswith("steadypose.")
