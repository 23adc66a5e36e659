"""The Gaussian mixture of initial states (HuMoR, section 3; 12 components)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from steadypose.prior.fit.humor_network import HumorNet
from steadypose.prior.fit.humor_state import pose_features

MIN_VARIANCE = 1e-3
"""Added to the variance of each standardised feature: joints on rigid bones have fewer degrees of freedom than
coordinates."""

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
