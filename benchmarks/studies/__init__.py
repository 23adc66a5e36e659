"""The studies of ``steadypose evaluate``, one module each. Each has ``run``, from a `Bench` to a `Result`, and
``DEPENDS_ON``, names of what it measures (`provenance.measured`): when one of these changes, its results are stale."""

from __future__ import annotations

STUDIES = (
    "fidelity", "kinect_vicon", "rotations", "heading", "mediapipe", "noisy_joints", "hidden_joints", "layouts",
    "interpolation", "completion", "hgvae", "world", "counter", "contacts", "humor", "event_mocap", "ablations",
)  # fmt: skip

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

PREPARED = ("event_mocap",)  # studies that need prepared motion and cannot use simulated people instead
