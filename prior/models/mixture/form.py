"""What the network writes of a joint, and how it is read: training and the live node share these."""

from __future__ import annotations

from steadypose.prior.models.mixture.bank import EXPERTS

OUTPUTS = 2 * EXPERTS + 4
"""Of each joint: logarithms of weights, reaches, correction, logarithm of the standard deviation."""

GATES = 3
"""Of each joint: how far weights and reaches, the correction, and the deviation lean on the last frame's."""

REACH = 1.0
"""Weight by which the mixture may leave the experts' convex hull, at most, of each expert."""

CORRECTION = 2.0
"""Largest correction along an axis, in units of the noise found."""

COASTING = 0.1
"""m/s: by how much a joint's standard deviation grows at least with the time to its nearest sighting."""

MIN_LOG_SIGMA, MAX_LOG_SIGMA = -3.0, 6.0
"""Range of the logarithm of the standard deviation, in units of a millimetre."""
