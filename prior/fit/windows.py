"""Fits recordings of any length in overlapping windows, one after the other, each stored as soon as it is finished."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.fit.energy import Anchored
from steadypose.prior.fit.humor_network import HumorNet
from steadypose.prior.fit.motion import Motion
from steadypose.prior.fit.observations import Observed
from steadypose.prior.fit.solve import FitSettings, Fitted, Start, fit_window

FRAMES, OVERLAP = 90, 15  # length of a window, as in the paper, and overlap with the next window, frames
LYING = 0.5  # cosine of the pelvis' tilt below which a body lies
MIN_FRAMES = 8  # length of the shortest track that is fitted, frames


@dataclass(frozen=True)
class Track:
    """One body at 30 Hz, T frames without a gap."""

    starts: Sequence[Start]  # initial poses; if there are several, each window keeps the fit of least energy
    observed: Sequence[Observed]  # observations of all T frames

    def __len__(self) -> int:
        return len(self.starts[0].root)


@dataclass(frozen=True)
class FittedTrack:
    """The fit of a track."""

    joints: Floats  # (T, 22, 3) metres, world
    rotations: Floats  # (T, 22, 3, 3) local; the root's to the world
    offsets: Floats  # (W, 22, 3) metres, the fitted bones of each of W windows
    ground: Floats  # (W, 3) the ground of each window: height, metres, and tilts about x and y, radians
    load: Floats  # (T, 8) probabilities that `CONTACT_JOINTS` bear load; NaN if the model does not predict them
    misfit: Floats  # (K, T, 22) `Observed.misfit` of each of K observations
    energies: Floats  # (W, S) nats after each stage
    kept: Bools  # (W,) whether a window's last stage was kept


def window_bounds(frames: int) -> list[tuple[int, int]]:
    """Return first frame and end (exclusive) of each window; the last is as long as the others and overlaps more."""
    if frames <= FRAMES:
        return [(0, frames)]
    firsts = [*range(0, frames - FRAMES, FRAMES - OVERLAP), frames - FRAMES]
    return [(first, first + FRAMES) for first in firsts]


def fit_track(
    model: HumorNet,
    track: Track,
    settings: FitSettings,
    folder: Path | None = None,
    *,
    advanced: Callable[[], None] = lambda: None,
) -> FittedTrack:
    """Fit all windows of a track, as `fit_window`. ``folder`` is a cache of fitted windows, keyed by a digest of
    everything that a fit depends on; ``advanced`` is called after each window."""
    done: list[dict[str, Floats]] = []
    starts = track.starts
    for number, (first, last) in enumerate(bounds := window_bounds(len(track))):
        anchor = None
        if number:
            shared = bounds[number - 1][1] - first
            anchor = Anchored(torch.from_numpy(done[-1]["joints"][-shared:]).float())
            bones, ground = torch.from_numpy(done[-1]["offsets"]).float(), float(done[-1]["ground"][0])
            starts = [replace(start, offsets=bones, ground=ground) for start in starts]
        parts = [_grounded(_between(start, first, last)) for start in starts]
        seen = [observed.between(first, last) for observed in track.observed]
        path = folder and folder / f"{number:05d}-{_fingerprint(model, parts, seen, settings, anchor)}.npz"
        found = _stored(path)
        if found is None:
            tried = [fit_window(model, part, seen, settings, anchor=anchor) for part in parts]
            best = min(range(len(tried)), key=lambda which: tried[which].energies[-1])
            found = {**_arrays(tried[best], seen), "start": np.array(best)}
            _store(path, found)
        starts = [starts[int(found["start"])]]
        done.append(found)
        advanced()
    return _joined(done, bounds)


def _between(start: Start, first: int, last: int) -> Start:
    return replace(start, root=start.root[first:last], rotations=start.rotations[first:last])


def _grounded(start: Start) -> Start:
    """Make the floor certain if the body ever lies, because such unlikely poses would displace it."""
    return replace(start, ground_known=start.ground_known or float(start.rotations[:, 0, 2, 2].min()) < LYING)


@torch.no_grad()
def _arrays(fitted: Fitted, seen: Sequence[Observed]) -> dict[str, Floats]:
    motion = fitted.motion
    rotations = motion.rotations.clone()
    rotations[:, 0] = motion.tilt @ rotations[:, 0]
    return {
        "joints": _numpy(motion.world_joints),
        "rotations": _numpy(rotations),
        "offsets": _numpy(motion.offsets),
        "ground": _numpy(motion.variables.ground),
        "load": load_of(motion),
        "misfit": np.stack([_numpy(observed.misfit(motion)) for observed in seen]),
        "energies": np.array(fitted.energies),
        "kept": np.array(fitted.kept),
    }


@torch.no_grad()
def load_of(motion: Motion) -> Floats:
    """(T, 8) probabilities of load. The first two frames, in which no step ends, have those of the third."""
    logits = motion.predicted[1][:, : len(CONTACT_JOINTS)]
    if not logits.shape[1]:
        return np.full((len(motion.joints), len(CONTACT_JOINTS)), np.nan)
    return _numpy(torch.cat([logits[:1], logits[:1], logits]).sigmoid())


def _numpy(values: Tensor) -> Floats:
    return values.detach().double().numpy()


def _joined(done: Sequence[dict[str, Any]], bounds: Sequence[tuple[int, int]]) -> FittedTrack:
    """Join all windows to one motion, cross-faded where two overlap."""
    whole = {name: values for name, values in done[0].items() if name in ("joints", "rotations", "load", "misfit")}
    for (_, end), (first, _), found in zip(bounds, bounds[1:], done[1:], strict=False):
        shared = end - first
        share = (np.arange(shared) + 1.0) / (shared + 1)
        for name in ("joints", "load", "misfit"):
            axis = 1 if name == "misfit" else 0
            a, b = np.moveaxis(whole[name], axis, 0), np.moveaxis(found[name], axis, 0)
            weight = share.reshape(-1, *[1] * (a.ndim - 1))
            mixed = (1 - weight) * a[-shared:] + weight * b[:shared]
            whole[name] = np.moveaxis(np.concatenate([a[:-shared], mixed, b[shared:]]), 0, axis)
        a, b = whole["rotations"], found["rotations"]
        mixed = _slerp(a[-shared:], b[:shared], share)
        whole["rotations"] = np.concatenate([a[:-shared], mixed, b[shared:]])
    every = {name: np.stack([found[name] for found in done]) for name in ("offsets", "ground", "energies", "kept")}
    return FittedTrack(**whole, **every)


def _slerp(first: Floats, second: Floats, share: Floats) -> Floats:
    """Interpolate rotations (F, 22, 3, 3) from the first to the second by ``share`` (F,)."""
    a = Rotation.from_matrix(first.reshape(-1, 3, 3))
    turn = (a.inv() * Rotation.from_matrix(second.reshape(-1, 3, 3))).as_rotvec()
    part = np.repeat(share, first.shape[1])[:, None] * turn
    return (a * Rotation.from_rotvec(part)).as_matrix().reshape(first.shape)


def _stored(path: Path | None) -> dict[str, Floats] | None:
    if path is None or not path.is_file():
        return None
    with np.load(path) as arrays:
        return dict(arrays)


def _store(path: Path | None, found: dict[str, Any]) -> None:
    if path is None:
        return
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez(file, **found)
    os.replace(part, path)


def _fingerprint(model: HumorNet, *inputs: Any) -> str:
    """Digest of everything that a window's fit depends on."""
    digest = hashlib.sha256()
    for value in (*model.state_dict().values(), *inputs):
        _update(digest, value)
    return digest.hexdigest()[:16]


def _update(digest: Any, value: Any) -> None:
    if isinstance(value, Tensor):
        digest.update(value.detach().contiguous().numpy().tobytes())
    elif is_dataclass(value):
        for field in fields(value):
            _update(digest, getattr(value, field.name))
    elif isinstance(value, list | tuple):
        for item in value:
            _update(digest, item)
    else:
        digest.update(repr(value).encode())
