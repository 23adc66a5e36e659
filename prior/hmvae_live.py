"""HM-VAE as the live node runs it: windows through the posterior's mean and the decoder, nothing else.

The same numbers as `HMVAE.reconstruct`, at half the cost. Pooling and unpooling, padding, stride and interpolation are
linear: those over the skeleton are folded into the weights, those over time into one small matrix a layer. Features
are (B, T, E * C).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from prior.hmvae import HMVAE, ROTATION_FEATURES, SLOPE
from prior.skeleton_conv import SkeletonConv, SkeletonPool, SkeletonUnpool


class LiveHMVAE(nn.Module):
    """A trained `HMVAE`'s reconstruction.

    Args:
        model: whose weights are folded; later changes to it are not seen here.
    """

    def __init__(self, model: HMVAE) -> None:
        super().__init__()
        config, steps = model.config, model.steps
        self.encoder = nn.ModuleList()
        self.decoder = nn.ModuleList()
        for k, block in enumerate(model.encoder):
            conv, pool = block  # type: ignore[misc]  (a ModuleList of two)
            self.encoder.append(_TemporalLinear(_pooled(conv, pool), conv.bias, torch.eye(steps[k]), conv, pool))
        for k, block in zip(reversed(range(len(self.encoder))), model.decoder, strict=True):
            unpool, conv = block  # type: ignore[misc]
            stretch = _stretch(steps[k + 1], config.strides[k])
            self.decoder.append(_TemporalLinear(_unpooled(unpool, conv), conv.bias, stretch, conv, None))
        self.local = _EdgeCode(model.to_local.linear, model.from_local, model.CHANNELS[1])
        self.deep = _EdgeCode(model.to_global.linear, model.from_global, model.CHANNELS[-1])

    @torch.inference_mode()
    def forward(self, x: Tensor) -> Tensor:
        """Decode the posterior's mean of windows (B, T, 22, 6): equations 10 and 11."""
        first, *others = self.encoder
        features = F.leaky_relu(first(x.flatten(2)), SLOPE)
        local = self.local(features)
        for layer in others:
            features = F.leaky_relu(layer(features), SLOPE)
        features = self.deep(features).flatten(2)
        *others, last = self.decoder
        for layer in others:
            features = F.leaky_relu(layer(features), SLOPE)
        joined = torch.cat([features.reshape(local.shape), local], dim=-1).flatten(2)
        return last(joined).reshape(*x.shape[:2], -1, ROTATION_FEATURES)


class _TemporalLinear(nn.Module):
    """A convolution as two products: ``over_time`` (T' * kernel, T) gathers each output frame's inputs."""

    def __init__(
        self, weight: Tensor, bias: Tensor | None, stretch: Tensor, conv: SkeletonConv, pool: SkeletonPool | None
    ) -> None:
        super().__init__()
        kernel = weight.shape[2]
        padded = F.pad(stretch.T[None], conv.pad, mode="reflect")[0].T
        self.register_buffer("over_time", padded.unfold(0, kernel, conv.stride).transpose(1, 2).flatten(0, 1))
        self.register_buffer("weight", weight.transpose(1, 2).flatten(1).contiguous())
        if bias is not None and pool is not None:
            bias = pool(bias[None, :, None])[0, :, 0]
        self.register_buffer("bias", None if bias is None else bias.detach().clone())

    over_time: Tensor
    weight: Tensor
    bias: Tensor | None

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, in) to (B, T', out)."""
        windows = (self.over_time @ x).reshape(len(x), -1, self.weight.shape[1])
        return F.linear(windows, self.weight, self.bias)


class _EdgeCode(nn.Module):
    """A latent's mean and what the decoder reads from it: (B, T, E * C) to (B, T, E, C)."""

    def __init__(self, to_latent: nn.Linear, from_latent: nn.Linear, channels: int) -> None:
        super().__init__()
        latent = from_latent.in_features
        time = to_latent.in_features // channels
        self.channels, self.time = channels, time
        # The model's features are (C, T) within an edge, these are (T, C).
        inwards = to_latent.weight[:latent].reshape(latent, channels, time).transpose(1, 2).flatten(1)
        outwards = from_latent.weight.reshape(channels, time, latent).transpose(0, 1).flatten(0, 1)
        shift = from_latent.bias.reshape(channels, time).T.flatten()
        self.register_buffer("inwards", inwards.detach().contiguous())
        self.register_buffer("mean", to_latent.bias[:latent].detach().clone())
        self.register_buffer("outwards", outwards.detach().contiguous())
        self.register_buffer("shift", shift.detach().contiguous())

    inwards: Tensor
    mean: Tensor
    outwards: Tensor
    shift: Tensor

    def forward(self, x: Tensor) -> Tensor:
        edges = x.reshape(len(x), self.time, -1, self.channels).transpose(1, 2).flatten(2)
        latent = F.linear(edges, self.inwards, self.mean)
        decoded = F.linear(latent, self.outwards, self.shift)
        return decoded.reshape(len(x), -1, self.time, self.channels).transpose(1, 2)


@torch.no_grad()
def _pooled(conv: SkeletonConv, pool: SkeletonPool) -> Tensor:
    """(pooled out, in, kernel): the convolution's weight with the pooling after it."""
    outputs, inputs, kernel = conv.weight.shape
    return pool(conv.weight.reshape(1, outputs, inputs * kernel)).reshape(-1, inputs, kernel)


@torch.no_grad()
def _unpooled(unpool: SkeletonUnpool, conv: SkeletonConv) -> Tensor:
    """(out, pooled in, kernel): the convolution's weight with the unpooling before it."""
    outputs, inputs, kernel = conv.weight.shape
    edges = conv.weight.reshape(outputs, len(unpool.mix), inputs // len(unpool.mix), kernel)
    return torch.einsum("oeck,eg->ogck", edges, unpool.mix).reshape(outputs, -1, kernel)


def _stretch(steps: int, factor: int) -> Tensor:
    """(steps * factor, steps): linear interpolation over time, as `torch.nn.functional.interpolate` does it."""
    if factor == 1:
        return torch.eye(steps)
    return F.interpolate(torch.eye(steps)[None], scale_factor=factor, mode="linear")[0].T
