"""The frame rate."""

FPS = 30.0  # rate of the prior's grid, of prepared motion and of every model, frames per second
