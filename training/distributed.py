"""Training on several processes, started by ``torchrun``: each draws a share of the batch, gradients are averaged.

Without torchrun there is one process, and nothing here does anything: `rank` is 0 and every average is the value.
The backend is gloo, because the models train on processors.
"""

from __future__ import annotations

import atexit
import os
from typing import TypeVar

import torch
import torch.distributed as dist
from torch.optim import Optimizer

T = TypeVar("T")


def join() -> None:
    """Meet the other processes that torchrun started, if it did."""
    if dist.is_torchelastic_launched() and not dist.is_initialized():
        dist.init_process_group("gloo")
        atexit.register(dist.destroy_process_group)


def rank() -> int:
    """This process' number, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def processes() -> int:
    """How many train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def set_threads(threads: int) -> None:
    """Share ``threads`` of this machine among the processes that train on it, at least one each."""
    neighbours = int(os.environ.get("LOCAL_WORLD_SIZE", 1)) if dist.is_initialized() else 1
    torch.set_num_threads(max(threads // neighbours, 1))


def writes() -> bool:
    """Whether this is the process that writes files and talks to the user: the first."""
    return rank() == 0


def share(batch: int) -> int:
    """How many of a batch's samples this process draws.

    Raises:
        ValueError: the batch cannot be shared out evenly.
    """
    if batch % processes():
        raise ValueError(f"batch: expected a multiple of the {processes()} processes of torchrun, got {batch}")
    return batch // processes()


def from_first(value: T) -> T:
    """What the first process has, on all of them."""
    if processes() == 1:
        return value
    box = [value]
    dist.broadcast_object_list(box, src=0)
    return box[0]


def average_gradients(optimiser: Optimizer) -> None:
    """Before each step of an optimiser, take the mean of every process' gradients."""
    if processes() > 1:
        optimiser.register_step_pre_hook(lambda stepping, *_: _average(stepping))


def _average(optimiser: Optimizer) -> None:
    # which parameters a step touches is the same on all processes: it depends on the step, not on the samples
    parameters = [p for group in optimiser.param_groups for p in group["params"] if p.grad is not None]
    total = torch.cat([parameter.grad.reshape(-1) for parameter in parameters])
    dist.all_reduce(total)
    total /= processes()
    for parameter, mean in zip(parameters, total.split([p.numel() for p in parameters]), strict=True):
        parameter.grad = mean.view_as(parameter)
