"""HM-VAE as the live node runs it: windows through the posterior's mean and the decoder, nothing else.

The same numbers as `HMVAE.reconstruct`, at a fifth of the cost. For one body it is the weights' way from memory that
takes the time, so all that is linear is folded once: pooling and unpooling into the convolutions; taps that see the
same frames, the window's ends being reflected, into one; and what follows a latent up to the next activation into one
product, which reads the latent's six numbers an edge instead of the features made of them. Features are (B, T, E * C).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.models.hmvae.network import HMVAE, ROTATION_FEATURES, SLOPE
from steadypose.prior.models.layers.skeleton_conv import SkeletonConv, SkeletonPool, SkeletonUnpool

Floats = NDArray[np.float32]

FEW_ROWS = 2
"""Products of so few take half the time without a BLAS, which copies the weights first."""


class LiveHMVAE:
    """A trained `HMVAE`'s reconstruction.

    Args:
        model: whose weights are folded; later changes to it are not seen here.
    """

    @torch.no_grad()
    def __init__(self, model: HMVAE) -> None:
        config, steps, edges = model.config, model.steps, [len(level.groups) for level in model.levels]
        self._encoder = []
        for k, block in enumerate(model.encoder):
            conv, pool = block  # type: ignore[misc]  (a ModuleList of two)
            bias = pool(conv.bias[None, :, None])[0, :, 0]
            self._encoder.append(_TemporalLinear(_pooled(conv, pool), bias, torch.eye(steps[k]), conv))
        self._local = _Latent(model.to_local.linear, config.local_latent, model.CHANNELS[1])
        self._deep = _Latent(model.to_global.linear, config.global_latent, model.CHANNELS[-1])

        def from_deep(latent: Tensor) -> Tensor:
            return _block(model, 3, model.from_global(latent).reshape(len(latent), -1, steps[4]))

        def from_local(latent: Tensor) -> Tensor:  # beside a stream of zeros
            features = model.from_local(latent).reshape(len(latent), edges[0], -1, steps[1])
            joined = torch.cat([torch.zeros_like(features), features], dim=2).flatten(1, 2)
            return _block(model, 0, joined)

        self._from_deep = _Affine(from_deep, edges[3], config.global_latent)
        self._from_local = _Affine(from_local, edges[0], config.local_latent)
        self._decoder = []
        for k, block in zip((2, 1, 0), list(model.decoder)[1:], strict=True):
            unpool, conv = block  # type: ignore[misc]
            weight, bias = _unpooled(unpool, conv), conv.bias
            if k == 0:  # of each edge, the stream's channels; the bias is in the local latent's part
                weight = weight.unflatten(1, (edges[0], 2, -1))[:, :, 0].flatten(1, 2)
                bias = None
            self._decoder.append(_TemporalLinear(weight, bias, _stretch(steps[k + 1], config.strides[k]), conv))

    def __call__(self, x: Floats) -> Floats:
        """Decode the posterior's mean of windows (B, T, 22, 6): equations 10 and 11."""
        first, *others = self._encoder
        features = _leaky(first(x.reshape(*x.shape[:2], -1)))
        local = self._from_local(self._local(features))
        for layer in others:
            features = _leaky(layer(features))
        features = self._from_deep(self._deep(features))
        for layer in self._decoder:
            features = layer(_leaky(features))
        return (features + local).reshape(*x.shape[:2], -1, ROTATION_FEATURES)


class _TemporalLinear:
    """A convolution as two products: ``over_time`` (T' * taps, T) gathers each output frame's inputs."""

    def __init__(self, weight: Tensor, bias: Tensor | None, stretch: Tensor, conv: SkeletonConv) -> None:
        kernel = weight.shape[2]
        padded = F.pad(stretch.T[None], conv.pad, mode="reflect")[0].T
        gathered = padded.unfold(0, kernel, conv.stride).transpose(1, 2)  # (T', kernel, T)
        taps, tap_of = torch.unique(gathered, dim=1, return_inverse=True)
        merged = weight.new_zeros(len(weight), taps.shape[1], weight.shape[1])
        merged.index_add_(1, tap_of, weight.transpose(1, 2))
        self._over_time = np.ascontiguousarray(taps.flatten(0, 1).numpy())
        self._weight = np.ascontiguousarray(merged.flatten(1).numpy())
        self._bias = np.zeros(1, dtype=np.float32) if bias is None else bias.detach().numpy().copy()

    def __call__(self, x: Floats) -> Floats:
        """(B, T, in) to (B, T', out)."""
        windows = (self._over_time @ x).reshape(-1, self._weight.shape[1])
        return _product(windows, self._weight, self._bias).reshape(len(x), -1, len(self._weight))


class _Latent:
    """A latent's mean, edge by edge: (B, T, E * C) to (B, E * latent)."""

    def __init__(self, linear: nn.Linear, latent: int, channels: int) -> None:
        # The model's features are (C, T) within an edge, these are (T, C).
        weight = linear.weight[:latent].reshape(latent, channels, -1).transpose(1, 2).flatten(1)
        self._channels, self._weight = channels, weight.detach().numpy().copy()
        self._bias = linear.bias[:latent].detach().numpy().copy()

    def __call__(self, x: Floats) -> Floats:
        edges = x.reshape(*x.shape[:2], -1, self._channels).swapaxes(1, 2).reshape(-1, self._weight.shape[1])
        return (edges @ self._weight.T + self._bias).reshape(len(x), -1)


class _Affine:
    """What torch makes of a latent, as one product: (B, E * latent) to (B, T, out).

    Args:
        function: affine, (B, E, latent) to (B, out, T).
    """

    def __init__(self, function: Callable[[Tensor], Tensor], edges: int, latent: int) -> None:
        size = edges * latent
        basis = torch.cat([torch.zeros(1, size), torch.eye(size)]).unflatten(1, (edges, latent))
        zero, *rows = function(basis).transpose(1, 2)
        self._shape = tuple(zero.shape)
        self._weight = (torch.stack(rows) - zero).flatten(1).T.contiguous().numpy()
        self._bias = zero.flatten().numpy()

    def __call__(self, latent: Floats) -> Floats:
        return _product(latent, self._weight, self._bias).reshape(-1, *self._shape)


def _product(x: Floats, weight: Floats, bias: Floats) -> Floats:
    """``x @ weight.T + bias``: (N, in) to (N, out)."""
    if len(x) > FEW_ROWS:
        return np.ascontiguousarray((weight @ x.T).T) + bias
    out = np.empty((len(x), len(weight)), dtype=np.float32)
    _few_rows(np.ascontiguousarray(x), weight, out)
    return out + bias


@njit("(f4[:,::1], f4[:,::1], f4[:,::1])", cache=True, fastmath=True)
def _few_rows(x, weight, out):
    """Writes ``x @ weight.T``: (N, in) and (M, in) to (N, M)."""
    for j in range(len(weight)):
        for i in range(len(x)):
            total = np.float32(0)
            for k in range(x.shape[1]):
                total += x[i, k] * weight[j, k]
            out[i, j] = total


def _leaky(x: Floats) -> Floats:
    return np.maximum(x, np.float32(SLOPE) * x)


def _block(model: HMVAE, level: int, features: Tensor) -> Tensor:
    """A block of the decoder without its activation: features (B, E * C, T) of this level to those of the one below."""
    unpool, conv = model.decoder[3 - level]  # type: ignore[misc]
    stride = model.config.strides[level]
    if stride > 1:
        features = F.interpolate(features, scale_factor=stride, mode="linear")
    return conv(unpool(features))


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
