"""Whether there is motion enough to train on, before the training starts."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from steadypose.nodes.graph.settings import LaunchError

RATE_HZ = 30.0
LEAST_MIN, ENOUGH_MIN = 0.5, 30.0
"""minutes of motion: below the one no batch is like another, below the other a model knows these movements alone"""


def little_data(path: Path, weights: str) -> str:
    """What to say of prepared motion that is little; empty if it is enough, or no prepared motion.

    Args:
        path: what `steadypose prepare` wrote, or what a model is trained on instead.
        weights: ``default`` trains on the clips free for products, ``research`` on all.

    Raises:
        LaunchError: it is too little to begin with.
    """
    if not zipfile.is_zipfile(path):
        return ""
    with np.load(path, allow_pickle=False) as arrays:
        if not {"clip_start", "split", "set"} <= set(arrays.files):
            return ""
        taken = (arrays["split"] == "train") & ((arrays["set"] == "default") | (weights == "research"))
        minutes = float(np.diff(arrays["clip_start"])[taken].sum()) / RATE_HZ / 60.0
    had = f"{path} has {minutes:.1f} minutes of motion to train the {weights!r} weights on"
    more = "prepare more recordings, or go on from weights that ship with --start default"
    if minutes < LEAST_MIN:
        raise LaunchError(f"{had}: expected {ENOUGH_MIN:g} or more; {more}")
    return f"{had}, which is little: expected {ENOUGH_MIN:g} or more; {more}" if minutes < ENOUGH_MIN else ""
