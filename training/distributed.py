"""Distributed training with ``torchrun``: each process draws a share of the batch, and gradients are averaged.

Without torchrun there is one process, and these functions have no effect: `rank` is 0 and every average is the value.
The backend is gloo, because the models train on CPUs.
"""

import atexit
import os
from typing import TypeVar

import torch
import torch.distributed as dist
from torch.optim import Optimizer

T = TypeVar("T")


def join() -> None:
    """Join the other processes, if torchrun started this one."""
    if dist.is_torchelastic_launched() and not dist.is_initialized():
        dist.init_process_group("gloo")
        atexit.register(dist.destroy_process_group)


def rank() -> int:
    """Return the index of this process, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def processes() -> int:
    return dist.get_world_size() if dist.is_initialized() else 1


def set_threads(threads: int) -> None:
    """Divide ``threads`` among the processes that train on this machine, at least one each."""
    neighbours = int(os.environ.get("LOCAL_WORLD_SIZE", 1)) if dist.is_initialized() else 1
    torch.set_num_threads(max(threads // neighbours, 1))


def writes() -> bool:
    """Whether this is the first process, which writes files and reports to the user."""
    return rank() == 0


def share(batch: int) -> int:
    """Return the number of a batch's samples that this process draws. Raises ValueError if the batch cannot be divided
    evenly."""
    if batch % processes():
        raise ValueError(f"batch: expected a multiple of the {processes()} processes of torchrun, got {batch}")
    return batch // processes()


def from_first(value: T) -> T:
    """Broadcast the first process' value to all."""
    if processes() == 1:
        return value
    box = [value]
    dist.broadcast_object_list(box, src=0)
    return box[0]


def average_gradients(optimiser: Optimizer) -> None:
    """Average the gradients of all processes before each step of an optimiser."""
    if processes() > 1:
        optimiser.register_step_pre_hook(_average)


def _average(optimiser: Optimizer, *_: object) -> None:
    # all processes have gradients for the same parameters: these depend on the step, not on the samples
    parameters = [p for group in optimiser.param_groups for p in group["params"] if p.grad is not None]
    total = torch.cat([parameter.grad.reshape(-1) for parameter in parameters])
    dist.all_reduce(total)
    total /= processes()
    for parameter, mean in zip(parameters, total.split([p.numel() for p in parameters]), strict=True):
        parameter.grad = mean.view_as(parameter)
