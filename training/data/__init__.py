"""Motion capture in: readers of BVH, ASF/AMC and .npz archives, and what turns them into training data.

Each reader yields `Clip`s: canonical joints in metres, z up, at the recording's own rate. `prepare` resamples them,
estimates the floor, checks, labels and splits them.
"""
