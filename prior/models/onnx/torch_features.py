"""The networks' input features as torch operations that ONNX supports: the live node's compiled loops, vectorised.

Each function gives the same numbers as the one in `prior.models` that it names; the tests hold them together. Exported
with the network, they make an ONNX file that takes joint positions, so that no features need be computed in C++.
"""

from __future__ import annotations

import torch
from torch import Tensor

from steadypose.prior.body.kinematics import CONTACT_JOINTS, REST_HEIGHT
from steadypose.prior.body.skeleton import HIPS, PARENTS, SHOULDERS
from steadypose.prior.models.contacts.features import (
    FASTEST,
    FROM_ROOT,
    HEIGHT,
    HIGHEST,
    MAX_SIGMA,
    MIN_SIGMA,
    SIGMA,
)
from steadypose.prior.models.hgvae.completion_features import BIAS_MIN, BIAS_SCALE, CENTIMETRE, GROWTH, LAG, NEAR, STILL
from steadypose.prior.models.hgvae.config import SCALE
from steadypose.prior.models.hgvae.fault_features import OFF_SCALE, RECENT, ROUGH_SCALE, SENSOR_SCALE

JOINTS = len(PARENTS)


def hang_unseen(deviations: Tensor) -> Tensor:
    """(B, 66, T) as `hgvae.features.hang_unseen`: joints never seen deviate as what they hang from."""
    joints = list(deviations.unflatten(1, (JOINTS, 3)).unbind(1))
    for joint, parent in enumerate(PARENTS):
        above = joints[parent] if parent > 0 else torch.zeros_like(joints[joint])
        joints[joint] = torch.where(torch.isnan(joints[joint][:, :1, :1]), above, joints[joint])
    return torch.cat(joints, dim=1)


def completion_features(deviations: Tensor, observed: Tensor, bias_sigma: Tensor, patch: int) -> tuple[Tensor, Tensor]:
    """The nodes (B, T / patch, inputs) and the line's variance (B, 22, T) of `hgvae.completion_features`.

    Args:
        deviations: (B, 66, T) tracks less the training mean, in units of `SCALE`; interpolated where not observed.
        observed: (B, 66, T) more than 0 where observed.
        bias_sigma: (B,) metres along an axis, the sensor's slow error.
        patch: frames in a node.
    """
    frames = deviations.shape[2]
    seen = observed.unflatten(1, (JOINTS, 3)).amin(dim=2) > 0
    since, until = _frames_from_sightings(seen)
    variance, of_noise = _noise(deviations, seen)
    mobility, of_mobility = _mobility(deviations, seen)
    bias = bias_sigma.clamp(min=BIAS_MIN)[:, None]
    of_window = torch.cat([of_noise, of_mobility, (bias / BIAS_SCALE).log()], dim=1)
    of_frames = torch.cat([deviations, _nearness(since), _nearness(until)], dim=1).transpose(1, 2)
    nodes = of_frames.unflatten(1, (frames // patch, patch)).flatten(2)
    nodes = torch.cat([nodes, of_window[:, None].expand(-1, frames // patch, -1)], dim=2)
    mobility = (mobility - 2 * variance).clamp(min=0.0)
    return nodes, _line_variance(mobility, variance + (bias / SCALE).square(), since, until)


def _frames_from_sightings(seen: Tensor) -> tuple[Tensor, Tensor]:
    """(B, 22, T) frames since the last sighting and until the next; T where there is none."""
    frames = seen.shape[2]
    ago = (torch.arange(frames)[:, None] - torch.arange(frames)).float()
    shown, never = seen[:, :, None], torch.full((), float(frames))
    since = torch.where(shown & (ago >= 0), ago, never).amin(dim=-1)
    until = torch.where(shown & (ago <= 0), -ago, never).amin(dim=-1)
    return since, until


def _nearness(frames: Tensor) -> Tensor:
    return torch.where(frames < frames.shape[2], 1.0 / (1.0 + frames / NEAR), 0.0)


def _noise(deviations: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Jitter variance of a sighting (B, 22), and its features (B, 23)."""
    shaken = deviations[..., :-2] - 2 * deviations[..., 1:-1] + deviations[..., 2:]
    shown = (seen[..., :-2] & seen[..., 1:-1] & seen[..., 2:]).float()
    squares = (shaken.square().unflatten(1, (JOINTS, 3)).sum(dim=2) * shown).sum(dim=-1)
    counts = shown.sum(dim=-1)
    together = squares.sum(dim=1, keepdim=True) / counts.sum(dim=1, keepdim=True).clamp(min=1.0)
    square = torch.where(counts > 3, squares / counts.clamp(min=1.0), together)
    features = 0.25 * (torch.cat([square, together], dim=1) / CENTIMETRE**2 + 1e-3).log()
    return square / 18, features


def _mobility(deviations: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Mobility of joints (B, 22), with their noise, and its features (B, 22)."""
    beside = torch.eye(JOINTS)
    for joint, parent in enumerate(PARENTS):
        if parent > 0:
            beside[joint, parent] = -1.0
    way = (deviations[..., LAG:] - deviations[..., :-LAG]).unflatten(1, (JOINTS, 3))
    way = (beside @ way.flatten(2)).unflatten(2, (3, -1))
    shown = (seen[..., LAG:] & seen[..., :-LAG]).float()
    squares, counts = (way.square().mean(dim=2) * shown).sum(dim=-1), shown.sum(dim=-1)
    together = squares.sum(dim=1, keepdim=True) / counts.sum(dim=1, keepdim=True).clamp(min=1.0)
    mobility = torch.where(counts > 0, squares / counts.clamp(min=1.0), together)
    return mobility, 0.5 * (mobility / CENTIMETRE**2 + 1e-3).log()


def _line_variance(mobility: Tensor, noise: Tensor, since: Tensor, until: Tensor) -> Tensor:
    frames = since.shape[2]
    alone = (since == frames) | (until == frames)
    gap = torch.where(alone, torch.minimum(since, until), since * until / (since + until).clamp(min=1.0))
    grown = (mobility + (STILL / SCALE) ** 2)[..., None] * (gap / LAG) ** GROWTH + noise[..., None]
    chain = torch.eye(JOINTS)  # each joint's ancestors, itself included
    for joint, parent in enumerate(PARENTS):
        if parent > 0:
            chain[joint] += chain[parent]
    never = (since == frames) & (until == frames)
    hidden = (gap > 0) & ~never
    held = chain @ torch.where(hidden, grown, 0.0)
    return torch.where(never, torch.inf, torch.where(hidden, held, 0.0))


def fault_features(
    tracks: Tensor, mean: Tensor, sigma: Tensor, observed: Tensor, sensor_sigma: Tensor, origin: Tensor
) -> Tensor:
    """(B, 66, 4 T + 2) as `hgvae.fault_features.fault_features`.

    Args:
        tracks: (B, 66, T) metres, as they were seen.
        mean: (B, 66, T) metres, where HG-VAE would put them.
        sigma: (B, 66, T) metres, how sure it is.
        observed: (B, 66, T) more than 0 where observed.
        sensor_sigma: (B,) metres along an axis.
        origin: (66,) metres, of the network.
    """
    frames, seen = tracks.shape[2], observed > 0
    deviations = torch.where(seen, (tracks - origin[:, None]) / SCALE, 0.0)
    off = torch.where(seen, ((tracks - mean) / OFF_SCALE).asinh(), 0.0)
    first = max(frames - RECENT, 2) - 2
    shaken = tracks[..., first:-2] - 2 * tracks[..., first + 1 : -1] + tracks[..., first + 2 :]
    shown = seen[..., first:-2] & seen[..., first + 1 : -1] & seen[..., first + 2 :]
    square = torch.where(shown, shaken, 0.0).square().sum(dim=-1, keepdim=True)
    count = shown.float().sum(dim=-1, keepdim=True).clamp(min=1.0)
    rough = 0.5 * (square / count / ROUGH_SCALE**2 + 1e-3).log()
    sensor = (sensor_sigma / SENSOR_SCALE).log()[:, None, None].expand(-1, tracks.shape[1], 1)
    return torch.cat([deviations, off, (sigma / OFF_SCALE).log(), seen.float(), rough, sensor], dim=-1)


def contact_features(
    positions: Tensor, before: Tensor, dt: Tensor, yaw: Tensor, sigma: Tensor, root_seen: Tensor, ground: Tensor
) -> Tensor:
    """(B, FEATURES) as `contacts.features.contact_features`, which says what each is."""
    joints = list(CONTACT_JOINTS)
    now, then = positions[:, joints], before[:, joints]
    known = ~(torch.isnan(now).any(dim=-1, keepdim=True) | torch.isnan(then).any(dim=-1, keepdim=True))
    nought, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    back = torch.stack([yaw.cos(), -yaw.sin(), nought, yaw.sin(), yaw.cos(), nought, nought, nought, one], dim=-1)
    back, step = back.reshape(-1, 3, 3), dt[:, None, None]
    from_root, from_root_then = now - positions[:, :1], then - before[:, :1]
    velocity = torch.where(root_seen[:, None, None] > 0, (now - then) / step, torch.nan)
    height = now[..., 2] - ground - torch.from_numpy(REST_HEIGHT).float()
    parts = [
        from_root @ back / FROM_ROOT,
        ((from_root - from_root_then) / step @ back).clamp(-FASTEST, FASTEST),
        height[..., None].clamp(-HIGHEST, HIGHEST) / HEIGHT,
        (velocity @ back).clamp(-FASTEST, FASTEST),
        (sigma[:, joints, None].clamp(MIN_SIGMA, MAX_SIGMA) / SIGMA).log(),
        torch.ones_like(height[..., None]),
    ]
    of_joints = torch.cat(parts, dim=-1)
    of_joints = torch.where(known & ~torch.isnan(of_joints), of_joints, 0.0)
    of_body = torch.stack([root_seen, (~torch.isnan(ground)).any(dim=1).float()], dim=1)
    return torch.cat([of_joints.flatten(1), of_body], dim=1)


def trunk_frame(positions: Tensor) -> Tensor:
    """(B, 3, 3) as `sensor_bias.features.trunk_frame`, of positions (B, 22, 3)."""
    hip_l, hip_r, shoulder_l, shoulder_r = (positions[:, joint] for joint in (*HIPS, *SHOULDERS))
    left = _unit(hip_l - hip_r + shoulder_l - shoulder_r)
    forward = _unit(torch.linalg.cross(left, shoulder_l + shoulder_r - hip_l - hip_r))
    return torch.stack([forward, left, torch.linalg.cross(forward, left)], dim=-1)


def correction_features(history: Tensor, camera: Tensor, frame: Tensor) -> Tensor:
    """(B, FEATURES) as `sensor_bias.features.features`.

    Args:
        history: (B, H, 22, 3) metres, z up, smoothed causally; NaN where a joint is missing.
        camera: (B, 3) metres, where the sensor stands.
        frame: (B, 3, 3) `trunk_frame` of the newest.
    """
    newest = history[:, 0]
    hips = (newest[:, HIPS[0]] + newest[:, HIPS[1]]) / 2
    view = camera - hips
    distance = view.square().sum(dim=-1, keepdim=True).sqrt()
    up = torch.zeros_like(view) + torch.tensor([0.0, 0.0, 1.0])
    joints = (history - hips[:, None, None]).flatten(1, 2)
    vectors = torch.cat([joints, up[:, None], (view / distance.clamp(min=1e-9))[:, None]], dim=1)
    seen = (~torch.isnan(newest).any(dim=-1)).float()
    return torch.cat([(vectors @ frame).flatten(1), distance, -view[:, 2:], seen], dim=1)


def _unit(v: Tensor) -> Tensor:
    return v / v.square().sum(dim=-1, keepdim=True).sqrt().clamp(min=1e-9)
