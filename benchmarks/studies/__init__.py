"""The studies of ``steadypose evaluate``, one module each. Each has ``run``, from a `Bench` to a `Result`, and
``DEPENDS_ON`` (`results.Study`)."""

from __future__ import annotations

STUDIES: dict[str, str] = {
    "fidelity": "error by speed of the joint, noise and delay; what is left of a swing",
    "kinect_vicon": "real Kinect against Vicon, each of eight people left out",
    "rotations": "orientations of joints, on motion whose files have them",
    "heading": "heading from a real Kinect; the root in the bundled streams",
    "mediapipe": "real MediaPipe beside four cameras",
    "noisy_joints": "independent and correlated noise, spikes, exchanged limbs",
    "hidden_joints": "joints below 0.9 m, an arm behind the body, limbs away for 0.2 to 2 s",
    "layouts": "joints that COCO's and other layouts lack; the same behind a counter",
    "interpolation": "motion in gaps of 5 to 45 frames (HM-VAE, table 2)",
    "completion": "a part of the body from the rest",
    "hgvae": "likelihood, anomalies, imputation (the HG-VAE paper)",
    "world": "root drift and foot skate",
    "counter": "simulated people behind a counter: heading, place, height, sitting or standing",
    "contacts": "load of feet, against force plates",
    "humor": "futures, noisy and hidden joints, a simulated detector and depth camera (the HuMoR paper)",
    "event_mocap": "events of motion capture whose names say what it holds",
    "ablations": "what each part of the default is worth, and its milliseconds",
}
"""Description of what each module of this package measures."""

SENSORS = {
    "kinect_vicon": "ui_prmd.npz",
    "rotations": "dancedb.tar.xz",
    "heading": "ui_prmd.npz",
    "mediapipe": "mediapipe_pose.npz",
    "contacts": "contacts_grf.npz",
}
"""Studies with their own recordings, and the file of each."""

NO_SPLIT = ("kinect_vicon", "heading", "mediapipe", "contacts", "counter")
"""Studies of people that have no test split, so that reading them is not logged."""

PREPARED = ("event_mocap",)
"""Studies that need prepared motion and cannot use simulated people instead."""
