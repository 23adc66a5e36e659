import numpy as np
import torch

from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.fit.hmvae_network import SkeletonConv, SkeletonPool, SkeletonUnpool
from steadypose.prior.models.layers import pooling_levels

SMPL24 = (*PARENTS, 20, 21)  # with hands, as the official code has it


def test_on_smpls_24_joints_the_graph_gives_the_official_tables() -> None:
    levels = pooling_levels(SMPL24)
    assert [level.edges for level in levels] == [24, 14, 9, 7]
    assert [len(n) for n in levels[0].neighbours] == [
        7, 8, 8, 8, 7, 7, 9, 4, 4, 9, 3, 3, 8, 9, 9, 5, 7, 7, 5, 5, 4, 4, 3, 3,
    ]  # fmt: skip
    assert all(len(n) == 7 for n in levels[3].neighbours)


def test_chains_pair_from_the_root_and_odd_ones_leave_the_first_edge_alone() -> None:
    levels = pooling_levels(PARENTS)
    assert [level.edges for level in levels] == [22, 12, 7, 7]
    assert levels[0].groups == [
        [0], [1, 4], [2, 5], [3], [6, 9], [7, 10], [8, 11], [12, 15], [13, 16], [14, 17], [18, 20], [19, 21],
    ]  # fmt: skip
    for level in levels:
        assert sorted(e for group in level.groups for e in group) == list(range(level.edges))


def test_an_edge_is_deaf_to_all_but_its_neighbours() -> None:
    level = pooling_levels(PARENTS)[0]
    conv = SkeletonConv(2, 3, level.neighbours, kernel=3)
    x = torch.randn(1, 22 * 2, 8)
    base = conv(x).reshape(22, 3, 8)
    for edge in range(22):
        touched = x.clone()
        touched[:, 2 * edge : 2 * edge + 2] += 1.0
        changed = (conv(touched).reshape(22, 3, 8) - base).abs().amax(dim=(1, 2)) > 1e-6
        assert [e for e in range(22) if edge in level.neighbours[e]] == np.flatnonzero(changed).tolist()


def test_training_never_wakes_a_masked_weight() -> None:
    conv = SkeletonConv(2, 2, pooling_levels(PARENTS)[0].neighbours, kernel=3)
    optimiser = torch.optim.Adam(conv.parameters(), lr=0.1, weight_decay=1e-4)
    for _ in range(3):
        conv(torch.randn(4, 44, 8)).square().sum().backward()
        optimiser.step()
    assert torch.all(conv.weight[conv.mask.expand_as(conv.weight) == 0] == 0)
    x = torch.randn(2, 44, 8)
    assert torch.equal(conv(x), conv.eval()(x))


def test_pooling_means_and_unpooling_copies() -> None:
    groups = [[0], [1, 2]]
    x = torch.arange(3 * 2 * 4, dtype=torch.float32).reshape(1, 6, 4)
    edges = x.reshape(3, 2, 4)
    pooled = SkeletonPool(groups)(x).reshape(2, 2, 4)
    assert torch.allclose(pooled[0], edges[0])
    assert torch.allclose(pooled[1], (edges[1] + edges[2]) / 2)
    back = SkeletonUnpool(groups)(SkeletonPool(groups)(x)).reshape(3, 2, 4)
    assert torch.equal(back[1], back[2])
    assert torch.equal(back[1], pooled[1])
