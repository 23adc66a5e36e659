"""The one rate of frames."""

FPS = 30.0
"""Frames a second of the prior's grid, of prepared motion and of every model."""
