from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torch.optim import SGD
from torch.optim.lr_scheduler import LambdaLR

from steadypose.training.data.prepare import save_arrays
from steadypose.training.loop import TrainingRun


def run(directory: Path, steps: int) -> TrainingRun:
    network = nn.Linear(2, 1)
    training = TrainingRun(directory, network, LambdaLR(SGD(network.parameters(), 0.1), lambda _: 1.0), steps, steps)
    training.minimise(lambda count, done, rng: (network(torch.ones(count, 2)).square().mean(), {"l": 1.0}), dict, 1, 0)
    return training


def test_a_full_disk_is_named_and_leaves_the_last_checkpoint(tmp_path: Path) -> None:
    run(tmp_path, 1)
    left = {file: file.read_bytes() for file in tmp_path.iterdir()}
    (tmp_path / "checkpoint.pt.part").symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"No space left on device: .*checkpoint\.pt'"):
        run(tmp_path, 2)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == left
    assert run(tmp_path, 2).step == 2


def test_a_full_disk_leaves_no_part_of_prepared_motion(tmp_path: Path) -> None:
    (tmp_path / "prepared.npz.part").symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"No space left on device: .*prepared\.npz'"):
        save_arrays(tmp_path / "prepared.npz", positions=np.zeros((100, 22, 3)))
    assert not list(tmp_path.iterdir())
