"""The protocols of ``steadypose evaluate``, one module each, by name.

Each has ``run``, from a `Bench` to a `Result`, and ``DEPENDS_ON``, names of `provenance.ships`: when one of these
changes, its results are stale.
"""

from __future__ import annotations

PROTOCOLS: dict[str, str] = {
    "fidelity": "error by speed of the joint, noise and delay; what is left of a swing",
    "kinect_vicon": "real Kinect against Vicon, each of eight people left out",
    "rotations": "orientations of joints; heading from a real Kinect",
    "mediapipe": "real MediaPipe beside four cameras",
    "noisy_joints": "independent and correlated noise, spikes, exchanged limbs",
    "hidden_joints": "joints below 0.9 m, an arm behind the body, limbs away for 0.2 to 2 s",
    "reconstruction": "windows through the refinement model (HM-VAE, table 3)",
    "interpolation": "motion in gaps of 5 to 45 frames (HM-VAE, table 2)",
    "completion": "a part of the body from the rest",
    "hgvae": "likelihood and depth, anomalies, imputation, actions (the HG-VAE paper)",
    "world": "root drift and foot skate",
    "contacts": "load of feet, against force plates",
    "humor": "futures, noisy and hidden joints, a simulated detector and depth camera (the HuMoR paper)",
    "camera_rates": "cameras of 15 to 120 Hz",
    "ablations": "what each part of the default is worth, and its milliseconds",
    "streaming": "delay found, jitter at matched delay, recovery, lost frames, jittering stamps",
}
"""Module in this package: what it measures."""

SENSORS = {
    "kinect_vicon": "ui_prmd.npz",
    "rotations": "ui_prmd.npz",
    "mediapipe": "mediapipe_pose.npz",
    "contacts": "contacts_grf.npz",
}
"""Protocols with recordings of their own, and the file of them."""
