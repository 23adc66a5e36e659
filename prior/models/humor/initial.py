"""The mixture of Gaussians that says how likely a state is to begin with (HuMoR, section 3; 12 components)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from steadypose.prior.models.humor.network import HumorNet
from steadypose.prior.models.humor.state import pose_features

MIN_VARIANCE = 1e-3
"""Of standardised features: added to each, as the joints of a body on bones are fewer than their coordinates."""

_ITERATIONS = 100


def fit_initial(model: HumorNet, inputs: Tensor, seed: int) -> None:
    """Fit the model's mixture by expectation-maximisation.

    Args:
        model: whose buffers are filled.
        inputs: (N, `FEATURES`) standardised features of states in their canonical frames.
        seed: of the initial responsibilities.
    """
    from sklearn.mixture import GaussianMixture  # of the extra `train`, and slow to import

    mixture = GaussianMixture(
        model.config.components, reg_covar=MIN_VARIANCE, max_iter=_ITERATIONS, random_state=seed
    ).fit(pose_features(inputs).double().numpy())
    model.mixture_log_weights.copy_(torch.from_numpy(np.log(np.asarray(mixture.weights_))))
    model.mixture_means.copy_(torch.from_numpy(mixture.means_))
    model.mixture_precisions.copy_(torch.from_numpy(mixture.precisions_cholesky_))


def initial_log_density(model: HumorNet, inputs: Tensor) -> Tensor:
    """(...) log density, nats, of standardised features (..., `FEATURES`) of states in their canonical frames."""
    known = pose_features(inputs)
    factors = model.mixture_precisions
    off = ((known.reshape(-1, known.shape[-1]) - model.mixture_means.unsqueeze(1)) @ factors).square().sum(dim=-1)
    log_root = factors.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1)
    width = known.shape[-1]
    each = (model.mixture_log_weights + log_root - 0.5 * width * math.log(math.tau)).unsqueeze(1) - 0.5 * off
    return torch.logsumexp(each, dim=0).reshape(inputs.shape[:-1])
