"""Motion from observations (Tables 2 to 4): inputs, methods and scores."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from steadypose.benchmarks import product
from steadypose.benchmarks.depth_camera import Stereo, corrupt, render
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.scores import acceleration_error, position_error
from steadypose.nodes.driving import clean_joints
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import LOAD_SPEED, REST_HEIGHT, label_contacts, rotation_matrices
from steadypose.prior.body.skeleton import J
from steadypose.prior.fit.bodies import noise_of
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.motion import float_tensor
from steadypose.prior.fit.observations import Observed, Pinhole, SeenJoints
from steadypose.prior.fit.picture import track_of_picture
from steadypose.prior.fit.solve import PICTURES, FitSettings, Start, fit_window
from steadypose.prior.fit.tensors import load_network
from steadypose.prior.fit.windows import Track, load_of
from steadypose.prior.timing.rate import FPS

NOISE, HIDDEN_BELOW = 0.04, 0.9  # HuMoR's noise of joints, and the height below which joints are hidden, metres

LEGS = [J[f"{side}_{part}"] for side in ("left", "right") for part in ("knee", "ankle", "foot")]
TOES = [J["left_foot"], J["right_foot"]]
DEPTHS = np.arange(0.0, 0.151, 0.03)  # HuMoR's thresholds of penetration, metres

FOCAL, CENTRE = 900.0, (640.0, 360.0)
CAMERA_HEIGHT, AWAY = 1.3, 4.5  # height of a level camera, and its mean distance from a clip, metres
PIXELS, MISSED, WRONG, WRONG_PIXELS = 5.0, 0.1, 0.02, 60.0
"""A detector's errors: noise in pixels, share of missed key points, share of wrong ones, and their error in pixels."""

POINTS = 200  # number of surface points per frame


@dataclass(frozen=True)
class Answer:
    joints: Floats  # (T, 22, 3) metres, world
    load: Floats | None = None  # (T, 8) probabilities, or None
    seconds: float | None = None  # processor time; None for methods that process all clips together


def starts_of(cleaned: product.Cleaned, frames: int, ground: Callable[[Floats], float] | None = None) -> list[Start]:
    """Return where ``steadypose fit`` starts for each clip of `clean`'s output, of which the last ``frames`` count; the
    floor is at 0, or ``ground`` guesses its height from joints (T, 22, 3)."""
    turned = cleaned.rotations[-frames:] / np.linalg.norm(cleaned.rotations[-frames:], axis=-1, keepdims=True)
    return [
        Start.of_joints(
            joints, ground(joints) if ground else 0.0, rotations=rotation_matrices(q), ground_known=ground is None
        )
        for joints, q in zip(cleaned.positions[-frames:].swapaxes(0, 1), turned.swapaxes(0, 1), strict=True)
    ]


def seen_joints(seen: Floats) -> list[Observed]:
    """Return observations from (T, 22, 3) metres, NaN where hidden."""
    return [SeenJoints(float_tensor(seen), torch.full(seen.shape[:-1], noise_of(seen)))]


def fitted(
    model: HumorNet, starts: Sequence[Start], observed: Sequence[Observed], stages: int, settings: FitSettings
) -> Answer:
    """Return the fit of least energy over all starts."""
    began = time.process_time()
    found = [fit_window(model, start, observed, settings, stages=stages) for start in starts]
    best = min(found, key=lambda fit: fit.energies[-1])
    return Answer(
        best.motion.world_joints.double().numpy(),
        load_of(best.motion) if stages == 3 and model.config.contacts else None,
        time.process_time() - began,
    )


@dataclass(frozen=True)
class Pictures:
    """A clip observed by a level camera."""

    truth: Floats  # (T, 22, 3) metres, in a frame with z up and the camera at 0
    seen: NDArray[np.bool_]  # (T, 22) which joints the detector detected
    flat: Track  # its key points
    deep: Track  # the key points with points of a depth camera


def pictures(clips: MotionClips, clip: int, rng: np.random.Generator) -> Pictures:
    """Project one clip, and render its depth."""
    truth = clips.positions[:, clip].copy()
    truth[..., :2] -= truth[:, 0, :2].mean(axis=0)
    truth += [0.0, AWAY, -CAMERA_HEIGHT]
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    optical = truth @ rotation
    pixels = optical[..., :2] / optical[..., 2:] * FOCAL + CENTRE + PIXELS * rng.standard_normal((*truth.shape[:2], 2))
    wrong = rng.random(truth.shape[:2]) < WRONG
    pixels[wrong] += WRONG_PIXELS * rng.standard_normal((int(wrong.sum()), 2))
    pixels[rng.random(truth.shape[:2]) < MISSED] = np.nan
    confidence = rng.uniform(0.5, 1.0, truth.shape[:2])
    focal, centre = torch.tensor([FOCAL, FOCAL]), torch.tensor(CENTRE)
    camera = Pinhole(focal, centre, float_tensor(rotation), torch.zeros(3))
    stereo = Stereo()
    wall = np.full((stereo.height, stereo.width), 2.0 * AWAY)
    points = np.full((len(truth), POINTS, 3), np.nan)
    for row, joints in enumerate(optical):
        depth = corrupt(render([(joints, clips.offsets[clip])], stereo, wall), stereo, rng) * 1e-3
        v, u = np.nonzero((depth > 0.5) & (depth < 1.6 * AWAY))
        some = rng.permutation(len(u))[:POINTS]
        z = depth[v[some], u[some]]
        centre = stereo.intrinsics[:2, 2]
        points[row, : len(some)] = (
            np.stack([(u[some] - centre[0]) * z / stereo.focal, (v[some] - centre[1]) * z / stereo.focal, z], axis=-1)
            @ rotation.T
        )
    flat, deep = (
        track_of_picture(pixels, confidence, camera, -CAMERA_HEIGHT, floor_known=True, points=told, clean=clean_joints)
        for told in (None, points)
    )
    return Pictures(truth, np.asarray(np.isfinite(pixels).all(axis=-1)), flat, deep)


CAMERA = replace(PICTURES, ground_height_sigma=0.05)  # settings of ``steadypose fit`` for a camera of known height


def scores(answers: Sequence[Answer], truth: Floats, hidden: NDArray[np.bool_], contacts: NDArray[np.bool_],
           floor: float = 0.0) -> dict[str, Any]:  # fmt: skip
    """Return the figures of Table 2 over C clips with these joints (T, C, 22, 3) metres ``hidden`` (T, C, 22), true
    labels of load (T, C, 8), and this height of the floor, metres.
    """
    said = np.stack([answer.joints for answer in answers], axis=1)
    error = position_error(said, truth)
    rooted = position_error(said - said[:, :, :1], truth - truth[:, :, :1])
    depth = floor + REST_HEIGHT[4] - said[:, :, TOES, 2]
    found: dict[str, Any] = {
        "all_mm": _mm(error), "seen_mm": _mm(np.where(hidden, np.nan, error)),
        "legs_mm": _mm(error[..., LEGS]), "rooted_mm": _mm(rooted),
        "acceleration_m_s2": round(float(np.linalg.norm(np.diff(said, n=2, axis=0), axis=-1).mean()) * FPS**2, 2),
        "acceleration_error_m_s2": round(float(acceleration_error(said, truth).mean()) * FPS**2, 2),
        "penetration_percent": round(100 * float(np.mean([depth > limit for limit in DEPTHS])), 2),
        "penetration_mm": _mm(np.maximum(depth, 0.0)),
    }  # fmt: skip
    if hidden.any():
        found["hidden_mm"] = _mm(np.where(hidden, error, np.nan))
    if all(answer.load is not None for answer in answers):
        load = np.stack([answer.load for answer in answers if answer.load is not None], axis=1) > 0.5
        found["contact_accuracy"] = round(float((load == contacts).mean()), 4)
    if all(answer.seconds is not None for answer in answers):
        found["seconds"] = round(float(np.mean([answer.seconds for answer in answers if answer.seconds])), 2)
    return found


def load_labels(clips: MotionClips) -> NDArray[np.bool_]:
    """Return the true labels of load, (T, C, 8)."""
    clip_count = clips.positions.shape[1]
    return np.stack([label_contacts(clips.positions[:, c], FPS, LOAD_SPEED) for c in range(clip_count)], axis=1)


def _mm(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return round(float(known.mean()) * 1e3, 1) if len(known) else None


def shipped() -> HumorNet:
    return load_network(HumorNet, HumorConfig.from_dict, "default", "humor")
