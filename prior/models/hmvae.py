"""Live inference of HM-VAE: windows through the posterior's mean and the decoder.

The results equal those of `HMVAE.reconstruct`, at a fifth of the cost. For one body, reading weights from memory
dominates, so linear operations are folded once. Pooling and unpooling are folded into the convolutions. Taps that read
the same frame, because the window's ends are reflected, become one. All operations from a latent up to the next
activation become one product, which reads the latent's six numbers per edge. Features are (B, T, E * C).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from steadypose.prior.arrays import Floats32
from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.models.completer_features import rotations_of_6d
from steadypose.prior.models.layers import Dense, leaky_relu, mix_edges, pool_matrix, pooling_levels, unpool_matrix
from steadypose.prior.models.weights import Arrays, load_weights, part

ROTATION_FEATURES = 6  # number of features of a joint: the first two columns of its local rotation

CHANNELS = (ROTATION_FEATURES, 12, 24, 48, 96)
"""Channels of an edge, before the encoder's first block and after each block."""

DEVIATION = 0.1  # unit of a joint's deviations from its mean over a window: their typical size
NO_ROTATION = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)  # features of a joint that does not deviate from its mean
_NO_ROTATION = np.array(NO_ROTATION, dtype=np.float32)


@dataclass(frozen=True)
class HMVAEConfig:
    """Sizes of an HM-VAE."""

    window: int = 8  # T, frames of a window
    kernel: int = 3  # time steps of a convolution (official: 3 for T = 8, 15 for T = 64)
    strides: tuple[int, int, int, int] = (1, 2, 2, 1)
    """strides of the four encoder blocks (official: 1, 2, 2, 1 for T = 8; 2, 2, 2, 2 for T = 64)"""
    local_latent: int = 6  # dimensions of z_l per edge (official: 6; 12)
    global_latent: int = 6  # dimensions of z_g per edge (official: 6; 24)
    about_mean: bool = False
    """whether each joint's rotations are encoded and decoded in the frame of their observed mean over the window, which
    is also an input of the encoder. The paper encodes the rotations themselves, and its error is mostly constant over
    the window. Given the mean, only the motion within the window has to be encoded"""

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> HMVAEConfig:
        """Build the configuration from the JSON of a weights file."""
        return cls(**{**config, "strides": tuple(config["strides"])})

    @property
    def features(self) -> int:
        """Number of the encoder's features of a joint: its rotation, or its deviation from the mean and the mean."""
        return ROTATION_FEATURES * (2 if self.about_mean else 1)

    @property
    def steps(self) -> list[int]:
        """Frames before the encoder's first block and after each block.

        Raises:
            ValueError: the strides do not divide the window.
        """
        steps = [self.window]
        for stride in self.strides:
            if steps[-1] % stride:
                raise ValueError(f"a window of {self.window} frames cannot be strided by {self.strides}")
            steps.append(steps[-1] // stride)
        return steps


class LiveHMVAE:
    """Reconstruction by a trained `HMVAE`, whose weights are folded."""

    def __init__(self, config: HMVAEConfig, weights: Arrays) -> None:
        self.window, self._about_mean = config.window, config.about_mean
        steps, levels, none = config.steps, pooling_levels(PARENTS), np.zeros(1, dtype=np.float32)
        edges = [len(level.groups) for level in levels]
        self._encoder = []
        for k, level in enumerate(levels):
            conv, pool = part(weights, f"encoder.{k}.0"), pool_matrix(level.groups)
            weight = mix_edges(pool, conv["weight"])
            bias = mix_edges(pool, conv["bias"])
            self._encoder.append(_TemporalLinear(weight, bias, _stretch(steps[k], 1), config.strides[k]))
        self._local = _Latent(part(weights, "to_local.linear"), config.local_latent, CHANNELS[1])
        self._deep = _Latent(part(weights, "to_global.linear"), config.global_latent, CHANNELS[-1])
        decoder = []
        for k, level in enumerate(levels):
            conv = part(weights, f"decoder.{3 - k}.1")
            weight, stretch = (
                _unpooled(conv["weight"], unpool_matrix(level.groups)),
                _stretch(steps[k + 1], config.strides[k]),
            )
            decoder.append((weight, conv.get("bias", none), stretch))
        (last, last_bias, last_stretch), *_, first = decoder
        stream = last.reshape(len(last), edges[0], 2, -1, last.shape[-1])[:, :, 0]  # the stream's channels of each edge
        decoder[0] = stream.reshape(len(last), -1, last.shape[-1]), none, last_stretch  # the bias comes with z_l

        def from_deep(latent: Floats32) -> Floats32:
            return _TemporalLinear(*first)(_expanded(latent, part(weights, "from_global"), steps[4]))

        def from_local(latent: Floats32) -> Floats32:  # with a stream of zeros
            features = _expanded(latent, part(weights, "from_local"), steps[1])
            features = features.reshape(*features.shape[:2], edges[0], -1)
            joined = np.concatenate([np.zeros_like(features), features], axis=-1)
            return _TemporalLinear(last, last_bias, last_stretch)(joined.reshape(*features.shape[:2], -1))

        self._from_deep = _Affine(from_deep, edges[3], config.global_latent)
        self._from_local = _Affine(from_local, edges[0], config.local_latent)
        self._decoder = [_TemporalLinear(*decoder[k]) for k in (2, 1, 0)]

    @classmethod
    def load(cls, weights: str) -> LiveHMVAE:
        """Load the weights of this name; raises like `load_weights`."""
        arrays, config = load_weights(weights, "hmvae")
        return cls(HMVAEConfig.from_dict(config), arrays)

    def __call__(self, x: Floats32) -> Floats32:
        """Decode the posterior's mean of windows (B, T, 22, 6): equations 10 and 11."""
        first, *others = self._encoder
        inputs, mean = x, None
        if self._about_mean:
            mean = _mean_pose(x)
            deviation = (_columns(x, mean) - _NO_ROTATION) / np.float32(DEVIATION)
            inputs = np.concatenate([deviation, np.broadcast_to(_first_two(mean), x.shape)], axis=-1)
        features = leaky_relu(first(inputs.reshape(*x.shape[:2], -1)))
        local = self._from_local(self._local(features))
        for layer in others:
            features = leaky_relu(layer(features))
        features = self._from_deep(self._deep(features))
        for layer in self._decoder:
            features = layer(leaky_relu(features))
        decoded = (features + local).reshape(*x.shape[:2], -1, ROTATION_FEATURES)
        if mean is None:
            return decoded
        return _columns(decoded * np.float32(DEVIATION) + _NO_ROTATION, mean.swapaxes(-1, -2))


def _mean_pose(x: Floats32) -> Floats32:
    """(B, 1, 22, 3, 3) local rotations of the mean of bones' orientations in windows x (B, T, 22, 6)."""
    local = rotations_of_6d(x)
    orientations = local.copy()
    for joint, parent in enumerate(PARENTS[1:], start=1):
        orientations[:, :, joint] = orientations[:, :, parent] @ local[:, :, joint]
    mean = rotations_of_6d(_first_two(orientations).mean(axis=1, keepdims=True))
    local = mean.copy()
    local[:, :, 1:] = mean[:, :, list(PARENTS[1:])].swapaxes(-1, -2) @ mean[:, :, 1:]
    return local


def _first_two(rotations: Floats32) -> Floats32:
    """(..., 6): the first two columns of (..., 3, 3)."""
    return rotations[..., :2].swapaxes(-1, -2).reshape(*rotations.shape[:-2], ROTATION_FEATURES)


def _columns(x: Floats32, frame: Floats32) -> Floats32:
    """Express the two column vectors in x (..., 6) in these frames (..., 3, 3)."""
    return (x.reshape(*x.shape[:-1], 2, 3) @ frame).reshape(x.shape)


class _TemporalLinear:
    """A convolution (out, in, kernel) as two products, the first of which gathers the inputs of each output frame.

    ``stretch`` (T', T) is a preceding linear operation over time; its ends are reflected.
    """

    def __init__(self, weight: Floats32, bias: Floats32, stretch: Floats32, stride: int = 1) -> None:
        kernel = weight.shape[2]
        padded = np.pad(stretch, [((kernel - 1) // 2,) * 2, (0, 0)], mode="reflect")
        gathered = np.lib.stride_tricks.sliding_window_view(padded, kernel, axis=0)[::stride].swapaxes(1, 2)
        taps, tap_of = np.unique(gathered, axis=1, return_inverse=True)  # (T', kernel, T)
        merged = np.zeros((len(weight), taps.shape[1], weight.shape[1]), dtype=np.float32)
        for k, tap in enumerate(tap_of.ravel()):
            merged[:, tap] += weight[..., k]
        self._over_time = np.ascontiguousarray(taps.reshape(-1, taps.shape[-1]))
        self._dense = Dense(merged.reshape(len(merged), -1), bias)
        self._inputs, self._outputs = merged[0].size, len(merged)

    def __call__(self, x: Floats32) -> Floats32:
        """Map (B, T, in) to (B, T', out)."""
        windows = (self._over_time @ x).reshape(-1, self._inputs)
        return self._dense(windows).reshape(len(x), -1, self._outputs)


class _Latent:
    """Mean of a latent, edge by edge: (B, T, E * C) to (B, E * latent)."""

    def __init__(self, linear: Arrays, latent: int, channels: int) -> None:
        # the model's features are (C, T) within an edge, these are (T, C)
        weight = linear["weight"][:latent].reshape(latent, channels, -1).swapaxes(1, 2)
        self._channels, self._weight = channels, weight.reshape(latent, -1)
        self._bias = linear["bias"][:latent]

    def __call__(self, x: Floats32) -> Floats32:
        edges = x.reshape(*x.shape[:2], -1, self._channels).swapaxes(1, 2).reshape(-1, self._weight.shape[1])
        return (edges @ self._weight.T + self._bias).reshape(len(x), -1)


class _Affine:
    """An affine function of a latent, (B, E, latent) to (B, T, out), folded into one product."""

    def __init__(self, function: Callable[[Floats32], Floats32], edges: int, latent: int) -> None:
        size = edges * latent
        basis = np.eye(1 + size, size, k=-1, dtype=np.float32).reshape(-1, edges, latent)
        zero, *rows = function(basis)
        self._shape = zero.shape
        self._dense = Dense((np.stack(rows) - zero).reshape(size, -1).T, zero.ravel())

    def __call__(self, latent: Floats32) -> Floats32:
        return self._dense(latent).reshape(-1, *self._shape)


def _unpooled(weight: Floats32, unpool: Floats32) -> Floats32:
    """(out, pooled in, kernel) weight of a convolution, with the preceding unpooling folded in."""
    outputs, _, kernel = weight.shape
    edges = weight.reshape(outputs, len(unpool), -1, kernel)
    return np.einsum("oeck,eg->ogck", edges, unpool).reshape(outputs, -1, kernel)


def _expanded(latent: Floats32, linear: Arrays, steps: int) -> Floats32:
    """(B, T, E * C) features from a latent (B, E, d), edge by edge."""
    features = latent @ linear["weight"].T + linear["bias"]
    features = features.reshape(*latent.shape[:2], -1, steps)  # (C, T) within an edge
    return features.transpose(0, 3, 1, 2).reshape(len(latent), steps, -1)


def _stretch(steps: int, factor: int) -> Floats32:
    """(steps * factor, steps) matrix of linear interpolation over time, equal to `torch.nn.functional.interpolate`."""
    places = np.maximum((np.arange(steps * factor) + 0.5) / factor - 0.5, 0.0)
    return np.maximum(1.0 - np.abs(np.minimum(places, steps - 1)[:, None] - np.arange(steps)), 0.0).astype(np.float32)
