"""The network that tells what bears load and what rests, one pass a frame.

HuMoR's decoder tells of eight joints whether they are in contact, by a label that asks for both: to be low and slower
than 0.15 m/s. Against force plates that misses a third of a walker's stance, for a foot rolls over its heel and its
toe. Here each joint has two labels, load and rest (`prior.body.kinematics.label_contacts`), and a recurrent network of
its own reads joints as a tracker's noise leaves them, with how noisy they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.models.contacts import FEATURES

OUTPUTS = 2 * len(CONTACT_JOINTS)
"""Load, then rest, of each joint."""


@dataclass(frozen=True)
class ContactConfig:
    """Sizes.

    Attributes:
        hidden: numbers that the network remembers of a body.
    """

    hidden: int = 64

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> ContactConfig:
        """From the JSON of a weights file."""
        return cls(**config)


class ContactNet(nn.Module):
    """A gated recurrent unit (Cho et al. 2014) and a linear layer."""

    def __init__(self, config: ContactConfig) -> None:
        super().__init__()
        self.config = config
        self.unit = nn.GRU(FEATURES, config.hidden, batch_first=True)
        self.head = nn.Linear(config.hidden, OUTPUTS)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of load and of rest, (B, T, 8) each, of features (B, T, FEATURES) from a body's first frame on."""
        logits = self.head(self.unit(features)[0])
        load, rest = logits.chunk(2, dim=-1)
        return load, rest

    def step(self, features: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Logits (B, 8) of load and of rest of one frame's features (B, FEATURES), and the state (B, hidden) after it;
        before the first frame it is 0."""
        of_input, of_state, input_bias, state_bias = self.unit.all_weights[0]
        reset_in, update_in, new_in = F.linear(features, of_input, input_bias).chunk(3, dim=-1)
        reset_kept, update_kept, new_kept = F.linear(state, of_state, state_bias).chunk(3, dim=-1)
        reset, update = torch.sigmoid(reset_in + reset_kept), torch.sigmoid(update_in + update_kept)
        new = torch.tanh(new_in + reset * new_kept)
        state = new + update * (state - new)
        load, rest = self.head(state).chunk(2, dim=-1)
        return load, rest, state
