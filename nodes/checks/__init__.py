"""Checks of a running stream. Each problem states a cause that the user can act on."""
