"""Text of others on a terminal."""

from __future__ import annotations


def printable(text: str) -> str:
    """The text, with what a terminal would obey instead of showing it made visible."""
    return "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text)
