"""The networks of the prior as exported to ONNX: features included, with the outputs of the live forms."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from steadypose.prior.models.contacts.network import ContactNet
from steadypose.prior.models.hgvae.completion import certainty_of
from steadypose.prior.models.hgvae.config import SCALE
from steadypose.prior.models.hgvae.faults import FaultNet
from steadypose.prior.models.hgvae.network import HGVAE
from steadypose.prior.models.hmvae.network import HMVAE
from steadypose.prior.models.mixture.network import MixtureNet, answer, kept_of
from steadypose.prior.models.occlusion.network import OcclusionNet
from steadypose.prior.models.onnx.torch_features import (
    completion_features,
    contact_features,
    correction_features,
    fault_features,
    hang_unseen,
    trunk_frame,
)
from steadypose.prior.models.root_velocity.network import TrajectoryNet
from steadypose.prior.models.sensor_bias.network import CorrectionNet


class Occlusion(nn.Module):
    """`LiveOcclusion`'s network, of occluded joints in place of bodies: features (N, FEATURES) and which joint (N,), to
    the weights (N, 3) of its candidates and metres (N,) of deviation along an axis."""

    def __init__(self, network: OcclusionNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, features: Tensor, joint: Tensor) -> tuple[Tensor, Tensor]:
        weights, log_sigma = self.network(features, joint.long())
        return weights, 1e-3 * log_sigma.exp()


class Mixture(nn.Module):
    """A frame of `MixtureSmoother`: what its bank says of it, and the memory so far, to joints, deviations and memory.

    Bank: features (B, 22, FEATURES), experts (B, 22, EXPERTS, 3), heading (B, 2), scale (B,), gap and between (B, 22).
    Memory: own, own_weight (B, 22, own), body, body_weight (B, body), written (B, 22, OUTPUTS); zeros at first.
    """

    def __init__(self, network: MixtureNet) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, features: Tensor, experts: Tensor, heading: Tensor, scale: Tensor, gap: Tensor, between: Tensor,
        own: Tensor, own_weight: Tensor, body: Tensor, body_weight: Tensor, written: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        own_keep, body_keep = self.network.own_memory.decay.sigmoid(), self.network.body_memory.decay.sigmoid()
        own_weight, before = own_keep * own_weight + (1.0 - own_keep), body_weight[:, :1, None] > 0
        body_weight = body_keep * body_weight + (1.0 - body_keep)
        memory = [own, body]

        def remember(which: int, keep: Tensor, new: Tensor) -> Tensor:
            memory[which] = keep * memory[which] + (1.0 - keep) * new
            return memory[which]

        new, gates = self.network.layers(
            features,
            lambda values: remember(0, own_keep, values) / own_weight,
            lambda values: remember(1, body_keep, values) / body_weight,
        )
        kept = kept_of(gates, before)
        written = kept * written + (1.0 - kept) * new
        positions, variance = answer(written, experts, heading, scale, gap, between)
        return positions, 1e-3 * variance.sqrt(), memory[0], own_weight, memory[1], body_weight, written


class Refinement(nn.Module):
    """`LiveHMVAE`: windows (B, 8, 22, 6) of local rotations to the same, decoded."""

    def __init__(self, network: HMVAE) -> None:
        super().__init__()
        self.network = network

    def forward(self, rotations: Tensor) -> Tensor:
        return self.network.reconstruct(rotations)


class Reconstruction(nn.Module):
    """`LiveHGVAE.reconstruct`: tracks, confidence (B, 66, T) and bias_sigma (B,) to mean and sigma (B, 66, T)."""

    def __init__(self, network: HGVAE) -> None:
        super().__init__()
        self.network = network

    def forward(self, tracks: Tensor, confidence: Tensor, bias_sigma: Tensor) -> tuple[Tensor, Tensor]:
        origin, completion = self.network.mean[:, None], self.network.completion
        deviations = hang_unseen((tracks - origin) / SCALE)
        seen = confidence > 0
        certainty = seen.float()
        if completion is not None:
            features = completion_features(deviations, confidence, bias_sigma, completion.config.patch)
            correction, log_var = completion(*features)
            deviations = torch.where(seen, deviations, deviations + correction)
            certainty = certainty_of(confidence, log_var)
        found = self.network(deviations, certainty).tracks
        return found.mean * SCALE + origin, (0.5 * found.log_var).exp() * SCALE


class Faults(nn.Module):
    """`LiveFaultNet`: tracks, those of HG-VAE, and confidence (B, 66, T), sensor_sigma (B,) to odds (B, 22)."""

    def __init__(self, network: FaultNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, tracks: Tensor, mean: Tensor, sigma: Tensor, confidence: Tensor, sensor_sigma: Tensor) -> Tensor:
        return self.network(fault_features(tracks, mean, sigma, confidence, sensor_sigma, self.network.mean))


class RootMotion(nn.Module):
    """`LiveRootVelocity`: joints (B, context, 22, 3) to the newest frame's velocity, log_sigma, contact_logits."""

    def __init__(self, network: TrajectoryNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        velocity, log_sigma, contact_logits = (part[:, -1] for part in self.network(joints))
        return velocity, log_sigma, contact_logits


class Contacts(nn.Module):
    """`LiveContacts` on `contact_features`: the arguments of these and state (B, hidden) to load and rest (B, 8), which
    are probabilities, and the state after the frame."""

    def __init__(self, network: ContactNet) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, positions: Tensor, before: Tensor, dt: Tensor, yaw: Tensor, sigma: Tensor, root_seen: Tensor,
        ground: Tensor, state: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        features = contact_features(positions, before, dt, yaw, sigma, root_seen, ground)
        load, rest, state = self.network.step(features, state)
        return load.sigmoid(), rest.sigmoid(), state


class Correction(nn.Module):
    """`LiveCorrection`, turned into the world: history (B, H, 22, 3), camera (B, 3) to correction (B, 22, 3)."""

    def __init__(self, network: CorrectionNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, history: Tensor, camera: Tensor) -> Tensor:
        frame = trunk_frame(history[:, 0])
        return self.network(correction_features(history, camera, frame)) @ frame.transpose(1, 2)
