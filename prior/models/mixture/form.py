"""Layout and bounds of the network's output, shared by training and the live node."""

from __future__ import annotations

from steadypose.prior.models.mixture.bank import EXPERTS

OUTPUTS = 2 * EXPERTS + 4
"""Outputs of each joint: logits of the weights w, then b, the correction r (3), and the log standard deviation."""

GATES = 3
"""Gates of each joint, weights of the last frame's output: of w and b, of r, and of the deviation."""

REACH = 1.0
"""Bound of each b: how far the estimate may leave the experts' convex hull."""

CORRECTION = 2.0
"""Bound of the correction along an axis, in units of the estimated noise."""

COASTING = 0.1
"""m/s: least growth of a joint's standard deviation with the time to its nearest observation."""

MIN_LOG_SIGMA, MAX_LOG_SIGMA = -3.0, 6.0
"""Range of the natural logarithm of the standard deviation in millimetres."""
