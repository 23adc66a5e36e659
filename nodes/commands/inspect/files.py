"""What is in an ``.npz`` or a ``.csv`` of poses, in words."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from steadypose.msgs.types import JointState, PoseRaw
from steadypose.nodes.commands.inspect.hz import Rate
from steadypose.nodes.driving import Diagnosis
from steadypose.nodes.sources.cleaned import is_output
from steadypose.nodes.sources.npz import read_arrays
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.clean.settings import PriorSettings


def describe_file(path: Path) -> Iterator[str]:
    """Lines that say what it holds, and what is probably wrong with it.

    Raises:
        NpzError, CsvError: it holds no poses.
    """
    if path.suffix == ".npz":
        arrays = read_arrays(path)
        output = is_output(arrays)
        yield f"{path}: {'an output of clean, complete or fit' if output else 'joints'}, {_size(path)}"
        for name, array in arrays.items():
            yield f"    {name} {array.shape} {array.dtype}"
        if output:
            state = arrays["state"]
            shares = ", ".join(f"{kind.name.lower()} {(state == kind).mean():.1%}" for kind in JointState)
            yield f"joints: {shares}; poses flagged as anomalies: {arrays['anomaly_flag'].mean():.1%}"
    else:
        yield f"{path}: joints, {_size(path)}"
    source = open_recording(path)
    diagnosis = Diagnosis(PriorSettings())
    stamps, seen, skeletons, ids = [], [], set(), set()
    for _, message in source:
        if isinstance(message, PoseRaw):
            diagnosis.see(message)
            stamps.append(message.stamp_ns / 1e9)
            skeletons.add(message.skeleton)
            for body in message.bodies:
                if (there := np.isfinite(body.positions).all(axis=-1)).any():
                    ids.add(body.id)
                    seen.append(there.mean())
    rate = Rate.of(stamps)
    share = f"{np.mean(seen):.0%} of their joints observed" if seen else "nobody in any frame"
    yield f"{rate.count} frames{rate.brief}, {stamps[-1] - stamps[0]:.2f} s; skeleton {', '.join(skeletons)}"
    yield f"bodies {', '.join(map(str, sorted(ids))) or 'none'}; {share}"
    for cause, count in source.refused.items():
        yield f"refused, {cause}: {count}"
    yield from diagnosis.look()


def _size(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.2f} MB"
