"""Simulated people in front of a simulated depth camera, with the truth known.

`scripts` stages motions from our own kinematic rules (`gait`, `motion`), `camera` films them, `noise` holds the
error model, and `streams` writes the recordings of ``sim_data/``. The model is fitted to a real Kinect's errors by
their statistics.
"""
