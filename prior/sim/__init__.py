"""Simulated people in front of a simulated depth camera, with the truth known.

`scripts` creates motions from our own kinematic rules (`gait`, `motion`), `camera` records them, `noise` is the error
model, and `streams` writes the recordings of ``sim_data/``. The error model is fitted to the statistics of a real
Kinect's errors.
"""
