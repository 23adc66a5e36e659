"""``steadypose train``: reproduce the weights that ship, or train on motion of one's own."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Literal, get_args

from steadypose.nodes.commands.training_data import little_data
from steadypose.nodes.graph.settings import LaunchError
from steadypose.training.data.datasets import WeightSet
from steadypose.training.distributed import join, set_threads, writes
from steadypose.training.loop import TrainingOptions
from steadypose.training.weights import install as install_weights


def train(
    model: Literal[
        "hmvae",
        "hmvae64",
        "hgvae",
        "hgvae-wide",
        "trajectory",
        "contacts",
        "completer",
        "humor",
        "correction",
        "mixture",
        "body_modes",
        "occlusion",
        "posture",
    ],
    data: Path = Path("data/prepared.npz"),
    weights: Literal["default", "research", "kinect_v2"] | None = None,
    runs: Path = Path("runs"),
    iterations: int | None = None,
    start: str | None = None,
    seed: int = 0,
    threads: int = 2,
    install: bool = False,
) -> None:
    """Train a model of the prior on prepared motion.

    With torchrun, several processes or machines share each batch; the first of them writes:
    `torchrun --nproc-per-node 2 -m steadypose.nodes.cli train hmvae`.

    Takes about an hour on two cores, shows its progress, draws its curves as it goes, and resumes where it was if
    it is killed and started again. The weights, with a card that says how they were made, lie in the run's folder,
    runs/MODEL-SET; a launch file takes their path. Those that ship are replaced only when asked to, and kept.

    Args:
        model: mixture (the smoother), body_modes (which joints it smooths together, in seconds), hmvae (refinement),
            hmvae64 ('complete --optimise'), hgvae (anomaly score and imputation), hgvae-wide (the same in the paper's
            size, for recordings), trajectory (root velocity), contacts, humor (transitions, for 'steadypose fit'),
            occlusion (weights of a hidden joint), posture (how joints lie to each other), completer ('steadypose
            complete'), or correction (a sensor's own error).
        data: what 'steadypose prepare' wrote; for a correction, ui_prmd.npz, the Kinect beside Vicon; for
            mixture, body_modes and occlusion, the folder of the recordings, which they take at several speeds.
        weights: the set to train: 'default' takes only data free for products, 'research' all of it (there is none of
            mixture, body_modes and occlusion); a correction is named after its sensor, kinect_v2.
        runs: where checkpoints and curves go.
        iterations: optimiser steps; the model's own number, if left out. Fewer make a weaker model sooner.
        start: weights to go on from, a set or a .safetensors file: with motion of one's own and a third of the
            iterations, say. Not for a correction.
        seed: for weights and sampling.
        threads: CPU threads; under torchrun, of all processes of a machine together.
        install: put the weights where nodes find them by the set's name; what they replace goes to 'previous' there.
    """
    join()
    set_threads(threads)
    if model == "hmvae":
        from steadypose.training.recipes.hmvae import train_hmvae as train_model
    elif model == "hmvae64":
        from steadypose.training.recipes.hmvae import train_long_hmvae as train_model
    elif model == "hgvae":
        from steadypose.training.recipes.hgvae import train_hgvae as train_model
    elif model == "hgvae-wide":
        from steadypose.training.recipes.hgvae import train_hgvae_wide as train_model
    elif model == "mixture":
        from steadypose.training.recipes.mixture import train_mixture as train_model
    elif model == "body_modes":
        from steadypose.training.recipes.body_modes import train_modes as train_model
    elif model == "trajectory":
        from steadypose.training.recipes.root_velocity import train_trajectory as train_model
    elif model == "completer":
        from steadypose.training.recipes.completer import train_completer as train_model
    elif model == "contacts":
        from steadypose.training.recipes.contacts import train_contacts as train_model
    elif model == "occlusion":
        from steadypose.training.recipes.occlusion import train_occlusion as train_model
    elif model == "posture":
        from steadypose.training.recipes.posture import train_posture as train_model
    elif model == "humor":
        from steadypose.training.recipes.humor import train_humor as train_model
    else:
        from steadypose.training.recipes.sensor_bias import train_correction as train_model
    name = weights or ("kinect_v2" if model == "correction" else "default")
    if name not in (sets := _weight_sets(model)):
        raise LaunchError(f"--weights: expected {' or '.join(sets)} for {model}, got {name}")
    if start is not None and model == "correction":
        raise LaunchError("--start: a correction is trained from the beginning, in minutes; leave it out")
    try:
        options = TrainingOptions(data, runs, name, iterations, seed, start)
    except ValueError as error:
        raise LaunchError(f"--{error}") from error
    if warning := little_data(data, name):
        print(warning, file=sys.stderr)
    path = train_model(options)
    if writes():
        print(f"weights: {install_weights(path) if install else path}")


def _weight_sets(model: str) -> tuple[str, ...]:
    """The sets of weights that a model can be trained for."""
    if model == "correction":
        return ("kinect_v2",)
    return ("default",) if model in ("mixture", "body_modes", "occlusion") else get_args(WeightSet)
