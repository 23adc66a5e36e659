"""``steadypose train``: reproduce the weights that ship, or train on motion of one's own."""

import sys
import zipfile
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
import tyro

from steadypose.nodes.settings import LaunchError
from steadypose.prior.models.weights import weights_path
from steadypose.training.data.datasets import WeightSet

RECIPES = {
    "hmvae": ("hmvae", "train_hmvae"),
    "hmvae64": ("hmvae", "train_long_hmvae"),
    "hgvae": ("hgvae", "train_hgvae"),
    "completion": ("hgvae", "train_completion"),
    "trajectory": ("root_velocity", "train_trajectory"),
    "contacts": ("contacts", "train_contacts"),
    "completer": ("completer", "train_completer"),
    "humor": ("humor", "train_humor"),
    "correction": ("sensor_bias", "train_correction"),
    "mixture": ("mixture", "train_mixture"),
    "body_modes": ("moments", "train_modes"),
    "occlusion": ("occlusion", "train_occlusion"),
    "posture": ("moments", "train_posture"),
}
"""of each model: the module of `training.recipes`, and its function"""
Model = Literal[tuple(RECIPES)]  # pyright: ignore[reportInvalidTypeForm]
RATE_HZ = 30.0
LEAST_MIN, ENOUGH_MIN = 0.5, 30.0
"""minutes of motion: below the one no batch is like another, below the other a model knows these movements alone"""


def train(
    model: Model,  # pyright: ignore[reportInvalidTypeForm]
    data: Path = Path("data/prepared.npz"),
    weights: Annotated[
        Literal["default", "research", "kinect_v2"] | None, tyro.conf.arg(metavar="{default,research,kinect_v2}")
    ] = None,
    runs: Path = Path("runs"),
    iterations: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    start: Annotated[str | None, tyro.conf.arg(metavar="WEIGHTS")] = None,
    seed: int = 0,
    threads: int = 2,
    install: bool = False,
) -> None:
    """Train a model of the prior on prepared motion.

    Training takes seconds (posture) to hours (completer: eight) on two cores. It shows progress and draws curves. If it
    is killed, the same command resumes it. The folder runs/MODEL-SET gets the weights and a card that describes how
    they were made. To use them, put their path into a launch file, or replace the bundled weights with --install.

    To train on several processes or machines, use torchrun:
    `torchrun --nproc-per-node 2 -m steadypose.nodes.cli train hmvae`.

    Try:
      steadypose prepare mocap/ && steadypose train contacts

    Args:
        model: mixture (the smoother), body_modes (which joints it smooths together; takes seconds), hmvae (refinement),
            hmvae64 ('complete --optimise'), hgvae (anomaly score and imputation), completion (the part of hgvae that
            places hidden joints), trajectory (root velocity), contacts, humor (transitions, for 'steadypose fit'),
            occlusion (weights of a hidden joint), posture (relative position of joints), completer ('steadypose
            complete'), or correction (bias of a sensor).
        data: output of 'steadypose prepare'. For a correction, ui_prmd.npz (Kinect beside Vicon). For mixture,
            body_modes and occlusion, the folder of the recordings, which are played at several speeds.
        weights: the weight set to train: 'default' uses only data licensed for products, 'research' all data (not for
            mixture, body_modes and occlusion). For a correction, the sensor's name, kinect_v2.
        runs: folder for checkpoints and curves.
        iterations: optimiser steps. Default: as the model needs. Fewer give a weaker model sooner.
        start: weights to start from, a set or a .safetensors file, for fine-tuning on your own motion; try a third of
            the iterations. Not for a correction.
        seed: random seed of weights and sampling.
        threads: CPU threads; with torchrun, of all processes of a machine together.
        install: replace the bundled weights of this set; the old ones move to the folder 'previous' beside them.
    """
    # here, so that --help needs no torch
    from steadypose.training.distributed import join, set_threads, writes
    from steadypose.training.loop import TrainingOptions
    from steadypose.training.weights import install as install_weights

    join()
    set_threads(threads)
    name = weights or ("kinect_v2" if model == "correction" else "default")
    of_default_alone = model in ("mixture", "body_modes", "occlusion")
    sets = ("kinect_v2",) if model == "correction" else ("default",) if of_default_alone else get_args(WeightSet)
    if name not in sets:
        raise LaunchError(f"--weights: expected {' or '.join(sets)} for {model}, got {name}")
    if start is not None and model == "correction":
        raise LaunchError("--start: a correction is trained from the beginning, in minutes; leave it out")
    if start is not None:  # before minutes of preparation
        weights_path(start, "hgvae" if model == "completion" else model)
    if of_default_alone and not data.is_dir():
        raise LaunchError(f"--data: expected the folder of the recordings to train {model} on, got {data}")
    try:
        options = TrainingOptions(data, runs, name, iterations, seed, start)
    except ValueError as error:
        raise LaunchError(f"--{error}") from error
    if warning := little_data(data, name, start):
        print(warning, file=sys.stderr)
    recipe, function = RECIPES[model]
    path = getattr(import_module(f"steadypose.training.recipes.{recipe}"), function)(options)
    if writes():
        print(f"weights: {install_weights(path) if install else path}")


def little_data(path: Path, weights: str, start: str | None = None) -> str:
    """A warning of too little prepared motion for a set of weights; empty if it is enough, or another file.

    Raises LaunchError if it is too little to begin with.
    """
    if not zipfile.is_zipfile(path):
        return ""
    with np.load(path, allow_pickle=False) as arrays:
        if not {"clip_start", "split", "set"} <= set(arrays.files):
            return ""
        taken = (arrays["split"] == "train") & ((arrays["set"] == "default") | (weights == "research"))
        minutes = float(np.diff(arrays["clip_start"])[taken].sum()) / RATE_HZ / 60.0
    had = f"{path} has {minutes:.1f} minutes of motion to train the {weights!r} weights on"
    if minutes < LEAST_MIN:
        raise LaunchError(f"{had}: expected at least {LEAST_MIN:g}, better {ENOUGH_MIN:g}; prepare more recordings")
    more = f"expected {ENOUGH_MIN:g}; prepare more recordings{'' if start else ', or fine-tune with --start default'}"
    return f"{had}, which is little: {more}" if minutes < ENOUGH_MIN else ""
