"""The trajectory network sees no future, and its live form says the same."""

from __future__ import annotations

import pytest
import torch

from steadypose.prior.models.root_velocity import LiveRootVelocity, TrajectoryConfig
from steadypose.training.recipes.root_velocity import RootMotion, TrajectoryNet
from steadypose.training.weights import arrays_of


@pytest.fixture
def net() -> TrajectoryNet:
    torch.manual_seed(0)
    return TrajectoryNet(TrajectoryConfig(kernel=5)).eval()


def window(net: TrajectoryNet, count: int, more: int = 0) -> torch.Tensor:
    return torch.randn(count, net.config.context + more, 22, 3, generator=torch.Generator().manual_seed(1))


@torch.no_grad()
def test_sees_no_future(net: TrajectoryNet):
    joints = window(net, 2, more=6)
    changed = joints.clone()
    changed[:, 10:] += 1.0
    before, after = net(joints), net(changed)
    for field in RootMotion._fields:
        torch.testing.assert_close(getattr(before, field)[:, :10], getattr(after, field)[:, :10])
    assert not torch.allclose(before.velocity[:, 10], after.velocity[:, 10])


@torch.no_grad()
def test_depends_on_its_context_and_nothing_before(net: TrajectoryNet):
    joints = window(net, 1, more=1)
    first, second = joints.clone(), joints.clone()
    first[:, 0] += 1.0
    second[:, 1] += 1.0
    end = net(joints).velocity[:, -1]
    # The velocity of the first frame of a context needs the frame before it, which counts as standing still.
    assert not torch.equal(net(second).velocity[:, -1], end)
    torch.testing.assert_close(net(first[:, 1:]).velocity[:, -1], net(joints[:, 1:]).velocity[:, -1])


@torch.no_grad()
def test_newest_frame_says_the_same(net: TrajectoryNet):
    joints = window(net, 3)
    whole, newest = net(joints), LiveRootVelocity(net.config, arrays_of(net))(joints.numpy())
    for live, trained in zip(newest, whole[:2], strict=True):  # contacts only train it
        torch.testing.assert_close(torch.from_numpy(live), trained[:, -1], atol=1e-4, rtol=1e-4)


def test_config_survives_json(net: TrajectoryNet):
    import json
    from dataclasses import asdict

    config = TrajectoryConfig(kernel=5, sigma_scale=(1.1, 0.9), correlation_s=(0.4, 0.2))
    assert TrajectoryConfig.from_dict(json.loads(json.dumps(asdict(config)))) == config
