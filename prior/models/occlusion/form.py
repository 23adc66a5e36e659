"""Range of the network's output, for training and the live node."""

MIN_LOG_SIGMA, MAX_LOG_SIGMA = -3.0, 7.0
"""Range of the logarithm of the standard deviation, in units of a millimetre."""
