import pytest
import torch

from steadypose.benchmarks.baselines.window_vaes import CONFIGS, MVAE, TCNVAE, trained
from steadypose.benchmarks.motion import as_set, simulated_clips
from steadypose.prior.fit.hmvae_network import HMVAE, SkeletonConv
from steadypose.prior.fit.tensors import forward_kinematics


def in_use(model: torch.nn.Module) -> int:
    """Parameters that the masks let through."""
    masked = [m for m in model.modules() if isinstance(m, SkeletonConv)]
    dense = sum(m.weight.numel() for m in masked)
    return (
        sum(p.numel() for p in model.parameters()) - dense + sum(int(m.mask.sum()) * m.weight.shape[2] for m in masked)
    )


@pytest.mark.parametrize("frames", CONFIGS)
def test_peers_are_of_hm_vaes_size_in_latents_and_parameters(frames: int) -> None:
    reference = HMVAE(CONFIGS[frames])
    x = torch.randn(2, frames, 22, 6)
    latents = sum(z[0].numel() for z in reference.encode(x).sample())
    for kind in (MVAE, TCNVAE):
        model = kind(CONFIGS[frames])
        posterior = model.encode(x)
        local, deep = posterior.sample()
        assert local.numel() == 0
        assert posterior.kl()[0] == 0
        assert deep[0].numel() == pytest.approx(latents, rel=0.05)
        assert in_use(model) == pytest.approx(in_use(reference), rel=0.02)
        assert model.decode(local, deep).shape == x.shape


def test_joints_of_the_other_arm_reach_a_leg_in_the_skeletons_bottleneck_only() -> None:
    x = torch.randn(1, 8, 22, 6)
    moved = x.clone()
    moved[:, :, 21] += 1.0  # the right wrist
    for kind, everywhere in ((MVAE, False), (TCNVAE, True)):
        model = kind(CONFIGS[8]).eval()
        first = model.encoder[0][0] if kind is MVAE else model.encoder[0]  # type: ignore[index]
        changed = (first(x.flatten(2).transpose(1, 2)) != first(moved.flatten(2).transpose(1, 2))).any(dim=-1)[0]
        assert bool(changed.all()) == everywhere
        assert changed.any()


def test_clips_as_a_set_have_the_joints_that_they_had() -> None:
    clips = simulated_clips(frames=20, most=3, seed=0)
    motion = as_set(clips)
    assert motion.clip_start.tolist() == [0, 20, 40, 60]
    rows = motion.all_windows(20, step=1)
    assert len(rows) == 3
    joints = forward_kinematics(motion.rotations[rows[1]], motion.offsets[rows[1]])[0]
    root = motion.positions[rows[1]][:, :1]
    torch.testing.assert_close(joints + root, motion.positions[rows[1]], atol=1e-3, rtol=0)


def test_a_finished_training_is_not_repeated(tmp_path) -> None:
    motion = as_set(simulated_clips(frames=30, most=4, seed=0))
    first = trained("TCN-VAE", 8, motion, motion, tmp_path, steps=2)
    again = trained("TCN-VAE", 8, motion, motion, tmp_path, steps=2)
    for a, b in zip(first.parameters(), again.parameters(), strict=True):
        assert torch.equal(a, b)
    assert not again.training
