"""The ONNX files that ship answer as the live forms do, from the same weights."""

from __future__ import annotations

import os
import re
from functools import cache

import numpy as np
import onnx
import onnxruntime
import pytest
from numpy.typing import NDArray
from onnx import numpy_helper
from tests.helpers.bodies import waving

from steadypose.benchmarks.machine import ROOT
from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.models.contacts.features import contact_features
from steadypose.prior.models.contacts.inference import LiveContacts
from steadypose.prior.models.hgvae.fault_inference import LiveFaultNet
from steadypose.prior.models.hgvae.features import to_tracks
from steadypose.prior.models.hgvae.inference import LiveHGVAE
from steadypose.prior.models.hmvae.inference import LiveHMVAE
from steadypose.prior.models.mixture.bank import (
    DENSITIES,
    EXPERTS,
    MEASUREMENT_SIGMA,
    advance,
    new_bank,
)
from steadypose.prior.models.mixture.features import FEATURES, PARENT, describe
from steadypose.prior.models.mixture.inference import MixtureSmoother
from steadypose.prior.models.occlusion.candidates import FEATURES as OCCLUSION_FEATURES
from steadypose.prior.models.occlusion.inference import SIGMA_SCALE, LiveOcclusion, Occluded
from steadypose.prior.models.onnx.export import FORMS, export
from steadypose.prior.models.root_velocity.inference import LiveRootVelocity
from steadypose.prior.models.sensor_bias.features import HISTORY, features, trunk_frame
from steadypose.prior.models.sensor_bias.inference import LiveCorrection
from steadypose.prior.models.weights_io import WEIGHTS

BIAS_SIGMA, SENSOR_SIGMA = 0.007, 0.01


@cache
def session(name: str) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(WEIGHTS / f"{name}.onnx", options, providers=["CPUExecutionProvider"])


def answers(name: str, **inputs: NDArray[np.floating]) -> list[NDArray[np.float32]]:
    return [np.asarray(part) for part in session(name).run(None, {k: v.astype(np.float32) for k, v in inputs.items()})]


def windows(bodies: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Tracks with gaps, ends that were not seen, and joints that never were; and how far each is to be believed."""
    rng = np.random.default_rng(bodies)
    motion = waving(50 + 10 * bodies)
    positions = np.stack([motion[10 * k : 10 * k + 50] for k in range(bodies)])
    positions = positions + rng.normal(scale=0.01, size=positions.shape)
    for body in positions[1:]:
        for joint in rng.choice(22, 10, replace=False):
            first, last = sorted(rng.integers(0, 51, 2))
            body[first:last, joint] = np.nan
        body[:, rng.choice(np.arange(3, 22), 2, replace=False)] = np.nan
    tracks = to_tracks(positions, np.full(bodies, 1.05))
    return tracks.x, tracks.observed * rng.uniform(0.1, 1.0, tracks.observed.shape)


def test_mixture_frame_by_frame() -> None:
    bodies, delay, rng = 2, 2, np.random.default_rng(0)
    motion = np.stack([waving(30), waving(30) + 1.0], axis=1) + rng.normal(scale=0.01, size=(30, bodies, 22, 3))
    motion[5:15, 0, 20] = motion[20:, 1, 7] = np.nan
    live, bank, confidence = MixtureSmoother(delay, bodies), new_bank(bodies, delay), np.ones((bodies, 22))
    features = np.empty((bodies, 22, FEATURES), dtype=np.float32)
    experts, scale, (gap, between) = np.empty((bodies, 22, EXPERTS, 3)), np.empty(bodies), np.empty((2, bodies, 22))
    sizes = {value.name: value.shape[1:] for value in session("mixture-default").get_inputs()}
    parts = ("own", "own_weight", "body", "body_weight", "written")
    memory = {name: np.zeros((bodies, *sizes[name])) for name in parts}
    for frame, positions in enumerate(motion):
        expected = live.update(positions, frame / 30)
        advance(bank, frame, 1 / 30, positions, confidence, DENSITIES, MEASUREMENT_SIGMA)
        if expected is None:
            continue
        describe(bank, frame + 1, delay, PARENT, experts, features, scale, gap, between)
        found, sigma, *kept = answers(
            "mixture-default",
            features=features, experts=experts, heading=bank.heading, scale=scale, gap=gap, between=between,
            **memory,
        )  # fmt: skip
        memory = dict(zip(memory, kept, strict=True))
        np.testing.assert_allclose(found, expected.positions, atol=5e-6)  # metres
        np.testing.assert_allclose(sigma, expected.sigma, rtol=1e-4)


def test_occlusion() -> None:
    rng = np.random.default_rng(0)
    features, joint = rng.normal(size=(30, OCCLUSION_FEATURES)).astype(np.float32), rng.integers(0, 22, 30)
    rows = Occluded(np.zeros(30, dtype=np.intp), joint, rng.normal(size=(30, 3, 3)), features)
    expected = LiveOcclusion.load("default")(rows)
    weights, sigma = answers("occlusion-default", features=features, joint=joint.astype(np.float32))
    np.testing.assert_allclose((weights[..., None] * rows.candidates).sum(axis=1), expected.positions, atol=1e-5)
    np.testing.assert_allclose(SIGMA_SCALE * sigma, expected.sigma, rtol=1e-4)


def test_refinement() -> None:
    for bodies in (1, 3):
        rotations = np.random.default_rng(bodies).normal(size=(bodies, 8, 22, 6)).astype(np.float32)
        (decoded,) = answers("hmvae-default", rotations=rotations)
        np.testing.assert_allclose(decoded, LiveHMVAE.load("default")(rotations), atol=2e-5)


@pytest.mark.parametrize("bodies", [1, 4])
def test_reconstruction_with_completion(bodies: int) -> None:
    tracks, confidence = windows(bodies)
    sigmas = np.full(bodies, BIAS_SIGMA)
    mean, sigma = answers("hgvae-default", tracks=tracks, confidence=confidence, bias_sigma=sigmas)
    live = LiveHGVAE.load("default", SENSOR_SIGMA, bodies).reconstruct(tracks, confidence, np.full(bodies, BIAS_SIGMA))
    np.testing.assert_allclose(mean, live.mean, atol=1e-5)  # metres
    np.testing.assert_allclose(sigma, live.sigma, rtol=1e-4)


@pytest.mark.parametrize("bodies", [1, 4])
def test_faults(bodies: int) -> None:
    tracks, confidence = windows(bodies)
    found = np.random.default_rng(0).normal(scale=0.05, size=tracks.shape) + np.nan_to_num(tracks)
    sigma = np.random.default_rng(1).uniform(0.005, 0.05, tracks.shape)
    sigmas = np.full(bodies, SENSOR_SIGMA)
    (odds,) = answers(
        "hgvae-default.faults",
        tracks=tracks, reconstructed=found, sigma=sigma, confidence=confidence, sensor_sigma=sigmas,
    )  # fmt: skip
    live = LiveFaultNet.load("default", bodies)(tracks, found, sigma, confidence, np.full(bodies, SENSOR_SIGMA))
    np.testing.assert_allclose(odds, live, atol=2e-4)


def test_root_motion() -> None:
    live = LiveRootVelocity.load("default")
    joints = np.random.default_rng(0).normal(scale=0.3, size=(3, live.config.context, 22, 3))
    for found, expected in zip(answers("trajectory-default", joints=joints), live(joints), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_contacts() -> None:
    """Four bodies: one seen in full, one against its root, one on unknown ground, one without its root or a foot."""
    rng, live = np.random.default_rng(0), LiveContacts.load("default")
    positions = waving(40)[[0, 10, 20, 30]]
    before = positions + rng.normal(scale=0.02, size=positions.shape)
    positions[3, 0] = positions[3, CONTACT_JOINTS[2]] = np.nan
    ground = np.zeros((4, 8))
    ground[2], ground[1, 3] = np.nan, np.nan
    inputs = {
        "positions": positions, "before": before, "dt": np.full(4, 0.04), "yaw": rng.uniform(-3, 3, 4),
        "sigma": rng.uniform(0.0, 0.05, (4, 22)), "root_seen": np.array([1.0, 0.0, 1.0, 1.0]), "ground": ground,
    }  # fmt: skip
    state = rng.normal(scale=0.5, size=(4, live.hidden)).astype(np.float32)
    expected = live(contact_features(**inputs), state)
    for found, wanted in zip(answers("contacts-default", **inputs, state=state), expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-4)


def test_sensor_correction() -> None:
    motion = waving(HISTORY[-1] + 3) + np.random.default_rng(0).normal(scale=0.01, size=(HISTORY[-1] + 3, 22, 3))
    history = np.stack([[motion[HISTORY[-1] + body - ago] for body in range(3)] for ago in HISTORY])
    history[0, 1, 20] = history[2:, 2, 15] = np.nan
    camera = np.array([2.5, -0.4, 1.1])
    (found,) = answers("correction-kinect_v2", history=history.swapaxes(0, 1), camera=np.tile(camera, (3, 1)))
    live = LiveCorrection.load("kinect_v2", 3)(features(history, camera))
    np.testing.assert_allclose(found, live @ trunk_frame(history[0]).swapaxes(-1, -2), atol=2e-6)


def weights_of(content: bytes) -> dict[str, bytes]:
    """What is kept in half precision in an ONNX file, by name."""
    arrays = {value.name: numpy_helper.to_array(value) for value in onnx.load_from_string(content).graph.initializer}
    return {name: array.tobytes() for name, array in arrays.items() if array.dtype == np.float16}


def test_the_files_are_those_of_the_weights_that_ship() -> None:
    name = "hgvae-default.faults"
    made = export(FORMS[name]())
    assert made == export(FORMS[name]())
    shipped = (WEIGHTS / f"{name}.onnx").read_bytes()
    assert weights_of(made) == weights_of(shipped)
    assert sum(map(len, weights_of(shipped).values())) > 100_000


@pytest.mark.parametrize("name", list(FORMS))
def test_a_file_is_small_named_and_of_no_machine(name: str) -> None:
    content = (WEIGHTS / f"{name}.onnx").read_bytes()
    assert len(content) < 8_000_000
    assert b"/" + b"site-packages" not in content
    assert os.sep.join(("prior", "models")).encode() not in content
    for value in (*session(name).get_inputs(), *session(name).get_outputs()):
        assert value.shape[0] == "bodies"
        assert all(isinstance(size, int) for size in value.shape[1:])


def test_the_page_states_every_input_and_output_with_its_shape() -> None:
    page = (ROOT / "docs" / "other_languages.md").read_text()
    stated: dict[str, dict[str, str]] = {}
    file = ""
    row = re.compile(r"^\| ?(\w*) \| ((?:`\w+`(?:, )?)+) \| ((?:\(.*?\)(?:, )?)+) \|", re.MULTILINE)
    for name, names, shapes in row.findall(page):
        file = name or file
        each = re.findall(r"\(.*?\)", shapes)
        values = re.findall(r"`(\w+)`", names)
        stated.setdefault(file, {}).update(zip(values, each * (len(values) // len(each)), strict=True))
    held: dict[str, dict[str, str]] = {}
    for path in WEIGHTS.glob("*.onnx"):
        graph = onnx.load(path).graph
        held["faults" if ".faults" in path.name else path.name.partition("-")[0]] = {
            value.name: f"({', '.join(['B', *(str(d.dim_value) for d in value.type.tensor_type.shape.dim[1:])])})"
            for value in [*graph.input, *graph.output]
        }
    assert stated == held
