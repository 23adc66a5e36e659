"""The peers of HM-VAE's table 3: a VAE without its hierarchy, and one without its skeleton, trained as it is trained.

Li et al. 2021, section 5.2, name them and say no more. Here both have as many latent dimensions as HM-VAE's two
levels together, so that what differs is where these sit, and its kernels and strides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.fit.hmvae_network import HMVAE, EdgeLinear, MotionVAE, Posterior, SkeletonConv
from steadypose.prior.models.hmvae import CHANNELS, ROTATION_FEATURES, HMVAEConfig
from steadypose.prior.models.layers import SLOPE
from steadypose.training.data.dataset import MotionSet
from steadypose.training.recipes.hmvae import STRIDES, Hyperparameters, recipe_of

CONFIGS: Mapping[int, HMVAEConfig] = {
    8: HMVAEConfig(),
    64: HMVAEConfig(window=64, kernel=15, strides=(2, 2, 2, 2), local_latent=12, global_latent=24),
}
"""HM-VAE's two window lengths, by frames (its official configurations)."""


def _latents(model: HMVAE) -> tuple[int, int]:
    """Edges at HM-VAE's deepest level, and latent dimensions for each that hold as many as its two levels do."""
    local, deep = len(model.levels[0].groups), len(model.levels[3].groups)
    config = model.config
    return deep, round((local * config.local_latent + deep * config.global_latent) / deep)


class MVAE(HMVAE):
    """M-VAE: HM-VAE without the local latent; all dimensions are in the global one."""

    def __init__(self, config: HMVAEConfig) -> None:
        super().__init__(config)
        _, size = _latents(self)
        channels, last = CHANNELS, self.steps[4]
        del self.to_local, self.from_local
        self.to_global = EdgeLinear(channels[4], last, 2 * size)
        self.from_global = nn.Linear(size, channels[4] * last)
        self.decoder[3][1] = SkeletonConv(channels[1], channels[0], self.levels[0].neighbours, config.kernel)  # type: ignore[index]

    def encode(self, x: Tensor) -> Posterior:
        """The posterior; z_l has no dimensions."""
        features = x.flatten(2).transpose(1, 2)
        for block in self.encoder:
            conv, pool = block  # type: ignore[misc]
            features = F.leaky_relu(pool(conv(features)), SLOPE)
        return _only_global(*self.to_global(features).chunk(2, dim=-1))

    def decode(self, local: Tensor, deep: Tensor) -> Tensor:
        """Windows (B, T, 22, 6) of z_g alone."""
        features = self.from_global(deep).reshape(deep.shape[0], -1, self.steps[4])
        for k, block in zip(reversed(range(4)), self.decoder, strict=True):
            unpool, conv = block  # type: ignore[misc]
            features = _stretched(features, self.config.strides[k])
            features = conv(unpool(features))
            if k > 0:
                features = F.leaky_relu(features, SLOPE)
        return features.transpose(1, 2).unflatten(2, (-1, ROTATION_FEATURES))


class TCNVAE(MotionVAE):
    """TCN-VAE: four temporal convolutions over all joints at once and back; no bones.

    So wide that it has as many parameters as HM-VAE has in use, within a hundredth.
    """

    WIDTH = 288

    def __init__(self, config: HMVAEConfig) -> None:
        super().__init__(config.window)
        reference = HMVAE(config)
        self.groups, size = _latents(reference)
        self.strides, self.last = config.strides, reference.steps[4]
        joints = len(reference.levels[0].neighbours)
        channels = [ROTATION_FEATURES * joints, *[self.WIDTH] * 4]

        def convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Conv1d:
            return nn.Conv1d(inputs, outputs, config.kernel, stride, padding=config.kernel // 2, padding_mode="reflect")

        self.encoder = nn.ModuleList(convolution(channels[k], channels[k + 1], config.strides[k]) for k in range(4))
        self.to_latent = nn.Linear(self.WIDTH * self.last, 2 * self.groups * size)
        self.from_latent = nn.Linear(self.groups * size, self.WIDTH * self.last)
        self.decoder = nn.ModuleList(convolution(channels[k + 1], channels[k]) for k in reversed(range(4)))

    def encode(self, x: Tensor) -> Posterior:
        """The posterior; in as many groups as HM-VAE has edges, for KL to weigh a dimension as much."""
        features = x.flatten(2).transpose(1, 2)
        for convolution in self.encoder:
            features = F.leaky_relu(convolution(features), SLOPE)
        latent = self.to_latent(features.flatten(1)).unflatten(1, (self.groups, -1))
        mean, log_var = latent.chunk(2, dim=-1)
        return _only_global(mean, log_var.clamp(max=MAX_LOG_VAR))

    def decode(self, local: Tensor, deep: Tensor) -> Tensor:
        """Windows (B, T, 22, 6) of z (B, groups, d)."""
        features = self.from_latent(deep.flatten(1)).unflatten(1, (self.WIDTH, self.last))
        for k, convolution in zip(reversed(range(4)), self.decoder, strict=True):
            features = convolution(_stretched(features, self.strides[k]))
            if k > 0:
                features = F.leaky_relu(features, SLOPE)
        return features.transpose(1, 2).unflatten(2, (-1, ROTATION_FEATURES))


def _only_global(mean: Tensor, log_var: Tensor) -> Posterior:
    nothing = mean[..., :0]
    return Posterior(nothing, nothing, mean, log_var)


def _stretched(features: Tensor, factor: int) -> Tensor:
    return features if factor == 1 else F.interpolate(features, scale_factor=factor, mode="linear")


MODELS: Mapping[str, Callable[[HMVAEConfig], MotionVAE]] = {"TCN-VAE": TCNVAE, "M-VAE": MVAE, "HM-VAE": HMVAE}
"""In the order of the paper's table."""

STEPS: Mapping[int, int] = {8: 2000, 64: 800}
"""Of training, by frames: at most five minutes a model on one core, a small part of what HM-VAE as shipped has had."""

FRAMES_A_STEP = 512
"""64 windows of 8 frames, or the official 8 of 64."""

MAX_LOG_VAR = 4.0
"""Of a TCN-VAE's posterior: unbounded, that of 64 frames bursts after 165 steps, and is not a number from 200 on."""

_STRIDES = {8: STRIDES, 64: (1,)}  # as official, windows of 64 frames keep the frame rate
_LEARNING_RATE = 1e-3


def trained(name: str, frames: int, train: MotionSet, val: MotionSet, runs: Path, steps: int) -> MotionVAE:
    """A model of `MODELS` for windows of so many frames, trained, or taken from an earlier training.

    Args:
        name: which.
        frames: of a window.
        train: what it learns.
        val: what its curves are drawn from.
        runs: folder for checkpoints of this data; a training killed there resumes, one finished there is not repeated.
        steps: of training.
    """
    directory = runs / f"{name.lower()}-{frames}-{steps}"
    hyperparameters = Hyperparameters(steps, FRAMES_A_STEP // frames, _LEARNING_RATE, _STRIDES[frames])
    recipe = recipe_of(name, lambda: MODELS[name](CONFIGS[frames]), train, val, hyperparameters)
    torch.manual_seed(0)
    model = recipe.network()
    recipe.minimise(model, directory, steps, seed=0)
    return model
