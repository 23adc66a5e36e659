"""Metrics as defined by the papers. Functions take and return arrays in SI units, NaN where there is nothing to
compare."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats


def position_error(estimate: Floats, truth: Floats) -> Floats:
    """Return the distance between (T, J, 3) and (T, J, 3), metres: (T, J). Its mean is the MPJPE."""
    return np.linalg.norm(estimate - truth, axis=-1)


def acceleration_error(estimate: Floats, truth: Floats) -> Floats:
    """Return the norm of the difference of the second differences, (T-2, J) metres/frame² (Kanazawa et al. 2019).

    Multiply by fps² for m/s²: at 30 Hz, 1 mm/frame² is 0.9 m/s².
    """
    return np.linalg.norm(np.diff(estimate - truth, n=2, axis=0), axis=-1)


def errors_mm(estimate: Floats, truth: Floats) -> dict[str, float]:
    """Return the mean errors of joints (T, ..., 3) metres, NaN left out: position, mm, and acceleration, mm/frame²."""
    errors = {"position_mm": position_error(estimate, truth), "acceleration_mm": acceleration_error(estimate, truth)}
    return {name: mean_mm(values) for name, values in errors.items()}


def mean_mm(values: Floats) -> float:
    """Return the mean of the finite values, metres, in mm; NaN if there is none."""
    known = values[np.isfinite(values)]
    return round(1e3 * float(known.mean()), 4) if len(known) else float("nan")


def length_variation(positions: Floats, bones: Sequence[tuple[int, int]]) -> float:
    """Return the variation of the lengths of ``bones`` (pairs of joints) of positions (T, J, 3): standard deviation
    over time by mean length, averaged over bones.
    """
    ends, starts = np.array(bones).T
    lengths = np.linalg.norm(positions[:, ends] - positions[:, starts], axis=-1)
    return float(np.mean(np.nanstd(lengths, axis=0) / np.nanmean(lengths, axis=0)))


def contact_speed(positions: Floats, contact: NDArray[np.bool_], stamps_s: Floats) -> Floats:
    """Return the horizontal speed of joints (T, J, 3) metres, z up, in contact (T, J) in both frames, m/s: (T-1, J),
    else NaN.

    Each foot counts separately. The mean is the foot skate.
    """
    speed = np.linalg.norm(np.diff(positions[..., :2], axis=0), axis=-1) / np.diff(stamps_s)[:, None]
    return np.where(contact[1:] & contact[:-1], speed, np.nan)


def procrustes(source: Floats, target: Floats) -> Floats:
    """Align ``source`` (..., J, 3) with ``target`` in each frame by rotation, translation and scale, for PA-MPJPE.

    Joints that are not finite in either are left out of the fit (Umeyama 1991).
    """
    both = (np.isfinite(source) & np.isfinite(target)).all(axis=-1, keepdims=True)
    count = np.maximum(both.sum(axis=-2, keepdims=True), 1)
    a, b = np.where(both, source, 0.0), np.where(both, target, 0.0)
    middle_a, middle_b = a.sum(axis=-2, keepdims=True) / count, b.sum(axis=-2, keepdims=True) / count
    a, b = np.where(both, a - middle_a, 0.0), np.where(both, b - middle_b, 0.0)
    u, values, vt = np.linalg.svd(a.swapaxes(-1, -2) @ b)
    mirrored = np.linalg.det(u @ vt) < 0
    signs = np.stack([np.ones_like(mirrored), np.ones_like(mirrored), np.where(mirrored, -1, 1)], axis=-1)
    rotation = (u * signs[..., None, :]) @ vt  # acts from the right
    scale = (values * signs).sum(axis=-1) / np.maximum((a**2).sum(axis=(-1, -2)), 1e-12)
    return scale[..., None, None] * ((source - middle_a) @ rotation) + middle_b


def sigma_ratio(error: Floats, sigma: Floats) -> float:
    """Return the error-to-sigma ratio, 1 when calibrated: the root mean square of ``error`` (distance in space) over
    ``sigma``, along an axis. Entries with infinite sigma or NaN error are left out.
    """
    ratio = error / sigma / np.sqrt(3)
    known = np.isfinite(ratio) & np.isfinite(sigma)
    return float(np.sqrt(np.mean(ratio[known] ** 2))) if known.any() else float("nan")


def reliability(error: Floats, sigma: Floats, bins: int = 10) -> list[tuple[float, float, int]]:
    """Return (predicted, observed, count) for ``bins`` equal parts of the joints, sorted by their predicted deviation.

    Both are root mean squares along an axis, metres. For the arguments see `sigma_ratio`.
    """
    known = np.isfinite(error) & np.isfinite(sigma)
    order = np.argsort(sigma[known], kind="stable")
    return [
        (float(np.sqrt(np.mean(stated**2))), float(np.sqrt(np.mean(found**2) / 3)), len(stated))
        for stated, found in zip(
            np.array_split(sigma[known][order], bins), np.array_split(error[known][order], bins), strict=True
        )
        if len(stated)
    ]


def quaternion_distance(estimate: Floats, truth: Floats) -> Floats:
    """Return LAFAN1's L2Q (Harvey et al. 2020): the norm of the difference of global rotations (T, J, 4), (T,).

    A quaternion and its opposite are the same rotation; the nearer one is compared.
    """
    sign = np.where((estimate * truth).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)
    return np.sqrt(((sign * estimate - truth) ** 2).sum(axis=(-1, -2)))


def npss(estimate: Floats, truth: Floats) -> float:
    """Return the normalised power spectrum similarity of motions (N, T, D); 0 is identical (Gopalakrishnan et al.
    2019).

    Power spectra over time are normalised to sum 1 and compared by the earth mover's distance over frequencies. Tracks
    are weighted by their true power.
    """
    power = [np.abs(np.fft.fft(x, axis=1)) ** 2 for x in (truth, estimate)]
    total = power[0].sum(axis=1)
    shares = [np.cumsum(p / np.maximum(p.sum(axis=1, keepdims=True), 1e-12), axis=1) for p in power]
    return float((np.abs(shares[1] - shares[0]).sum(axis=1) * total).sum() / total.sum())
