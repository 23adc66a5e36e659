"""The live forms of the small networks are the trained ones: random weights, random inputs."""

import numpy as np
import pytest
import torch
from tests.prior.models.test_hgvae import awake

from steadypose.prior.models.hgvae.config import FaultNetConfig
from steadypose.prior.models.hgvae.faults import LiveFaultNet, fault_features
from steadypose.prior.models.hgvae.live_completion import LiveCompletion
from steadypose.prior.models.sensor_bias import FEATURES, CorrectionConfig, LiveCorrection
from steadypose.training.networks.graph import FaultNet
from steadypose.training.recipes.sensor_bias import CorrectionNet
from steadypose.training.weights import arrays_of

SEEDS = pytest.mark.parametrize("seed", range(5))


def randomised(network: torch.nn.Module, seed: int) -> None:
    """Every weight counts: as they begin, biases and residual branches are zero."""
    torch.manual_seed(seed)
    for name, tensor in network.state_dict().items():
        torch.nn.init.normal_(tensor, std=0.3)
        if "adjacency" in name or "weight" in name:
            tensor /= tensor.shape[-1] ** 0.5


@SEEDS
def test_completion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = awake(seed=seed)
    assert model.completion is not None
    deviations = rng.normal(scale=0.3, size=(4, 66, 12)).astype(np.float32)
    observed = (rng.random((4, 66, 12)) < 0.8) * rng.uniform(0.1, 1.0, (4, 66, 12))
    observed[0] = 1.0  # a whole window, which it leaves alone
    observed[1, 30:36] = 0.0  # joints never seen
    observed[2, :, 5:] = 0.0
    torched = torch.from_numpy(deviations), torch.from_numpy(observed).float()
    expected, expected_certainty = model.completed(*torched, 0.01)
    completed = deviations.copy()
    assert model.config.completion is not None
    live = LiveCompletion(model.config.completion, arrays_of(model.completion), max_batch=5)
    certainty = live.complete(completed, observed, np.full(len(completed), 0.01))
    np.testing.assert_allclose(completed, expected.numpy(), atol=2e-6)
    np.testing.assert_allclose(certainty, expected_certainty.numpy(), atol=2e-6)
    assert (completed[0] == deviations[0]).all()


@SEEDS
def test_faults(seed: int) -> None:
    rng = np.random.default_rng(seed)
    config = FaultNetConfig(frames=20, features=8)
    network = FaultNet(config).eval()
    randomised(network, seed)
    x, found = rng.normal(scale=0.3, size=(2, 3, 66, 20))
    sigma, observed = rng.uniform(0.002, 0.1, (3, 66, 20)), (rng.random((3, 66, 20)) < 0.8).astype(float)
    sensor_sigma = rng.uniform(0.003, 0.04, 3)
    features = fault_features(x, found, sigma, observed, sensor_sigma, network.mean.numpy().astype(np.float64))
    with torch.inference_mode():
        expected = network(torch.from_numpy(features)).numpy()
    live = LiveFaultNet(config, arrays_of(network), max_batch=4)
    np.testing.assert_allclose(live(x, found, sigma, observed, sensor_sigma), expected, atol=1e-5 * abs(expected).max())


@SEEDS
def test_sensor_correction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    network = CorrectionNet(CorrectionConfig(hidden=16)).eval()
    randomised(network, seed)
    network.scale.abs_().add_(0.1)
    features = rng.normal(size=(3, FEATURES))
    features[rng.random(features.shape) < 0.1] = np.nan  # of missing joints
    with torch.inference_mode():
        expected = network(torch.from_numpy(features).float()).numpy()
    live = LiveCorrection(arrays_of(network), max_batch=4)(features)
    np.testing.assert_allclose(live, expected, atol=1e-5 * np.abs(expected).max())
