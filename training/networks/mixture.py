"""The network of the mixture: predicts weights of a bank of filters for every joint, from features of the whole body.

It is a mixture of experts (Jacobs et al. 1991) over linear filters. A layer shared by all joints encodes each joint's
features, a second layer encodes the whole body's, and each joint's output is computed from both. The estimate is

    sum of w_m x_m  +  (1 - w_raw) (sum of b_m x_m + scale r),   w >= 0, sum of w = 1, sum of b = 0, b and r bounded

where ``x`` are the experts' positions. The second term extrapolates beyond filters that lag, and corrects a joint from
the context of the whole body. It is bounded by the estimated noise ``scale``, and vanishes where the raw joint has all
the weight, so that a noise-free input stays unchanged. As far as the noise is white, the estimate is moved towards the
multiple-model estimate (`prior.models.mixture.whiteness`).

The network computes gates that smooth its outputs over time (as in gated recurrent units, Cho et al. 2014), because
fluctuating weights would add noise.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.models.mixture.bank import EXPERTS, MULTIPLE_MODEL, RAW
from steadypose.prior.models.mixture.features import (
    COASTING,
    CORRECTION,
    FEATURES,
    GATES,
    MAX_LOG_SIGMA,
    MIN_LOG_SIGMA,
    OUTPUTS,
    REACH,
)
from steadypose.prior.timing.rate import FPS

JOINTS = 22

FIRST_GATE = -4.0  # initial bias of the gates, which gives almost no weight to the previous output


@dataclass(frozen=True)
class MixtureConfig:
    own: int = 32  # number of features of each joint
    body: int = 384  # number of features of the whole body
    told: int = 24  # number of the body's features passed to each joint
    head: int = 64  # width of the layers that compute a joint's output


class Memory(nn.Module):
    """Running means of features with learned time constants: a stable, diagonal linear recurrence.

    They are normalised from the first frame on, so the initial state has no weight.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        frames = torch.logspace(0.2, 1.7, features)[torch.randperm(features)]
        self.decay = nn.Parameter(torch.logit(1.0 - 1.0 / frames))

    def forward(self, values: Tensor, present: Tensor) -> Tensor:
        """Return means (C, T, ..., F) of values up to each frame, without frames that are not ``present`` (C, T)."""
        inner = (1,) * (values.ndim - 3)
        kept = torch.where(present[..., None], torch.sigmoid(self.decay), 1.0)
        kept = kept.reshape(*present.shape, *inner, -1)
        total = _faded(kept, (1.0 - kept) * values)
        return total / _faded(kept, 1.0 - kept).clamp(min=1e-6)


def _faded(kept: Tensor, added: Tensor) -> Tensor:
    """Compute the recurrence y[t] = kept[t] y[t - 1] + added[t] over (C, T, ...), with y[-1] = 0."""
    total, out = torch.zeros_like(added[:, 0]), []
    for keep, new in zip(kept.unbind(1), added.unbind(1), strict=True):
        total = torch.addcmul(new, keep, total)
        out.append(total)
    return torch.stack(out, dim=1)


class MixtureNet(nn.Module):
    """Maps features of a body's joints, frame by frame, to weights, corrections and standard deviations."""

    def __init__(self, config: MixtureConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("deviation", torch.ones(FEATURES))
        self.read = nn.Linear(FEATURES, config.own)
        self.joint = nn.Parameter(torch.zeros(JOINTS, config.own))
        self.own_memory = Memory(config.own)
        self.gather = nn.Linear(JOINTS * config.own, config.body)
        self.body_memory = Memory(config.body)
        self.remember = nn.Linear(config.body, config.body)
        self.think = nn.Linear(config.body, config.body)
        self.tell = nn.Linear(config.body, JOINTS * config.told)
        self.mix = nn.Linear(FEATURES + config.own + config.told, config.head)
        self.joint_mix = nn.Parameter(torch.zeros(JOINTS, config.head))
        self.deepen = nn.Linear(config.head, config.head)
        self.write = nn.Linear(config.head, OUTPUTS + GATES)
        with torch.no_grad():
            self.write.weight.mul_(0.1)
            self.write.bias[OUTPUTS:] = FIRST_GATE

    mean: Tensor
    deviation: Tensor

    def forward(self, features: Tensor, present: Tensor) -> Tensor:
        """Return outputs (C, T, 22, OUTPUTS) from features (C, T, 22, FEATURES) of whole clips.

        ``present`` (C, T) is whether there is a body.
        """
        normalised = (features - self.mean) / self.deviation
        own = F.relu(self.read(normalised) + self.joint)
        before = self.own_memory(own, present)
        body = F.relu(self.gather(own.flatten(-2)))
        body = body + F.relu(self.remember(self.body_memory(body, present)))
        body = body + F.relu(self.think(body))
        context = self.tell(body).unflatten(-1, (JOINTS, self.config.told))
        mixed = F.relu(self.mix(torch.cat([normalised, before, context], dim=-1)) + self.joint_mix)
        written, gates = self.write(mixed + F.relu(self.deepen(mixed))).split([OUTPUTS, GATES], dim=-1)
        continued = F.pad(present[:, :-1], (1, 0))[..., None, None]
        kept = torch.where(continued, torch.sigmoid(gates), 0.0)
        kept = kept.repeat_interleave(torch.tensor([2 * EXPERTS, 3, 1]), dim=-1)
        return _faded(kept, (1.0 - kept) * written)


def estimate(
    outputs: Tensor, experts: Tensor, heading: Tensor, scale: Tensor, gap: Tensor, between: Tensor, fallback: Tensor
) -> tuple[Tensor, Tensor]:
    """Return positions (..., 22, 3) metres, and their variances along an axis (..., 22) mm².

    In a gap between two observations, the multiple-model estimate is used.

    Args:
        outputs: (..., 22, OUTPUTS) outputs of the network.
        experts: (..., 22, EXPERTS, 3) metres; this and the following are written by `features.describe`.
        heading: (..., 2) cosine and sine of the body's heading.
        scale: (...) metres along an axis, estimated noise.
        gap: (..., 22) frames to the nearest observation of each joint.
        between: (..., 22) metres along an axis, deviation of the multiple-model estimate in gaps between two
            observations; otherwise 0.
        fallback: (...) share of the multiple-model estimate in the part that is not the raw joint's
            (`whiteness.fallback`).
    """
    logits, reach, correction, log_sigma = outputs.split([EXPERTS, EXPERTS, 3, 1], dim=-1)
    weights = logits.softmax(dim=-1)
    free = 1.0 - weights[..., RAW:]
    reach = REACH * torch.tanh(reach)
    reach = reach - reach.mean(dim=-1, keepdim=True)
    weights = weights + free * reach
    moved = CORRECTION * torch.tanh(correction / CORRECTION) * free * scale[..., None, None]
    cos, sin = heading[..., None, 0], heading[..., None, 1]
    moved = torch.stack(
        [cos * moved[..., 0] - sin * moved[..., 1], sin * moved[..., 0] + cos * moved[..., 1], moved[..., 2]], dim=-1
    )
    # relative to the raw joint, so that rounding does not move it
    came = experts[..., RAW, :]
    places = came + (weights[..., None] * (experts - came[..., None, :])).sum(dim=-2) + moved
    places = places + fallback[..., None, None] * free * (experts[..., MULTIPLE_MODEL, :] - places)
    coasted = 1e3 * COASTING / FPS * gap
    variance = (2.0 * log_sigma[..., 0].clamp(MIN_LOG_SIGMA, MAX_LOG_SIGMA)).exp() + coasted.square()
    inside = between > 0.0
    return (
        torch.where(inside[..., None], experts[..., MULTIPLE_MODEL, :], places),
        torch.where(inside, (1e3 * between).square(), variance),
    )
